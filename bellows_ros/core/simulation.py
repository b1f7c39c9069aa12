"""Whole simulations: static equilibrium, the package's motion under a tool motion, energies."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .integrator import advance
from .jit import COMPILED, kernel
from .kernels import (
    body_acceleration,
    lip_relative_to_tool,
    ModelTuple,
    spring_energy,
    spring_frames,
    State,
)
from .lie import quaternion_to_rotation, rotation_to_quaternion
from .model import Cup, model_tuple, Package, STANDARD_GRAVITY
from .trajectory import Trajectory
from .tuples import (
    add,
    apply,
    apply_transposed,
    dot,
    exp_quaternion,
    quaternion_product,
    rotation_matrix,
    scale,
    Vector,
)
from ..errors import BellowsError

Array = NDArray[np.float64]

PHASE_PER_STEP = 0.1
"""Largest |eigenvalue| * step (rad) of one integration step: RK4 is accurate and stable there."""

_EQUILIBRIUM_LOADS = 8
_EQUILIBRIUM_ITERATIONS = 50


def state_row(position: ArrayLike, quaternion_xyzw: ArrayLike, twist: ArrayLike) -> State:
    """Return a pose and a body twist as the kernels take them."""
    o = [float(value) for value in np.asarray(position)]
    q = [float(value) for value in np.asarray(quaternion_xyzw)]
    v = [float(value) for value in np.asarray(twist)]
    return (o[0], o[1], o[2]), (q[0], q[1], q[2], q[3]), (v[0], v[1], v[2]), (v[3], v[4], v[5])


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


def static_equilibrium(model: ModelTuple, tool: State) -> State:
    """
    Return the state in which the package hangs at rest from a tool at rest (3.9).

    The load is put on in steps from the nominal pose, each solved by Newton's method, so that of
    several equilibria the one that a real cup reaches is found. It is sought in tool axes: where
    in the world the tool is does not matter.

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
    body = resting_on_tool(model, origin)
    for load in np.linspace(0.0, 1.0, _EQUILIBRIUM_LOADS + 1)[1:]:
        loaded = (cup, package, scale(float(load), gravity_in_tool))
        body = _newton_equilibrium(loaded, origin, body)
    position = add(tool[0], apply(R_world_tool, body[0]))
    return position, quaternion_product(tool[1], body[1]), zero, zero


def _newton_equilibrium(model: ModelTuple, tool: State, body: State) -> State:
    """Return the state near body in which its acceleration is zero."""
    size = math.inf
    for _ in range(_EQUILIBRIUM_ITERATIONS):
        residual = np.array(body_acceleration(model, tool, body)).ravel()
        jacobian = _acceleration_slope(model, tool, body)
        try:
            step = np.linalg.solve(jacobian, -residual)
        except np.linalg.LinAlgError:
            break
        size = float(np.linalg.norm(step))
        if not math.isfinite(size):
            break
        step *= min(1.0, 0.3 / max(size, 0.3))  # never further than 0.3 m or rad at once
        body = displaced(body, tuple(step[:3].tolist()), tuple(step[3:].tolist()))
        if size < 1e-13:
            break
    if size < 1e-9:  # as near as rounding lets it
        return body
    raise BellowsError(
        f'No static equilibrium: the cup cannot carry {model[1][0]:g} kg in this tool pose. '
        'Check package.mass, package.com, cup.stiffness and their units.'
    )


def _acceleration_slope(model: ModelTuple, tool: State, body: State, step: float = 1e-6) -> Array:
    """Return the derivative (6, 6) of the acceleration by a displacement in body axes."""
    columns = []
    for delta in np.eye(6) * step:
        ends = []
        for sign in (1.0, -1.0):
            move = (sign * delta).tolist()
            moved = displaced(body, tuple(move[:3]), tuple(move[3:]))
            ends.append(np.array(body_acceleration(model, tool, moved)).ravel())
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.array(columns).T


def system_matrix(model: ModelTuple) -> Array:
    """
    Return the matrix (12, 12) of small motions about the nominal pose with the tool at rest.

    The state is displacement and twist of B in its own axes; its eigenvalues are the package's
    modes (rad/s).
    """
    zero = (0.0, 0.0, 0.0)
    tool = (zero, (0.0, 0.0, 0.0, 1.0), zero, zero)
    body = resting_on_tool(model, tool)
    rest = np.array(body_acceleration(model, tool, body)).ravel()
    by_twist = []
    for twist in np.eye(6) * 1e-3:
        moving = (body[0], body[1], tuple(twist[:3].tolist()), tuple(twist[3:].tolist()))
        change = np.array(body_acceleration(model, tool, moving)).ravel() - rest
        by_twist.append(change / 1e-3)
    return np.block(
        [
            [np.zeros((6, 6)), np.eye(6)],
            [_acceleration_slope(model, tool, body), np.array(by_twist).T],
        ]
    )


def largest_step(model: ModelTuple) -> float:
    """Return the longest integration step (s) that keeps RK4 accurate for the fastest mode."""
    fastest = float(np.abs(np.linalg.eigvals(system_matrix(model))).max())
    return PHASE_PER_STEP / fastest if fastest > 0.0 else math.inf


def substeps_for(duration: float, longest_step: float) -> int:
    """Return into how many integration steps a time between two tool samples is cut."""
    return max(1, math.ceil(duration / longest_step - 1e-9))


def tool_rows(tool: Trajectory) -> Array:
    """Return a trajectory with twists as rows (N, 13): position, quaternion xyzw, body twist."""
    if tool.twist is None:
        raise BellowsError('The tool trajectory has no twists; filter or differentiate it first.')
    return np.hstack([tool.position, rotation_to_quaternion(tool.rotation), tool.twist])


