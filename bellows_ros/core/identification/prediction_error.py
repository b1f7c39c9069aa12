"""
Prediction-error method: K, P and the start of every stretch from one-step prediction errors.

The innovations (see `innovations`) are whitened by their own covariance and their squares
minimised by SciPy's trust region with Huber's loss. The tool's noise enters as what it is, an
input error; outliers neither steer the state nor count by more than Huber lets them. False minima
are passed by starting with an observer that forgets quickly, as if the tool were noisier than it
is, and taking that away in stages: each begins where the last one ended.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import copy
from dataclasses import replace
import os
import time

from bellows_ros.core.equilibrium import static_equilibrium
from bellows_ros.core.identification.innovations import innovations, Observer, observer
from bellows_ros.core.identification.measured import Measured
from bellows_ros.core.identification.noise import Noise, TWIST_HALF_WINDOW, TWIST_ORDER
from bellows_ros.core.identification.parametrisation import Parametrisation
from bellows_ros.core.identification.result import definiteness_warnings, Fit, Iteration
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.lie import apply, exp_so3, rotation_to_quaternion
from bellows_ros.core.linearisation import displaced, largest_step
from bellows_ros.core.model import Cup, model_tuple
from bellows_ros.core.savgol import weights
from bellows_ros.core.simulation import state_row, tool_rows
from bellows_ros.core.trajectory import NS_PER_S, resample, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d
from scipy.optimize import least_squares as minimise

Array = NDArray[np.float64]
Progress = Callable[[Iteration], None]

INFLATIONS = (1.0,)
"""Tool noise of the early stages, in parts of the package's, beside the tool's own."""

SMALLEST_TOOL_PART = 1e-3
"""In the end the tool's noise is taken as at least this part: the observer needs some."""

SMALLEST_NOISE = Noise(2e-7, 2e-6)
"""Noise (m, rad) below which a stream is not taken to be: interpolation and rounding."""

HUBER_FROM = 3.0
"""Standard deviations from which an innovation counts linearly."""

STEP = 1e-4
"""Difference of the free numbers for derivatives; they are logarithms or near one."""

FARTHEST = 3.0
"""The free numbers stay this near to a stage's start: a factor of 20 in K and P."""

STEPS_PER_LARGEST = 0.4
"""Integration steps are longer than those of a simulation: 4e-5 of a motion is below noise."""

MOST_SUBSTEPS = 20
MOST_ITERATIONS = 60
FEWEST_STAGES = 6
"""Iterations that a fit takes at least, for telling progress."""

MORE_NOISE = 3
"""Times that noise is added to see what it contributes to the derivatives."""

NOTHING_KNOWN = 1e-9
"""Part of a free number's apparent information below which it is taken as none."""

LARGEST_CHI2 = 1.2
"""A chi^2 per degree of freedom above this is said to be too large."""


class _Stretch:
    """A stretch in the form of the kernels, with the state that its start is counted from."""

    def __init__(self, measured: Measured, cup: Cup) -> None:
        self.measured = measured
        package = measured.package
        self.package = np.hstack([package.position, rotation_to_quaternion(package.rotation)])
        self.durations = np.diff(package.stamps_ns) / NS_PER_S
        self.period = float(np.median(self.durations))
        self.noise = _at_least(measured.package_noise, SMALLEST_NOISE)
        per_second = 0.01
        pose = np.array([self.noise.position] * 3 + [self.noise.rotation] * 3)
        self.start_scale = np.concatenate([pose, pose / per_second])
        self._rows: dict[float, Array] = {}
        self.rest = static_equilibrium(self.model(cup), self.tool_state())
        self.origin = self._first_state()

    def with_more_noise(self, rng: np.random.Generator) -> '_Stretch':
        """Return the stretch with noise added of the size it has, and the same first state."""
        other = copy.copy(self)
        package, tool = self.measured.package, self.measured.tool
        noisy = _with_noise(package, self.noise, rng)
        other.package = np.hstack([noisy.position, rotation_to_quaternion(noisy.rotation)])
        other.measured = replace(
            self.measured,
            tool=_with_noise(tool, self.measured.tool_noise, rng, self.measured.tool_period),
        )
        other._rows = {}
        return other

    def tool_rows(self, delay: float = 0.0) -> Array:
        """Return the tool's rows at the package's stamps plus a delay (s)."""
        if delay not in self._rows:
            if len(self._rows) > 8:
                self._rows.clear()
            stamps = self.measured.package.stamps_ns + round(delay * NS_PER_S)
            self._rows[delay] = tool_rows(resample(self.measured.tool, stamps))
        return self._rows[delay]

    def tool_state(self) -> State:
        """Return the tool's first state."""
        row = self.tool_rows()[0]
        return state_row(row[:3], row[3:7], row[7:])

    def model(self, cup: Cup) -> ModelTuple:
        """Return cup, package and gravity for the kernels."""
        return model_tuple(cup, self.measured.held, self.measured.gravity)

    def observer(self, cup: Cup, inflation: float) -> Observer:
        """Return the observer for this cup with the tool's noise made larger."""
        part = max(inflation, SMALLEST_TOOL_PART)
        tool = Noise(
            float(np.hypot(self.measured.tool_noise.position, part * self.noise.position)),
            float(np.hypot(self.measured.tool_noise.rotation, part * self.noise.rotation)),
        )
        return observer(
            self.model(cup), self.tool_state(), self.rest, self.period,
            self.measured.tool_period, tool, self.noise,
        )  # fmt: skip

    def start(self, offset: Array) -> State:
        """Return the first state, offset (12,) in units of the start scale from the guess."""
        d = (offset * self.start_scale).tolist()
        o, q, v, w = displaced(self.origin, (d[0], d[1], d[2]), (d[3], d[4], d[5]))
        return (
            o, q,
            (v[0] + d[6], v[1] + d[7], v[2] + d[8]),
            (w[0] + d[9], w[1] + d[10], w[2] + d[11]),
        )  # fmt: skip

    def _first_state(self) -> State:
        """Return a guess of the first state: the package as it is seen, or hangs, at rest."""
        if not self.measured.package.valid[0]:
            return self.rest
        return state_row(self.package[0, :3], self.package[0, 3:], np.zeros(6))


