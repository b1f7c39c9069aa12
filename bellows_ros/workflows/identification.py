"""An identified cup as sentences, as a cup file, and as JSON."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.identification.estimates import (
    com_change,
    Estimates,
    ParameterEstimate,
    terms_of,
)
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.segments import ReducedRecording
from bellows_ros.core.identification.verdict import (
    cause_finding,
    FitVerdict,
    UNTESTED,
)
from bellows_ros.core.model import cup_package, validity_range
from bellows_ros.core.model.cup_package import TERMS
from bellows_ros.core.parameters import checks, conversion, table
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError
from bellows_ros.files import File, parameter_files, results
from bellows_ros.report.findings import entry, warnings
from bellows_ros.report.findings import text as text_of
from bellows_ros.version import __version__
from bellows_ros.workflows import CommandResult
from bellows_ros.workflows.recordings import (
    estimate_finding,
    Failed,
    offset_findings,
)
import numpy as np

UNKNOWN_STD = 1e9
"""Standard error of an unidentifiable entry in parameter files."""

CELL_PREFIXES = ('package.', 'recording.', 'topics.', 'tool_pose.', 'tool_twist.', 'gravity.',
                 'measured.', 'filter.', 'vacuum.')
"""Prefixes of the parameters of a cell and its package."""


@dataclass(frozen=True, eq=False)
class Identification(CommandResult):
    """
    An identified cup.

    Parameters
    ----------
    fit : Fit
        K and P with their uncertainty.
    values : mapping
        All given parameters of the run.
    parts : tuple of ReducedRecording
        Used recordings, reduced.
    estimates : Estimates
        Estimates jointly with K and P.
    envelope : Envelope
        Validity range of the fit.
    recordings : tuple of Recording
        The first of the used recordings, kept for later steps.
    verdict : FitVerdict
        Quality of the cup and of the given quantities; empty without an unreduced recording.
    failed : tuple of Failed
        Unusable recordings.
    assumed : tuple of str
        Sentences on values taken from the thesis for lack of given ones.

    """

    fit: Fit
    values: Values
    parts: tuple[ReducedRecording, ...]
    estimates: Estimates
    envelope: validity_range.Envelope
    recordings: tuple[Recording, ...] = ()
    verdict: FitVerdict = UNTESTED
    failed: tuple[Failed, ...] = ()
    assumed: tuple[str, ...] = ()

    @property
    def bags(self) -> tuple[str, ...]:
        """Used recordings."""
        return tuple(part.name for part in self.parts)

    @property
    def cup_length(self) -> float:
        """Cup length of the fit, m: given or estimated."""
        return self.parts[0].cup_length

    @property
    def found(self) -> Mapping[str, ParameterEstimate]:
        """Estimates jointly with K and P, by parameter."""
        return self.estimates.found

    @property
    def cup(self) -> cup_package.Cup:
        """K, P, length and relaxation."""
        return conversion.cup_of(self.cup_values())

    def cup_values(self) -> Values:
        """Return the parameters of the run with the cup, and the estimates of the cell."""
        return self.values.replaced({
            'cup.length': self.cup_length,
            **{name: checks.validate(name, value) for name, (value, *_) in self.found.items()},
            **{TERMS[name].parameter: TERMS[name].to_parameter(term)
               for name, term in terms_of(
                   self.fit, conversion.one_cup_of(self.values)).items()}})

    def parameters(self, with_cell: bool = False) -> dict[str, Any]:
        """
        Return the parameters of the cup file: all terms, with standard errors and validity.

        Without a cell file, the length is corrected such that the package has the pose of the fit
        with the given centre of mass and marker.
        """
        found = self.cup_values()
        values = {term.parameter: found[term.parameter] for term in TERMS.values()}
        if not with_cell and self.recordings and self.found:
            free = {name: rows[0] for name, rows in self.fit.nuisances.items()}
            own = ~np.array(self.recordings[0].settings.moves_with_com)
            values['cup.length'] += float(
                free.get('package_marker', np.zeros(3))[2] - (own * com_change(self.fit))[2])
        errors: dict[str, Any] = {
            f'cup.{name}': tuple(np.minimum(getattr(self.fit, name), UNKNOWN_STD).ravel().tolist())
            for name in ('stiffness_std', 'damping_std')}
        length = self.found.get('cup.length')
        if length and np.isfinite(length.std):
            errors['cup.length_std'] = min(float(np.squeeze(length.std)), 1.0)
        return {**values, **errors, **self.envelope.parameters()}

    def cell_parameters(self) -> dict[str, Any]:
        """Return the parameters of the cell file: the given cell and package, and estimates."""
        given = {
            name: value for name, value in self.values.items()
            if name.startswith(CELL_PREFIXES) and value != table.PARAMETERS[name].default
            and name not in ('package.files', 'recording.start', 'recording.end')}
        if 'package/camera_info' in self.remappings:
            given['measured.type'] = 'detections'
        found = {name: each for name, each in self.found.items() if name != 'cup.length'}
        errors = {
            f'{name}_std': std for name, (_, std, _) in found.items()
            if f'{name}_std' in table.PARAMETERS}
        for name, whole in (('measured.offset', 'measured.marker_std'),
                            ('recording.package_world', 'measured.camera_std')):
            if name in found:
                errors[whole] = np.max(np.split(found[name][1], 2), axis=1)
        errors = {name: np.minimum(std, table.PARAMETERS[name].maximum or np.inf).tolist()
                  for name, std in errors.items()}  # unidentifiable quantities have infinite ones
        if 'measured.offset' in found:  # the pose of the tag is relative to the com
            given |= {'recording.package_frame': 'com', 'recording.align_at_rest': False}
        return {**given, **{name: value for name, (value, *_) in found.items()}, **errors}

    @property
    def remappings(self) -> dict[str, str]:
        """Recorded topics by input of the node."""
        topics = self.values.topics
        inputs = {'tool_arm/pose': topics.tool_pose}
        if self.values.measured.type != 'tf':
            inputs['package/measured'] = topics.package_pose
        if self.recordings:
            camera = self.recordings[0].report.package.recorded
            inputs['package/camera_info'] = camera.calibration
        return {name: topic for name, topic in inputs.items() if topic}

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on the cup in addition to K and P, without warnings."""
        return tuple(text_of(each) for each in self.findings if each.level == Level.OK)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on clocks, estimates, and changed given quantities."""
        return (*offset_findings(zip(self.bags, self.estimates.delays, strict=False)),
                *(estimate_finding(name, *self.found[name]) for name in self.estimates.asked),
                *self.verdict.corrections)

    @property
    def outside_cup_file(self) -> list[str]:
        """Changed and requested quantities that only the cell file contains."""
        changed = [change.parameter for change in self.verdict.changes]
        return [name for name in dict.fromkeys([*self.estimates.asked, *changed])
                if name in self.found and name != 'cup.length']

    def _fit_warnings(self) -> tuple[str, ...]:
        """Return the warnings of the fit and its equations, unless detected faults cause them."""
        causes = self.verdict.causing[:1]
        if self.verdict.faults or any(cause.material for cause in causes):
            return ()
        is_explained = any(cause.certain for cause in causes)
        findings = () if self.fit.usable and self.verdict.refusals else self.fit.findings
        misfit = [self.fit.misfit] if self.fit.misfit and not is_explained else []
        return tuple(map(text_of, (*findings, *misfit)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings: about the input, the fit, the recordings."""
        left_out = [Finding('left_out', Level.WARN, {
            'part': f"Recording '{bag}'", 'reason': reason}) for bag, reason in self.failed]
        remarks = [remark for part in self.parts for remark in part.remarks]
        return (*map(text_of, left_out), *self.assumed, *self._fit_warnings(),
                *warnings(self.findings), *map(text_of, remarks))

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return results.plain_items({
            **fit_json(self.fit),
            'time_offsets': [offset.value for offset in self.estimates.delays],
            'time_offsets_std': [offset.std for offset in self.estimates.delays],
            'warnings': self.warnings,
            'findings': [*map(entry, self.findings)],
            'cup_length': self.cup_length,
            'found_parameters': {
                name: {'value': value, 'std': std}
                for name, (value, std, _) in self.found.items()},
            'usable': self.succeeded,
            'refusals': self.refusals,
            'verdict': verdict_json(self.verdict),
            'recordings': [part.report for part in self.parts],
            'envelope': self.envelope,
            'settings': dict(self.values),
            'provenance': {
                'recordings': [{'path': each.name, 'files': each.files} for each in self.parts],
                'versions': results.versions()},
            'failed': [{'bag': bag, 'error': reason} for bag, reason in self.failed],
            'version': __version__})

    @property
    def succeeded(self) -> bool:
        """Whether the cup is usable."""
        return not self.refusals

    @property
    def refusals(self) -> tuple[str, ...]:
        """Reasons to reject the cup; empty for a usable one."""
        reasons = self.verdict.refusals
        if not (reasons or self.fit.usable):
            why = ('this cup cannot hold a package' if self.fit.converged else
                   'the search did not converge')
            reasons = (Finding('unusable', Level.ERROR, {
                'name': 'what the warnings name', 'why': why}),)
        return tuple(map(text_of, reasons))

    def require_usable(self, force: bool = False) -> None:
        """Raise BellowsError for a rejected cup; with force, only for a cup unable to predict."""
        if not self.refusals or force and self.fit.usable:
            return
        sentences = [*map(text_of, self.verdict.cause), *self.refusals]
        if not self.fit.usable:
            sentences += [*self.assumed, *self._fit_warnings()]
        raise BellowsError(' '.join(sentences))

    def header(self) -> list[str]:
        """Return the lines at the top of the cup file: the origin of its numbers."""
        fit = self.fit
        is_unknown = np.isinf(np.diag(fit.covariance))
        unknown = [label for label, each in zip(fit.labels, is_unknown, strict=True) if each]
        return [
            f'Identified by bellows_ros {__version__} from {", ".join(self.bags)}',
            f'{fit.method}, {fit.structure}; {fit.samples_used} samples used, '
            f'{fit.samples_rejected} rejected, condition number {fit.condition_number:.3g}.',
            *map(text_of, self.findings),
            *(f'Not identifiable, as given: {label}.' for label in unknown),
            *(f'REFUSED, but written all the same: {reason}' for reason in self.refusals)]


