"""
Sufficient statistics of a recording: all that least squares needs of it, small enough to be kept.

Those of several recordings are added up, wherever they were made. The weight W of (4.66) comes
from the wrenches of all recordings, so it is not known when they are made. What is kept can be
weighted later: cluster by cluster the rows [L c] of each wrench component, reduced by QR to an R
factor with the same inner products. Where W couples the components six R factors would not do and
those of all products would be larger than the samples, so that these themselves are kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.equations.added_noise import noise_products
from bellows_ros.core.identification.equations.equations import LipMotion, Rows
from bellows_ros.core.identification.equations.samples import Samples
from bellows_ros.core.identification.equations.whitening import joined, Moments
from bellows_ros.core.recording.noise import FilterNoise
from bellows_ros.core.structure import Structure
import numpy as np


@dataclass(frozen=True, eq=False)
class Statistics:
    """
    Sufficient statistics of one recording, whatever the weight will be.

    Parameters
    ----------
    structure : Structure
        Of K and P.
    cup_length : float
        Nominal length l0, m.
    used, rejected : int
        Valid samples, and the others.
    moments : Moments
        Of the needed wrenches.
    r_factors : ndarray (C, 6, q, q)
        For each of C clusters and each component the R factor of its rows [L c], q = p + 1; none
        where the structure couples the components.
    lip : LipMotion or None
        There instead, the motion of the lip itself.
    noise : ndarray (6, q, 6, q) or None
        What noise adds to the products of the rows (see `noise_products`), where it is known.

    """

    structure: Structure
    cup_length: float
    used: int
    rejected: int
    moments: Moments
    r_factors: Array
    lip: LipMotion | None
    noise: Array | None

    def rows(self) -> Iterator[Rows]:
        """Yield rows [L c], or such with the same inner products, cluster by cluster."""
        if self.lip is not None:
            yield from self.lip.equations(self.cup_length, self.structure)
        elif len(self.r_factors):
            count, _, size, _ = self.r_factors.shape
            rows = self.r_factors.transpose(0, 2, 1, 3).reshape(count * size, 6, size)
            clusters = [slice(k * size, (k + 1) * size) for k in range(count)]
            yield Rows(rows[..., :-1], rows[..., -1], clusters)


def statistics(
    samples: Samples, cup_length: float, structure: Structure, noise: FilterNoise | None = None
) -> Statistics:
    """
    Return the sufficient statistics of a recording, which may be without valid samples.

    Parameters
    ----------
    samples : Samples
        Of the recording.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Which entries of K and P are free.
    noise : FilterNoise, optional
        Of the recording; without it nothing is known of the bias that it causes.

    """
    size = 2 * structure.size + 1
    r_factors = [np.empty((0, 6, size, size))]
    if not structure.couples:
        for L, c, clusters in samples.lip.equations(cup_length, structure):
            rows = np.dstack([L, c]).swapaxes(0, 1)
            r_factors += [_component_r_factors(rows[:, part])[None] for part in clusters]
    wrenches = (samples.lip.wrench[block] for block in samples.lip.blocks())
    return Statistics(
        structure, cup_length, samples.count, len(samples.tool) - samples.count,
        joined(Moments.of(part) for part in wrenches), np.concatenate(r_factors),
        samples.lip if structure.couples else None,
        None if noise is None else noise_products(samples, noise, cup_length, structure),
    )


def _component_r_factors(rows: Array) -> Array:
    """Return the R factors (6, q, q) of the rows [L c] (6, N, q) of a cluster."""
    size = rows.shape[2]
    few = np.zeros((6, max(size - rows.shape[1], 0), size))
    return np.asarray(np.linalg.qr(np.concatenate([rows, few], axis=1), mode='r'))
