"""Recordings of standstills: the cup's length."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from bellows_ros.core import Progress
from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.identification import statics
from bellows_ros.core.identification.unknowns import given_std
from bellows_ros.core.parameters.checks import ESTIMATE
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.recording.standstills import Standstill, standstills_of
from bellows_ros.errors import BellowsError, UndeterminedError
from bellows_ros.files import results
from bellows_ros.report.findings import text
from bellows_ros.workflows import recordings as reading
import numpy as np


class StaticResult(NamedTuple):
    """
    The result from static recordings.

    Parameters
    ----------
    recordings : tuple of Recording
        Recordings in the given order.
    length : CupLength or None
        The cup's length without load, None with too few masses.
    cup_length : float
        Assumed length of the cup, m.

    """

    recordings: tuple[Recording, ...]
    length: statics.CupLength | None
    cup_length: float

    @property
    def standstills(self) -> list[Standstill]:
        """All standstills."""
        return [still for recording in self.recordings for still in standstills_in(recording)[0]]

    @property
    def findings(self) -> Iterator[Finding]:
        """Findings on length and standstills."""
        if self.length:
            yield from self.length.remarks
            if abs(self.length.length - self.cup_length) > 3e-4:  # m
                yield Finding('differs', Level.WARN, {
                    'off': f'{1e3 * (self.cup_length - self.length.length):+.2f} mm off',
                    'found': f'{self.length.length:.5f}'}, 'cup.length')
        for recording in self.recordings:
            settled, failed = standstills_in(recording)
            if failed:
                yield Finding('left_out', Level.WARN, {
                    'part': f'{recording.name}: {failed} of {failed + len(settled)} standstills',
                    'reason': 'the package was still swinging; hold each pose for longer'})

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        return (*map(text, self.findings), *(
            f'{each.name}: {text(own)}' for each in self.recordings
            for own in each.report.remarks))

    def as_json(self) -> dict[str, Any]:
        """Return the content of a JSON file."""
        return results.plain_items({
            'estimated_length': self.length,
            'cup_length': self.cup_length,
            'recordings': [
                {**recording.as_json(), 'unsettled': failed, 'standstills': [results.attributes(
                    still, 'start_ns', 'duration', 'tilt', 'samples', 'lip', 'creep')
                    for still in settled]}
                for recording in self.recordings
                for settled, failed in [standstills_in(recording)]],
            'warnings': self.warnings})


def standstills_in(recording: Recording) -> tuple[tuple[Standstill, ...], int]:
    """Return a recording's standstills, and the number of failed ones of the tool."""
    try:
        return recording.cached('standstills', lambda: standstills_of(recording))
    except BellowsError as error:
        raise BellowsError(f'{recording.name}: {error}') from None


def read_standstills(values: Values, progress: Progress) -> StaticResult:
    """
    Return the result from the recordings in the parameter `static.bags`.

    With static.length, the cup has the estimated length.

    Parameters
    ----------
    values : mapping
        All parameters.
    progress : callable
        Callback with the current step and its completed fraction (0 to 1).

    Raises
    ------
    BellowsError
        If a recording is unusable, or static.length requests an undetermined length.

    """
    recordings, com_std = _read(values, progress)
    result = StaticResult(recordings, None, values.cup.length)
    try:
        length = statics.cup_length_of(result.standstills, values.gravity.magnitude)
    except UndeterminedError as error:
        if values.static.length:
            raise BellowsError(f'static.length is set, but: {error}') from None
        return result
    if values.static.length:
        if not np.isfinite(length.length_std):
            raise BellowsError(f'static.length is set, but: {text(length.remarks[0])}')
        result = result._replace(cup_length=length.length)
    return result._replace(length=length._replace(com_std=com_std))


def _read(values: Values, progress: Progress) -> tuple[tuple[Recording, ...], float]:
    """Return the recordings, and the largest std (m) of a com that moves the lip, along z."""
    recordings, com_std = list[Recording](), 0.0
    for bag, own in zip(
            values.static.bags, reading.values_of_each(values, at_rest=True), strict=True):
        progress(f'reading {bag}', 0.0)
        if own.recording.package_world == ESTIMATE:
            raise BellowsError(
                f"'{bag}' has only standstills, which do not give recording.package_world. Set "
                'its seven numbers: they are in the cup file of an identification with a motion.')
        recordings.append(reading.load(  # twists are irrelevant at rest
            bag, own.replaced({'topics.tool_twist': '', 'fit.free': ()}), accepted='tool_at_rest'))
        if not recordings[-1].settings.moves_with_com[2]:
            com_std = max(com_std, float(given_std(own).get('com', np.zeros(3))[2]))
        for _, words in reading.duplicates((each.name, each.digest) for each in recordings):
            raise BellowsError(words)
    return tuple(recordings), com_std
