"""
The equations of identification: the wrench of the cup is the one that the motion needs.

At the lip L x = c for every sample, with x the parameters of K and P (4.66-4.68).
"""

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.lie import log_so3
from bellows_ros.core.model import regressor
from bellows_ros.core.structure import Structure
from bellows_ros.core.trajectory import NS_PER_S
import numpy as np

BLOCK = 4096
"""Samples that are worked on at a time, so that memory does not grow with the recording."""

LARGEST_KEPT = 2**27
"""Bytes of one recording's regressor that are kept for those who ask for it again."""

WRENCH = (
    *((f'force along {axis}', 'N') for axis in 'xyz'),
    *((f'moment about {axis}', 'N m') for axis in 'xyz'),
)
"""The components of a wrench at S, and their units."""

CLUSTER_WINDOWS = 4
"""Residuals this many filter windows apart are taken as independent for standard errors."""


class Rows(NamedTuple):
    """Equations A x = b of N samples: A (N, 6, p), b (N, 6), and which of the N are a cluster."""

    A: Array
    b: Array
    clusters: list[slice]

    @property
    def stacked(self) -> Array:
        """Rows [A b] (6 N, p + 1)."""
        return np.dstack([self.A, self.b]).reshape(-1, self.A.shape[2] + 1)

    def whitened(self, whitening: Array) -> 'Rows':
        """Return the same equations with their errors whitened."""
        return Rows(whitening @ self.A, self.b @ whitening.T, self.clusters)


@dataclass(frozen=True, eq=False)
class LipMotion:
    """
    Motion of the lip in the tool, and the wrench that it needs, at the valid samples.

    Parameters
    ----------
    index : ndarray (N,)
        Which of the recording's samples they are.
    stamps_ns : ndarray (N,)
        ns.
    window : float
        Duration of the filter's window, s: so far residuals are correlated.
    position, rotation, twist : ndarray (N, 3), (N, 3, 3), (N, 6)
        E_o_S (m), E_R_S and S_v_ES (m/s, rad/s).
    wrench : ndarray (N, 6)
        c of (4.68), N and N m.

    """

    index: Stamps
    stamps_ns: Stamps
    window: float
    position: Array
    rotation: Array
    twist: Array
    wrench: Array
    _kept: dict[Hashable, Array] = field(default_factory=dict, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave behind what can be computed again."""
        return {**vars(self), '_kept': {}}

    @cached_property
    def rotation_vector(self) -> Array:
        """Rotation vector of the lip in the tool, rad (N, 3)."""
        return np.concatenate([log_so3(self.rotation[part]) for part in self.blocks()])

    def displacement(self, cup_length: float) -> Array:
        """Return how the lip is displaced from nominal (N, 6): E_o_S + l0 z (m), and rotation."""
        return np.hstack([self.position + [0.0, 0.0, cup_length], self.rotation_vector])

    def blocks(self) -> Iterator[slice]:
        """Yield the samples in blocks, in the order of time."""
        for start in range(0, max(len(self.index), 1), BLOCK):
            yield slice(start, min(start + BLOCK, len(self.index)))

    def clusters(self, block: slice) -> list[slice]:
        """Return the samples of a block cut into clusters that are several windows long."""
        stamps = self.stamps_ns[block]
        cluster_ns = int(CLUSTER_WINDOWS * self.window * NS_PER_S)
        starts = np.unique((stamps - stamps[:1]) // cluster_ns, return_index=True)[1]
        return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(stamps)], strict=True)]

    def equations(
        self, cup_length: float, structure: Structure, keep: bool = True
    ) -> Iterator[Rows]:
        """
        Yield L and c of (4.67), (4.68), block by block.

        Parameters
        ----------
        cup_length : float
            Nominal length l0, m.
        structure : Structure
            Of K and P.
        keep : bool
            Whether somebody will ask for the same again.

        """
        key = (cup_length, structure.name)
        size = 2 * structure.size
        keep &= 8 * 6 * size * len(self.index) <= LARGEST_KEPT
        kept = self._kept.get(key)
        L = np.empty((len(self.index), 6, size)) if keep and kept is None else None
        for block in self.blocks():
            own = kept[block] if kept is not None else regressor(
                cup_length, structure.basis, self.position[block], self.rotation[block],
                self.twist[block])
            if L is not None:
                L[block] = own
            yield Rows(own, self.wrench[block], self.clusters(block))
        if L is not None:
            self._kept[key] = L

    def select(self, chosen: slice | Mask | Stamps) -> 'LipMotion':
        """Return some of the samples, with what is known of them."""
        some = LipMotion(
            self.index[chosen], self.stamps_ns[chosen], self.window, self.position[chosen],
            self.rotation[chosen], self.twist[chosen], self.wrench[chosen])
        some._kept.update({key: L[chosen] for key, L in self._kept.items()})
        return some

    def thinned(self, step: int) -> 'LipMotion':
        """Return those of every so many of the recording's samples, which are counted anew."""
        some = self.select(self.index % step == 0)
        object.__setattr__(some, 'index', some.index // step)
        return some
