"""
The live predictor without ROS: tool messages in, predicted package states out.

The node and `bellows replay` run this very code. Nothing here reads a clock: the time of motion
is in the stamps, and the caller passes the arrival of each message.
"""

from __future__ import annotations  # signatures show names, not their members

from array import array
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
import tomllib
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.jit import seldom_collected
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.live.flight import Flight
from bellows_ros.core.live.load import ALL
from bellows_ros.core.live.payload import LivePayload
from bellows_ros.core.live.tool_twist import Pairing, ToolMotion
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.cup_package import Cup, frozen_array, Package
from bellows_ros.core.model.grip import ratio, safety_factors
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State
from bellows_ros.core.model.simulation import trajectory_of
from bellows_ros.core.model.structure import require_stiffness
from bellows_ros.core.signals import screening
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.trajectory import frozen, NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError, require_types
import numpy as np
from numpy.typing import ArrayLike

from .tool_screening import Frame, REFUSALS, Screen, ToolArrivals, TwistSample, why_no_twist

COAST_LIMIT_NS = 100_000_000
"""Default time (ns) for which the tool is extrapolated."""

MOVING_SPEED, MOVING_RATE = 0.02, 0.1
"""Speed (m/s) or rate (rad/s) of the tool from which on no package is released."""

MESSAGES = tomllib.loads(Path(__file__).with_name('messages.toml').read_text())
RESTARTS: Mapping[str, str] = {
    reason: text.format(gap=screening.LONGEST_GAP_NS / NS_PER_S)
    for reason, text in MESSAGES['restarts'].items()}
"""Why the prediction starts again, in words."""


