"""Quality of a cup, causes of a misfit, and the acceptance of the cup."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import causes, methods
from bellows_ros.core.identification.output_error import HELD_OUT
from bellows_ros.core.identification.quantities import as_found, Free, given_std, payload_of
from bellows_ros.core.identification.result import Fit, POSE_UNITS
from bellows_ros.core.identification.validation import MAX_NRMSE, validate
from bellows_ros.core.model.cup_package import Cup, gripper_of
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.parameters.conversion import given_structure
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError, UnstableError
from bellows_ros.report.sentences import finding_sentence, setting_of, texts
import numpy as np

MAX_TESTED = 3
"""Largest number of tested recordings; more give no further information."""

MAX_SIMULATED = 50_000
"""Largest number of samples of a recording simulated freely for the verdict."""

UNEXPLAINED = 0.2
"""Largest unexplained fraction of the motion in an axis."""

DRAWS, SIGMAS = 5, 3.0
"""Number of cups drawn by the standard errors, and number of allowed standard deviations."""

LOCAL = frozenset({'com', 'length', 'package_marker', 'time_offset', 'package_world'})
"""Quantities that recordings separate from K and P, unlike mass and inertia, which scale with K
and P."""


CLOCK_RATE = 'rate of the clocks (ppm)'
MAX_PULL = 5.0
"""Largest change of centre of mass or length by a fit, standard deviations: a cup that deviates
from the model appears longer."""


class Simulated(NamedTuple):
    """A recording simulated freely with the cup: RMS errors, noise and motion (6,), m and rad."""

    bag: str
    rms: Array
    noise: Array
    motion: Array
    unexplained: tuple[str, ...]
    beginning: float = 0.0
    """Duration of the simulated beginning of a long recording, s; 0 for a whole recording."""
    uncertainty: Array | float = 0.0
    """RMS errors (6,) explained by the standard errors of K and P."""
    all_identifiable: bool = True
    """Whether all entries of K and P are identifiable."""
    held_out: Array | float = 0.0
    """RMS errors (6,) in the last fifth with the cup of the other four, m and rad."""

    @property
    def unpredicted(self) -> list[str]:
        """Axes with a held-out error beyond three times the noise and beyond `MAX_NRMSE`."""
        largest = np.maximum(3.0 * self.noise, MAX_NRMSE * self.motion)
        return [AXES[i] for i in np.flatnonzero(self.held_out > largest)]

    @property
    def largest(self) -> Array:
        """Largest RMS errors (6,) explained by noise and the standard errors of K and P."""
        allowed = np.hypot(
            methods.MAX_MISFIT_TO_NOISE * self.noise, SIGMAS * np.asarray(self.uncertainty))
        if not self.all_identifiable:
            return np.asarray(allowed)
        return np.asarray(np.minimum(allowed, np.maximum(
            3.0 * self.noise, 0.01 * self.motion)))

    @property
    def sentence(self) -> str:
        """The accuracy of the cup."""
        if not np.isfinite(self.rms).all():
            return f'{self.bag} cannot be simulated freely with this cup.'
        parts = []
        for kind in (slice(0, 3), slice(3, 6)):
            rms, noise = (DISPLAY_FACTORS[kind] * each[kind] for each in (self.rms, self.noise))
            errors = ', '.join(
                f'{name} {x:.2g}' for name, x in zip(AXES[kind], rms, strict=True))
            parts.append(f'{errors} {DISPLAY_UNITS[kind.start]} '
                         f'(noise {", ".join(f"{x:.2g}" for x in noise)})')
        what = f'{self.beginning:.0f} s of {self.bag}' if self.beginning else self.bag
        return f'Free simulation of {what} with this cup: RMS error {"; ".join(parts)}.'

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        return {**self._asdict(), 'axes': AXES, 'units': {
            **dict.fromkeys(('noise', 'uncertainty', 'held_out'), POSE_UNITS), 'beginning': 's'}}


class FitVerdict(NamedTuple):
    """
    Free simulations of recordings of the fit, and deviations from given quantities.

    A cup of output error is rejected for a misfit by its robust chi^2 per degree of freedom, which
    is None for other methods.
    """

    simulated: tuple[Simulated, ...]
    diagnosis: causes.Diagnosis
    given: Values
    chi2: float | None = None
    expected: Free = MappingProxyType({})
    """Standard deviations, SI units, of given quantities that output error may correct jointly
    with K and P."""
    log_inertia_ratio: float = 0.0
    """Logarithm of the ratio of inertia and mass as estimated by the fit, relative to the given
    ratio."""
    found: Mapping[str, tuple[Array, str, float]] = MappingProxyType({})
    """
    Significantly changed parameters of package and cup: value by the fit, change, and change in
    standard deviations; the largest change first.
    """

    @property
    def wrong(self) -> list[causes.Finding]:
        """Findings that reject a cup: certain ones, and likely ones that change K materially."""
        return [finding for finding in self.causing if finding.datum and (
            finding.certain
            or self.chi2 is not None and finding.name in LOCAL
            and finding.likely and finding.moved > causes.MATERIAL
            and not _is_within(finding, self.expected))]

    @property
    def causing(self) -> list[causes.Finding]:
        """Causes, the likeliest first, followed by deviations within expectation."""
        alone = self.diagnosis.findings
        first = alone if alone and alone[0].is_fact else alone[:1]
        findings = [*first, *self.diagnosis.besides]
        if not all(finding.certain for finding in findings):
            return findings
        return sorted(findings, key=lambda finding: _is_within(finding, self.expected))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the likeliest cause, if any, and on the quality of the cup."""
        return (*self.cause, *self.doubts, *(simulated.sentence for simulated in self.simulated))

    @property
    def is_at_noise(self) -> bool:
        """Whether free simulations are as accurate as the poses."""
        return bool(self.simulated) and all(
            # as accurate as noise
            (simulated.rms <= 1.1 * simulated.noise).all() for simulated in self.simulated)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Sentences on corrections by the fit that may be due to a wrong mass."""
        sentences = []
        if abs(self.log_inertia_ratio) >= causes.MATERIAL:
            sentences.append(
                f'package.inertia is {np.exp(-self.log_inertia_ratio):.3g} times the value '
                'consistent with package.mass, and the fit has corrected the inertia. If the mass '
                'is wrong instead, K and P are off by that factor: weigh the package.')
        if self.found:
            found = ', '.join(
                f'{name} [{", ".join(f"{x:.4g}" for x in value)}] (given {off} off)'
                for name, (value, off, _) in self.found.items())
            sentences.append(f'Found with K and P: {found}. Predictions of this package need '
                             'these values, too.')
        return () if self.refusals else tuple(sentences)

    @property
    def cause(self) -> tuple[str, ...]:
        """Sentences about the main cause and further ones, if any."""
        if not self.diagnosis.findings:
            return ()
        first, *others = self.causing
        if first.name == 'unknown':
            return self._unknown(first, others)
        besides = [f'Besides{"" if finding.certain else ", likely"}: '
                   f'{finding_sentence(finding, self.given)}' for finding in others]
        if first.is_fact and not others:
            besides.append('More may be wrong: correct this, and run it again.')
        if first.certain:
            return (finding_sentence(first, self.given), *besides)
        if self.is_at_noise:
            return ()
        if self.given.get('fit.relaxation') == 'off':
            besides.append('Rubber that relaxes may be the cause, too: set fit.relaxation: auto.')
        if first.likely:
            return (f'Likely, but not certain: {finding_sentence(first, self.given)}',
                    *besides)
        if self.diagnosis.excess < causes.DOUBTED:
            return ()
        return ('Noise does not explain the residuals, and no tested cause explains most of '
                'them: check the list in the JSON file, and the given values.' + (
                    ' recording.align_at_rest supposes one world for both bodies: if they may be '
                    'in two, set recording.package_world: estimate.'
                    if self.given.get('recording.align_at_rest') else ''),)

    def _unknown(
        self, residual: causes.Finding, candidates: Sequence[causes.Finding]
    ) -> tuple[str, ...]:
        """Return the sentence on an unknown cause, and the likeliest settings without a claim."""
        if self.is_at_noise:
            return ()
        settings = dict.fromkeys(setting_of(finding) for finding in candidates)
        return (finding_sentence(residual, self.given), *(
            [f'Likeliest, but not certain: {" or ".join(settings)}.'] if settings else []))

    @property
    def refusals(self) -> tuple[str, ...]:
        """Reasons to reject the cup; empty for a usable one."""
        reasons = []
        for simulated in self.simulated:
            if simulated.unexplained:
                reasons.append(
                    f'{simulated.bag}: more than {100.0 * UNEXPLAINED:g} % of the motion is '
                    f'unexplained in {", ".join(simulated.unexplained)}.')
            elif self.chi2 is not None and (simulated.rms > simulated.largest).any():
                ratio = np.max(simulated.rms / simulated.noise)
                reasons.append(
                    f'{simulated.bag}: the free simulation is off by up to {ratio:.1f} times the '
                    'noise, more than the standard errors of K and P allow, so model or data are '
                    'wrong. Check package.mass, package.com, package.inertia and the frames, or '
                    'use a richer fit.structure.')
            elif simulated.unpredicted:
                reasons.append(
                    f'{simulated.bag}: with the cup of the first four fifths, the last fifth is '
                    f'predicted worse than {100.0 * MAX_NRMSE:g} % of the motion and three times '
                    f'the noise in {", ".join(simulated.unpredicted)}, so model or data are '
                    'wrong, or change during the recording.')
        if self.simulated and not reasons and self.chi2 is not None and (
                self.chi2 > methods.MAX_MISFIT_TO_NOISE**2):
            reasons.append(
                f'What the fit leaves of each pose is {np.sqrt(self.chi2):.1f} times the noise '
                f'(chi^2 per degree of freedom {self.chi2:.3g}): K and P are not those of the '
                'lowest minimum, or model or data are wrong. Start from another cup.stiffness, or '
                'use a simpler fit.structure.')
        for name, (_, off, pull) in self.found.items():
            if pull > MAX_PULL and name not in ('package.inertia', CLOCK_RATE) and not (
                    self.wrong or reasons):
                reasons.append(
                    f'{name} would be {off} off, {pull:.2g} times its standard deviation. Measure '
                    f'it again, set {name}_std if it is so uncertain, or try fit.structure: full.')
        for finding in self.wrong[:1]:
            line = 'first line says' if finding is self.causing[0] else 'lines above say'
            reasons.append(f'Correct {setting_of(finding)} as the {line}, and fit again.')
        return tuple(reasons)

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        return {
            'free_simulations': self.simulated,
            'excess': self.diagnosis.excess,
            'hypotheses': [
                {**finding._asdict(), 'material': finding.material,
                 'setting': setting_of(finding),
                 'sentence': finding_sentence(finding, self.given),
                 'units': dict.fromkeys(
                     ('theta', 'std'), texts('causes').get(f'{finding.name}.units', '1'))}
                for finding in (*self.diagnosis.findings, *self.diagnosis.besides)],
            'besides': len(self.diagnosis.besides)}


def _is_within(finding: causes.Finding, std: Free) -> bool:
    """Return whether a cause is within three standard deviations of the given value."""
    if finding.name not in std or not len(finding.theta):
        return False
    limit = SIGMAS * std[finding.name]
    return bool(np.all(np.abs(finding.theta.reshape(-1, len(limit))) <= limit))


def verdict_of(
    fit: Fit | None, recordings: Sequence[Recording], length: float, values: Values,
) -> FitVerdict | None:
    """
    Return the verdict on a fit from some of its recordings, None without any.

    Parameters
    ----------
    fit : Fit or None
        K and P; None for a search of causes alone.
    recordings : sequence of Recording
        Recordings of the fit.
    length : float
        Length of the cup, m.
    values : mapping
        Parameters by name.

    """
    tested = recordings[:MAX_TESTED]
    if not tested:
        return None
    package = tested[0].payload
    given = values.replaced({
        'package.mass': package.mass, 'package.com': package.com,
        'package.inertia': np.diag(package.inertia)})
    simulated = values.replaced({'cup.length': length, 'fit.method': 'output_error'})
    verdict = FitVerdict((), causes.Diagnosis(0.0, ()), given)
    if fit is not None:
        verdict = _judged(verdict, fit, tested, length, values)
    if facts := causes.facts(tested, length):
        besides: tuple[causes.Finding, ...] = ()
        right = [causes.corrected(each)[1] for each in tested]
        with suppress(BellowsError):  # the fault cannot be corrected
            besides = methods.fitted(right, simulated).causes
        return verdict._replace(diagnosis=causes.Diagnosis(np.inf, facts, tuple(
            cause for cause in besides if cause.likely and all(
                cause.name not in (fact.name, fact.instead) for fact in facts))))
    if fit is None or fit.method != 'output_error':
        if verdict.is_at_noise:
            return verdict
        fit = methods.fitted(tested, simulated, exactly=True)
    excess = max(fit.chi2 or 1.0, fit.robust_chi2 or 1.0) - 1.0
    return verdict._replace(
        diagnosis=causes.Diagnosis(excess, fit.causes[:1], fit.causes[1:]))


def _judged(
    verdict: FitVerdict, fit: Fit, tested: Sequence[Recording], length: float, values: Values
) -> FitVerdict:
    """Return a verdict with free simulations of recordings, and with the corrections of a fit."""
    log_inertia_ratio = float(  # one of the three moments may be uncertain
        np.median(fit.nuisances['inertia']) - np.mean(fit.nuisances.get('mass', 0.0))) if (
        'inertia' in fit.nuisances) else 0.0
    length += float(fit.nuisances['length'][0, 0]) if 'length' in fit.nuisances else 0.0
    structure = given_structure(verdict.given)
    cup = gripper_of(Cup(
        fit.stiffness, fit.damping, length, fit.relaxation, stretch=fit.stretch), structure.places)
    others = [] if fit.robust_chi2 is None else _drawn(fit, cup, structure)
    held = None if fit.held_out is None else _cup_of(fit, fit.held_out, cup, structure)
    return verdict._replace(
        simulated=tuple(
            _simulated(cup, as_found(recording, fit.nuisances, number), others,
                       fit.noise_in_motion.get(number), held)._replace(
                           all_identifiable=bool(np.all(np.isfinite(np.diag(fit.covariance)))))
            for number, recording in enumerate(tested) if fit.usable),
        chi2=fit.robust_chi2, log_inertia_ratio=log_inertia_ratio,
        expected={name: std for name, std in given_std(values).items() if name in LOCAL},
        found=_found(fit, values, tested[0], length))


def _found(
    fit: Fit, values: Values, recording: Recording, length: float
) -> Mapping[str, tuple[Array, str, float]]:
    """Return `FitVerdict.found` of a converged fit; length in m."""
    if not fit.converged:
        return {}
    std, free = given_std(values), {name: rows[0] for name, rows in fit.nuisances.items()
                                    if name != 'exposure' or rows[0, 0] > 0.0}
    found, rate_hz = payload_of(recording.payload, free), recording.report.package.timing.rate_hz
    parameters = {
        'com': ('package.com', found.com), 'length': ('cup.length', np.array([length])),
        'inertia': ('package.inertia', found.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]),
        'clock_rate': (CLOCK_RATE, 1e6 * free.get('clock_rate', np.zeros(1))),
        'exposure': (
            'exposure of the camera (ms)',
            1e3 / rate_hz * np.sqrt(free.get('exposure', np.zeros(1))))}
    pulls = {name: float(np.max(np.abs(free[name]) / std[name]))
             for name in parameters if name in free and name in std}
    if max(pulls.values(), default=0.0) <= 0.5:  # standard deviations
        return {}
    changes = {name: f'{1e3 * np.linalg.norm(free[name]):.2g} mm' for name in pulls}
    if 'inertia' in pulls:
        changes['inertia'] = f'{100.0 * np.max(np.abs(np.expm1(free["inertia"]))):.2g} %'
    changes |= {name: f'{abs(parameters[name][1][0]):.2g} {unit}' for name, unit in (
        ('clock_rate', 'ppm'), ('exposure', 'ms')) if name in pulls}
    return {parameters[name][0]: (parameters[name][1], changes[name], pulls[name])
            for name in sorted(pulls, key=pulls.__getitem__, reverse=True)}


def _drawn(fit: Fit, cup: Cup, structure: Structure) -> list[Cup]:
    """Return cups with K and P drawn from the covariance of a fit, or widely without a fit."""
    finite, rng = np.isfinite(np.diag(fit.covariance)), np.random.default_rng(0)
    if not finite.any():
        return []
    thetas = fit.parameters * np.where(
        finite, 1.0, np.exp(rng.standard_normal((DRAWS, len(finite)))))
    thetas[:, finite] = rng.multivariate_normal(
        fit.parameters[finite], fit.covariance[np.ix_(finite, finite)], DRAWS, method='eigh')
    cups = (_cup_of(fit, theta, cup, structure) for theta in thetas)
    return [each for each in cups if each]


def _cup_of(fit: Fit, theta: Array, cup: Cup, structure: Structure) -> Cup | None:
    """Return a cup with other parameters (p,), None if indefinite."""
    K, P = structure.matrices(theta)
    if min(np.linalg.eigvalsh(K)[0], np.linalg.eigvalsh(P)[0]) <= 0.0:
        return None
    return gripper_of(
        Cup(K, P, cup.length, fit.relaxation, stretch=fit.stretch), structure.places)


def _simulated(
    cup: Cup, recording: Recording, others: Sequence[Cup] = (),
    noise_in_motion: Array | None = None, held: Cup | None = None,
) -> Simulated:
    """Return a free simulation of a recording; a failed simulation explains no motion."""
    if recording.pose_errors and noise_in_motion is not None:
        recording, noise_in_motion = recording.with_noise(noise_in_motion), None
    try:
        result = validate(cup, recording, MAX_SIMULATED)
        beyond = result.moves & ~(result.model_error <= UNEXPLAINED)
    except UnstableError:
        unknown = np.full(6, np.nan)
        return Simulated(recording.name, unknown, unknown, unknown, AXES)
    changes = []
    for other in others:
        with suppress(UnstableError):
            changes.append(validate(other, recording, MAX_SIMULATED).predicted - result.predicted)
    seconds = float(np.ptp(result.stamps_ns)) / NS_PER_S
    noise = result.noise
    if noise_in_motion is not None:
        noise = np.sqrt(noise**2 + np.maximum(
            noise_in_motion**2 - recording.body_noise[1].std**2, 0.0))
    return Simulated(
        recording.name, result.scores.rms, noise, result.scores.motion,
        tuple(AXES[i] for i in np.flatnonzero(beyond)),
        seconds if len(recording.valid) > MAX_SIMULATED else 0.0,
        np.sqrt(np.nanmean(np.square(changes), axis=(0, 1))) if changes else 0.0,
        held_out=_held_out(held, recording) if held else 0.0)


def _held_out(cup: Cup, recording: Recording) -> Array:
    """Return the RMS errors (6,) of a free simulation in the last fifth, m and rad."""
    try:
        result = validate(cup, recording, MAX_SIMULATED)
    except UnstableError:
        return np.full(6, np.inf)
    first, last = result.stamps_ns[[0, -1]]
    return result.select(result.stamps_ns > last - (last - first) // HELD_OUT).scores.rms
