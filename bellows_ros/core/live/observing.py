"""The sensors of a held package, and the alarms by which it is lost or deviates."""

import math

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.live.held_package import HeldPackage
from bellows_ros.core.model.kernels import Wrench
from bellows_ros.core.observer.alarms import Alarm, LOST

ALARM_DURATION_NS = 5_000_000_000
"""Duration of an alarm without a resolution, ns."""

MAX_AHEAD_NS = 50_000_000
"""Longest lead of a wrench before the newest pose of the tool, ns: some periods of slow poses."""

SEEN_AGAIN = 3
"""Number of used poses that indicate the next package, without vacuum and valve."""


class Observing:
    """
    Corrections of a held package by measured poses and wrenches.

    Parameters
    ----------
    package : HeldPackage
        Package to correct.

    Attributes
    ----------
    alarms : list of Alarm
        Alarms of its observer, and losses indicated by the vacuum.

    """

    def __init__(self, package: HeldPackage) -> None:
        self._package = package
        self.alarms: list[Alarm] = package.observer.alarms
        self._processed = self._used_at_loss = 0

    def new_alarms(self) -> list[Alarm]:
        """Return the alarms since the last call."""
        new, self._processed = self.alarms[self._processed:], len(self.alarms)
        return new

    def lose(self) -> None:
        """Note the loss of the package, after which poses may show the next one."""
        self._used_at_loss = self._package.observer.counts['used']

    def note_loss(self, stamp_ns: int) -> None:
        """Raise the alarm on a loss indicated by the vacuum, unless a sensor has raised it."""
        if not any(alarm.kind == LOST and stamp_ns - alarm.stamp_ns < ALARM_DURATION_NS
                   for alarm in self.alarms):
            self.alarms.append(Alarm(stamp_ns, LOST, shown_by='vacuum'))
            self._processed = len(self.alarms)

    def unresolved(self, is_lost: bool, now_ns: int) -> Alarm | None:
        """
        Return the unresolved alarm: a loss until the next package, others for 5 s.

        An alarm after which cup or payload deviate from their parameters by more than allowed
        lasts until the deviation ends.
        """
        if not self.alarms:
            return None
        newest = self.alarms[-1]
        lasts = is_lost if newest.kind == LOST and newest.cup < 0 else (
            now_ns - newest.stamp_ns < ALARM_DURATION_NS
            or self._package.observer.departs_from_file)
        return newest if lasts else None

    @property
    def shows_next(self) -> bool:
        """Whether measured poses show the next package after a loss."""
        return self._package.observer.counts['used'] >= self._used_at_loss + SEEN_AGAIN

    def on_measured(
        self, stamp_ns: int, in_frame: bool,
        measured: tuple[Vector, Quaternion, Array | None], since_ns: int,
    ) -> bool:
        """
        Correct the package by a measured pose in the frame of the tool's poses, or count it.

        The result is whether the pose is plausible; it came some time (ns) after the newest
        sample.
        """
        observer, (position, quaternion_xyzw, covariance) = self._package.observer, measured
        (x, y, z), (qx, qy, qz, qw) = position, quaternion_xyzw
        measurement = observer.sensor.measurement(
            stamp_ns, (x, y, z), (qx, qy, qz, qw), covariance)
        if isinstance(measurement, str):
            observer.counts[measurement] += 1
        elif not (observer.sensor.has_own_world or in_frame):
            observer.counts['frame_id'] += 1
        else:
            observer.update(measurement, since_ns)
            return True
        return False

    def on_wrench(self, stamp_ns: int, wrench: Wrench, in_world: bool, newest_ns: int) -> str:
        """Correct the package by a wrench; return the reason of a rejection, or ''."""
        if not math.isfinite(sum(map(sum, wrench))):
            return 'nan'
        if (sample := self._package.sample) is None:
            return 'not_held'
        if stamp_ns - newest_ns > MAX_AHEAD_NS:
            return 'future_stamp'
        observer, (force, moment) = self._package.observer, wrench
        if in_world:
            turned = observer.wrenches.in_own_axes
            force, moment = turned(sample.tool, force), turned(sample.tool, moment)
        return observer.on_wrench(stamp_ns, (force, moment))
