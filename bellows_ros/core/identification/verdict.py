"""Quality of a cup, causes of a misfit, and the acceptance of the cup."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
import math
from operator import attrgetter
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import fitting
from bellows_ros.core.identification.estimate import MAX_NOISE_CHI2
from bellows_ros.core.identification.fitting import HELD_OUT
from bellows_ros.core.identification.result import Cause, Fit, MAJORITY
from bellows_ros.core.identification.unknowns import as_found, given_std
from bellows_ros.core.identification.validation import (
    corner_scores,
    MAX_NRMSE,
    validate,
    Validation,
)
from bellows_ros.core.model.cup_package import Cup, gripper_of
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.parameters.conversion import given_structure, one_cup_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording import alignment
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.errors import UnstableError
import numpy as np

MAX_TESTED = 3
"""Largest number of tested recordings; more give no further information."""

MAX_NOISE = 1.1
"""Largest ratio of a free simulation's error to the noise of the poses, if there is no misfit."""

MAX_NOISE_RATIO = 3.0
"""Largest ratio of the held-out error to the noise, if the error also exceeds `MAX_NRMSE`."""

MAX_SOUND_RATIO = 2.0
"""Ratio of a free simulation's error to the noise above which the cause of a misfit is described:
recordings without faults, whose noise has a memory of 26 ms, have 1.06 to 1.33 (10 seeds)."""

MIN_INERTIA_RATIO = 0.05
"""Smallest logarithm of a corrected ratio of inertia and mass that makes the mass doubtful: the
usual standard deviation of an inertia by CAD."""

SIGMAS = 3.0
"""Number of stated standard deviations beyond which an estimate is a finding of its own."""


def _percents(change: Array) -> str:
    """Return the largest of some changes, logarithms of factors, as a sentence's number."""
    return f'{100.0 * np.max(np.abs(np.expm1(change))):.2g} %'


def _millimetres(change: Array) -> str:
    """Return the length of a change (n,), m, as a sentence's number."""
    return f'{1e3 * np.linalg.norm(change):.2g} mm'


def _shift_and_angle(change: Array) -> str:
    """Return the change (6,) of a frame, m and rad, as a sentence's numbers."""
    return (f'{_millimetres(change[:3])} and '
            f'{math.degrees(float(np.linalg.norm(change[3:]))):.2g} degrees')


CHANGED: Mapping[str, tuple[str, str, Callable[[Array], str]]] = {
    'com': ('package.com', 'package.com_std', _millimetres),
    'length': ('cup.length', 'cup.length_std', _millimetres),
    'mass': ('package.mass', 'package.mass_std', _percents),
    'inertia': ('package.inertia', 'package.inertia_std', _percents),
    'package_marker': ('measured.offset', 'recording.marker_std', _shift_and_angle),
    'time_offset': ('measured.latency', 'recording.clock_std', lambda change: (
        f'{1e3 * abs(change[0]):.2g} ms'))}
"""Given quantities that a fit may change: parameter, its standard deviation, size in words."""


class Simulated(NamedTuple):
    """
    A recording simulated freely with the cup: RMS errors, noise and motion by axis, m and rad.

    A tag is rated by its corners alone, rad, as in a replay.
    """

    bag: str
    rms: Array
    noise: Array
    motion: Array
    held_out: Array | None = None
    """RMS errors in the last fifth with the cup of the other four, if known."""
    axes: tuple[str, ...] = AXES

    @property
    def is_at_noise(self) -> bool:
        """Whether the simulation is as accurate as the poses."""
        return bool((self.rms <= MAX_NOISE * self.noise).all())

    @property
    def unpredicted(self) -> list[str]:
        """Axes with an error beyond three times the noise and 5 % of the motion, held out."""
        error = self.rms if self.held_out is None else self.held_out
        within = error <= np.maximum(MAX_NOISE_RATIO * self.noise, MAX_NRMSE * self.motion)
        return [self.axes[i] for i in np.flatnonzero(~within)]


