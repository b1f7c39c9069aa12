"""
The prediction of a held package, corrected by measured poses in any order.

Measurements come late and out of order. The tool's samples of the last moments are kept, each with
the estimate after it: a measurement goes to its stamp, and all that followed is worked out again,
so that the outcome is that of measurements that came in order.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.equilibrium import resting_on_tool, substeps_for
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.structure import composition, places_of, UPPER
from bellows_ros.core.observer.alarms import Alarm, Alarms, processed
from bellows_ros.core.observer.filter import (
    ALL_ROWS,
    CAMERA,
    COM,
    DAMPING,
    driving,
    Estimate,
    Evidence,
    followed,
    INERTIA,
    is_coarse,
    LATENCY,
    LEAST_ROWS,
    MARKER,
    MASS,
    NO_EVIDENCE,
    NOISE,
    NOT_FOLLOWED,
    propagated,
    pushed,
    STATE,
    STIFFNESS,
    with_theta,
    WRENCH,
    wrench_of,
)
from bellows_ros.core.observer.lost_cup import cups_of, NO_CUPS, NO_LOSSES, without
from bellows_ros.core.observer.measurement import (
    changed_by,
    FIRST_MEMORY,
    Measurement,
    OUT_OF_REACH,
    OUTSIDE,
    PoseSensor,
)
import numpy as np

LATEST_NS = 500_000_000
"""Largest delay (ns) of a measurement, and largest lead over the tool's newest pose."""

GATE = 27.86
"""Squared Mahalanobis distance that 1 in 10,000 good measurements exceeds (chi^2 of 6)."""

WRONG_GATE = 8
"""Consecutive measurements outside the gate after which the filter restarts from them."""

SILENT = 2.5
"""After a pose out of reach the camera is silent if this many of its periods pass."""

KEPT_NS = 100_000_000
"""
Estimates are kept so much longer (ns) than anything can change them: with a camera of 10 Hz and
more no pose of the tool waits for a covariance to be carried along.
"""

LEAST_ROOM = 4096
"""Smallest buffer of tool samples: seconds of them."""

NOTHING_SEEN = Measurement(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), np.zeros((6, 6)))
"""Stands for a measurement where there is none."""

REPEATED_NS = 5_000_000_000
"""What stays wrong raises an alarm so often (ns)."""

START = np.repeat([0.01, 0.1, 0.5, 1.0], 3)
"""Standard deviations at the start: m, rad, m/s, rad/s."""

MASS_SHARE, COM_UNCERTAIN = 0.1, 0.01
"""Default standard deviations of the payload: relative mass, centre of mass (m)."""

UNCALIBRATED = 0.03, 0.05, 0.05
"""Standard deviations of position (m), rotation and latency (s) of a camera to be calibrated."""

BIAS_WALK, WALK_ARM = 0.01, 0.02
"""Random walk of the wrench bias per second: fraction of the weight, and moment by force (m)."""

BIAS_SHARE = 0.1
"""Initial bias, relative to the effect of the default payload uncertainty."""

VERDICTS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'covariance', 'frame_id', 'not_held',
    'late', 'future_stamp', 'duplicate_stamp', 'out_of_reach', 'gate',
)
"""Why a measured pose is refused."""


