"""
Identification of the law of release from drops and tosses of packages of one or more masses.

The law's prediction is compared with the poses from shortly before each valve to the end of the
fall. The free numbers of the law are common to all drops. Each drop has its own delay, and its own
offset of the package at rest, or its own initial state. `scipy.optimize.least_squares` minimises
the squared residuals of positions, of velocities by local polynomials, and of rotations. The
covariance is the sum of two covariances H^-1 (sum of g g^T) H^-1, with the Hessian H and the
gradients g of clusters: single drops, and all drops of a mass.
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
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.toss import release as tossing
from bellows_ros.core.toss.landing import as_law
from bellows_ros.core.toss.release import NO_GRIP
from bellows_ros.errors import UndeterminedError, UnexplainedError
import numpy as np
from scipy import sparse
from scipy.optimize import approx_fprime, least_squares
from scipy.signal import savgol_filter
from scipy.special import ndtri, stdtrit

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

DELAY_STD = 2.5e-3
"""Prior standard deviation of the delay between drops, s."""

OFFSET_STD = (1e-3, 0.02)
"""Prior standard deviations of the offset of a package at rest, m and rad."""

MAX_RMS = 1e-3
"""Largest RMS residual of the positions with which a law explains drops, m."""
MAX_CHI2 = 1.5
"""Largest chi^2 per pose with which a law explains drops within their noise."""

LINEAR_TAU = 0.5
"""Time constant with which the suction falls linearly during a release, s."""

MAX_SQUARES_RATIO = 0.8
"""Largest ratio of mean square residuals with and without a lengthening cup, to keep its law."""

OPENING = (0, 3, 4, 5, 6, 7)
"""Indices of the free numbers for a cup that lengthens: all but tau and impulse."""

TYPICAL_LAW: Law = (0.015, LINEAR_TAU, 0.0, 22.0, 19.0, 0.02, 25.0, 2.4)
"""Law of a lengthening cup for numbers that are neither given nor identifiable, similar to the law
identified from real drops."""

MAX_RELATIVE_STD = 0.5
"""Largest relative standard error of an identifiable number; default for a given number."""

ABSOLUTE_SCALES = np.array([0.015, 0.05, 0.02, 1.0, 1.0, 1e-3, 10.0, 0.1])
"""Smallest scales (8,) of the numbers of the law of release, SI units."""

MAX_EVALUATIONS = 16
"""Largest number of evaluations of a fit, for each free number of the law."""

LAW_MIN = np.array([0.0, 1e-4, -10.0, 0.0, 0.1, 1e-3, 0.1, 0.0])
LAW_MAX = np.array([1.0, 1.0, 10.0, 1e3, 1e4, 1.0, 1e4, 1e3])
"""Bounds of the numbers of a law; the lower bound of `opening` holds if the cup lengthens."""

SCALES = np.array([1e-3, 1e-2, 1e-2, 1.0, 1.0, 1e-3, 1.0, 0.1])
"""Units of the law's numbers in the fit."""

MAX_OWN = 5.0
"""Largest deviation of a drop's law from the common one, prior standard deviations."""

