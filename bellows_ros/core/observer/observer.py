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
from bellows_ros.core.observer.alarms import Alarm, Alarms
from bellows_ros.core.observer.filter import (
    driving,
    Estimate,
    followed,
    is_coarse,
    NOT_FOLLOWED,
    pushed,
    swept,
    UNPASSED,
    with_payload,
    wrench_of,
)
from bellows_ros.core.observer.measurement import (
    Innovation,
    Measurement,
    OUT_OF_REACH,
    OUTSIDE,
    Sight,
    taken,
)
import numpy as np

LATEST_NS = 500_000_000
"""Largest delay (ns) of a measurement, and largest lead over the tool's newest pose."""

GATE = 27.86
"""Squared Mahalanobis distance that 1 in 10,000 good measurements exceeds (chi^2 of 6)."""

WRONG_GATE = 8
"""Consecutive measurements outside the gate after which the filter restarts from them."""

KEPT_NS = 100_000_000
"""
Estimates are kept so much longer (ns) than anything can change them: with a camera of 10 Hz and
more no pose of the tool waits for a covariance to be carried along.
"""

LEAST_ROOM = 4096
"""Smallest buffer of tool samples: seconds of them."""

REPEATED_NS = 5_000_000_000
"""What stays wrong raises an alarm so often (ns)."""

START = np.repeat([0.01, 0.1, 0.5, 1.0], 3)
"""Standard deviations at the start: m, rad, m/s, rad/s."""

MASS_SHARE, COM_UNCERTAIN = 0.1, 0.01
"""Default standard deviations of the payload: relative mass, centre of mass (m)."""

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


