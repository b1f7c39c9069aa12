"""
A gripper of several parallel, equal cups on one package.

Cup i stands at a_i in E, and its lip at a_i in S. Its strain (3.18) and twist are linear in those
of a cup at the origin, h_i = A_i h and v_i = A_i v with A_i = [[I, -a_i^], [0, I]], as
(I + R^T)(R - I) a = (R - R^T) a. So K = sum A_i^T K_1 A_i and P = sum A_i^T P_1 A_i are one cup of
the same kernel, exactly, at any rotation and in motion. Holding is that of each cup, by its own
wrench, which needs K_1 and P_1 again: the sum is solved for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.kernels import Blocks, cup_wrench, CupTuple, Strains, Wrench
from bellows_ros.errors import BellowsError
import numpy as np

CENTRE = (0.0, 0.0, 0.0)
"""The layout of a single cup."""

MOST_CUPS, FARTHEST, NEAREST = 32, 2.0, 5e-3
"""Largest number of cups, and distance (m) from E; smallest distance of two."""

UPPER = np.triu_indices(6)
SINGLE = np.zeros((1, 4))
"""One cup at E, as `places_of` returns it."""


def positions_of(layout: Sequence[float]) -> Array:
    """
    Return the positions (n, 3) of cups in E, m.

    Raises
    ------
    BellowsError
        If they are not x, y, z of 1 to 32 cups, or no gripper has them.

    """
    if not layout or len(layout) % 3:
        raise BellowsError(
            f'cup.layout has {len(layout)} numbers; expected x, y and z of each cup in the tool, '
            'one cup after the other: [0.05, 0.0, 0.0, -0.05, 0.0, 0.0] for two.')
    places = np.reshape(np.array(layout, dtype=np.float64), (-1, 3))
    if len(places) > MOST_CUPS:
        raise BellowsError(
            f'cup.layout has {len(places)} cups; expected at most {MOST_CUPS}. Fit a gripper of '
            'more as one cup (fit.structure: full).')
    farthest = float(np.abs(places).max())
    if farthest > FARTHEST:
        raise BellowsError(
            f'cup.layout has a cup {farthest:g} m from the tool; expected at most {FARTHEST:g} m. '
            'Is it in mm?')
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.diag([np.inf] * len(places))
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    if apart[i, j] < NEAREST:
        raise BellowsError(
            f'cup.layout: cups {min(i, j)} and {max(i, j)} are {1e3 * apart[i, j]:.3g} mm apart; '
            f'expected at least {1e3 * NEAREST:g} mm. Give each cup once, in m.')
    return places


def places_of(values: Mapping[str, Any]) -> Array:
    """
    Return x, y, z (m) in E and the index, from 0, of each cup that holds (n, 4).

    Raises
    ------
    BellowsError
        If cup.layout and cup.open do not describe a gripper that holds.

    """
    positions = positions_of(values.get('cup.layout', CENTRE))
    opened = set(values.get('cup.open', ())) - {-1.0}  # which stands for none
    wrong = sorted(opened - set(range(len(positions))))
    if wrong:
        raise BellowsError(
            f'cup.open has {wrong[0]:g}; expected integers from 0 to {len(positions) - 1}, '
            'the places of cups in cup.layout.')
    if len(opened) == len(positions):
        raise BellowsError(
            'cup.open has all cups of cup.layout, so that none holds. Leave out those that hold.')
    indexed = np.column_stack([positions, np.arange(len(positions))])
    return indexed[[k for k in range(len(positions)) if k not in opened]]


def is_single(places: Array) -> bool:
    """Return whether it is one cup at E."""
    return len(places) == 1 and not places[0, :3].any()


def maps(places: Array) -> Array:
    """Return A (n, 6, 6), from strain and twist at the origin to those of each cup."""
    A = np.tile(np.eye(6), (len(places), 1, 1))
    A[:, :3, 3:] = -hat(places[:, :3])
    return A


def composed(matrix: Array, places: Array) -> Array:
    """Return K or P (6, 6) of the gripper, that of one cup being given: sum A_i^T K_1 A_i."""
    if is_single(places):
        return matrix
    A = maps(places)
    return np.asarray(np.einsum('nki,kl,nlj->ij', A, matrix, A))


def composition(places: Array) -> Array:
    """Return C (21, 21): the upper triangle of a gripper's matrix, row by row, from one cup's."""
    C = np.empty((21, 21))
    for k, (i, j) in enumerate(zip(*UPPER, strict=True)):
        unit = np.zeros((6, 6))
        unit[i, j] = unit[j, i] = 1.0
        C[:, k] = composed(unit, places)[UPPER]
    return C


@kernel
def one_of(M: Blocks, places: Array) -> Blocks:
    """Return the blocks of one cup from those of the gripper, the inverse of `composed`."""
    n = float(len(places))
    oo = t3.scale_matrix(1.0 / n, M[0])
    total, squares = (0.0, 0.0, 0.0), t3.scale_matrix(0.0, M[0])
    for k in range(len(places)):
        a = t3.hat((places[k, 0], places[k, 1], places[k, 2]))
        total = t3.add(total, (places[k, 0], places[k, 1], places[k, 2]))
        squares = t3.add_scaled_matrix(squares, 1.0, t3.multiply(t3.multiply(a, oo), a))
    S = t3.hat(total)
    oR = t3.scale_matrix(1.0 / n, t3.add_scaled_matrix(M[1], 1.0, t3.multiply(oo, S)))
    mixed = t3.multiply(S, oR)  # S oR - oR^T S is twice its symmetric part
    RR = t3.add_scaled_matrix(t3.add_scaled_matrix(M[2], -1.0, mixed), -1.0, t3.transposed(mixed))
    return oo, oR, t3.scale_matrix(1.0 / n, t3.add_scaled_matrix(RR, 1.0, squares))


@kernel
def cup_of_gripper(cup: CupTuple, places: Array) -> CupTuple:
    """Return one cup of a gripper."""
    return (cup[0], cup[1], one_of(cup[2], places), one_of(cup[3], places), *cup[4:])


@kernel
def wrench_at(
    one: CupTuple, a: Vector, o: Vector, R: Matrix, v: Vector, w: Vector, strains: Strains
) -> Wrench:
    """
    Return the wrench of one cup of a gripper on the package, at its own lip in S axes.

    It stands at a; pose and twist are those of S, and the internal strains of the gripper.
    """
    o = t3.add(o, t3.subtract(t3.apply(R, a), a))
    return cup_wrench(one, o, R, t3.add(v, t3.cross(w, a)), w, strains_at(strains, a))


@kernel
def strains_at(strains: Strains, a: Vector) -> Strains:
    """Return A z of internal strains."""
    if len(strains) == 0:
        return ()
    (b, c), (d, e) = strains
    return ((t3.subtract(b, t3.cross(a, c)), c), (t3.subtract(d, t3.cross(a, e)), e))
