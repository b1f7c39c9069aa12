"""
What recordings can tell about a cup, said before anything is fitted.

A parameter is told by what the motion changes in its direction. What the sensors add there looks
like motion, too, but tells nothing, and makes least squares find too little (errors in variables):
its part in the equations, and the shift that comes from it, are computed by adding noise of the
same kind once more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bellows_ros.core.identification.advice.added_noise import FilterNoise, SEED, with_noise
from bellows_ros.core.identification.advice.pass_band import too_fast
from bellows_ros.core.identification.advice.told import advice, Told
from bellows_ros.core.identification.judgement.whiteness import (
    interpolated,
    Spectrum,
    spectrum,
)
from bellows_ros.core.identification.regression.least_squares import (
    BLOCK,
    column_sizes,
    regular,
    Samples,
    whitening_of,
    wrench_covariance,
)
from bellows_ros.core.identification.regression.rows import rows_of
from bellows_ros.core.identification.regression.triangles import triangle
from bellows_ros.core.identification.structure import AXES, Structure
from bellows_ros.core.identification.wrenches import lip_relative
from bellows_ros.core.lie import log_so3
from bellows_ros.core.trajectory import uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SMALLEST_RATIO = 0.5
"""An estimate that noise of the same size shrinks by more than this is off by its own size."""

DRAWS = 4
"""How often noise is added."""

ENOUGH = 20_000
"""Samples of a recording from which all but spectra are taken, to a percent; some more at most."""

RANK_WITHIN = 1e-6
"""Singular values below this part of the largest, with columns of unit length, tell nothing."""

IN_NULL_SPACE = 0.05
"""A parameter that has at least this part in a direction of which nothing is told is not told."""

CORRELATED = 0.95
"""Parameters with estimates correlated by more than this can hardly be told apart."""

BAND = 0.9
"""Part of the power of a velocity that its frequency band holds."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """
    Spectra of one recording's relative motion, six channels each.

    Parameters
    ----------
    strain, twist : Spectrum
        Of the lip's displacement from nominal (m, rad) and of its twist (m/s, rad/s), in the tool.

    """

    strain: Spectrum
    twist: Spectrum


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
    spectra : tuple of Spectra
        Of each recording.
    warnings : tuple of str
        What the user should know and do, in sentences.

    """

    structure: str
    axes: tuple[Axis, ...]
    parameters: tuple[Told, ...]
    rank: int
    size: int
    condition_number: float
    pairs: tuple[tuple[str, str, float], ...]
    spectra: tuple[Spectra, ...]
    warnings: tuple[str, ...]


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
    if not sum(samples.count for samples in recordings):
        raise BellowsError('No valid sample is left of which to say what it tells.')
    if noises and len(noises) != len(recordings):
        raise BellowsError(f'{len(recordings)} recordings need as many noises, not {len(noises)}.')
    rates_hz = [uniform_rate_hz(samples.package.stamps_ns) for samples in recordings]
    spectra = tuple(_spectra(samples, cup_length) for samples in recordings)
    recordings = [samples.thinned(ENOUGH) for samples in recordings]
    whitening = whitening_of(regular(wrench_covariance(recordings, structure)))
    solved = _solve(_triangle(recordings, cup_length, structure, whitening), structure)
    shares, bias = _noise_effects(recordings, cup_length, structure, whitening, noises, solved)
    parameters = tuple(
        Told(label, float(x), 1.0 if np.isnan(x) else float(share), float(off))
        for label, x, share, off in zip(structure.labels, solved.x, shares, bias, strict=True)
    )
    axes = _axes(recordings, cup_length, noises, spectra)
    pairs = tuple(_pairs(solved, structure.labels))
    source = 'this recording' if len(recordings) == 1 else 'these recordings'
    warnings = tuple(advice(parameters, structure, solved.rank, pairs, source, filtered))
    if filtered:
        twists = [recording.twist for recording in spectra]
        warnings += tuple(too_fast(axes, twists, rates_hz, noises))
    return Excitation(
        structure.name, axes, parameters, solved.rank, len(solved.x), solved.condition_number,
        pairs, spectra, warnings,
    )  # fmt: skip


def displacement(samples: Samples, cup_length: float) -> tuple[Array, Array]:
    """
    Return how the lip is displaced from nominal (N, 6), and its twist (N, 6), in the tool.

    The displacement is E_o_S + l0 z (m) and the rotation vector of E_R_S (rad).
    """
    strain, twist = np.empty((2, len(samples.tool), 6))
    for start in range(0, len(strain), BLOCK):
        part = slice(start, start + BLOCK)
        o, R, twist[part] = lip_relative(
            samples.tool.select(part), samples.package.select(part), samples.held.com)
        strain[part] = np.hstack([o + [0.0, 0.0, cup_length], log_so3(R)])
    return strain, twist


