"""
Three alarms: a package is lost, its poses deviate, or it differs from its parameters.

`deviates`: moving means of whitened innovations m += (z - m) / n with several n; without faults m
has the variance (1 - (1 - 1/n)^(2k)) / (2n - 1) after k poses, and its normalised square is chi^2
of 6. `differs`: a parameter has changed by five standard deviations sqrt(P0 - P) of its change,
which is the difference of its value by the poses alone (`shown_alone`) from the stated value, in
standard deviations of this difference. Poses show K/m and P/m, as a common scale of K, P and mass
does not change the motion: the test of the mass is the test of the ratio `RATIO`.
`lost` by poses: a free fall from a recent onset explains the innovations z = W y instead of the
held package. A fall moves the pose by c from the held one, which gives the log-likelihood ratio
z^T W c - |W c|^2 / 2 of each pose.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import entry
from bellows_ros.core.geometry.tuples import Vector, ZERO
from bellows_ros.core.model.equilibrium import pose_error
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.observer.measurement import Corrected, LEAST_KNOWN, SHARES
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

LOST, DEVIATES, DIFFERS = KINDS = 'lost', 'deviates', 'differs'
"""Kinds of alarms."""

RATIO = 'cup.stiffness / package.mass'
"""Name of the ratio K/m, whose value is relative to the stated one."""

VIEW_NS = 3_000_000_000
"""Shortest duration of a deviation of a tag, ns: its errors last as long as a view and its blur,
and work changes both within this time."""

KNOWN_COUNT = 33
"""Number of measurements from which the noise is known to 12 %, a second of a usual camera."""

CONFUSED_NS = 25_000_000
"""Time out of reach or outside the gate from which poses of a body count, ns: trackers confuse
bodies for some frames."""

SIGNIFICANCE = 5.0
"""Smallest change of a parameter that differs, standard deviations: 1 in 1.7 million."""

DIFFERING = 3
"""Number of successive poses in which it differs; a change within one pose is an outlier's."""

MAX_FALL_NS = 300_000_000
"""Longest tested fall, ns: 0.44 m, below which a camera sees the package out of reach."""

LEAST_FALL = 9.0
"""Smallest squared displacement by a fall at a pose that counts, squared standard deviations."""

UNEXPLAINED, MAX_UNEXPLAINED = 27.86, 0.2
"""Largest part of a squared innovation not explained by a fall, the gate, and its growth with the
innovation; a push or another object is no fall."""


class Alarm(NamedTuple):
    """A lost package ('lost'), deviating poses ('deviates') or a wrong parameter ('differs')."""

    stamp_ns: int
    kind: str
    since_ns: int = 0
    """Likely begin, ns; 0 for unknown."""
    shift: Vector = ZERO
    """Shift of measured poses from predicted poses, m, world."""
    rotation: Vector = ZERO
    """Rotation, rad, world."""
    parameter: str = ''
    """Name of the parameter that differs, or `RATIO`."""
    value: tuple[float, ...] = ()
    """Its value by the measurements alone."""
    std: tuple[float, ...] = ()
    """Standard deviations of this value."""
    cup: int = -1
    """Index in cup.layout of a lost cup; -1 for the package."""
    place: tuple[float, float] = (0.0, 0.0)
    """Position of a lost cup in the tool, m."""
    shown_by: str = 'poses'
    """Origin of the alarm: 'poses', 'vacuum' or 'wrench'."""

    @property
    def finding(self) -> Finding:
        """The finding, for a sentence."""
        code = self.kind if self.cup < 0 else 'lost_cup'
        if self.parameter == RATIO:
            share = self.value[0] - 1.0
            code = 'softer' if share < 0.0 else 'stiffer'
            return Finding(f'alarm_{code}', Level.ERROR, {
                'share': abs(share), 'std': self.std[0]}, self.parameter)
        seconds = (self.stamp_ns - self.since_ns) / NS_PER_S if self.since_ns else math.nan
        (x, y), along = self.place, t3.scale(1.0 / max(t3.norm(self.shift), 1e-9), self.shift)
        return Finding(f'alarm_{code}', Level.ERROR, {
            'shift': t3.norm(self.shift), 'rotation': t3.norm(self.rotation), 'along': along,
            'seconds': seconds, 'value': self.value, 'std': self.std, 'cup': self.cup, 'x': x,
            'y': y, 'origin': self.shown_by}, self.parameter)


