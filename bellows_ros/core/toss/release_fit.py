"""
Identification of the law of release from drops of packages of one or more masses from rest.

The law's prediction is compared with the poses from shortly before each valve to the end of the
fall. The six numbers of the law are common to all drops, and each drop has its own delay and its
own constant offset of the package. `scipy.optimize.least_squares` minimises the squared residuals
of positions, and of velocities by local polynomials, over the logarithms of the numbers, with wide
priors for numbers that the drops do not determine. The covariance is the sum of two covariances
H^-1 (sum of g g^T) H^-1, with the Hessian H and the gradients g of clusters: single drops, and all
drops of a mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.equilibrium import adapted, largest_step
from bellows_ros.core.model.grip import Grip, Law, NO_FLIGHT, NO_LAW, RELEASE_NAMES
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import rest, row_state, tool_rows
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.toss import release as tossing
from bellows_ros.core.toss.landing import as_law
from bellows_ros.core.toss.release import NO_GRIP
from bellows_ros.errors import UndeterminedError, UnexplainedError
import numpy as np
import scipy  # whose parts are loaded as they are used

MIN_DROPS = 3
"""Smallest number of drops: two have no scatter beside their delays."""

TIME_AFTER_FALL = 0.3
"""Duration of a drop after the beginning of its fall, s: 0.44 m."""

REST_TOLERANCE = (1e-3, 0.01)
"""Largest displacement and rotation of a body at rest, m and rad."""

ORDER = 3
"""Order of the polynomials that give velocities."""

MIN_NOISE = 1e-4
"""Smallest standard deviation of positions in the fit, m: errors of the law itself."""
VELOCITY_SCALE = 40.0
"""Ratio of the standard deviations of velocities and positions, 1/s: of a window of 1/30 s."""

DELAY_STD = 2.5e-3
"""Prior standard deviation of the delay between drops, s: half a cycle of a 200 Hz controller."""
MAX_OWN = 5.0
"""Largest deviation of a drop's delay from the common one, prior standard deviations."""

OFFSET_STD = 1e-3
"""Prior standard deviation of the offset of a package at rest, m: of a static model."""

MAX_RMS = 1e-3
"""Largest RMS residual of the positions with which a law explains drops, m."""
MAX_CHI2 = 1.5
"""Largest chi^2 per position with which a law explains drops within their noise."""

TYPICAL_LAW: Law = (0.015, 0.02, 19.0, 0.02, 25.0, 2.4)
"""Law of a lengthening cup as the start of the fit, similar to the law of real drops."""
OPENING = 0.08
"""Time from the fall of the suction to the fall of a package by the typical law, s."""
PRIOR_STD = 1.0
"""Prior standard deviation of the logarithm of a number: within a factor of 7 at 95 %."""
MAX_RELATIVE_STD = 0.5
"""Largest relative standard error of an identifiable number, half the prior's."""

DIFFERENCE = 1e-2
"""Step of the derivatives by logarithms and by delays in prior standard deviations."""


