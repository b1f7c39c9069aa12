"""What alarms must allow for, from a recording of sound work, and what they then raise falsely."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bellows_ros.core.observer import Observer
from bellows_ros.core.observer.sound_work import FEWEST, SoundWork
from bellows_ros.errors import BellowsError

STEPS = 5
"""Iterations of the noise's standard deviations (expectation and maximisation)."""

BEGUN = 4.0
"""The noise begins so many times larger: poses beyond the gate would tell nothing."""

MORE = 100.0
"""
False alarms are rare: where none is raised they are counted with so many times as many allowed,
as the likelihood ratios that noise alone makes are A or more one A-th as often.
"""

Run = Callable[[Observer], object]
"""Lets an observer see a recording."""


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
        found = ', '.join(
            f'{name} ' + ' '.join(f'{value:.3g}' for value in (
                values if isinstance(values, tuple) else (values,)))
            for name, values in self.parameters.items())
        said = (f'From this recording: {found}. False alarms to expect per hour, where '
                f'{self.allowed:g} are allowed: {_said(self.before)} without these parameters, '
                f'{_said(self.after)} with them.')
        if self.after.causes:
            said += (f' Alarms remain ({", ".join(self.after.causes)}): what causes them is not '
                     'the noise. Check whether the work was sound, cup.*_std and package.*_std.')
        return said


def _said(rate: Rate) -> str:
    return f'{rate.per_hour:.2g} (95 %: at most {rate.at_most:.2g})'


def calibrated_alarms(
    run: Run, values: Mapping[str, Any], seconds: float, with_covariance: bool
) -> AlarmCalibration:
    """
    Estimate what alarms must allow for, and count false alarms with and without it.

    Parameters
    ----------
    run : callable
        Lets an observer see the recording.
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
    allowed = float(values['alarm.false_per_hour'])
    if allowed == 0.0:
        raise BellowsError(
            'alarm.false_per_hour is 0: there are no alarms to calibrate. Set how many false '
            'alarms per hour are acceptable.')
    found = {**values, 'measured.noise': tuple(BEGUN * x for x in values['measured.noise'])}
    for _ in range(STEPS):
        work = SoundWork(found)
        run(work)
        if work.found < FEWEST:
            raise BellowsError(
                f'The recording has {work.found} usable measured poses; calibrating alarms takes '
                f'at least {FEWEST}. Record sound work for longer, best several minutes.')
        found['measured.memory'] = work.memory
        found['measured.noise'] = tuple(
            noise * factor for noise, factor in zip(
                found['measured.noise'], work.noise_factors, strict=True))
    found['measured.offset_std'] = work.offset_std
    found['measured.latency_std'] = work.latency_std
    names = ('measured.noise', 'measured.memory', 'measured.offset_std', 'measured.latency_std')
    return AlarmCalibration(
        {name: found[name] for name in names[with_covariance:]}, allowed,
        _rate(run, values, seconds), _rate(run, found, seconds))


def _rate(run: Run, values: Mapping[str, Any], seconds: float) -> Rate:
    """Return the false alarms to expect in sound work like that of a recording."""
    from scipy.stats import chi2

    allowed = values['alarm.false_per_hour']
    for more in (1.0, MORE):
        observer = Observer({**values, 'alarm.false_per_hour': more * allowed})
        run(observer)
        count, hours = len(observer.alarms), more * seconds / 3600.0
        if count:
            break
    causes = tuple(alarm.cause for alarm in observer.alarms) if more == 1.0 else ()
    at_most = 0.5 * float(chi2.ppf(0.95, 2 * (count + 1)))
    return Rate(count / hours, at_most / hours, causes)