OWN_STD = np.array([DELAY_STD, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Prior standard deviations of the law's numbers between drops: of the delay and the impulse."""

START_STD = np.repeat([1e-3, 1e-2, 1e-2, 1e-1], 3)
"""Prior standard deviations of the first state: pose and twist, m, rad, m/s and rad/s."""

COMMON = slice(8)
"""Numbers of the common law among the numbers (28,) of a drop, in units of `SCALES`."""

OWN_LAW = slice(8, 16)
"""Deviations of one drop from the common law, in prior standard deviations."""

OWN_START = slice(16, 28)
"""Deviations of the first state of one drop, in prior standard deviations."""

EXACT_STEPS = {'regularize': False, 'atol': 1e-12, 'btol': 1e-12, 'conlim': 0.0, 'maxiter': 2000}
"""Options of LSMR for exact steps, as the law's numbers are strongly correlated."""

DIFFERENCE = 1e-3
"""Step of the derivatives, in units of the numbers."""


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
    def _inputs(self) -> tuple[Array, Array, float, Array]:
        """Rows of the tool, times (s), longest integration step (s), the package's quaternions."""
        return (tool_rows(self.tool), self.tool.seconds, largest_step(self.model),
                lie.rotation_to_quaternion(self.package.rotation))

    def predicted(self, law: Law, change: Array | None = None) -> tuple[float, Array]:
        """
        Return the time of release (s since the first stamp, -1 without), and states (N, 13).

        The first state may be changed by numbers (12,), in units of `START_STD`.
        """
        rows, seconds, max_step, _ = self._inputs
        start = adapted(self.model, row_state(rows[0]), self.start)
        if change is not None:
            start = moved_by(start, START_STD * change)
        states = np.empty((len(seconds), 13))
        switching = self.model, self.grip, NO_FLIGHT._replace(law=law), self.valve
        released = tossing.write_toss(switching, start, rows, seconds, max_step, states)
        return float(released), states

    @cached_property
    def sizes(self) -> Array:
        """Standard deviations (9, 1) of positions, velocities and rotations in the fit."""
        position, rotation = np.maximum(self.noise, MIN_NOISE)
        return np.repeat([position, VELOCITY_SCALE * position, rotation], 3)[:, None]

    def explained_by(self, numbers: Array) -> tuple[float, Array, Array]:
        """
        Return the time of release (s), states (N, 13) and residuals (9, N) for numbers (28,).

        The residuals are of position (m), velocity (m/s) and rotation (rad), measured minus
        predicted. If tool and package are at rest before the valve, the likeliest constant offset
        of the package is subtracted from the residuals of position and rotation.
        """
        released, states = self.predicted(
            as_law(SCALES * numbers[COMMON] + OWN_STD * numbers[OWN_LAW]),
            None if self.stands else numbers[OWN_START])
        _, seconds, _, orientation = self._inputs
        errors, n = np.zeros((9, len(seconds))), half_window(seconds)
        position = self.package.position - states[:, :3]
        errors[:3], errors[3:6, n:-n] = position.T, _derivative(position, seconds, 1).T
        errors[6:] = lie.log_quaternion(lie.quaternion_product(
            lie.quaternion_conjugate(states[:, 3:7]), orientation)).T
        if self.stands:
            for rows, std in zip((slice(3), slice(6, 9)), OFFSET_STD, strict=True):
                gain = len(states) * (std / self.sizes[rows])**2
                errors[rows] -= (1.0 - (1.0 + gain)**-0.5) * errors[rows].mean(1, keepdims=True)
        return released, states, errors

    def residuals(self, numbers: Array) -> Array:
        """Return the whitened residuals of numbers (28,), and the own numbers."""
        errors = self.explained_by(numbers)[2] / self.sizes
        return np.concatenate([
            np.nan_to_num(errors, nan=1e6).clip(-1e6, 1e6).ravel(), numbers[8:]])

    def slopes(self, numbers: Array, places: Any) -> Array:
        """Return the derivatives of the residuals by the numbers in some places."""
        def changed(part: Array) -> Array:
            trial = numbers.copy()
            trial[places] = part
            return self.residuals(trial)

        return np.asarray(approx_fprime(numbers[places], changed, DIFFERENCE))


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
        Covariance of the numbers: from the scatter between drops for identifiable numbers, from
        the prior for unidentifiable ones, and 0 for other numbers.
    scatter : ndarray (8,)
        Standard deviations between drops; 0 for common numbers.
    drops : tuple of Explained
        Residuals in the order of the given drops.

    """

    law: Law
    free: tuple[int, ...]
    covariance: Array
    scatter: Array
    drops: tuple[Explained, ...]

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
        return latest < MAX_OWN * DELAY_STD and (
            self.position <= MAX_RMS or self.chi2 <= MAX_CHI2)


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

    Laws are tried in this order: a cup that keeps its length, a cup that opens.

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
    noise = max(drop.noise[0] for drop in subset)
    if MAX_SQUARES_RATIO * best.position**2 > noise**2:  # otherwise no law leaves so much less
        opened = min((_fitted(subset, start, OPENING) for start in _openings(subset, fall)),
                     key=lambda fit: fit.position)
        if opened.position**2 < MAX_SQUARES_RATIO * best.position**2:
            best = opened
    if len(subset) < len(drops):
        best = _fitted(drops, np.array(best.law), best.free)
    if best.explains:
        return _identifiable(drops, best, given, given_std)
    raise UnexplainedError(
        f'No law of release explains the drops: it leaves {1e3 * best.position:.2g} mm of their '
        f'positions (rms, chi2 per pose {best.chi2:.3g}), with instants that scatter by '
        f'{1e3 * best.scatter[0]:.2g} ms; '
        f'expected less than {1e3 * MAX_RMS:g} mm, and {1e3 * DELAY_STD:g} ms. The '
        'likeliest cause is a wrong package.mass, cup.stiffness or cup.length, or a valve stamped '
        'by another clock.')


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


def _fall(drop: Drop) -> float:
    """Return the time at which the last fall of a package begins, s since the first stamp."""
    position, seconds = drop.package.position, drop.package.seconds
    return float(seconds[free_fall_samples(position, seconds, drop.model[2])[0]])


def half_window(seconds: Array) -> int:
    """Return the half window (samples) of velocities, of samples at times (s)."""
    return max(2, round(1.0 / 60.0 / float(np.median(np.diff(seconds)))))  # s


def _derivative(values: Array, seconds: Array, order: int) -> Array:
    """Return a derivative (N - 2 n, M) of local polynomials, without half windows at the ends."""
    n = half_window(seconds)
    return np.asarray(savgol_filter(
        values, 2 * n + 1, ORDER, order, float(np.median(np.diff(seconds))), axis=0)[n:-n])


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
        felt = np.pad(np.linalg.norm(
            _derivative(position, seconds, 2) - gravity, axis=1), n, 'edge')
        impact = np.flatnonzero(felt > 80.0)  # m/s^2; an opening cup has 30
        free = felt[:max(impact[0] - n, 0) if len(impact) else None] < 3.0  # m/s^2
        edges = np.flatnonzero(np.diff(free.astype(int), prepend=0, append=0)).reshape(-1, 2)
        for first, end in edges[::-1]:
            if seconds[end - 1] - seconds[first] >= 0.012:  # s
                return int(first), int(end - 1)
    raise UndeterminedError('no tracked fall follows')


def _openings(drops: Sequence[Drop], fall: float) -> list[Array]:
    """Return laws of a lengthening cup as initial guesses, with the release at full length."""
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
    """Return the law fitted in its free numbers; fixed numbers have `fixed_std` (8,)."""
    count, common = len(free), list(free)
    is_own = np.zeros((len(drops), 28), bool)
    is_own[:, [8 + k for k in free if OWN_STD[k]]] = True
    is_own[[not drop.stands for drop in drops], OWN_START] = True
    total = count + int(is_own.sum())
    index = np.full(is_own.shape, total)  # of each number among the unknowns
    index[:, common], index[is_own] = range(count), np.arange(count, total)
    places = [np.flatnonzero(row < total) for row in index]
    chosen = sparse.eye(total, format='csr')[index[index < total]]
    most = np.where(np.nonzero(is_own)[1] < OWN_START.start, MAX_OWN, np.inf)
    first, low, high = (np.concatenate([(part / SCALES)[common], own]) for part, own in (
        (start, 0.0 * is_own[is_own]), (LAW_MIN, -most), (LAW_MAX, most)))
    fixed = np.zeros(28)
    fixed[COMMON] = np.where(np.isin(range(8), common), 0.0, start / SCALES)

    def numbers(x: Array) -> Array:
        """Return a row (28,) for each drop."""
        return np.asarray(fixed + np.append(x, 0.0)[index])

    def residuals(x: Array) -> Array:
        return np.concatenate([*map(Drop.residuals, drops, numbers(x))])

    def slopes(x: Array) -> Any:
        return sparse.block_diag([*map(Drop.slopes, drops, numbers(x), places)]) @ chosen

    found = least_squares(residuals, first.clip(low, high), slopes, (low, high), x_scale='jac',
                          ftol=1e-6, max_nfev=MAX_EVALUATIONS * count, tr_options=EXACT_STEPS)
    return _as_fit(drops, numbers(found.x), is_own, free, fixed_std)


def _as_fit(
    drops: Sequence[Drop], rows: Array, is_own: Array, free: tuple[int, ...],
    fixed_std: Array | None,
) -> ReleaseFit:
    """Return a fit from the numbers (28,) of each drop."""
    hessians, gradients, variances = (np.array(part) for part in zip(
        *map(_eliminated, drops, rows, is_own), strict=True))
    results = [drop.explained_by(row) for drop, row in zip(drops, rows, strict=True)]
    masses, at, total = np.array([drop.mass for drop in drops]), list(free), sum(hessians)
    inverse, covariance = np.linalg.pinv(total[np.ix_(at, at)]), np.zeros((8, 8))
    clusters = [np.eye(len(drops)), np.equal.outer(np.unique(masses), masses)]
    covariance[np.ix_(at, at)] = sum(_clustered(of_drop @ gradients[:, at], inverse)
                                     for of_drop in clusters if len(of_drop) > 2)
    if fixed_std is not None:  # the free numbers follow
        moves = np.diag(fixed_std / SCALES)
        moves[at] = -inverse @ total[at] @ moves
        covariance += moves @ moves.T
    scatter = OWN_STD * np.sqrt(np.maximum(
        np.var(rows[:, OWN_LAW], axis=0, ddof=1) - variances.mean(axis=0), 0.0))
    return ReleaseFit(
        as_law(SCALES * rows[0, COMMON]), free, np.outer(SCALES, SCALES) * covariance, scatter,
        tuple(map(_explained, drops, rows, results)))


def _eliminated(drop: Drop, row: Array, is_own: Array) -> tuple[Array, Array, Array]:
    """Return Hessian and gradient of the law after elimination of a drop's own numbers."""
    places = np.flatnonzero(is_own)
    J = drop.slopes(row, [*range(8), *places])
    matrix, gradient, variances = J.T @ J, J.T @ drop.residuals(row), np.zeros(28)
    inverse = np.linalg.inv(matrix[8:, 8:])
    gain, variances[places] = matrix[:8, 8:] @ inverse, np.diag(inverse)
    return (matrix[:8, :8] - gain @ matrix[8:, :8], gradient[:8] - gain @ gradient[8:],
            variances[OWN_LAW])


def _clustered(gradients: Array, inverse: Array) -> Array:
    """
    Return the covariance (n, n) from gradients (G, n) of clusters, by an inverse Hessian.

    The 95 % intervals follow Student's t with G - 1 degrees of freedom.
    """
    moves = (gradients - gradients.mean(axis=0)) @ inverse
    degrees = len(moves) - 1.0
    factor = stdtrit(degrees, 0.975) / ndtri(0.975)
    return np.asarray(factor**2 * len(moves) / degrees * moves.T @ moves)


def _explained(drop: Drop, row: Array, result: tuple[float, Array, Array]) -> Explained:
    """Return the residuals of a drop with numbers (28,), and the result of `explained_by`."""
    released, states, errors = result
    seconds, up = drop.package.seconds, np.array(drop.model[2]) / np.linalg.norm(drop.model[2])
    n, after = half_window(seconds), int(np.searchsorted(seconds[:-1], max(released, 0.0)))
    noise = np.repeat(np.maximum(drop.noise, 0.1 * np.array(MIN_NOISE)), 3)[:, None]
    return Explained(
        drop.mass, released - drop.valve if released >= 0.0 else math.nan,
        DELAY_STD * float(row[OWN_LAW][0]), _rms(up @ errors[:3]), _rms(up @ errors[3:6, n:-n]),
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
