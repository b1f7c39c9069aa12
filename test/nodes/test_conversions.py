"""Messages and tuples, there and back."""

from bellows_ros.core.live import Prediction
from bellows_ros.nodes import conversions
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from hypothesis import given
from hypothesis import strategies as st

PREDICTION = Prediction(
    1_700_000_000_987_654_321, (0.1, 0.2, 0.3), (0.5, -0.5, 0.5, -0.5), (1.0, 2.0, 3.0),
    (4.0, 5.0, 6.0), (7.0, 8.0, 9.0), (10.0, 11.0, 12.0),
)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1))
def test_stamp_survives_the_round_trip(sec, nanosec):
    """Keep every nanosecond, as no double does."""
    back = Time()
    conversions.write_stamp(back, conversions.stamp_to_ns(Time(sec=sec, nanosec=nanosec)))
    assert back == Time(sec=sec, nanosec=nanosec)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(10**9, 2**32 - 1))
def test_stamp_that_is_none(sec, nanosec):
    """Give no stamp for a second or more of nanoseconds."""
    assert conversions.stamp_to_ns(Time(sec=sec, nanosec=nanosec)) == conversions.NO_STAMP


def test_prediction_becomes_three_messages():
    """Put each part where it belongs."""
    pose, twist, wrench = PoseStamped(), TwistStamped(), WrenchStamped()
    conversions.write_pose(pose, PREDICTION.stamp_ns, 'base', *PREDICTION[1:3])
    conversions.write_twist(twist, 'package', PREDICTION)
    conversions.write_wrench(wrench, 'cup_lip', PREDICTION)

    for message, frame in ((pose, 'base'), (twist, 'package'), (wrench, 'cup_lip')):
        assert message.header.frame_id == frame
        assert conversions.stamp_to_ns(message.header.stamp) == PREDICTION.stamp_ns
    assert PREDICTION[1:7] == (
        conversions.vector(pose.pose.position), conversions.quaternion_xyzw(pose.pose.orientation),
        *map(conversions.vector, (twist.twist.linear, twist.twist.angular, wrench.wrench.force,
                                  wrench.wrench.torque)))