class Change(NamedTuple):
    """A given quantity that a fit changed beyond the estimate's own error, by its parameter."""

    parameter: str
    off: str
    """Size of the change in words, with units."""
    pull: float
    """Size of the change in stated standard deviations of the given value."""
    std: str
    """Parameter with this standard deviation."""


class FitVerdict(NamedTuple):
    """
    Free simulations of recordings of the fit, and deviations from given quantities.

    A definite cup of a converged search is rejected for a held-out error, for a cause without
    which K is wrong, or for given values that it contradicts without a certain cause.
    """

    simulated: tuple[Simulated, ...]
    """Errors of the free simulations with a usable cup."""
    causing: tuple[Cause, ...]
    """Causes of a misfit, the likeliest first."""
    given: Values
    excess: float = 0.0
    """Chi² beyond noise, over the chi² expected of noise."""
    faults: tuple[Any, ...] = ()
    """Faults of the recordings that were accepted."""
    sensor: tuple[Any, ...] = ()
    """Findings on poses that seem to be of another kind of sensor than stated."""
    log_inertia_ratio: float = 0.0
    """Logarithm of the ratio of inertia and mass as estimated by the fit, relative to the given
    ratio."""
    changes: tuple[Change, ...] = ()
    """Changed given quantities, the largest change in stated standard deviations first."""
    simulations: tuple[Validation, ...] = ()
    """Free simulations with a definite cup that do not diverge."""

    @property
    def wrong(self) -> list[Cause]:
        """The likeliest cause, if the cup is wrong without it."""
        return [each for each in self._likely[:1] if each.material]

    @property
    def contradicted(self) -> list[Finding]:
        """Given values beyond their stated errors, if no single cause explains the deviations."""
        is_open = self.causing and not self.causing[0].certain and (
            self.causing[0].name != 'unknown' or self._is_misfit)
        wrong = [change for change in self.changes if change.pull > SIGMAS and (
            change.parameter.startswith(('package.', 'cup.')))]
        return [off_given(change, Level.ERROR) for change in wrong] if is_open else []

    @property
    def _is_misfit(self) -> bool:
        """Whether chi² or a free simulation exceeds the errors of recordings without faults."""
        return self.excess > MAX_NOISE_CHI2 - 1.0 or any(
            (each.rms > MAX_SOUND_RATIO * each.noise).any() for each in self.simulated)

    @property
    def is_at_noise(self) -> bool:
        """Whether free simulations are as accurate as the poses."""
        return bool(self.simulated) and all(each.is_at_noise for each in self.simulated)

    @property
    def corrections(self) -> tuple[Finding, ...]:
        """Findings on given quantities that the fit of an accepted cup changed."""
        if self.refusals:
            return ()
        found = []
        if abs(self.log_inertia_ratio) >= MIN_INERTIA_RATIO:
            found.append(Finding('doubtful_mass', Level.WARN, {
                'factor': math.exp(-self.log_inertia_ratio)}))
        return (*found, *(off_given(change, Level.WARN if change.pull > SIGMAS else Level.OK)
                          for change in self.changes))

    @property
    def cause(self) -> tuple[Any, ...]:
        """Findings on the main cause and further ones, if any."""
        if self.faults:
            return self.faults
        if not self.causing:
            return ()
        first = cause_finding(self.causing[0], self.given)
        if self.causing[0].certain:
            return (first,)
        if self._is_sound:
            return ()
        found = self.sensor
        if not found and self.causing[0].name == 'unknown':
            found = (first,)
        if not self._likely:
            return found
        named = tuple(cause_finding(each, self.given) for each in self._likely)
        return (*found, Finding('likeliest', Level.WARN, {'causes': named}))

    @property
    def _likely(self) -> list[Cause]:
        """Causes with a name, the likeliest first."""
        return [each for each in self.causing if each.name != 'unknown']

    @property
    def _is_sound(self) -> bool:
        """Whether uncertain causes are not worth a sentence: the cup predicts its recordings."""
        if self.contradicted or self.wrong:
            return False
        if self.is_at_noise:
            return True
        has_major_cause = bool(self._likely) and self._likely[0].share >= MAJORITY
        is_accepted = bool(self.simulated) and not self.refusals
        return is_accepted and not has_major_cause and not self._is_misfit

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """Reasons to reject the cup; empty for a usable one."""
        reasons = [Finding('not_predicted', Level.ERROR, {
            'bag': simulated.bag, 'limit': MAX_NRMSE, 'axes': ', '.join(simulated.unpredicted)})
            for simulated in self.simulated if simulated.unpredicted]
        reasons += self.contradicted
        if self.faults or self.wrong:
            reasons.append(Finding('wrong_data', Level.ERROR, {
                'corrected': tuple(cause_finding(each, self.given) for each in self.wrong)}))
        return tuple(reasons)


