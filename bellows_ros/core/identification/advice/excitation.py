"""
What recordings can tell about a cup, said before anything is fitted.

A parameter is told by what the motion changes in its direction. What the sensors add there looks
like motion, too, but tells nothing, and makes least squares find too little (errors in variables):
its part in the equations, and the shift that comes from it, are computed by adding noise of the
same kind once more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.evidence import (
    Evidence,
    evidence_of,
    relative_spectra,
    Spectra,
)
from bellows_ros.core.identification.advice.pass_band import too_fast
from bellows_ros.core.identification.advice.told import advice, Told
from bellows_ros.core.identification.regression.least_squares import (
    column_sizes,
    regular,
    Samples,
    whitening_of,
)
from bellows_ros.core.identification.regression.moments import joined, Moments
from bellows_ros.core.identification.regression.triangles import triangle
from bellows_ros.core.identification.structure import AXES, Structure
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_RATIO = 0.5
"""An estimate that noise of the same size shrinks by more than this is off by its own size."""

RANK_WITHIN = 1e-6
"""Singular values below this part of the largest, with columns of unit length, tell nothing."""

IN_NULL_SPACE = 0.05
"""A parameter that has at least this part in a direction of which nothing is told is not told."""

CORRELATED = 0.95
"""Parameters with estimates correlated by more than this can hardly be told apart."""


@dataclass(frozen=True, eq=False)
class Axis:
    """
    How one direction is excited.

    Parameters
    ----------
    name : str
        'x' to 'rz'.
    strain, motion : float
        RMS of the lip's displacement in the tool from the nominal pose, and from its own mean; m
        or rad.
    twist : float
        RMS of its velocity, m/s or rad/s.
    band_hz : (float, float)
        Frequencies between which 90 % of the velocity's power lies; nan where nothing moves.
    strain_noise, twist_noise : float
        Standard deviation of the noise in them after filtering; nan where it is not known.

    """

    name: str
    strain: float
    motion: float
    twist: float
    band_hz: tuple[float, float]
    strain_noise: float
    twist_noise: float


@dataclass(frozen=True, eq=False)
class Excitation:
    """
    What recordings can tell.

    Parameters
    ----------
    structure : str
        The structure of K and P that was asked for.
    axes : tuple of Axis
        The six directions.
    parameters : tuple of Told
        The free parameters.
    rank, size : int
        How many combinations of parameters are told, of how many.
    condition_number : float
        Of the whitened equations with columns of unit length.
    pairs : tuple of (str, str, float)
        Parameters that can hardly be told apart, and the correlation of their estimates.
    warnings : tuple of str
        What the user should know and do, in sentences.
    spectra : tuple of Spectra
        Of each recording, where the recordings themselves were described.

    """

    structure: str
    axes: tuple[Axis, ...]
    parameters: tuple[Told, ...]
    rank: int
    size: int
    condition_number: float
    pairs: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]
    spectra: tuple[Spectra, ...] = ()

    @property
    def untold(self) -> tuple[str, ...]:
        """Labels of the parameters that nothing but noise tells."""
        return tuple(told.label for told in self.parameters if told.untold)


@dataclass(frozen=True, eq=False)
class _Solved:
    """A solution of whitened equations: x, nan where nothing is told, and how well it is told."""

    x: Array
    norm: Array
    rank: int
    condition_number: float
    correlation: Array


def describe_excitation(
    recordings: Sequence[Samples],
    cup_length: float,
    structure: Structure,
    noises: Sequence[FilterNoise] = (),
    filtered: bool = True,
) -> Excitation:
    """
    Say what recordings can tell about K and P.

    Parameters
    ----------
    recordings : sequence of Samples
        Prepared recordings.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries are to be found.
    noises : sequence of FilterNoise, optional
        Of each recording; without them nothing is said about noise.
    filtered : bool
        Whether to warn of what biases least squares of filtered motion: noise, and what is too
        fast for the filter.

    Raises
    ------
    BellowsError
        If there is no valid sample, or there are noises of some recordings only.

    """
    recordings = list(recordings)
    if noises and len(noises) != len(recordings):
        raise BellowsError(f'{len(recordings)} recordings need as many noises, not {len(noises)}.')
    _require_samples(sum(samples.count for samples in recordings))
    spectra = [relative_spectra(samples, cup_length) for samples in recordings]
    known: Sequence[FilterNoise | None] = noises or [None] * len(recordings)
    parts = [
        evidence_of(samples, cup_length, structure, noise, seen)
        for samples, noise, seen in zip(recordings, known, spectra, strict=True)
    ]
    found = excitation_of(parts, structure, filtered)
    warnings = found.warnings
    if filtered:
        rates_hz = [uniform_rate_hz(samples.package.stamps_ns) for samples in recordings]
        twists = [recording.twist for recording in spectra]
        warnings += tuple(too_fast(found.axes, twists, rates_hz, noises))
    return replace(found, spectra=tuple(spectra), warnings=warnings)


def excitation_of(
    parts: Sequence[Evidence], structure: Structure, filtered: bool = True
) -> Excitation:
    """
    Say what recordings can tell about K and P, from the evidence of each.

    Raises
    ------
    BellowsError
        If there is no valid sample.

    """
    wrench = joined(part.wrench for part in parts)
    _require_samples(wrench.count)
    whitening = whitening_of(regular(wrench.covariance(structure)))
    solved = _solve(_triangle(parts, 0, whitening), structure)
    shares, bias = _noise_effects(parts, structure, whitening, solved)
    parameters = tuple(
        Told(label, float(x), 1.0 if np.isnan(x) else float(share), float(off))
        for label, x, share, off in zip(structure.labels, solved.x, shares, bias, strict=True)
    )
    pairs = tuple(_pairs(solved, structure.labels))
    source = 'this recording' if len(parts) == 1 else 'these recordings'
    return Excitation(
        structure.name, _axes(parts), parameters, solved.rank, len(solved.x),
        solved.condition_number, pairs,
        tuple(advice(parameters, structure, solved.rank, pairs, source, filtered)),
    )  # fmt: skip


def _require_samples(count: int) -> None:
    """Raise BellowsError if there is no valid sample."""
    if not count:
        raise BellowsError('No valid sample is left of which to say what it tells.')


def _triangle(parts: Sequence[Evidence], draw: int, whitening: Array) -> Array:
    """Return the triangle of the whitened equations, as they are (0) or with noise once more."""
    size = parts[0].rows.shape[-1]
    return triangle(((whitening @ part.rows[draw]).reshape(-1, size) for part in parts), size)


def _solve(R: Array, structure: Structure) -> _Solved:
    """Solve the equations of a triangle as far as they tell something."""
    unit = column_sizes(R[:-1, :-1], structure)
    U, singular, Vt = np.linalg.svd(R[:-1, :-1] / unit)
    told = singular > RANK_WITHIN * singular[0]
    inverse = (Vt[told].T / singular[told]) @ U[:, told].T
    x = inverse @ R[:-1, -1] / unit
    gram = inverse @ inverse.T
    spread = np.sqrt(np.diag(gram))
    untold = (spread == 0.0) | np.any(np.abs(Vt[~told]) > IN_NULL_SPACE, axis=0)
    safe = np.where(untold, 1.0, spread)
    correlation = np.where(untold | untold[:, None], 0.0, gram / np.outer(safe, safe))
    return _Solved(
        np.where(untold, np.nan, x),
        np.where(untold, 0.0, unit / safe),
        int(np.count_nonzero(told)),
        float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
        correlation,
    )


def _noise_effects(
    parts: Sequence[Evidence], structure: Structure, whitening: Array, solved: _Solved
) -> tuple[Array, Array]:
    """
    Return the share of noise in what tells each parameter, and the bias that it causes.

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
    again = [_solve(_triangle(parts, draw, whitening), structure).x for draw in draws]
    later = np.mean(again, axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        share = np.minimum(energy / solved.norm**2, 1.0)
        return share, 1.0 - 1.0 / np.maximum(later / solved.x, SMALLEST_RATIO)


def _axes(parts: Sequence[Evidence]) -> tuple[Axis, ...]:
    """Return how the six directions are excited."""
    strain, twist, strain_noise, twist_noise = (
        joined(getattr(part, kind) for part in parts)
        for kind in ('strain', 'twist', 'strain_noise', 'twist_noise')
    )
    columns = (
        _rms(strain), strain.std, _rms(twist), _bands(parts).T.tolist(), strain_noise.std,
        twist_noise.std,
    )  # fmt: skip
    return tuple(
        Axis(name, float(lip), float(motion), float(rate), (low, high), float(shake), float(hum))
        for name, lip, motion, rate, (low, high), shake, hum in zip(AXES, *columns, strict=True)
    )


def _bands(parts: Sequence[Evidence]) -> Array:
    """Return the frequencies (2, 6) in Hz between which most of the velocities' power lies."""
    ends = np.array([part.bands_hz for part in parts])
    known = np.isfinite(ends[:, 0])
    low = np.where(known, ends[:, 0], np.inf).min(axis=0)
    high = np.where(known, ends[:, 1], -np.inf).max(axis=0)
    return np.where(known.any(axis=0), np.array([low, high]), np.nan)


def _rms(moments: Moments) -> Array:
    """Return the root mean squares (6,)."""
    return np.asarray(np.hypot(moments.mean, moments.std))


def _pairs(solved: _Solved, labels: Sequence[str]) -> Iterator[tuple[str, str, float]]:
    """Yield the pairs of parameters that can hardly be told apart, the worst first."""
    upper = np.abs(np.triu(solved.correlation, 1))
    for flat in np.argsort(-upper, axis=None):
        i, j = divmod(int(flat), upper.shape[1])
        if upper[i, j] <= CORRELATED:
            return
        yield labels[i], labels[j], float(solved.correlation[i, j])
