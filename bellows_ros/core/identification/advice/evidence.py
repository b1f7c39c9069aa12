"""
What one recording tells about a cup, small, and such that recordings can be added.

How far rows of equations tell a parameter depends on the weight W of (4.66), which comes from all
recordings. So rows are kept without it: as few of them with the same inner products.
"""

from dataclasses import dataclass

from bellows_ros.core.identification.advice.added_noise import FilterNoise, SEED, with_noise
from bellows_ros.core.identification.judgement.whiteness import interpolated, Spectrum, spectrum
from bellows_ros.core.identification.regression.least_squares import BLOCK, equations, Samples
from bellows_ros.core.identification.regression.moments import Moments
from bellows_ros.core.identification.regression.summaries import couples
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.identification.wrenches import lip_relative, needed_wrench
from bellows_ros.core.lie import log_so3
from bellows_ros.core.trajectory import uniform_rate_hz
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRAWS = 4
"""How often noise is added."""

ENOUGH = 20_000
"""Samples of a recording from which all but spectra are taken, to a percent; some more at most."""

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
class Evidence:
    """
    What one recording tells.

    Parameters
    ----------
    wrench : Moments
        Of the needed wrenches, N and N m.
    strain, twist : Moments
        Of the lip's displacement from nominal (m, rad) and of its twist (m/s, rad/s), in the tool.
    strain_noise, twist_noise : Moments
        Of the noise in them; of nothing where the noise is not known.
    bands_hz : ndarray (2, 6)
        Frequencies between which most of the twist's power lies; nan where nothing moves.
    rows : ndarray (1 or 1 + DRAWS, M, 6, q)
        Rows [L c], q = p + 1, with the inner products of all samples' rows; then those of samples
        with noise once more, where it is known. Products of different components of the wrench
        are right only where the structure couples these.
    added : ndarray (p, 6, 6)
        Products of what such noise changes in each column, of each two components; mean of draws.

    """

    wrench: Moments
    strain: Moments
    twist: Moments
    strain_noise: Moments
    twist_noise: Moments
    bands_hz: Array
    rows: Array
    added: Array


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


def relative_spectra(samples: Samples, cup_length: float) -> Spectra:
    """Return the spectra of a recording's relative motion."""
    valid = samples.tool.valid & samples.package.valid
    rate_hz = uniform_rate_hz(samples.package.stamps_ns)
    strain, twist = (
        spectrum(interpolated(np.where(valid[:, None], values, np.nan)), rate_hz)
        for values in displacement(samples, cup_length)
    )
    return Spectra(strain, twist)


def evidence_of(
    samples: Samples,
    cup_length: float,
    structure: Structure,
    noise: FilterNoise | None,
    spectra: Spectra | None = None,
) -> Evidence:
    """Return what a recording tells; its spectra are computed where they are not given."""
    spectra = spectra or relative_spectra(samples, cup_length)
    samples = samples.thinned(ENOUGH)
    first, added = _rows(samples, samples, cup_length, structure)
    rows = [first]
    needed = [needed_wrench(b.held, b.package, b.gravity) for b in samples.blocks()]
    strain, twist = _moved(samples, cup_length)
    strain_noise, twist_noise = np.empty((2, 0, 6))
    if noise is not None:
        for draw in np.random.default_rng(SEED).spawn(DRAWS):
            noisy = with_noise(samples, noise, draw)
            again, changed = _rows(samples, noisy, cup_length, structure)
            rows.append(again)
            added += changed / DRAWS
        noisy = with_noise(samples, noise, np.random.default_rng(SEED))
        strain_noise, twist_noise = _moved(noisy, cup_length) - np.array([strain, twist])
    return Evidence(
        Moments.of(np.concatenate([np.empty((0, 6)), *needed])), Moments.of(strain),
        Moments.of(twist), Moments.of(strain_noise), Moments.of(twist_noise),
        np.array(spectra.twist.band(BAND)), np.array(rows), added,
    )  # fmt: skip


def _moved(samples: Samples, cup_length: float) -> Array:
    """Return displacement and twist (2, N, 6) of the valid samples."""
    valid = samples.tool.valid & samples.package.valid
    return np.array(displacement(samples, cup_length))[:, valid]


def _rows(
    samples: Samples, noisy: Samples, cup_length: float, structure: Structure
) -> tuple[Array, Array]:
    """Return the few rows of noisy samples, and products of what noise changes in the columns."""
    rows = np.zeros((1, 6, 2 * structure.size + 1))
    added = np.zeros((2 * structure.size, 6, 6))
    for block, other in zip(samples.blocks(), noisy.blocks(), strict=True):
        here, there = (_block_rows(part, cup_length, structure) for part in (block, other))
        rows = _reduced(np.concatenate([rows, there]), structure)
        change = (there - here)[:, :, :-1].transpose(2, 1, 0)
        added += change @ change.swapaxes(1, 2)
    return _reduced(rows, structure), added


def _block_rows(block: Samples, cup_length: float, structure: Structure) -> Array:
    """Return the rows [L c] (N, 6, q) of a block."""
    L, c, _ = equations(block, cup_length, structure)
    return np.dstack([L, c])


def _reduced(rows: Array, structure: Structure) -> Array:
    """Return few rows (M, 6, q) with the inner products of many (N, 6, q)."""
    count, _, size = rows.shape
    # One triangle of all components side by side, or one of each component.
    groups = 1 if couples(structure) else 6
    columns = 6 // groups * size
    stacked = np.zeros((groups, max(count, columns), columns))
    stacked[:, :count] = rows.reshape(count, groups, columns).swapaxes(0, 1)
    triangles = np.asarray(np.linalg.qr(stacked, mode='r'))
    return triangles.swapaxes(0, 1).reshape(columns, 6, size)
