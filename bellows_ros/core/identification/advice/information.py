"""
The information of one recording on a cup, small, and such that that of recordings can be added.

How much there is in rows of equations depends on the weight W of (4.66), which comes from all
recordings. So rows are kept without it: as few of them with the same inner products.
"""

from dataclasses import dataclass

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.advice.pass_band import PassBand
from bellows_ros.core.identification.equations.added_noise import draws, SEED, with_noise
from bellows_ros.core.identification.equations.equations import LipMotion
from bellows_ros.core.identification.equations.samples import Samples
from bellows_ros.core.identification.equations.validity_range import relative_spectra, Spectra
from bellows_ros.core.identification.equations.whitening import Moments
from bellows_ros.core.recording.noise import ENOUGH, FilterNoise
from bellows_ros.core.structure import Structure
from bellows_ros.core.trajectory import uniform_rate_hz
import numpy as np

DRAWS = 4
"""How often noise is added."""

BAND = 0.9
"""Part of the power of a velocity that its frequency band holds."""


@dataclass(frozen=True, eq=False)
class Information:
    """
    The information of one recording.

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
    passed : PassBand or None
        What the filter leaves of the twist; None where its noise is not known.

    """

    wrench: Moments
    strain: Moments
    twist: Moments
    strain_noise: Moments
    twist_noise: Moments
    bands_hz: Array
    rows: Array
    added: Array
    passed: PassBand | None


def information_of(
    samples: Samples,
    cup_length: float,
    structure: Structure,
    noise: FilterNoise | None = None,
    spectra: Spectra | None = None,
) -> Information:
    """
    Return the information of a recording.

    Parameters
    ----------
    samples : Samples
        Of the recording.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries of K and P are free.
    noise : FilterNoise, optional
        Of the recording; without it nothing is known of what noise adds.
    spectra : Spectra, optional
        Those of `relative_spectra`, where they are known already.

    Raises
    ------
    BellowsError
        Without valid samples.

    """
    twists = (spectra or relative_spectra(samples, cup_length)).twist
    rate_hz = uniform_rate_hz(samples.package.stamps_ns)
    samples = samples.thinned(ENOUGH)
    lip = samples.lip
    first, added = _rows(lip, None, cup_length, structure)
    rows = [first]
    moved = np.array([lip.displacement(cup_length), lip.twist])
    noise_moved, passed = np.empty((2, 0, 6)), None
    if noise is not None:
        for draw in draws(DRAWS):
            noisy = with_noise(samples, noise, draw).lip
            again, changed = _rows(lip, noisy, cup_length, structure)
            rows.append(again)
            added += changed / DRAWS
        noisy = with_noise(samples, noise, np.random.default_rng(SEED)).lip
        noise_moved = np.array([noisy.displacement(cup_length), noisy.twist]) - moved
        passed = PassBand.of(twists, rate_hz, noise)
    return Information(
        Moments.of(lip.wrench), Moments.of(moved[0]), Moments.of(moved[1]),
        Moments.of(noise_moved[0]), Moments.of(noise_moved[1]),
        np.array(twists.band(BAND)), np.array(rows), added, passed,
    )


def _rows(
    lip: LipMotion, noisy: LipMotion | None, cup_length: float, structure: Structure
) -> tuple[Array, Array]:
    """Return the few rows of (noisy) samples, and products of what noise changes in columns."""
    rows = np.zeros((1, 6, 2 * structure.size + 1))
    added = np.zeros((2 * structure.size, 6, 6))
    others = noisy and noisy.equations(cup_length, structure, keep=False)
    for here in lip.equations(cup_length, structure):
        there = next(others) if others else here
        rows = _reduced(np.concatenate([rows, np.dstack([there.A, there.b])]), structure)
        change = (there.A - here.A).transpose(2, 1, 0)
        added += change @ change.swapaxes(1, 2)
    return _reduced(rows, structure), added


def _reduced(rows: Array, structure: Structure) -> Array:
    """Return few rows (M, 6, q) with the inner products of many (N, 6, q)."""
    count, _, size = rows.shape
    # One R factor of all components side by side, or one of each component.
    groups = 1 if structure.couples else 6
    columns = 6 // groups * size
    stacked = np.zeros((groups, max(count, columns), columns))
    stacked[:, :count] = rows.reshape(count, groups, columns).swapaxes(0, 1)
    r_factors = np.asarray(np.linalg.qr(stacked, mode='r'))
    return r_factors.swapaxes(0, 1).reshape(columns, 6, size)
