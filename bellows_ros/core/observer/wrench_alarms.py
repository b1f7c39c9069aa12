"""
Loss, slip and a wrong set-up, from the wrenches of a force-torque sensor.

The force of a lost package disappears from the sensor; a slipped package shifts the line of its
weight. The states of the cycle exclude supports, which also carry the weight.
"""

from __future__ import annotations

from collections import deque
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.sensors.set_up import COS_MIN_TILT, fault_of, Still
from bellows_ros.core.sensors.wrench import WrenchSensor
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

LOST_SHARE = 0.35
"""Largest measured fraction of the predicted force after the loss of a package."""

LOSS_NS = 10_000_000
"""Time for which the measured fraction must be smaller before a loss is reported, ns."""

LEAST_LOAD = 0.5
"""Smallest predicted force before a loss, and largest force after the loss, in weights."""

SLIP_NS = 16_000_000
"""Time of the mean after a slip, ns."""

EARLIER_NS = 250_000_000
"""Time of the mean before a slip, ns."""

LEAST_SLIP = 2.5e-3
"""Smallest slip, m."""

SLIP_SIGNIFICANCE = 6.0
"""Smallest slip in standard deviations: 1 in 7e7 normal draws of two axes."""

UNMODELLED = 0.25
"""Standard deviation of the line's shift, relative to the predicted change by motion."""

SCATTER_TIME = 3.0
"""Time over which the scatter of shifts is learned, s."""

SETTLED_NS = 750_000_000
"""Time after a lift in which centre of mass and zero are estimated, ns."""

LEARNT_NS = 500_000_000
"""Time after `SETTLED_NS` in which the scatter is learned before a first alarm, ns."""

KEPT_BLOCKS = 8
"""Number of blocks at rest that are kept of each tilt."""


class LoadChange(NamedTuple):
    """A lost ('lost') or shifted ('slip') package; size and standard deviation of a slip, m."""

    cause: str
    size: float = 1.0
    std: float = 0.0


class Watch:
    """
    Detect loss and slip in successive loads of a package on a sensor.

    Parameters
    ----------
    weight : float
        Weight of the package, N.
    lip : ndarray (3,)
        Position of the cup's lip in the sensor, m.

    """

    def __init__(self, weight: float, lip: Array) -> None:
        self._weight, self._lip = weight, lip
        self.clear()

    def clear(self) -> None:
        """Begin with another package."""
        self._past = deque[tuple[int, Array]]()
        self._variance, self._share_ns, self._last_ns, self._first_ns = 0.0, 0, 0, 0

    def add(self, stamp_ns: int, shown: Array, predicted: Array) -> LoadChange | None:
        """Return a finding after another load of the package (6,), shown and predicted."""
        force, f = shown[:3], predicted[:3]
        square = max(float(f @ f), 1e-9)
        usual = (LEAST_LOAD * self._weight) ** 2
        is_off = square > usual > force @ force and force @ f < LOST_SHARE * square
        self._share_ns = (self._share_ns or stamp_ns) if is_off else 0
        if self._share_ns and stamp_ns - self._share_ns >= LOSS_NS:
            return LoadChange('lost')
        if is_off:
            return None
        expected = self._line(predicted)
        return self._slip(stamp_ns, np.r_[self._line(shown) - expected, expected])

    def _line(self, load: Array) -> Array:
        """Return the shift (3,) of a load's line of action from the lip, m; reduced if light."""
        force = load[:3]
        return np.asarray(np.cross(force, load[3:] - np.cross(self._lip, force)) / max(
            float(force @ force), self._weight**2))

    def _slip(self, stamp_ns: int, shifts: Array) -> LoadChange | None:
        """Return a slip by the shift of the line of the weight: deviation, and prediction (6,)."""
        past, seconds = self._past, (stamp_ns - self._last_ns) / NS_PER_S
        self._last_ns = stamp_ns
        past.append((stamp_ns, shifts))
        while past[0][0] < stamp_ns - EARLIER_NS - SLIP_NS:
            past.popleft()
        self._first_ns = self._first_ns or stamp_ns
        age_ns = stamp_ns - self._first_ns - SETTLED_NS
        if stamp_ns - past[0][0] < 0.9 * EARLIER_NS or age_ns <= 0:
            return None
        rows: Array = np.array([each for _, each in past])
        count = sum(each > stamp_ns - SLIP_NS for each, _ in past)
        change = rows[-count:].mean(axis=0) - rows[:-count].mean(axis=0)
        by_motion = UNMODELLED * float(np.linalg.norm(change[3:]))
        square, std = float(change[:3] @ change[:3]), math.hypot(
            math.sqrt(self._variance), by_motion)
        if age_ns > LEARNT_NS and square > max(LEAST_SLIP, SLIP_SIGNIFICANCE * std) ** 2:
            past.clear()
            return LoadChange('slip', math.sqrt(square), std)
        part = seconds / min(SCATTER_TIME, max(age_ns / NS_PER_S, seconds))
        self._variance += part * (max(square - by_motion**2, 0.0) / 2.0 - self._variance)
        return None


class SetUp:
    """
    Check the set-up of a sensor by the weight of a held package, see `sensors.set_up`.

    Attributes
    ----------
    is_contradicted, fault : bool, str
        See `fault_of`.

    """

    def __init__(self, sensor: WrenchSensor) -> None:
        self._sensor = sensor
        self._still: list[Still] = []
        self.is_contradicted, self.fault = False, ''

    def add(self, now: Still, weight: float) -> None:
        """Check the mean reading of another block at rest; the oldest of its tilt is dropped."""
        alike = [k for k, each in enumerate(self._still)
                 if each.R_world_sensor[2] @ now.R_world_sensor[2] > COS_MIN_TILT]
        if len(alike) >= KEPT_BLOCKS:
            del self._still[alike[0]]
        self._still.append(now)
        self.is_contradicted, self.fault = fault_of(
            Still(*map(np.array, zip(*self._still, strict=True))), self._sensor, weight)
