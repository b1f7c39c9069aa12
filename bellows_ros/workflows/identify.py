"""
Identification of a cup: recordings in, K and P with their uncertainty out.

Every recording is reduced to the statistics of a fit, in this process, in others or on a cluster,
with equal results. Steps that need the recordings themselves get them here.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
import os
from typing import Any, TYPE_CHECKING

from bellows_ros.core.identification import causes, methods
from bellows_ros.core.identification.quantities import as_found
from bellows_ros.core.identification.reduction import AnyRecording, reduced, whole_recordings
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model import structure
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.conversion import is_gripper
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.errors import BellowsError, require_pictures, UnexplainedError
from bellows_ros.files import bag_folder
from bellows_ros.workflows import identification
from bellows_ros.workflows import recordings as reading
from bellows_ros.workflows.recordings import Failed, FULL_RANGE, no_progress, Progress
from bellows_ros.workflows.static import read_standstills, StaticResult, with_spring
from bellows_ros.workflows.verdict import MAX_TESTED, verdict_of
from bellows_ros.workflows.workers import on_cores, on_dask
import numpy as np

if TYPE_CHECKING:  # not needed by a plain identification
    from bellows_ros.workflows.compare import ComparedFits
    from bellows_ros.workflows.replay import Replay

Poses = Mapping[str, PoseStream]
"""Poses of tool and package."""

FIT_BEGINS, FIT_ENDS = 0.2, 0.9
"""Fractions of the work at which the fit begins and ends, for the progress display."""

CAUSE_TESTS = 'testing possible causes'
"""Name of the diagnosis in the progress display."""

MAX_PAGE_RECORDINGS = 20
"""Largest number of recordings in a report."""

RECORDING_USERS = ('static.length', 'fit.compare_structures', 'output.report')
"""Parameters of steps that need the recordings themselves, not only their statistics."""


def identify(
    settings: Mapping[str, Any], progress: Progress = no_progress,
    parameter_files: Sequence[str | os.PathLike[str]] = (), jobs: int | None = None,
    dask: str = '', force: bool = False, poses: Mapping[str, Poses] | None = None
) -> identification.Identification:
    """
    Identify a cup from the recordings of the parameter `bags`.

    Output error is not fitted if a given quantity is certainly wrong.

    Parameters
    ----------
    settings : mapping
        Parameters by name; others have their defaults.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    parameter_files : sequence of path, optional
        Files of the settings, for the provenance.
    jobs : int, optional
        Number of processes that read recordings on this machine, -1 for one per core. An unusable
        recording is then reported and omitted.
    dask : str
        Address of a Dask scheduler whose workers have the recordings at equal paths, instead of
        local processes; '' for none.
    force : bool
        Whether output error is also fitted to wrong data.
    poses : mapping
        Recordings in memory, by their names in `bags`: see `prepare_streams`.

    Raises
    ------
    BellowsError
        If a parameter or a recording is unusable, an extra package is missing, the scheduler does
        not answer, or the recordings do not determine the cup.

    """
    values = resolved(settings)
    conversion.fitted_structure(values)
    static = None
    if values.static.bags:
        static = read_standstills(values.replaced({**FULL_RANGE}), progress)
    effective = values.replaced({'cup.length': static.cup_length}) if static else values
    keep = values.fit.method != 'least_squares' or any(
        values[name] for name in RECORDING_USERS)

    parts, failed = read_all(effective, keep, progress, jobs, dask, poses)
    if values.fit.method == 'output_error' and not force:
        _require_no_facts(whole_recordings(parts), effective, progress)
    return _identify(
        values, effective, parts, static, progress, failed=tuple(failed),
        assumed=_assumed(settings),
        parameter_files=tuple(
            {'path': os.fspath(file), 'files': bag_folder.digests(file)}
            for file in parameter_files))


def _require_no_facts(
    recordings: Sequence[Recording], values: Values, progress: Progress
) -> None:
    """Raise for recordings with faults detected without a fit, with all further faults."""
    if causes.facts(recordings, values.cup.length):
        progress(CAUSE_TESTS, FIT_BEGINS)
        verdict = verdict_of(None, recordings, values.cup.length, values)
        raise UnexplainedError(' '.join([
            *(verdict.cause if verdict else ()),
            "The cup was not fitted; 'bellows identify --force' fits it all the same."]))


def resolved(settings: Mapping[str, Any]) -> Values:
    """Return all parameters of a run, or raise BellowsError for missing ones."""
    required = () if settings.get('package.files') else checks.RECORDING_PARAMETERS
    values = checks.resolve(settings, required)
    free = values.fit.free
    if 'time_offset' in free:
        values = values.replaced({'fit.time_offset': True})
    if not values.recording.package_world and 'package_world' in free:
        values = values.replaced({'recording.package_world': checks.ESTIMATE})
    conversion.given_structure(values)
    if values.output.report:
        require_pictures()
    for wrong, words in _mistakes(values):
        if wrong:
            raise BellowsError(words)
    return values


def _mistakes(values: Values) -> Iterator[tuple[Any, str]]:
    """Yield contradictions of parameters, and their remedies."""
    free = sorted(set(values.fit.free) - {'time_offset', 'package_world'})
    names = f'fit.free: {", ".join(free)}: '
    yield (free and values.fit.method == 'least_squares',
           f'{names}they need fit.method: output_error. Set it.')
    yield (values.fit.relaxation == 'on' and values.fit.method == 'least_squares',
           'fit.relaxation: on needs fit.method: output_error: least squares does not estimate '
           'relaxation. Set it.')
    yield (values.fit.stretch == 'on' and values.fit.method == 'least_squares',
           'fit.stretch: on needs fit.method: output_error: least squares does not estimate '
           'cup.stretch. Set it.')
    yield ({*free} - {'length', 'package_marker', 'clock_rate', 'scale'} and values.package.files,
           f'{names}with package.files each recording has another package. Fit the recordings of '
           'one package alone.')
    yield ('length' in free and values.static.length,
           f'{names}static.length estimates the length from standstills. Use one of the two.')
    bags, validation = values.bags, values.validation.bags
    used = {os.path.realpath(bag) for bag in bags}
    repeated = [bag for bag in validation if os.path.realpath(bag) in used]
    missing = [name for name in checks.PACKAGE_PARAMETERS if name not in values]
    yield (not bags, 'No recording is given: the parameter bags is empty. Name at least one '
           'rosbag2 folder, or a .mcap or .db3 file.')
    yield (values.static.length and not values.static.bags,
           'static.length is set, but static.bags is empty: the length comes from standstills '
           'with two or more masses. Name their recordings in static.bags.')
    yield (values.output.report and len(bags) > MAX_PAGE_RECORDINGS,
           f'A report shows at most {MAX_PAGE_RECORDINGS} recordings, got {len(bags)}. Leave the '
           'report out.')
    yield (repeated,
           f"'{', '.join(repeated)}' is both in bags and in validation.bags, but validation needs "
           'a recording that was not used in the fit. Remove it from one.')
    yield (validation and missing, f'The package of validation.bags is unknown: set '
           f'{", ".join(missing)} in addition to package.files.')


def _assumed(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a warning if the cup's length is neither given nor estimated."""
    if 'cup.length' in settings or settings.get('static.length'):
        return ()
    return (
        f"cup.length is not set: using the thesis's {structure.THESIS_LENGTH:g} m, on which K "
        'and P depend. Measure yours from the tool tip to the lip, under vacuum and without '
        'load.',)


