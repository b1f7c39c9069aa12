"""
The equations of motion of a recording, and the covariance of their errors due to noise.

At every pose of the package c = dv - f(tool, package; parameters) is zero, with dv the rate of its
body twist and f that of the model (3.42). Twists and their rates come from polynomials through
nine successive poses, so noise n of the poses leaves c = sum_j A_j n_(k+j), whose covariance is
known and banded. All is linearised about the motion that is likeliest given all poses.

Quantities of `KINDS`, which are given otherwise, may be estimated together with K and P. Where
such a quantity moves poses, it acts on the equations as noise of the poses would; where it changes
the model, it is a column of `parameter_jacobian`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import COMPILED, kernel
from bellows_ros.core.geometry.lie import apply, exp_so3, hat, rotation_to_quaternion, twist_cross
from bellows_ros.core.identification.equations import internal_strains
from bellows_ros.core.identification.segments import Measured
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, varied
from bellows_ros.core.model.equilibrium import resting_on_tool
from bellows_ros.core.model.jacobians import (
    body_jacobians,
    COM,
    DAMPING,
    INERTIA,
    LENGTH,
    MASS,
    parameter_jacobian,
    PARAMETERS,
    relaxation_jacobian,
    tool_jacobians,
    write_column,
    write_square,
)
from bellows_ros.core.model.kernels import body_acceleration, ModelTuple, State
from bellows_ros.core.model.simulation import body_row, row_state
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.savgol import savgol, weights
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

REACH = 4
"""Poses on each side used for a twist; accurate to 2e-5 up to a ninth of the sampling rate."""

STEPS = 2 * REACH + 1

SMOOTHED_OVER = 1 / 12
"""Half window (s) of the polynomials that smooth the motion of the linearisation."""

SMOOTHED_ORDER = 6

LEAST_STRENGTH = 1e-6
"""Strengths of relaxation are not below this where they are searched for."""

ORIGIN: State = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class Kind(NamedTuple):
    """
    A kind of quantity that may be estimated together with K and P.

    Parameters
    ----------
    unit : float
        Size in which it is searched for: s, m, or a logarithm.
    size : int
        How many there are.
    known : float
        With a larger standard error it is not identifiable.
    each : bool
        Whether each recording has its own.
    wide : float
        Standard deviation of what may be anything.

    """

    unit: float
    size: int
    known: float
    each: bool = False
    wide: float = np.inf


KINDS: Mapping[str, Kind] = {
    'time_offset': Kind(1e-3, 1, 3e-3, True, 0.1),
    'com': Kind(1e-3, 3, 3e-3, False, 0.05),
    'length': Kind(1e-3, 1, 1e-3, False, 0.02),
    'inertia': Kind(1e-2, 3, 0.1, False, 0.7),
    'mass': Kind(1e-2, 1, 0.1, False, 0.7),
    'package_world': Kind(1e-3, 6, 5e-3, True, 0.2),
    'package_marker': Kind(1e-3, 6, 5e-3, True, 0.1),
    'relaxation': Kind(1e-2, 2, 0.1, False, 0.1),
}
"""
By their names in fit.free.

