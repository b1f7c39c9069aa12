"""Subscriptions to sensors: best effort unless overridden, watched for rate, age and QoS."""

from collections.abc import Callable, Mapping
import time
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    qos_check_compatible,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions

from ..core.live.health import InputSeen, OTHER_TYPE
from ..core.live.timing import Arrivals

QUEUE = 500
"""Messages kept on each topic: at 1 kHz the longest gap that the motion is followed across."""

OVERRIDABLE = (
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)  # fmt: skip
"""Durability for the last word of a vacuum switch that speaks only when it changes."""

POLICY_WORDS = {
    'reliability': ('reliab', 'best effort'),
    'durability': ('durab', 'volatile', 'transient'),
    'deadline': ('deadline',),
    'liveliness': ('liveliness', 'lease'),
}


class SensorInput:
    """
    One subscription and what is known about its messages.

    Parameters
    ----------
    node : rclpy.node.Node
    kind : type
        Of the messages.
    topic : str
        Relative name.
    callback : callable
        Takes each message.
    on_publishers : callable, optional
        Takes the number of matching publishers when it changes.

    """

    def __init__(
        self, node: Node, kind: type, topic: str, callback: Callable[[Any], None],
        on_publishers: Callable[[int], None] | None = None,
    ) -> None:  # fmt: skip
        """Listen as to any sensor, without asking for lost messages; QoS can be overridden."""
        self._node, self._type = node, f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
        self.arrivals = Arrivals()
        self._refused: Mapping[str, int] = {}
        events = None
        if on_publishers:
            events = SubscriptionEventCallbacks(
                matched=lambda matched: on_publishers(matched.current_count))
        self._subscription = node.create_subscription(
            kind, topic, callback,
            QoSProfile(depth=QUEUE, reliability=ReliabilityPolicy.BEST_EFFORT),
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions(OVERRIDABLE),
        )  # fmt: skip

    @property
    def topic(self) -> str:
        """Full name of the topic."""
        return str(self._subscription.topic_name)

    def note(self, arrival_ns: int, stamp_ns: int) -> None:
        """
        Note a message and its age.

        The node's clock takes 2.5 us to ask, the system's 0.04: it is the same one unless time is
        simulated, which is looked up once a report.
        """
        if self.arrivals.is_empty:
            self._clock = self._node.get_clock()
            self._is_simulated = self._clock.ros_time_is_active
        now_ns = self._clock.now().nanoseconds if self._is_simulated else time.time_ns()
        self.arrivals.add(arrival_ns, (now_ns - stamp_ns) * 1e-9)

    def seen(self, refused: Mapping[str, int]) -> InputSeen:
        """Return what came since the last call, with the counts of what was refused so far."""
        before, self._refused = self._refused, dict(refused)
        last_ns = self.arrivals.last_ns
        silent = (time.monotonic_ns() - last_ns) * 1e-9 if last_ns >= 0 else float('inf')
        publishers = self._node.count_publishers(self.topic)
        return InputSeen(
            self.topic, publishers, self._mismatch(publishers), self.arrivals.take(), silent,
            {reason: count - before.get(reason, 0) for reason, count in refused.items()}, refused,
        )  # fmt: skip

    def _mismatch(self, publishers: int) -> str:
        """Return the QoS policy, or else type, for which a publisher cannot be heard, if any."""
        if self._subscription.get_publisher_count() >= publishers:
            return ''
        for other in self._node.get_publishers_info_by_topic(self.topic):
            if other.topic_type != self._type:
                return f'{OTHER_TYPE}{other.topic_type}'
            fits, why = qos_check_compatible(other.qos_profile, self._subscription.qos_profile)
            if fits == QoSCompatibility.ERROR:
                return _policy_in(str(why).lower())
        return ''


def _policy_in(why: str) -> str:
    """Return the name of the policy that an explanation speaks of."""
    for policy, words in POLICY_WORDS.items():
        if any(word in why for word in words):
            return policy
    return 'policy'
