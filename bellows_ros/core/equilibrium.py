"""
Where a package hangs at rest, and small motions about a state.

Derivatives of the package's acceleration, modes, step sizes, and the static equilibrium.
"""

import math
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.jacobians import body_jacobians, Square, tool_jacobians
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import body_acceleration, ModelTuple, State
from bellows_ros.core.tuples import (
    add,
    apply,
    apply_transposed,
    exp_quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    scale,
    subtract,
    Vector,
)
from bellows_ros.errors import BellowsError
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


def stiffness(model: ModelTuple, tool: State, body: State) -> Array:
    """Return the derivative (6, 6) of the package's acceleration by its own displacement alone."""
    return _matrix(body_jacobians(model, tool, body)[0])


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


_LOADS = 8
_ITERATIONS = 50
_LARGEST_MOVE = 0.3  # m or rad, of one iteration


def static_equilibrium(
    model: ModelTuple, tool: State, near: State | None = None
) -> State:
    """
    Return the state in which the package hangs at rest from a tool at rest (3.9).

    The load is put on in steps from the nominal pose, each solved by Newton's method, so that of
    several equilibria the one that a real cup reaches is found; or all of it is at once on a
    package that is near to its rest. It is sought in tool axes: where in the world the tool is
    does not matter.

    Raises
    ------
    BellowsError
        If there is none: the cup is too soft for the package in this tool pose.

    """
    cup, package, gravity = model
    zero = (0.0, 0.0, 0.0)
    origin = (zero, (0.0, 0.0, 0.0, 1.0), zero, zero)
    R_world_tool = rotation_matrix(tool[1])
    gravity_in_tool = apply_transposed(R_world_tool, gravity)
    if near is None:
        body, loads = resting_on_tool(model, origin), _LOADS
    else:
        shift = apply_transposed(R_world_tool, subtract(near[0], tool[0]))
        turn = quaternion_product(quaternion_conjugate(tool[1]), near[1])
        body, loads = (shift, turn, zero, zero), 1
    loaded = model
    for load in np.linspace(0.0, 1.0, loads + 1)[1:]:
        loaded = (cup, package, scale(float(load), gravity_in_tool))
        body = _newton_equilibrium(loaded, origin, body)
    if np.linalg.eigvals(stiffness(loaded, origin, body)).real.max() >= 0.0:
        raise _no_equilibrium(model)  # it would fall over
    position = add(tool[0], apply(R_world_tool, body[0]))
    return position, quaternion_product(tool[1], body[1]), zero, zero


def _newton_equilibrium(model: ModelTuple, tool: State, body: State) -> State:
    """Return the state near body in which its acceleration is zero."""
    size = math.inf
    for _ in range(_ITERATIONS):
        residual = np.array(body_acceleration(model, tool, body)).ravel()
        jacobian = stiffness(model, tool, body)
        try:
            step = np.linalg.solve(jacobian, -residual)
        except np.linalg.LinAlgError:
            break
        before, size = size, float(np.linalg.norm(step))
        if not math.isfinite(size):
            break
        step *= _LARGEST_MOVE / max(size, _LARGEST_MOVE)
        body = displaced(body, tuple(step[:3].tolist()), tuple(step[3:].tolist()))
        if size < 1e-9 and size > 0.1 * before or size < 1e-13:  # as near as rounding lets it
            break
    if size < 1e-9:
        return body
    raise _no_equilibrium(model)


def _no_equilibrium(model: ModelTuple) -> BellowsError:
    """Return the error that says so."""
    return BellowsError(
        f'No static equilibrium: the cup cannot carry {model[1][0]:g} kg in this tool pose '
        'without falling over. Check package.mass, package.com, cup.stiffness and their units.'
    )
