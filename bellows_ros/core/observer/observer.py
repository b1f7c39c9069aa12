"""
The prediction of a held package, corrected by measured poses in any order.

Measurements come late and out of order. The tool's samples of the last moments are kept, each with
the estimate after it: a measurement goes to its stamp, and all that followed is worked out again,
so that the outcome is that of measurements that came in order.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model.equilibrium import resting_on_tool, substeps_for
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Wrench
from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.correction import (
    Correction,
    OF_MOTION,
    OF_PACKAGE,
    Outcome,
    Track,
)
from bellows_ros.core.observer.filter import (
    advanced_with_wrench,
    CAMERA,
    Estimate,
    followed,
    is_coarse,
    LATENCY,
    MASS,
    model_with,
    STATE,
    wrench_of,
)
from bellows_ros.core.observer.measurement import changed_by, Measurement, PoseSensor
import numpy as np

LATEST_NS = 500_000_000
"""Largest delay (ns) of a measurement, and largest lead over the tool's newest pose."""

AWAY_NS = 25_000_000
"""A package out of reach for so long (ns) is lost: trackers confuse bodies for some frames."""

SILENT, SILENT_NS = 2.5, 50_000_000
"""After a pose out of reach the camera is silent if this many of its periods pass, and this time
(ns)."""

KEPT_NS = 100_000_000
"""
Estimates are kept so much longer (ns) than anything can change them: with a camera of 10 Hz and
more no pose of the tool waits for a covariance to be carried along.
"""

REPEATED_NS = 5_000_000_000
"""What stays wrong raises an alarm so often (ns)."""

