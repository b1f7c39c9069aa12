"""
The live predictor without ROS: tool messages in, predicted package states out.

The node and `bellows replay` run this very code. Nothing here knows a clock: time is the stamps.
"""

from __future__ import annotations

from collections import deque
import math
from typing import NamedTuple

from bellows_ros.core.equilibrium import static_equilibrium
from bellows_ros.core.integrator import advance
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import held_wrench, ModelTuple, State, Wrench
from bellows_ros.core.linearisation import largest_step, substeps_for
from bellows_ros.core.model import Cup, model_tuple, Package
from bellows_ros.core.tool_twist import PoseHistory
from bellows_ros.core.tuples import (
    apply_transposed,
    normalised,
    Quaternion,
    rotation_matrix,
    Vector,
)
from bellows_ros.errors import BellowsError

PAIRING_TOLERANCE_NS = 100_000
"""Stamps of a pose and a twist that differ by no more belong to one instant."""

LONGEST_WAIT_NS = 20_000_000
"""A pose does not wait longer for its twist, counted in stamps."""

LOST_RUN = 3
"""After so many poses in a row whose twists were lost, twists are not waited for any more."""

LONGEST_GAP_NS = 500_000_000
"""After a longer time without poses the package's motion is unknown: start from rest again."""

UNIT_WITHIN = 0.01
"""A quaternion whose length is off by more is refused, by less is scaled to unit length."""

BACKWARD_RUN = 5
"""So many backward stamps in a row, themselves increasing, are a clock that was set back."""

REFUSALS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'duplicate_stamp', 'backward_stamp',
    'frame_id', 'twist_nan', 'twist_unpaired',
)  # fmt: skip
RESTARTS = ('gap', 'clock_set_back', 'diverged', 'no_equilibrium')


class Prediction(NamedTuple):
    """The package at one stamp; SI units."""

    stamp_ns: int
    position: Vector
    """Origin of B in the world, m."""
    quaternion_xyzw: Quaternion
    """Orientation of B in the world."""
    linear: Vector
    """Linear body twist, R^T do/dt, in B axes, m/s."""
    angular: Vector
    """Body rate in B axes, rad/s."""
    force: Vector
    """Force of the cup on the package, in lip axes, N."""
    moment: Vector
    """Moment of the cup on the package about the lip's centre, in lip axes, N m."""


class _Pose(NamedTuple):
    stamp_ns: int
    position: Vector
    quaternion_xyzw: Quaternion


class _Twist(NamedTuple):
    stamp_ns: int
    linear: Vector
    angular: Vector


@kernel
def _finite(a: float, b: float, c: float) -> bool:
    """Return whether all three numbers are finite."""
    return (a - a) + (b - b) + (c - c) == 0.0


@kernel
def advance_and_hold(
    model: ModelTuple, body: State, before: State, now: State, duration: float, substeps: int
) -> tuple[State, Wrench]:
    """Return the package's state at the newest tool sample and the cup's wrench there."""
    body = advance(model, body, before, now, duration, substeps)
    return body, held_wrench(model, now, body)


