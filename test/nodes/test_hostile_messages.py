"""Hostile text in each string of each message and parameter of a live predictor, over DDS."""

from collections.abc import Iterator, MutableSequence
import copy

from bellows_ros.core.parameters import table
from geometry_msgs.msg import Transform, Twist
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import String
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from .conftest import LATCHED, MS, PACKAGE, START

INVALID = b'\xed\xb0\x80\xff\xed\xb0\x80\xff'  # a surrogate, and no UTF-8
MARK = 'M' * len(INVALID)
TEXTS = ('\x1b]0;x\x07\x1b[2J\n', '$5_$6_$\\frac{', '\u202e\x07' * 100_000, 'a' * 200_000, MARK)
VALUES = {
    **PACKAGE, 'package.size': [0.1, 0.1, 0.1], 'landing.height': -1.0, 'tool_link': 'tool',
    'vacuum.signal': 'pressure', 'cup.layout': [0.05, 0.0, 0.0, -0.05, 0.0, 0.0],
    'cup.lip_radius': 0.02, 'vacuum.holding': 60000.0}
URDF = """<robot name="arm"><link name="base"/><link name="tool"/>
<joint name="one" type="revolute"><parent link="base"/><child link="tool"/>
<origin xyz="0 0 1" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1"/></joint></robot>"""
WORDS = ('world', 'tool', 'one', 'revolute', '0 0 1', '-1', 'arm')


def require_harmless(text):
    """Refuse control characters and floods."""
    assert all(c.isprintable() or c == '\n' for c in text), repr(text[:300])
    assert text.encode() and len(text) <= 3000


def sound(kind):
    """Return a message of a type with content wherever it has room for text."""
    message = kind()
    if kind is MultiDOFJointTrajectory:
        message.joint_names = ['tool']
        message.points = [MultiDOFJointTrajectoryPoint(
            transforms=[Transform()], velocities=[Twist()]) for _ in range(30)]
    elif kind is JointTrajectory:
        message.joint_names = ['one']
        message.points = [JointTrajectoryPoint(positions=[0.0]) for _ in range(30)]
    elif kind is String:
        message.data = URDF.replace('"base"', '"world"')
    elif kind is FluidPressure:
        message.fluid_pressure = 40_000.0
    for k, point in enumerate(getattr(message, 'points', ())):
        point.time_from_start.nanosec = k * 10_000_000
    if hasattr(message, 'header'):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(START, 1_000_000_000)
    return message


def with_text(message, text) -> Iterator[object]:
    """Yield copies of a message, in each of which a text is one of the strings."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        parts = []
        if isinstance(value, str):
            parts = [text, *(value.replace(f'"{word}"', f'"{text}"', 1)
                             for word in WORDS if f'"{word}"' in value)]
        elif isinstance(value, MutableSequence) and value and isinstance(value[0], str):
            parts = [[text], [*value, text]]
        elif hasattr(value, 'get_fields_and_field_types'):
            parts = list(with_text(value, text))
        for part in parts:
            changed = copy.copy(message)
            setattr(changed, name, part)
            yield changed


def strings_of(message) -> Iterator[str]:
    """Yield all strings of a message."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        for part in value if isinstance(value, MutableSequence) else [value]:
            if isinstance(part, str):
                yield part
            elif hasattr(part, 'get_fields_and_field_types'):
                yield from strings_of(part)


@pytest.fixture
def graph(make_partner, plan_kernels, observer_kernels):
    """Give a partner, the publisher of each input, and what is heard on each output."""
    partner = make_partner(VALUES)
    node, heard = partner.predictor, []
    for end in list(node.publishers):
        if end.topic_name not in ('/rosout', '/parameter_events'):
            heard.append(partner.hears(end.msg_type, end.topic_name))
    inputs = {end.topic_name: (end.msg_type, partner.writes(
        end.msg_type, end.topic_name, LATCHED if end.topic_name.endswith('description') else 10))
        for end in node.subscriptions if not end.topic_name.endswith(('/clock', '_events'))}
    partner.connect(node)
    return partner, inputs, heard


def is_idle(node):
    """Tell whether a predictor has taken what was sent."""
    answering = node.pipeline.planning._answering
    return answering.done() or not answering.running()


@pytest.mark.stress
def test_no_text_of_a_message_reaches_log_diagnostics_or_outputs(graph, capfd):
    """Escaped and shortened, or refused; the node predicts as before. Frames missing: one line."""
    partner, inputs, heard = graph
    node = partner.predictor
    node.diagnostics.report()
    assert len(inputs) >= 10, inputs
    planning = node.pipeline.planning
    partner.wait(lambda: planning._warming.is_done and is_idle(node))
    for stamp, text in enumerate(TEXTS):
        for kind, writer in inputs.values():
            for message in with_text(sound(kind), text):
                data = serialize_message(message)
                writer.publish(data.replace(MARK.encode(), INVALID))
                partner.ros.spin_until(lambda: is_idle(node))
        partner.send_pose(START + (stamp + 1) * MS)
        partner.wait(lambda: len(partner.poses) > stamp and is_idle(node))  # noqa: B023
        node.diagnostics.report()
    partner.wait(lambda: any(hasattr(message, 'status') for got in heard for message in got))
    for got in heard:
        for message in got:
            for text in filter(None, strings_of(message)):
                require_harmless(text)
    log = capfd.readouterr().err
    for line in filter(None, log.splitlines()):
        require_harmless(line)
    assert len(log) < 300_000 and not node.failures


def test_no_text_of_a_parameter_reaches_log_or_answer(node, capfd):
    """In the value of each one that is a string."""
    names = [name for name in table.PARAMETERS if table.lookup(name).kind.startswith('string')]
    for text in TEXTS:
        for parameter in (
                Parameter(name, value=[text] if 'array' in table.lookup(name).kind else text)
                for name in names if node.has_parameter(name)):
            (result,) = node.set_parameters([parameter])
            require_harmless(result.reason or ' ')
    for line in filter(None, capfd.readouterr().err.splitlines()):
        require_harmless(line)
    assert not node.failures
