"""
The prediction of a held package, corrected by measured poses in any order.

Measurements arrive late and out of order. Recent samples of the tool are stored, with the estimate
after each measurement. A measurement is applied at its stamp, and all later measurements are
applied again, so the result is independent of the order of arrival.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable
from itertools import pairwise
import math

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.model.equilibrium import resting_on_tool, sag, substeps_for
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Wrench
from bellows_ros.core.model.simulation import body_row, row_state
from bellows_ros.core.observer import alarms, dynamics
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.alarms import Alarm, DIFFERS, LOST
from bellows_ros.core.observer.correction import Correction, ON_SUPPORT
from bellows_ros.core.observer.dynamics import MAX_SUBSTEPS
from bellows_ros.core.observer.measurement import OUTLIER_DISTANCE
from bellows_ros.core.observer.pose_sensor import Measurement, NO_MEASUREMENT, PoseSensor
from bellows_ros.core.observer.results import Estimate, Payload, payload_of
from bellows_ros.core.observer.states import (
    ANOTHER_PACKAGE,
    CAMERA_ROWS,
    CUP_ROWS,
    KNOWN_ROWS,
    STATE,
)
from bellows_ros.core.observer.support import Support
from bellows_ros.core.observer.wrenches import MIN_COUNT, WrenchFilter
from bellows_ros.core.parameters.conversion import places_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.sensors.wrench import BLOCK_NS, WrenchSensor
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

MAX_DELAY_NS = 500_000_000
"""Largest delay of a measurement, and its largest lead over the tool's newest pose, ns."""

HISTORY_NS = 100_000_000
"""
Additional time for which estimates are stored, ns, so that poses of the tool do not wait for the
propagation of a covariance (with a camera of at least 10 Hz).
"""

SWING_NS = 200_000_000
"""Time after a start in which poses may contradict its swing, ns: the start is stored longer."""

SILENT_PERIODS = 2.5
"""Number of periods after which a sensor is silent; the period of a camera is the shorter of the
last two."""

SILENT_NS = 50_000_000
"""Shortest time after which a sensor is silent, ns."""

VACUUM_DELAY_NS = 100_000_000
"""Largest delay of the vacuum's break and its message after a package is out of reach, ns."""

REPEATED_NS = 5_000_000_000
"""Interval of repeated alarms of a persisting fault, ns."""

ONSET_NS = 35_000_000
"""Time before the first pose in which a fall may begin, the period of a usual camera, ns."""

MAX_ONSETS = 30
"""Largest number of tested begins of a fall: 11 ms, by which the position errs by 16 mm after
0.3 s, at most a third of the squared noise of a usual camera at the first two poses."""

VERDICTS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'millimetres', 'covariance', 'repeated',
    'frame_id', 'not_held', 'late', 'future_stamp', 'duplicate_stamp', 'out_of_reach', 'outlier',
)
"""Reasons for rejecting a measured pose."""