By how much the tool's stamps are behind the package's, s; the centre of mass beside the given one
in axes of the lip, m; the length beside the given one, m; logarithms of the factors of the moments
of inertia and of the mass; shift and turn of the package's world about the middle of the
package's way, and of B in its own axes against the measured pose, m and rad; and the strengths of
relaxation beside those of the start.
"""

Free = Mapping[str, Array]
"""Values by name, for one recording."""


class Equations(NamedTuple):
    """
    The equations at N poses.

    Errors (N, 6): c as the measured poses make it, m/s^2 and rad/s^2; jacobian (N, 6, p): of f
    by the entries of K and P, then of -c by the free quantities; package, tool (N, 6, 9, 6): the
    A_j, of changes in the body's own axes.
    """

    errors: Array
    jacobian: Array
    package: Array
    tool: Array


class Segment:
    """
    A segment of a recording at the package's stamps, with a tool that may be late.

    Poses that are not noisy are linearised about as they are.
    """

    def __init__(self, measured: Measured, noisy: bool = True) -> None:
        self.measured, self.noisy = measured, noisy
        package = measured.package
        self._poses = Trajectory(package.stamps_ns, package.position, package.rotation)
        self._moves = np.array(measured.moves_with_com, dtype=float)
        self.period = float(np.median(np.diff(package.stamps_ns))) / NS_PER_S
        self.weights = weights(REACH, 2 * REACH, 1.0 / self.period)
        self._tool: tuple[float, Trajectory] | None = None

    def tool(self, free: Free) -> Trajectory:
        """Return the tool's poses at the package's stamps plus how late it is."""
        delay = float(free['time_offset'][0]) if 'time_offset' in free else 0.0
        if self._tool is None or self._tool[0] != delay:
            stamps = self._poses.stamps_ns + round(delay * NS_PER_S)
            poses = resample(self.measured.tool, stamps)
            self._tool = delay, Trajectory(
                self._poses.stamps_ns, poses.position, poses.rotation)
        return self._tool[1]

    def package(self, free: Free) -> Trajectory:
        """Return the package's poses."""
        return poses_of(self._poses, free, self._moves)

    def equations(self, cup: Cup, noise: Array, free: Free) -> Equations:
        """
        Return the equations with a cup, about the poses without an estimate of their noise.

        Parameters
        ----------
        cup : Cup
            K, P and length.
        noise : ndarray (M, 12)
            Of package and tool, small changes in their own axes, m and rad.
        free : mapping
            What is not as it was given; derivatives by these numbers follow those by K and P.

        """
        jacobian, package, tool = self.linearised(cup, noise, free)
        return Equations(self.errors(cup, noise, free, package, tool), jacobian, package, tool)

    def _model(self, cup: Cup, free: Free) -> ModelTuple:
        """Return the model with the free quantities in it."""
        longer = float(free['length'][0]) if 'length' in free else 0.0
        r = np.add(cup.relaxation, free.get('relaxation', 0.0))
        if any(cup.relaxation):
            r = np.maximum(r, LEAST_STRENGTH)
        return model_tuple(
            replace(cup, length=cup.length + longer, relaxation=tuple(r.tolist())),
            payload_of(self.measured.payload, free), self.measured.gravity)

    def _strained(self, model: ModelTuple, body: Array) -> tuple[State, Array]:
        """Return a state like those of a package (13, N), and these with internal strains."""
        like, history = resting_on_tool(model, ORIGIN), self.measured.history
        if len(like) == 4 or history is None:
            return ORIGIN, body
        inner = history[REACH:len(history) - REACH]
        strains = internal_strains(inner, model[0][1]).reshape(len(inner), 12)
        return like, np.vstack([body, strains.T])

    def errors(
        self, cup: Cup, noise: Array, free: Free, package: Array, tool: Array
    ) -> Array:
        """Return the errors of `equations`, with effects of noise as they are there."""
        parts = np.hsplit(noise, 2)
        (body, rate), (of_tool, _) = (
            _states(_changed_poses(poses, -own), REACH, 2 * REACH)
            for poses, own in zip((self.package(free), self.tool(free)), parts, strict=True))
        of_model: Array = np.empty((6, len(rate)))
        model = self._model(cup, free)
        _accelerations(model, of_tool, *self._strained(model, body), of_model)
        errors = rate - of_model.T
        for A, own in zip((package, tool), parts, strict=True):
            for j in range(STEPS):
                errors += apply(A[:, :, j], own[j:j + len(errors)])
        return errors

    def linearised(self, cup: Cup, noise: Array, free: Free) -> tuple[Array, Array, Array]:
        """Return the derivatives of `equations`: jacobian, package and tool, about a motion."""
        poses = self.package(free)
        (body, rate), (tool, tool_rate) = (
            self._smooth(_changed_poses(own, -part)) for own, part in zip(
                (poses, self.tool(free)), np.hsplit(noise, 2), strict=True))
        last = PARAMETERS if free.keys() - {'time_offset'} else DAMPING.stop
        out = np.zeros((6, 24 + last + 2, len(rate)))
        model = self._model(cup, free)
        _derivatives(model, tool, *self._strained(model, body), 0, last, out)
        by_pose, by_twist, by_tool, by_tool_twist, parameters = (
            np.ascontiguousarray(part) for part in np.split(
                np.moveaxis(out, 2, 0), (6, 12, 18, 24), axis=2))
        turning, tool_turning = twist_cross(body[7:].T), twist_cross(tool[7:].T)
        package, of_tool = (np.zeros((len(rate), 6, STEPS, 6)) for _ in range(2))
        slope, tool_slope = turning - by_twist, -by_tool_twist
        for j in range(STEPS):
            package[:, :, j] = self.weights[2, j] * np.eye(6) + self.weights[1, j] * slope
            of_tool[:, :, j] = self.weights[1, j] * tool_slope
        package[:, :, REACH] += twist_cross(rate) - by_twist @ turning - by_pose
        of_tool[:, :, REACH] -= by_tool_twist @ tool_turning + by_tool
        columns = [parameters[:, :, :DAMPING.stop]]
        for name in free:
            if name == 'time_offset':
                by_delay = apply(by_tool, tool[7:].T) + apply(by_tool_twist, tool_rate)
                columns.append(by_delay[:, :, None])
                continue
            column = model_columns(name, payload_of(self.measured.payload, free), parameters)
            changes = pose_changes(name, poses, self._moves)
            if changes is not None:
                column = column - sum(
                    package[:, :, j] @ changes[j:j + len(rate)] for j in range(STEPS))
            columns.append(column)
        return np.concatenate(columns, axis=2), package, of_tool

    def _smooth(self, poses: Trajectory) -> tuple[Array, Array]:
        """Return states and rates of twists as of `_states`, smoother away from the ends."""
        if not self.noisy:
            return _states(poses, REACH, 2 * REACH)
        states, rate = _states(poses, REACH, SMOOTHED_ORDER)
        half = max(round(SMOOTHED_OVER / self.period), REACH)
        if len(poses) > 2 * half:
            inner = slice(half - REACH, len(poses) - half - REACH)
            states[:, inner], rate[inner] = _states(poses, half, SMOOTHED_ORDER)
        return states, rate