def simulate(
    cup: Cup,
    package: Package,
    tool: Trajectory,
    start: State | None = None,
    gravity: float | ArrayLike = STANDARD_GRAVITY,
    substeps: int | None = None,
) -> Trajectory:
    """
    Simulate the package under a whole tool motion.

    Parameters
    ----------
    cup : Cup
        What connects tool and package.
    package : Package
        What hangs on it.
    tool : Trajectory
        N poses of E in the world with body twists; cubic Hermite in between.
    start : State, optional
        State of B in the world at the first sample; static equilibrium when left out.
    gravity : float or array_like (3,)
        Along -z of the world, or as a vector there, m/s^2.
    substeps : int, optional
        Integration steps per tool sample; chosen from the model's fastest mode when left out.

    Returns
    -------
    Trajectory
        N poses and body twists of B in the world, at the tool's stamps.

    Raises
    ------
    BellowsError
        If there is no static equilibrium to start from, or the simulation does not stay finite.

    """
    model = model_tuple(cup, package, gravity)
    rows = tool_rows(tool)
    durations = np.diff(tool.stamps_ns) * 1e-9
    steps = _substeps(model, durations, substeps)
    if start is None:
        start = static_equilibrium(model, state_row(rows[0, :3], rows[0, 3:7], np.zeros(6)))
    try:
        out = simulate_rows(model, start, rows, durations, steps)
    except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled give nan
        out = np.full(1, np.nan)
    if not np.all(np.isfinite(out)):
        raise BellowsError(
            'The simulation did not stay finite. The cup is too stiff for the sampling time, or '
            'its damping is negative; check cup.stiffness, cup.damping and their units.'
        )
    return Trajectory(
        stamps_ns=tool.stamps_ns,
        position=out[:, :3],
        rotation=quaternion_to_rotation(out[:, 3:7]),
        twist=out[:, 7:],
    )


def _substeps(
    model: ModelTuple, durations: Array, substeps: int | None
) -> NDArray[np.int64]:
    """Return the number of integration steps for each time between tool samples."""
    if substeps is not None:
        return np.full(len(durations), substeps, dtype=np.int64)
    longest = largest_step(model)
    return np.maximum(1, np.ceil(durations / longest - 1e-9)).astype(np.int64)


def simulate_rows(
    model: ModelTuple, start: State, tool: Array, durations: Array, substeps: NDArray[np.int64]
) -> Array:
    """Return the package's state rows (N, 13) for as many tool rows and the times between."""
    out = np.empty((len(tool), 13))
    inputs: tuple[Any, Any, Any] = (tool, durations, substeps)
    if not COMPILED:  # plain floats are several times faster than NumPy's in plain Python
        inputs = (tool.tolist(), durations.tolist(), substeps.tolist())
    _simulate(model, start, *inputs, out)
    return out


@kernel
def row_state(row: Array) -> State:
    """Return the state in one row of 13 numbers."""
    return (
        (row[0], row[1], row[2]),
        (row[3], row[4], row[5], row[6]),
        (row[7], row[8], row[9]),
        (row[10], row[11], row[12]),
    )


@kernel
def write_row(row: Array, state: State) -> None:
    """Write a state into one row of 13 numbers."""
    row[0], row[1], row[2] = state[0]
    row[3], row[4], row[5], row[6] = state[1]
    row[7], row[8], row[9] = state[2]
    row[10], row[11], row[12] = state[3]


@kernel
def _simulate(
    model: ModelTuple, start: State, tool: Any, durations: Any, substeps: Any, out: Array
) -> None:
    """Advance from row to row."""
    body = start
    write_row(out[0], body)
    before = row_state(tool[0])
    for k in range(len(durations)):
        after = row_state(tool[k + 1])
        body = advance(model, body, before, after, durations[k], substeps[k])
        write_row(out[k + 1], body)
        before = after


@dataclass(frozen=True)
class Energies:
    """Energies (J), each (N,): kinetic (3.43), elastic (3.17) and of gravity (3.44)."""

    kinetic: Array
    elastic: Array
    gravity: Array

    @property
    def total(self) -> Array:
        """Sum of the three (3.50), (N,)."""
        return self.kinetic + self.elastic + self.gravity


def energies(
    cup: Cup,
    package: Package,
    tool: Trajectory,
    body: Trajectory,
    gravity: float | ArrayLike = STANDARD_GRAVITY,
) -> Energies:
    """Return the energies of a motion of the package; gravity's is zero at the world's origin."""
    out = np.empty((len(tool.stamps_ns), 3))
    _energies(model_tuple(cup, package, gravity), tool_rows(tool), tool_rows(body), out)
    return Energies(*out.T)


@kernel
def _energies(model: ModelTuple, tool: Array, body: Array, out: Array) -> None:
    """Write the energies of every row into out (N, 3)."""
    for k in range(len(out)):
        out[k, 0], out[k, 1], out[k, 2] = state_energies(
            model, row_state(tool[k]), row_state(body[k])
        )


@kernel
def state_energies(model: ModelTuple, tool: State, body: State) -> tuple[float, float, float]:
    """Return kinetic (3.43), elastic (3.17) and gravity's (3.44) energy (J) of one state."""
    cup, package, gravity = model
    mass, com, inertia, _ = package
    o, _, v, w = body
    o_E_S, R_E_S, _, _ = lip_relative_to_tool(
        com,
        tool[0], rotation_matrix(tool[1]), tool[2], tool[3],
        o, rotation_matrix(body[1]), v, w,
    )  # fmt: skip
    kinetic = 0.5 * (mass * dot(v, v) + dot(w, apply(inertia, w)))
    elastic = spring_energy(spring_frames(cup, o_E_S, R_E_S), R_E_S, cup[2])
    return kinetic, elastic, -mass * dot(gravity, o)
