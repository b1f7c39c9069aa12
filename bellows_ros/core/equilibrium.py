"""Static equilibrium: where a package hangs from a tool at rest."""

import math

from bellows_ros.core.kernels import body_acceleration, ModelTuple, State
from bellows_ros.core.linearisation import displaced, linearise, resting_on_tool
from bellows_ros.core.tuples import (
    add,
    apply,
    apply_transposed,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    scale,
    subtract,
)
from bellows_ros.errors import BellowsError
import numpy as np

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
    if np.linalg.eigvals(linearise(loaded, origin, body).body_pose).real.max() >= 0.0:
        raise _no_equilibrium(model)  # it would fall over
    position = add(tool[0], apply(R_world_tool, body[0]))
    return position, quaternion_product(tool[1], body[1]), zero, zero


def _newton_equilibrium(model: ModelTuple, tool: State, body: State) -> State:
    """Return the state near body in which its acceleration is zero."""
    size = math.inf
    for _ in range(_ITERATIONS):
        residual = np.array(body_acceleration(model, tool, body)).ravel()
        jacobian = linearise(model, tool, body).body_pose
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