def is_deviation(square: float, false_per_hour: float, period: float) -> bool:
    """
    Return whether usual poses exceed the normalised square of a mean less often than allowed.

    A mean of n poses is independent of the one n poses before. The probability that chi^2 of 6
    exceeds x is exp(-x/2) (1 + x/2 + x^2/8).
    """
    chance = math.exp(-0.5 * square) * (1.0 + 0.5 * square + 0.125 * square * square)
    return bool(chance * SHARES.sum() * 3600.0 < false_per_hour * period)


def smallest_slip(seen: Corrected, false_per_hour: float, period: float) -> float:
    """
    Return the smallest shift (m) in any direction that the shortest moving mean shows by itself.

    The period (s) is that of the poses. The threshold is that of `is_deviation`.
    """
    chance, square = false_per_hour * period / (3600.0 * SHARES.sum()), 40.0
    for _ in range(20):
        square = 2.0 * math.log((1.0 + 0.5 * square + 0.125 * square * square) / chance)
    variance = SHARES[0] / (2.0 - SHARES[0])  # of the mean, 1 / (2 n - 1)
    W = np.linalg.inv(seen.whitener)
    largest = float(np.linalg.norm(W[:3], 2))  # standard deviation of an innovation
    return math.sqrt(square * variance) * largest


def shown_alone(change: Array, prior: Array, variance: Array) -> tuple[Array, Array]:
    """
    Return changes by the measurements alone, without the prior, and their standard deviations.

    The arguments (k,) are estimated changes, and their variances before and after. With the
    variance R of the measurements, P = P0 R / (P0 + R), and the estimate is P / R of the change.
    """
    gained = np.maximum(prior - variance, LEAST_KNOWN * prior)
    weight = prior / np.maximum(gained, 1e-99)
    return weight * change, np.sqrt(weight * variance)


def deviation(seen: Corrected, z: Array, since_ns: int) -> Alarm:
    """Return the alarm on poses that deviate by a whitened innovation (6,) since a stamp (ns)."""
    shift, rotation = (t3.apply(t3.rotation_matrix(seen.exposed[1]), (a, b, c))
                       for a, b, c in np.linalg.solve(seen.whitener, z).reshape(2, 3).tolist())
    return Alarm(seen.stamp_ns, DEVIATES, since_ns, shift, rotation)


@entry
def fall_ratio(
    onsets_ns: Stamps, onsets: Array, stamps_ns: Stamps, poses: Array, z: Array, W: Array,
    gravity: Vector,
) -> float:
    """
    Return the largest log-likelihood ratio of a free fall.

    Parameters
    ----------
    onsets_ns, onsets : ndarray (k,), (k, 25)
        Stamps (ns) and states of the held package, at which it may begin to fall.
    stamps_ns, poses, z, W : ndarray (m,), (m, 7), (m, 6), (m, 6, 6)
        Measured poses: stamps (ns), predicted poses, whitened innovations and whiteners.
    gravity : tuple
        World, m/s^2.

    """
    best = 0.0
    for k in range(len(onsets)):
        state = row_state(onsets[k])
        o, q, v, w = state[0], state[1], state[2], state[3]
        v, ratio, fallen, is_one = t3.apply(t3.rotation_matrix(q), v), 0.0, 0, True
        for i in range(len(poses)):
            t = (stamps_ns[i] - onsets_ns[k]) / NS_PER_S
            if t <= 0.0:
                continue
            pose, left, usual = poses[i], 0.0, UNEXPLAINED
            held = ((pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]), ZERO, ZERO)
            a, b = pose_error(
                held, t3.add_scaled(t3.add_scaled(o, t, v), 0.5 * t * t, gravity),
                t3.quaternion_product(q, t3.exp_quaternion(t3.scale(t, w))))
            square = 0.0
            for j in range(6):
                by = (W[i, j, 0] * a[0] + W[i, j, 1] * a[1] + W[i, j, 2] * a[2]
                      + W[i, j, 3] * b[0] + W[i, j, 4] * b[1] + W[i, j, 5] * b[2])
                square += by * by
                ratio += by * (z[i, j] - 0.5 * by)
                left += (z[i, j] - by) ** 2
                usual += MAX_UNEXPLAINED * z[i, j] ** 2
            fallen += square > LEAST_FALL
            is_one &= left <= usual
        if fallen > 1 and is_one:
            best = max(best, ratio)
    return best
