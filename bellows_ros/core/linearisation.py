"""Small motions about a state: derivatives of the package's acceleration, modes and step sizes."""

import math
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.jacobians import body_jacobians, Square, tool_jacobians
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.tuples import (
    apply,
    exp_quaternion,
    quaternion_product,
    rotation_matrix,
    Vector,
)
import numpy as np

PHASE_PER_STEP = 0.1
"""Largest |eigenvalue| * step (rad) of one integration step: RK4 is accurate and stable there."""


@kernel
def resting_on_tool(model: ModelTuple, tool: State) -> State:
    """Return the package at the cup's nominal pose, [B] = [S] = [E], at rest."""
    com, l0 = model[1][1], model[0][1]
    R = rotation_matrix(tool[1])
    offset = apply(R, (com[0], com[1], com[2] - l0))
    o = tool[0]
    zero = (0.0, 0.0, 0.0)
    return (o[0] + offset[0], o[1] + offset[1], o[2] + offset[2]), tool[1], zero, zero


@kernel
def displaced(body: State, delta: Vector, phi: Vector) -> State:
    """Return the body moved by R delta and turned by exp(phi) in its own axes, at rest."""
    move = apply(rotation_matrix(body[1]), delta)
    o = body[0]
    return (
        (o[0] + move[0], o[1] + move[1], o[2] + move[2]),
        quaternion_product(body[1], exp_quaternion(phi)),
        body[2],
        body[3],
    )


class Jacobian(NamedTuple):
    """
    Derivatives (6, 6) of the package's acceleration about a state.

    By displacements (m, rad) and by twists (m/s, rad/s) of the body and of the tool, each in its
    own axes.
    """

    body_pose: Array
    body_twist: Array
    tool_pose: Array
    tool_twist: Array


def linearise(model: ModelTuple, tool: State, body: State) -> Jacobian:
    """Return the derivatives of the package's acceleration about a state."""
    of_body, of_tool = body_jacobians(model, tool, body), tool_jacobians(model, tool, body)
    return Jacobian(*(_matrix(square) for square in (*of_body, *of_tool)))


def _matrix(square: Square) -> Array:
    """Return a 6x6 matrix of the kernels as an array."""
    parts = np.reshape(square, (2, 2, 3, 3))
    return np.asarray(parts.transpose(0, 2, 1, 3).reshape(6, 6))


def system_matrix(model: ModelTuple) -> Array:
    """
    Return the matrix (12, 12) of small motions about the nominal pose with the tool at rest.

    The state is displacement and twist of B in its own axes; its eigenvalues are the package's
    modes (rad/s).
    """
    zero = (0.0, 0.0, 0.0)
    tool = (zero, (0.0, 0.0, 0.0, 1.0), zero, zero)
    jacobian = linearise(model, tool, resting_on_tool(model, tool))
    return np.block([[np.zeros((6, 6)), np.eye(6)], [jacobian.body_pose, jacobian.body_twist]])


def largest_step(model: ModelTuple) -> float:
    """Return the longest integration step (s) that keeps RK4 accurate for the fastest mode."""
    fastest = float(np.abs(np.linalg.eigvals(system_matrix(model))).max())
    return PHASE_PER_STEP / fastest if fastest > 0.0 else math.inf


def substeps_for(duration: float, longest_step: float) -> int:
    """Return into how many integration steps a time between two tool samples is cut."""
    return max(1, math.ceil(duration / longest_step - 1e-9))