def read_part(
    bag: str, values: Values, path: str = '', keep: Container[str] = (),
    poses: Mapping[str, Poses] | None = None,
) -> Any:
    """
    Read and reduce a recording; return the recording or its sufficient statistics.

    Parameters
    ----------
    bag : str
        Name of the recording by the user.
    values : mapping
        All parameters.
    path : str
        Path for the reader; default: the name.
    keep : container of str
        Names of the recordings that are kept in full.
    poses : mapping
        Recordings in memory, as in `identify`.

    Raises
    ------
    BellowsError
        If the recording is unusable.

    """
    if poses and bag in poses:
        settings = reading.prepare_settings(values)
        recording = replace(
            reading.prepare_streams(poses[bag], settings, values), name=bag, digest=bag)
    else:
        recording = reading.load(path or bag, values, name=bag, with_digest=True)
    if causes.misread(recording):
        verdict = verdict_of(None, [recording], values.cup.length, values)
        raise BellowsError(' '.join(verdict.cause if verdict else ()))
    part = reduced(recording, values)
    return recording if bag in keep else part


def read_all(
    values: Values, keep: bool, progress: Progress, jobs: int | None = None, dask: str = '',
    poses: Mapping[str, Poses] | None = None,
) -> tuple[list[Any], list[Failed]]:
    """
    Return the recordings, and the unusable ones.

    They are read by processes or a cluster, or sequentially, in which case all must be usable.
    """
    bags = [os.fspath(bag) for bag in values.bags]
    task = partial(read_part, keep=frozenset(bags if keep else bags[:MAX_TESTED]), poses=poses)
    work = [(n, bag, each) for n, (bag, each) in
            enumerate(zip(bags, reading.values_of_each(values), strict=True))]
    if jobs is None and not dask:
        parts = list[Any]()
        for number, bag, each in work:
            progress(f'reading {bag}', FIT_BEGINS * number / len(bags))
            parts.append(task(bag, each))
            for _, sentence in reading.duplicates((part.name, part.digest) for part in parts):
                raise BellowsError(sentence)
        return parts, []
    words = f'reading {len(bags)} recordings'
    progress(words, 0.0)
    outcomes: dict[int, Any] = {}
    for number, outcome in (
            on_dask(work, dask, task) if dask else on_cores(work, jobs or 1, task)):
        outcomes[number] = outcome
        progress(words, FIT_BEGINS * len(outcomes) / len(bags))
    done = [n for n in range(len(bags)) if not isinstance(outcomes[n], Failed)]
    digested = ((outcomes[n].name, outcomes[n].digest) for n in done)
    for place, sentence in reading.duplicates(digested):
        outcomes[done[place]] = Failed(bags[done[place]], sentence)
    parts, failed = ([each for _, each in sorted(outcomes.items(), key=itemgetter(0))
                      if isinstance(each, Failed) is unusable] for unusable in (False, True))
    if not parts:
        raise BellowsError(
            f'None of {len(failed)} recordings can be used. The first, '
            f"'{failed[0].bag}': {failed[0].reason}")
    return parts, failed


