"""The predictor node over real DDS: what it publishes, and what bad input does to it."""


from bellows_ros.files.messages import POSE_TYPES
from bellows_ros.nodes import predictor_node
from bellows_ros.nodes.conversions import message_class, quaternion_xyzw, vector
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from nav_msgs.msg import Odometry
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rclpy.qos import ReliabilityPolicy
from std_srvs.srv import Trigger

from .conftest import MS, OUTPUTS, PACKAGE, placed, pose_at, stamp_ns, stamped, UPRIGHT

START = 1_700_000_000_123_456_789  # ns; a stamp that no double can hold
LENGTH, DEPTH, MASS, GRAVITY, AXIAL = 0.0481, 0.03, 2.17, 9.81, 11530.0


def numbers(messages):
    """Return positions and quaternions of poses, (N, 7)."""
    return np.array([
        [*vector(m.pose.position), *quaternion_xyzw(m.pose.orientation)] for m in messages])


def test_standing_tool_carries_the_package_at_rest(make_partner):
    """Publish the static equilibrium with the input's stamp, and the weight as the wrench."""
    partner = make_partner()
    for step in range(3):
        partner.send(START + step * MS)
    partner.wait_for_poses(3)
    partner.wait(lambda: len(partner.wrenches) == len(partner.twists) == 3)

    for messages in (partner.poses, partner.twists, partner.wrenches):
        assert list(map(stamp_ns, messages)) == [START, START + MS, START + 2 * MS]
    stretched = LENGTH + MASS * GRAVITY / AXIAL  # the weight hangs on the axial spring
    expected = [0.0, 0.0, -stretched - DEPTH, *UPRIGHT]
    assert_allclose(numbers(partner.poses), [expected] * 3, atol=1e-12)
    assert {m.header.frame_id for m in partner.poses} == {'world'}
    assert {m.header.frame_id for m in partner.twists} == {'package'}
    assert {m.header.frame_id for m in partner.wrenches} == {'cup_lip'}
    assert_allclose(
        vector(partner.wrenches[-1].wrench.force), [0.0, 0.0, MASS * GRAVITY], atol=1e-9)


@pytest.mark.parametrize('kind', ['pose', 'pose_with_covariance', 'transform', 'odometry'])
def test_the_pose_may_come_in_each_type_that_drivers_send(kind, make_predictor, peer):
    """Predict the same from PoseStamped, with covariance, TransformStamped and Odometry."""
    make_predictor({**PACKAGE, 'tool_pose.type': kind})
    answers = peer.hears(PoseStamped, 'package/pose')
    empty = message_class(POSE_TYPES[kind], kind, '')()
    message = placed(stamped(empty, START, 'base'), (1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))
    writer = peer.writes(type(message), 'tool_arm/pose')
    peer.connect()
    writer.publish(message)
    peer.wait(lambda: len(answers) == 1)
    stretched = LENGTH + MASS * GRAVITY / AXIAL
    assert_allclose(
        numbers(answers), [[1.0, 2.0, 3.0 - stretched - DEPTH, 0.0, 0.0, 0.6, 0.8]], atol=1e-12)


def test_reset_starts_from_rest(partner):
    """Forget the motion, the stamps and the frame."""
    for step in range(60):  # 1 m/s^2 to the side
        partner.send_pose(START + step * MS, (0.5 * (step * 1e-3) ** 2, 0.0, 0.0))
    partner.wait_for_poses(60)
    assert abs(numbers(partner.poses)[-1, 0] - 0.5 * 0.059**2) > 1e-5  # it swings

    answer = partner.call('/predictor/reset', Trigger)
    partner.send_pose(START - 1_000_000_000, frame_id='base')
    partner.wait_for_poses(61)

    assert answer.success and 'static equilibrium' in answer.message
    assert partner.poses[-1].header.frame_id == 'base'
    assert_allclose(numbers(partner.poses)[-1, :2], 0.0, atol=1e-12)


