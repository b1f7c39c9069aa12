"""
Identify a cup: recordings in, K and P with their uncertainty, or the best structure, out.

Every recording is reduced to what a fit needs of it, and the fit is made of what they are reduced
to. Who reads them, one after the other, processes or a cluster, makes no difference. What needs
the recordings themselves gets them here.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
import os
from typing import Any, TYPE_CHECKING

from bellows_ros import __version__
from bellows_ros.core.identification import methods
from bellows_ros.core.identification.causes import misread
from bellows_ros.core.identification.identifiability import Excitation, excitation_of
from bellows_ros.core.identification.least_squares import with_relaxation
from bellows_ros.core.identification.reduction import Reduced, reduced
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import cup_of, is_gripper
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, RECORDING_PARAMETERS, resolve
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import digests
from bellows_ros.files.results import with_units
from bellows_ros.workflows import identification
from bellows_ros.workflows.recordings import (
    Failed,
    FULL_RANGE,
    load,
    Progress,
    repeats,
    silent,
    values_of_each,
)
from bellows_ros.workflows.verdict import allowances, FitVerdict, LOOKED_AT, verdict_of
import numpy as np

if TYPE_CHECKING:  # what a plain identification does without
    from bellows_ros.core.identification.comparison import Consistency
    from bellows_ros.core.identification.structure_selection import StructureSelection
    from bellows_ros.workflows.replay import Replay
    from bellows_ros.workflows.static import StaticResult

Part = Recording | Reduced
Read = Callable[[Mapping[str, Any]], tuple[list[Part], list['Failed']]]

FIT_BEGINS, FIT_ENDS = 0.2, 0.9
"""Fractions of the work at which the fit begins and ends, for the progress."""

CAUSES = 'testing possible causes'
"""The work of a diagnosis, for the progress."""

MOST_ON_A_PAGE = 20
"""Most recordings shown in a report."""

BY_LEAST_SQUARES = {'fit.method': 'least_squares'}
"""How recordings are fitted whose data are certainly wrong."""

NEEDING_RECORDINGS = ('static.length', 'fit.compare_structures', 'output.report')
"""Parameters that need the recordings themselves, not only their statistics."""

ONLY_QUICK = (
    'K and P are those of least squares: something given is wrong, so the output error was '
    'not fitted. --force fits it all the same.')


def identify(
    settings: Mapping[str, object], progress: Progress = silent,
    parameter_files: Sequence[str | os.PathLike[str]] = (), jobs: int | None = None,
    dask: str = '', force: bool = False
) -> identification.Identification:
    """
    Identify a cup from the recordings that the parameter `bags` names.

    The output error is not fitted where something given is certainly wrong.

    Parameters
    ----------
    settings : mapping
        Parameters by name; those left out have their defaults.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.
    parameter_files : sequence of path, optional
        Files that the settings are from, for the provenance.
    jobs : int, optional
        Processes that read recordings on this machine, -1 for one per core. A recording that
        cannot be used is then reported and left out.
    dask : str
        Address of a Dask scheduler whose workers see the recordings at the same paths, used
        instead of processes here; '' for none.
    force : bool
        Whether the output error is fitted to wrong data, too.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, an extra package is missing, the scheduler
        does not answer, or the recordings do not determine the cup.

    """
    values = resolved(settings)
    structure.fitted_structure(values)
    of_files = tuple({'path': os.fspath(path), 'files': digests(path)} for path in parameter_files)
    static = _static(values, progress)
    effective = {**values, 'cup.length': static.cup_length} if static else values
    keep = values['fit.method'] != 'least_squares' or values['fit.relaxation'] != 'off' or any(
        values[name] for name in NEEDING_RECORDINGS)

    def read(own: Mapping[str, Any]) -> tuple[list[Part], list[Failed]]:
        parts, failed = read_all(own, keep=keep, tell=progress, jobs=jobs, dask=dask)
        differentiable = methods.are_differentiable(parts, own)
        return with_relaxation(parts, own) if differentiable else parts, failed

    parts, failed = read(effective)
    whole = [part for part in parts if isinstance(part, Recording)]
    notes = assumed(settings)
    of_model = set(values['fit.free']) - {'time_offset', 'package_world'}
    if values['fit.method'] == 'output_error' and not (force or static or of_model) and (
            methods.are_differentiable(parts, values)):
        progress(CAUSES, FIT_BEGINS)
        early = verdict_of(None, whole, effective['cup.length'], effective)
        if early and early._replace(allowed=allowances(effective)).refusals:
            effective, notes = {**effective, **BY_LEAST_SQUARES}, (*notes, ONLY_QUICK)
    return _identified(values, effective, parts, static, progress, read, failed=tuple(failed),
                       assumed=notes, parameter_files=of_files)


def resolved(settings: Mapping[str, object]) -> dict[str, Any]:
    """Return all parameters of a run, or raise BellowsError where something is missing."""
    required = () if settings.get('package.files') else RECORDING_PARAMETERS
    values: dict[str, Any] = resolve(settings, required)
    if values['fit.free']:
        values = _with_free(values)
    structure.given_structure(values)
    if values['output.report']:
        from bellows_ros.errors import require_pictures

        require_pictures()
    used = {os.path.realpath(bag) for bag in values['bags']}
    seen = [bag for bag in values['validation.bags'] if os.path.realpath(bag) in used]
    missing = [name for name in PACKAGE_PARAMETERS if name not in values]
    for wrong, words in (
        (not used,
         'No recording is given: the parameter bags is empty. Name at least one rosbag2 '
         'folder, or a .mcap or .db3 file.'),
        (values['static.length'] and not values['static.bags'],
         'static.length is set, but static.bags is empty: the length comes from standstills '
         'with two or more masses. Name their recordings in static.bags.'),
        (values['output.report'] and len(values['bags']) > MOST_ON_A_PAGE,
         f'A report shows at most {MOST_ON_A_PAGE} recordings, got {len(values["bags"])}. '
         'Leave the report out.'),
        (seen,
         f"'{', '.join(seen)}' is both in bags and in validation.bags, but validation needs a "
         'recording that was not used in the fit. Remove it from one.'),
        (values['validation.bags'] and missing,
         f'The package of validation.bags is unknown: set {", ".join(missing)} beside '
         'package.files.'),
    ):
        if wrong:
            raise BellowsError(words)
    return values


def _with_free(values: dict[str, Any]) -> dict[str, Any]:
    """Return parameters with the clocks and worlds of fit.free; refuse what cannot be free."""
    free = set(values['fit.free'])
    given = sorted(free - {'time_offset', 'package_world'})
    for wrong, remedy in (
        (given and values['fit.method'] == 'least_squares',
         'they need fit.method: output_error. Set it'),
        (set(given) - {'length', 'package_marker'} and values['package.files'],
         'package.files gives each recording a package of its own. Fit the recordings of one '
         'package alone'),
        ('length' in free and values['static.length'],
         'static.length estimates the length from standstills. Use one of the two'),
    ):
        if wrong:
            raise BellowsError(f'fit.free: {", ".join(given)}: {remedy}.')
    world = values['recording.package_world']
    return {**values, 'fit.time_offset': values['fit.time_offset'] or 'time_offset' in free,
            'recording.package_world': world or ('estimate' if 'package_world' in free else '')}


def assumed(settings: Mapping[str, object]) -> tuple[str, ...]:
    """Return a warning if the cup's length is neither given nor estimated."""
    if 'cup.length' in settings or settings.get('static.length'):
        return ()
    return (
        f"cup.length is not set: using the thesis's {structure.THESIS_LENGTH:g} m, on which K "
        'and P depend. Measure yours from the tool tip to the lip, under vacuum and without '
        'load.',)


