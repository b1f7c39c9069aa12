"""
Which parts of a cup are identifiable from recordings, before anything is fitted.

What the motion changes in the direction of a parameter is information on it. What the sensors add
there looks like motion, too, but is none, and makes least squares find too little (errors in
variables). Its part in the equations, and the bias that it causes, are computed by adding noise of
the same kind once more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.advice.identifiability import (
    advice,
    Axis,
    Identifiability,
    LARGEST_SHARE,
)
from bellows_ros.core.identification.advice.information import Information
from bellows_ros.core.identification.advice.pass_band import too_fast
from bellows_ros.core.identification.equations.r_factors import r_factor, Solution, solution
from bellows_ros.core.identification.equations.whitening import (
    joined,
    Moments,
    regular,
    whitening_of,
)
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.structure import AXES, Structure, structure_named
from bellows_ros.errors import BellowsError
import numpy as np

SMALLEST_RATIO = 0.5
"""An estimate that noise of the same size shrinks by more than this is off by its own size."""

CORRELATED = 0.95
"""Parameters with estimates correlated by more than this can hardly be separated."""


@dataclass(frozen=True, eq=False)
class Excitation:
    """
    What is identifiable from recordings.

    Parameters
    ----------
    structure : str
        The structure of K and P that was asked for.
    axes : tuple of Axis
        The six directions.
    parameters : tuple of Identifiability
        The free parameters.
    rank, size : int
        How many combinations of parameters are identifiable, of how many.
    condition_number : float
        Of the whitened equations with columns of unit length.
    pairs : tuple of (str, str, float)
        Parameters that can hardly be separated, and the correlation of their estimates.
    warnings : tuple of str
        What the user should know and do, in sentences.

    """

    structure: str
    axes: tuple[Axis, ...]
    parameters: tuple[Identifiability, ...]
    rank: int
    size: int
    condition_number: float
    pairs: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Labels of the parameters on which there is no information but that of noise."""
        return tuple(own.label for own in self.parameters if not own.identifiable)


def found_by(
    fit: Fit, excitation: Excitation, source: str
) -> Excitation:
    """Return what recordings can tell with a fit's own verdicts on what is identifiable."""
    structure = structure_named(fit.structure)
    values = structure.parameters(fit.stiffness, fit.damping)
    known = np.isfinite(np.diag(fit.covariance))
    parameters = tuple(
        replace(own, value=float(value), noise_share=min(own.noise_share, LARGEST_SHARE))
        if seen else replace(own, value=np.nan, noise_share=1.0)
        for own, value, seen in zip(excitation.parameters, values, known, strict=True))
    spread = np.where(known, np.sqrt(np.diag(fit.covariance)), 1.0)
    pairs = tuple(_correlated(fit.covariance / np.outer(spread, spread), fit.labels))
    return replace(
        excitation, parameters=parameters, rank=int(np.count_nonzero(known)), pairs=pairs,
        warnings=tuple(advice(parameters, structure, len(known), pairs, source, False)))


def excitation_of(
    parts: Sequence[Information], structure: Structure, filtered: bool = True
) -> Excitation:
    """
    Return what of K and P is identifiable, from the information of each recording.

    Parameters
    ----------
    parts : sequence of Information
        Of each recording.
    structure : Structure
        Which entries are to be found.
    filtered : bool
        Whether to warn of what biases least squares of filtered motion: noise, and what is too
        fast for the filter.

    Raises
    ------
    BellowsError
        If there is no valid sample.

    """
    wrench = joined(part.wrench for part in parts)
    if not wrench.count:
        raise BellowsError('No valid sample is left: nothing is identifiable.')
    whitening = whitening_of(regular(wrench.covariance(structure)))
    found = solution(_r_factor(parts, 0, whitening), structure)
    x = np.where(found.identifiable, found.x, np.nan)
    shares, bias = _noise_effects(parts, structure, whitening, found)
    parameters = tuple(
        Identifiability(label, float(value), 1.0 if np.isnan(value) else float(share), float(off))
        for label, value, share, off in zip(structure.labels, x, shares, bias, strict=True)
    )
    axes, pairs = _axes(parts), tuple(_pairs(found, structure.labels))
    source = 'this recording' if len(parts) == 1 else 'these recordings'
    fast = too_fast(axes, [part.passed for part in parts if part.passed]) if filtered else ()
    return Excitation(
        structure.name, axes, parameters, found.rank, len(x), found.condition_number, pairs,
        (*advice(parameters, structure, found.rank, pairs, source, filtered), *fast))


