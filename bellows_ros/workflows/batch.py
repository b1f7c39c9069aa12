"""
Identify a cup from many recordings: on many cores, on many machines, or piece by piece.

Every recording is reduced where it is read to a summary of what least squares needs; summaries are
small, and adding them gives the fit of all recordings
(`core.identification.regression.summaries`). A recording that cannot be used is reported and left
out.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import os
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.evidence import Evidence, evidence_of
from bellows_ros.core.identification.advice.excitation import Excitation, excitation_of
from bellows_ros.core.identification.advice.package_check import Checked
from bellows_ros.core.identification.envelope import Envelope
from bellows_ros.core.identification.judgement.consistency import Consistency, same_cup
from bellows_ros.core.identification.methods import filtered_samples, with_offsets
from bellows_ros.core.identification.regression.summaries import (
    fit_summaries,
    joined_envelopes,
    summarise,
    Summary,
)
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.seen import envelope
from bellows_ros.core.identification.statics.static_rows import joined_with_rest, Length
from bellows_ros.core.identification.structure import structure_named
from bellows_ros.core.model import cup_of, Package, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.preparation import Recording, Report
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import write_parameters
from bellows_ros.files.provenance import recording_digest
from bellows_ros.files.results import write_result
from bellows_ros.files.summary_files import read_summary, SummaryFile, write_summary
from bellows_ros.workflows.identify import (
    assumed,
    checked,
    errors_of,
    FIT_BEGINS,
    Identification,
    identify,
    NOT_OF_THE_CUP,
    Readings,
    resolved,
    rest_of,
    warnings_of,
)
from bellows_ros.workflows.recordings import Failed, load, names_of, repeats, values_of_each
from bellows_ros.workflows.result_json import (
    checked_json,
    excitation_json,
    fit_json,
    recording_json,
)
from bellows_ros.workflows.static import AtRest
from bellows_ros.workflows.workers import on_cores, on_dask, Task
import numpy as np

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Done:
    """A recording that was summarised: its place in `bags`, its digest, and what it tells."""

    number: int
    digest: str
    summary: Summary
    evidence: Evidence
    envelope: Envelope
    checked: Checked
    report: Report


@dataclass(frozen=True, eq=False)
class Read:
    """A recording that was read elsewhere: its place in `bags`, its digest, and itself."""

    number: int
    digest: str
    recording: Recording


@dataclass(frozen=True, eq=False)
class BatchIdentification(Identification):
    """
    A cup identified from summaries.

    Parameters
    ----------
    kept : tuple of Report
        What became of each recording that was used; `values['bags']` names them.
    envelopes : tuple of Envelope
        What each of those that were used has seen.

    Notes
    -----
    The prepared recordings stay where they were made: `recordings` is empty.

    """

    kept: tuple[Report, ...] = ()
    envelopes: tuple[Envelope, ...] = ()

    @property
    def envelope(self) -> Envelope:
        """What the fit has seen."""
        return self._with_rest(joined_envelopes(self.envelopes))

    @property
    def reports(self) -> tuple[Report, ...]:
        """What became of each recording that was used."""
        return self.kept


def identify_many(
    settings: Mapping[str, object],
    jobs: int = 1,
    dask: str = '',
    progress: Progress | None = None,
    parameter_files: Sequence[str | os.PathLike[str]] = (),
) -> Identification:
    """
    Identify a cup from many recordings at a time.

    What least squares needs of each is summarised where it is read. What a fit needs recordings
    themselves for, as the prediction error does, is made here of recordings that others have read.

    Parameters
    ----------
    settings : mapping
        Parameters by name; `bags` are the recordings.
    jobs : int
        Processes on this machine, -1 for one per core.
    dask : str
        Address of a Dask scheduler whose workers see the recordings at the same paths, used
        instead of processes here; '' for none.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.
    parameter_files : sequence of path, optional
        Files that the settings are from, for the provenance.

    Raises
    ------
    BellowsError
        If a parameter is not usable, the extra package is missing, the scheduler does not answer,
        no recording is usable, or all together do not determine the cup.

    """
    tell = progress or (lambda what, part: None)
    values = resolved(settings)
    if _needs_recordings(values):
        return _from_recordings(settings, jobs, dask, tell, parameter_files)
    at_rest = rest_of(values, tell)
    each = values_of_each(values)
    used, done, failed = _worked_on(summarise_bag, values, jobs, dask, tell)
    fit, excitation = _fit(done, used, at_rest)
    result = BatchIdentification(
        fit=fit,
        values=used,
        recordings=(),
        held=tuple(package_of(each[item.number]) for item in done),
        parameter_files=tuple(parameter_files),
        consistency=_consistency(done, used, [package_of(each[item.number]) for item in done]),
        excitation=excitation,
        at_rest=at_rest,
        assumed=assumed(settings),
        checks=tuple(item.checked for item in done),
        kept=tuple(item.report for item in done),
        failed=tuple(failed),
        envelopes=tuple(item.envelope for item in done),
    )
    tell('done', 1.0)
    return result


def _needs_recordings(values: Mapping[str, Any]) -> bool:
    """Return whether a fit takes more of the recordings than their summaries."""
    return bool(
        values['fit.method'] != 'least_squares' or values['fit.compare_structures']
        or values['static.length'] or values['validation.bags']
    )  # fmt: skip


def _from_recordings(
    settings: Mapping[str, object], jobs: int, dask: str, tell: Progress,
    parameter_files: Sequence[str | os.PathLike[str]],
) -> Identification:
    """Return what is made here of recordings that others read."""
    left_out: list[Failed] = []

    def read(values: dict[str, Any], tell: Progress) -> Readings:
        used, done, failed = _worked_on(
            read_bag, values, jobs, dask, lambda what, part: tell(what, FIT_BEGINS * part))
        left_out.extend(failed)
        each = values_of_each(values)
        return used, [r.recording for r in done], [package_of(each[r.number]) for r in done]

    result = identify(settings, tell, parameter_files, read)
    return replace(result, failed=tuple(left_out))


def read_bag(number: int, bag: str, values: Mapping[str, Any]) -> Read | Failed:
    """Return a prepared recording, or why there is none; the work of one process."""
    try:
        return Read(number, recording_digest(bag), load(bag, values).recording)
    except BellowsError as error:
        return Failed(number, bag, str(error))


def _worked_on(
    task: Task, values: Mapping[str, Any], jobs: int, dask: str, tell: Progress
) -> tuple[dict[str, Any], list[Any], list[Failed]]:
    """Return the parameters of the recordings that could be used, results, and failures."""
    bags = [os.fspath(bag) for bag in values['bags']]
    each = values_of_each(values)
    tell(f'reading {len(bags)} recordings', 0.0)
    work = [(n, bag, dict(own)) for n, (bag, own) in enumerate(zip(bags, each, strict=True))]
    results = on_dask(work, dask, task) if dask else on_cores(work, jobs, task)
    done, failed = _gathered(results, bags, tell)
    used = {**values, 'bags': tuple(bags[item.number] for item in done)}
    if values['package.files']:
        used['package.files'] = tuple(values['package.files'][item.number] for item in done)
    return used, done, failed


def _gathered(
    results: Iterator[Any], bags: Sequence[str], tell: Progress
) -> tuple[list[Any], list[Failed]]:
    """Return the results in the order of the recordings; at least one must be usable."""
    done: list[Any] = []
    failed: list[Failed] = []
    for count, result in enumerate(results, 1):
        if isinstance(result, Failed):
            failed.append(replace(result, bag=bags[result.number]))
        else:
            done.append(result)
        tell(f'reading {len(bags)} recordings', count / (len(bags) + 1))
    done.sort(key=lambda item: item.number)
    for place, sentence in reversed([*repeats((bags[d.number], d.digest) for d in done)]):
        number = done.pop(place).number
        failed.append(Failed(number, bags[number], sentence))
    failed.sort(key=lambda item: item.number)
    if not done:
        raise BellowsError(
            f'None of {len(failed)} recordings can be used. The first, '
            f"'{failed[0].bag}': {failed[0].reason}"
        )
    return done, failed


def _fit(
    done: Sequence[Done], values: Mapping[str, Any], at_rest: AtRest | None
) -> tuple[Fit, Excitation]:
    """Return the fit of all summaries and of standstills, if there are any; and what is told."""
    fit, excitation = _told_fit(done)
    if values['fit.time_offset']:
        fit = with_offsets(fit, [item.report for item in done])
    if at_rest is None:
        return fit, excitation
    exact = Length(values['cup.length'], 0.0, np.zeros(len(fit.labels)))
    typical = cup_of(values).stiffness
    return joined_with_rest(fit, at_rest.holds, exact, values['gravity'], typical), excitation


def _told_fit(parts: Sequence[Done | SummaryFile]) -> tuple[Fit, Excitation]:
    """Return the fit of summaries, without what only noise tells, and what is told."""
    fit = fit_summaries([part.summary for part in parts])
    excitation = excitation_of([part.evidence for part in parts], parts[0].summary.structure)
    return fit.without(excitation.untold), excitation


def _consistency(
    done: Sequence[Done], values: Mapping[str, Any], held: Sequence[Package]
) -> Consistency | None:
    """Return whether the recordings are of one cup, where that is asked for."""
    if not values['fit.compare_recordings'] or len(done) < 2:
        return None
    alone = [fit_summaries([item.summary]) for item in done]
    return same_cup(alone, names_of(values['bags'], held))


def summarise_bag(number: int, bag: str, values: Mapping[str, Any]) -> Done | Failed:
    """Return a recording's summary, or why there is none; the work of one process."""
    try:
        recording = load(bag, values).recording
        samples = filtered_samples(recording, package_of(values), values)
        length, structure = values['cup.length'], structure_named(values['fit.structure'])
        noise = FilterNoise.of(recording)
        return Done(
            number,
            recording_digest(bag),
            summarise(samples, noise, length, structure),
            evidence_of(samples, length, structure, noise),
            envelope([samples], length),
            checked(samples, values, recording),
            recording.report,
        )
    except BellowsError as error:
        return Failed(number, bag, str(error))