UNTESTED = FitVerdict((), (), Values({}))
"""Verdict without a recording."""


def verdict_of(
    fit: Fit, recordings: Sequence[Recording], length: float, values: Values,
) -> FitVerdict:
    """
    Return the verdict on a fit from some of its recordings, `UNTESTED` without any.

    Parameters
    ----------
    fit : Fit
        K and P.
    recordings : sequence of Recording
        Recordings of the fit.
    length : float
        Length of the cup, m.
    values : mapping
        Parameters by name.

    """
    if not (tested := recordings[:MAX_TESTED]):
        return UNTESTED
    remarks = [remark for recording in tested for remark in recording.report.remarks]
    package, length_change = tested[0].payload, fit.nuisances.get('length', np.zeros((1, 1)))
    given = values.replaced({
        'package.mass': package.mass, 'package.com': package.com,
        'package.inertia': np.diag(package.inertia)})
    ratings, simulations = _all_simulated(fit, tested, length + float(length_change[0, 0]), given)
    verdict = FitVerdict(
        tuple(ratings) if fit.usable else (), (), given, simulations=tuple(simulations),
        faults=tuple(remark for remark in remarks if remark.level == Level.ERROR),
        sensor=tuple(remark for remark in remarks if remark.code == 'sensor')[:1],
        log_inertia_ratio=_log_inertia_ratio(fit),
        changes=_changes(fit, values))
    if verdict.faults:
        return verdict
    if fit.method != 'output_error':
        are_sound = [(each.rms <= MAX_SOUND_RATIO * each.noise).all()
                     for each in verdict.simulated]
        if are_sound and all(are_sound):
            return verdict  # its causes would not be described
        fit = fitting.fitted(tested, values.replaced({
            'cup.length': length, 'fit.method': 'output_error'}), exactly=True)
    excess = max(fit.chi2 or 1.0, fit.robust_chi2 or 1.0) - 1.0
    return verdict._replace(excess=excess, causing=fit.causes)


def _log_inertia_ratio(fit: Fit) -> float:
    """Return `FitVerdict.log_inertia_ratio`; 0 if mass or inertia are requested."""
    if 'inertia' not in fit.nuisances or {'mass', 'inertia'} & {*fit.named}:
        return 0.0
    inertia = np.median(fit.nuisances['inertia'])  # one of the three moments may be uncertain
    return float(inertia - np.mean(fit.nuisances.get('mass', 0.0)))


def _all_simulated(
    fit: Fit, tested: Sequence[Recording], length: float, given: Values
) -> tuple[list[Simulated], list[Validation]]:
    """
    Simulate recordings freely with a definite cup of a length (m).

    The results are the errors in each recording, and the simulations that do not diverge.
    """
    ratings, simulations = list[Simulated](), list[Validation]()
    if fit.indefinite:
        return ratings, simulations
    structure = given_structure(given)
    cup = gripper_of(
        one_cup_of(given).with_terms({**fit.terms, 'length': length}), structure.places)
    held = None if fit.held_out is None else _cup_of(fit.held_out, cup, structure)
    for number, recording in enumerate(tested):
        recording = as_found(recording, fit.nuisances, number)
        noise_in_motion = fit.noise_in_motion.get(number)
        if recording.views and noise_in_motion is not None:
            recording = recording.with_noise(noise_in_motion)
        try:
            simulation = validate(cup, recording)
        except UnstableError:
            unknown = np.full(6, np.nan)
            ratings.append(Simulated(recording.name, unknown, unknown, unknown))
            continue
        simulations.append(simulation)
        held_out = _held_out(held, recording) if held else None
        ratings.append(_rating(simulation, noise_in_motion, held_out))
    return ratings, simulations


