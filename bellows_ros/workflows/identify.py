"""Identify a cup from recordings: files in, K and P with all that is known about them out."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import os
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.excitation import describe_excitation, Excitation
from bellows_ros.core.identification.advice.ladder import Ladder, structure_ladder
from bellows_ros.core.identification.advice.package_check import (
    check_centre_of_mass,
    check_length,
    Checked,
)
from bellows_ros.core.identification.envelope import Envelope
from bellows_ros.core.identification.judgement.consistency import Consistency, same_cup
from bellows_ros.core.identification.methods import filtered_samples, fitted, samples_of
from bellows_ros.core.identification.regression.least_squares import Samples
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.seen import envelope, with_rest
from bellows_ros.core.identification.statics.static import check_spring, SpringCheck
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import Cup, Package, package_of
from bellows_ros.core.parameter_table import THESIS_LENGTH
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Recording, Report, TimeOffset
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.files.provenance import provenance, recording_digest
from bellows_ros.files.results import write_result
from bellows_ros.workflows.findings import findings
from bellows_ros.workflows.recordings import (
    Failed,
    load,
    names_of,
    offset_sentence,
    repeats,
    values_of_each,
)
from bellows_ros.workflows.result_json import (
    checked_json,
    consistency_json,
    excitation_json,
    fit_json,
    ladder_json,
    measured_json,
    package_json,
    recording_json,
)
from bellows_ros.workflows.static import AtRest, recorded_at_rest
from bellows_ros.workflows.validate import validate, Validated
import numpy as np

Progress = Callable[[str, float], None]
Readings = tuple[dict[str, Any], list[Recording], list[Package]]
Reader = Callable[[dict[str, Any], Progress], Readings]

NOT_OF_THE_CUP = (
    'bags', 'package.files', 'static.bags', 'static.files', 'static.length', 'validation.bags',
    'output.parameters', 'output.json', 'output.report', 'predictor', 'exit_when_done',
)  # fmt: skip
"""Parameters that belong to one run and not into the file of the cup."""

UNKNOWN_STD = 1e9
"""Stands in parameter files for the standard error of an entry of which nothing is known."""

FIT_BEGINS, FIT_ENDS = 0.2, 0.9
"""Parts of the whole work at which fitting begins and ends, for the progress."""


@dataclass(frozen=True, eq=False)
class Identification:
    """
    An identified cup.

    Parameters
    ----------
    fit : Fit
        K and P with their uncertainty.
    values : mapping
        All parameters of the run, with the cup.length that was found where that was asked for.
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
    at_rest : AtRest or None
        The recordings of standstills, where there are any.
    ladder : Ladder or None
        The structures of K and P compared, where that was asked for.
    validations : tuple of Validated
        Recordings that the fit has not seen, simulated with its cup.
    checks : tuple of Checked
        What each recording says of the cup's length and of the centre of mass.
    failed : tuple of Failed
        Recordings that were left out.
    assumed : tuple of str
        What was not given and taken from the thesis, in sentences.

    """

    fit: Fit
    values: Mapping[str, Any]
    recordings: tuple[Recording, ...]
    held: tuple[Package, ...]
    parameter_files: tuple[str | os.PathLike[str], ...] = ()
    consistency: Consistency | None = None
    excitation: Excitation | None = None
    at_rest: AtRest | None = None
    ladder: Ladder | None = None
    validations: tuple[Validated, ...] = ()
    checks: tuple[Checked, ...] = ()
    failed: tuple[Failed, ...] = ()
    assumed: tuple[str, ...] = ()

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
        return self._with_rest(envelope(samples, self.values['cup.length']))

    def _with_rest(self, moving: Envelope) -> Envelope:
        """Return an envelope with that of the standstills."""
        if self.at_rest is None:
            return moving
        return with_rest(moving, self.at_rest.holds, self.values['cup.length'])

    @cached_property
    def spring(self) -> SpringCheck | None:
        """Whether the cup's spring holds in the standstills; None without these."""
        if self.at_rest is None:
            return None
        cup = Cup(self.fit.stiffness, self.fit.damping, self.values['cup.length'])
        return check_spring(cup, self.at_rest.holds, self.values['gravity'])

    def cup_values(self) -> dict[str, Any]:
        """Return the parameters of the run with K and P in them."""
        return {
            **self.values,
            'cup.stiffness': tuple(self.fit.stiffness.ravel().tolist()),
            'cup.damping': tuple(self.fit.damping.ravel().tolist()),
        }

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the cup file: those of the run with K and P in them."""
        kept = {name: v for name, v in self.cup_values().items() if name not in NOT_OF_THE_CUP}
        return {**kept, **errors_of(self.fit), **self.envelope.parameters()}

    @property
    def findings(self) -> tuple[str, ...]:
        """What was found beside the cup, in sentences."""
        return findings(self)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user must know: of what was given, the fit, the recordings, validations."""
        one_cup = self.consistency
        verdict = (one_cup.verdict,) if one_cup and one_cup.differs else ()
        resting = self.at_rest.warnings(self.values['cup.length']) if self.at_rest else ()
        of_recordings = tuple(w for report in self.reports for w in report.warnings)
        unseen = (f'{v.bag}: {warning}' for v in self.validations for warning in v.warnings)
        of_fit = warnings_of(self.fit, self.values['bags'], self.checks, self.excitation)
        left_out = (f"Recording '{f.bag}' was left out: {f.reason}" for f in self.failed)
        return (*left_out, *self.assumed, *of_fit, *verdict, *resting, *of_recordings, *unseen)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            **fit_json(self.fit),
            'warnings': self.warnings,
            'findings': self.findings,
            'cup_length': self.values['cup.length'],
            'recordings': self._recordings_json(),
            'at_rest': self.at_rest and self.at_rest.as_json(),
            'one_cup': self.consistency and consistency_json(self.consistency),
            'excitation': self.excitation and excitation_json(self.excitation),
            'ladder': self.ladder and ladder_json(self.ladder),
            'validations': [validated.as_json() for validated in self.validations],
            'envelope': self.envelope.as_json(),
            'settings': dict(self.values),
            'provenance': provenance(
                [*self.values['bags'], *self.values['static.bags']], self.parameter_files),
            'failed': [{'bag': f.bag, 'error': f.reason} for f in self.failed],
            'version': __version__,
        }

    def _recordings_json(self) -> list[dict[str, Any]]:
        """Return what became of each recording, with what it held, its noise and its offsets."""
        found = [
            {**recording_json(str(bag), report), 'package': package_json(package)}
            for bag, report, package in zip(
                self.values['bags'], self.reports, self.held, strict=True)
        ]  # fmt: skip
        for entry, recording in zip(found, self.recordings, strict=False):
            entry.update(measured_json(recording))
        for entry, checked in zip(found, self.checks, strict=False):
            entry.update(checked_json(checked))
        return found