def _with_noise(
    poses: Trajectory, noise: Noise, rng: np.random.Generator, period: float = 1.0
) -> Trajectory:
    """Return poses with white noise added, and twists with what it makes of them."""
    shift = noise.position * rng.standard_normal(poses.position.shape)
    turn = noise.rotation * rng.standard_normal(poses.position.shape)
    twist = None
    if poses.twist is not None:
        slope = weights(TWIST_HALF_WINDOW, TWIST_ORDER, 1.0 / period)[1]
        added = correlate1d(np.hstack([shift, turn]), slope, axis=0, mode='nearest')
        twist = poses.twist + added
    return Trajectory(
        poses.stamps_ns, poses.position + apply(poses.rotation, shift),
        poses.rotation @ exp_so3(turn), twist, valid=poses.valid,
    )  # fmt: skip


def _at_least(noise: Noise, smallest: Noise) -> Noise:
    return Noise(*(max(a, b) for a, b in zip(noise, smallest, strict=True)))


class _Objective:
    """
    The whitened innovations as a function of the free numbers.

    These are the chart's for K and P, 12 for the start of every stretch, and a delay (in ms) for
    every recording where delays are wanted.
    """

    def __init__(
        self, stretches: list[_Stretch], cup_length: float, chart: Parametrisation, delays: int
    ) -> None:
        self.stretches = stretches
        self.cup_length = cup_length
        self.chart = chart
        self.delays = delays
        self.inflation = 0.0
        self.pool = ThreadPoolExecutor(os.cpu_count() or 1)

    def with_more_noise(self, seed: int) -> '_Objective':
        """Return the same objective with as much noise again on all poses."""
        rng = np.random.default_rng(seed)
        noisier = [stretch.with_more_noise(rng) for stretch in self.stretches]
        return _Objective(noisier, self.cup_length, self.chart, self.delays)

    @property
    def size(self) -> int:
        """Number of free numbers."""
        return self.chart.size + 12 * len(self.stretches) + self.delays

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the free numbers."""
        return Cup(*self.chart.matrices(theta[: self.chart.size]), self.cup_length)

    def residuals(self, theta: Array) -> Array:
        """Return the whitened innovations of all stretches, one after the other."""
        cup = self.cup(theta)
        return np.concatenate(
            [self._of(i, cup, theta) for i in range(len(self.stretches))]
        )

    def jacobian(self, theta: Array) -> Array:
        """Return the derivatives of the residuals; columns are shared among the cores."""
        here = self.residuals(theta)
        ends = np.cumsum([0, *(6 * np.count_nonzero(s.measured.package.valid)
                               for s in self.stretches)])
        J = np.zeros((len(here), self.size))

        def column(j: int) -> None:
            moved = theta.copy()
            moved[j] += STEP
            cup = self.cup(moved)
            for i in self._touched(j):
                part = slice(ends[i], ends[i + 1])
                J[part, j] = (self._of(i, cup, moved) - here[part]) / STEP

        list(self.pool.map(column, range(self.size)))
        return J

    def _touched(self, j: int) -> list[int]:
        """Return the stretches that a free number has an effect on."""
        start = j - self.chart.size
        if start < 0:
            return list(range(len(self.stretches)))
        if start < 12 * len(self.stretches):
            return [start // 12]
        recording = start - 12 * len(self.stretches)
        return [i for i, s in enumerate(self.stretches) if s.measured.recording == recording]

    def _of(self, i: int, cup: Cup, theta: Array) -> Array:
        """Return the whitened innovations of one stretch."""
        stretch = self.stretches[i]
        filtering = stretch.observer(cup, self.inflation)
        begin = self.chart.size + 12 * i
        delay = 0.0
        if self.delays:
            first = self.chart.size + 12 * len(self.stretches)
            delay = 1e-3 * float(theta[first + stretch.measured.recording])
        model = stretch.model(cup)
        longest = largest_step(model) / STEPS_PER_LARGEST
        substeps = np.clip(np.ceil(stretch.durations / longest - 1e-9), 1, MOST_SUBSTEPS)
        valid = stretch.measured.package.valid
        e = innovations(
            model, stretch.start(theta[begin:begin + 12]), stretch.tool_rows(delay),
            stretch.package, valid, stretch.durations, substeps.astype(np.int64), filtering,
        )  # fmt: skip
        white = np.linalg.solve(np.linalg.cholesky(filtering.covariance), e[valid].T).T
        return np.nan_to_num(white.ravel(), nan=1e4, posinf=1e4, neginf=-1e4)


def prediction_error(
    recordings: list[Measured],
    cup_length: float,
    structure: Structure,
    start: Cup,
    progress: Progress | None = None,
    estimate_delay: bool = False,
) -> Fit:
    """
    Fit K and P so that the model predicts every measured pose from those before it.

    Parameters
    ----------
    recordings : list of Measured
        Stretches of recordings of one cup.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries of K and P are free; K is positive definite and P positive semidefinite by
        construction.
    start : Cup
        First guess, as from least squares.
    progress : callable, optional
        Called with every iteration.
    estimate_delay : bool
        Whether the time by which the tool's stamps are behind the package's is estimated for
        every recording, s.

    Raises
    ------
    BellowsError
        If nothing can be compared.

    """
    if not any(r.package.valid.any() for r in recordings):
        raise BellowsError('No valid package pose to compare with. See the report for why.')
    chart = _chart(structure, start)
    theta = chart.numbers(start.stiffness, start.damping)
    first = Cup(*chart.matrices(theta), cup_length)
    delays = 1 + max(r.recording for r in recordings) if estimate_delay else 0
    objective = _Objective(
        [_Stretch(r, first) for r in recordings], cup_length, chart, delays)
    theta = np.concatenate([theta, np.zeros(objective.size - chart.size)])
    log = _Log(objective, progress)
    for stage, inflation in enumerate(INFLATIONS):
        theta = _minimised(objective, theta, inflation, log, stage, 1e-3)
    theta = _minimised(objective, theta, 0.0, log, len(INFLATIONS), 1e-8)
    covariance, chi2 = _uncertainty(objective, theta)
    return _fit(objective, theta, covariance, chi2, log)


def _chart(structure: Structure, start: Cup) -> Parametrisation:
    """Return the parametrisation scaled by a start's diagonals, lifted where not positive."""
    scales = []
    for matrix in (start.stiffness, start.damping):
        diagonal = np.diag(matrix).copy()
        for part in (slice(0, 3), slice(3, 6)):  # metres and radians
            diagonal[part] = np.maximum(diagonal[part], 0.05 * np.abs(diagonal[part]).max())
        scales.append(diagonal)
    return Parametrisation(structure, *scales)


