"""
The live predictor without ROS: tool messages in, predicted package states out.

The node and `bellows replay` share this code. The predictor reads no clock: time is in the stamps,
and the caller passes the arrival of each message.
"""

from __future__ import annotations  # signatures show names, not their members

from collections.abc import Mapping
import math
from operator import mul

from bellows_ros.core.geometry.arrays import Array, real_numbers
from bellows_ros.core.geometry.tuples import Quaternion, rotation_matrix, Vector
from bellows_ros.core.live.cycle import Cycle, FALL_NS, GRIPPED, LOST, ON_CUP, RELEASED
from bellows_ros.core.live.held_package import HeldPackage, stated_payload
from bellows_ros.core.live.observing import Observing
from bellows_ros.core.live.tool_screening import REFUSALS, Screen
from bellows_ros.core.live.tool_twist import Pairing, ToolMotion, TwistSample
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.live.vacuum import ALL, check_live, Load, Vacuum
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.grip import ratio, safety_factors
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State
from bellows_ros.core.model.structure import require_stiffness
from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.results import Payload
from bellows_ros.core.observer.states import CAMERA_ROWS, SAME_PACKAGE
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.conversion import cup_of, gravity_of, package_of, tip_of
from bellows_ros.core.parameters.table import lookup
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.sensors.set_up import Fault
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.trajectory import same_frame
from bellows_ros.errors import BellowsError, require_types
import numpy as np
from numpy.typing import ArrayLike

COAST_LIMIT_NS = 100_000_000
"""Limit of the extrapolation of the tool, ns: it errs by 20 mm at an acceleration of 4 m/s^2."""

MOVING_SPEED = 0.02
"""Speed of the tool above which no package is released, m/s."""

MOVING_RATE = 0.1
"""Angular speed of the tool above which no package is released, rad/s."""

STOPPED_NS = 100_000_000
"""Time at rest before a release, ns. A vacuum that ends earlier is a loss in motion."""

MIN_UPWARD_GRAVITY = 0.5
"""Fraction of gravity along z of the tool above which the package is above the tool."""

UNSAFE_DURATION_NS = 1_000_000_000
"""Duration of a false `is_ok` after a safety factor below safety.least, ns."""

PROVEN_NS = 500_000_000
"""Duration of uninterrupted prediction before `is_ok` is true, ns."""

RESTARTS = (
    'gap', 'clock_set_back', 'clock_set_forward', 'frame_changed', 'moved',
    'diverged', 'no_equilibrium', 'failure')
"""Reasons for a restart of the prediction from rest."""


def points_down(z_world: Vector, gravity: Vector) -> bool:
    """Return whether z of the tool in the world points down, with the package above the tool."""
    return bool(sum(map(mul, z_world, gravity)) > MIN_UPWARD_GRAVITY * math.hypot(*gravity))


