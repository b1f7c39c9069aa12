"""
Prediction-error method: K and P that predict every measured pose from those before it.

The equations of motion hold along the true motions of tool and package; noise of their measured
poses makes errors in them whose covariance is known. In units of it the errors are one-step
prediction errors (see `whitening`), whose squares are minimised (see `minimum`).
"""

from collections.abc import Callable, Sequence
import time

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.equations import without
from bellows_ros.core.identification.prediction.covariance import Certainty, certainty
from bellows_ros.core.identification.prediction.equations import Segment
from bellows_ros.core.identification.prediction.free import KINDS
from bellows_ros.core.identification.prediction.minimum import Found, minimum_in_cone, Search
from bellows_ros.core.identification.prediction.segments import Measured
from bellows_ros.core.identification.result import (
    definiteness_warnings,
    Fit,
    Freed,
    Iteration,
    POSE_UNITS,
)
from bellows_ros.core.model import Cup
from bellows_ros.core.structure import Structure
from bellows_ros.errors import BellowsError
import numpy as np

Progress = Callable[[Iteration], None]

LARGEST_CHI2 = 1.2
"""A chi^2 per degree of freedom above this is said to be too large."""

SHORTEST_COLOUR = 0.6
"""Noise of which the next pose keeps less than this is as good as white."""

SOFTEST = 0.05
"""Eigenvalues of K and P where the search for definite ones begins, in scaled units."""

NOT_CONVERGED = (
    'The search for the minimum of the prediction errors has not converged: K and P are not to '
    'be used, and there are no standard errors. Take a simpler fit.structure, or record a motion '
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
        raise BellowsError('No valid package pose to compare with. See the report for why.')
    search = Search([Segment(r) for r in recordings], structure, start, free)
    iterations: list[Iteration] = []
    began = time.perf_counter()

    def note(theta: Array, chi2: float) -> None:
        cup = search.cup(theta)
        iterations.append(Iteration(
            0, len(iterations), chi2, cup.stiffness, cup.damping, time.perf_counter() - began))
        if progress is not None:
            progress(iterations[-1])

    found = search.found(note)
    sure = certainty(search, found)
    return _fit(search, found._replace(theta=_definite(search, found)), sure, iterations)


def _definite(search: Search, found: Found) -> Array:
    """Return the free numbers of the likeliest definite K and P."""
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


def _fit(
    search: Search, found: Found, sure: Certainty, iterations: list[Iteration]
) -> Fit:
    """Return the result with uncertainties of the matrices' entries."""
    size, structure, measured = search.count, search.structure, [
        segment.measured for segment in search.segments]
    cup = search.cup(found.theta)
    known = sure.identifiable & found.converged
    unit = search.units
    covariance = without((sure.covariance * np.outer(unit, unit))[:size, :size], ~known[:size])
    errors = structure.spread(np.sqrt(np.diag(covariance)))
    std = np.where(known, unit * np.sqrt(np.diag(sure.covariance)), np.inf)

    def of_name(numbers: Array, name: str) -> tuple[float, ...]:
        """Return the numbers of one name."""
        places = search.places.get(name)
        return () if places is None else tuple(numbers[places.ravel()].tolist())

    noise = np.concatenate([own[:, :6] for own in found.noise])
    used = int(sum(np.count_nonzero(m.package.valid) for m in measured))
    return Fit(
        method='prediction_error',
        structure=structure.name,
        stiffness=cup.stiffness,
        damping=cup.damping,
        stiffness_std=errors[0],
        damping_std=errors[1],
        covariance=covariance,
        labels=structure.labels,
        samples_used=used,
        samples_rejected=sum(len(m.package) for m in measured) - used,
        condition_number=_condition(found.information[:size, :size]),
        weight=np.diag(search.noises(search.segments[0], search.kept)[0].std ** -2),
        residual_rms=np.sqrt(np.mean(noise**2, axis=0)),
        residual_units=POSE_UNITS,
        warnings=(
            *definiteness_warnings(cup.stiffness, cup.damping, structure.name),
            *_doubts(search, sure), *(() if found.converged else (NOT_CONVERGED,))),
        chi2=sure.chi2,
        robust_chi2=sure.robust_chi2,
        converged=found.converged,
        iterations=tuple(iterations),
        delays=of_name((unit * found.theta), 'time_offset'),
        delays_std=of_name(std, 'time_offset'),
        freed=tuple(
            Freed(name, of_name(unit * found.theta, name), of_name(std, name))
            for name in search.places if not KINDS[name].each),
    )


def _doubts(search: Search, sure: Certainty) -> list[str]:
    """Return what must be said of the noise, and of a chi^2 per degree of freedom."""
    doubts = []
    kept, period = max(search.kept), search.segments[0].period
    if kept > SHORTEST_COLOUR:
        doubts.append(
            f'The noise is correlated over {-1e3 * period / np.log(kept):.0f} ms: motion capture '
            'smoothing? The standard errors allow for it; poses that are not smoothed give '
            'smaller ones.')
    if sure.robust_chi2 > LARGEST_CHI2:
        doubts.append(
            'The model does not explain the recording: chi^2 per degree of freedom is '
            f'{sure.robust_chi2:.2f} where 1 is expected. Check package.mass, package.com, the '
            'frames and whether one clock stamped both streams (else set fit.time_offset), or '
            'take a richer fit.structure.')
    return doubts


def _condition(information: Array) -> float:
    """Return the condition number of the scaled problem behind an information matrix."""
    scale = np.sqrt(np.diag(information))
    values = np.linalg.eigvalsh(information / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / max(values[0], 1e-300)))
