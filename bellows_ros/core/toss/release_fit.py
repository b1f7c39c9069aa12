"""
Identification of the law of release from drops and tosses of packages of one or more masses.

The poses from before each valve until the package has fallen are compared with the law's
prediction: the law's free numbers are common to all drops; each drop has its own instant, and its
own offset of the package on the lip at rest, or else its own initial state. The sum of squared
residuals of positions, of velocities by local polynomials, and of rotations is minimised
(Gauss-Newton with damping; the numbers of each drop are eliminated). Standard errors follow from
the scatter between drops, by the gradient of each, and from the model error across masses: the
errors by scatter are enlarged so that they match the deviations of the drops of each mass from a
fit to the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.equilibrium import adapted, largest_step, moved_by
from bellows_ros.core.model.grip import Grip, Law, NO_FLIGHT, NO_LAW, RELEASE_NAMES
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import rest, row_state, state_row, tool_rows
from bellows_ros.core.parameters.conversion import distance_of, EXTRAPOLATION
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.savgol import weights
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.toss import release as tossing
from bellows_ros.core.toss.landing import as_law
from bellows_ros.core.toss.release import LAW_STEP, NO_GRIP
from bellows_ros.errors import UndeterminedError, UnexplainedError
import numpy as np

MIN_DROPS = 3
"""Smallest number of drops."""

TIME_AFTER_FALL = 0.3
"""Duration of a drop after the beginning of its fall, s."""

REST_TOLERANCE = (1e-3, 0.01)
"""Largest displacement and rotation of a body at rest, m and rad."""

ORDER = 3
"""Order of the polynomials that give velocities."""

MIN_NOISE = (1e-4, 5e-4)
"""Smallest standard deviations of positions and rotations in the fit, m and rad."""
VELOCITY_SCALE = 40.0
"""Ratio of the standard deviations of velocities and positions, 1/s."""

PRIOR_SCATTER = {0: 2.5e-3, 2: 0.01}
"""Prior standard deviation between drops of the delay (s) and of the impulse (N s), by index."""

STATE_STD = np.repeat([1e-3, 1e-2, 1e-2, 1e-1], 3)
"""Prior standard deviations of the first state: pose and twist, m, rad, m/s and rad/s."""

MAX_RMS = 1e-3
"""Largest RMS residual of the positions with which a law explains drops, m."""
MAX_CHI2 = 2.0
"""Largest chi^2 per pose with which a law explains drops within their noise."""

LINEAR_TAU = 0.5
"""Time constant with which the suction falls linearly during a release, s."""

MAX_COMMON_RESIDUAL = 4.0
"""Largest ratio of the common residual of drops of one mass to their scatter."""

MAX_SQUARES_RATIO = 0.8
"""Largest ratio of chi^2 with and without a further number of the law that is kept."""

OPENING = (0, 3, 4, 5, 6, 7)
"""Indices of the free numbers of an opening cup: all but tau and impulse."""

TYPICAL_LAW: Law = (0.015, LINEAR_TAU, 0.0, 22.0, 19.0, 0.02, 25.0, 2.4)
"""The law of an opening cup for numbers that are neither given nor identifiable, similar to the
law of the drops in docs/toss.md."""

MAX_RELATIVE_STD, ABSOLUTE_SCALES = 0.5, np.array([0.015, 0.05, 0.02, 1.0, 1.0, 1e-3, 10.0, 0.1])
"""Largest relative standard error of an identifiable number, and default of a given one's standard
deviation; and smallest scales of the numbers."""

MAX_ITERATIONS = 20
"""Largest number of Gauss-Newton steps of a fit."""

MAX_NUISANCE = 30.0
"""Largest nuisance parameter of a drop, prior standard deviations."""

LAW_MIN = np.array([0.0, 1e-4, -10.0, 0.0, 0.1, 1e-3, 0.1, 0.0])
LAW_MAX = np.array([1.0, 1.0, 10.0, 1e3, 1e4, 1.0, 1e4, 1e3])
"""Bounds of the numbers of a law; the lower bound of `opening` holds if the cup opens."""

SCALES = np.array([1e-3, 1e-2, 1e-2, 1.0, 1.0, 1e-3, 1.0, 0.1])
"""Scales of the law's numbers for the damping of Gauss-Newton steps; the steps of differences are
1e-3 of them."""


@dataclass(frozen=True, eq=False)
class Drop:
    """
    One drop or toss.

    Parameters
    ----------
    model, grip : tuple
        Model and grip for the kernels.
    tool, package : Trajectory
        E with body twists and B, in the world, at common stamps: from before the valve until
        before the landing.
    start : State
        Approximate state of B at the first stamp.
    valve : float
        Time of the valve, s since the first stamp.
    noise : (float, float)
        Standard deviations of the package's positions (m) and rotations (rad).
    stands : bool
        Whether the tool and the package are at rest at `start`.

    """

    model: ModelTuple
    grip: Grip
    tool: Trajectory
    package: Trajectory
    start: State
    valve: float
    noise: tuple[float, float]
    stands: bool

    @property
    def mass(self) -> float:
        """Mass of the package, kg."""
        return float(self.model[1][0])

    @cached_property
    def _inputs(self) -> tuple[Array, Array, float, Array, Array]:
        """
        Inputs of the prediction: tool for the kernels, longest integration step, orientations.

        Then the package's orientations, and the matrix from positions to velocities of local
        polynomials.
        """
        seconds = self.tool.seconds
        return (
            tool_rows(self.tool), seconds, largest_step(self.model),
            lie.rotation_to_quaternion(self.package.rotation),
            _derivative(np.eye(len(seconds)), seconds, 1, 'constant'))

    def predicted(self, law: Law, change: Array | None = None) -> tuple[float, Array]:
        """
        Return the time of release (s since the first stamp, -1 without), and states (N, 13).

        The start may be changed (12,), in units of `STATE_STD`.
        """
        rows, seconds, max_step, *_ = self._inputs
        start = adapted(self.model, row_state(rows[0]), self.start)
        if change is not None:
            start = moved_by(start, STATE_STD * change)
        states = np.empty((len(seconds), 13))
        switching = self.model, self.grip, NO_FLIGHT._replace(law=law), self.valve
        released = tossing.write_toss(switching, start, rows, seconds, max_step, states)
        return float(released), states

    def errors(self, states: Array) -> Array:
        """Return measured minus predicted position (m), velocity (m/s), rotation (rad), (9, N)."""
        position, (*_, orientation, slopes) = self.package.position - states[:, :3], self._inputs
        rotation = lie.log_quaternion(lie.quaternion_product(
            lie.quaternion_conjugate(states[:, 3:7]), orientation))
        return np.hstack([position, slopes @ position, rotation]).T


class Explained(NamedTuple):
    """Residuals of a law in a drop."""

    mass: float
    """Mass, kg."""
    released: float
    """Time from the valve to the release, with the drop's own delay, s; NaN without a release."""
    own_delay: float
    """Deviation of the drop's delay from the common delay, s."""
    position: float
    """RMS residual of the position along gravity, m."""
    velocity: float
    """RMS residual of the velocity, m/s."""
    speed: float
    """Speed of B at release, m/s."""
    chi2: float
    """Mean square of positions and rotations relative to the noise."""


