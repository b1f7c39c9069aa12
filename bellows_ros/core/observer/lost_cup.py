"""
What the loss of one cup of a gripper makes of the error: K and P become those of the others.

Without cup i the package goes on without that cup's wrench w_i(x). The error e of an estimate x
that has all cups has the slope A e - M^-1 (w_i(x) + W_i e), with A of all cups and W_i the
derivative of w_i. It is linear, and has a transition (12, 13) of its own, whose last column is
what the loss has made.
"""

from __future__ import annotations

from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.geometry.tuples import Matrix
from bellows_ros.core.model.grip import one_of
from bellows_ros.core.model.jacobians import (
    acceleration_at,
    cup_accelerations,
    write_column,
    write_square,
)
from bellows_ros.core.model.kernels import Blocks, lip_wrench, ModelTuple, State
from bellows_ros.core.model.structure import is_single, maps
import numpy as np

NUMBERS = 54
"""K and P (6, 6) of a cup, as the kernels' blocks."""

NO_CUPS: Array = np.zeros((0, NUMBERS))
"""A gripper of one cup: if that is lost, the package is."""


NO_LOSSES: Array = np.zeros((0, 12, 13))
"""Transitions without each of no cups."""


def cups_of(model: ModelTuple, places: Array) -> Array:
    """
    Return K and P (n, 54) of each cup of a gripper for strains at the origin.

    The model is that of the gripper, its cups are at places (n, 4), as of `places_of`.
    """
    if len(places) < 2 or is_single(places):
        return NO_CUPS
    return np.hstack([_of_each(matrix, places) for matrix in model[0][2:4]])


def _of_each(gripper: Blocks, places: Array) -> Array:
    """Return A_i^T K_1 A_i of each cup as rows (n, 27) of blocks."""
    oo, oR, RR = (np.reshape(block, (3, 3)) for block in one_of(gripper, places))
    A = maps(places)
    M = np.swapaxes(A, 1, 2) @ np.block([[oo, oR], [oR.T, RR]]) @ A
    return np.stack([M[:, :3, :3], M[:, :3, 3:], M[:, 3:, 3:]], axis=1).reshape(-1, 27)


@kernel
def matrix_at(row: Any, i: int) -> Matrix:
    """Return a 3x3 matrix from nine numbers of a row."""
    return (row[i], row[i + 1], row[i + 2], row[i + 3], row[i + 4], row[i + 5], row[i + 6],
            row[i + 7], row[i + 8])


@kernel
def blocks_at(row: Any, i: int) -> Blocks:
    """Return K or P from 27 numbers of a row."""
    return matrix_at(row, i), matrix_at(row, i + 9), matrix_at(row, i + 18)


@array_kernel
def write_losses(
    model: ModelTuple, cups: Array, tool: State, body: State, out: Array
) -> None:
    """Write M^-1 [W_i, w_i] of each cup into (n, 6, 13): accelerations by error, and without."""
    for i in range(len(cups)):
        cup = model[0]
        one = ((cup[0], cup[1], blocks_at(cups[i], 0), blocks_at(cups[i], 27), *cup[4:]), model[1],
               model[2])
        by_pose, by_twist = cup_accelerations(one, tool, body)
        write_square(out[i], 0, 0, by_pose)
        write_square(out[i], 0, 6, by_twist)
        f, m = lip_wrench(one, tool, body)
        dv, dw = acceleration_at(model[1], model[1][1], f, m)
        write_column(out[i], 12, dv, dw)
