"""
A bare node that sends every tool pose back: the floor for the latency of the predictor.

`python -m benchmarks.echo` spins it as the commands of this package spin theirs; `--raw` sends the
bytes of messages back, without message objects.
"""

import sys

from bellows_ros.nodes.command import run
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future

QUEUE = 100


class Echo(Node):
    """Send `tool_arm/pose` on as `package/pose`; never finished."""

    def __init__(self) -> None:
        """Make the topics."""
        super().__init__('echo')
        self.finished = Future()
        publisher = self.create_publisher(PoseStamped, 'package/pose', QUEUE)
        qos = QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(
            PoseStamped, 'tool_arm/pose', publisher.publish, qos, raw='--raw' in sys.argv)

    def close(self) -> None:
        """Take the node down."""
        self.destroy_node()


if __name__ == '__main__':
    sys.exit(run('echo', (), 'benchmarks.echo:Echo'))