class _Log:
    """The iterations, told to whoever wants to know."""

    def __init__(self, objective: _Objective, progress: Progress | None) -> None:
        self.objective = objective
        self.progress = progress
        self.iterations: list[Iteration] = []
        self.began = time.perf_counter()

    def note(self, stage: int, theta: Array) -> None:
        """Keep one iteration."""
        r = self.objective.residuals(theta)
        stiffness, damping = self.objective.chart.matrices(theta[: self.objective.chart.size])
        iteration = Iteration(
            stage, len(self.iterations), float(np.mean(r**2)), stiffness, damping,
            time.perf_counter() - self.began,
        )  # fmt: skip
        self.iterations.append(iteration)
        if self.progress is not None:
            self.progress(iteration)


def _minimised(
    objective: _Objective, theta: Array, inflation: float, log: _Log, stage: int, tolerance: float
) -> Array:
    """Return the free numbers at the minimum with the observers of the given ones."""
    objective.inflation = inflation
    base = theta - 1.0  # SciPy takes the first trust region from the size of the numbers

    def jacobian(numbers: Array) -> Array:
        log.note(stage, base + numbers)
        return objective.jacobian(base + numbers)

    reach = np.concatenate(
        [np.full(objective.chart.size, FARTHEST),
         np.full(12 * len(objective.stretches), 1e5), np.full(objective.delays, 50.0)]
    )

    def residuals(numbers: Array) -> Array:
        return objective.residuals(base + numbers)

    found = minimise(
        residuals, np.ones_like(theta), jacobian,
        bounds=(1.0 - reach, 1.0 + reach), x_scale='jac', loss='huber', f_scale=HUBER_FROM,
        xtol=tolerance, ftol=tolerance, gtol=1e-12, max_nfev=MOST_ITERATIONS,
    )  # fmt: skip
    return np.asarray(base + found.x)