class ReleaseFit(NamedTuple):
    """
    A fitted law of release, and its residuals.

    Parameters
    ----------
    law : Law
        All numbers of the law.
    free : tuple of int
        Indices of the fitted numbers.
    covariance : ndarray (8, 8)
        Covariance of the numbers, from the scatter between drops, and from the prior for
        unidentifiable ones; 0 for others that were not fitted.
    scatter : ndarray (8,)
        Standard deviations between drops; 0 for common numbers.
    drops : tuple of Explained
        Residuals in the order of the given drops.
    lack : float
        Ratio of the common mean square residual of drops of one mass to its expectation by
        scatter.
    common : float
        RMS of the common residual of positions, m.

    """

    law: Law
    free: tuple[int, ...]
    covariance: Array
    scatter: Array
    drops: tuple[Explained, ...]
    lack: float
    common: float

    @property
    def std(self) -> Array:
        """Standard errors (8,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def not_identifiable(self) -> tuple[int, ...]:
        """The numbers of the law that are not identifiable: as given, or typical."""
        return tuple(k for k in range(8) if self.std[k] > 0.0 and k not in self.free)

    @property
    def chi2(self) -> float:
        """Mean of chi^2 over the drops."""
        return float(np.mean([drop.chi2 for drop in self.drops]))

    @property
    def position(self) -> float:
        """RMS residual of the positions, m."""
        return math.sqrt(float(np.mean([drop.position**2 for drop in self.drops])))

    @property
    def explains(self) -> bool:
        """Whether the law explains the drops."""
        latest = max(abs(drop.own_delay) for drop in self.drops)
        return latest <= 5.0 * PRIOR_SCATTER[0] and (self.position <= MAX_RMS or (
            self.chi2 <= MAX_CHI2
            and (self.lack <= MAX_COMMON_RESIDUAL or self.common <= MAX_RMS)))


def release_parameters(fit: ReleaseFit) -> dict[str, Any]:
    """Return the parameters `release.*` of a fit, with the scatter between drops."""
    covariance = fit.covariance + np.diag(fit.scatter**2)
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    correlation = covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    masses = [drop.mass for drop in fit.drops]
    return {
        **dict(zip(RELEASE_NAMES, fit.law, strict=True)),
        **{f'{name}_std': x for name, x in zip(
            RELEASE_NAMES, np.minimum(std, LAW_MAX).tolist(), strict=True)},
        'release.correlation': tuple(correlation.ravel().tolist()),
        'release.mass_range': (min(masses), max(masses))}


def fit_release(drops: Sequence[Drop], given: Law = NO_LAW, given_std: Law = NO_LAW) -> ReleaseFit:
    """
    Return the smallest law that explains drops.

    Laws are tried in this order: a cup that keeps its length, a cup that opens, a cup that opens
    with tau.

    Parameters
    ----------
    drops : sequence of Drop
        Drops, at least `MIN_DROPS`.
    given, given_std : Law
        Values of unidentifiable numbers, and their standard deviations; without an opening,
        `TYPICAL_LAW`.

    Raises
    ------
    UndeterminedError
        If there are too few drops, they do not determine the law, or no law explains them.

    """
    if len(drops) < MIN_DROPS:
        raise UndeterminedError(
            f'The release needs {MIN_DROPS} or more usable drops, got {len(drops)}. Record more.')
    has_grip = drops[0].grip[1] > 0.0
    # about 12 drops select the kind of law
    subset = sorted(drops, key=lambda drop: drop.mass)[::max(1, len(drops) // 12)]
    fall = float(np.median([_fall(drop) - drop.valve for drop in subset]))
    closed = np.array(given)
    closed[[0, 1]] = (max(fall - 0.02, 1e-3), 0.01) if has_grip else (fall, 0.0)
    closed[3:] = 0.0
    best = _fitted(subset, closed, (0, 1, 2) if has_grip else (0, 2))
    if has_grip and best.std[1] > 0.5 * best.law[1]:
        closed[1] = given[1]
        best = _fitted(subset, closed, (0, 2))
    if not best.explains or best.lack > MAX_COMMON_RESIDUAL:
        openings = [_fitted(subset, start, OPENING) for start in _openings(subset, fall)]
        opened = min(openings, key=_squares)
        if not best.explains or _squares(opened) < MAX_SQUARES_RATIO * _squares(best):
            best = opened
    if best.free == OPENING:
        shorter = np.array(best.law)
        shorter[[1, 3]] = 0.15, max((1.0 + best.law[3]) * 0.15 / best.law[1] - 1.0, 0.0)
        further = _fitted(subset, shorter, (1, *OPENING))
        if _squares(further) < MAX_SQUARES_RATIO * _squares(best) and (
                further.std[1] < MAX_RELATIVE_STD * further.law[1] or not best.explains):
            best = further
    if len(subset) < len(drops):
        best = _fitted(drops, np.array(best.law), best.free)
    if best.explains:
        return _calibrated(drops, _identifiable(drops, best, given, given_std))
    raise UnexplainedError(
        f'No law of release explains the drops: it leaves {1e3 * best.position:.2g} mm of their '
        f'positions (rms, chi2 per pose {best.chi2:.3g}), {1e3 * best.common:.2g} mm of it in all '
        f'drops of a mass alike, with instants that scatter by {1e3 * best.scatter[0]:.2g} ms; '
        f'expected less than {1e3 * MAX_RMS:g} mm, and {1e3 * PRIOR_SCATTER[0]:g} ms. The '
        'likeliest cause is a wrong package.mass, cup.stiffness or cup.length, or a valve stamped '
        'by another clock; check the first with bellows static.')


def _identifiable(
    drops: Sequence[Drop], fit: ReleaseFit, given: Law, given_std: Law
) -> ReleaseFit:
    """Return a fit of the identifiable numbers alone; the least identifiable are fixed first."""
    opens = fit.law[5] > 0.0
    default = np.array(TYPICAL_LAW if opens and not given[5] > 0.0 else given)
    std = np.where(np.array(given_std) > 0.0, given_std,
                   MAX_RELATIVE_STD * np.where(default > 0.0, default, ABSOLUTE_SCALES))
    fixed_std = np.zeros(8)
    while True:
        relative = fit.std / np.maximum(np.abs(fit.law), ABSOLUTE_SCALES)
        wide = [k for k in fit.free if relative[k] >= MAX_RELATIVE_STD]
        if not wide:
            return fit
        worst = max(wide, key=lambda k: float(relative[k]) if k else 0.0)
        law = np.array(fit.law)
        law[worst], fixed_std[worst] = default[worst], std[worst]
        if worst:
            fit = _fitted(drops, law, tuple(k for k in fit.free if k != worst), fixed_std)
        if not (worst and fit.explains):
            raise UndeterminedError(
                f'The drops do not determine {RELEASE_NAMES[worst]}: they differ too much from '
                f'each other, or too little in mass. With {default[worst]:.3g} '
                f'{PARAMETERS[RELEASE_NAMES[worst]].unit} for it, the law leaves '
                f'{1e3 * fit.position:.2g} mm of their positions. Record more drops, of packages '
                'from half to twice this mass, or give the number.')


def _squares(fit: ReleaseFit) -> float:
    """Return the mean square residual of positions and scaled velocities, m^2."""
    return float(np.mean([
        drop.position**2 + (drop.velocity / VELOCITY_SCALE)**2 for drop in fit.drops]))


def _fall(drop: Drop) -> float:
    """Return the time at which a package finally begins to fall, s since the first stamp."""
    position, seconds = drop.package.position, drop.package.seconds
    return float(seconds[free_fall_samples(position, seconds, drop.model[2])[0]])


def half_window(seconds: Array) -> int:
    """Return the half window (samples) of velocities, of samples at times (s)."""
    return max(2, round(1.0 / 60.0 / float(np.median(np.diff(seconds)))))  # s


def _derivative(values: Array, seconds: Array, order: int, ends: Any) -> Array:
    """Return a derivative (N, M) of local polynomials; `ends` is the padding of `np.pad`."""
    n = half_window(seconds)
    row = weights(n, ORDER, 1.0 / float(np.median(np.diff(seconds))))[order]
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * n + 1, axis=0)
    return np.pad(windows @ row, ((n, n), (0, 0)), ends)


def free_fall_samples(position: Array, seconds: Array, gravity: Any) -> tuple[int, int]:
    """
    Return the first and the last sample of the last fall before an impact.

    Parameters
    ----------
    position, seconds : array (N, 3), (N,)
        Positions of B in the world, m, and times, s.
    gravity : (3,)
        Gravity, m/s^2.

    Raises
    ------
    UndeterminedError
        If there is no fall.

    """
    n = half_window(seconds)
    if len(seconds) > 2 * n:
        felt = np.linalg.norm(_derivative(position, seconds, 2, 'edge') - gravity, axis=1)
        impact = np.flatnonzero(felt > 80.0)  # m/s^2; an opening cup has 30
        free = felt[:max(impact[0] - n, 0) if len(impact) else None] < 3.0  # m/s^2
        edges = np.flatnonzero(np.diff(free.astype(int), prepend=0, append=0)).reshape(-1, 2)
        for first, end in edges[::-1]:
            if seconds[end - 1] - seconds[first] >= 0.012:  # s
                return int(first), int(end - 1)
    raise UndeterminedError('no tracked fall follows')


def _openings(drops: Sequence[Drop], fall: float) -> list[Array]:
    """Return laws of an opening cup as initial guesses, with the release at the end of opening."""
    weight = max(drop.mass for drop in drops) * float(np.linalg.norm(drops[0].model[2]))
    reach = np.median([
        np.linalg.norm(drop.package.position[np.searchsorted(drop.package.seconds, _fall(drop))]
                       - drop.package.position[0]) for drop in drops])
    damping, delay = max(drops[0].model[0][3][0][8], 10.0), 0.12 * fall
    rate = 4.0 / (fall - delay)  # of the suction, which is 0 after a quarter of the time
    return [np.array([delay, LINEAR_TAU, 0.0, rate * LINEAR_TAU - 1.0, part * weight, reach / 1.5,
                      damping, 3.0]) for part in (0.5, 1.0)]


def _fitted(
    drops: Sequence[Drop], start: Array, free: tuple[int, ...], fixed_std: Array | None = None
) -> ReleaseFit:
    """Return the fit of some numbers of a law, from a start; others have `fixed_std` (8,)."""
    problem = [_DropFit(drop, free) for drop in drops]
    law, chosen = start.copy(), list(free)
    damping, cost = 1e-2, math.inf
    for _ in range(MAX_ITERATIONS):
        H, gradients = _reduced(problem, law)
        cost, lower = sum(one.cost for one in problem), math.inf
        while lower >= cost and damping < 1e6:
            step = np.linalg.solve(
                H + damping * np.diag(np.diag(H) + 1e-12), gradients.sum(axis=0))
            trial = law.copy()
            trial[chosen] = np.clip(
                law[chosen] + step * SCALES[chosen], LAW_MIN[chosen], LAW_MAX[chosen])
            lower = sum(one.trial(trial, step) for one in problem)
            damping *= 4.0 if lower >= cost else 1.0
        if lower >= cost:
            break
        for one in problem:
            one.accept()
        law, damping = trial, max(damping / 6.0, 1e-6)
        if cost - lower < 1e-5 * cost:
            break
    H, _ = _reduced(problem, law)
    inverse = np.linalg.pinv(H)
    lack, common = _in_common(problem, law)
    placed = SCALES[:, None] * np.eye(8)[:, chosen]
    noise = len(free) / len(drops) * cost / sum(
        one.residuals(law, one.nuisance).size for one in problem) * inverse
    covariance = max(lack, 1.0) * _by_scatter(problem, law) + placed @ noise @ placed.T
    if fixed_std is not None:
        covariance += _of_fixed(problem, law, inverse, fixed_std)
    scatter = np.sqrt(np.maximum(
        np.var([one.law_offset for one in problem], axis=0, ddof=1)
        - np.mean([one.noise for one in problem], axis=0), 0.0))
    return ReleaseFit(
        as_law(law), free, covariance, scatter,
        tuple(one.explained(law) for one in problem), lack, common)


def _by_scatter(problem: Sequence['_DropFit'], law: Array) -> Array:
    """Return the covariance (8, 8) of the free numbers by the scatter between drops."""
    H, gradients = _reduced(problem, law)
    inverse = SCALES[:, None] * np.eye(8)[:, list(problem[0].free)] @ np.linalg.pinv(H)
    moves, count = gradients @ inverse.T, len(problem)
    return np.asarray(count / max(count - gradients.shape[1], 1) * moves.T @ moves)


def _calibrated(drops: Sequence[Drop], fit: ReleaseFit) -> ReleaseFit:
    """
    Return a fit whose covariance explains the errors of held-out masses.

    The stated variance equals the mean square deviation of height and velocity at the end of the
    drops of each mass, predicted by a fit to the others. With fewer than three others, the
    common residual of drops enlarges the covariance instead.
    """
    ratios = list[Array]()
    for mass in sorted({drop.mass for drop in drops if drop.stands}):
        own, others = ([drop for drop in drops if drop.stands and (drop.mass == mass) is is_own]
                       for is_own in (True, False))
        if len(ranges := {drop.mass for drop in others}) < 3:
            continue
        part = _fitted(others, np.array(fit.law), fit.free)
        problem = [_DropFit(drop, fit.free) for drop in others]
        by_scatter = _end_variance(own[0], part.law, _by_scatter(problem, np.array(part.law)))
        of_drops = _end_variance(own[0], part.law, np.diag(part.scatter**2))
        wider = 1.0 + EXTRAPOLATION * distance_of(mass, (min(ranges), max(ranges)))
        squares = np.mean([_end_error(drop, part.law)**2 for drop in own], axis=0) / wider**2
        ratios.append(np.maximum(squares - of_drops, 0.0) / by_scatter)
    if not ratios:
        return fit
    factor = max(1.0, float(np.mean(ratios, axis=0).max()))
    by_scatter = _by_scatter([_DropFit(drop, fit.free) for drop in drops], np.array(fit.law))
    return fit._replace(
        covariance=fit.covariance + (factor - max(fit.lack, 1.0)) * by_scatter)


def _end_error(drop: Drop, law: Law) -> Array:
    """Return measured minus predicted height (m) and velocity (m/s) at the end of a drop."""
    errors = drop.errors(drop.predicted(law)[1])
    before = slice(0, max(1, int(np.searchsorted(drop.package.seconds, drop.valve))))
    at, up = -1 - half_window(drop.package.seconds), np.array(drop.model[2])
    shift = errors[:3, at] - errors[:3, before].mean(axis=1)
    return np.array([up @ shift, up @ errors[3:6, at]]) / float(np.linalg.norm(up))


def _end_variance(drop: Drop, law: Law, covariance: Array) -> Array:
    """Return the variances (2,) of `_end_error` by a covariance (8, 8) of the law."""
    sizes, axes = np.linalg.eigh(covariance)
    factor = axes * np.sqrt(np.maximum(sizes, 0.0))
    slopes = [(_end_error(drop, as_law(np.array(law) + LAW_STEP * column))
               - _end_error(drop, as_law(np.array(law) - LAW_STEP * column))) / (2.0 * LAW_STEP)
              for column in factor.T]
    return np.asarray(np.sum(np.square(slopes), axis=0))


def _reduced(problem: Sequence['_DropFit'], law: Array) -> tuple[Array, Array]:
    """Return the matrix of the free numbers, and the gradient of each drop."""
    matrices, gradients = zip(*[one.reduced(law) for one in problem], strict=True)
    return np.sum(matrices, axis=0), np.array(gradients)


def _of_fixed(problem: Sequence['_DropFit'], law: Array, inverse: Any, fixed_std: Array) -> Array:
    """Return the covariance (8, 8) by fixed numbers with a std (8,), by their effect on others."""
    free, fixed = problem[0].free, np.flatnonzero(fixed_std).tolist()
    both = [_DropFit(one.drop, (*free, *fixed), one.nuisance) for one in problem]
    H, _ = _reduced(both, law)
    moves = np.zeros((8, len(fixed)))
    moves[list(free)] = -inverse @ H[:len(free), len(free):]
    moves[fixed] = np.eye(len(fixed))
    moves *= SCALES[:, None] * (fixed_std / SCALES)[fixed]
    return np.asarray(moves @ moves.T)


def _in_common(problem: Sequence['_DropFit'], law: Array) -> tuple[float, float]:
    """
    Return the common residual of drops of one mass, relative to their scatter, and its RMS (m).

    The model error is common to drops, unlike noise, even with memory. The results are 1 and 0
    without two drops of one mass.
    """
    between, within, common = 0.0, 0.0, 0.0
    masses = {one.drop.mass for one in problem}
    for mass in masses:
        group = [one for one in problem if one.drop.mass == mass]
        seconds = [one.drop.package.seconds - one.drop.valve for one in group]
        at = seconds[0][(seconds[0] >= max(s[0] for s in seconds))
                        & (seconds[0] <= min(s[-1] for s in seconds))]
        errors = np.array([[np.interp(at, s, row) for row in one.errors(law)]
                           for one, s in zip(group, seconds, strict=True)])
        mean = errors.mean(axis=0)
        between += len(group) * float(np.sum(mean**2))
        within += float(np.sum((errors - mean)**2))
        common += len(group) * float(
            np.sum(np.mean((mean[:3] * group[0].sizes[:3])**2, axis=1)))
    degrees = len(problem) - len(masses)
    if not (degrees and within):
        return 1.0, 0.0
    return (between / len(masses)) / (within / degrees), math.sqrt(common / len(problem))


class _DropFit:
    """
    A drop, and its contribution to the fit.

    Its nuisance parameters, in units of their prior scatter, are the scattering numbers of the
    law, then the offset of a package at rest, or else the state at the start.
    """

    def __init__(
        self, drop: Drop, free: tuple[int, ...], nuisance: Array | None = None
    ) -> None:
        self.drop, self.free = drop, free
        noise = np.maximum(drop.noise, MIN_NOISE)
        self.sizes = np.repeat([noise[0], VELOCITY_SCALE * noise[0], noise[1]], 3)[:, None]
        self._scatter = np.transpose(
            [PRIOR_SCATTER[k] * np.eye(8)[k] for k in free if k in PRIOR_SCATTER])
        count = self._scatter_count = self._scatter.shape[1]
        self.nuisance = (
            np.zeros(count + (6 if drop.stands else 12)) if nuisance is None else nuisance)
        self._count = 0

    @property
    def law_offset(self) -> Array:
        """Deviation of the drop's law from the common law (8,)."""
        return np.asarray(self._scatter @ self.nuisance[:self._scatter_count])

    def _predicted(self, law: Array, nuisance: Array) -> tuple[float, Array]:
        """Return the result of `Drop.predicted`."""
        return self.drop.predicted(
            as_law(law + self._scatter @ nuisance[:self._scatter_count]),
            None if self.drop.stands else nuisance[self._scatter_count:])

    def residuals(self, law: Array, nuisance: Array) -> Array:
        """Return errors relative to their sizes, and the nuisance parameters."""
        errors = self.drop.errors(self._predicted(law, nuisance)[1])
        if self.drop.stands:
            errors[[0, 1, 2, 6, 7, 8]] -= (np.repeat([1e-3, 0.02], 3) * nuisance[-6:])[:, None]
        return np.concatenate([
            np.nan_to_num(errors / self.sizes, nan=1e6).clip(-1e6, 1e6).ravel(), nuisance])

    def reduced(self, law: Array) -> tuple[Array, Array]:
        """Return matrix and gradient of the free numbers, with nuisance parameters eliminated."""
        residuals = self.residuals(law, self.nuisance)
        self.cost = float(residuals @ residuals)
        n, m, scatter_count = len(self.free), len(self.nuisance), self._scatter_count
        J = np.zeros((len(residuals), n + m))
        for i, k in enumerate(self.free):
            changed = law + 1e-3 * SCALES * np.eye(8)[k]
            J[:, i] = (self.residuals(changed, self.nuisance) - residuals) / 1e-3
        J[:, n:n + scatter_count] = J[:, :n] @ (self._scatter / SCALES[:, None])[list(self.free)]
        if self._count % 5 == 0:  # derivatives by the state hardly change
            self._by_state = np.transpose([
                (self.residuals(law, self.nuisance + change) - residuals) / 1e-3
                for change in 1e-3 * np.eye(m)[scatter_count:]])
        self._count += 1
        J[:, n + scatter_count:] = self._by_state
        J[-m:, n:] = np.eye(m)
        A, B, C = J[:, :n].T @ J[:, :n], J[:, :n].T @ J[:, n:], J[:, n:].T @ J[:, n:]
        gradient = -J.T @ residuals
        self.noise = self._scatter**2 @ np.diag(np.linalg.inv(C))[:scatter_count]
        self._follows = np.linalg.solve(C, B.T)
        self._newton_step = np.linalg.solve(C, gradient[n:])
        return A - B @ self._follows, gradient[:n] - B @ self._newton_step

    def trial(self, law: Array, step: Array) -> float:
        """Return the squares at another law, a step away, with adapted nuisance parameters."""
        self._trial = np.clip(self.nuisance + self._newton_step - self._follows @ step,
                              -MAX_NUISANCE, MAX_NUISANCE)
        residuals = self.residuals(law, self._trial)
        return float(residuals @ residuals)

    def accept(self) -> None:
        self.nuisance = self._trial

    def errors(self, law: Array) -> Array:
        """Return the residuals of the law relative to their sizes (9, N)."""
        return self.residuals(law, self.nuisance)[:-len(self.nuisance)].reshape(9, -1)

    def explained(self, law: Array) -> Explained:
        drop = self.drop
        released, states = self._predicted(law, self.nuisance)
        errors = self.errors(law) * self.sizes
        n = half_window(drop.package.seconds)
        up = np.array(drop.model[2]) / np.linalg.norm(drop.model[2])
        after = int(np.searchsorted(drop.package.seconds[:-1], max(released, 0.0)))
        noise = np.repeat(np.maximum(drop.noise, 0.1 * np.array(MIN_NOISE)), 3)[:, None]
        return Explained(
            drop.mass, released - drop.valve if released >= 0.0 else math.nan,
            float(self.law_offset[0]), _rms(up @ errors[:3]), _rms(up @ errors[3:6, n:-n]),
            float(np.linalg.norm(states[after, 7:10])),
            _rms(errors[[0, 1, 2, 6, 7, 8]] / noise)**2)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def drops_of(
    recording: Recording, model: ModelTuple, grip: Grip | None, valves_ns: Sequence[int]
) -> tuple[list[Drop], list[str]]:
    """
    Return the drops in a recording, and the reasons for unusable switchings of the valve.

    Parameters
    ----------
    recording : Recording
        Recording of tool and package.
    model, grip : tuple
        Model and grip for the kernels.
    valves_ns : sequence of int
        Stamps of switching the valve off, ns.

    """
    drops, left_out = list[Drop](), list[str]()
    for number, valve_ns in enumerate(valves_ns):
        later_ns = valve_ns + round((1.0 + TIME_AFTER_FALL) * NS_PER_S)  # a fall begins within 1 s
        until_ns = min([later_ns, *valves_ns[number + 1:number + 2]])
        try:
            drops.append(_drop(recording, model, grip or NO_GRIP, valve_ns, until_ns))
        except UndeterminedError as error:
            seconds = (valve_ns - recording.start_ns) / NS_PER_S
            left_out.append(f'the valve at {seconds:.2f} s: {error}')
    return drops, left_out


