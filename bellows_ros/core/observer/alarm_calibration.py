"""What measured poses of sound work say of noise and camera, and what alarms they raise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.filter import STATE
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
import numpy as np
from scipy.special import gammaincinv

MIN_POSES = 300
"""Measured poses required: standard deviations are then known to a twentieth."""

SETTLING_POSES = 30
"""Measured poses at the beginning that are not counted: the filter settles."""

MEMORY_RANGE = 1e-3, 1.0
"""Bounds of the noise's memory (s)."""

ITERATIONS = 5
"""Iterations of the noise's standard deviations (expectation and maximisation)."""

INITIAL_NOISE_FACTOR = 4.0
"""The noise begins so many times larger: poses beyond the gate would tell nothing."""

RATE_FACTOR = 100.0
"""
False alarms are rare: where none is raised they are counted with so many times as many allowed,
as the likelihood ratios that noise alone makes are A or more one A-th as often.
"""

Replayer = Callable[[Observer], object]
"""Lets an observer process a recording."""


class SoundWork(Observer):
    """
    An observer that keeps the noise that it finds in each measured pose.

    It raises no alarms, and estimates pose and latency of the camera.

    Parameters
    ----------
    values : mapping
        As of `Observer`.

    Attributes
    ----------
    squares : list of array (6,)
        Expected squares of the noise of each pose, relative to that stated.

    """

    def __init__(self, values: Values) -> None:
        """Start without poses."""
        super().__init__(values.replaced(
            {'alarm.false_per_hour': 0.0, 'measured.calibrate': True}))
        self.squares: list[Array] = []
        self._places: list[tuple[float, float, float]] = []

    def _reprocess(self, first: int) -> None:
        """Update with a new measurement, and keep the expected square of its noise if used."""
        used = self.counts['used']
        super()._reprocess(first)
        if self.counts['used'] > used:
            after = self._estimates[first + 1]
            noise = after.theta[ekf.NOISE - STATE:ekf.NOISE - STATE + 6]
            self.squares.append(
                noise**2 + np.diag(after.covariance)[ekf.NOISE:ekf.NOISE + 6])
            self._places.append(self._measurements[first].position)

    @property
    def noise_factors(self) -> tuple[float, ...]:
        """By how much position and rotation are noisier than stated (expectation step)."""
        return _rms_of_axes(np.mean(self.squares[SETTLING_POSES:], axis=0))

    @property
    def memory(self) -> float:
        """The time (s) in which the correlation of the position's noise falls to 1 / e."""
        seconds, squares, _, products, *_ = self._estimates[-1].memory.tolist()
        share = products / squares
        if not 0.0 < share < 1.0:
            return MEMORY_RANGE[share > 0.0]
        return float(np.clip(-seconds / math.log(share), *MEMORY_RANGE))

    @property
    def offset_std(self) -> tuple[float, ...]:
        """RMS error of the camera's position (m), where the package is, and of its rotation."""
        last, rows = self._estimates[-1], slice(ekf.CAMERA, ekf.CAMERA + 6)
        at_package: Array = np.eye(6)
        at_package[:3, 3:] = -hat(np.mean(self._places, axis=0))
        e = at_package @ last.theta[ekf.CAMERA - STATE:ekf.CAMERA - STATE + 6]
        return _rms_of_axes(
            e**2 + np.diag(at_package @ last.covariance[rows, rows] @ at_package.T))

    @property
    def latency_std(self) -> float:
        """RMS error of the stamps (s)."""
        last, row = self._estimates[-1], ekf.LATENCY
        return math.hypot(last.theta[row - STATE], math.sqrt(last.covariance[row, row]))


def _rms_of_axes(squares: Array) -> tuple[float, ...]:
    """Return the RMS value per axis of position and rotation, from squares (6,)."""
    return tuple(np.sqrt(squares.reshape(2, 3).mean(axis=1)).tolist())