def off_given(change: Change, level: Level) -> Finding:
    """Return the finding on a changed quantity."""
    return Finding('off_given', level, {
        'off': change.off, 'pull': change.pull, 'std': change.std}, change.parameter)


def _changes(fit: Fit, values: Values) -> tuple[Change, ...]:
    """Return `FitVerdict.changes` of a converged fit."""
    found, given = list[Change](), given_std(values)
    if not fit.converged:
        return ()
    estimated = given.keys() & fit.nuisances.keys() - {*fit.named}
    for name, (parameter, std, off) in CHANGED.items():
        if name not in estimated:
            continue
        sizes, errors = np.abs(fit.nuisances[name]), fit.nuisances_std[name]
        if np.any(sizes > SIGMAS * errors):
            row = fit.nuisances[name][np.argmax(np.max(sizes / errors, axis=1))]
            pull = float(np.max(np.abs(row) / given[name]))
            found.append(Change(parameter, off(row), pull, std))
    return tuple(sorted(found, key=attrgetter('pull'), reverse=True))


def _cup_of(theta: Array, cup: Cup, structure: Structure) -> Cup | None:
    """Return a cup with other parameters (p,), None if indefinite."""
    K, P = structure.matrices(theta)
    if min(np.linalg.eigvalsh(K)[0], np.linalg.eigvalsh(P)[0]) <= 0.0:
        return None
    return gripper_of(replace(cup, stiffness=K, damping=P), structure.places)


def _rating(
    simulation: Validation, noise_in_motion: Array | None, held_out: Array | None
) -> Simulated:
    """Return the errors of a free simulation, with the noise (6,) of moving poses if known."""
    name = simulation.recording.name
    if corners := simulation.corners:
        rms, noise, motion = map(np.atleast_1d, (corners.rms, corners.noise, corners.motion))
        return Simulated(name, rms, noise, motion, held_out, ('corners',))
    noise = simulation.noise
    if noise_in_motion is not None:
        noise = np.sqrt(noise**2 + np.maximum(
            noise_in_motion**2 - simulation.recording.body_noise[1].std**2, 0.0))
    return Simulated(name, simulation.scores.rms, noise, simulation.scores.motion, held_out)


def _held_out(cup: Cup, recording: Recording) -> Array:
    """Return the RMS errors of a free simulation in the last fifth, of a tag in its corners."""
    try:
        result = validate(cup, recording)
    except UnstableError:
        return np.full(1 if recording.views else 6, np.inf)
    first, last = result.stamps_ns[[0, -1]]
    later = last - (last - first) // HELD_OUT
    if recording.views:
        seen = corner_scores(
            recording, result.package.select(result.package.stamps_ns > later))
        return np.atleast_1d(seen.rms if seen else 0.0)
    return result.select(result.stamps_ns > later).scores.rms


# ------------------------------------------------------------------------- causes as findings

SIDES = {'time_offset': ('earlier', 'later'), 'scale': ('large', 'small'),
         'length_drift': ('shortens', 'lengthens')}
"""Words for a number that is not positive, and for a positive one, by cause."""

CORRECTED: Mapping[str, tuple[str, str, float]] = {
    'com': ('package.com', 'mm', 1e3), 'length': ('cup.length', 'mm', 1e3),
    'inertia': ('package.inertia', '%', 1e2),
    'gravity': ('gravity.direction', 'degrees', math.degrees(1.0))}
"""Parameter that a cause corrects, with the unit of the correction and its number in SI units."""

Given = Mapping[str, Any]


