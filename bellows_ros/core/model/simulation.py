"""Simulation of the package under a tool motion."""

from dataclasses import dataclass
import math
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.model import equilibrium, kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, STANDARD_GRAVITY
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.signals.trajectory import frozen, NS_PER_S, pose_rows, Trajectory
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np
from numpy.typing import ArrayLike


def state_row(
    position: ArrayLike, quaternion_xyzw: ArrayLike, twist: ArrayLike = (0.0,) * 6
) -> State:
    """Return the state of a pose and a body twist for the kernels; without twist at rest."""
    o, q, v = (np.asarray(x, float).tolist() for x in (position, quaternion_xyzw, twist))
    return (o[0], o[1], o[2]), (q[0], q[1], q[2], q[3]), (v[0], v[1], v[2]), (v[3], v[4], v[5])


MAX_REST_RATES = (1e-3, 1e-2)
"""Largest speeds of a tool at rest, m/s and rad/s."""


def stands(twist: Array) -> bool:
    """Return whether a tool with a twist (6,) is at rest."""
    speed, rate = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
    return bool(speed <= MAX_REST_RATES[0] and rate <= MAX_REST_RATES[1])


def rest(model: ModelTuple, row: Array, guess: State | None = None) -> State:
    """Return the package at rest under a tool (13,), searched from a guess if given."""
    return equilibrium.static_equilibrium(model, state_row(row[:3], row[3:7]), guess)


def require_steps(steps: float, max_steps: int = 10_000_000) -> None:
    """Raise BellowsError for a prediction with too many steps, which would take some seconds."""
    if not steps <= max_steps:
        raise BellowsError(
            f'The prediction takes {steps:.3g} integration steps; expected at most '
            f'{max_steps:.3g}. Shorten what is predicted, or check cup.stiffness, cup.damping, '
            'package.mass and package.inertia, whose fastest mode sets the step.')


def steady_start(
    model: ModelTuple, tool: 'Trajectory | ToolRows', guess: State | None = None
) -> State:
    """
    Return the package in steady motion at a plan's first point; at rest under a tool at rest.

    Under a moving tool, package and tool move as one rigid body with the first acceleration of the
    plan. Under a tool at rest the search starts from a guess.

    Raises
    ------
    UnstableError
        If there is no steady motion.

    """
    rows = tool_rows(tool)
    if stands(rows[0, 7:]):
        return rest(model, rows[0], guess)
    hanging, first = rest(model, rows[0]), row_state(rows[0])
    duration = float(tool.seconds[1])
    segment = kernels.tool_segment(first, row_state(rows[1]), duration)
    linear, dw = (t3.scale(2.0 / duration**2, quadratic) for quadratic in segment[3:8:4])
    R, (v, w) = t3.rotation_matrix(first[1]), first[2:4]
    dv = t3.subtract(t3.apply_transposed(R, linear), t3.cross(w, v))
    rates = np.array([v, w, dv, dw]).reshape(2, 6)
    T_world_tool = lie.transform(lie.quaternion_to_rotation(rows[0, 3:7]), rows[0, :3])

    def with_offset(offset: Array) -> tuple[State, Array]:
        state = equilibrium.moved_by(hanging, np.pad(offset, (0, 6)))
        T_world_package = lie.transform(lie.quaternion_to_rotation(np.array(state[1])), state[0])
        T_package_tool = lie.inverse_transform(T_world_package) @ T_world_tool
        at_package = lie.apply(lie.adjoint(T_package_tool), rates)
        return state_row(state[0], state[1], at_package[0]), at_package[1]

    def unbalance(offset: Array) -> Array:
        state, needed = with_offset(offset)
        return np.ravel(equilibrium.acceleration(model, first, state)) - needed

    offset, shifts = np.zeros(6), 1e-6 * np.eye(6)
    for _ in range(30):
        J = np.column_stack([
            (unbalance(offset + h) - unbalance(offset - h)) / 2e-6 for h in shifts])
        if not abs(np.linalg.det(J)) > 0.0:
            break
        step = np.linalg.solve(J, unbalance(offset))
        offset -= step * min(1.0, 0.1 / max(float(np.abs(step).max()), 1e-300))
        if np.abs(step).max() < 1e-10:
            return equilibrium.adapted(model, first, with_offset(offset)[0])
    raise UnstableError(
        'The plan begins in motion, and the cup cannot hold the package in steady motion at '
        f'the first acceleration, {math.hypot(*dv):.3g} m/s^2. Give the plan from rest.')


def diverged() -> UnstableError:
    """Return the error for a prediction that is not finite."""
    return UnstableError(
        'The prediction along the plan diverges. Check the plan for jumps, and cup.stiffness, '
        'cup.damping, package.mass and their units.')


@dataclass(frozen=True, eq=False, slots=True)
class ToolRows:
    """
    A checked motion of the tool in the form of the kernels.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Stamps, ns.
    rows : array (N, 13)
        States, as `tool_rows` returns them.

    """

    stamps_ns: Stamps
    rows: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def seconds(self) -> Array:
        """Times since the first sample, s (N,)."""
        return np.asarray((self.stamps_ns - self.stamps_ns[0]) / NS_PER_S)

    def trajectory(self) -> Trajectory:
        """Return the simulation as a checked trajectory."""
        return trajectory_of(self.stamps_ns, self.rows)


