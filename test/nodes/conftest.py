"""A predictor, and nodes of the tests that publish, subscribe and call services over DDS."""

import importlib.util
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest

WITHOUT_ROS = ('test_command.py', 'test_config.py')
if importlib.util.find_spec('rclpy') is None:  # the report's header says so
    collect_ignore = [path.name for path in Path(__file__).parent.glob('test_*.py')
                      if path.name not in WITHOUT_ROS]
else:
    from bellows_ros.nodes.conversions import stamp_to_ns
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from rclpy.qos import DurabilityPolicy, QoSProfile

    LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

PACKAGE = {
    'package.mass': 2.17,
    'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03],
}
GIVEN = [word for key, value in PACKAGE.items() for word in ('-p', f'{key}:={value}')]
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)
MS = 1_000_000
START = 1_700_000_000_000_000_000
QUEUE = 10_000  # messages; nothing is lost while a node is busy sending
OK, WARN, ERROR = b'\x00', b'\x01', b'\x02'  # levels of diagnostics
OUTPUTS = ('package/pose', 'package/twist', 'cup/wrench')


def overrides_of(values):
    """Return values as the overrides that a node takes."""
    return [Parameter(name, value=value) for name, value in values.items()]


def set_on(node, name, value):
    """Set a parameter, which must succeed."""
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert result.successful, result.reason


def break_once(thing, name):
    """Let the next call of a method raise; later calls work."""
    sound = getattr(thing, name)

    def fail(*arguments):
        setattr(thing, name, sound)
        raise ZeroDivisionError('\x1b[31mbroken' + 'x' * 1000)

    setattr(thing, name, fail)


def break_always(thing, name):
    """Let a method raise whenever it is called."""
    def fail(*arguments):
        raise ZeroDivisionError('broken')

    setattr(thing, name, fail)


def stamp_ns(message):
    """Return the stamp of a message."""
    return stamp_to_ns(message.header.stamp)


def stamped(message, stamp_ns, frame_id='world'):
    """Give a message with a header."""
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return message


def pose_at(stamp_ns, position=ORIGIN, xyzw=UPRIGHT, frame_id='world'):
    """Return a pose."""
    return placed(stamped(PoseStamped(), stamp_ns, frame_id), position, xyzw)


def placed(message, position, xyzw):
    """Give a message of a pose or a transform its numbers."""
    part = message.transform if hasattr(message, 'transform') else message.pose
    part = getattr(part, 'pose', part)
    point = part.translation if hasattr(part, 'translation') else part.position
    q = part.rotation if hasattr(part, 'rotation') else part.orientation
    point.x, point.y, point.z = map(float, position)
    q.x, q.y, q.z, q.w = map(float, xyzw)
    return message


class Peer:
    """Another node of the graph."""

    def __init__(self, ros, name='peer'):
        """Join the graph."""
        self.ros, self.node = ros, Node(name, context=ros.context)
        self.ends: list[Any] = []
        ros.executor.add_node(self.node)

    def hears(self, kind, topic, qos=QUEUE, decode=None, **options):
        """Listen to a topic, and return the list into which its messages come."""
        got: list[Any] = []

        def take(message):
            got.append(decode(message) if decode else message)

        self.ends.append(self.node.create_subscription(kind, topic, take, qos, **options))
        return got

    def writes(self, kind, topic, qos=QUEUE):
        """Return a publisher on a topic."""
        self.ends.append(self.node.create_publisher(kind, topic, qos))
        return self.ends[-1]

    def is_connected(self, other=None):
        """Return whether every topic is matched, in the view of both nodes."""
        names = {end.topic_name for end in self.ends}
        others = [] if other is None else [*other.subscriptions, *other.publishers]
        # A best-effort reader gets nothing from a writer it does not know yet.
        return all(
            (getattr(end, 'get_publisher_count', None) or end.get_subscription_count)()
            for end in (*self.ends, *(end for end in others if end.topic_name in names)))

    def connect(self, other=None):
        """Wait until every topic is matched."""
        self.wait(lambda: self.is_connected(other))

    def wait(self, condition):
        """Spin until a condition holds."""
        assert self.ros.spin_until(condition)

    def call(self, service, kind, request=None):
        """Call a service and return its answer."""
        client = self.node.create_client(kind, service)
        assert self.ros.spin_until(client.service_is_ready), service
        future = client.call_async(kind.Request() if request is None else request)
        assert self.ros.spin_until(future.done), service
        return future.result()