class LivePredictor:
    """
    Predict the package from the tool's poses and twists as they come.

    Every accepted pose gives exactly one prediction, at its stamp. A twist is paired with the
    pose of the same stamp, whichever comes first; where none comes it is estimated from the
    poses. What is refused is counted in `refused`, a fresh start from rest in `restarts`.

    Parameters
    ----------
    cup, package : Cup, Package
    gravity : float
        m/s^2, along -z of the world.
    twist_frame : {'world', 'tool'}
        Axes of the linear and angular velocity given to `on_twist`; the linear one is the
        velocity of the tool point in either case.
    history : int
        Number of poses from which a missing twist is estimated.

    """

    def __init__(
        self,
        cup: Cup,
        package: Package,
        gravity: float,
        twist_frame: str = 'world',
        history: int = 5,
    ) -> None:
        """Prepare the model; nothing is predicted before the first pose."""
        self._gravity = gravity
        self._twist_in_world = twist_frame == 'world'
        self._history = PoseHistory(history)
        self.refused = dict.fromkeys(REFUSALS, 0)
        self.restarts = dict.fromkeys(RESTARTS, 0)
        self.poses_in = self.twists_in = self.predictions = self.twists_estimated = 0
        self.set_model(cup, package)
        self.expect_twists = False
        self.reset()

    def set_model(self, cup: Cup, package: Package) -> None:
        """Exchange cup and package between two steps; the package's motion goes on."""
        model = model_tuple(cup, package, self._gravity)
        self._longest_step = largest_step(model)
        self._model = model

    def reset(self) -> None:
        """Start from static equilibrium at the next pose, whatever its stamp and frame."""
        self.frame_id = ''
        self._forget_motion()

    def _forget_motion(self) -> None:
        """Drop the package's state and all that waits, but not the frame."""
        self._body: State | None = None
        self._tool: State | None = None
        self._last_ns = -1
        self._newest_ns = -1
        self._backward: list[int] = []
        self._waiting: deque[_Pose] = deque()
        self._twists: deque[_Twist] = deque(maxlen=32)
        self._pairs_in_a_row = self._lost_in_a_row = self._late_in_a_row = 0
        self._last_paired = False
        self._without_twist: deque[int] = deque(maxlen=16)  # stamps predicted so
        self._history.clear()

    @property
    def waiting(self) -> int:
        """Number of poses that wait for their twist."""
        return len(self._waiting)

    # ------------------------------------------------------------------ input

    def on_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion
    ) -> list[Prediction]:
        """
        Take a tool pose in the world and return the predictions that it makes possible.

        Parameters
        ----------
        stamp_ns : int
            Header stamp, ns.
        frame_id : str
            The first accepted pose sets the frame; poses in another are refused.
        position : (x, y, z)
            m.
        quaternion_xyzw : (x, y, z, w)
            Orientation; scaled to unit length where it is nearly so.

        """
        self.poses_in += 1
        reason = self._why_refused(stamp_ns, frame_id, position, quaternion_xyzw)
        if reason:
            self.refused[reason] += 1
            return []
        if self._newest_ns >= 0 and stamp_ns - self._newest_ns > LONGEST_GAP_NS:
            predictions = self.flush()
            self.restarts['gap'] += 1
            self._forget_motion()
        else:
            predictions = []
        self.frame_id = frame_id
        self._newest_ns = stamp_ns
        self._backward.clear()
        self._waiting.append(_Pose(stamp_ns, position, normalised(quaternion_xyzw)))
        return self._release(predictions)

    def on_twist(self, stamp_ns: int, linear: Vector, angular: Vector) -> list[Prediction]:
        """Take the tool's twist (m/s, rad/s) and return the predictions that it makes possible."""
        self.twists_in += 1
        if not (_finite(*linear) and _finite(*angular)):
            self.refused['twist_nan'] += 1
            return []
        if abs(stamp_ns - self._last_ns) <= PAIRING_TOLERANCE_NS:
            if not self._last_paired:  # it came after its pose had been predicted without it
                self._count_pair()
            return []
        if stamp_ns < self._last_ns:
            self.refused['twist_unpaired'] += 1
            self._note_late(stamp_ns)
            return []
        self._twists.append(_Twist(stamp_ns, linear, angular))
        return self._release([])

    def flush(self) -> list[Prediction]:
        """Predict for all poses that still wait, without their twists."""
        predictions: list[Prediction] = []
        if self._waiting:
            self.expect_twists = False
            self._pairs_in_a_row = 0
        return self._release(predictions)

    # --------------------------------------------------------------- refusals

    def _why_refused(
        self, stamp_ns: int, frame_id: str, position: Vector, q: Quaternion
    ) -> str | None:
        """Return why a pose cannot be used, or None."""
        squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        if not (_finite(*position) and math.isfinite(squared)):
            return 'nan'
        if squared < 1e-12:
            return 'zero_quaternion'
        if abs(squared - 1.0) > 2.0 * UNIT_WITHIN:
            return 'not_unit'
        if self.frame_id and frame_id != self.frame_id:
            return 'frame_id'
        if stamp_ns <= 0:
            return 'zero_stamp'
        if stamp_ns == self._newest_ns:
            return 'duplicate_stamp'
        if stamp_ns < self._newest_ns and not self._clock_was_set_back(stamp_ns):
            return 'backward_stamp'
        return None

    def _clock_was_set_back(self, stamp_ns: int) -> bool:
        """Return whether backward stamps have come long enough in order to start afresh."""
        if self._backward and stamp_ns <= self._backward[-1]:
            self._backward.clear()
        self._backward.append(stamp_ns)
        if len(self._backward) < BACKWARD_RUN:
            return False
        self.restarts['clock_set_back'] += 1
        self._forget_motion()
        return True

    # ---------------------------------------------------------------- pairing

    def _release(self, predictions: list[Prediction]) -> list[Prediction]:
        """Predict for the waiting poses, oldest first, until one must wait for its twist."""
        while self._waiting:
            pose = self._waiting[0]
            twist = self._twist_of(pose.stamp_ns)
            if twist is None and self.expect_twists:
                overdue = self._newest_ns - pose.stamp_ns > LONGEST_WAIT_NS
                if not (overdue or self._twists):  # a newer twist says that this one is lost
                    break
                self._lost_in_a_row += 1
                self.expect_twists = not overdue and self._lost_in_a_row < LOST_RUN
            self._waiting.popleft()
            if not self._last_paired:
                self._pairs_in_a_row = 0
            self._last_paired = False
            if twist is not None:
                self._count_pair()
            else:
                self._without_twist.append(pose.stamp_ns)
            prediction = self._predict(pose, twist)
            if prediction is not None:
                predictions.append(prediction)
        return predictions

    def _twist_of(self, stamp_ns: int) -> _Twist | None:
        """Return the twist of that instant, and drop those before it."""
        while self._twists:
            difference = self._twists[0].stamp_ns - stamp_ns
            if difference > PAIRING_TOLERANCE_NS:
                return None
            twist = self._twists.popleft()
            if difference >= -PAIRING_TOLERANCE_NS:
                return twist
            self.refused['twist_unpaired'] += 1
        return None

    def _note_late(self, stamp_ns: int) -> None:
        """Wait for twists again when those of poses predicted without come, only later."""
        in_time = self._newest_ns - stamp_ns <= LONGEST_WAIT_NS
        known = (abs(stamp_ns - other) <= PAIRING_TOLERANCE_NS for other in self._without_twist)
        if in_time and any(known):
            self._late_in_a_row += 1
            self.expect_twists = self.expect_twists or self._late_in_a_row >= 2

    def _count_pair(self) -> None:
        """Note that the newest predicted pose has a twist; after two in a row wait for them."""
        self._last_paired = True
        self._lost_in_a_row = self._late_in_a_row = 0
        self._pairs_in_a_row += 1
        if self._pairs_in_a_row >= 2:
            self.expect_twists = True

    # ------------------------------------------------------------- prediction

    def _predict(self, pose: _Pose, twist: _Twist | None) -> Prediction | None:
        """Advance the package to a pose's stamp, or start it from rest there."""
        self._history.append(*pose)
        if twist is None:
            self.twists_estimated += 1
            now = self._history.state()
        else:
            now = self._measured(pose, twist)
        duration = (pose.stamp_ns - self._last_ns) * 1e-9
        before, body = self._tool, self._body
        self._last_ns, self._tool = pose.stamp_ns, now
        if before is None or body is None:
            return self._start(pose.stamp_ns, now)
        if twist is None:  # with a later pose known the slope before is known better
            before = self._history.state(back=1)
        try:
            body, (force, moment) = advance_and_hold(
                self._model, body, before, now, duration,
                substeps_for(duration, self._longest_step),
            )  # fmt: skip
        except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled give nan
            force = (math.nan, math.nan, math.nan)
        if not (_finite(*force) and _finite(*moment) and _finite(*body[0]) and _finite(*body[3])):
            self.restarts['diverged'] += 1
            return self._start(pose.stamp_ns, now)
        self._body = body
        self.predictions += 1
        return Prediction(pose.stamp_ns, *body, force, moment)

    def _measured(self, pose: _Pose, twist: _Twist) -> State:
        """Return the tool's state with the twist turned into tool axes."""
        q = pose.quaternion_xyzw
        if not self._twist_in_world:
            return pose.position, q, twist.linear, twist.angular
        R_world_tool = rotation_matrix(q)
        return (
            pose.position, q,
            apply_transposed(R_world_tool, twist.linear),
            apply_transposed(R_world_tool, twist.angular),
        )  # fmt: skip

    def _start(self, stamp_ns: int, tool: State) -> Prediction | None:
        """Let the package hang at rest from the tool, if it can."""
        try:
            body = static_equilibrium(self._model, tool)
            force, moment = held_wrench(self._model, _still(tool), body)
        except (BellowsError, ArithmeticError, ValueError):
            self.restarts['no_equilibrium'] += 1
            self._body = None
            return None
        self._body = body
        self.predictions += 1
        return Prediction(stamp_ns, *body, force, moment)


def _still(tool: State) -> State:
    """Return the tool's pose without its motion."""
    return tool[0], tool[1], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def warm_up(cup: Cup, package: Package, gravity: float, twist_frame: str) -> None:
    """Predict on made-up data in a predictor that is thrown away: nothing compiles later."""
    live = LivePredictor(cup, package, gravity, twist_frame)
    still, upright = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for stamp_ns in range(1_000_000, 13_000_000, 1_000_000):
        live.on_pose(stamp_ns, 'world', still, upright)
        if stamp_ns > 6_000_000:  # first without twists, then with
            live.on_twist(stamp_ns, still, still)
    live.flush()
