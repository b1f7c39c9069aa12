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

ARM = 0.05
"""Lever by which moments are compared with forces in the check of the set-up, m."""

MISFIT = 0.3
"""RMS deviation of the readings above which they contradict a set-up, weights."""

FIT = 0.12
"""RMS deviation of the readings below which they fit a set-up, weights."""

CLEAR = 2.5
"""Smallest ratio of deviations that distinguishes two set-ups."""

TILT_COSINE = math.cos(math.radians(5.0))
"""Largest cosine between two tilts."""

MIN_STILL = 4
"""Smallest number of blocks at rest by which a set-up is judged."""

MAX_STILL = 64
"""Largest number of blocks at rest that are kept."""


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
    Check sign, axes, reference point and zero of a sensor by the weight of a held package.

    Attributes
    ----------
    fault : str
        'sign', 'world_axes', 'tcp', 'zeroed_holding', 'compensated' or 'unknown'; '' without.

    """

    def __init__(self, sensor: WrenchSensor) -> None:
        self._sensor = sensor
        self._still: list[tuple[Array, Array, Array]] = []
        self.fault, self.is_contradicted = '', False

    def add(self, shown: Array, load: Array, R_world_sensor: Array, weight: float) -> None:
        """Check the mean reading (6,) of a block at rest, with its predicted load (6,)."""
        if len(self._still) < MAX_STILL and not self.fault:
            self._still.append((shown, load, R_world_sensor))
            misfits = self._misfits(weight)
            self.is_contradicted = misfits.pop('fits') > MISFIT
            if self.is_contradicted and len(self._still) >= MIN_STILL and self._has_tilts():
                first, second = sorted(misfits, key=misfits.__getitem__)[:2]
                is_clear = misfits[first] < FIT and misfits[second] > CLEAR * misfits[first]
                self.fault = first if is_clear else 'unknown'

    def _has_tilts(self) -> bool:
        down = np.array([R[2] for _, _, R in self._still])
        return bool((down @ down[0]).min() < TILT_COSINE)

    def _misfits(self, weight: float) -> dict[str, float]:
        """Return the RMS deviation of the readings of each set-up, in weights."""
        shown, load, R = (np.array(each) for each in zip(*self._still, strict=True))
        position, axes, _ = self._sensor.mount
        arm = np.reshape(axes, (3, 3)).T @ position
        of_tip = load + np.pad(np.cross(arm, load[:, :3]), ((0, 0), (3, 0)))
        in_world = np.hstack([
            np.einsum('nij,nj->ni', R, part) for part in np.split(load, 2, axis=1)])
        scale = weight * np.repeat([1.0, ARM], 3)
        return {name: float(np.sqrt(np.mean(((shown - other) / scale) ** 2) * 2.0))
                for name, other in (
                    ('fits', load), ('sign', -load), ('world_axes', in_world), ('tcp', of_tip),
                    ('zeroed_holding', load - load[0]), ('compensated', 0.0 * load))}
