"""Set payload and centre of mass of a UR arm from package/estimated, only while at rest."""

from geometry_msgs.msg import InertiaStamped, TwistStamped
import rclpy
from rclpy.node import Node
from ur_msgs.srv import SetPayload  # of the UR driver

PERIOD, AT_REST = 2.0, 0.01
"""Least time between two calls (s), and the largest speed at rest (m/s)."""


class Payload(Node):
    """Call the driver's payload service with what the predictor estimates."""

    def __init__(self) -> None:
        """Subscribe; com is in the frame of the lip, so add the cup's length in the tool frame."""
        super().__init__('ur_payload')
        self.length = self.declare_parameter('cup_length', 0.0481).value
        self.speed, self.called_ns = float('inf'), 0
        self.client = self.create_client(SetPayload, '/io_and_status_controller/set_payload')
        self.create_subscription(TwistStamped, 'package/twist', self.on_twist, 10)
        self.create_subscription(InertiaStamped, 'package/estimated', self.on_estimate, 10)

    def on_twist(self, message: TwistStamped) -> None:
        """Note the speed of the package."""
        v = message.twist.linear
        self.speed = max(abs(v.x), abs(v.y), abs(v.z))

    def on_estimate(self, message: InertiaStamped) -> None:
        """Set the payload at rest. z of E points into the arm, that of the flange away from it."""
        now_ns = self.get_clock().now().nanoseconds
        if self.speed > AT_REST or now_ns - self.called_ns < PERIOD * 1e9:
            return
        self.called_ns, com = now_ns, message.inertia.com
        request = SetPayload.Request(mass=message.inertia.m)
        center = request.center_of_gravity
        center.x, center.y, center.z = com.x, -com.y, self.length - com.z
        self.client.call_async(request)


rclpy.init()
rclpy.spin(Payload())