class Partner(Peer):
    """
    Send the tool arm's messages and keep the answers.

    Attributes
    ----------
    poses, twists, wrenches : list
        Messages received on package/pose, package/twist and cup/wrench.

    """

    def __init__(self, ros, predictor, with_twists=True):
        """Create the topics, and wait until every topic is matched."""
        super().__init__(ros, 'partner')
        self.predictor = predictor
        self.poses, self.twists, self.wrenches = map(
            self.hears, (PoseStamped, TwistStamped, WrenchStamped), OUTPUTS)
        self.pose_writer = self.writes(PoseStamped, 'tool_arm/pose')
        if with_twists:
            self.twist_writer = self.writes(TwistStamped, 'tool_arm/twist')
        self.connect(predictor)

    def send_pose(self, stamp_ns, *where, **options):
        """Send a pose of the tool."""
        self.pose_writer.publish(pose_at(stamp_ns, *where, **options))

    def send_twist(self, stamp_ns, linear=ORIGIN, angular=ORIGIN):
        """Send a twist of the tool."""
        message = stamped(TwistStamped(), stamp_ns, '')
        v, w = message.twist.linear, message.twist.angular
        v.x, v.y, v.z = map(float, linear)
        w.x, w.y, w.z = map(float, angular)
        self.twist_writer.publish(message)

    def send(self, stamp_ns, position=ORIGIN, linear=ORIGIN):
        """Send a pose and a twist of a tool without rotation."""
        self.send_pose(stamp_ns, position)
        self.send_twist(stamp_ns, linear)

    def predict(self, stamp_ns, *where):
        """Send a pose and wait for one more prediction."""
        count = len(self.poses)
        self.send_pose(stamp_ns, *where)
        self.wait_for_poses(count + 1)

    def wait_for_poses(self, count):
        """Spin until so many predictions have come."""
        assert self.ros.spin_until(lambda: len(self.poses) >= count), (
            f'{len(self.poses)} of {count} predictions')

    def wait_for_inputs(self, poses):
        """Spin until the predictor has received a number of poses, rejected ones included."""
        screen = self.predictor.pipeline.live.screen
        assert self.ros.spin_until(lambda: screen.poses >= poses), f'{screen.poses} of {poses}'


def topics_of(predictor):
    """Return the `Topic` of each output that follows each pose of the tool."""
    from bellows_ros.nodes.outputs import Topic

    return [part for name, part in vars(predictor.pipeline.outputs).items()
            if isinstance(part, Topic) and name not in ('_state', '_ok', 'landing')]


class Listener(Peer):
    """A subscriber that keeps the newest diagnostics."""

    def __init__(self, ros):
        """Subscribe."""
        super().__init__(ros, 'monitor')
        self.reports = self.hears(DiagnosticArray, '/diagnostics')

    def line(self, name):
        """Return the newest line of a name, or nothing."""
        lines = (line for report in reversed(self.reports) for line in report.status)
        return next((line for line in lines if line.name == f'predictor: {name}'), None)

    def sees(self, name, level, words):
        """Wait until a line has a level, and a message that contains some words."""
        def there():
            line = self.line(name)
            return line is not None and line.level == level and words in line.message

        return bool(self.ros.spin_until(there))

    def value(self, name, key):
        """Return a value of a line."""
        return {v.key: v.value for v in self.line(name).values}[key]


@pytest.fixture
def peer(ros):
    """Give another node of the graph."""
    return Peer(ros)


@pytest.fixture
def listener(ros, monkeypatch):
    """Return a subscriber to diagnostics, which nodes then publish five times per second."""
    from bellows_ros.nodes import predictor_node

    monkeypatch.setattr(predictor_node, 'REPORT_PERIOD', 0.2)
    return Listener(ros)


@pytest.fixture
def make_predictor(ros, predictor_kernels, observer_kernels, plan_kernels):
    """Give a function that makes a predictor node with the given parameters, and spins it."""
    from bellows_ros.nodes.predictor_node import PredictorNode

    def make(given=None, **options):
        overrides = overrides_of(PACKAGE if given is None else given)
        node = PredictorNode(context=ros.context, parameter_overrides=overrides, **options)
        ros.executor.add_node(node)
        return node

    return make


@pytest.fixture
def make_partner(ros, make_predictor):
    """Give a function that makes a predictor and a partner connected with it."""
    def make(given=None, with_twists=True):
        return Partner(ros, make_predictor(given), with_twists)

    return make


@pytest.fixture
def node(make_predictor):
    """Give a predictor."""
    return make_predictor()


@pytest.fixture
def partner(make_partner):
    """Give a partner that sends no twists, connected with a predictor."""
    return make_partner(with_twists=False)


@pytest.fixture
def run_predictor(root, user_environment):
    """Give a function that starts a predictor in a process of its own."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    processes = []

    def run(**variables):
        processes.append(subprocess.Popen(
            [sys.executable, '-m', 'bellows_ros.nodes.command', 'predictor', '--ros-args', *GIVEN],
            env={**user_environment, **variables}, cwd=root, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True))
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()