def tool_rows(tool: Trajectory | ToolRows) -> Array:
    """Return a motion with twists as rows (N, 13): position, quaternion xyzw, body twist."""
    if isinstance(tool, ToolRows):
        return tool.rows
    if tool.twist is None:
        raise BellowsError('The tool trajectory has no twists; filter or differentiate it first.')
    return np.hstack([pose_rows(tool), tool.twist])


def trajectory_of(stamps_ns: Stamps, rows: Array) -> Trajectory:
    """Return a motion with twists of rows (N, 13) or longer, as `tool_rows` returns them."""
    rotation = frozen(lie.quaternion_to_rotation(rows[:, 3:7]))
    return Trajectory(stamps_ns, rows[:, :3], rotation, rows[:, 7:13])


def simulate(
    cup: Cup, package: Package, tool: Trajectory, start: State | None = None,
    gravity: float | ArrayLike = STANDARD_GRAVITY, substeps: int | None = None
) -> Trajectory:
    """
    Simulate the package under a whole tool motion.

    Parameters
    ----------
    cup : Cup
        Cup between tool and package.
    package : Package
        Package on the cup.
    tool : Trajectory
        N poses of E in the world with body twists; interpolated by cubic Hermite curves.
    start : State, optional
        State of B in the world at the first sample; default: static equilibrium.
    gravity : float or array_like (3,)
        Magnitude along -z of the world, or vector in the world, m/s^2.
    substeps : int, optional
        Integration steps per tool sample; default: chosen from the model's fastest mode.

    Returns
    -------
    Trajectory
        N poses and body twists of B in the world, at the tool's stamps.

    Raises
    ------
    BellowsError
        If there is no static equilibrium to start from, or the simulation diverges.

    """
    model = model_tuple(cup, package, gravity)
    rows = tool_rows(tool)
    durations = np.diff(tool.stamps_ns) / NS_PER_S
    longest = equilibrium.largest_step(model)
    steps = np.array([substeps or equilibrium.substeps_for(duration, longest)
                      for duration in durations.tolist()], dtype=np.int64)
    try:
        begin = (equilibrium.adapted(model, row_state(rows[0]), start) if start
                 else rest(model, rows[0]))
        out = simulate_rows(model, begin, rows, durations, steps)
    except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled ones give nan
        out = np.full(1, np.nan)
    if not np.all(np.isfinite(out)):
        raise UnstableError(
            'The simulation diverged. The package is too heavy for the cup, the cup too stiff for '
            'the sampling time, or its damping negative. Check package.mass, cup.stiffness, '
            'cup.damping and their units.')
    return trajectory_of(tool.stamps_ns, frozen(out))


def simulate_rows(
    model: ModelTuple, start: State, tool: Array, durations: Array, substeps: Stamps
) -> Array:
    """Return the package's rows (N, `row_length`) for N tool rows and the times between."""
    out = np.empty((len(tool), row_length(start)))
    _simulate(model, start, *as_inputs(tool, durations, substeps), out)
    return out


def accelerations(model: ModelTuple, tool: Array, body: Array) -> Array:
    """Return the change of twists (N, 6) of bodies (N, 13) without internal strains, a second."""
    out = np.empty((len(tool), 6))
    _accelerate(model, np.ascontiguousarray(tool), np.ascontiguousarray(body), out)
    return out


@kernel
def row_state(row: Array) -> State:
    """Return the state in one row of 13 numbers."""
    return ((row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]),
            (row[7], row[8], row[9]), (row[10], row[11], row[12]))


@kernel
def body_row(row: Array, body: State) -> State:
    """Return the state in one row, with internal strains if the body has any."""
    if len(body) == 4:
        return row_state(row)
    return kernels.with_strains(row_state(row), kernels.strains_of(row[13:]))


def row_length(body: State) -> int:
    """Return the length of a row: 13, or 25 with internal strains."""
    return 13 + 6 * len(body[4:])


@kernel
def write_row(row: Array, state: State) -> None:
    """Write a state into one row of 13 numbers, or of 25 with its internal strains."""
    row[0], row[1], row[2] = state[0]
    row[3], row[4], row[5], row[6] = state[1]
    row[7], row[8], row[9] = state[2]
    row[10], row[11], row[12] = state[3]
    if len(state) == 6:
        if len(row) > 13:
            row[13], row[14], row[15] = state[4][0]
            row[16], row[17], row[18] = state[4][1]
            row[19], row[20], row[21] = state[5][0]
            row[22], row[23], row[24] = state[5][1]


@entry
def first_after(times: Any, time: float, count: int) -> int:
    """Return the index of the first sample after a time."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if times[middle] > time:
            high = middle
        else:
            low = middle + 1
    return low


@entry
def _simulate(
    model: ModelTuple, start: State, tool: Any, durations: Any, substeps: Any, out: Array
) -> None:
    body, before = start, row_state(tool[0])
    write_row(out[0], body)
    for k in range(len(durations)):
        after = row_state(tool[k + 1])
        body = kernels.advance(model, body, before, after, durations[k], substeps[k])
        write_row(out[k + 1], body)
        before = after


@entry
def _accelerate(model: ModelTuple, tool: Any, body: Any, out: Array) -> None:
    for k in range(len(tool)):
        linear, angular = kernels.body_acceleration(
            model, row_state(tool[k]), row_state(body[k]))
        out[k, 0], out[k, 1], out[k, 2] = linear
        out[k, 3], out[k, 4], out[k, 5] = angular