def _r_factor(parts: Sequence[Information], draw: int, whitening: Array) -> Array:
    """Return the R factor of the whitened equations, as they are (0) or with noise once more."""
    size = parts[0].rows.shape[-1]
    return r_factor(((whitening @ part.rows[draw]).reshape(-1, size) for part in parts), size)


def _noise_effects(
    parts: Sequence[Information], structure: Structure, whitening: Array, found: Solution
) -> tuple[Array, Array]:
    """
    Return the share of noise in the information on each parameter, and its bias.

    Noise that is added once more shrinks the estimates again. An estimate that goes as 1 / (1 + n)
    with the noise's variance n, as that of one parameter does, was off before by 1 - x / x', where
    x' is the one with more noise. The share is the noise's energy in a parameter's own column,
    over the energy of the part of that column that no other parameter explains.
    """
    draws = range(1, min(len(part.rows) for part in parts))
    if not draws:
        return np.full(2 * structure.size, np.nan), np.full(2 * structure.size, np.nan)
    added = np.sum([part.added for part in parts], axis=0)
    energy = np.einsum('ab,pbc,ac->p', whitening, added, whitening)
    again = [solution(_r_factor(parts, draw, whitening), structure) for draw in draws]
    later = np.mean([np.where(noisy.identifiable, noisy.x, np.nan) for noisy in again], axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        share = np.minimum(energy * np.sum(found.inverse**2, axis=1), 1.0)
        return share, 1.0 - 1.0 / np.maximum(later / found.x, SMALLEST_RATIO)


def _axes(parts: Sequence[Information]) -> tuple[Axis, ...]:
    """Return how the six directions are excited."""
    strain, twist, strain_noise, twist_noise = (
        joined(getattr(part, kind) for part in parts)
        for kind in ('strain', 'twist', 'strain_noise', 'twist_noise')
    )
    columns = (
        _rms(strain), strain.std, _rms(twist), _bands(parts).T.tolist(), strain_noise.std,
        twist_noise.std,
    )
    return tuple(
        Axis(name, float(lip), float(motion), float(rate), (low, high), float(shake), float(hum))
        for name, lip, motion, rate, (low, high), shake, hum in zip(AXES, *columns, strict=True)
    )


def _bands(parts: Sequence[Information]) -> Array:
    """Return the frequencies (2, 6) in Hz between which most of the velocities' power lies."""
    ends = np.array([part.bands_hz for part in parts])
    known = np.isfinite(ends[:, 0])
    low = np.where(known, ends[:, 0], np.inf).min(axis=0)
    high = np.where(known, ends[:, 1], -np.inf).max(axis=0)
    return np.where(known.any(axis=0), np.array([low, high]), np.nan)


def _rms(moments: Moments) -> Array:
    """Return the root mean squares (6,)."""
    return np.asarray(np.hypot(moments.mean, moments.std))


def _pairs(found: Solution, labels: Sequence[str]) -> Iterator[tuple[str, str, float]]:
    """Yield the pairs of parameters that can hardly be separated, the worst first."""
    gram = found.inverse @ found.inverse.T
    spread = np.where(found.identifiable, np.sqrt(np.diag(gram)), np.inf)
    yield from _correlated(gram / np.outer(spread, spread), labels)


def _correlated(
    correlation: Array, labels: Sequence[str]
) -> Iterator[tuple[str, str, float]]:
    """Yield the pairs of parameters with nearly the same errors, the worst first."""
    upper = np.abs(np.triu(correlation, 1))
    for flat in np.argsort(-upper, axis=None):
        i, j = divmod(int(flat), upper.shape[1])
        if upper[i, j] <= CORRELATED:
            return
        yield labels[i], labels[j], float(correlation[i, j])
