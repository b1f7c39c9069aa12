"""A bare node that sends every tool pose back: the floor for the latency of the predictor."""

from geometry_msgs.msg import PoseStamped
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

QUEUE = 100


def main() -> None:
    """Send `tool_arm/pose` on as `package/pose` until the process is asked to end."""
    rclpy.init()
    node = Node('echo')
    publisher = node.create_publisher(PoseStamped, 'package/pose', QUEUE)
    qos = QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(PoseStamped, 'tool_arm/pose', publisher.publish, qos)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == '__main__':
    main()