def _require_least_squares(values: Mapping[str, Any], instead: str) -> None:
    """Refuse other methods, whose residuals are not additive, and say what to do instead."""
    if values['fit.method'] != 'least_squares':
        raise BellowsError(
            f"Recordings can be worked on apart only with fit.method 'least_squares', not "
            f"'{values['fit.method']}'. Set it, or {instead}."
        )


def summarise_to_file(
    bag: str | os.PathLike[str], settings: Mapping[str, object], out: str | os.PathLike[str]
) -> SummaryFile:
    """
    Write the summary of one recording.

    Raises
    ------
    BellowsError
        If a parameter or the recording is not usable, or the file cannot be written.

    """
    values: dict[str, Any] = resolve(settings, PACKAGE_PARAMETERS)
    _require_least_squares(values, 'give all recordings to bellows identify')
    result = summarise_bag(0, os.fspath(bag), values)
    if isinstance(result, Failed):
        raise BellowsError(result.reason)
    report = recording_json(os.fspath(bag), result.report)
    content = SummaryFile(
        result.summary,
        result.evidence,
        result.envelope,
        result.checked,
        os.fspath(bag),
        result.digest,
        {name: value for name, value in values.items() if name not in NOT_OF_THE_CUP},
        {
            **report,
            'warnings': [*assumed(settings), *report['warnings']],
            **checked_json(result.checked),
        },
    )
    write_summary(out, content)
    return content


