"""A package that is lost, by poses out of reach, a silent camera, or the vacuum of the cup."""

from __future__ import annotations

from bellows_ros.core.observer.alarms import Alarm, Alarms
from bellows_ros.core.observer.filter import Estimate

LOST_AFTER_NS = 25_000_000
"""A package out of reach for so long (ns) is lost: trackers confuse bodies for some frames."""

SILENT_PERIODS, SILENT_NS = 2.5, 50_000_000
"""After a pose out of reach the camera is silent if this many of its periods pass, and this time
(ns)."""


class LossDetector:
    """
    Joins what the camera shows with the vacuum.

    Attributes
    ----------
    alarms : Alarms or None
        None where none are wanted.
    reach : float
        How far (m) a lip can be.

    """

    def __init__(self) -> None:
        """Start without a reading of the vacuum."""
        self.alarms: Alarms | None = None
        self.reach = 0.0
        self._vacuum: tuple[int, bool] | None = None  # when, on the tool's clock, and if it holds

    def out_of_reach(self, estimate: Estimate, stamp_ns: int) -> tuple[Estimate, Alarm | None]:
        """Note a pose out of reach; a package that was within reach is lost after some time."""
        evidence, away_ns = estimate.evidence, estimate.away_ns
        if self.alarms is None or away_ns < 0:
            return estimate, None
        if away_ns == 0:
            was_near = not evidence.from_start or evidence.onsets[0, 0] > 0
            return estimate._replace(away_ns=stamp_ns * was_near), None
        if stamp_ns - away_ns < LOST_AFTER_NS:
            return estimate, None
        alarm = self.alarms.lost(stamp_ns, self._is_held_since(away_ns), reach=self.reach)
        return estimate._replace(away_ns=-1), alarm

    def unseen(
        self, estimate: Estimate, before_ns: int, last_ns: int, delay_ns: int, stamp_ns: int
    ) -> tuple[Estimate, Alarm | None]:
        """
        Note that the camera sees nothing, after the package has left its reach.

        By the stamps of its last two poses, their delay, and that of the tool (ns).
        """
        silence_ns = max(SILENT_PERIODS * (last_ns - before_ns), SILENT_NS)
        if self.alarms is None or stamp_ns - last_ns <= silence_ns + delay_ns:
            return estimate, None
        is_held = self._is_held_since(last_ns)  # then it was one wrong pose, and none since
        return (estimate._replace(away_ns=-1),
                None if is_held else self.alarms.lost(stamp_ns, is_held))

    def on_vacuum(
        self, estimate: Estimate | None, stamp_ns: int, is_held: bool, breaks: bool, moves: bool,
        cup: int,
    ) -> Alarm | None:
        """
        Note a reading of the vacuum of one cup of a gripper, or of all with a cup below zero.

        Where it breaks down the package is lost, unless the tool is at rest, as for a release, and
        no pose is out of reach. That of one cup means that this cup is lost.
        """
        if cup < 0:
            self._vacuum = stamp_ns, is_held
        if self.alarms is None or estimate is None or not breaks:
            return None
        if cup >= 0:
            return self.alarms.without_vacuum(stamp_ns, cup) if moves else None
        is_seen = estimate.away_ns != 0
        return self.alarms.lost(stamp_ns, False, is_seen) if moves or is_seen else None

    def _is_held_since(self, stamp_ns: int) -> bool | None:
        """Return whether the vacuum holds at a stamp or later; None if not measured since."""
        return self._vacuum[1] if self._vacuum and self._vacuum[0] >= stamp_ns else None