class LivePredictor:
    """
    Predict the package from the tool's poses and twists as they come.

    Every accepted pose gives exactly one prediction, at its stamp. A twist is paired with the
    pose of the same stamp, whichever comes first, or interpolated; where that cannot be it is
    estimated from the poses. What is refused is counted in `refused`, a fresh start from rest in
    `restarts`.

    Parameters
    ----------
    cup, package : Cup, Package
    gravity : float or array_like (3,)
        m/s^2, along -z of the world, or as a vector there.
    twist_frame : {'world', 'tool'}
        Axes of the linear and angular velocity given to `on_twist`; the linear one is the
        velocity of the tool point in either case.
    coast_limit_ns : int
        How long the tool is extrapolated when no pose comes, 0 for not at all.

    Attributes
    ----------
    pairing : Pairing
        Which poses wait for their twists.
    tool : ToolMotion
        Pose and twist of the tool, and the check of its twists.
    package : LivePayload
        State of the package, and the observer that corrects it, if any.
    arrivals : ToolArrivals
        When accepted poses came.
    attached : bool
        Whether the cup holds the package; without it nothing is predicted.
    flight : Flight or None
        Follows the package after the valve, where one is set.
    poses_in, twists_in, predictions, twists_estimated, coasted : int
        Counts of inputs, outputs, and estimated twists and tool poses.

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
        self._screen, self._twist_frame = Screen(), Frame()
        self.pairing, self.arrivals = Pairing(), ToolArrivals()
        self.tool = ToolMotion(twist_frame == 'world')
        self.package = LivePayload(cup, package, gravity)
        self.coast_limit_ns = coast_limit_ns
        self._counts = dict.fromkeys(REFUSALS, 0)
        self.restarts = dict.fromkeys(RESTARTS, 0)
        self.poses_in = self.twists_in = 0
        self.predictions = self.twists_estimated = self.coasted = 0
        self.attached, self._twists_expected = True, False
        self._vacuum: dict[int, bool] = {}  # whether a cup holds by it, or all together
        self.flight: Flight | None = None

    # ------------------------------------------------------------------ state

    @property
    def model(self) -> ModelTuple:
        """The model as the kernels take it."""
        return self.package.model

    @property
    def frame_id(self) -> str:
        """Frame of the accepted poses, '' before the first."""
        return self._screen.frame.name or ''

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest accepted pose, ns."""
        return self._screen.newest_ns

    @property
    def refused(self) -> dict[str, int]:
        """Counts of refused messages, by reason."""
        return {**self._counts, 'twist_unpaired': self.pairing.unpaired}

    @property
    def counts(self) -> dict[str, int]:
        """Counts of messages in, predictions out, and restarts, since the beginning."""
        return {
            'poses in': self.poses_in, 'twists in': self.twists_in,
            'predictions': self.predictions, 'coasted': self.coasted,
            'twists estimated': self.twists_estimated,
            'twists interpolated': self.pairing.interpolated,
            'twists unpaired': self.pairing.unpaired,
            **{f'fresh starts: {reason}': count for reason, count in self.restarts.items()},
        }

    def phase(self, arrival_ns: int) -> str:
        """
        Return the phase of the prediction at a time on the clock of arrivals.

        'detached', 'waiting' (no pose has come yet), 'predicting', 'settling' (predicting, but
        the error of the start has not decayed), 'coasting' (no pose has come for a moment) or
        'lost' (none for longer than can be bridged, or no prediction from it); after the valve
        'released', 'flying' or 'landed'.
        """
        if not self.attached:
            return 'detached'
        if self.flight is not None and self.flight.state:
            return self.flight.state
        if self.arrivals.newest_ns is None:
            return 'waiting'
        if silent_ns := self.arrivals.silent_ns(arrival_ns, self._screen.period_ns):
            return 'coasting' if silent_ns <= self.coast_limit_ns else 'lost'
        if not (self.package.sample or self.pairing.waiting):
            return 'lost'
        return 'settling' if self.package.settling.now else 'predicting'

    # ---------------------------------------------------------------- control

    def configure(self, coast_limit_ns: int, flight: Flight) -> None:
        """Set how long pauses are bridged, and what follows the package after the valve."""
        self.coast_limit_ns, self.flight = coast_limit_ns, flight

    def set_model(self, cup: Cup, package: Package) -> None:
        """Continue with another cup or package; pose and motion stay as they are."""
        self.package.set_model(cup, package)

    def reset(self, reason: str = '') -> None:
        """Start from rest at the next pose, in any frame; for one of `RESTARTS` in the same."""
        if reason:
            self.restarts[reason] += 1
            self._screen.forget_motion()
        else:
            self._screen.reset()
            self.pairing.expect = self._twists_expected
        self._forget_motion()

    def expect_twists(self, expected: bool) -> None:
        """Let poses wait for their twists, or not, until those that come show otherwise."""
        self._twists_expected = self.pairing.expect = expected

    def set_attached(self, attached: bool) -> list[Prediction]:
        """Take up a package, from rest at the next pose, or let it go."""
        predictions = self.flush() if self.attached and not attached else []
        if attached != self.attached:
            self.package.forget()
            self.arrivals.clear()
        self.attached = attached
        return predictions

    def switch_valve(self, on: bool, stamp_ns: int) -> None:
        """Toss the package, its valve being switched at a stamp, or take up the next one."""
        if self.flight is None:
            return
        if not on:
            self.flight.switch(stamp_ns)
        elif self.flight.state:
            self.flight.forget()
            self.package.forget()

    def _forget_motion(self) -> None:
        """Drop the package's state and all that waits, but not the frame."""
        if self.flight is not None:
            self.flight.forget()
        self.package.forget(is_another=False)
        self.pairing.clear()
        self.tool.clear()
        self._twist_frame = Frame()
        self.arrivals.clear()

    # ------------------------------------------------------------------ input

    def on_pose(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        arrival_ns: int | None = None,
    ) -> list[Prediction]:
        """
        Process a tool pose in the world and return the predictions that it makes possible.

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
        arrival_ns : int, optional
            Arrival on a monotonic clock; None where messages do not arrive in real time.

        """
        self.poses_in += 1
        try:
            reason = self._screen.judge(stamp_ns, frame_id, position, quaternion_xyzw, arrival_ns)
        except TypeError:
            frozen_array(quaternion_xyzw, (4,), 'quaternion_xyzw')
            raise
        if reason in self._counts:
            self._counts[reason] += 1
            return []
        predictions: list[Prediction] = []
        if reason:
            predictions = self.flush()
            self.restarts[reason] += 1
            self._forget_motion()
        if self._screen.suspect:
            self.package.settling.inflate(stamp_ns, *self._screen.suspect)
        self.arrivals.add(arrival_ns)
        self.pairing.add_pose(self.tool.pose(stamp_ns, position, quaternion_xyzw))
        return predictions + self._release()

    def on_twist(
        self, stamp_ns: int, linear: Vector, angular: Vector, frame_id: str | None = None
    ) -> list[Prediction]:
        """
        Process the tool's twist (m/s, rad/s) and return the predictions that it makes possible.

        Its frame_id does not define its axes, as drivers fill in what they like; but twists in
        another one than the first are refused until nothing else has come for a while.
        """
        self.twists_in += 1
        refused = why_no_twist(linear, angular)
        if refused or not self._twist_frame.accepts(frame_id, stamp_ns):
            self._counts[refused or 'twist_frame_id'] += 1
            return []
        self.pairing.add_twist(TwistSample(stamp_ns, linear, angular))
        return self._release()

    def on_measured(
        self, stamp_ns: int, frame_id: str, position: Vector, quaternion_xyzw: Quaternion,
        covariance: Array | None = None,
    ) -> None:
        """
        Correct the next predictions with a measured pose of the package, if it has an observer.

        It may be late, and out of order; what cannot be used is counted by the observer. The
        covariance (6, 6) is that of the message, about axes of the world. Its frame is the
        tool's unless recording.package_world is given.
        """
        observer = self.package.observer
        if observer is None:
            return
        measurement = observer.sensor.measurement(stamp_ns, position, quaternion_xyzw, covariance)
        if isinstance(measurement, str):
            observer.counts[measurement] += 1
        elif not observer.sensor.has_own_world and self.frame_id not in ('', frame_id):
            observer.counts['frame_id'] += 1
        elif self.flight is not None and self.flight.is_free:
            observer.counts['not_held'] += 1
        else:
            self.package.correct(measurement)

    def on_vacuum(self, is_held: bool, cup: int = ALL) -> None:
        """Combine measured poses with the vacuum: whether the cup, or one of them, holds by it."""
        observer, sample = self.package.observer, self.package.sample
        breaks, self._vacuum[cup] = self._vacuum.get(cup, False) and not is_held, is_held
        if observer is not None and not (self.flight is not None and self.flight.state):
            speed, rate = (0.0, 0.0) if sample is None else map(t3.norm, sample.tool[2:4])
            observer.on_vacuum(is_held, breaks, speed > MOVING_SPEED or rate > MOVING_RATE, cup)

    def flush(self) -> list[Prediction]:
        """Predict for all poses that still wait, without their twists."""
        self.pairing.release_waiting_poses()
        return self._release()

    def coast(self, arrival_ns: int) -> list[Prediction]:
        """Return a prediction for a moment at which no pose came, while that is safe."""
        newest_ns = self.arrivals.newest_ns
        if newest_ns is None or self.phase(arrival_ns) != 'coasting':
            return []
        prediction = self.package.coast(self._screen.newest_ns + arrival_ns - newest_ns)
        if prediction is None:
            return []
        self.coasted += 1
        return [prediction]

    # ------------------------------------------------------------- prediction

    def _release(self) -> list[Prediction]:
        """Predict for the poses that need not wait any longer."""
        return [
            prediction for pose, twist in self.pairing.ready()
            if (prediction := self._predict(pose, twist)) is not None]

    def _predict(self, pose: PoseSample, twist: TwistSample | None) -> Prediction | None:
        """Advance the package to a pose's stamp, or start it from rest there."""
        before, now = self._tool_states(pose, twist)
        if not self.attached:
            return None
        flight = self.flight
        if flight is not None and flight.is_free:
            prediction = flight.fly(self.model, pose.stamp_ns, now)
        else:
            prediction = self.package.follow(pose.stamp_ns, before, now)
            if self.package.outcome:
                self.restarts[self.package.outcome] += 1
            if flight is not None and prediction is not None:
                prediction = flight.follow(self.model, prediction)
        if prediction is not None:
            self.predictions += 1
        return prediction

    def _tool_states(
        self, pose: PoseSample, twist: TwistSample | None
    ) -> tuple[State | None, State]:
        """Return the tool with its twist, measured or estimated, and better at the pose before."""
        self.tool.add(pose)
        last = self.package.sample
        if twist is not None:
            start, seconds = (ORIGIN, 0.0) if last is None else (
                last.tool, (pose.stamp_ns - last.stamp_ns) / NS_PER_S)
            now, excess, suspicion, jump = self.tool.measured(pose, twist, start, seconds)
            if last is None or excess <= 1.0:
                if last is not None and suspicion > 1.0:
                    self.package.settling.inflate(pose.stamp_ns, *jump)
                return None, now
            self._counts['twist_misses_pose'] += 1
        self.twists_estimated += 1
        return self.tool.estimated(has_before=last is not None)