def cause_finding(cause: Cause, given: Given) -> Finding:
    """Return a cause with its size, its share of the misfit, and given values corrected by it."""
    theta, std = cause.theta.tolist(), cause.std.tolist()
    name = cause.name.removesuffix('.direction')
    share = f' It explains {100.0 * cause.share:.0f} % of the misfit.' if (
        name != 'unknown' and cause.share > 0.0) else ''
    if name in ('com', 'length') and cause.instead:
        return Finding('length', Level.WARN, {'offset': abs(theta[-1])})
    if name in CORRECTED:
        return Finding('differs', Level.WARN, {
            'off': _off(name, cause), 'found': _corrected(cause, given), 'share': share},
            CORRECTED[name][0])
    numbers: dict[str, Any] = {'share': share}
    if theta:
        numbers |= {
            'first': theta[0], 'last': theta[-1], 'size': abs(theta[0]), 'std': std[0],
            'side': SIDES.get(name, ('', ''))[theta[0] > 0.0]}
    if name == 'exposure':
        numbers['size'] = body.EXPOSURE * math.sqrt(max(theta[0], 0.0))
    elif name == 'package_world':
        numbers['why'] = alignment.motion_words(cause.theta, cause.std)
    elif name == 'slip':
        numbers |= {'position': math.hypot(*theta[:2]), 'rotation': 0.0, 'at': theta[-1]}
    elif name == 'package_marker':
        shift, angle = map(np.linalg.norm, np.split(cause.theta, [len(theta) - 3]))
        numbers |= {'shift': float(shift), 'angle': float(angle)}
    elif name == 'unknown':
        is_band = bool(np.all(np.isfinite(theta[2:4])))
        numbers |= {'axis': cause.value, 'second': theta[min(1, len(theta) - 1)], 'band': (
            ', at {:.1f} to {:.1f} Hz'.format(*theta[2:4]) if is_band else '')}
    return Finding(name if name != 'unknown' else 'unknown_cause', Level.WARN, numbers,
                   given.get('topics.package_pose', ''))


def _off(name: str, cause: Cause) -> str:
    """Return by how much a given quantity is off, or else the mass beside an inertia."""
    (_, unit, factor), theta, std, instead = CORRECTED[name], cause.theta, cause.std, ''
    if name == 'inertia':  # logarithms of factors
        instead = ', if package.mass is right'
        if np.ptp(theta) < SIGMAS * np.max(std):
            instead = f', or package.mass by {100.0 * abs(np.expm1(-np.mean(theta))):.3g} %'
        theta, std = np.expm1(theta), np.exp(theta) * std
    sizes = ', '.join(f'{factor * abs(x):.3g} ± {factor * s:.2g} {unit}' for x, s in zip(
        theta, std, strict=True) if abs(x) > SIGMAS * s) or 'little'
    return f'off by {sizes}{instead}'


def _corrected(cause: Cause, given: Given) -> str:
    """Return a given quantity with the correction by a cause."""
    topic, *_ = CORRECTED[cause.name.removesuffix('.direction')]
    if topic == 'package.inertia':
        moments = np.array(given[topic][:3]) * np.exp(cause.theta)
        return f'{", ".join(f"{x:.3g}" for x in moments)} kg m^2'
    if topic == 'gravity.direction':
        down = lie.exp_so3(np.append(-cause.theta, 0.0)) @ alignment.DOWN
        direction = _listed(alignment.levelling(given.get(topic, alignment.DOWN)).T @ down)
        if cause.instead == 'force':
            return f'{direction}; or a hose or cable pulls at the package'
        return direction
    sure = np.where(np.abs(cause.theta) > SIGMAS * cause.std, cause.theta, 0.0)
    value = np.add(given[topic], sure if topic == 'package.com' else cause.theta[0])
    return _listed(value) if topic == 'package.com' else f'{value:.5f}'


def _listed(values: Array) -> str:
    """Return a list with four decimals."""
    return f'[{", ".join(f"{x:.4f}" for x in np.round(values, 4) + 0.0)}]'
