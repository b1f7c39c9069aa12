"""
Prediction-error method: K, P and the start of every stretch from one-step prediction errors.

The innovations (see `innovations`) are whitened by their own covariance and their squares
minimised by SciPy's trust region with Huber's loss. The tool's noise enters as what it is, an
input error; outliers neither steer the state nor count by more than Huber lets them. False minima
are passed by starting with an observer that forgets quickly, as if the tool were noisier than it
is, and taking that away in stages: each begins where the last one ended.
"""

from collections.abc import Callable
import math
import time

from bellows_ros.core.identification.prediction.certainty import Certainty, certainty, HUBER_FROM
from bellows_ros.core.identification.prediction.measured import Measured
from bellows_ros.core.identification.prediction.objective import Objective, Stretch
from bellows_ros.core.identification.prediction.parametrisation import (
    Neighbourhood,
    Parametrisation,
    semidefinite,
)
from bellows_ros.core.identification.result import definiteness_warnings, Fit, Iteration
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.identification.unknown import without
from bellows_ros.core.model import Cup
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[Iteration], None]

INFLATIONS = (1.0,)
"""Tool noise of the early stages, in parts of the package's, beside the tool's own."""

FARTHEST = 3.0
"""The free numbers stay this near to a stage's start: a factor of 20 in K and P."""

MOST_ROUNDS = 3
"""How often all stages are gone through where numbers end as far away as they may be."""

MOST_ITERATIONS = 60
LARGEST_CHI2 = 1.2
"""A chi^2 per degree of freedom above this is said to be too large."""


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
    if not any(r.counted.any() for r in recordings):
        raise BellowsError('No valid package pose to compare with. See the report for why.')
    chart = _chart(structure, start)
    theta = chart.numbers(start.stiffness, start.damping)
    first = Cup(*chart.matrices(theta), cup_length)
    delays = 1 + max(r.recording for r in recordings) if estimate_delay else 0
    objective = Objective(
        [Stretch(r, first) for r in recordings], cup_length, chart, delays)
    theta = np.concatenate([theta, np.zeros(objective.size - chart.size)])
    log = _Log(objective, progress)
    for _ in range(MOST_ROUNDS):
        for stage, inflation in enumerate(INFLATIONS):
            theta, _ = _minimised(objective, theta, inflation, log, stage, 1e-3)
        theta, limits = _minimised(objective, theta, 0.0, log, len(INFLATIONS), 1e-8)
        lost = _lost(chart, limits)
        if not lost.any():
            break
    near = chart.near(theta[: chart.size])
    theta[: chart.size] = 0.0
    objective = objective.with_chart(near)
    sure = certainty(objective, theta).without(lost)
    return _fit(objective, near, theta - sure.pull, sure, log.iterations)


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

    def __init__(self, objective: Objective, progress: Progress | None) -> None:
        self.objective = objective
        self.progress = progress
        self.iterations: list[Iteration] = []
        self.began = time.perf_counter()

    def note(self, stage: int, theta: Array) -> None:
        """Keep one iteration."""
        r = self.objective.residuals(theta)
        cup = self.objective.cup(theta)
        iteration = Iteration(
            stage, len(self.iterations), float(np.mean(r**2)), cup.stiffness, cup.damping,
            time.perf_counter() - self.began,
        )  # fmt: skip
        self.iterations.append(iteration)
        if self.progress is not None:
            self.progress(iteration)


def _minimised(
    objective: Objective, theta: Array, inflation: float, log: _Log, stage: int, tolerance: float
) -> tuple[Array, Array]:
    """Return the free numbers at the minimum, and at which end of their reach (-1, 1) they are."""
    from scipy.optimize import least_squares as minimise  # late: least squares need not load it

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
    return np.asarray(base + found.x), np.asarray(found.active_mask)


def _lost(chart: Parametrisation, limits: Array) -> Mask:
    """Return which numbers have gone as far as they may because nothing holds them; P may be 0."""
    lost: Mask = np.zeros(len(limits), dtype=bool)
    if chart.structure.name != 'full':  # there each number is a parameter
        half = chart.structure.size
        lost[:half] = limits[:half] != 0
        lost[half:chart.size] = limits[half:chart.size] > 0
    return lost


def _fit(
    objective: Objective, near: Neighbourhood, theta: Array, sure: Certainty,
    iterations: list[Iteration],
) -> Fit:  # fmt: skip
    """Return the result with uncertainties of the matrices' entries."""
    size, structure = near.size, near.structure
    stiffness, damping = near.matrices(theta[:size])
    damping = semidefinite(damping)
    covariance = without(
        sure.covariance[:size, :size] * np.outer(near.scale, near.scale), ~sure.told[:size])
    errors = structure.spread(np.sqrt(np.diag(covariance)))
    innovation = objective.prepared(theta)[0].filtering.covariance
    counted = [s.measured.counted for s in objective.stretches]
    whitened = objective.residuals(theta).reshape(-1, 6)
    rms = np.sqrt(np.mean(whitened**2, axis=0))
    first = objective.size - objective.delays
    std = np.where(sure.told, np.sqrt(np.diag(sure.covariance)), np.inf)
    return Fit(
        method='prediction_error',
        structure=structure.name,
        stiffness=stiffness,
        damping=damping,
        stiffness_std=errors[0],
        damping_std=errors[1],
        covariance=covariance,
        labels=structure.labels,
        samples_used=int(sum(np.count_nonzero(c) for c in counted)),
        samples_rejected=int(sum(np.count_nonzero(~c) for c in counted)),
        condition_number=_condition(sure.covariance[:size, :size]),
        weight=np.asarray(np.linalg.inv(innovation)),
        residual_rms=rms * np.sqrt(np.diag(innovation)),
        warnings=(
            *definiteness_warnings(stiffness, damping, structure.name), *_doubts(sure.chi2)),
        chi2=sure.chi2,
        iterations=tuple(iterations),
        delays=tuple((1e-3 * theta[first:]).tolist()),
        delays_std=tuple((1e-3 * std[first:]).tolist()),
    )


def _doubts(chi2: float) -> list[str]:
    """Return what must be said of a chi^2 per degree of freedom."""
    if chi2 <= LARGEST_CHI2:
        return []
    return [
        f'The model does not explain the recording: chi^2 per degree of freedom is {chi2:.2f} '
        'where 1 is expected. Check package.mass, package.com, the frames and whether one clock '
        'stamped both streams (else set fit.time_offset), or take a richer fit.structure.'
    ]


def _condition(covariance: Array) -> float:
    """Return the condition number of the scaled problem behind a covariance."""
    told = np.diag(covariance) > 0.0
    if not told.any():
        return math.inf
    scale = np.sqrt(np.diag(covariance)[told])
    values = np.linalg.eigvalsh(covariance[np.ix_(told, told)] / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))