def _triangle(
    recordings: Sequence[Samples], cup_length: float, structure: Structure, whitening: Array
) -> Array:
    """Return the triangle of the whitened equations."""
    rows = rows_of(recordings, cup_length, structure, whitening)
    return triangle(rows, 2 * structure.size + 1)


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
    recordings: Sequence[Samples],
    cup_length: float,
    structure: Structure,
    whitening: Array,
    noises: Sequence[FilterNoise],
    solved: _Solved,
) -> tuple[Array, Array]:
    """
    Return the share of noise in what tells each parameter, and the bias that it causes.

    Noise that is added once more shrinks the estimates again. An estimate that goes as 1 / (1 + n)
    with the noise's variance n, as that of one parameter does, was off before by 1 - x / x', where
    x' is the one with more noise. The share is the noise's energy in a parameter's own column,
    over the energy of the part of that column that no other parameter explains.
    """
    size = 2 * structure.size
    if not noises:
        return np.full(size, np.nan), np.full(size, np.nan)
    energy, later = np.zeros(size), np.zeros(size)
    for draw in np.random.default_rng(SEED).spawn(DRAWS):
        noisy = [with_noise(s, n, draw) for s, n in zip(recordings, noises, strict=True)]
        pairs = zip(
            rows_of(recordings, cup_length, structure, whitening),
            rows_of(noisy, cup_length, structure, whitening),
            strict=True,
        )
        energy += sum(np.sum((b - a)[:, :-1] ** 2, axis=0) for a, b in pairs) / DRAWS
        again = _solve(_triangle(noisy, cup_length, structure, whitening), structure)
        later += again.x / DRAWS
    with np.errstate(divide='ignore', invalid='ignore'):
        share = np.minimum(energy / solved.norm**2, 1.0)
        return share, 1.0 - 1.0 / np.maximum(later / solved.x, SMALLEST_RATIO)


def _axes(
    recordings: Sequence[Samples],
    cup_length: float,
    noises: Sequence[FilterNoise],
    spectra: Sequence[Spectra],
) -> tuple[Axis, ...]:
    """Return how the six directions are excited."""
    parts = [displacement(b, cup_length) for s in recordings for b in s.blocks()]
    strain, twist = (np.concatenate(values) for values in zip(*parts, strict=True))
    low, high = _bands(spectra)
    strain_noise, twist_noise = _relative_noise(recordings, cup_length, noises)
    return tuple(
        Axis(
            name,
            _rms(strain[:, i]),
            float(np.std(strain[:, i])),
            _rms(twist[:, i]),
            (float(low[i]), float(high[i])),
            float(strain_noise[i]),
            float(twist_noise[i]),
        )
        for i, name in enumerate(AXES)
    )


def _relative_noise(
    recordings: Sequence[Samples], cup_length: float, noises: Sequence[FilterNoise]
) -> tuple[Array, Array]:
    """Return the standard deviations (6,) of noise in strain and twist, of all recordings."""
    if not noises:
        return np.full(6, np.nan), np.full(6, np.nan)
    draw = np.random.default_rng(SEED)
    errors: list[tuple[Array, Array]] = []
    for samples, noise in zip(recordings, noises, strict=True):
        here = displacement(samples, cup_length)
        there = displacement(with_noise(samples, noise, draw), cup_length)
        valid = samples.tool.valid & samples.package.valid
        errors.append((there[0][valid] - here[0][valid], there[1][valid] - here[1][valid]))
    strain, twist = (np.concatenate(part) for part in zip(*errors, strict=True))
    return np.std(strain, axis=0), np.std(twist, axis=0)


def _spectra(samples: Samples, cup_length: float) -> Spectra:
    """Return the spectra of a recording's relative motion."""
    valid = samples.tool.valid & samples.package.valid
    rate_hz = uniform_rate_hz(samples.package.stamps_ns)
    strain, twist = (
        spectrum(interpolated(np.where(valid[:, None], values, np.nan)), rate_hz)
        for values in displacement(samples, cup_length)
    )
    return Spectra(strain, twist)


def _bands(spectra: Sequence[Spectra]) -> Array:
    """Return the frequencies (2, 6) in Hz between which most of the velocities' power lies."""
    ends = np.array([recording.twist.band(BAND) for recording in spectra])
    known = np.isfinite(ends[:, 0])
    low = np.where(known, ends[:, 0], np.inf).min(axis=0)
    high = np.where(known, ends[:, 1], -np.inf).max(axis=0)
    return np.where(known.any(axis=0), np.array([low, high]), np.nan)


def _rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _pairs(solved: _Solved, labels: Sequence[str]) -> Iterator[tuple[str, str, float]]:
    """Yield the pairs of parameters that can hardly be told apart, the worst first."""
    upper = np.abs(np.triu(solved.correlation, 1))
    for flat in np.argsort(-upper, axis=None):
        i, j = divmod(int(flat), upper.shape[1])
        if upper[i, j] <= CORRELATED:
            return
        yield labels[i], labels[j], float(solved.correlation[i, j])