class Observer:
    """
    Follow a held package, and correct it.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, payload.*, package.*_std, tool_noise.*.

    Attributes
    ----------
    counts : dict
        Measurements taken in, those that made it start anew, and those not used, by `VERDICTS`.
    alarms : list of Alarm
        What was found to be wrong so far.

    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        """Know of no package."""
        self.sight = Sight(values)
        self._values = values
        self.counts = dict.fromkeys(('used', 'recovered', *VERDICTS), 0)
        self._track = Track()
        self._known: list[Estimate] = []  # the oldest, and those after each of what was seen
        self._seen: list[Measurement] = []
        self._ahead: list[Measurement] = []
        self._asked: Estimate | None = None  # for, last
        self._kept = np.zeros(10), np.zeros((4, 4))  # payload of the same package
        self._opened_ns: set[int] = set()  # stamps of measurements at which an alarm was raised
        allowed = values['alarm.false_per_hour']
        self._alarms = Alarms(allowed) if allowed > 0.0 else None
        self._unpassed = UNPASSED if allowed > 0.0 else NOT_FOLLOWED
        self.alarms: list[Alarm] = []
        self._away, self._were_near = 0, False

    def set_model(self, model: ModelTuple, longest_step: float, reach: float) -> None:
        """Take a nominal model, the longest step (s) of it, and how far (m) a lip can be."""
        self._nominal, self._longest, self._reach = model, longest_step, reach
        weight = model[1][0] * math.hypot(*model[2])
        bias = BIAS_SHARE * weight * np.repeat([MASS_SHARE, COM_UNCERTAIN], 3)
        self._prior = np.concatenate([START, self._payload_std(), bias])
        walk = BIAS_WALK * weight * np.repeat([1.0, WALK_ARM], 3)
        self._walk = np.concatenate([np.zeros(16), np.square(walk)])
        self.forget()

    def _payload_std(self) -> Array:
        """Return the standard deviations (4,) of mass, relative, and centre of mass (m)."""
        values = self._values
        if not values['payload.estimate']:
            return np.zeros(4)
        mass = values['package.mass_std'] / values['package.mass'] or MASS_SHARE
        return np.array([mass, *(std or COM_UNCERTAIN for std in values['package.com_std'])])

    def forget(self, is_another: bool = True) -> None:
        """Start again, with the same or another package."""
        if is_another:
            self._kept = np.zeros(10), np.diag(np.square(self._prior[12:16]))
        elif self._known:
            known = self._known[-1]
            self._kept = np.r_[known.theta[:4], np.zeros(6)], known.covariance[12:16, 12:16]
        self._known.clear()
        self._seen.clear()
        self._ahead.clear()
        self._opened_ns.clear()
        self._away, self._were_near = 0, False
        self._use(self._kept[0])
        if self._alarms is not None:
            self._alarms.forget()

    def _use(self, theta: Array) -> None:
        """Put the estimated payload into the model."""
        self._theta, self._asked = theta, None
        self.model = self._with(theta)

    def _with(self, theta: Array) -> ModelTuple:
        """Return the model with the estimated payload."""
        return with_payload(self._nominal, theta) if self._values['payload.estimate'] else (
            self._nominal)

    @property
    def estimate(self) -> Estimate | None:
        """The estimate at the newest sample of the tool."""
        if not self._known:
            return None
        known, newest_ns = self._asked or self._known[-1], self._track.newest_ns
        if known.stamp_ns < newest_ns:
            known = self._carried(known, newest_ns, True)
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
        std = np.sqrt(np.diag(known.covariance)[12:16])
        return Payload(known.stamp_ns, mass, com, inertia, float(std[0] * self._nominal[1][0]),
                       std[1:])

    # ---------------------------------------------------------------- the tool

    def start(self, stamp_ns: int, tool: State, body: State) -> None:
        """Begin with a package at rest."""
        P = np.diag(np.square(self._prior))
        theta, P[12:16, 12:16] = self._kept
        noise = np.repeat([self._values['tool_noise.position'],
                           self._values['tool_noise.rotation']], 3)
        self._driven = driving(self._nominal, tool, body, noise, self._walk)
        self._track.begin(stamp_ns)
        self._seen.clear()
        self._known = [Estimate(stamp_ns, tool, body, theta, P, 0, self._unpassed)]
        self._use(theta)
        self.body = body

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
            self._work_out(len(self._seen) - 1)
        if stamp_ns - self._known[0].stamp_ns > LATEST_NS + KEPT_NS:
            self._let_go(stamp_ns - LATEST_NS)
        return self.body

    def _let_go(self, before_ns: int) -> None:
        """Discard estimates that nothing can change any more, except the last of them."""
        known, seen = self._known, self._seen
        while seen and seen[0].stamp_ns <= before_ns:
            del known[0], seen[0]
        if known[0].stamp_ns >= before_ns - KEPT_NS:
            return
        stamps, k = self._track.rows[0], self._track.after(before_ns) - 1
        while stamps[k] > known[0].stamp_ns:
            if is_coarse(stamps[k], stamps[k + 1], self._longest):  # it would end there anyhow
                known[0] = self._carried(known[0], int(stamps[k]), True)
                break
            k -= 1

    def drifted(self, body: State, start: State, end: State, seconds: float) -> State:
        """Return a package after a motion of the tool that is not kept."""
        return pushed(
            self.model, wrench_of(self._theta), body, start, end, seconds,
            substeps_for(seconds, self._longest))

    def _carried(self, known: Estimate, stamp_ns: int, is_known: bool) -> Estimate:
        """Return an estimate carried along with the tool, where the package has been before."""
        P, passage = known.covariance.copy(), known.passage.copy()
        tool, body = self._swept(
            self._with(known.theta), known, stamp_ns, is_known, P, passage)
        return Estimate(stamp_ns, tool, body, known.theta, P, known.refused, passage)

    def _swept(
        self, model: ModelTuple, known: Estimate, stamp_ns: int, is_known: bool = False,
        P: Array = NOT_FOLLOWED, passage: Array = NOT_FOLLOWED,
    ) -> tuple[State, State]:
        """Return tool and package at a stamp; carry covariance and passage there in place."""
        return swept(
            model, known.theta, known.tool, known.body, P, passage, *self._track.rows, is_known,
            self._track.after(known.stamp_ns), known.stamp_ns, stamp_ns, self._longest,
            self._driven)

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
            self._work_out(at)
        return ''

    def _work_out(self, at: int) -> None:
        """Take a measured pose in, and all that followed again."""
        del self._known[at + 1:]
        for k in range(at, len(self._seen)):
            known = self._carried(self._known[k], self._seen[k].stamp_ns, k == at)
            self._known.append(self._taken(known, self._seen[k], k == at))
        known, newest_ns = self._known[-1], self._track.newest_ns
        self._use(known.theta)
        self.body = known.body
        if known.stamp_ns < newest_ns:
            self.body = self._swept(self.model, known, newest_ns)[1]

    def _taken(self, estimate: Estimate, seen: Measurement, is_new: bool) -> Estimate:
        """Correct an estimate, or leave it where the measurement is outside the gate."""
        verdict, found, body, theta, P = self._compared(estimate, seen, GATE)
        name = ('used', 'gate', 'out_of_reach')[verdict]
        if verdict == OUTSIDE and estimate.refused + 1 >= WRONG_GATE:
            name = 'recovered'
        if is_new:
            self.counts[name] += 1
            self._look_for_causes(seen.stamp_ns, estimate, found, name)
        if verdict == OUT_OF_REACH:
            return estimate
        if name == 'recovered' or seen.stamp_ns in self._opened_ns:
            _, _, body, theta, P = self._compared(self._opened(estimate), seen, math.inf)
        elif verdict == OUTSIDE:
            return estimate._replace(passage=self._unpassed, refused=estimate.refused + 1)
        return Estimate(seen.stamp_ns, estimate.tool, body, theta, P, 0, self._unpassed)

    def _compared(self, estimate: Estimate, seen: Measurement, gate: float) -> Any:
        """Return what `taken` does."""
        return taken(
            *estimate[1:5], *seen[1:], self.sight.marker, self.sight.H, self._nominal[1][1],
            self._nominal[0][1], self._reach, gate)

    def _look_for_causes(
        self, stamp_ns: int, estimate: Estimate, found: Any, verdict: str
    ) -> None:
        """Raise an alarm for a fault, and widen the states that it affects."""
        alarms, alarm = self._alarms, None
        if alarms is None:
            return
        if verdict == 'out_of_reach':
            self._away += 1
            if self._away == WRONG_GATE and self._were_near:
                alarm = alarms.lost(stamp_ns)
        elif stamp_ns > alarms.last_ns:
            self._away, self._were_near = 0, self._were_near or verdict == 'used'
            alarm = alarms.step(
                stamp_ns, estimate.passage, Innovation(*found), verdict == 'used')
            if verdict == 'recovered':
                alarms.forget(alarms.named)
        if alarm is not None:
            before = self.alarms[-1] if self.alarms else None
            if before is None or before.cause != alarm.cause or (
                    stamp_ns - before.stamp_ns >= REPEATED_NS):
                self.alarms.append(alarm)
            if alarm.cause not in ('camera', 'lost'):
                self._opened_ns.add(stamp_ns)

    def _opened(self, estimate: Estimate) -> Estimate:
        """Return an estimate as uncertain as at the start, except for the payload."""
        P = estimate.covariance + np.diag(
            np.square(self._prior) * ([1.0] * 12 + [0.0] * 4 + [1.0] * 6))
        return estimate._replace(covariance=P)


def warm_up_observer(values: Mapping[str, Any], model: ModelTuple) -> None:
    """Compile all that an observer needs, with a model."""
    made = Observer(values)
    made.set_model(model, math.inf, math.inf)
    tool = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    made.start(1, tool, resting_on_tool(model, tool))
    made.see(Measurement(500_000, *made.body[:2], np.eye(6)))
    made.drifted(made.follow(1_000_000, tool, tool), tool, tool, 1e-3)
    with_payload(model, np.zeros(10))  # if the payload is estimated later