def _static(values: Mapping[str, Any], tell: Progress) -> 'StaticResult | None':
    """Return the result of the recordings of standstills, if there are any."""
    if not values['static.bags']:
        return None
    from bellows_ros.workflows.static import read_standstills

    return read_standstills({**values, **FULL_RANGE}, tell)


def read_part(
    bag: str, values: Mapping[str, Any], path: str = '', keep: Container[str] = ()
) -> Any:
    """
    Read and reduce a recording; return the recording or its sufficient statistics.

    Parameters
    ----------
    bag : str
        What the user calls it.
    values : mapping
        All parameters.
    path : str
        Its path for the reader; the same where left out.
    keep : container of str
        The recordings that are wanted themselves.

    Raises
    ------
    BellowsError
        If it is not usable.

    """
    recording = load(path or bag, values, name=bag, with_digest=True)
    if misread(recording):
        verdict = verdict_of(None, [recording], values['cup.length'], values)
        raise BellowsError(' '.join(verdict.cause if verdict else ()))
    part = reduced(recording, values)
    return recording if bag in keep else part


def read_all(
    values: Mapping[str, Any], keep: bool, tell: Progress, jobs: int | None = None, dask: str = ''
) -> tuple[list[Any], list[Failed]]:
    """
    Return the recordings, and those that cannot be used.

    They are read by processes or a cluster, or one after the other: then all must be usable.
    """
    bags = [os.fspath(bag) for bag in values['bags']]
    task = partial(read_part, keep=frozenset(bags if keep else bags[:LOOKED_AT]))
    work = [(n, bag, dict(own)) for n, (bag, own) in
            enumerate(zip(bags, values_of_each(values), strict=True))]
    parts = list[Any]()
    if jobs is None and not dask:
        for number, bag, own in work:
            tell(f'reading {bag}', FIT_BEGINS * number / len(bags))
            parts.append(task(bag, own))
            for _, sentence in repeats((part.name, part.digest) for part in parts):
                raise BellowsError(sentence)
        return parts, []
    from bellows_ros.workflows.workers import on_cores, on_dask

    words = f'reading {len(bags)} recordings'
    tell(words, 0.0)
    results: dict[int, Any] = {}
    for number, result in on_dask(work, dask, task) if dask else on_cores(work, jobs or 1, task):
        results[number] = result
        tell(words, FIT_BEGINS * len(results) / len(bags))
    done = [n for n, result in sorted(results.items()) if not isinstance(result, Failed)]
    for place, sentence in repeats((results[n].name, results[n].digest) for n in done):
        results[done[place]] = Failed(bags[done[place]], sentence)
    in_order = [results[n] for n in range(len(bags))]
    parts = [result for result in in_order if not isinstance(result, Failed)]
    failed = [result for result in in_order if isinstance(result, Failed)]
    if not parts:
        raise BellowsError(
            f'None of {len(failed)} recordings can be used. The first, '
            f"'{failed[0].bag}': {failed[0].reason}")
    return parts, failed