def _drop(
    recording: Recording, model: ModelTuple, grip: Grip, valve_ns: int, until_ns: int
) -> Drop:
    """Return the drop after a valve, until a stamp."""
    package = _tracked(recording.aligned_package, valve_ns, until_ns)
    tool = _tracked(recording.aligned_tool, valve_ns, int(package.stamps_ns[-1]))
    before = slice(0, max(int(np.searchsorted(package.stamps_ns, valve_ns)), 1))
    stands = _stands(tool, 3.0) and _stands(package.select(before))  # it recoils
    if not stands:  # the tool is measured at the common stamps
        package = _tracked(recording.measured_package, valve_ns, until_ns)
    after = int(np.searchsorted(package.stamps_ns, valve_ns))
    first, last = free_fall_samples(package.position[after:], package.seconds[after:], model[2])
    fallen = package.seconds[after + first] + TIME_AFTER_FALL
    package = package.select(slice(0, min(
        after + last + 1, int(np.searchsorted(package.seconds, fallen, 'right')))))
    if stands:
        position, rotation = tool.position.mean(axis=0), tool.rotation[len(tool) // 2]
        count = len(package)
        tool = Trajectory(package.stamps_ns, np.tile(position, (count, 1)),
                          np.tile(rotation, (count, 1, 1)), np.zeros((count, 6)))
        start = rest(model, tool_rows(tool)[0])
    else:
        at = np.searchsorted(recording.tool.stamps_ns, package.stamps_ns)
        tool, body = recording.tool.select(at), recording.package.select(at[:1])
        if not (tool.valid.all() and body.valid[0]):
            raise UndeterminedError('the tool was not tracked continuously')
        start = state_row(*(row[0] for row in np.split(tool_rows(body), [3, 7], axis=1)))
    return Drop(model, grip, tool, package, start,
                (valve_ns - int(package.stamps_ns[0])) / NS_PER_S, recording.measured_noise[1],
                stands)


def _tracked(poses: Trajectory, valve_ns: int, until_ns: int) -> Trajectory:
    """Return poses from before a valve to a stamp, up to the first missing one."""
    stamps_ns = poses.stamps_ns
    at, end = (int(np.searchsorted(stamps_ns, ns)) for ns in (valve_ns, until_ns))
    # s before the valve
    begin = int(np.searchsorted(stamps_ns, valve_ns - round(0.15 * NS_PER_S)))
    wrong = np.flatnonzero(~poses.valid)
    begin = max([begin, *(wrong[wrong < at][-1:] + 1)])
    end = min([end, *wrong[wrong >= at][:1]])
    if begin >= end or (stamps_ns[begin] - valve_ns) / NS_PER_S > 0.01:  # s
        raise UndeterminedError('tool or package was not tracked then')
    return poses.select(slice(begin, end))


def _stands(poses: Trajectory, times: float = 1.0) -> bool:
    """Return whether poses are at rest within a multiple of `REST_TOLERANCE`."""
    rotation = lie.log_so3(np.swapaxes(poses.rotation[:1], -1, -2) @ poses.rotation)
    shift = poses.position - poses.position.mean(axis=0)
    return bool(np.abs(shift).max() < times * REST_TOLERANCE[0]
                and np.abs(rotation).max() < times * REST_TOLERANCE[1])