class Track:
    """The tool's samples of the last moments, the package at each, as the kernels take them."""

    def __init__(self) -> None:
        """Start without samples."""
        self._make(LEAST_ROOM)

    def _make(self, room: int) -> None:
        """Make room for samples."""
        self.count = 0
        stamps, (starts, ends) = np.zeros(room, np.int64), np.zeros((2, room, 13))
        bodies = np.zeros((room, 25))  # with internal strains, if there are any
        self.rows = as_inputs(stamps, starts, ends, bodies)

    def begin(self, stamp_ns: int) -> None:
        """Discard all but the start of a motion."""
        self.rows[0][0], self.count = stamp_ns, 1

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample."""
        return int(self.rows[0][self.count - 1])

    def after(self, stamp_ns: int) -> int:
        """Return the number of the first sample after a stamp."""
        return bisect_right(self.rows[0], stamp_ns, 0, self.count)

    def make_room(self, since_ns: int) -> None:
        """Make room for another sample; discard those before a stamp."""
        if self.count < len(self.rows[0]):
            return
        before, kept = self.rows, slice(self.after(since_ns) - 1, self.count)
        self._make(max(LEAST_ROOM, 4 * (kept.stop - kept.start)))
        self.count = kept.stop - kept.start
        for old, new in zip(before, self.rows, strict=True):
            new[:self.count] = old[kept]


class Payload(NamedTuple):
    """An estimated payload: kg, m in S, kg m^2 at B, and standard deviations."""

    stamp_ns: int
    mass: float
    com: Vector
    inertia: Matrix
    mass_std: float
    com_std: Array


class Calibration(NamedTuple):
    """Errors of a camera, with standard deviations: shift and turn in the world, latency."""

    shift: Array
    """m."""
    shift_std: Array
    turn: Array
    """rad."""
    turn_std: Array
    latency: float
    """s."""
    latency_std: float


class Observer:
    """
    Follow a held package, and correct it.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, payload.*, package.*_std, cup.*_std, tool_noise.*.

    Attributes
    ----------
    counts : dict
        Measurements taken in, those that made it start anew, and those not used, by `VERDICTS`.
    alarms : list of Alarm
        What was found to be wrong so far.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Know of no package."""
        self.sensor = PoseSensor(values)
        self._values = values
        self.counts = dict.fromkeys(('used', 'recovered', *VERDICTS), 0)
        self._track = Track()
        self._known: list[Estimate] = []  # the oldest, and those after each of what was seen
        self._seen: list[Measurement] = []
        self._ahead: list[Measurement] = []
        self._asked: Estimate | None = None  # for, last
        self._lag_ns = 0  # of the newest measurement, when it came
        self._vacuum: tuple[int, bool] | None = None  # when heard, on the tool's clock; it holds
        self.alarms: list[Alarm] = []

    def set_model(self, model: ModelTuple, longest_step: float, reach: float) -> None:
        """Take a nominal model, the longest step (s) of it, and how far (m) a lip can be."""
        self._nominal, self._longest, self._reach = model, longest_step, reach
        self._prior = prior_std(self._values, model)
        weight = model[1][0] * math.hypot(*model[2])
        self._walk = np.square(BIAS_WALK * weight * np.repeat([1.0, WALK_ARM], 3))
        allowed, of_lip = self._values['alarm.false_per_hour'], self.sensor.marker[2]
        places = places_of(self._values)
        self._cups = cups_of(model, places)
        self._alarms = Alarms(
            allowed, len(self._prior), of_lip, places) if allowed > 0.0 else None
        self._steps = self._alarms.steps if self._alarms else NOT_FOLLOWED
        self._known.clear()
        self._opened: tuple[int, ...] = ()
        self._memory = self._first_memory = first_memory(
            self._values['measured.memory'])
        self._kept = np.zeros(len(self._prior) - STATE), np.diag(np.square(self._prior))
        self.forget()

    def forget(self, is_another: bool = True) -> None:
        """Start again, with the same or another package; the camera is the same."""
        if self._known:
            known = self._known[-1]
            theta, P, self._memory = known.theta.copy(), known.covariance.copy(), known.memory
            rows = [row for row in OF_MOTION + is_another * OF_PACKAGE if row < len(P)]
            P[rows], P[:, rows] = 0.0, 0.0
            P[rows, rows] = np.square(self._prior[rows])
            theta[[row - STATE for row in rows if row >= STATE]] = 0.0
            self._kept, self._opened = (theta, P), () if is_another else known.opened
        self._known.clear()
        self._seen.clear()
        self._ahead.clear()
        self._use(self._kept[0], with_theta(self._gripper(self._opened), self._kept[0]))

    def _gripper(self, opened: tuple[int, ...]) -> ModelTuple:
        """Return the nominal model without those cups that are lost."""
        return without(self._nominal, self._cups[list(opened)]) if opened else self._nominal

    def _holding(self, opened: tuple[int, ...]) -> Array:
        """Return the cups, see `cups_of`, that hold; none where the last would be."""
        cups = np.delete(self._cups, list(opened), axis=0) if opened else self._cups
        return cups if len(cups) > 1 else NO_CUPS

    def _use(self, theta: Array, model: ModelTuple) -> None:
        """Go on with the estimated numbers, and the model with them."""
        self._theta, self.model, self._asked = theta, model, None

    @property
    def estimate(self) -> Estimate | None:
        """The estimate at the newest sample of the tool."""
        if not self._known:
            return None
        known, newest_ns = self._asked or self._known[-1], self._track.newest_ns
        if known.stamp_ns < newest_ns:
            known = self._carried(known._replace(evidence=NO_EVIDENCE), newest_ns)
        self._asked = known
        return known

    def covariance(self, stamp_ns: int) -> Array | None:
        """Return the covariance of the state (12, 12) at a stamp of the tool, if available."""
        known = self.estimate
        return None if known is None or known.stamp_ns != stamp_ns else known.covariance[:12, :12]

    @property
    def payload(self) -> Payload | None:
        """The estimated payload, if it is estimated."""
        if not self._known or not self._values['payload.estimate']:
            return None
        known = self._known[-1]
        mass, com, inertia, _ = self.model[1]
        std = np.sqrt(np.diag(known.covariance)[MASS:MASS + 4])
        return Payload(known.stamp_ns, mass, com, inertia, float(std[0] * self._nominal[1][0]),
                       std[1:])

    @property
    def calibration(self) -> Calibration | None:
        """By how much the camera is off, if that is estimated."""
        if not self._known or not self._values['measured.calibrate']:
            return None
        known, rows = self._known[-1], slice(CAMERA, LATENCY + 1)
        found, std = known.theta[CAMERA - STATE:LATENCY + 1 - STATE], np.sqrt(
            np.diag(known.covariance)[rows])
        return Calibration(
            found[:3], std[:3], found[3:6], std[3:6], float(found[6]), float(std[6]))

    # ---------------------------------------------------------------- the tool

    def start(self, stamp_ns: int, tool: State, body: State) -> None:
        """Begin with a package at rest."""
        theta, P = self._kept
        noise = np.repeat([self._values['tool_noise.position'],
                           self._values['tool_noise.rotation']], 3)
        self._drive = driving(self._nominal, tool, body, noise)
        self._track.begin(stamp_ns)
        self._seen.clear()
        self._known = [Estimate(
            stamp_ns, tool, body, theta, P, self._memory, self.model,
            self._evidence(stamp_ns, self._opened), self._opened)]
        self.body = body

    def _evidence(
        self, stamp_ns: int, opened: tuple[int, ...], is_first: bool = True
    ) -> Evidence:
        """Return that of no fault yet."""
        return NO_EVIDENCE if self._alarms is None else self._alarms.start(
            stamp_ns, len(self._holding(opened)), is_first)

    def follow(self, stamp_ns: int, start: State, end: State) -> State:
        """Carry the package along with the tool, from the newest sample to this one."""
        track = self._track
        track.make_room(self._known[0].stamp_ns)
        self.body = followed(
            self.model, self._theta, self.body, *track.rows, track.count, stamp_ns, start, end,
            self._longest)
        track.count += 1
        while self._ahead and self._ahead[0].stamp_ns <= stamp_ns:
            self._seen.append(self._ahead.pop(0))
            self._reprocess(len(self._seen) - 1)
        if stamp_ns - self._known[0].stamp_ns > LATEST_NS + KEPT_NS:
            self._drop_old(stamp_ns - LATEST_NS)
        if self._known[-1].away == 1:
            self._look_for_silence(stamp_ns)
        return self.body

    def _look_for_silence(self, stamp_ns: int) -> None:
        """Raise an alarm if a camera sees nothing after a package has left its reach."""
        seen, known = self._seen, self._known[-1]
        if len(seen) < 2 or self._alarms is None:
            return
        last_ns = seen[-1].stamp_ns
        usual_ns = last_ns - seen[-2].stamp_ns
        if stamp_ns - last_ns > SILENT * usual_ns + self._lag_ns:
            self._known[-1] = known._replace(away=2)
            if not (is_held := self._is_held_since(last_ns)):  # else one wrong pose, then none
                self._raise(self._alarms.lost(stamp_ns, is_held))

    def hear_vacuum(self, is_held: bool, breaks: bool, moves: bool) -> None:
        """
        Join what is measured with the vacuum of the cup.

        Where it breaks down the package is lost, unless the tool is at rest, as for a release, and
        no pose is out of reach.
        """
        self._vacuum = self._track.newest_ns, is_held
        if breaks and self._known and self._alarms:
            is_seen = self._known[-1].away > 0
            if moves or is_seen:
                self._raise(self._alarms.lost(self._track.newest_ns, False, is_seen))

    def _is_held_since(self, stamp_ns: int) -> bool | None:
        """Return whether the vacuum holds at a stamp or later; None if it was not heard since."""
        return self._vacuum[1] if self._vacuum and self._vacuum[0] >= stamp_ns else None

    def _drop_old(self, before_ns: int) -> None:
        """Discard estimates that nothing can change any more, except the last of them."""
        known, seen = self._known, self._seen
        while seen and seen[0].stamp_ns <= before_ns:
            del known[0], seen[0]
        if known[0].stamp_ns >= before_ns - KEPT_NS:
            return
        stamps, k = self._track.rows[0], self._track.after(before_ns) - 1
        while stamps[k] > known[0].stamp_ns:
            if is_coarse(stamps[k], stamps[k + 1], self._longest):  # it would end there anyhow
                known[0] = self._carried(known[0], int(stamps[k]))
                break
            k -= 1

    def drifted(self, body: State, start: State, end: State, seconds: float) -> State:
        """Return a package after a motion of the tool that is not kept."""
        return pushed(
            self.model, wrench_of(self._theta), body, start, end, seconds,
            substeps_for(seconds, self._longest))

    def _processed(
        self, known: Estimate, stamp_ns: int, is_known: bool, seen: Measurement | None = None,
        gate: float = 0.0,
    ) -> tuple[Estimate, tuple[float, float, tuple[int, ...], int], int]:
        """
        Return an estimate carried along with the tool, and corrected with what is seen there.

        Where the package has been before, is_known is set. And what `processed` says of faults,
        and its verdict.
        """
        before, others = known.evidence, (known.refused, known.away)
        opened = known.opened
        verdict, tool, body, theta, P, memory, E, numbers, onsets, outcome, model = processed(
            self._gripper(opened), known.theta, known.tool, known.body, known.covariance,
            known.memory, *self._track.rows, is_known, self._track.after(known.stamp_ns),
            known.stamp_ns, stamp_ns, self._longest, self._drive, self._walk, *before[:3],
            before.is_first, self._steps, self._holding(opened), seen is not None,
            *(seen or NOTHING_SEEN)[1:], self.sensor.marker, self._reach, gate)
        if seen is not None:
            others = (known.refused + 1, known.away) if verdict else (0, 0)
        after = Evidence(E, numbers, onsets, before.half_way, before.is_first)
        return Estimate(
            stamp_ns, tool, body, theta, P, memory, model, after, opened, *others
        ), outcome, verdict

    def _carried(self, known: Estimate, stamp_ns: int) -> Estimate:
        """Return an estimate carried along with the tool, where the package has been before."""
        return self._processed(known, stamp_ns, True)[0]._replace(model=known.model)

    # ------------------------------------------------------------ measurements

    def see(self, seen: Measurement) -> str:
        """Process a measured pose; return why it is refused, or ''."""
        verdict = self._place(seen)
        if verdict:
            self.counts[verdict] += 1
        return verdict

    def _place(self, seen: Measurement) -> str:
        """Put a measured pose where it belongs, or say why it belongs nowhere."""
        stamp_ns = seen.stamp_ns
        if not self._known:
            return 'not_held'
        newest_ns = self._track.newest_ns
        if stamp_ns > newest_ns + LATEST_NS:
            return 'future_stamp'
        others = self._ahead if stamp_ns > newest_ns else self._seen
        at = bisect_left(others, seen[:1])
        if at < len(others) and others[at].stamp_ns == stamp_ns:
            return 'duplicate_stamp'
        if stamp_ns <= self._known[0].stamp_ns:
            return 'late'
        others.insert(at, seen)
        if others is self._seen:
            self._lag_ns = max(newest_ns - stamp_ns, self._lag_ns // 2)
            self._reprocess(at)
        return ''

    def _reprocess(self, at: int) -> None:
        """Update with a measured pose, and again with all that followed."""
        del self._known[at + 1:]
        while self.alarms and self.alarms[-1].stamp_ns >= self._seen[at].stamp_ns and (
                at < len(self._seen) - 1):
            self.alarms.pop()
        for k in range(at, len(self._seen)):
            self._known.append(self._updated(self._known[k], self._seen[k], k == at))
        known, newest_ns = self._known[-1], self._track.newest_ns
        self._use(known.theta, known.model)
        self.body = known.body
        if known.stamp_ns < newest_ns:
            self.body = propagated(
                self._gripper(known.opened), known.theta, known.tool, known.body, NOT_FOLLOWED,
                NOT_FOLLOWED, *self._track.rows, False, self._track.after(known.stamp_ns),
                known.stamp_ns, newest_ns, self._longest, self._drive, NO_CUPS, NO_LOSSES)[1]

    def _updated(self, before: Estimate, seen: Measurement, is_new: bool) -> Estimate:
        """Return the estimate after a measurement: the one before it where that is no package."""
        stamp_ns = seen.stamp_ns
        after, outcome, verdict = self._processed(before, stamp_ns, is_new, seen, GATE)
        name = ('used', 'gate', 'out_of_reach')[verdict]
        if verdict == OUTSIDE and after.refused >= WRONG_GATE:
            name = 'recovered'
        if is_new:
            self.counts[name] += 1
        if verdict == OUT_OF_REACH:
            return self._away(before, stamp_ns)
        if self._alarms is not None:
            evidence, fault = self._alarms.step(
                after.evidence, stamp_ns, outcome, after.opened)
            after = after._replace(evidence=evidence)
            if fault is not None:
                self._raise(fault.alarm)
                opened = after.opened + ((fault.cup,) if fault.cup >= 0 else ())
                body, theta = changed_by(after.body, after.theta, fault.error)
                return after._replace(  # the fault was taken for noise, too
                    body=body, theta=theta, memory=self._first_memory, refused=0, opened=opened,
                    model=with_theta(self._gripper(opened), theta),
                    evidence=self._evidence(stamp_ns, opened, False),
                    covariance=after.covariance + fault.spread @ fault.spread.T)
        if name == 'recovered':
            P, rows = after.covariance.copy(), np.r_[:STATE, WRENCH:WRENCH + 6]
            P[rows, rows] += np.square(self._prior[rows])  # as uncertain as at the start
            restarted = after._replace(
                covariance=P, memory=before.memory, evidence=NO_EVIDENCE)
            return self._processed(restarted, stamp_ns, True, seen, math.inf)[0]._replace(
                memory=before.memory, evidence=self._evidence(stamp_ns, after.opened, False))
        return after

    def _away(self, known: Estimate, stamp_ns: int) -> Estimate:
        """Count a pose out of reach; a package that was within reach is lost after two."""
        if known.away == 1 and self._alarms is not None:
            first_ns = self._seen[bisect_left(self._seen, (stamp_ns,)) - 1].stamp_ns
            self._raise(self._alarms.lost(
                stamp_ns, self._is_held_since(first_ns), reach=self._reach))
        return known._replace(away=known.away + 1 if known.away or self._is_near(known) else 0)

    def _is_near(self, known: Estimate) -> bool:
        """Return whether the package has been seen within reach."""
        return bool(known.memory[1] > FIRST_MEMORY[1])

    def _raise(self, alarm: Alarm) -> None:
        """Keep an alarm, unless the same one has just been raised."""
        before = next((a for a in reversed(self.alarms) if a.cause == alarm.cause), None)
        if before is None or alarm.stamp_ns - before.stamp_ns >= REPEATED_NS:
            self.alarms.append(alarm)


OF_MOTION = (*range(STATE), *range(WRENCH, STIFFNESS), *range(NOISE, NOISE + 6))
"""Rows that are forgotten at a fresh start with the same package, ..."""

OF_PACKAGE = (*range(MASS, COM + 3), *range(MARKER, MARKER + 6), *range(INERTIA, ALL_ROWS))
"""... and with another one, too."""


def first_memory(time_constant: float) -> Array:
    """Return the memory (s) of the noise before the first measurement, see `correlations`."""
    seconds, squares = FIRST_MEMORY
    products = squares * math.exp(-seconds / time_constant)
    memory: Array = np.r_[seconds, squares, squares, products, products, np.zeros(6)]
    return memory


def prior_std(values: Mapping[str, Any], model: ModelTuple) -> Array:
    """Return the standard deviations (n,) of the error at the start."""
    (_, _, *blocks), (mass, *_), gravity = (model[0][:4], *model[1:])
    weight = mass * math.hypot(*gravity)
    C = np.square(composition(places_of(values))[UPPER[0] == UPPER[1]])
    K, P = (
        np.minimum(np.sqrt(C @ np.square(np.reshape(values[f'cup.{name}_std'], (6, 6))[UPPER]))
                   / np.maximum(np.r_[matrix[0][::4], matrix[2][::4]], 1e-12), 1.0)
        for name, matrix in zip(('stiffness', 'damping'), blocks, strict=True))
    inertia = np.array(values['package.inertia_std'][:3])
    std: Array = np.zeros(ALL_ROWS if P.any() or inertia.any() else LEAST_ROWS)
    std[:STATE] = START
    mass, com = values['package.mass_std'] / mass, values['package.com_std']
    if values['payload.estimate']:
        mass, com = mass or MASS_SHARE, [each or COM_UNCERTAIN for each in com]
    std[MASS], std[COM:COM + 3] = mass, com
    std[WRENCH:WRENCH + 6] = BIAS_SHARE * weight * np.repeat([MASS_SHARE, COM_UNCERTAIN], 3)
    std[STIFFNESS:STIFFNESS + 6] = K
    offset, latency = values['measured.offset_std'], values['measured.latency_std']
    std[MARKER:MARKER + 6] = np.repeat(offset, 3)
    if values['measured.calibrate']:
        offset, latency = np.maximum(offset, UNCALIBRATED[:2]), max(latency, UNCALIBRATED[2])
    std[CAMERA:CAMERA + 6], std[LATENCY] = np.repeat(offset, 3), latency
    std[NOISE:NOISE + 6] = 1.0
    if len(std) > LEAST_ROWS:
        std[DAMPING:INERTIA], std[INERTIA:] = P, inertia
    return std


def warm_up_observer(values: Mapping[str, Any], model: ModelTuple) -> None:
    """Compile all that an observer needs, with a model."""
    made = Observer(values)
    made.set_model(model, math.inf, math.inf)
    tool = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    made.start(1, tool, resting_on_tool(model, tool))
    made.see(Measurement(500_000, *made.body[:2], np.eye(6)))
    made.drifted(made.follow(1_000_000, tool, tool), tool, tool, 1e-3)
