"""Identify a cup from recordings: files in, K and P with all that is known about them out."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.least_squares import least_squares, Samples
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Recording, Report, StreamReport
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.files.results import write_result
from bellows_ros.workflows.recordings import load

Progress = Callable[[str, float], None]

NOT_OF_THE_CUP = ('bags', 'output.parameters', 'output.json', 'predictor', 'exit_when_done')
"""Parameters that belong to one run and not into the file of the cup."""


@dataclass(frozen=True, eq=False)
class Identification:
    """
    An identified cup.

    Parameters
    ----------
    fit : Fit
        K and P with their uncertainty.
    values : mapping
        All parameters of the run.
    recordings : tuple of Recording
        The prepared recordings, in the order of the parameter `bags`.

    """

    fit: Fit
    values: Mapping[str, Any]
    recordings: tuple[Recording, ...]

    @property
    def reports(self) -> tuple[Report, ...]:
        """What became of each recording."""
        return tuple(recording.report for recording in self.recordings)

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the cup file: those of the run with K and P in them."""
        kept = {name: v for name, v in self.values.items() if name not in NOT_OF_THE_CUP}
        return {
            **kept,
            'cup.stiffness': tuple(self.fit.stiffness.ravel().tolist()),
            'cup.damping': tuple(self.fit.damping.ravel().tolist()),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user must know: of the fit, then of the recordings."""
        return self.fit.warnings + tuple(w for report in self.reports for w in report.warnings)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        fit = self.fit
        return {
            'method': fit.method,
            'structure': fit.structure,
            'stiffness': fit.stiffness,
            'damping': fit.damping,
            'stiffness_std': fit.stiffness_std,
            'damping_std': fit.damping_std,
            'samples_used': fit.samples_used,
            'samples_rejected': fit.samples_rejected,
            'condition_number': fit.condition_number,
            'usable': fit.usable,
            'warnings': self.warnings,
            'parameters': {'labels': fit.labels, 'covariance': fit.covariance},
            'weight': fit.weight,
            'residual_rms': fit.residual_rms,
            'cup_length': self.values['cup.length'],
            'recordings': [
                recording_json(str(bag), report)
                for bag, report in zip(self.values['bags'], self.reports, strict=True)
            ],
            'settings': dict(self.values),
            'version': __version__,
        }


def identify(settings: Mapping[str, object], progress: Progress | None = None) -> Identification:
    """
    Identify a cup from the recordings that the parameter `bags` names.

    Parameters
    ----------
    settings : mapping
        Parameters by name; those left out have their defaults.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or the recordings do not determine the cup.

    """
    values: dict[str, Any] = resolve(settings, PACKAGE_PARAMETERS)
    bags = values['bags']
    if not bags:
        raise BellowsError(
            'No recording to identify from: the parameter bags is empty. Name at least one '
            'rosbag2 folder, or a .mcap or .db3 file.'
        )
    recordings = []
    for number, bag in enumerate(bags):
        _tell(progress, f'reading {os.fspath(bag)}', number / (len(bags) + 1))
        recordings.append(load(bag, values).recording)
    _tell(progress, 'fitting', len(bags) / (len(bags) + 1))
    samples = [_samples(recording, values) for recording in recordings]
    fit = least_squares(samples, values['cup.length'], structure_named(values['fit.structure']))
    _tell(progress, 'done', 1.0)
    return Identification(fit, values, tuple(recordings))


def save(
    result: Identification,
    parameters_path: str | os.PathLike[str] | None,
    json_path: str | os.PathLike[str] | None,
) -> None:
    """
    Write the cup file and the JSON file; None or '' for none.

    Raises
    ------
    BellowsError
        If a file cannot be written, or the cup is not one that the predictor can take. The JSON
        file is written in that case too, the cup file is not.

    """
    if json_path:
        write_result(json_path, result.as_json())
    if not parameters_path:
        return
    if not result.fit.usable:
        raise BellowsError(' '.join(result.fit.warnings))
    write_parameters(parameters_path, result.parameters(), header(result))


def header(result: Identification) -> list[str]:
    """Return the lines at the top of the cup file: where its numbers come from."""
    fit = result.fit
    bags = ', '.join(map(str, result.values['bags']))
    return [
        f'Identified by bellows_ros {__version__} from {bags}',
        f'{fit.method}, {fit.structure}; {fit.samples_used} samples used, '
        f'{fit.samples_rejected} rejected, condition number {fit.condition_number:.3g}.',
    ]


def recording_json(bag: str, report: Report) -> dict[str, Any]:
    """Return what became of a recording, for the JSON file."""
    return {
        'bag': bag,
        'samples': report.samples,
        'valid': report.valid,
        'tool_pose': _stream_json(report.tool),
        'package_pose': _stream_json(report.package),
        'warnings': report.warnings,
    }


def _stream_json(stream: StreamReport) -> dict[str, Any]:
    """Return what became of a topic's messages."""
    return {
        'topic': stream.name,
        'poses': stream.samples,
        'rate_hz': stream.timing.rate_hz,
        'refused': {reason: list(where) for reason, where in stream.refused.items()},
        'outliers': stream.marked,
        'gaps': [
            {'start_ns': gap.start_ns, 'duration_s': gap.duration_s} for gap in stream.timing.gaps
        ],
        'filtered_samples_left_out': stream.touched,
    }


def _samples(recording: Recording, values: Mapping[str, Any]) -> Samples:
    """Return a prepared recording as least squares takes it."""
    stamps = recording.package.stamps_ns
    return Samples(
        tool=recording.tool,
        package=recording.package,
        held=package_of(values),
        gravity=values['gravity'],
        window=recording.package_weights.shape[1] / uniform_rate_hz(stamps),
    )


def _tell(progress: Progress | None, what: str, part: float) -> None:
    """Report progress where somebody wants to know."""
    if progress is not None:
        progress(what, part)