def _uncertainty(objective: _Objective, theta: Array) -> tuple[Array, float]:
    """
    Return the covariance of the free numbers and chi^2 per degree of freedom of the inliers.

    Noise in the poses is also in the derivatives, where it looks like information. How much it
    adds is seen by adding as much again; what is left is inverted, and where nothing is left the
    variance is infinite.
    """
    r = objective.residuals(theta)
    information = _information(objective, theta, r)
    noisier = np.mean(
        [_information(objective.with_more_noise(seed), theta, r) for seed in range(MORE_NOISE)],
        axis=0,
    )
    usual = np.abs(r) <= 2.0 * HUBER_FROM
    degrees = max(int(np.count_nonzero(usual)) - len(theta), 1)
    chi2 = float(np.sum(r[usual] ** 2)) / degrees
    inverse = _inverse(2.0 * information - noisier, information)
    return inverse @ information @ inverse * max(chi2, 1.0), chi2


def _information(objective: _Objective, theta: Array, residuals: Array) -> Array:
    """Return J^T J with Huber's weights."""
    J = objective.jacobian(theta)
    size: Array = np.abs(residuals)
    weight = np.minimum(HUBER_FROM / np.maximum(size, 1e-300), 1.0)
    return np.asarray((J * weight[:, None]).T @ J)


def _inverse(matrix: Array, scale_of: Array) -> Array:
    """Return the inverse, with huge entries along directions of which nothing is known."""
    scale = np.sqrt(np.maximum(np.diag(scale_of), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    known = np.maximum(values, NOTHING_KNOWN)
    return np.asarray((vectors / known) @ vectors.T / np.outer(scale, scale))


def _fit(
    objective: _Objective, theta: Array, covariance: Array, chi2: float, log: _Log
) -> Fit:
    """Return the result with uncertainties of the matrices' entries."""
    chart, structure = objective.chart, objective.chart.structure
    size = chart.size
    stiffness, damping = chart.matrices(theta[:size])
    slopes = chart.entry_slopes(theta[:size])
    entries = slopes @ covariance[:size, :size] @ slopes.T
    std = np.sqrt(np.maximum(np.diag(entries), 0.0)).reshape(2, 6, 6)
    flat = [
        36 * matrix + 6 * free[0][0] + free[0][1]
        for matrix in range(2) for free in structure.entries
    ]  # fmt: skip
    covariance_0 = objective.stretches[0].observer(objective.cup(theta), 0.0).covariance
    valid = [s.measured.package.valid for s in objective.stretches]
    whitened = objective.residuals(theta).reshape(-1, 6)
    rms = np.sqrt(np.mean(whitened**2, axis=0))
    warnings = list(definiteness_warnings(stiffness, damping, structure.name))
    if chi2 > LARGEST_CHI2:
        warnings.append(
            f'The model does not explain the recording: chi^2 per degree of freedom is {chi2:.2f} '
            'where 1 is expected. Check package.mass, package.com and the frames, or take a '
            'richer fit.structure.'
        )
    delays = theta[size + 12 * len(objective.stretches):]
    return Fit(
        method='prediction_error',
        structure=structure.name,
        stiffness=stiffness,
        damping=damping,
        stiffness_std=std[0],
        damping_std=std[1],
        covariance=entries[np.ix_(flat, flat)],
        labels=structure.labels,
        samples_used=int(sum(np.count_nonzero(v) for v in valid)),
        samples_rejected=int(sum(np.count_nonzero(~v) for v in valid)),
        condition_number=_condition(covariance[:size, :size]),
        weight=np.asarray(np.linalg.inv(covariance_0)),
        residual_rms=rms * np.sqrt(np.diag(covariance_0)),
        warnings=tuple(warnings),
        chi2=chi2,
        iterations=tuple(log.iterations),
        delays=tuple((1e-3 * delays).tolist()),
    )


def _condition(covariance: Array) -> float:
    """Return the condition number of the scaled problem behind a covariance."""
    scale = np.sqrt(np.diag(covariance))
    values = np.linalg.eigvalsh(covariance / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))