class Predictor:
    """
    Predict the package from the tool's poses and twists; needs no ROS.

    Every accepted pose gives exactly one prediction, at its stamp. A twist is paired with the pose
    of equal stamp, in any order, or interpolated; otherwise it is estimated from the poses.
    Rejected messages are counted in `refused`, starts from rest in `restarts`.

    `from_parameters` adds the other functions of the node: measured poses, alarms, vacuum and
    valve, with the state of the package in a pick-and-place cycle.

    Parameters
    ----------
    cup, package : Cup, Package
    gravity : float or array_like (3,)
        Magnitude along -z of the world, or vector in the world, m/s^2.
    twist_frame : {'world', 'tool'}
        Axes of the velocities given to `on_twist`; the linear velocity is of the tool point.
    coast_limit_ns : int
        Longest extrapolation of the tool without a pose, ns; 0 for none.

    Attributes
    ----------
    alarms : list of Alarm
        Alarms, oldest first: a lost package ('lost'), deviating poses ('deviates', with shift and
        rotation), or a parameter that differs from its estimate ('differs').
    values : Values
        Parameters in use, with the chosen cup and without cups that do not hold; empty unless made
        by `from_parameters`.
    latest : Prediction or None
        Newest prediction of a held package.
    load : Load or None
        Safety factor of the grip, and distance from the validity range.
    vacuum : Vacuum
        Pressures by cup.
    lost_cups : set of int
        Cups of cup.layout lost since the package was attached.
    screen : Screen
        Judge of the tool's poses, with their arrivals.
    pairing : Pairing
        Poses that wait for their twists.
    motion : ToolMotion
        Pose and twist of the tool, and the check of its twists.
    package : HeldPackage
        State of the package, and the observer that corrects it.
    attached : bool
        Whether the package is predicted.
    predictions, coasted : int
        Counts of predictions at tool poses, and at extrapolated ones.

    Examples
    --------
    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> predictor = bellows_ros.LivePredictor(cup, package, gravity=9.81)
    >>> for k in range(1, 4):
    ...     predictions = predictor.on_pose(
    ...         k * 2_000_000, 'world', (0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    >>> [round(x, 5) for x in predictions[0].position]
    [0.0, 0.0, 0.42208]

    """

    def __init__(
        self, cup: Cup, package: Package, gravity: ArrayLike, twist_frame: str = 'world',
        coast_limit_ns: int = COAST_LIMIT_NS,
    ) -> None:
        """Prepare the model; predictions begin with the first pose."""
        require_types(cup=(cup, Cup), package=(package, Package))
        require_stiffness(cup.stiffness)
        if twist_frame not in ('world', 'tool'):
            raise BellowsError(f"twist_frame is '{twist_frame}'; expected 'world' or 'tool'.")
        self.screen, self.pairing = Screen(), Pairing()
        self.motion = ToolMotion(twist_frame == 'world')
        self._expected = False  # twists, by the last call of `expect_twists`
        self.package = HeldPackage(cup, package, gravity, resolve({}, ()))
        self._observing = Observing(self.package)
        self.alarms = self._observing.alarms
        self.coast_limit_ns = coast_limit_ns
        self.restarts = dict.fromkeys(RESTARTS, 0)
        self.predictions = self.coasted = 0
        self.attached, self._cycle, self._held_cups = True, Cycle(True), dict[int, bool]()
        self.values = self._given = Values({})
        self.vacuum, self.lost_cups = Vacuum(), set[int]()
        self.load: Load | None = None
        self.latest: Prediction | None = None
        self._begun_ns: int | None = None
        self._unsafe_ns = -1
        self._moved_ns = -STOPPED_NS
        self._resting: Quaternion | None = None  # orientation of the tool when it last rested

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, object]) -> Predictor:
        """
        Return a predictor with all functions of the node except messages.

        Parameters
        ----------
        parameters : mapping
            Parameters by name, as `read_parameters` returns them.

        Raises
        ------
        BellowsError
            If a parameter is unknown, not allowed, missing or without a computable prediction.

        Examples
        --------
        >>> predictor = bellows_ros.LivePredictor.from_parameters(
        ...     bellows_ros.read_parameters('bags/tossing.yaml'))
        >>> predictor.state, predictor.alarms
        ('held', [])

        """
        if not isinstance(parameters, Mapping):
            raise BellowsError(
                f'parameters must be a mapping of names to values, got {parameters!r}. Read a '
                'file with bellows_ros.read_parameters.')
        values = resolve(parameters, PACKAGE_PARAMETERS)
        check_live(values)
        predictor = cls(
            cup_of(values), package_of(values), gravity_of(values),
            'tool' if values.tool_pose.type == 'odometry' else values.tool_twist.frame)
        predictor.motion.set_tip(tip_of(values))
        is_held = values.vacuum.signal == 'none'
        predictor.attached, predictor._cycle = is_held, Cycle(is_held)
        predictor.use(values)
        return predictor

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> ModelTuple:
        """The model as the kernels take it."""
        return self.package.model

    @property
    def frame_id(self) -> str:
        """Frame of the accepted poses, '' before the first."""
        return self.screen.frame

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest accepted pose, ns."""
        return self.screen.newest_ns

    @property
    def refused(self) -> dict[str, int]:
        """Counts of rejected messages of the tool, by reason."""
        return {**self.screen.refused, **self.pairing.refused}

    @property
    def counts(self) -> dict[str, int]:
        """Counts of incoming messages, predictions and restarts, since the beginning."""
        return {
            'poses in': self.screen.poses, 'twists in': self.pairing.twists,
            'predictions': self.predictions, 'coasted': self.coasted,
            'twists estimated': self.motion.estimated,
            **{f'fresh starts: {reason}': count for reason, count in self.restarts.items()},
        }

    @property
    def state(self) -> str:
        """State of the package: 'none', 'gripped' (on a support), 'held', 'released' or 'lost'."""
        return self._cycle.state

    @property
    def is_ok(self) -> bool:
        """
        Whether the package is held, predicted without an alarm for 0.5 s, and gripped safely.

        The value is False with an unknown safety factor or vacuum, and while cup or payload in use
        deviate from their parameters by more than allowed.
        """
        if self.latest is not None:
            self.watch(self.latest)
        return self.is_ok_at(self.screen.arrival_ns or 0)

    def is_ok_at(self, arrival_ns: int) -> bool:
        """Return `is_ok` for a given time on the clock of arrivals."""
        observer, load, latest = self.package.observer, self.load, self.latest
        return (self.state in ON_CUP and self.alarm is None and not self.is_above
                and load is not None and load.grip is not None and not self.vacuum.is_wrong
                and not observer.departs_from_file
                and self.newest_ns >= self._unsafe_ns
                and latest is not None and self._begun_ns is not None
                and latest.stamp_ns - self._begun_ns >= PROVEN_NS
                and self.phase(arrival_ns) in ('predicting', 'settling'))

    @property
    def is_above(self) -> bool:
        """Whether z of the tool pointed down when it last rested: a package is above it."""
        if self.latest is None or self._resting is None:
            return False
        R = rotation_matrix(self._resting)
        return points_down((R[2], R[5], R[8]), self.model[2])

    @property
    def alarm(self) -> Alarm | None:
        """
        The unresolved alarm: a loss until the next package, others for 5 s.

        An alarm after which cup or payload deviate from their parameters by more than allowed
        lasts until the deviation ends.
        """
        return self._observing.unresolved(self.state == LOST, self.newest_ns)

    @property
    def payload(self) -> Payload | None:
        """Mass, centre of mass and inertia with standard deviations: estimated, or as stated."""
        if estimated := self.package.observer.payload:
            return estimated
        return stated_payload(self.values, self.newest_ns) if self.values else None

    def covariance(self, stamp_ns: int) -> Array | None:
        """
        Return the 12 by 12 covariance of a prediction; None if unavailable.

        The order is displacement (m), rotation (rad), linear and angular twist (m/s, rad/s), in
        body axes. The covariance is available for the newest prediction, and with measured poses
        for the last 0.5 s.
        """
        latest = self.latest
        if latest is None:
            return None
        return self.package.covariance(
            stamp_ns, latest.coasting and stamp_ns == latest.stamp_ns)

    def phase(self, arrival_ns: int) -> str:
        """
        Return the phase of the prediction at a time on the clock of arrivals.

        The phase is 'detached', 'waiting' (before the first pose), 'predicting', 'settling'
        (predicting with a remaining initial error), 'coasting' (a short gap of poses) or
        'interrupted' (a longer gap, or no prediction).
        """
        if not self.attached:
            return 'detached'
        has_package = bool(self.package.sample or self.pairing.waiting)
        if self.screen.arrival_ns is None and not has_package:
            return 'waiting'
        if silent_ns := self.screen.silent_ns(arrival_ns):
            return 'coasting' if silent_ns <= self.coast_limit_ns else 'interrupted'
        if not has_package:
            return 'interrupted'
        return 'settling' if self.package.is_settling else 'predicting'

    # ---------------------------------------------------------------- control

    def set_parameters(self, parameters: Mapping[str, object]) -> None:
        """
        Continue with other values of some parameters; the package keeps its motion.

        Estimates of quantities that these parameters do not describe are kept, for example of the
        camera.

        Raises
        ------
        BellowsError
            As in `from_parameters`; parameters are then unchanged.

        """
        if fixed := [name for name in parameters if lookup(name).read_only
                     and parameters[name] != self._given.get(name)]:
            raise BellowsError(
                f'{fixed[0]} cannot change while predicting. Make another LivePredictor.')
        values = resolve({**self._given, **parameters})
        check_live(values)
        self.use(values)

    def use(self, values: Values) -> None:
        """Use checked values."""
        self._given = values
        opened = {*values.cup.open, *map(float, {*self.vacuum.open_cups, *self.lost_cups})}
        if len(opened - {-1.0}) < len(values.cup.layout) // 3:  # otherwise no cup holds
            values = values.replaced({'cup.open': tuple(opened)})
        self.values = values
        self.package.observer.use_values(values)
        self.package.set_model(cup_of(values), package_of(values))
        self.load = Load(values, self.vacuum.pressure, self.vacuum.of_cups)

    def reset(self, reason: str = '') -> None:
        """
        Restart from rest at the next pose, in any frame unless the reason is in `RESTARTS`.

        Without a reason, all estimates of the package are reset, too.
        """
        if reason:
            if reason not in self.restarts:
                raise BellowsError(f"reason is '{reason}'; expected one of {', '.join(RESTARTS)}.")
            self.restarts[reason] += 1
            self.screen.forget_motion()
        else:
            self.screen.reset()
            self.pairing.expect = self._expected
            if self.attached and self.state == LOST:
                self._cycle.grip()
        self._forget_motion(SAME_PACKAGE if reason else CAMERA_ROWS)

    def expect_twists(self, expected: bool) -> None:
        """Set whether poses wait for twists; received twists change this setting."""
        self._expected = self.pairing.expect = expected

    def set_attached(self, attached: bool) -> list[Prediction]:
        """Attach a package, from rest at the next pose, or detach it."""
        predictions = self.flush() if self.attached and not attached else []
        if attached:
            self._cycle.grip()
        else:
            self._cycle.end(RELEASED)
        self._attach(attached)
        return predictions

    def _attach(self, attached: bool) -> None:
        """Predict the next package, or none."""
        is_next = attached and not self.attached
        if attached != self.attached:
            self.package.forget()
            self.screen.forget_arrivals()
        self.attached, self.latest, self._begun_ns = attached, None, None
        if is_next:
            self.package.observer.grip()
        if attached and self.lost_cups:  # the next package may be held by them
            self.lost_cups.clear()
            self.use(self._given)

    def _forget_motion(self, kept: tuple[int, ...] = SAME_PACKAGE) -> None:
        """Drop the package's state and waiting messages, but not the frame."""
        self.package.forget(kept)
        self.latest, self._unsafe_ns, self._moved_ns = None, -1, -STOPPED_NS
        self._begun_ns = self._resting = None
        self.pairing.clear()
        self.motion.clear()

    # ------------------------------------------------------ valve, vacuum, loss

    def on_valve(self, on: bool, stamp_ns: int) -> None:
        """Process a reading of the valve; a valve that is off releases the package."""
        before = self.state
        self._cycle.on_valve(on)
        self._follow_cycle(before, stamp_ns)

    def on_vacuum(self, held: bool, stamp_ns: int | None = None, cup: int = ALL) -> None:
        """
        Process a reading of the vacuum.

        Parameters
        ----------
        held : bool
            Whether the vacuum holds the package.
        stamp_ns : int, optional
            Stamp of the reading, ns; default: stamp of the newest tool pose.
        cup : int
            Index in cup.layout of the measured cup; default: all.

        """
        stamp_ns = self.newest_ns if stamp_ns is None else stamp_ns
        observer = self.package.observer
        moves = self.newest_ns - self._moved_ns < STOPPED_NS
        breaks = self._held_cups.get(cup, False) and not held
        observer.on_vacuum(held, breaks and self.state in ON_CUP, moves, cup)
        self._held_cups[cup] = held
        if cup == ALL:
            before, patience_ns = self.state, observer.patience_ns
            self._cycle.on_vacuum(held, stamp_ns, moves or observer.departs,
                                  patience_ns and patience_ns + FALL_NS)
            self._follow_cycle(before, stamp_ns)
        self._note_alarms()

    def on_pressure(self, pressure: float, frame_id: str) -> str:
        """Process a pressure (Pa) of all cups or of one; return the reason of rejection, or ''."""
        opened = self.vacuum.open_cups
        readings = self.vacuum.update(self._given, pressure, frame_id)
        if isinstance(readings, str):
            if self.vacuum.is_wrong:
                self.on_vacuum(False)
            return readings
        for is_held, cup in readings:
            self.on_vacuum(is_held, cup=cup)
        if self.load is not None:
            self.load.set_pressure(self.vacuum.pressure, self.vacuum.of_cups)
        if self.vacuum.open_cups != opened:
            self.use(self._given)
        return ''

    def _follow_cycle(self, before: str, stamp_ns: int) -> None:
        """Attach or detach the package after a change of its state."""
        state = self.state
        if state == LOST and before != LOST and self._given.get('alarm.false_per_hour', 0.0):
            self._observing.note_loss(stamp_ns)
        if (before in ON_CUP) != (state in ON_CUP):
            self._attach(state in ON_CUP)

    def _note_alarms(self) -> None:
        """Process new alarms of the observer: loss of the package, or of a cup."""
        if not (new := self._observing.new_alarms()):
            return
        if lost := {alarm.cup for alarm in new if alarm.cup >= 0} - self.lost_cups:
            self.lost_cups |= lost
            self.use(self._given)
        if any(alarm.kind == LOST and alarm.cup < 0 for alarm in new) and self.state in ON_CUP:
            self._cycle.end(LOST)
            self._observing.lose()
            if not (self._cycle.valve is self._cycle.vacuum is None):  # they show the next package
                self._attach(False)

    # ------------------------------------------------------------------ input

    def on_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        arrival_ns: int | None = None,
    ) -> list[Prediction]:
        """
        Process a tool pose in the world and return the resulting predictions.

        Parameters
        ----------
        stamp_ns : int
            Header stamp, ns.
        frame_id : str
            Frame, set by the first accepted pose; poses in another frame are rejected.
        position : (x, y, z)
            m.
        quaternion_xyzw : (x, y, z, w)
            Orientation; normalised if its length is nearly 1.
        arrival_ns : int, optional
            Arrival on a monotonic clock; None if messages do not arrive in real time.

        """
        reason = self.screen.judge(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
        if reason in REFUSALS:
            if reason in ('jump', 'millimetres'):
                self._begun_ns = None
            return []
        predictions: list[Prediction] = []
        if reason:
            predictions = self.flush()
            self.restarts[reason] += 1
            self._forget_motion()
        self.pairing.add_pose(self.motion.pose(stamp_ns, position, quaternion_xyzw))
        return predictions + self._release()

    def on_twist(
        self, stamp_ns: int, linear: Vector, angular: Vector, frame_id: str | None = None
    ) -> list[Prediction]:
        """
        Process the tool's twist (m/s, rad/s) and return the resulting predictions.

        The frame_id does not define the axes, as drivers set it arbitrarily.
        """
        self.pairing.add_twist(TwistSample(stamp_ns, linear, angular))
        return self._release()

    def on_measured(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        covariance: Array | None = None, arrival_ns: int | None = None,
    ) -> None:
        """
        Correct the next predictions with a measured pose of the package.

        Parameters
        ----------
        stamp_ns : int
            Time of the exposure, ns; poses may be late and out of order.
        frame_id : str
            Frame of the tool's poses, or any with recording.package_world.
        position : (x, y, z)
            m.
        quaternion_xyzw : (x, y, z, w)
            Orientation.
        covariance : ndarray (6, 6), optional
            Covariance of position and rotation about axes of the world, m^2, rad^2; default:
            measured.noise.
        arrival_ns : int, optional
            Arrival on the clock of `on_pose`.

        """
        if covariance is not None:
            covariance = real_numbers(covariance, 'covariance')
            if covariance.shape != (6, 6):
                raise BellowsError(f'covariance must be of shape (6, 6), got {covariance.shape}.')
        newest_ns = self.screen.arrival_ns
        since_ns = 0 if arrival_ns is None or newest_ns is None else max(arrival_ns - newest_ns, 0)
        if self._observing.on_measured(
                stamp_ns, same_frame(self.frame_id, frame_id),
                (position, quaternion_xyzw, covariance), since_ns):
            self._note_alarms()
            if self.state == LOST and self.attached and self._observing.shows_next:
                self._cycle.grip()

    def on_wrench(
        self, stamp_ns: int, frame_id: str, force: Vector, moment: Vector
    ) -> str:
        """
        Correct the next predictions with a wrench of the force-torque sensor.

        Parameters
        ----------
        stamp_ns : int
            Stamp of the wrench, ns, later than the last.
        frame_id : str
            Axes: of the world for the frame of the tool's poses, otherwise of wrench.frame.
        force, moment : (x, y, z)
            N, N m.

        Returns
        -------
        str
            Reason of a rejection, or ''.

        """
        in_world = bool(frame_id) and frame_id == self.frame_id
        refused = self._observing.on_wrench(stamp_ns, (force, moment), in_world, self.newest_ns)
        self._note_alarms()
        return refused

    @property
    def wrench_fault(self) -> Fault | None:
        """Fault in the set-up of the force-torque sensor; its wrenches are then ignored."""
        return self.package.observer.wrenches.set_up.fault

    def flush(self) -> list[Prediction]:
        """Predict for all waiting poses, without their twists."""
        self.pairing.release_waiting_poses()
        return self._release()

    def coast(self, arrival_ns: int) -> list[Prediction]:
        """Return a prediction at a time without a pose, within the limit of the extrapolation."""
        newest_ns = self.screen.arrival_ns
        if newest_ns is None:
            return []
        stamp_ns = self.newest_ns + arrival_ns - newest_ns
        if self._cycle.follows:
            self._on_tool(stamp_ns)
        prediction = self.package.coast(stamp_ns) if self.phase(arrival_ns) == 'coasting' else None
        if prediction is None:
            return []
        self.coasted += 1
        self.latest, self._begun_ns = prediction, None
        return [prediction]

    # ------------------------------------------------------------- prediction

    def _release(self) -> list[Prediction]:
        """Predict for the poses whose twist has arrived, or is no longer awaited."""
        return [
            prediction for pose, twist in self.pairing.ready()
            if (prediction := self._predict(pose, twist)) is not None]

    def _predict(self, pose: PoseSample, twist: TwistSample | None) -> Prediction | None:
        """Advance the package to a pose's stamp, or start from rest at this pose."""
        before, now = self.motion.states(pose, twist, self.package.sample is not None)
        if is_moving(now):
            self._moved_ns = pose.stamp_ns
        elif before or twist:  # the first pose alone has no speed
            self._resting = now[1]
        if self._cycle.follows:
            self._on_tool(pose.stamp_ns, pose.position)
        if not self.attached:
            return None
        prediction = self.package.follow(pose.stamp_ns, before, now)
        if self.package.outcome:
            self.restarts[self.package.outcome] += 1
            self._begun_ns = None
        if prediction is not None:
            self.predictions += 1
            self.latest = prediction
            if self._begun_ns is None:
                self._begun_ns = prediction.stamp_ns
        self._note_alarms()
        return prediction

    def _on_tool(self, stamp_ns: int, position: Vector | None = None) -> None:
        """Update the state of the package by time and the tool's motion."""
        cycle = self._cycle
        before = cycle.state
        if before == GRIPPED and position is not None:
            gravity = self.model[2]
            cycle.on_height(-sum(map(mul, position, gravity)) / math.hypot(*gravity))
        if cycle.is_due(stamp_ns):
            cycle.decide(self.package.observer.departs)
        self._follow_cycle(before, stamp_ns)

    def watch(self, prediction: Prediction) -> tuple[float, float] | None:
        """Record and return the safety factors of a prediction, if the grip is known."""
        if self.load is None:
            return None
        factors = self.load.watch_force(self.model, prediction)
        if factors and min(factors) < self.load.required:
            self._unsafe_ns = prediction.stamp_ns + UNSAFE_DURATION_NS
        return factors


def is_moving(tool: State) -> bool:
    """Return whether a tool is too fast for a release."""
    return math.hypot(*tool[2]) > MOVING_SPEED or math.hypot(*tool[3]) > MOVING_RATE


def warm_up(cup: Cup, package: Package, gravity: ArrayLike, twist_frame: str) -> None:
    """Compile all kernels by predictions of synthetic data in a temporary predictor."""
    live = Predictor(cup, package, np.linalg.norm(gravity), twist_frame)
    safety_factors((ratio(1.0, 1.0), 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    (still, upright, *_), arrival_ns = ORIGIN, 0
    for arrival_ns in range(10_000_000, 150_000_000, 10_000_000):  # until settled
        live.on_pose(arrival_ns, 'world', still, upright, arrival_ns)
        if arrival_ns > 60_000_000:  # first without twists, then with
            live.on_twist(arrival_ns + 50_000, still, still)
    live.on_twist(arrival_ns + 500_000, still, still)
    live.on_twist(arrival_ns + 1_500_000, still, still)
    for k, x in enumerate((1e-6, 1.0, 2e-6), 1):  # with a jump, and back
        live.on_pose(arrival_ns + k * 1_000_000, 'world', (x, 0.0, 0.0), upright, arrival_ns)
    live.flush()
    live.coast(arrival_ns + live.coast_limit_ns)