@dataclass(frozen=True, eq=False)
class Merged:
    """
    A cup identified from files of summaries.

    Parameters
    ----------
    fit : Fit
        K and P with their uncertainty.
    excitation : Excitation
        What the recordings can tell.
    files : tuple of SummaryFile
        That were added.

    """

    fit: Fit
    excitation: Excitation
    files: tuple[SummaryFile, ...]

    @property
    def bags(self) -> tuple[str, ...]:
        """The recordings."""
        return tuple(file.bag for file in self.files)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user must know: of the fit, then of the recordings."""
        of_bags = (f"'{f.bag}': {w}" for f in self.files for w in f.report.get('warnings', ()))
        checks = [file.checked for file in self.files]
        return (*warnings_of(self.fit, self.bags, checks, self.excitation), *of_bags)

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the cup file; a package only if it is that of all."""
        first = self.files[0].settings
        common = {
            name: value for name, value in first.items()
            if all(file.settings.get(name) == value for file in self.files)
        }  # fmt: skip
        return {
            **common,
            'cup.stiffness': tuple(self.fit.stiffness.ravel().tolist()),
            'cup.damping': tuple(self.fit.damping.ravel().tolist()),
            **errors_of(self.fit),
            **joined_envelopes([file.envelope for file in self.files]).parameters(),
        }

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return {
            **fit_json(self.fit),
            'warnings': self.warnings,
            'cup_length': self.files[0].summary.cup_length,
            'recordings': [dict(file.report) for file in self.files],
            'excitation': excitation_json(self.excitation),
            'version': __version__,
        }


def merge(paths: Sequence[str | os.PathLike[str]]) -> Merged:
    """
    Return the fit of all recordings whose summaries are in files.

    Raises
    ------
    BellowsError
        If a file is not usable or a recording is there twice, they are not of one cup, or all
        together do not determine it.

    """
    files = tuple(read_summary(path) for path in paths)
    for _, sentence in repeats((file.bag, file.digest) for file in files):
        raise BellowsError(sentence)
    return Merged(*_told_fit(files), files)


def save_merged(result: Merged, parameters_path: str, json_path: str) -> None:
    """Write the cup file, if the cup is usable, and the JSON file; '' for none."""
    if json_path:
        write_result(json_path, result.as_json())
    if parameters_path:
        bags = ', '.join(result.bags)
        write_parameters(
            parameters_path, result.parameters(),
            [f'Identified by bellows_ros {__version__} from summaries of {bags}'],
        )  # fmt: skip