@dataclass(frozen=True, eq=False)
class Drop:
    """
    One drop of a package that hangs at rest.

    Parameters
    ----------
    model, grip : tuple
        Model and grip for the kernels.
    tool, package : Trajectory
        E at rest and B, in the world, at common stamps: from before the valve until before the
        landing.
    start : State
        State of B at the first stamp.
    valve : float
        Time of the valve, s since the first stamp.
    noise : float
        Standard deviation of the package's positions, m.

    """

    model: ModelTuple
    grip: Grip
    tool: Trajectory
    package: Trajectory
    start: State
    valve: float
    noise: float

    @property
    def mass(self) -> float:
        """Mass of the package, kg."""
        return float(self.model[1][0])

    @cached_property
    def _inputs(self) -> tuple[Array, Array, float]:
        """Rows of the tool, times (s), and longest integration step (s)."""
        return tool_rows(self.tool), self.tool.seconds, largest_step(self.model)

    @cached_property
    def sizes(self) -> Array:
        """Standard deviations (6, 1) of positions and velocities in the fit."""
        position = max(self.noise, MIN_NOISE)
        return np.repeat([position, VELOCITY_SCALE * position], 3)[:, None]

    def predicted(self, law: Law) -> tuple[float, Array]:
        """Return the time of release (s since the first stamp, -1 without), and states (N, 13)."""
        rows, seconds, max_step = self._inputs
        states = np.empty((len(seconds), 13))
        released = tossing.write_toss(
            (self.model, self.grip, NO_FLIGHT._replace(law=law), self.valve),
            adapted(self.model, row_state(rows[0]), self.start), rows, seconds, max_step, states)
        return float(released), states

    def explained_by(self, numbers: Array) -> tuple[float, Array, Array]:
        """
        Return the time of release (s), states (N, 13) and residuals (6, N) for numbers (7,).

        The numbers are logarithms of the law, and the drop's delay in `DELAY_STD`. The residuals
        are of position (m) and velocity (m/s), measured minus predicted, less the likeliest
        constant offset.
        """
        law = np.exp(numbers[:6]) + [DELAY_STD * numbers[6], *(0.0,) * 5]
        released, states = self.predicted(as_law(np.maximum(law, 0.0)))
        seconds = self.package.seconds
        errors, n = np.zeros((6, len(seconds))), half_window(seconds)
        position = self.package.position - states[:, :3]
        errors[:3], errors[3:, n:-n] = position.T, _derivative(position, seconds, 1).T
        gain = len(states) * (OFFSET_STD / self.sizes[:3])**2
        errors[:3] -= (1.0 - (1.0 + gain)**-0.5) * errors[:3].mean(1, keepdims=True)
        return released, states, errors

    def residuals(self, numbers: Array) -> Array:
        """Return the whitened residuals of numbers (7,), and the own delay."""
        errors = self.explained_by(numbers)[2] / self.sizes
        return np.append(np.nan_to_num(errors, nan=1e6).clip(-1e6, 1e6), numbers[6])


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
    """Mean square of positions relative to the noise."""