def _identified(
    values: Mapping[str, Any], effective: Mapping[str, Any], parts: Sequence[Part],
    static: 'StaticResult | None', tell: Progress, read: Read, **more: Any,
) -> identification.Identification:
    """
    Fit the recordings; return the result.

    Of the parameters there are those that were given, and those in effect, with the length that
    standstills have given. What is found of the package or the cup's length takes the place of
    what was given, and the recordings are read again with it.
    """
    tell('fitting', FIT_BEGINS)
    uncertain = static.length if static and values['static.length'] else None
    result = methods.fit(
        parts, effective,
        lambda what, part: tell(what, FIT_BEGINS + (FIT_ENDS - FIT_BEGINS) * part),
        static.standstills if static else (), uncertain.length_std if uncertain else 0.0)
    if result.fit.freed and result.fit.converged:
        values, effective = (
            methods.with_freed(own, result.fit.freed) for own in (values, effective))
        parts, _ = read(effective)
    whole = tuple(part for part in parts if isinstance(part, Recording))
    tell(CAUSES, FIT_ENDS)
    length = result.fit.standstills.length if result.fit.standstills else effective['cup.length']
    verdict = verdict_of(
        result.fit, whole, length, effective,
        [own.label for own in result.excitation.parameters if own.identifiable])
    found = identification.Identification(
        result.fit, result.excitation, values,
        tuple(reduced(part, effective) for part in parts),
        whole, _consistency(parts, effective, tell),
        selection=(selection(whole, effective, tell, verdict)
                   if values['fit.compare_structures'] else None), verdict=verdict, **more)
    if static:
        from bellows_ros.workflows.static import with_spring

        static = replace(static, cup_length=found.cup_length)
        cup = cup_of(found.cup_values())
        found = replace(found, static=with_spring(static, cup, values['gravity.magnitude']))
    found = replace(found, validations=tuple(_validated(found, tell)))
    tell('done', 1.0)
    return found


