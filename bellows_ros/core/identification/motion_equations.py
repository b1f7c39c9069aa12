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

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import COMPILED, kernel
from bellows_ros.core.geometry.lie import apply, exp_so3, rotation_to_quaternion, twist_cross
from bellows_ros.core.identification.equations import internal_strains
from bellows_ros.core.identification.quantities import (
    Free,
    model_columns,
    payload_of,
    pose_changes,
    poses_of,
)
from bellows_ros.core.identification.segments import Measured
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.equilibrium import resting_on_tool
from bellows_ros.core.model.jacobians import (
    body_jacobians,
    DAMPING,
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
