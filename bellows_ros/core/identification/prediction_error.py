"""
Prediction-error method: K and P that predict every measured pose from those before it.

The equations of motion hold along the true motions of tool and package; noise of their measured
poses makes errors in them whose covariance is known. In units of it the errors are one-step
prediction errors, whose squares are minimised (see `minimum`).

To first order the estimates are off by H^-1 g, with H the information and g the gradient at the
truth. What the noise model says of g is H itself; what the recordings say is how they scatter
without one second or another, which needs no noise model (the jackknife, robust by clusters). Few
seconds give variances badly; these lean on what all parameters have in common. Noise that is
left in the motion that is linearised about looks like information: how much it adds is seen by
adding as much again.
"""

from collections.abc import Callable, Sequence

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.equations import without
from bellows_ros.core.identification.minimum import Found, Root, Search
from bellows_ros.core.identification.motion_equations import Segment
from bellows_ros.core.identification.quantities import KINDS
from bellows_ros.core.identification.result import (
    condition,
    excess,
    Fit,
    Freed,
    Iteration,
    LARGEST_ERROR,
    left_out,
    MEDIAN_OF_NORMAL,
    misfit,
)
from bellows_ros.core.identification.segments import Measured, SMALLEST
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.errors import BellowsError
import numpy as np

Progress = Callable[[Iteration], None]


SHORTEST_COLOUR = 0.6
"""Autocorrelation between successive poses below which noise is treated as white."""

SOFTEST = 0.05
"""Smallest scaled eigenvalue of K and P at the start of the search for definite matrices."""

NOT_CONVERGED = (
    'The search for the minimum of the prediction errors did not converge: K and P must not be '
    'used, and there are no standard errors. Use a simpler fit.structure, or record a motion '
    'that is richer in all directions.')


def prediction_error(
    recordings: list[Measured],
    structure: Structure,
    start: Cup,
    progress: Progress | None = None,
    free: Sequence[str] = (),
) -> Fit:
    """
    Fit K and P so that the model predicts every measured pose from those before it.

    Parameters
    ----------
    recordings : list of Measured
        Segments of recordings of one cup.
    structure : Structure
        Which entries of K and P are free; K is positive definite and P positive semidefinite.
    start : Cup
        First guess, as from least squares, with the nominal length l0.
    progress : callable, optional
        Called with every iteration.
    free : sequence of str
        What else is found, of `KINDS`.

    Raises
    ------
    BellowsError
        If nothing can be compared.

    """
    if not any(r.package.valid.any() for r in recordings):
        raise BellowsError('No valid package pose is left for comparison. The report shows why.')
    search = Search([Segment(r) for r in recordings], structure, start, free)
    iterations: list[Iteration] = []

    def note(theta: Array, chi2: float) -> None:
        cup = search.cup(theta)
        iterations.append(Iteration(len(iterations), chi2, cup.stiffness, cup.damping))
        if progress is not None:
            progress(iterations[-1])

    return _fit(search, search.found(note), iterations)


def _definite(search: Search, found: Found) -> Array:
    """Return the parameters of the likeliest definite K and P."""
    cup = search.cup(found.theta)
    if np.linalg.eigvalsh(cup.stiffness)[0] > 0.0 and np.linalg.eigvalsh(cup.damping)[0] >= 0.0:
        return found.theta
    scales = np.split(search.units[:search.count], 2)
    roots = [np.sqrt(np.diag(search.structure.matrices(np.concatenate([s, s]))[0]))
             for s in scales]
    units = np.array([
        np.array(search.structure.basis) * s[:, None, None] / np.outer(root, root)
        for s, root in zip(scales, roots, strict=True)])
    inside = found.theta.copy()
    for half, unit in enumerate(units):
        index = slice(half * len(unit), (half + 1) * len(unit))
        values, vectors = np.linalg.eigh(np.tensordot(found.theta[index], unit, axes=1))
        lifted = (vectors * np.maximum(values, SOFTEST)) @ vectors.T
        inside[index] = search.structure.parameters(
            lifted * np.outer(roots[half], roots[half]), lifted)[:len(unit)] / scales[half]
    return minimum_in_cone(found.information, found.theta, inside, units)