@dataclass(frozen=True)
class Rate:
    """
    False alarms to expect per hour.

    Parameters
    ----------
    per_hour, at_most : float
        Expected, and the end of the one-sided interval of 95 % (Garwood 1936).
    causes : tuple of str
        Of the alarms that were raised, in order.

    """

    per_hour: float
    at_most: float
    causes: tuple[str, ...]

    def __str__(self) -> str:
        """Return both rates."""
        return f'{self.per_hour:.2g} (95 %: at most {self.at_most:.2g})'


@dataclass(frozen=True)
class AlarmCalibration:
    """
    Parameters from sound work, and the false alarms with and without them.

    Parameters
    ----------
    parameters : mapping
        Of measured.*, to be written.
    allowed : float
        alarm.false_per_hour.
    before, after : Rate
        With the parameters as they were given, and with those found.

    """

    parameters: Mapping[str, Any]
    allowed: float
    before: Rate
    after: Rate

    @property
    def sentence(self) -> str:
        """The parameters found, and the false alarms to expect."""
        parameters = ', '.join(
            f'{name} ' + ' '.join(f'{value:.3g}' for value in (
                values if isinstance(values, tuple) else (values,)))
            for name, values in self.parameters.items())
        text = (f'From this recording: {parameters}. False alarms to expect per hour, where '
                f'{self.allowed:g} are allowed: {self.before} without these parameters, '
                f'{self.after} with them.')
        if self.after.causes:
            text += (f' Alarms remain ({", ".join(self.after.causes)}): what causes them is not '
                     'the noise. Check whether the work was sound, cup.*_std and package.*_std.')
        return text


def calibrated_alarms(
    run: Replayer, values: Values, seconds: float, with_covariance: bool
) -> AlarmCalibration:
    """
    Estimate what alarms must allow for, and count false alarms with and without it.

    Parameters
    ----------
    run : callable
        Lets an observer process the recording.
    values : mapping
        Parameters by name.
    seconds : float
        Length of the recording.
    with_covariance : bool
        Whether the poses state their noise, so that measured.noise is not used.

    Raises
    ------
    BellowsError
        If alarms are turned off, or the recording is too short.

    """
    allowed = float(values.alarm.false_per_hour)
    if allowed == 0.0:
        raise BellowsError(
            'alarm.false_per_hour is 0: there are no alarms to calibrate. Set how many false '
            'alarms per hour are acceptable.')
    noise = INITIAL_NOISE_FACTOR * np.array(values.measured.noise)
    estimated = values.replaced({'measured.noise': tuple(noise.tolist())})
    for _ in range(ITERATIONS):
        work = SoundWork(estimated)
        run(work)
        if len(work.squares) < MIN_POSES:
            raise BellowsError(
                f'The recording has {len(work.squares)} usable measured poses; calibrating alarms '
                f'takes at least {MIN_POSES}. Record sound work for longer, best several minutes.')
        estimated = estimated.replaced({
            'measured.memory': work.memory, 'measured.noise': tuple(
                np.multiply(estimated.measured.noise, work.noise_factors).tolist())})
    estimated = estimated.replaced({
        'measured.offset_std': work.offset_std, 'measured.latency_std': work.latency_std})
    names = ('measured.noise', 'measured.memory', 'measured.offset_std', 'measured.latency_std')
    return AlarmCalibration(
        {name: estimated[name] for name in names[with_covariance:]}, allowed,
        _rate(run, values, seconds), _rate(run, estimated, seconds))


def _rate(run: Replayer, values: Values, seconds: float) -> Rate:
    """Return the false alarms to expect in sound work like that of a recording."""
    allowed = values.alarm.false_per_hour
    for more in (1.0, RATE_FACTOR):
        observer = Observer(values.replaced({'alarm.false_per_hour': more * allowed}))
        run(observer)
        count, hours = len(observer.alarms), more * seconds / 3600.0
        if count:
            break
    causes = tuple(alarm.cause for alarm in observer.alarms) if more == 1.0 else ()
    at_most = float(gammaincinv(count + 1, 0.95))
    return Rate(count / hours, at_most / hours, causes)