def test_topics_follow_namespace_and_remaps(make_predictor, peer):
    """Stand in a cell's namespace and read the driver's topic."""
    node = make_predictor(cli_args=[
        '--ros-args', '-r', '__ns:=/cell', '-r', 'tool_arm/pose:=/driver/tcp_pose',
        '-r', '__node:=left_cup'])
    heard = list(map(peer.hears, (PoseStamped, TwistStamped, WrenchStamped), (
        f'/cell/{topic}' for topic in OUTPUTS)))
    writer = peer.writes(PoseStamped, '/driver/tcp_pose')
    peer.connect(node)
    writer.publish(pose_at(START))
    peer.wait(lambda: all(heard))

    assert node.get_fully_qualified_name() == '/cell/left_cup'
    assert {name for name, _ in node.get_service_names_and_types()} >= {
        '/cell/left_cup/reset', '/cell/left_cup/set_parameters'}


def test_qos_of_every_topic_can_be_overridden(make_predictor):
    """Declare reliability and depth of all that the node makes; sensor data by default."""
    node = make_predictor({**PACKAGE, 'vacuum.signal': 'pressure'}, cli_args=[
        '--ros-args', '-p', 'qos_overrides./tool_arm/pose.subscription.reliability:=reliable',
        '-p', 'qos_overrides./tool_arm/pose.subscription.depth:=7'])
    qos = {end.topic_name: end.qos_profile for end in node.subscriptions}

    assert qos['/tool_arm/pose'].reliability == ReliabilityPolicy.RELIABLE
    assert qos['/tool_arm/pose'].depth == 7
    assert qos['/tool_arm/twist'].reliability == ReliabilityPolicy.BEST_EFFORT
    published = {p.topic_name: p.qos_profile.reliability for p in node.publishers}
    for topic in OUTPUTS:
        assert published[f'/{topic}'] == ReliabilityPolicy.RELIABLE
    of_ros = {'/parameter_events', '/rosout'}
    ends = [(end, 'subscription') for end in node.subscriptions]
    ends += [(end, 'publisher') for end in node.publishers]
    topics = {(end.topic_name, kind) for end, kind in ends if end.topic_name not in of_ros}
    assert len(topics) >= 11
    for topic, kind in topics:
        for policy in ('reliability', 'depth', *(['durability'] * (kind == 'subscription'))):
            assert node.has_parameter(f'qos_overrides.{topic}.{kind}.{policy}'), topic


@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_cup_too_soft_for_the_package_is_reported_once(make_partner, capfd, monkeypatch):
    """Publish nothing and say why, once in the interval of the log."""
    monkeypatch.setattr(predictor_node, 'LOG_INTERVAL', 1e4)  # also on a busy machine
    heavy = {
        'package.mass': 1e4, 'package.inertia': [1e3, 1e3, 1e3, 0.0, 0.0, 0.0],
        'package.com': [5.0, 0.0, -5.0],
    }
    partner = make_partner(heavy, with_twists=False)
    for step in range(10):
        partner.send_pose(START + step * MS)
        partner.wait_for_inputs(step + 1)
        partner.predictor.diagnostics.report()

    assert partner.poses == []
    assert capfd.readouterr().err.count('the cup cannot hold the package') == 1


@pytest.mark.parametrize('is_filled', [True, False])
def test_twists_of_odometry_are_used_in_the_child_frame(make_predictor, peer, is_filled):
    """Take them in the tool's axes, though tool_twist.frame is the world; not if all are zero."""
    node = make_predictor({**PACKAGE, 'tool_pose.type': 'odometry'})
    live, writer = node.pipeline.live, peer.writes(Odometry, 'tool_arm/pose')
    peer.connect(node)
    quarter = (0.0, 0.0, 0.5 ** 0.5, 0.5 ** 0.5)  # about z: x of the tool is y of the world
    for step in range(1, 450):
        message = placed(
            stamped(Odometry(child_frame_id='tool'), START + step * MS),
            (0.0, 0.2 * step * 1e-3, 0.0), quarter)
        message.twist.twist.linear.x = 0.2 * is_filled
        writer.publish(message)
        peer.wait(lambda: live.predictions == step)  # noqa: B023
    assert_allclose(live.latest.tool[2], (0.2, 0.0, 0.0), atol=1e-9)
    assert live.motion.estimated == (0 if is_filled else 449)
    assert live.motion.verdict == ('fits' if is_filled else 'unknown')
    assert node.count_subscribers('/tool_arm/twist') == 0
