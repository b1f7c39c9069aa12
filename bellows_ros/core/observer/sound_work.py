"""What measured poses of sound work say of their own noise, and of the errors of a camera."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.observer.correction import Outcome
from bellows_ros.core.observer.filter import CAMERA, Estimate, LATENCY, NOISE, STATE
from bellows_ros.core.observer.measurement import Measurement
from bellows_ros.core.observer.observer import Observer
import numpy as np

FEWEST = 300
"""Measured poses required: standard deviations are then known to a twentieth."""

LEARNING = 30
"""Measured poses at the beginning that are not counted: the filter settles."""

SHORTEST, LONGEST = 1e-3, 1.0
"""Bounds of the noise's memory (s)."""


class SoundWork(Observer):
    """
    An observer that keeps the noise that it finds in each measured pose.

    It raises no alarms, and estimates pose and latency of the camera.

    Parameters
    ----------
    values : mapping
        As of `Observer`.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Know of no pose yet."""
        super().__init__({**values, 'alarm.false_per_hour': 0.0, 'measured.calibrate': True})
        self._squares: list[Array] = []
        self._places: list[tuple[float, float, float]] = []

    def _updated(self, before: Estimate, seen: Measurement, is_new: bool) -> Outcome:
        """Return the estimate after a measurement, and keep the expected square of its noise."""
        outcome = super()._updated(before, seen, is_new)
        if is_new and outcome.verdict == 'used':
            known = outcome.known
            found = known.theta[NOISE - STATE:NOISE - STATE + 6]
            self._squares.append(found**2 + np.diag(known.covariance)[NOISE:NOISE + 6])
            self._places.append(seen.position)
        return outcome

    @property
    def found(self) -> int:
        """The number of poses whose noise is known."""
        return len(self._squares)

    @property
    def noise_factors(self) -> tuple[float, float]:
        """By how much position and rotation are noisier than was said (expectation step)."""
        position, rotation = np.mean(self._squares[LEARNING:], axis=0).reshape(2, 3).mean(axis=1)
        return math.sqrt(position), math.sqrt(rotation)

    @property
    def memory(self) -> float:
        """The time (s) in which the correlation of the position's noise falls to 1 / e."""
        seconds, squares, _, products, *_ = self._known[-1].memory.tolist()
        share = products / squares
        if not 0.0 < share < 1.0:
            return SHORTEST if share <= 0.0 else LONGEST
        return float(np.clip(-seconds / math.log(share), SHORTEST, LONGEST))

    @property
    def offset_std(self) -> tuple[float, float]:
        """RMS error of the camera's position (m), where the package is, and of its rotation."""
        known, at = self._known[-1], np.mean(self._places, axis=0)
        rows = slice(CAMERA, CAMERA + 6)
        there: Array = np.eye(6)
        there[:3, 3:] = -hat(at)
        e = there @ known.theta[CAMERA - STATE:CAMERA - STATE + 6]
        squares = e**2 + np.diag(there @ known.covariance[rows, rows] @ there.T)
        position, rotation = np.sqrt(squares.reshape(2, 3).mean(axis=1)).tolist()
        return position, rotation

    @property
    def latency_std(self) -> float:
        """RMS error of the stamps (s)."""
        known = self._known[-1]
        return math.hypot(
            known.theta[LATENCY - STATE], math.sqrt(known.covariance[LATENCY, LATENCY]))