class Observer:
    """
    Predict a held package, corrected by measured poses.

    Parameters
    ----------
    values : mapping
        Parameters by name: measured.*, payload.*, package.*_std, cup.*_std, tool_noise.

    Attributes
    ----------
    counts : dict
        Numbers of used and restarting measurements, and of rejected ones by `VERDICTS`.
    alarms : list of Alarm
        Detected faults.
    has_sensor : bool
        Whether a measured pose or a wrench has arrived.
    max_step : float
        Longest stable step of the estimated model, s.

    """

    _correction: Correction
    _known: Estimate

    def __init__(self, values: Values) -> None:
        self.use_values(values)
        self.counts = dict.fromkeys(('used', 'recovered', *VERDICTS), 0)
        self.alarms: list[Alarm] = []
        self.has_sensor = False
        self._track, self._support = ekf.Track(), Support()
        self._estimates: list[Estimate] = []  # the oldest, and one after each measurement
        self._measurements: list[Measurement] = []
        self._pending: list[Measurement] = []  # newer than the tool
        self._newest: Estimate | None = None  # at the newest sample, if requested
        self._error_at: Callable[[int], Array] | None = None  # of a start
        self._waits = False  # for `settle`
        self._delay_ns = 0  # of the newest measurement at its arrival
        self._last_ns = deque([0], 3)  # stamps of the newest measurements
        self._vacuum: tuple[int, bool, float] | None = None  # stamp, whether it holds, and period
        self._of_signals: list[Alarm] = []

    def use_values(self, values: Values) -> None:
        """Use other parameters from the next model on; estimates of the camera are kept."""
        self._values, self.sensor = values, PoseSensor(values)
        self.wrenches = WrenchFilter(WrenchSensor.of(values))

    def set_model(self, model: ModelTuple, max_step: float, reach: float) -> None:
        """Set a nominal model, its longest step (s), and the largest displacement of a lip (m)."""
        before, rows = getattr(self, '_correction', None), CAMERA_ROWS
        self._keep()
        self._correction = Correction(self._values, self.sensor.marker, model, max_step, reach)
        if before is not None and before.nominal[0] == model[0]:
            rows += CUP_ROWS
        self._begin_with(rows if self.has_sensor else ())
        gravity = model[2] if any(model[2]) else (0.0, 0.0, -1.0)
        self._support.use(t3.scale(-1.0 / t3.norm(gravity), gravity), sag(model))

    def forget(self, kept: tuple[int, ...] = ANOTHER_PACKAGE) -> None:
        """Restart with another package; estimates of the given rows of the error are kept."""
        self._keep()
        self._begin_with(kept)

    def grip(self, height: float | None = None) -> None:
        """Take another package from a support; a previous one was lifted at this height (m)."""
        self._support.grip(height, self._track.newest_ns)

    def _keep(self) -> None:
        """Keep the newest estimate of camera, cup and package if its poses were usual."""
        last = self._estimates[-1] if self._estimates else None
        if last and not last.gated_ns and last.stamp_ns - self._troubled_ns > REPEATED_NS:
            self._known = last

    def _begin_with(self, kept: tuple[int, ...]) -> None:
        """Begin without a motion, with the kept rows of previous estimates."""
        correction = self._correction
        known = correction.initial
        if kept:
            known = known.with_rows(self._known, kept)._replace(memory=self._known.memory)
        self._known = known
        for each in (self._estimates, self._measurements, self._pending):
            each.clear()
        self._track.count = 0
        self._newest = None
        self.wrenches.clear()
        self._troubled_ns = -REPEATED_NS
        self._predict_with(known.theta)

    def _predict_from(self, newest: Estimate) -> None:
        """Predict with the newest estimate."""
        self._newest = newest
        self._predict_with(newest.theta)

    def _predict_with(self, theta: Array) -> None:
        """Predict with estimated parameters."""
        self._theta = theta
        self.max_step = dynamics.stable_step(self._correction.max_step, theta)
        self._reach_ns = int(min(MAX_DELAY_NS, NS_PER_S * MAX_SUBSTEPS * self.max_step))
        self._model: ModelTuple | None = None

    @property
    def model(self) -> ModelTuple:
        """The model with the newest estimated parameters."""
        if self._model is None:
            self._model = dynamics.model_at(
                self._correction.row, self._correction.law, self._theta)
        return self._model

    @property
    def estimate(self) -> Estimate | None:
        """The estimate at the newest sample of the tool."""
        if not self._begin_estimates():
            return None
        self._newest = self._correction.propagated(
            self._newest or self._estimates[-1], self._track, self._track.newest_ns)
        return self._correction.with_noise_of_sample(self._newest)

    def covariance(self, stamp_ns: int) -> Array | None:
        """Return the covariance of the state (12, 12) at a stamp of the last 0.5 s, or None."""
        estimate = self.estimate
        if estimate is None or not (
                self._estimates[0].stamp_ns <= stamp_ns <= estimate.stamp_ns):
            return None
        if stamp_ns < estimate.stamp_ns:
            before = self._estimates[bisect_right(
                self._estimates, stamp_ns, key=lambda each: each.stamp_ns) - 1]
            estimate = self._correction.with_noise_of_sample(
                self._correction.propagated(before, self._track, stamp_ns))
        return estimate.covariance[:STATE, :STATE]

    @property
    def payload(self) -> Payload | None:
        """The estimated payload, if any."""
        if not (self.has_sensor and self._values.payload.estimate and self._begin_estimates()):
            return None
        return payload_of(self._estimates[-1], self.model)

    @property
    def smallest_slip(self) -> float:
        """Smallest slip (m) that the next poses show as an alarm; NaN before the first pose."""
        last = self._estimates[-1] if self._estimates else None
        allowed = self._correction.false_per_hour
        if last is None or last.evidence.seen is None or not allowed:
            return math.nan
        return alarms.smallest_slip(last.evidence.seen, allowed, last.memory[ekf.PERIOD])

    # ---------------------------------------------------------------- the tool

    def start(self, stamp_ns: int, tool: State, body: State, settles: bool = False) -> None:
        """Begin with a package at rest, or in a known motion; `settle` may follow."""
        self._track.begin(stamp_ns, tool, body)
        self._measurements.clear()
        self._estimates.clear()
        self._newest, self._error_at, self._waits = None, None, settles
        self._support.follow(stamp_ns, tool)
        self.body = body

    def settle(self, error_at: Callable[[int], Array]) -> None:
        """
        Begin with the swing of a start under a moving tool; measurements have waited for it.

        The function returns the standard deviations (12,) of the state at a stamp (ns).
        """
        self._waits = False
        self._begin_again(error_at)

    def _begin_again(self, error_at: Callable[[int], Array] | None) -> None:
        """Begin with another swing, see `settle`, and apply all measurements."""
        self._estimates.clear()
        self._newest, self._error_at = None, error_at
        if self._measurements and self._begin_estimates():
            self._reprocess(0, has_new=False)

    def _begin_estimates(self) -> bool:
        """Return whether there are estimates; they begin with the oldest sample when needed."""
        if self._estimates or not self._track.count:
            return bool(self._estimates)
        stamps, _, ends, bodies = self._track.rows
        stamp_ns = int(stamps[0])
        rests_on_support = self._support.at(stamp_ns) > 0
        std = self._error_at(stamp_ns) if self._error_at else None
        self._estimates.append(self._correction.start(
            stamp_ns, row_state(ends[0]), body_row(bodies[0], self.body), self._known,
            ON_SUPPORT if rests_on_support else std, rests_on_support))
        return True

    def follow(
        self, stamp_ns: int, start: State, end: State
    ) -> tuple[State, Wrench, bool] | None:
        """
        Propagate the package with the tool, from the newest sample to another.

        The result has the wrench and the verdict of `checked_wrench`; it is None if a waiting
        measured pose of this interval has corrected the package meanwhile.
        """
        track, correction = self._track, self._correction
        track.discard_before(self._estimates[0].stamp_ns if self._estimates
                             else stamp_ns - MAX_DELAY_NS)
        track.count += 1
        prediction: tuple[State, Wrench, bool] | None = ekf.followed(
            correction.row, correction.law, (track.newest_ns, start, self.body, self._theta),
            track.samples, stamp_ns, end, correction.max_step, correction.reach)
        track.newest_ns = stamp_ns
        assert prediction is not None
        self.body = prediction[0]
        event = self._support.follow(stamp_ns, end)
        if not self._estimates and not (event == 'meets' and self._begin_estimates()):
            return prediction
        while self._pending and self._pending[0].stamp_ns <= stamp_ns:
            prediction = None
            self._measurements.append(self._pending.pop(0))
            self._reprocess(len(self._measurements) - 1)
        if event == 'meets':
            prediction, at = None, bisect_left(self._measurements, (stamp_ns + 1,))
            self._measurements.insert(
                at, NO_MEASUREMENT._replace(stamp_ns=stamp_ns, meets_support=True))
            self._reprocess(at)
        elif event == 'leaves' and self._has_left:
            self._predict_from(self._correction.released(self._estimates[-1]))
        if stamp_ns - self._estimates[0].stamp_ns > MAX_DELAY_NS + HISTORY_NS:
            self._drop_old(stamp_ns - MAX_DELAY_NS)
        return prediction

    @property
    def _has_left(self) -> bool:
        """Whether the newest estimate is on a support that the package has left since."""
        return bool(self._estimates[-1].support) and not self._support.is_near

    def _drop_old(self, before_ns: int) -> None:
        """Discard estimates that no measurement can change any more, except the last of them."""
        estimates, measurements = self._estimates, self._measurements
        while measurements and measurements[0].stamp_ns <= before_ns:
            del estimates[0], measurements[0]
        if estimates[0].stamp_ns < before_ns - HISTORY_NS:
            stamp_ns = int(self._track.rows[0][self._track.after(before_ns) - 1])
            estimates[0] = self._correction.propagated(estimates[0], self._track, stamp_ns)

    def propagated_briefly(self, start: State, end: State, seconds: float) -> State:
        """Return the package after a motion of the tool, without storing it."""
        return dynamics.advanced_with_wrench(
            self.model, dynamics.wrench_bias(self._theta), self.body, start, end, seconds,
            substeps_for(seconds, self.max_step))

    # ------------------------------------------------------------ measurements

    def update(self, measurement: Measurement, since_ns: int = 0) -> str:
        """Process a measured pose, some time (ns) after the newest sample; return a rejection."""
        stamp_ns, verdict, self.has_sensor = measurement.stamp_ns, '', True
        newest_ns = self._track.newest_ns if self._begin_estimates() else 0
        is_ahead = stamp_ns > newest_ns
        others = self._pending if is_ahead else self._measurements
        at = bisect_left(others, (stamp_ns,))
        if not self._estimates:
            verdict = 'not_held'
        elif stamp_ns > newest_ns + MAX_DELAY_NS:
            verdict = 'future_stamp'
        elif at < len(others) and others[at].is_pose and others[at].stamp_ns == stamp_ns:
            verdict = 'duplicate_stamp'
        elif stamp_ns <= max(self._estimates[0].stamp_ns, newest_ns - self._reach_ns):
            verdict = 'late'
        if verdict:
            self.counts[verdict] += 1
            return verdict
        others.insert(at, measurement)
        if stamp_ns > self._last_ns[-1]:
            self._last_ns.append(stamp_ns)
        if not is_ahead:
            self._delay_ns = max(newest_ns + since_ns - stamp_ns, self._delay_ns // 2)
            self._reprocess(at)
        return ''

    def _reprocess(self, first: int, has_new: bool = True) -> None:
        """
        Apply a measurement, which may be new, and all later ones again.

        A swing at the start that early poses contradict is unknown.
        """
        if self._waits:
            self.counts['used'] += self._measurements[first].is_pose
            return
        estimates, measurements = self._estimates, self._measurements
        del estimates[first + 1:]
        since_ns, signals = measurements[first].stamp_ns, list[Alarm]()
        if first < len(measurements) - 1 or not has_new:
            self.alarms[:] = [each for each in self.alarms if each.stamp_ns < since_ns]
            signals = [each for each in self._of_signals if each.stamp_ns >= since_ns]
        for k in range(first, len(measurements)):
            while signals and signals[0].stamp_ns < measurements[k].stamp_ns:
                self._raise(signals.pop(0))
            self._apply(measurements[k], k > first or not has_new)
        for alarm in signals:
            self._raise(alarm)
        if self._error_at and estimates[0].evidence.seen is None and any(
                each.gated_ns and each.stamp_ns - estimates[0].stamp_ns < SWING_NS
                for each in estimates[first + 1:]):
            self._begin_again(None)
            return
        last = self._correction.released(estimates[-1]) if self._has_left else estimates[-1]
        self._predict_from(last)
        self.body = self._correction.body_at_end(last, self._track)

    def _apply(self, measurement: Measurement, is_again: bool) -> None:
        """Apply a measurement after the last estimate, for the first time or again."""
        correction, track, stamp_ns = self._correction, self._track, measurement.stamp_ns
        last = before = self._estimates[-1]
        if not (support := self._support.at(stamp_ns)):
            before = correction.released(last) if last.support else last
            before = self.wrenches.corrected(
                correction, before, track, stamp_ns, bool(self.counts['used']))
        if is_again or before is not last or last.support:  # other samples of the package
            correction.body_at_end(before, track)
        if measurement.meets_support:
            self._estimates.append(correction.met(before, track, stamp_ns))
            return
        after, verdict, alarm = correction.updated(before, track, measurement, support)
        if verdict and not is_again:
            self.counts[verdict] += 1
        if verdict == 'recovered':
            after = after.with_rows(self._known, KNOWN_ROWS)
        if verdict == 'recovered' or (alarm and alarm.kind != DIFFERS):
            self._troubled_ns = after.stamp_ns
        self._estimates.append(after)
        if verdict and self._may_fall(stamp_ns):
            alarm = None  # the next poses decide between a fall and a deviation
        self._raise(alarm)
        if verdict == 'out_of_reach':
            self._estimates[-1] = self._out_of_reach(after, measurement)

    def on_wrench(self, stamp_ns: int, wrench: Wrench) -> str:
        """Process a wrench (N, N m) of the sensor in its axes; return a rejection."""
        stamp_ns, newest_ns = self.wrenches.add(stamp_ns, wrench), self._track.newest_ns
        self.has_sensor = True
        if not self._begin_estimates():
            return 'not_held'
        if stamp_ns <= self._estimates[0].stamp_ns:
            return 'late'
        self._watch_wrench(stamp_ns)
        if not self._waits and (
                self._estimates[-1].stamp_ns + BLOCK_NS <= stamp_ns <= newest_ns):
            self._measurements.append(Measurement(stamp_ns, *ORIGIN[:2], np.zeros((0, 0))))
            self._reprocess(len(self._measurements) - 1)
        return ''

    def _watch_wrench(self, stamp_ns: int) -> None:
        """Detect a loss in the newest wrench, away from supports."""
        if self._correction.false_per_hour and self.wrenches.is_lost(
                self._correction, self._estimates[-1], self._track, stamp_ns,
                self._support.at(stamp_ns) > 0):
            self._of_signals.append(Alarm(stamp_ns, LOST, shown_by='wrench'))
            self._raise(self._of_signals[-1])

    @property
    def departs_from_file(self) -> bool:
        """Whether a parameter of the package differs from its estimate."""
        return bool(self._estimates) and (
            self._estimates[-1].evidence.differing >= alarms.DIFFERING)

    # ---------------------------------------------------------- a lost package

    def _out_of_reach(self, estimate: Estimate, measurement: Measurement) -> Estimate:
        """Process a pose out of reach; the package is lost after some time."""
        stamp_ns, away_ns = measurement.stamp_ns, estimate.away_ns
        if away_ns < 0 or estimate.support:
            return estimate
        if away_ns == 0:
            if not self._is_of_package(estimate, measurement):
                return estimate
            away_ns = min(estimate.gated_ns, default=stamp_ns)  # these were part of the fall
            estimate = estimate._replace(away_ns=away_ns)
        if stamp_ns - away_ns < (
                VACUUM_DELAY_NS if self._is_held else alarms.CONFUSED_NS):
            return estimate
        seen = estimate.evidence.seen
        assert seen
        self._raise(alarms.deviation(seen, seen.z, away_ns) if self._is_held
                    else Alarm(stamp_ns, LOST, away_ns))
        return estimate._replace(away_ns=-1)

    def _may_fall(self, stamp_ns: int) -> bool:
        """Return whether a fall may explain the recent poses; raise an alarm if it is certain."""
        last = self._estimates[-1].evidence.seen
        assert last
        allowed = self._correction.false_per_hour
        if not allowed or last.z @ last.z <= OUTLIER_DISTANCE:
            return False
        if self._estimates[-1].support and self._is_held is not None:
            return False
        stamps: Stamps = np.asarray(self._track.rows[0])
        bodies: Array = np.asarray(self._track.rows[3])
        seen = [each for before, after in pairwise(self._estimates)
                if (each := after.evidence.seen) is not before.evidence.seen and each
                and each.stamp_ns > stamp_ns - alarms.MAX_FALL_NS]
        if not seen:
            return False
        end = self._track.after(stamp_ns)
        first = max(self._track.after(seen[0].stamp_ns - ONSET_NS), 1)
        every = max((end - first) // MAX_ONSETS, 1)
        ratio = alarms.fall_ratio(
            stamps[first:end:every].copy(), bodies[first:end:every].copy(),
            np.array([each.stamp_ns for each in seen]),
            np.array([[*each.exposed[0], *each.exposed[1]] for each in seen]),
            np.array([each.z for each in seen]), np.array([each.whitener for each in seen]),
            self._correction.nominal[2])
        period = self._estimates[-1].memory[ekf.PERIOD]
        least = math.log(3600.0 / (period * min(allowed, 1.0)))
        if ratio > least:
            self._raise(Alarm(stamp_ns, LOST, seen[0].stamp_ns))
        return ratio > 0.5 * least

    def _is_of_package(self, estimate: Estimate, measurement: Measurement) -> bool:
        """
        Return whether a pose out of reach is of the package, or else of another object.

        A package that was never within reach may have fallen on the way of the tool, if the
        camera has shown packages before.
        """
        if estimate.evidence.poses:
            return True
        bodies, k = self._track.rows[3], self._track.after(measurement.stamp_ns) - 1
        return self.counts['used'] >= alarms.KNOWN_COUNT and self._support.is_below_way(
            measurement.position, row_state(bodies[k])[0])

    @property
    def departs(self) -> bool:
        """
        Whether the last measured poses contradict a held package: out of reach, or outliers.

        A support explains outliers.
        """
        last = self._estimates[-1] if self._estimates else None
        return last is not None and not last.support and (
            self._is_away or len(last.gated_ns) > 1)

    @property
    def _is_away(self) -> bool:
        """Whether the package is out of reach by a camera that is not silent since one pose."""
        away_ns = self._estimates[-1].away_ns if self._estimates else 0
        return away_ns < 0 or (away_ns > 0 and self.patience_ns > 0)

    @property
    def patience_ns(self) -> int:
        """Delay (ns) of a measured pose of the present; 0 if the camera is silent."""
        is_seen = self._estimates and len(self._last_ns) == 3 and (
            self._track.newest_ns - self._last_ns[-1] <= self._delay_ns + _silence_ns(
                float(np.diff(self._last_ns).min())))
        return max(self._delay_ns, 1) if is_seen else 0

    def on_vacuum(self, is_held: bool, breaks: bool, moves: bool, cup: int = -1) -> None:
        """
        Process a reading of the vacuum of one cup of a gripper, or of all cups if cup < 0.

        A break of the vacuum is the loss of the package, or of the single cup. It counts as a
        release if the tool is at rest and no pose is out of reach.
        """
        newest_ns = self._track.newest_ns
        if cup < 0:
            before_ns, was_held, _ = self._vacuum or (0, not is_held, 0.0)
            self._vacuum = (
                newest_ns, is_held, newest_ns - before_ns if is_held == was_held else math.inf)
        if not (self._track.count and breaks and (moves or (cup < 0 and self._is_away))):
            return
        alarm = Alarm(newest_ns, LOST, shown_by='vacuum')
        places = [(x, y) for x, y, _, k in places_of(self._values).tolist() if k == cup]
        if cup < 0 or places:
            alarm = alarm._replace(cup=cup, place=places[0] if places else (0.0, 0.0))
            self._of_signals.append(alarm)
            self._raise(alarm)

    @property
    def _is_held(self) -> bool | None:
        """
        Whether the vacuum holds by its last reading; None if unknown.

        A signal that repeats its value is periodic; when overdue it is treated as unknown.
        """
        stamp_ns, is_held, period_ns = self._vacuum or (0, None, 0.0)
        return None if self._track.newest_ns - stamp_ns > _silence_ns(period_ns) else is_held

    def _raise(self, alarm: Alarm | None) -> None:
        """Store an alarm, if any, unless an equal one has just been raised, or none is allowed."""
        if alarm and self._correction.false_per_hour and all(
                (other.kind, other.cup) != (alarm.kind, alarm.cup)
                or alarm.stamp_ns - other.stamp_ns >= REPEATED_NS for other in self.alarms):
            self.alarms.append(alarm)


def _silence_ns(period_ns: float) -> float:
    """Return the time (ns) after which a sensor with a period is silent."""
    return max(SILENT_PERIODS * period_ns, SILENT_NS)


def warm_up_observer(values: Values, model: ModelTuple) -> None:
    """Compile all kernels of an observer with a model."""
    observer = Observer(values)
    observer.set_model(model, math.inf, math.inf)
    observer.start(1, ORIGIN, resting_on_tool(model, ORIGIN))
    observer.update(Measurement(500_000, *observer.body[:2], np.eye(6)))
    last_ns = 2 * BLOCK_NS
    observer.follow(last_ns, ORIGIN, ORIGIN)
    observer.propagated_briefly(ORIGIN, ORIGIN, 1e-3)
    for stamp_ns in (*range(last_ns - BLOCK_NS, last_ns - BLOCK_NS + MIN_COUNT - 1), last_ns):
        observer.on_wrench(stamp_ns + observer.wrenches.sensor.delay_ns, (ZERO, ZERO))