def _fit(search: Search, found: Found, iterations: list[Iteration]) -> Fit:
    """Return the result: a definite K and P, and the covariance of what is identifiable."""
    size, unit = search.count, search.units
    covariance = _covariance(search, found) * np.outer(unit, unit)
    std = np.sqrt(np.diag(covariance))
    known = (std <= _largest_errors(search, found.theta)) & found.converged
    x, std = unit * _definite(search, found), np.where(known, std, np.inf)
    measured = [segment.measured for segment in search.segments]
    used = int(sum(np.count_nonzero(m.package.valid) for m in measured))
    r = np.concatenate([part.innovations for part in found.parts])
    robust_chi2 = float((np.median(np.abs(r)) / MEDIAN_OF_NORMAL) ** 2)
    noise = np.concatenate([own[:, :6] for own in found.noise])
    offsets = search.places.get('time_offset', np.empty(0, np.int64)).ravel()
    return Fit(
        method='prediction_error',
        structure=search.structure.name,
        parameters=x[:size],
        covariance=without(covariance[:size, :size], ~known[:size]),
        samples_used=used,
        samples_rejected=sum(len(m.package) for m in measured) - used,
        condition_number=condition(found.information[:size, :size]),
        weight=np.diag(search.noises(search.segments[0], search.kept)[0].std ** -2),
        residual_rms=np.sqrt(np.mean(noise**2, axis=0)),
        notes=() if found.converged else (NOT_CONVERGED,),
        misfit=' '.join(filter(None, (_colour(search), misfit(robust_chi2)))),
        chi2=_squares(search, found.theta) / max(len(r) - len(x), 1),
        robust_chi2=robust_chi2,
        converged=found.converged,
        iterations=tuple(iterations),
        delays=tuple(x[offsets].tolist()),
        delays_std=tuple(std[offsets].tolist()),
        freed=tuple(
            Freed(name, tuple(x[own].tolist()), tuple(std[own].tolist()))
            for name, (own, *_) in search.places.items() if not KINDS[name].each),
    )


def _colour(search: Search) -> str:
    """Return a sentence if the noise is correlated in time."""
    kept, period = max(search.kept), search.segments[0].period
    if kept <= SHORTEST_COLOUR:
        return ''
    return (
        f'The noise is correlated over {-1e3 * period / np.log(kept):.0f} ms, perhaps by '
        'smoothing in the motion capture. The standard errors account for it; unsmoothed '
        'poses give smaller ones.')


LAST_WEIGHT = 1e-3
"""Final weight of the barrier function."""

FALL = 5.0
"""Factor by which the weight falls from stage to stage."""

CONE_STEPS = 100
CONE_NEAR = 1e-6
"""Newton decrement at which a stage of the constrained minimisation ends."""


def minimum_in_cone(H: Array, best: Array, inside: Array, units: Array) -> Array:
    """
    Return the x nearest to the best one, in the metric H, whose K and P are positive definite.

    By Newton's method on (x - best)^T H (x - best) / 2 with a barrier, -log det of both matrices,
    whose weight falls in stages. Steps are damped so that they never leave the cone.

    Parameters
    ----------
    H, best : ndarray (n, n), (n,)
        H positive definite. Parameters beyond those of K and P are not constrained.
    inside : ndarray (n,)
        Where K and P are definite.
    units : ndarray (2, k, 6, 6)
        What K and P are sums of, times the first k parameters and the next k: scaled so that
        their diagonals are near one.

    """
    x = inside
    weight = max(float((x - best) @ H @ (x - best)), LAST_WEIGHT)
    while True:
        for _ in range(CONE_STEPS):
            slope, curvature = _barrier(x, units)
            total = H + weight * curvature
            step = -np.linalg.solve(total, H @ (x - best) + weight * slope)
            decrement = float(np.sqrt(step @ total @ step / weight))
            x = x + step * (1.0 if decrement < 0.25 else 1.0 / (1.0 + decrement))
            if decrement < CONE_NEAR:
                break
        if weight <= LAST_WEIGHT:
            return x
        weight = max(weight / FALL, LAST_WEIGHT)


