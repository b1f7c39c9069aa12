"""Set the total payload of a UR arm at its flange from package/estimated, only while at rest."""

from geometry_msgs.msg import InertiaStamped, TwistStamped
import rclpy
from rclpy.node import Node
from ur_msgs.srv import SetPayload  # of the UR driver

PERIOD = 2.0
"""Least time between two calls, s."""

SPEED_AT_REST = 0.01
"""Largest speed of a package at rest, m/s."""

RATE_AT_REST = 0.05
"""Largest angular speed of a package at rest, rad/s."""

SURE = 0.02, 0.005
"""Largest standard deviations of a payload to set: relative mass, and centre of mass (m)."""


class TotalPayload(Node):
    """
    Call the driver's payload service with gripper and package together.

    A UR takes the total payload at the flange. z of the flange points away from the arm, z of E
    into it; E is on the axis of the flange.
    """

    def __init__(self) -> None:
        """Subscribe."""
        super().__init__('ur_payload')
        parameter = self.declare_parameter
        self.gripper_mass = parameter('gripper_mass', 0.0).value  # kg, with adapter and cup
        self.gripper_com = parameter('gripper_com', [0.0, 0.0, 0.0]).value  # m, in the flange
        self.lip = parameter('lip_distance', 0.0481).value  # m, from the flange to the lip
        self.is_at_rest, self.called_ns = False, 0
        self.mass_std = self.com_std = float('inf')
        self.client = self.create_client(SetPayload, '/io_and_status_controller/set_payload')
        self.create_subscription(TwistStamped, 'package/twist', self.on_twist, 10)
        self.create_subscription(InertiaStamped, 'package/estimated_std', self.on_std, 10)
        self.create_subscription(InertiaStamped, 'package/estimated', self.on_estimate, 10)

    def on_twist(self, message: TwistStamped) -> None:
        """Note whether the package is at rest."""
        v, w = message.twist.linear, message.twist.angular
        self.is_at_rest = (max(abs(v.x), abs(v.y), abs(v.z)) < SPEED_AT_REST
                           and max(abs(w.x), abs(w.y), abs(w.z)) < RATE_AT_REST)

    def on_std(self, message: InertiaStamped) -> None:
        """Note the standard deviations of the estimate that follows."""
        com = message.inertia.com
        self.mass_std, self.com_std = message.inertia.m, max(com.x, com.y, com.z)

    def on_estimate(self, message: InertiaStamped) -> None:
        """Set the payload of a sure estimate at rest."""
        now_ns, package = self.get_clock().now().nanoseconds, message.inertia
        is_sure = self.mass_std < SURE[0] * package.m and self.com_std < SURE[1]
        if not (self.is_at_rest and is_sure) or now_ns - self.called_ns < PERIOD * 1e9:
            return
        self.called_ns = now_ns
        request = SetPayload.Request(mass=self.gripper_mass + package.m)
        com = package.com.x, -package.com.y, self.lip - package.com.z  # turned about x
        center = request.center_of_gravity
        center.x, center.y, center.z = (
            (self.gripper_mass * of_gripper + package.m * of_package) / request.mass
            for of_gripper, of_package in zip(self.gripper_com, com, strict=True))
        self.client.call_async(request)


rclpy.init()
rclpy.spin(TotalPayload())