def _states(poses: Trajectory, half_window: int, order: int) -> tuple[Array, Array]:
    """Return states (13, N), one in each column, and the rates of their twists (N, 6)."""
    found = savgol(poses, half_window, order)
    rows = np.hstack([found.position, rotation_to_quaternion(found.rotation), found.twist])
    return np.ascontiguousarray(rows.T), np.array(found.acceleration)


def _changed_poses(poses: Trajectory, change: Array) -> Trajectory:
    """Return poses after small displacements (N, 6) in their own axes."""
    return Trajectory(
        poses.stamps_ns, poses.position + apply(poses.rotation, change[:, :3]),
        poses.rotation @ exp_so3(change[:, 3:]))


if COMPILED:
    @kernel
    def columns(n: int) -> Iterable[Any]:
        """Return the range over n columns."""
        return range(n)
else:
    def columns(n: int) -> Iterable[Any]:
        """Return all columns at once: what is scalar here may be an array."""
        return (slice(None),)


@kernel
def _accelerations(model: ModelTuple, tool: Any, like: State, body: Any, out: Any) -> None:
    """Write the rates (6, N) of the package's twist."""
    for k in columns(tool.shape[1]):
        dv, dw = body_acceleration(model, row_state(tool[:, k]), body_row(body[:, k], like))
        write_column(out, k, dv, dw)


@kernel
def _derivatives(
    model: ModelTuple, tool: Any, like: State, body: Any, first: int, last: int, out: Any
) -> None:
    """
    Write derivatives (6, 24 + p + 2, N).

    By pose and twist of package and tool, by parameters, and by the strengths of relaxation.
    """
    for k in columns(tool.shape[1]):
        own, other, here = body_row(body[:, k], like), row_state(tool[:, k]), out[:, :, k]
        by_pose, by_twist = body_jacobians(model, other, own)
        write_square(here, 0, 0, by_pose)
        write_square(here, 0, 6, by_twist)
        by_pose, by_twist = tool_jacobians(model, other, own)
        write_square(here, 0, 12, by_pose)
        write_square(here, 0, 18, by_twist)
        parameter_jacobian(model, other, own, first, last, here, 24)
        relaxation_jacobian(model, other, own, here, 24 + last - first)


def payload_of(held: Package, free: Free) -> Package:
    """Return the package with the free quantities in it."""
    own = {name: free[name] for name in ('com', 'mass', 'inertia') if name in free}
    return varied(held, **own) if own else held


def poses_of(
    package: Trajectory, free: Free, moves: Array, middle: Array | None = None
) -> Trajectory:
    """
    Return the poses of B for given free quantities.

    Moves (3,) is 1 for the components of the centre of mass that B moves with, else 0. The world
    turns about a middle (3,), that of the poses where none is given.
    """
    position, R = package.position, package.rotation
    if 'com' in free:
        position = position + apply(R, moves * free['com'])
    if 'package_world' in free:
        way, turn = np.split(free['package_world'], 2)
        middle = _middle(package) if middle is None else middle
        position = middle + way + apply(exp_so3(turn), position - middle)
        R = exp_so3(turn) @ R
    if 'package_marker' in free:
        way, turn = np.split(free['package_marker'], 2)
        position, R = position + apply(R, way), R @ exp_so3(turn)
    return Trajectory(package.stamps_ns, position, R)


def _middle(package: Trajectory) -> Array:
    """Return the mean position (3,)."""
    return np.asarray(package.position.mean(axis=0))


def model_columns(name: str, payload: Package, parameters: Array) -> Array:
    """Return derivatives (..., count) by a free quantity of the model from those by parameters."""
    if name == 'length':
        return parameters[..., LENGTH]
    if name == 'com':
        return parameters[..., COM]
    if name == 'relaxation':
        return parameters[..., -2:]
    if name == 'mass':
        return np.asarray(payload.mass * parameters[..., MASS])
    if name == 'inertia':
        rows, columns = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
        sizes = payload.inertia[rows, columns]
        by_log = 0.5 * sizes[:, None] * (np.eye(3)[list(rows)] + np.eye(3)[list(columns)])
        return np.asarray(parameters[..., INERTIA] @ by_log)
    return np.zeros((*parameters.shape[:-1], KINDS[name].size))


def pose_changes(
    name: str, package: Trajectory, moves: Array, middle: Array | None = None
) -> Array | None:
    """Return the derivatives of poses (M, 6, count) in their own axes, None if they are fixed."""
    if name == 'com' and moves.any():
        change = np.zeros((6, 3))
        change[:3] = np.diag(moves)
        return np.broadcast_to(change, (len(package), 6, 3))
    if name == 'package_marker':
        return np.broadcast_to(np.eye(6), (len(package), 6, 6))
    if name == 'package_world':
        inverse = np.swapaxes(package.rotation, 1, 2)
        change = np.zeros((len(package), 6, 6))
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ hat(
            package.position - (_middle(package) if middle is None else middle))
        return change
    return None