def _barrier(x: Array, units: Array) -> tuple[Array, Array]:
    """Return gradient (n,) and Hessian (n, n) of -log det K - log det P."""
    slope, curvature = np.zeros(len(x)), np.zeros((len(x), len(x)))
    size = units.shape[1]
    for half, unit in enumerate(units):
        index = slice(half * size, (half + 1) * size)
        turned = np.linalg.inv(np.tensordot(x[index], unit, axes=1)) @ unit
        slope[index] = -np.trace(turned, axis1=1, axis2=2)
        curvature[index, index] = np.einsum('aij,bji->ab', turned, turned)
    return slope, curvature


LEAST_SIGNAL = 0.05
"""Smallest share of the information on a direction that is taken to be signal."""


def _covariance(search: Search, found: Found) -> Array:
    """Return the covariance (m, m) of the unknowns, in their units."""
    directions, signal = _directions(found.information, _signal(search, found))
    scatter = excess(np.array([
        directions.T @ gradient for segment, part in zip(search.segments, found.parts, strict=True)
        for gradient in left_out(found.information, part, segment.period)]))
    if all(np.all(own.measured.package_noise.ripple <= SMALLEST) for own in search.segments):
        scatter = np.maximum(scatter, 1.0)  # what is left is no noise: rounding, interpolation
    return (directions * scatter / signal**2) @ directions.T


def _squares(search: Search, theta: Array) -> float:
    """Return the sum of squares of all innovations, those of outlying poses not weighted down."""
    return sum(
        float(np.sum(Root(own, search.noises(segment, search.kept), missing).innovations(
            own.errors) ** 2))
        for segment, own, missing in zip(
            search.segments, search.equations(theta), search.missing, strict=True))


def _signal(search: Search, found: Found) -> Array:
    """Return the information (m, m) without the contribution of noise in the motion."""
    rng = np.random.default_rng(0)
    cup = search.cup(found.theta)
    total = found.information.copy()
    for segment, part, noise in zip(search.segments, found.parts, found.noise, strict=True):
        fresh = rng.standard_normal(noise.shape)
        _, seen = part.root.noise(part.root.errors(fresh))
        left = part.root.accumulated(fresh - seen)
        added = -(part.jacobian.T @ part.jacobian)
        for side in (-1.0, 1.0):
            jacobian, _, _ = segment.linearised(
                cup, noise + side * left, search.free(found.theta, segment))
            J = part.root.whitened(search.by_numbers(segment, jacobian))
            added += 0.5 * J.T @ J
        total -= added
    return total


def _directions(information: Array, signal: Array) -> tuple[Array, Array]:
    """
    Return directions (m, m), uncorrelated and of unit variance by the information.

    With them comes the part of the information on each that is signal (m,).
    """
    root = np.linalg.cholesky(information)
    part = np.linalg.solve(root, np.linalg.solve(root, signal).T)
    values, vectors = np.linalg.eigh(0.5 * (part + part.T))
    return np.linalg.solve(root.T, vectors), np.maximum(values, LEAST_SIGNAL)


def _largest_errors(search: Search, theta: Array) -> Array:
    """
    Return the standard errors (m,) above which numbers are not identifiable, SI units.

    The size of an entry of K or P is the root of the product of its diagonals.
    """
    cup, largest = search.cup(theta), np.empty(len(theta))
    largest[:search.count] = LARGEST_ERROR * search.structure.sizes(cup.stiffness, cup.damping)
    for name, places in search.places.items():
        largest[places] = KINDS[name].known
    return largest