def _identify(
    values: Values, effective: Values, parts: Sequence[AnyRecording],
    static: StaticResult | None, progress: Progress, assumed: tuple[str, ...], **more: Any,
) -> identification.Identification:
    """
    Fit the recordings; return the result.

    `effective` are the parameters `values` with the length estimated from standstills. Estimates
    of the package or the cup's length replace the given values, also in the recordings.
    """
    progress('fitting', FIT_BEGINS)
    length = static.length if static and values.static.length else None
    try:
        result = methods.fit(
            parts, effective,
            lambda what, part: progress(what, FIT_BEGINS + (FIT_ENDS - FIT_BEGINS) * part),
            static.standstills if static else (), length.length_std if length else 0.0)
    except BellowsError:
        _require_no_facts(whole_recordings(parts), effective, progress)
        raise
    fit = result.fit
    if values.fit.structure == structure.AUTO:
        values, effective = (each.replaced({'fit.structure': fit.structure})
                             for each in (values, effective))
    if fit.freed and fit.converged:
        values, effective = (methods.with_freed(each, fit.freed) for each in (values, effective))
        found = {freed.name: np.array([freed.change]) for freed in fit.freed}
        parts = [as_found(part, found, n) for n, part in enumerate(whole_recordings(parts))]
    recordings = whole_recordings(parts)
    progress(CAUSE_TESTS, FIT_ENDS)
    verdict = verdict_of(
        fit, recordings, fit.standstills.length if fit.standstills else effective.cup.length,
        effective)
    selected = None
    if values.fit.compare_structures:
        from bellows_ros.core.identification.structure_selection import select_structure

        progress('comparing structures', FIT_ENDS)
        selected = select_structure(
            [samples_of(recording) for recording in recordings], effective.cup.length,
            [recording.noise for recording in recordings],
            conversion.given_structure(effective.replaced({'fit.structure': 'layout'}))
            if is_gripper(effective) else None)
    identified = identification.Identification(
        fit, result.excitation, values, tuple(reduced(part, effective) for part in parts),
        tuple(recordings), _consistency(parts, effective, progress), verdict=verdict,
        selection=selected, assumed=assumed, **more)
    if static:
        identified = replace(identified, static=with_spring(
            static._replace(cup_length=identified.cup_length), identified.cup,
            values.gravity.magnitude))
    identified = replace(identified, validations=tuple(_validated(identified, progress)))
    progress('done', 1.0)
    return identified


def _consistency(
    parts: Sequence[AnyRecording], values: Values, progress: Progress
) -> 'ComparedFits | None':
    """Return the test for one cup by each recording alone, with fit.compare_recordings."""
    if not values.fit.compare_recordings or len(parts) < 2:
        return None

    def alone(part: AnyRecording, name: str) -> Fit:
        return methods.fitted(
            [part], values, lambda what, _: progress(f'{name} alone, {what}', FIT_ENDS))

    from bellows_ros.workflows.compare import consistency

    return consistency(parts, alone)


def _validated(
    result: identification.Identification, progress: Progress
) -> 'Iterator[Replay]':
    """Yield the free simulations of the validation recordings, if the cup is usable."""
    for bag in result.values.validation.bags if result.fit.usable else ():
        progress(f'validating on {bag}', FIT_ENDS)
        from bellows_ros.workflows.replay import replay

        yield replay(
            bag, {**result.cup_values(), **result.envelope.parameters(), **FULL_RANGE})