VERDICTS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'covariance', 'frame_id', 'not_held',
    'late', 'future_stamp', 'duplicate_stamp', 'out_of_reach', 'gate',
)
"""Why a measured pose is refused."""


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
        self._vacuum: tuple[int, bool] | None = None  # when, on the tool's clock, and if it holds
        self.alarms: list[Alarm] = []

    def set_model(self, model: ModelTuple, longest_step: float, reach: float) -> None:
        """Take a nominal model, the longest step (s) of it, and how far (m) a lip can be."""
        self._by = Correction(self._values, self.sensor, model, longest_step, reach)
        self._known.clear()
        self._opened: tuple[int, ...] = ()
        prior = self._by.prior
        self._initial = np.zeros(len(prior) - STATE), np.diag(prior**2), self._by.first_memory
        self.forget()

    def forget(self, is_another: bool = True) -> None:
        """Start again, with the same or another package; the camera is the same."""
        if self._known:
            known = self._known[-1]
            theta, P = known.theta.copy(), known.covariance.copy()
            rows = [row for row in OF_MOTION + is_another * OF_PACKAGE if row < len(P)]
            P[rows], P[:, rows] = 0.0, 0.0
            P[rows, rows] = np.square(self._by.prior[rows])
            theta[[row - STATE for row in rows if row >= STATE]] = 0.0
            self._initial, self._opened = (
                theta, P, known.memory), () if is_another else known.opened
        for what in (self._known, self._seen, self._ahead):
            what.clear()
        self._asked = None
        self._use(self._initial[0], self._opened)

    def _use(self, theta: Array, opened: tuple[int, ...]) -> None:
        """Predict with numbers as they are estimated, without those cups that are lost."""
        self._theta, self._row = theta, self._by.row(opened)
        self._model: ModelTuple | None = None

    @property
    def model(self) -> ModelTuple:
        """The model with the numbers as they were estimated last."""
        if self._model is None:
            self._model = model_with(self._row, self._by.branches, self._theta)
        return self._model

    @property
    def estimate(self) -> Estimate | None:
        """The estimate at the newest sample of the tool."""
        if not self._known:
            return None
        known, newest_ns = self._asked or self._known[-1], self._track.newest_ns
        if known.stamp_ns < newest_ns:
            known = self._by.carried(known, self._track, newest_ns, False)
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
        return Payload(known.stamp_ns, mass, com, inertia,
                       float(std[0] * mass), std[1:])

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
        self._track.begin(stamp_ns)
        self._seen.clear()
        self._known = [self._by.start(stamp_ns, tool, body, self._initial, self._opened)]
        self.body = body

    def follow(
        self, stamp_ns: int, start: State, end: State
    ) -> tuple[State, Wrench, bool] | None:
        """
        Carry the package along with the tool, from the newest sample to this one.

        Returns it with the wrench and the verdict of `checked_wrench`, or None where a measured
        pose of that time has been waiting: it is corrected by then.
        """
        track, by = self._track, self._by
        track.make_room(self._known[0].stamp_ns)
        found: tuple[State, Wrench, bool] | None = followed(
            self._row, by.branches, self._theta, self.body, *track.rows, track.count, stamp_ns,
            start, end, by.longest, by.reach)
        assert found is not None
        self.body = found[0]
        track.count, track.newest_ns = track.count + 1, stamp_ns
        while self._ahead and self._ahead[0].stamp_ns <= stamp_ns:
            found = None
            self._seen.append(self._ahead.pop(0))
            self._reprocess(len(self._seen) - 1)
        if stamp_ns - self._known[0].stamp_ns > LATEST_NS + KEPT_NS:
            self._drop_old(stamp_ns - LATEST_NS)
        if self._known[-1].away_ns > 0:
            self._look_for_silence(stamp_ns)
        return found

    def _drop_old(self, before_ns: int) -> None:
        """Discard estimates that nothing can change any more, except the last of them."""
        known, seen = self._known, self._seen
        while seen and seen[0].stamp_ns <= before_ns:
            del known[0], seen[0]
        if known[0].stamp_ns >= before_ns - KEPT_NS:
            return
        stamps, k = self._track.rows[0], self._track.after(before_ns) - 1
        while stamps[k] > known[0].stamp_ns:
            if is_coarse(stamps[k], stamps[k + 1], self._by.longest):  # it would end there anyhow
                known[0] = self._by.carried(known[0], self._track, int(stamps[k]))
                break
            k -= 1

    def drifted(self, body: State, start: State, end: State, seconds: float) -> State:
        """Return a package after a motion of the tool that is not kept."""
        return advanced_with_wrench(
            self.model, wrench_of(self._theta), body, start, end, seconds,
            substeps_for(seconds, self._by.longest))

    # ------------------------------------------------------------ measurements

    def see(self, seen: Measurement) -> str:
        """Process a measured pose; return why it is refused, or ''."""
        stamp_ns, verdict = seen.stamp_ns, ''
        newest_ns = self._track.newest_ns if self._known else 0
        others = self._ahead if stamp_ns > newest_ns else self._seen
        at = bisect_left(others, (stamp_ns,))
        if not self._known:
            verdict = 'not_held'
        elif stamp_ns > newest_ns + LATEST_NS:
            verdict = 'future_stamp'
        elif at < len(others) and others[at].stamp_ns == stamp_ns:
            verdict = 'duplicate_stamp'
        elif stamp_ns <= self._known[0].stamp_ns:
            verdict = 'late'
        if verdict:
            self.counts[verdict] += 1
            return verdict
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
            outcome = self._updated(self._known[k], self._seen[k], k == at)
            if k == at:
                self.counts[outcome.verdict] += 1
            self._raise(outcome.alarm)
            self._known.append(self._away(outcome.known, self._seen[k].stamp_ns) if (
                outcome.verdict == 'out_of_reach') else outcome.known)
        known = self._known[-1]
        self._asked = None
        self._use(known.theta, known.opened)
        self.body = self._by.body_at_end(known, self._track)

    def _updated(self, before: Estimate, seen: Measurement, is_new: bool) -> Outcome:
        """Return the estimate after a measurement, new or worked out again."""
        return self._by.updated(before, self._track, seen, is_new)

    # ------------------------------------------------------- a package that is lost

    def _away(self, known: Estimate, stamp_ns: int) -> Estimate:
        """Note a pose out of reach; a package that was within reach is lost after some time."""
        if known.away_ns == 0:
            was_near = (known.memory != self._by.first_memory).any()
            return known._replace(away_ns=stamp_ns) if was_near else known
        if known.away_ns < 0 or stamp_ns - known.away_ns < AWAY_NS:
            return known
        if self._by.alarms is not None:
            self._raise(self._by.alarms.lost(
                stamp_ns, self._is_held_since(known.away_ns), reach=self._by.reach))
        return known._replace(away_ns=-1)

    def _look_for_silence(self, stamp_ns: int) -> None:
        """Raise an alarm if a camera sees nothing after a package has left its reach."""
        seen, known = self._seen, self._known[-1]
        if len(seen) < 2 or self._by.alarms is None:
            return
        last_ns = seen[-1].stamp_ns
        usual_ns = last_ns - seen[-2].stamp_ns
        if stamp_ns - last_ns > max(SILENT * usual_ns, SILENT_NS) + self._lag_ns:
            self._known[-1] = known._replace(away_ns=-1)
            if not (is_held := self._is_held_since(last_ns)):  # else one wrong pose, then none
                self._raise(self._by.alarms.lost(stamp_ns, is_held))

    def on_vacuum(self, is_held: bool, breaks: bool, moves: bool, cup: int = -1) -> None:
        """
        Join what is measured with the vacuum of the cup.

        Where it breaks down the package is lost, unless the tool is at rest, as for a release, and
        no pose is out of reach. That of one cup of a gripper says that this cup is lost.
        """
        if cup >= 0:
            if breaks and moves and self._known and self._by.alarms:
                self._raise(self._by.alarms.without_vacuum(self._track.newest_ns, cup))
            return
        self._vacuum = self._track.newest_ns, is_held
        if breaks and self._known and self._by.alarms:
            is_seen = self._known[-1].away_ns != 0
            if moves or is_seen:
                self._raise(self._by.alarms.lost(self._track.newest_ns, False, is_seen))

    def _is_held_since(self, stamp_ns: int) -> bool | None:
        """Return whether the vacuum holds at a stamp or later; None if not measured since."""
        return self._vacuum[1] if self._vacuum and self._vacuum[0] >= stamp_ns else None

    def _raise(self, alarm: Alarm | None) -> None:
        """Keep an alarm if there is one, unless the same has just been raised."""
        if alarm is None:
            return
        before = next((a for a in reversed(self.alarms) if a.cause == alarm.cause), None)
        if before is None or alarm.stamp_ns - before.stamp_ns >= REPEATED_NS:
            self.alarms.append(alarm)


def warm_up_observer(values: Mapping[str, Any], model: ModelTuple) -> None:
    """Compile all that an observer needs, with a model."""
    made = Observer(values)
    made.set_model(model, math.inf, math.inf)
    made.start(1, ORIGIN, resting_on_tool(model, ORIGIN))
    made.see(Measurement(500_000, *made.body[:2], np.eye(6)))
    made.follow(1_000_000, ORIGIN, ORIGIN)
    made.drifted(made.body, ORIGIN, ORIGIN, 1e-3)
    estimate = made._known[-1]
    changed_by(made.body, estimate.theta, np.zeros(len(estimate.covariance)))