def warnings_of(
    fit: Fit, bags: Sequence[str | os.PathLike[str]], checks: Sequence[Checked],
    excitation: Excitation | None,
) -> tuple[str, ...]:
    """Return what is to be said of a fit, of what was given, and of what recordings tell."""
    along = excitation is not None and 'P z' not in excitation.untold
    wrong = (
        text for bag, checked in zip(bags, checks, strict=False)
        for text in checked.warnings(os.fspath(bag), along)
    )  # fmt: skip
    return (*fit.warnings, *wrong, *(excitation.warnings if excitation else ()))


def errors_of(fit: Fit) -> dict[str, tuple[float, ...]]:
    """Return the standard errors of a fit as parameters; of what is not known `UNKNOWN_STD`."""
    return {
        f'cup.{name}': tuple(np.minimum(getattr(fit, name), UNKNOWN_STD).ravel().tolist())
        for name in ('stiffness_std', 'damping_std')
    }


def identify(
    settings: Mapping[str, object],
    progress: Progress | None = None,
    parameter_files: Sequence[str | os.PathLike[str]] = (),
    read: Reader | None = None,
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
    read : callable, optional
        Reads the recordings in another way than one after the other, here.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or the recordings do not determine the cup.

    """
    tell = progress or (lambda what, part: None)
    values = resolved(settings)
    at_rest = rest_of(values, tell)
    if at_rest and at_rest.length and values['static.length']:
        values['cup.length'] = at_rest.length.length
    values, recordings, held = (read or _read)(values, tell)
    tell('looking at the excitation', FIT_BEGINS)
    excitation = _excitation(recordings, held, values)
    fit = _fit(recordings, held, values, excitation, at_rest, tell)
    if fit.rest is not None:
        values['cup.length'] = fit.rest.length
    result = Identification(
        fit, values, tuple(recordings), tuple(held), tuple(parameter_files),
        _consistency(recordings, held, values, tell), excitation, at_rest,
        _ladder(recordings, held, values, tell), checks=_checks(recordings, held, values),
        assumed=assumed(settings),
    )  # fmt: skip
    result = replace(result, validations=tuple(_validated(result, tell)))
    tell('done', 1.0)
    return result


def resolved(settings: Mapping[str, object]) -> dict[str, Any]:
    """Return all parameters of a run, or raise BellowsError where something is missing."""
    required = () if settings.get('package.files') else PACKAGE_PARAMETERS
    values: dict[str, Any] = resolve(settings, required)
    if not values['bags']:
        raise BellowsError(
            'No recording to identify from: the parameter bags is empty. Name at least one '
            'rosbag2 folder, or a .mcap or .db3 file.'
        )
    if values['static.length'] and not values['static.bags']:
        raise BellowsError(
            'static.length is set, but static.bags is empty: the length is found from standstills '
            'with two or more masses. Name their recordings in static.bags.'
        )
    used = {os.path.realpath(bag) for bag in values['bags']}
    seen = [bag for bag in values['validation.bags'] if os.path.realpath(bag) in used]
    if seen:
        raise BellowsError(
            f"'{seen[0]}' is both in bags and in validation.bags: a cup is validated on what it "
            'has not seen. Take it out of one.'
        )
    if values['validation.bags'] and values['package.files']:
        values = {**values, **_common_package(values)}
    return values


def assumed(settings: Mapping[str, object]) -> tuple[str, ...]:
    """Return what is said where the cup's length is neither given nor to be found."""
    if 'cup.length' in settings or settings.get('static.length'):
        return ()
    return (
        f'cup.length is not set: the {THESIS_LENGTH:g} m of the thesis are taken, on which K and '
        'P depend. Measure yours from the tool tip to the lip, under vacuum and without load.',
    )


def _common_package(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the package of the recordings for validation, which must be known."""
    missing = [name for name in PACKAGE_PARAMETERS if name not in values]
    if missing:
        raise BellowsError(
            f'Which package validation.bags held is not known: set {", ".join(missing)} beside '
            'package.files.'
        )
    return {name: values[name] for name in PACKAGE_PARAMETERS}


def rest_of(values: Mapping[str, Any], tell: Progress) -> AtRest | None:
    """Return the recordings of standstills, where there are any."""
    return recorded_at_rest(values, tell) if values['static.bags'] else None


def _read(values: dict[str, Any], tell: Progress) -> Readings:
    """Return the parameters, the prepared recordings, and what was held in each."""
    recordings, held, bags = [], [], values['bags']
    if len(bags) > 1:
        for _, sentence in repeats((os.fspath(bag), recording_digest(bag)) for bag in bags):
            raise BellowsError(sentence)
    for number, (bag, own) in enumerate(zip(bags, values_of_each(values), strict=True)):
        tell(f'reading {os.fspath(bag)}', FIT_BEGINS * number / len(bags))
        recordings.append(load(bag, own).recording)
        held.append(package_of(own))
    return values, recordings, held


def _fit(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any],
    excitation: Excitation, at_rest: AtRest | None, tell: Progress,
) -> Fit:
    """Return the fit to all recordings."""
    tell('fitting', FIT_BEGINS)
    if all(told.untold for told in excitation.parameters if told.label.startswith('P')):
        raise BellowsError(
            'Nothing moves enough in the recordings: no damping can be told from them, nor any '
            'stiffness that is not bent by the weight. Move the tool, in all directions at 1-3 Hz '
            "and along the cup at 4-6 Hz; recordings at rest are for 'bellows static' and "
            'static.bags.'
        )
    holds = at_rest.holds if at_rest else ()
    length = at_rest.length if at_rest and values['static.length'] else None
    error = length.length_std if length else 0.0
    return fitted(recordings, held, values, _within(tell), excitation.untold, holds, error)


def _within(tell: Progress) -> Progress:
    """Return what tells the progress of a fit as a part of the whole."""
    return lambda what, part: tell(what, FIT_BEGINS + (FIT_ENDS - FIT_BEGINS) * part)


def _consistency(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any],
    tell: Progress,
) -> Consistency | None:
    """Return whether each recording alone finds the same cup, where that is asked for."""
    if not values['fit.compare_recordings'] or len(recordings) < 2:
        return None
    names = names_of(values['bags'], held)
    alone = []
    for name, recording, package in zip(names, recordings, held, strict=True):
        alone.append(fitted([recording], [package], values, _of(name, tell)))
    return same_cup(alone, names)


def _of(name: str, tell: Progress) -> Progress:
    """Return what tells the progress of the fit to one recording."""
    return lambda what, part: tell(f'{name} alone, {what}', FIT_ENDS)


def _checks(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any]
) -> tuple[Checked, ...]:
    """Return what each recording says of the values that were given."""
    return tuple(
        checked(filtered_samples(recording, package, values), values, recording)
        for recording, package in zip(recordings, held, strict=True)
    )


def checked(samples: Samples, values: Mapping[str, Any], recording: Recording) -> Checked:
    """Return what a recording says of the cup's length and of the centre of mass."""
    noise, structure = FilterNoise.of(recording), structure_named(values['fit.structure'])
    lip = values['recording.package_frame'] == 'lip'
    return Checked(
        check_length(samples, values['cup.length'], structure, noise),
        check_centre_of_mass(samples, values['cup.length'], structure, lip, noise),
    )


def _ladder(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any],
    tell: Progress,
) -> Ladder | None:
    """Return the structures compared, where that is asked for."""
    if not values['fit.compare_structures']:
        return None
    tell('comparing structures', FIT_ENDS)
    samples = [filtered_samples(r, p, values) for r, p in zip(recordings, held, strict=True)]
    noises = [FilterNoise.of(recording) for recording in recordings]
    return structure_ladder(samples, values['cup.length'], noises)


def _validated(result: Identification, tell: Progress) -> list[Validated]:
    """Return the free simulations of the recordings for validation, if the cup can hold them."""
    if not result.fit.usable:
        return []
    settings = {**result.cup_values(), **result.envelope.parameters()}
    found = []
    for bag in result.values['validation.bags']:
        tell(f'validating on {bag}', FIT_ENDS)
        found.append(validate(bag, settings))
    return found


def _excitation(
    recordings: Sequence[Recording], held: Sequence[Package], values: Mapping[str, Any]
) -> Excitation:
    """Return what recordings can tell."""
    samples = [filtered_samples(r, p, values) for r, p in zip(recordings, held, strict=True)]
    noises = [FilterNoise.of(recording) for recording in recordings]
    structure = structure_named(values['fit.structure'])
    return describe_excitation(
        samples, values['cup.length'], structure, noises,
        values['fit.method'] == 'least_squares',
    )  # fmt: skip


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
        raise BellowsError(' '.join([*result.assumed, *result.fit.warnings]))
    write_parameters(parameters_path, result.parameters(), header(result))


def header(result: Identification) -> list[str]:
    """Return the lines at the top of the cup file: where its numbers come from."""
    fit = result.fit
    bags = ', '.join(map(str, result.values['bags']))
    offsets = map(TimeOffset, fit.delays, fit.delays_std)
    return [
        f'Identified by bellows_ros {__version__} from {bags}',
        f'{fit.method}, {fit.structure}; {fit.samples_used} samples used, '
        f'{fit.samples_rejected} rejected, condition number {fit.condition_number:.3g}.',
        *(line for bag, offset in zip(result.values['bags'], offsets, strict=False)
          for line in offset_sentence(bag, offset)),
    ]
