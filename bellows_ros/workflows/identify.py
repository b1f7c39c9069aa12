"""Identify a cup from recordings: files in, K and P with all that is known about them out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
import os
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.consistency import Consistency, same_cup
from bellows_ros.core.identification.envelope import Envelope
from bellows_ros.core.identification.excitation import (
    describe_excitation,
    Excitation,
    FilterNoise,
)
from bellows_ros.core.identification.methods import filtered_samples, fitted, samples_of
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.seen import envelope
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import Package, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Recording, Report
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.files.provenance import provenance
from bellows_ros.files.results import write_result
from bellows_ros.workflows.recordings import load
from bellows_ros.workflows.result_json import excitation_json, fit_json, recording_json

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
    held : tuple of Package
        The package in each of them.
    parameter_files : tuple of path
        Files that the parameters are from, for their digests.
    consistency : Consistency or None
        Whether the recordings are of one cup, where that was asked for.
    excitation : Excitation or None
        What the recordings can tell.

    """

    fit: Fit
    values: Mapping[str, Any]
    recordings: tuple[Recording, ...]
    held: tuple[Package, ...]
    parameter_files: tuple[str | os.PathLike[str], ...] = ()
    consistency: Consistency | None = None
    excitation: Excitation | None = None

    @property
    def reports(self) -> tuple[Report, ...]:
        """What became of each recording."""
        return tuple(recording.report for recording in self.recordings)

    @cached_property
    def envelope(self) -> Envelope:
        """What the fit has seen."""
        samples = [
            samples_of(recording, package, self.values['gravity'])
            for recording, package in zip(self.recordings, self.held, strict=True)
        ]
        return envelope(samples, self.values['cup.length'])

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the cup file: those of the run with K and P in them."""
        kept = {name: v for name, v in self.values.items() if name not in NOT_OF_THE_CUP}
        return {
            **kept,
            'cup.stiffness': tuple(self.fit.stiffness.ravel().tolist()),
            'cup.damping': tuple(self.fit.damping.ravel().tolist()),
            'cup.stiffness_std': tuple(self.fit.stiffness_std.ravel().tolist()),
            'cup.damping_std': tuple(self.fit.damping_std.ravel().tolist()),
            **self.envelope.parameters(),
        }

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user must know: of the fit, then of the recordings."""
        told = self.excitation.warnings if self.excitation else ()
        verdict = (self.consistency.verdict,) if self.consistency else ()
        of_recordings = tuple(w for report in self.reports for w in report.warnings)
        return (*self.fit.warnings, *told, *verdict, *of_recordings)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            **fit_json(self.fit),
            'warnings': self.warnings,
            'cup_length': self.values['cup.length'],
            'recordings': [
                recording_json(str(bag), report)
                for bag, report in zip(self.values['bags'], self.reports, strict=True)
            ],
            'one_cup': self.consistency and {
                'probability': self.consistency.probability,
                'verdict': self.consistency.verdict,
                'deviations': self.consistency.deviations,
            },
            'excitation': excitation_json(self.excitation) if self.excitation else None,
            'envelope': self.envelope.as_json(),
            'settings': dict(self.values),
            'provenance': provenance(self.values['bags'], self.parameter_files),
            'version': __version__,
        }


def identify(
    settings: Mapping[str, object],
    progress: Progress | None = None,
    parameter_files: Sequence[str | os.PathLike[str]] = (),
) -> Identification:
    """
    Identify a cup from the recordings that the parameter `bags` names.

    Parameters
    ----------
    settings : mapping
        Parameters by name; those left out have their defaults.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.
    parameter_files : sequence of path, optional
        Files that the settings are from, for the provenance.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or the recordings do not determine the cup.

    """
    required = () if settings.get('package.files') else PACKAGE_PARAMETERS
    values: dict[str, Any] = resolve(settings, required)
    bags = values['bags']
    if not bags:
        raise BellowsError(
            'No recording to identify from: the parameter bags is empty. Name at least one '
            'rosbag2 folder, or a .mcap or .db3 file.'
        )
    recordings, held = [], []
    for number, (bag, own) in enumerate(zip(bags, values_of_each(values), strict=True)):
        _tell(progress, f'reading {os.fspath(bag)}', number / (len(bags) + 1))
        recordings.append(load(bag, own).recording)
        held.append(package_of(own))
    _tell(progress, 'fitting', len(bags) / (len(bags) + 1))
    excitation = _excitation(recordings, held, values)
    fit = fitted(recordings, held, values, progress)
    consistency = None
    if values['fit.compare_recordings'] and len(bags) > 1:
        alone = [
            fitted([recording], [package], values, progress)
            for recording, package in zip(recordings, held, strict=True)
        ]
        consistency = same_cup(alone, bags)
    _tell(progress, 'done', 1.0)
    return Identification(
        fit, values, tuple(recordings), tuple(held), tuple(parameter_files), consistency,
        excitation,
    )  # fmt: skip


def _excitation(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any]
) -> Excitation:
    """Return what recordings can tell; of noise only where the method suffers from it."""
    samples = [filtered_samples(r, p, values) for r, p in zip(recordings, held, strict=True)]
    noises = [FilterNoise.of(recording) for recording in recordings]
    structure = structure_named(values['fit.structure'])
    by_least_squares = values['fit.method'] == 'least_squares'
    return describe_excitation(
        samples, values['cup.length'], structure, noises if by_least_squares else ()
    )


def values_of_each(values: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the parameters for each recording, with the package that it held."""
    files, bags = values['package.files'], values['bags']
    if not files:
        return [values] * len(bags)
    if len(files) != len(bags):
        raise BellowsError(
            f'package.files has {len(files)} files for {len(bags)} recordings. Name one for each '
            'recording in bags, in the same order, or none.'
        )
    each: list[Mapping[str, Any]] = []
    for file in files:
        own = {n: v for n, v in read_parameters(file).items() if n in PACKAGE_PARAMETERS}
        missing = [name for name in PACKAGE_PARAMETERS if name not in own]
        if missing:
            raise BellowsError(f"Parameter file '{file}' lacks {', '.join(missing)}.")
        each.append({**values, **own})
    return each


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


def _tell(progress: Progress | None, what: str, part: float) -> None:
    """Report progress where somebody wants to know."""
    if progress is not None:
        progress(what, part)
