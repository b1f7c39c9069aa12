"""The tool from its messages: screened and counted, with a twist at each pose."""

from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.live.tool_screening import (
    REFUSALS,
    Screen,
    ToolArrivals,
    TwistSample,
    why_no_twist,
)
from bellows_ros.core.live.tool_twist import Pairing, ToolMotion


class ToolInput:
    """
    Poses and twists of the tool.

    Parameters
    ----------
    twist_in_world : bool
        Whether twists are in axes of the world, instead of axes of the tool.

    Attributes
    ----------
    screen : Screen
        Judge of the poses.
    pairing : Pairing
        Poses that wait for their twists.
    motion : ToolMotion
        Pose and twist of the tool, and the check of its twists.
    arrivals : ToolArrivals
        Arrivals of accepted poses.
    poses, twists : int
        Counts of messages.

    """

    def __init__(self, twist_in_world: bool) -> None:
        self.screen, self.pairing, self.arrivals = Screen(), Pairing(), ToolArrivals()
        self.motion = ToolMotion(twist_in_world)
        self.poses = self.twists = 0
        self._counts = dict.fromkeys(REFUSALS, 0)
        self._expected = False

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest accepted pose, ns."""
        return self.screen.newest_ns

    @property
    def refused(self) -> dict[str, int]:
        """Counts of rejected messages, by reason."""
        return {**self._counts, 'twist_misses_pose': self.motion.missed,
                'twist_stamp': self.pairing.refused}

    def expect_twists(self, expected: bool) -> None:
        """Set whether poses wait for twists; received twists change this setting."""
        self._expected = self.pairing.expect = expected

    def reset(self) -> None:
        """Accept any next stamp and frame."""
        self.screen.reset()
        self.pairing.expect = self._expected

    def forget(self) -> None:
        """Drop waiting messages and the past motion, but not the frame."""
        for part in (self.pairing, self.motion, self.arrivals):
            part.clear()

    def judge(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        arrival_ns: int | None,
    ) -> str:
        """Count a pose; return the reason why it is rejected or restarts the prediction, or ''."""
        self.poses += 1
        reason = self.screen.judge(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
        if reason in self._counts:
            self._counts[reason] += 1
        return reason

    def add_pose(
        self, stamp_ns: int, position: Vector, quaternion_xyzw: Quaternion, arrival_ns: int | None
    ) -> None:
        """Queue an accepted pose."""
        self.arrivals.add(arrival_ns)
        self.pairing.add_pose(self.motion.pose(stamp_ns, position, quaternion_xyzw))

    def add_twist(self, twist: TwistSample) -> None:
        """Queue a twist, or reject it."""
        self.twists += 1
        if refused := why_no_twist(*twist[1:]):
            self._counts[refused] += 1
        else:
            self.pairing.add_twist(twist)
