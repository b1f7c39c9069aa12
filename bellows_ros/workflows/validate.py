"""Judge a cup by a recording that it was not identified from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import os
from typing import Any

from bellows_ros.core.identification.envelope import beyond, known_envelope
from bellows_ros.core.identification.judgement.validation import LIMIT, SEED, Validation
from bellows_ros.core.identification.judgement.validation import validate as validate_recording
from bellows_ros.core.identification.judgement.whiteness import Spectrum, Whiteness
from bellows_ros.core.identification.methods import samples_of
from bellows_ros.core.identification.seen import envelope
from bellows_ros.core.model import cup_of, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Recording, TimeOffset
from bellows_ros.core.score import AXES
from bellows_ros.files.provenance import provenance
from bellows_ros.workflows.recordings import load

Progress = Callable[[str, float], None]

SHOWN = 3
"""Ranges of the envelope that a warning names."""


@dataclass(frozen=True, eq=False)
class Validated:
    """
    A cup and a recording that it was tried on.

    Parameters
    ----------
    bag : str
        The recording.
    values : mapping
        All parameters of the run.
    recording : Recording
        As it was prepared.
    validation : Validation
        What the free simulation gave.
    warnings : tuple of str
        What the user should know: of the recording, the simulation and the envelope.

    """

    bag: str
    values: Mapping[str, Any]
    recording: Recording
    validation: Validation
    warnings: tuple[str, ...]

    @property
    def time_offset(self) -> TimeOffset | None:
        """What was taken from the tool's stamps, where that was wanted and could be found."""
        return self.recording.report.time_offset

    def as_json(
        self, limit: float = LIMIT, parameter_files: Sequence[str | os.PathLike[str]] = ()
    ) -> dict[str, Any]:
        """Return the content of the JSON file; m for x, y, z and rad for rx, ry, rz."""
        found = self.validation
        return {
            'bag': self.bag,
            'axes': AXES,
            'units': ['m'] * 3 + ['rad'] * 3,
            'rms': found.scores.rms,
            'largest': found.scores.largest,
            'motion': found.scores.motion,
            'nrmse': found.scores.nrmse,
            'noise_rms': found.noise,
            'model_error': found.model_error,
            'moves': found.moves,
            'limit': limit,
            'above_limit': found.failing(limit),
            'samples': found.scores.samples,
            'start': found.start,
            'time_offset': self.time_offset and self.time_offset._asdict(),
            'seed': SEED,
            'free_run': _coloured_json(found.whiteness, found.spectrum),
            'one_step': found.one_step and {
                'chi2': found.one_step.chi2,
                **_coloured_json(found.one_step.whiteness, found.one_step.spectrum),
            },
            'warnings': self.warnings,
            'settings': dict(self.values),
            'provenance': provenance([self.bag], parameter_files),
        }


def validate(
    bag: str | os.PathLike[str],
    settings: Mapping[str, object],
    progress: Progress | None = None,
) -> Validated:
    """
    Simulate a recording freely with a cup, from start to end, and compare.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    settings : mapping
        Parameters by name: cup, package, topics and how it was recorded.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or the recording is not usable, or the cup cannot hold the package.

    """
    values: dict[str, Any] = resolve(settings, PACKAGE_PARAMETERS)
    tell = progress or (lambda what, part: None)
    tell(f'reading {os.fspath(bag)}', 0.0)
    recording = load(bag, values).recording
    tell('simulating', 0.5)
    result = judge(bag, values, recording)
    tell('done', 1.0)
    return result


def judge(
    bag: str | os.PathLike[str], values: Mapping[str, Any], recording: Recording
) -> Validated:
    """Return what a prepared recording says about the cup that the parameters describe."""
    held = package_of(values)
    found = validate_recording(cup_of(values), held, recording, values['gravity'])
    warnings = recording.report.warnings + found.warnings + _outside(values, recording)
    return Validated(os.fspath(bag), dict(values), recording, found, warnings)


def _outside(values: Mapping[str, Any], recording: Recording) -> tuple[str, ...]:
    """Return a warning where a recording leaves the envelope of the cup's fit, where known."""
    known = known_envelope(values)
    if known is None:
        return ()
    samples = samples_of(recording, package_of(values), values['gravity'])
    phrases = beyond(known, envelope([samples], values['cup.length']))
    if not phrases:
        return ()
    more = f'; and {len(phrases) - SHOWN} more' if len(phrases) > SHOWN else ''
    return (
        f'The recording goes beyond what the fit of the cup has seen: '
        f'{"; ".join(phrases[:SHOWN])}{more}. Errors there say little about the fit elsewhere.',
    )


def _coloured_json(whiteness: Whiteness, spectrum: Spectrum) -> dict[str, Any]:
    """Return the whiteness and the spectrum of residuals."""
    return {
        'lags': whiteness.lags,
        'portmanteau': whiteness.statistic,
        'p_value': whiteness.p_value,
        'largest_autocorrelation': whiteness.largest,
        'verdict': whiteness.words,
        'spectrum_peak_hz': spectrum.peak,
    }
