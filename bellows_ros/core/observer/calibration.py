"""Calibration of the measurement model on work without faults, and the rate of false alarms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import FACTORS
from bellows_ros.core.observer.measurement import cholesky, corrected_pose
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.observer.states import NOISE, STATE
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.special import gammaincinv

MIN_POSES = 100
"""Smallest number of measured poses, which determine standard deviations to 10 %."""

ITERATIONS = 4
"""Number of iterations of expectation maximisation, after which sizes change by less than 3 %."""

INITIAL_FACTOR = 3.0
"""Factor of the initial standard deviations, so that poses stay within the gate."""

RATE_FACTOR = 100.0
"""Factor of the allowed rate for counting, because alarms at the allowed rate are too rare."""

WORK_FOLDS = 2
"""Number of parts of the poses for cross-validation."""

Run = Callable[[Observer, int], object]
"""Function by which an observer processes one fold of the measured poses, or all with fold -1."""


class SoundWork(Observer):
    """
    An observer without alarms that stores the noise of each used pose.

    Attributes
    ----------
    noise : list of array (2,)
        Expected mean squares of position (m^2) and rotation (rad^2).

    """

    def __init__(self, values: Values) -> None:
        super().__init__(values.replaced({'alarm.false_per_hour': 0.0}))
        self.noise: list[Array] = []

    def _reprocess(self, first: int) -> None:
        """Update with a new measurement, and store its noise if used."""
        used = self.counts['used']
        super()._reprocess(first)
        if self.counts['used'] > used and not self._estimates[first + 1].support:
            self._keep_noise(first)

    def _keep_noise(self, first: int) -> None:
        after = self._estimates[first + 1]
        _, position, q, noise, _ = self._measurements[first]
        body, marker = after.body, self.sensor.marker
        if not noise.any():
            noise = np.diag(np.square(np.repeat(marker[3][1:3], 3)))
        com = self.model[1][1]
        root = cholesky(corrected_pose(position, q, noise, marker, after.theta, com)[2])[0]
        rows = slice(NOISE, NOISE + 6)
        n = after.theta[NOISE - STATE:NOISE - STATE + 6]
        squares = root @ (np.outer(n, n) + after.covariance[rows, rows]) @ root.T
        squares *= np.sqrt(np.outer(*[np.repeat(after.memory[FACTORS:FACTORS + 2], 3)] * 2))
        R = np.reshape(t3.rotation_matrix(body[1]), (3, 3))
        at_marker = np.kron(np.eye(2), R)
        at_marker[:3, 3:] = hat(np.subtract(position, body[0])).T @ R
        squares = np.diag(at_marker @ squares @ at_marker.T)
        self.noise.append(squares.reshape(2, 3).mean(axis=1))

    def sizes(self) -> dict[str, tuple[float, ...]]:
        """Return measured.noise."""
        return {'measured.noise': tuple(np.sqrt(np.mean(self.noise, axis=0)).tolist())}

    def camera(self) -> dict[str, Any]:
        """Return the latency with its standard deviation."""
        last, row = self._estimates[-1] if self._estimates else self._known, states.LATENCY
        late = float(last.theta[row - STATE])
        return {'measured.latency': self._values.measured.latency + late,
                'measured.latency_std': max(math.sqrt(last.covariance[row, row]), 1e-3)}


@dataclass(frozen=True)
class Rate:
    """
    Expected rate of false alarms.

    Parameters
    ----------
    per_hour, at_most : float
        Expected rate, and upper end of the one-sided 95 % interval (Garwood 1936).

    """

    per_hour: float
    at_most: float


@dataclass(frozen=True)
class ModelCalibration:
    """
    A calibrated measurement model, and the rates of false alarms with and without it.

    Parameters
    ----------
    parameters : mapping
        Values of measured.*.
    poses : int
        Number of used measured poses.
    before, after : Rate
        With the given parameters, and with parameters from the other poses (cross-validation).

    """

    parameters: Mapping[str, Any]
    poses: int
    before: Rate
    after: Rate

    @property
    def is_better(self) -> bool:
        """Whether the calibration lowers the rate of false alarms, or keeps it at zero."""
        return self.after.per_hour < max(self.before.per_hour, 1e-9) or (
            self.before.per_hour == self.after.per_hour == 0.0)


def calibrated(run: Run, values: Values, seconds: float) -> ModelCalibration:
    """
    Fit the measurement model to work without faults; count false alarms by cross-validation.

    Parameters
    ----------
    run : callable
        Function by which an observer processes a part of the work.
    values : Values
        Parameters.
    seconds : float
        Duration of the work, s.

    Raises
    ------
    BellowsError
        If alarms are disabled, a tag is measured, or too few poses are used.

    """
    if values.alarm.false_per_hour == 0.0:
        raise BellowsError(
            'alarm.false_per_hour is 0: there are no alarms to calibrate. Set the acceptable '
            'number of false alarms per hour.')
    if values.measured.tag_size:
        raise BellowsError(
            "The noise of a tag's corners is found by 'bellows identify', which writes it into "
            'the cell file. --calibrate is for tracked bodies.')
    parameters, poses = _fitted(run, values, -1)
    if poses < MIN_POSES:
        raise BellowsError(
            f'The recording has {poses} usable measured poses; a calibration takes at least '
            f'{MIN_POSES}. Record sound work for longer.')
    counts = np.zeros(2)
    for fold in range(WORK_FOLDS):
        others = _fitted(run, values, (fold + 1) % WORK_FOLDS)[0]
        counts += [_count(run, given, fold) for given in (values, values.replaced(others))]
    hours = RATE_FACTOR * seconds / 3600.0
    before, after = (
        Rate(count / hours, float(gammaincinv(count + 1.0, 0.95)) / hours)
        for count in counts.tolist())
    return ModelCalibration(parameters, poses, before, after)


def _fitted(run: Run, values: Values, fold: int) -> tuple[dict[str, Any], int]:
    """Return the numbers of the model from a part of the work, and its used poses."""
    noise = Observer(values).sensor.marker[3][1:3]
    found: dict[str, Any] = {
        'measured.noise': tuple(INITIAL_FACTOR * each for each in noise)}
    work = SoundWork(values.replaced(found))
    for _ in range(ITERATIONS):
        work = SoundWork(values.replaced(found))
        run(work, fold)
        if len(work.noise) < MIN_POSES // (2 * WORK_FOLDS):
            break
        found = work.sizes()
    return (found | work.camera() if work.noise else found), len(work.noise)


def _count(run: Run, values: Values, fold: int) -> int:
    observer = Observer(values.replaced({
        'alarm.false_per_hour': RATE_FACTOR * values.alarm.false_per_hour}))
    run(observer, fold)
    return len(observer.alarms)