def _consistency(
    parts: Sequence[Part], values: Mapping[str, Any], tell: Progress
) -> 'Consistency | None':
    """Return whether each recording alone gives the same cup, with fit.compare_recordings."""
    if not values['fit.compare_recordings'] or len(parts) < 2:
        return None
    from bellows_ros.core.identification.comparison import same_cup

    differ = len({part.payload.mass for part in parts}) > 1
    names = [f'{part.name} ({part.payload.mass:.4g} kg)' if differ else part.name
             for part in parts]

    def alone(part: Part, name: str) -> Fit:
        return methods.fitted(
            [part], values, lambda what, _: tell(f'{name} alone, {what}', FIT_ENDS))

    return same_cup([*map(alone, parts, names)], names)


def selection(
    recordings: Sequence[Recording], values: Mapping[str, Any], tell: Progress,
    verdict: FitVerdict | None = None,
) -> 'StructureSelection':
    """Compare the structures, with a verdict where none fits; that of the fit where given."""
    from bellows_ros.core.identification.structure_selection import select_structure

    tell('comparing structures', FIT_ENDS)
    found = select_structure(
        [samples_of(recording) for recording in recordings], values['cup.length'],
        [recording.noise for recording in recordings],
        structure.structure_of_gripper(values) if is_gripper(values) else None)
    if verdict and values['fit.structure'] == found.advised:
        return found.judged(verdict.diagnosis, ())
    own = verdict_of(None, recordings, values['cup.length'],
                     {**values, 'fit.structure': found.advised})
    return found.judged(own.diagnosis, own.cause) if own else found


def _validated(result: identification.Identification, tell: Progress) -> 'list[Replay]':
    """Return the free simulations of the validation recordings, if the cup is usable."""
    if not (result.fit.usable and result.values['validation.bags']):
        return []
    from bellows_ros.workflows.replay import replay

    settings = {**result.cup_values(), **result.envelope.parameters(), **FULL_RANGE}
    found = []
    for bag in result.values['validation.bags']:
        tell(f'validating on {bag}', FIT_ENDS)
        found.append(replay(bag, settings))
    return found


@dataclass(frozen=True, eq=False)
class StructureAdvice:
    """
    What is identifiable from recordings, and a comparison of structures.

    Parameters
    ----------
    excitation : Excitation
        For the structure of the parameter fit.structure.
    selection : StructureSelection
        The structures with their criteria.
    recordings : tuple of Recording
        That were read.
    values : mapping
        All parameters.

    """

    excitation: Excitation
    selection: 'StructureSelection'
    recordings: tuple[Recording, ...]
    values: Mapping[str, Any]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the excitation, then about the recordings."""
        of_recordings = (text for own in self.recordings for text in own.report.warnings)
        return (*self.excitation.warnings, *of_recordings)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, in SI units."""
        return with_units({
            'excitation': identification.excitation_json(self.excitation),
            'structures': identification.selection_json(self.selection),
            'recordings': self.recordings,
            'warnings': self.warnings,
            'settings': dict(self.values),
            'version': __version__})


def structures(
    settings: Mapping[str, object], progress: Progress = silent
) -> StructureAdvice:
    """
    Find what is identifiable from the recordings of the parameter `bags`; compare structures.

    Parameters
    ----------
    settings : mapping
        Parameters by name; those left out have their defaults.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or a recording is not usable, or no structure can be fitted.

    """
    values = resolved(settings)
    read: list[Recording] = read_all(values, True, progress)[0]
    recordings = with_relaxation(read, values)
    relaxation = recordings[0].relaxation
    if any(relaxation.strengths):  # least squares alone is biased by noise
        better = methods.fit(recordings, {
            **values, 'fit.method': 'output_error',
            'fit.structure': 'layout' if is_gripper(values) else 'axisymmetric'}, progress).fit
        if better.converged:
            relaxation = relaxation._replace(
                strengths=better.relaxation, covariance=np.diag(np.square(better.relaxation_std)))
            recordings = [replace(own, relaxation=relaxation) for own in recordings]
    advice = StructureAdvice(
        excitation_of([reduced(recording, values) for recording in recordings]),
        selection(recordings, values, progress), tuple(recordings), values)
    progress('done', 1.0)
    return advice