def save(
    result: Identification, parameters_path: File | None, json_path: File | None,
    force: bool = False, cell_path: File | None = None,
) -> None:
    """
    Write the cup file, the JSON file and the cell file, unless None or ''.

    With force the file of a rejected cup is also written, with a note in its header.

    Raises
    ------
    BellowsError
        If a file cannot be written, or the cup is rejected. The JSON file is also written for a
        rejected cup, the others are not.

    """
    if json_path:
        results.write_json(json_path, result)
    for path, parameters in (
            (parameters_path, partial(result.parameters, bool(cell_path))),
            (cell_path, result.cell_parameters)):
        if path:
            result.require_usable(force)
            parameter_files.write_parameters(path, parameters(), result.header())


def verdict_json(verdict: FitVerdict) -> dict[str, Any]:
    """Return the JSON content on the verdict."""
    return {
        'free_simulations': verdict.simulated,
        'excess': verdict.excess,
        'hypotheses': [
            {**results.attributes(each, 'name', 'value', 'share', 'certain', 'material'),
             **entry(cause_finding(each, verdict.given))} for each in verdict.causing]}


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return the JSON content on a fit."""
    exact = fit.exactly_given
    return {
        **results.attributes(
            fit, 'method', 'structure', 'stiffness', 'damping', 'stiffness_std', 'damping_std',
            'samples_used', 'samples_rejected', 'condition_number', 'usable', 'residual_rms',
            'chi2', 'robust_chi2', 'converged'),
        **fit.law, **{f'{name}_std': std for name, std in fit.law_std.items()},
        'with_exactly_given': results.attributes(exact, 'stiffness_std', 'damping_std'),
        'parameters': {
            'labels': fit.labels, 'covariance': fit.covariance,
            'covariance_from_given': fit.from_given}}
