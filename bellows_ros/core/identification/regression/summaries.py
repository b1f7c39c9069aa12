"""
What least squares needs of a recording, small enough to be kept and added up elsewhere.

The weight W of (4.66) comes from the wrenches of all recordings, so it is not known when one of
them is summarised. What is kept can be weighted later: cluster by cluster the rows [L c] of each
wrench component, reduced by QR to a triangle that has the same inner products. Where W couples the
components (a full structure) six triangles would not do and those of all products would be larger
than the samples, so that these themselves are kept, in 18 numbers each.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.envelope import Envelope
from bellows_ros.core.identification.regression.least_squares import (
    equations,
    regular,
    require_enough,
    Rows,
    Samples,
    solved,
    whitening_of,
    wrench_moments,
)
from bellows_ros.core.identification.regression.moments import joined, Moments
from bellows_ros.core.identification.regression.noise_products import noise_products
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.identification.wrenches import lip_relative
from bellows_ros.core.lie import exp_so3, log_so3
from bellows_ros.core.model import regressor
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Summary:
    """
    What a fit needs of one recording, whatever the weight will be.

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
    triangles : ndarray (C, 6, q, q)
        For each of C clusters and each component the triangle of its rows [L c], q = p + 1; none
        where the structure couples the components.
    samples : ndarray (N, 18)
        There instead, of each valid sample: E_o_S (m), log E_R_S (rad), S_v_ES (m/s, rad/s), c (N,
        N m).
    starts : ndarray (C,)
        The first sample of each cluster in them.
    noise : ndarray (6, q, 6, q)
        What noise adds to the products of the rows (see `noise_products`).

    """

    structure: Structure
    cup_length: float
    used: int
    rejected: int
    moments: Moments
    triangles: Array
    samples: Array
    starts: NDArray[np.int64]
    noise: Array


def couples(structure: Structure) -> bool:
    """Tell whether the weight of a structure couples the components of the wrench."""
    return structure.name == 'full'


def summarise(
    recording: Samples, noise: FilterNoise, cup_length: float, structure: Structure
) -> Summary:
    """Return the summary of a recording, which may be without valid samples."""
    size = 2 * structure.size + 1
    triangles, samples = [np.empty((0, 6, size, size))], [np.empty((0, 18))]
    starts: list[int] = []
    for block in recording.blocks():
        L, c, clusters = equations(block, cup_length, structure)
        if couples(structure):
            starts += [sum(map(len, samples)) + part.start for part in clusters]
            o, R, twist = lip_relative(block.tool, block.package, block.held.com)
            samples.append(np.hstack([o, log_so3(R), twist, c]))
        else:
            rows = np.dstack([L, c]).swapaxes(0, 1)
            triangles.append(np.array([_component_triangles(rows[:, part]) for part in clusters]))
    return Summary(
        structure, cup_length, recording.count, len(recording.tool) - recording.count,
        wrench_moments(recording), np.concatenate(triangles), np.concatenate(samples),
        np.array(starts, dtype=np.int64),
        noise_products(recording, noise, cup_length, structure),
    )  # fmt: skip


def _component_triangles(rows: Array) -> Array:
    """Return the triangles (6, q, q) of the rows [L c] (6, N, q) of a cluster."""
    size = rows.shape[2]
    few = np.zeros((6, max(size - rows.shape[1], 0), size))
    return np.asarray(np.linalg.qr(np.concatenate([rows, few], axis=1), mode='r'))


def fit_summaries(summaries: Sequence[Summary]) -> Fit:
    """
    Return the fit of all recordings that were summarised.

    It is that of `least_squares` on the recordings themselves, but for rounding.

    Parameters
    ----------
    summaries : sequence of Summary
        Of one cup, all with one structure and cup length.

    Raises
    ------
    BellowsError
        If there is none, they differ in structure or length, there are too few samples, or they
        tell nothing at all.

    """
    structure = _same(summaries)
    used = sum(summary.used for summary in summaries)
    require_enough(used, structure)
    covariance = joined(s.moments for s in summaries).covariance(structure)
    whitening = whitening_of(regular(covariance))
    rejected = sum(summary.rejected for summary in summaries)
    noise = np.sum([summary.noise for summary in summaries], axis=0)
    rows = partial(_rows, summaries, whitening)
    return solved(rows, structure, whitening, used, rejected, noise)


def _same(summaries: Sequence[Summary]) -> Structure:
    """Return the structure of all summaries, which must be of one cup."""
    if not summaries:
        raise BellowsError('There is no summary to fit. Summarise at least one recording.')
    kinds = {(summary.structure.name, summary.cup_length) for summary in summaries}
    if len(kinds) > 1:
        found = ', '.join(f'{name} with {length:g} m' for name, length in sorted(kinds))
        raise BellowsError(
            'Summaries can be added only where fit.structure and cup.length are the same; '
            f'these have {found}. Summarise all recordings with the same parameter file.'
        )
    return summaries[0].structure


def _rows(summaries: Sequence[Summary], whitening: Array) -> Iterator[Rows]:
    """Yield the whitened rows of summaries, a few clusters at a time."""
    for summary in summaries:
        for rows, clusters in _unweighted(summary):
            L, c = rows[..., :-1], rows[..., -1]
            yield Rows(whitening @ L, c @ whitening.T, clusters)


def _unweighted(summary: Summary) -> Iterator[tuple[Array, list[slice]]]:
    """Yield rows [L c] (N, 6, q), or such with the same inner products, and their clusters."""
    if couples(summary.structure):
        ends = [*summary.starts[1:], len(summary.samples)]
        for start, end in zip(summary.starts, ends, strict=True):
            o, phi, twist, c = np.split(summary.samples[start:end], [3, 6, 12], axis=1)
            L = regressor(
                summary.cup_length, summary.structure.basis, o, exp_so3(phi), twist
            )
            yield np.dstack([L, c]), [slice(0, end - start)]
    elif len(summary.triangles):
        count, _, size, _ = summary.triangles.shape
        rows = summary.triangles.transpose(0, 2, 1, 3).reshape(count * size, 6, size)
        yield rows, [slice(k * size, (k + 1) * size) for k in range(count)]


def joined_envelopes(parts: Sequence[Envelope]) -> Envelope:
    """Return the envelope of all recordings together: the widest range of each."""
    low, high, rates, bands, mass = (
        np.array([getattr(part, name) for part in parts])
        for name in ('deflection_low', 'deflection_high', 'rates', 'frequencies', 'mass')
    )
    return Envelope(
        low.min(axis=0),
        high.max(axis=0),
        rates.max(axis=0),
        np.column_stack([bands[:, :, 0].min(axis=0), bands[:, :, 1].max(axis=0)]),
        np.array([mass[:, 0].min(), mass[:, 1].max()]),
    )