class ReleaseFit(NamedTuple):
    """
    A fitted law of release, and its residuals.

    Parameters
    ----------
    law : Law
        The numbers of the law.
    covariance : ndarray (6, 6)
        Covariance of the numbers.
    scatter : float
        Standard deviation of the delay between drops, s.
    drops : tuple of Explained
        Residuals in the order of the given drops.

    """

    law: Law
    covariance: Array
    scatter: float
    drops: tuple[Explained, ...]

    @property
    def std(self) -> Array:
        """Standard errors (6,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def not_identifiable(self) -> tuple[int, ...]:
        """The numbers of the law that the drops hardly determine."""
        return tuple(np.flatnonzero(self.std > MAX_RELATIVE_STD * np.array(self.law)).tolist())

    @property
    def chi2(self) -> float:
        """Mean of chi^2 over the drops."""
        return float(np.mean([drop.chi2 for drop in self.drops]))

    @property
    def position(self) -> float:
        """RMS residual of the positions, m."""
        return _rms(np.array([drop.position for drop in self.drops]))

    def parameters(self) -> dict[str, Any]:
        """Return the parameters `release.*`, with the scatter between drops."""
        covariance = self.covariance + np.diag([self.scatter**2, *(0.0,) * 5])
        std = np.sqrt(np.diag(covariance))
        masses = [drop.mass for drop in self.drops]
        return {
            **dict(zip(RELEASE_NAMES, self.law, strict=True)),
            'release.std': tuple(std.tolist()),
            'release.correlation': tuple(np.clip(  # of rounding
                covariance / np.outer(std, std), -1.0, 1.0).ravel().tolist()),
            'release.mass_range': (min(masses), max(masses))}


def fit_release(drops: Sequence[Drop], given: Law = NO_LAW) -> ReleaseFit:
    """
    Return the law that explains drops.

    Parameters
    ----------
    drops : sequence of Drop
        Drops, at least `MIN_DROPS`.
    given : Law
        Expected numbers; `TYPICAL_LAW` for numbers of 0.

    Raises
    ------
    UndeterminedError
        If there are too few drops, or no law explains them.

    """
    if len(drops) < MIN_DROPS:
        raise UndeterminedError(
            f'The release needs {MIN_DROPS} or more usable drops, got {len(drops)}. Record more.')
    expected = np.log(np.where(np.array(given) > 0.0, given, TYPICAL_LAW))
    delay = max(float(np.median([*map(_fall, drops)])) - OPENING, 0.3 * TYPICAL_LAW[0])
    fit = _as_fit(drops, _fitted(drops, np.append(np.log(delay), expected[1:]), expected))
    latest = max(abs(drop.own_delay) for drop in fit.drops)
    if latest < MAX_OWN * DELAY_STD and (fit.position <= MAX_RMS or fit.chi2 <= MAX_CHI2):
        return fit
    raise UnexplainedError(
        f'No law of release explains the drops: it leaves {1e3 * fit.position:.2g} mm of their '
        f'positions (rms, chi2 per position {fit.chi2:.3g}), with instants off by up to '
        f'{1e3 * latest:.2g} ms; expected less than {1e3 * MAX_RMS:g} mm, and '
        f'{1e3 * MAX_OWN * DELAY_STD:g} ms. The likeliest cause is a wrong package.mass, '
        'cup.stiffness or cup.length, or a valve stamped by another clock.')


def _fall(drop: Drop) -> float:
    """Return the time from the valve to the last fall of a package, s."""
    position, seconds = drop.package.position, drop.package.seconds
    return float(seconds[free_fall_samples(position, seconds, drop.model[2])[0]] - drop.valve)


def _fitted(drops: Sequence[Drop], start: Array, expected: Array) -> Any:
    """Return the result of a fit: the logarithms (6,) of the law, and the own delays (N,)."""
    count = len(drops)

    def residuals(x: Array) -> Array:
        parts = [drop.residuals(np.append(x[:6], own)) for drop, own in zip(
            drops, x[6:], strict=True)]
        return np.concatenate([*parts, (x[:6] - expected) / PRIOR_STD])

    def slopes(x: Array) -> Array:
        steps = DIFFERENCE * np.eye(7, 6 + count)
        steps[6] = DIFFERENCE * (np.arange(6 + count) >= 6)  # each drop has its own delay
        *of_law, of_own = (
            (residuals(x + step) - residuals(x - step)) / (2.0 * DIFFERENCE) for step in steps)
        ends = np.cumsum([6 * len(drop.package) + 1 for drop in drops])
        return np.column_stack([*of_law, scipy.linalg.block_diag(
            *np.split(of_own[:, None], ends)[:-1], np.empty((6, 0)))])

    middle, own = np.append(expected, np.zeros(count)), np.zeros(count)
    reach = np.append(np.full(6, 5.0 * PRIOR_STD), np.full(count, 2.0 * MAX_OWN))
    return scipy.optimize.least_squares(
        residuals, np.append(start, own), slopes, (middle - reach, middle + reach),
        x_scale='jac', ftol=1e-6, max_nfev=60)


def _as_fit(drops: Sequence[Drop], result: Any) -> ReleaseFit:
    """Return a fit from the logarithms (6,) of the law and the own delays (N,)."""
    law, own = np.exp(result.x[:6]), result.x[6:]
    hessian, gradients, variances, first = np.eye(6) / PRIOR_STD**2, [], [], 0
    for k, drop in enumerate(drops):
        rows = slice(first, first := first + 6 * len(drop.package) + 1)
        J = result.jac[rows][:, [*range(6), 6 + k]]
        matrix, gradient = J.T @ J, J.T @ result.fun[rows]
        gain = matrix[:6, 6] / matrix[6, 6]  # the own delay is eliminated
        hessian += matrix[:6, :6] - np.outer(gain, matrix[6, :6])
        gradients.append(gradient[:6] - gain * gradient[6])
        variances.append(1.0 / matrix[6, 6])
    inverse, masses = np.linalg.inv(hessian), np.array([drop.mass for drop in drops])
    clusters = [np.eye(len(drops)), np.equal.outer(np.unique(masses), masses)]
    covariance = inverse @ inverse / PRIOR_STD**2  # of the prior, and of the drops
    for of_drop in clusters:
        if len(of_drop) > 2:
            covariance += _clustered(of_drop @ np.array(gradients), np.asarray(inverse))
    scatter = DELAY_STD * math.sqrt(max(np.var(own, ddof=1) - np.mean(variances), 0.0))
    return ReleaseFit(as_law(law), np.outer(law, law) * covariance, scatter, tuple(
        _explained(drop, np.append(result.x[:6], each))
        for drop, each in zip(drops, own, strict=True)))


def _clustered(gradients: Array, inverse: Array) -> Array:
    """
    Return the covariance (n, n) from gradients (G, n) of clusters, by an inverse Hessian.

    The 95 % intervals follow Student's t with G - 1 degrees of freedom.
    """
    moves = (gradients - gradients.mean(axis=0)) @ inverse
    degrees = len(moves) - 1.0
    factor = scipy.special.stdtrit(degrees, 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(factor**2 * len(moves) / degrees * moves.T @ moves)


def _explained(drop: Drop, row: Array) -> Explained:
    """Return the residuals of a drop with numbers (7,)."""
    released, states, errors = drop.explained_by(row)
    seconds, up = drop.package.seconds, np.array(drop.model[2]) / np.linalg.norm(drop.model[2])
    n, after = half_window(seconds), int(np.searchsorted(seconds[:-1], max(released, 0.0)))
    return Explained(
        drop.mass, released - drop.valve if released >= 0.0 else math.nan,
        DELAY_STD * float(row[6]), _rms(up @ errors[:3]), _rms(up @ errors[3:, n:-n]),
        float(np.linalg.norm(states[after, 7:10])),
        _rms(errors[:3] / max(drop.noise, 0.1 * MIN_NOISE))**2)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# ---------------------------------------------------------------------- drops of a recording


def half_window(seconds: Array) -> int:
    """Return the half window (samples) of velocities, 1/60 s, of samples at times (s)."""
    return max(2, round(1.0 / 60.0 / float(np.median(np.diff(seconds)))))


def _derivative(values: Array, seconds: Array, order: int) -> Array:
    """Return a derivative (N - 2 n, M) of local polynomials, without half windows at the ends."""
    n = half_window(seconds)
    return np.asarray(scipy.signal.savgol_filter(
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
    after = int(np.searchsorted(package.stamps_ns, valve_ns))
    if not (_stands(tool, 3.0) and _stands(package.select(slice(0, max(after, 1))))):  # it recoils
        raise UndeterminedError('tool or package moves; expected a drop from rest')
    first, last = free_fall_samples(package.position[after:], package.seconds[after:], model[2])
    fallen = package.seconds[after + first] + TIME_AFTER_FALL
    package = package.select(slice(0, min(
        after + last + 1, int(np.searchsorted(package.seconds, fallen, 'right')))))
    count = len(package)
    tool = Trajectory(package.stamps_ns, np.tile(tool.position.mean(axis=0), (count, 1)),
                      np.tile(tool.rotation[len(tool) // 2], (count, 1, 1)), np.zeros((count, 6)))
    return Drop(model, grip, tool, package, rest(model, tool_rows(tool)[0]),
                (valve_ns - int(package.stamps_ns[0])) / NS_PER_S,
                recording.noise[1].position)


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