@seldom_collected()
def warm_up(cup: Cup, package: Package, gravity: ArrayLike, twist_frame: str) -> None:
    """Compile everything, by predicting made-up data in a temporary predictor."""
    live = LivePredictor(cup, package, np.linalg.norm(gravity), twist_frame)
    safety_factors((ratio(1.0, 1.0), 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    (still, upright, *_), arrival_ns = ORIGIN, 0
    for arrival_ns in range(10_000_000, 150_000_000, 10_000_000):  # until it has settled
        live.on_pose(arrival_ns, 'world', still, upright, arrival_ns)
        if arrival_ns > 60_000_000:  # first without twists, then with
            live.on_twist(arrival_ns + 50_000, still, still)
    live.on_twist(arrival_ns + 500_000, still, still)
    live.on_twist(arrival_ns + 1_500_000, still, still)
    live.on_pose(arrival_ns + 1_000_000, 'world', (1e-6, 0.0, 0.0), upright, arrival_ns)
    live.flush()
    live.coast(arrival_ns + live.coast_limit_ns)


MESSAGE_BLOCK = 2000
"""Messages held as Python objects at a time, to spare the garbage collector."""


@dataclass(frozen=True, eq=False)
class Messages:
    """
    Poses and twists of the tool in the order of their stamps.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
    is_twist : bool ndarray (N,)
    numbers : ndarray (N, 7)
        Position (m) and quaternion (x, y, z, w); of a twist the linear and the angular velocity
        (m/s, rad/s), and a zero.

    """

    stamps_ns: Stamps
    is_twist: Mask
    numbers: Array

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[tuple[int, bool, Vector, Any]]:
        """Yield stamp (ns), whether it is a twist, and its two parts as tuples."""
        for start in range(0, len(self), MESSAGE_BLOCK):
            part = slice(start, start + MESSAGE_BLOCK)
            for stamp_ns, is_twist, (a, b, c, d, e, f, g) in zip(
                self.stamps_ns[part].tolist(), self.is_twist[part].tolist(),
                self.numbers[part].tolist(), strict=True,
            ):
                yield stamp_ns, is_twist, (a, b, c), (d, e, f) if is_twist else (d, e, f, g)


def predicted_trajectory(
    live: LivePredictor, messages: Messages,
    progress: Callable[[str, float], None] = lambda what, part: None,
    measured: Sequence[tuple[Any, ...]] = (), vacuum: Sequence[tuple[int, bool, int]] = (),
) -> Trajectory:
    """
    Return the live predictions for messages in order: B in the world with body twists.

    Measured poses of the package (stamp, position, quaternion, covariance or None), in order, are
    given to it before the first message after their stamp, as are readings of the vacuum (stamp,
    whether it holds, of which cup).

    Raises
    ------
    BellowsError
        If it predicts fewer than two poses.

    """
    stamps, numbers = array('q'), array('d')

    def store(predicted: list[Prediction]) -> None:
        for stamp_ns, position, quaternion_xyzw, linear, angular, *_ in predicted:
            stamps.append(stamp_ns)
            numbers.extend((*position, *quaternion_xyzw, *linear, *angular))

    live.expect_twists(bool(messages.is_twist.any()))
    poses, readings = deque(measured), deque(vacuum)
    for number, (stamp_ns, is_twist, first, second) in enumerate(messages):
        if number % MESSAGE_BLOCK == 0:
            progress('predicting', number / len(messages))
        while poses and poses[0][0] < stamp_ns:
            measured_ns, *pose = poses.popleft()
            live.on_measured(measured_ns, 'world', *pose)
        while readings and readings[0][0] < stamp_ns:
            live.on_vacuum(*readings.popleft()[1:])
        store(live.on_twist(stamp_ns, first, second) if is_twist
              else live.on_pose(stamp_ns, 'world', first, second))
    store(live.flush())
    if len(stamps) < 2:
        raise BellowsError(
            f'The predictor made {len(stamps)} predictions, too few to compare. Check the '
            'recording, and whether the cup can hold the package.')
    return trajectory_of(np.array(stamps), frozen(np.frombuffer(numbers).reshape(-1, 13)))
