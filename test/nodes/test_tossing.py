"""The toss over DDS: where it would land, when to release, and the flight after the valve."""

from collections.abc import Callable
import time
from typing import Any

import numpy as np

from .conftest import PACKAGE, Partner

TOSSED = {
    **PACKAGE, 'package.size': [0.3, 0.3, 0.02], 'landing.height': -0.5, 'release.delay': 0.02,
    'release.delay_std': 0.002, 'landing.aim': True, 'landing.target': [0.05, 0.0],
}
PERIOD_NS = 4_000_000
SPEED = 0.4  # m/s


def test_lands_where_it_said_it_would(make_partner: Callable[..., Partner]) -> None:
    """Say landing and time of release; then fly on after the valve, land, and take up the next."""
    from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
    from std_msgs.msg import Bool, Header, String

    partner = make_partner(TOSSED)
    heard: dict[str, list[Any]] = {'landing': [], 'at': [], 'state': [], 'lip': []}
    ends = [
        partner.node.create_subscription(kind, name, heard[key].append, 10)
        for kind, name, key in (
            (PoseWithCovarianceStamped, 'package/landing', 'landing'),
            (Header, 'release/at', 'at'), (String, 'package/state', 'state'),
            (PoseStamped, 'cup/deflection', 'lip'))]
    valve = partner.node.create_publisher(Bool, 'vacuum/valve', 10)
    assert partner.ros.spin_until(lambda: (
        valve.get_subscription_count() and all(e.get_publisher_count() for e in ends)
        and partner.predictor._tossing._landing.wanted and partner.predictor._tossing._at.wanted
        and partner.predictor._outputs._deflection.wanted))
    start_ns, sent = time.time_ns(), 0

    def go_on() -> None:
        nonlocal sent
        now_ns = start_ns + sent * PERIOD_NS
        if time.time_ns() >= now_ns:
            partner.send_pose(now_ns, (SPEED * (now_ns - start_ns) * 1e-9, 0.0, 0.0))
            partner.send_twist(now_ns, (SPEED, 0.0, 0.0))
            sent += 1

    def until(condition: Callable[[], Any]) -> bool:
        def check() -> Any:
            go_on()
            return condition()

        return bool(partner.ros.spin_until(check))

    def state() -> str:
        return str(heard['state'][-1].data) if heard['state'] else ''

    assert until(lambda: len(heard['landing']) > 3 and heard['at'])
    said = heard['landing'][-1]
    covariance = np.array(said.pose.covariance).reshape(6, 6)
    assert np.isfinite(covariance).all() and covariance[0, 0] > (0.002 * SPEED * 0.9) ** 2
    assert said.pose.pose.position.z > -0.5
    valve.publish(Bool(data=False))
    assert until(lambda: state() == 'flying')
    assert until(lambda: state() == 'landed')
    assert partner.predictor._held() is None  # nor does the cup any longer
    assert heard['lip'] and max(abs(lip.pose.position.z) for lip in heard['lip']) < 0.02
    assert 'released' in [message.data for message in heard['state']]
    heights = [message.pose.position.z for message in partner.poses]
    # A corner, 0.21 m from the middle of the tilted plate, comes down first.
    assert heights[0] > -0.12 and -0.5 < min(heights) < -0.29
    count = len(partner.poses)
    go_on()
    valve.publish(Bool(data=True))
    assert until(lambda: state() == 'predicting')
    assert until(lambda: len(partner.poses) > count + 3)
    assert partner.poses[-1].pose.position.z > -0.12


def test_without_a_size_the_valve_is_warned_of(make_partner: Callable[..., Partner]) -> None:
    """Keep the package held."""
    from std_msgs.msg import Bool

    partner = make_partner()
    valve = partner.node.create_publisher(Bool, 'vacuum/valve', 10)
    assert partner.ros.spin_until(valve.get_subscription_count)
    partner.send_pose(1_000_000_000)
    partner.send_twist(1_000_000_000)
    partner.wait_for_poses(1)
    valve.publish(Bool(data=False))
    partner.send_pose(1_004_000_000)
    partner.send_twist(1_004_000_000)
    partner.wait_for_poses(2)
    assert partner.predictor._live.flight.state == ''
