"""A predictor and a partner that sends it messages and keeps what it publishes, over DDS."""

from dataclasses import dataclass, field
import importlib.util
from typing import Any

import pytest

if importlib.util.find_spec('rclpy') is None:  # the report's header says so
    collect_ignore = [
        f'test_{name}.py'
        for name in ('bag_player', 'conversions', 'demo_player', 'failures', 'flood', 'gripper',
                     'health',
                     'hostile', 'hot_path', 'identifier_node', 'joint_planning', 'lifecycle',
                     'parameters', 'planning',
                     'predictor_node', 'predictor_recording', 'security', 'spinning', 'tf',
                     'tossing')]

PACKAGE = {
    'package.mass': 2.17,
    'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03],
}
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)
QUEUE = 10_000  # messages; the partner loses nothing while it is busy sending


@dataclass
class Partner:
    """
    Send the tool arm's messages and keep the answers.

    Attributes
    ----------
    node : rclpy.node.Node
    poses, twists, wrenches : list
        Messages received on package/pose, package/twist and cup/wrench.

    """

    ros: Any
    node: Any
    predictor: Any
    poses: list[Any] = field(default_factory=list)
    twists: list[Any] = field(default_factory=list)
    wrenches: list[Any] = field(default_factory=list)

    def connect(self, inputs, outputs, with_twists):
        """Make the topics, and wait until each has found its other end."""
        from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped

        make = self.node.create_subscription
        ends = [
            make(PoseStamped, outputs['pose'], self.poses.append, QUEUE),
            make(TwistStamped, outputs['twist'], self.twists.append, QUEUE),
            make(WrenchStamped, outputs['wrench'], self.wrenches.append, QUEUE),
        ]
        self.pose_writer = self.node.create_publisher(PoseStamped, inputs['pose'], QUEUE)
        writers = [self.pose_writer]
        if with_twists:
            self.twist_writer = self.node.create_publisher(TwistStamped, inputs['twist'], QUEUE)
            writers.append(self.twist_writer)
        # Both ends: a best-effort reader gets nothing from a writer it does not know yet.
        names = {writer.topic_name for writer in writers}
        ends += [end for end in self.predictor.subscriptions if end.topic_name in names]
        out = {end.topic_name for end in ends}
        writers += [writer for writer in self.predictor.publishers if writer.topic_name in out]
        assert len(ends) == 3 + len(names) and len(writers) == len(names) + 3
        assert self.ros.spin_until(
            lambda: all(end.get_publisher_count() for end in ends)
            and all(writer.get_subscription_count() for writer in writers)
        ), 'no discovery on this machine'

    def send_pose(self, stamp_ns, position=ORIGIN, xyzw=UPRIGHT, frame_id='world'):
        """Send a pose of the tool."""
        from geometry_msgs.msg import PoseStamped

        message = PoseStamped()
        message.header.frame_id = frame_id
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        point, q = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = map(float, position)
        q.x, q.y, q.z, q.w = map(float, xyzw)
        self.pose_writer.publish(message)

    def send_twist(self, stamp_ns, linear=ORIGIN, angular=ORIGIN):
        """Send a twist of the tool."""
        from geometry_msgs.msg import TwistStamped

        message = TwistStamped()
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        v, w = message.twist.linear, message.twist.angular
        v.x, v.y, v.z = map(float, linear)
        w.x, w.y, w.z = map(float, angular)
        self.twist_writer.publish(message)

    def wait_for_poses(self, count):
        """Spin until so many predictions have come."""
        assert self.ros.spin_until(lambda: len(self.poses) >= count), (
            f'{len(self.poses)} of {count} predictions')

    def wait_for_inputs(self, poses):
        """Spin until the predictor has taken so many poses, refused ones too."""
        live = self.predictor._live
        assert self.ros.spin_until(lambda: live.poses_in >= poses), f'{live.poses_in} of {poses}'


def topics_of(predictor):
    """Return what knows whether somebody listens, of each topic about the package."""
    from bellows_ros.nodes.outputs import Topic

    outputs = predictor._outputs
    return [part for name, part in vars(outputs).items()
            if isinstance(part, Topic) and name not in ('_state', '_ok')]


INPUTS = {'pose': 'tool_arm/pose', 'twist': 'tool_arm/twist'}
OUTPUTS = {'pose': 'package/pose', 'twist': 'package/twist', 'wrench': 'cup/wrench'}


@pytest.fixture
def make_predictor(ros):
    """Give a function that makes a predictor node with the given parameters, and spins it."""
    from bellows_ros.nodes.predictor_node import PredictorNode
    from rclpy.parameter import Parameter

    def make(given=None, **options):
        values = PACKAGE if given is None else given
        overrides = [Parameter(name, value=value) for name, value in values.items()]
        node = PredictorNode(context=ros.context, parameter_overrides=overrides, **options)
        ros.executor.add_node(node)
        return node

    return make


@pytest.fixture
def make_partner(ros, make_predictor):
    """Give a function that makes a predictor and a partner connected with it."""
    from rclpy.node import Node

    def make(given=None, inputs=INPUTS, outputs=OUTPUTS, with_twists=True, **options):
        predictor = make_predictor(given, **options)
        node = Node('partner', context=ros.context)
        ros.executor.add_node(node)
        partner = Partner(ros, node, predictor)
        partner.connect(inputs, outputs, with_twists)
        return partner

    return make
