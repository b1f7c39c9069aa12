"""Estimates of a held package: propagation with the tool, correction, evidence of deviations."""

from __future__ import annotations

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model.equilibrium import sag
from bellows_ros.core.model.kernels import law_of, model_row, ModelTuple, ORIGIN, State
from bellows_ros.core.observer import alarms, dynamics, states
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import measurement as measured
from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.measurement import changed_by, MeasuredPose
from bellows_ros.core.observer.pose_sensor import Measurement, NO_MEASUREMENT
from bellows_ros.core.observer.results import Estimate, Evidence, USUAL
from bellows_ros.core.observer.states import LARGEST, STATE
from bellows_ros.core.observer.support import CONTACT
from bellows_ros.core.parameters.values import Values
import numpy as np

RESTART_COUNT = 8
"""Number of consecutive measurements outside the gate from which the filter restarts."""

RESTART_NS = 100_000_000
"""Shortest duration of these measurements, ns."""

LARGEST_LOAD = 5.0
"""Largest load of a holding cup, in weights, for the largest plausible displacement of its lip."""

ON_SUPPORT = np.repeat([5e-3, 0.02, 0.0, 0.0], 3)
"""Standard deviations of the state of a package at rest on a support, in which a cup that grips
it is bent: m, rad, m/s and rad/s."""

TOUCHDOWN = 0.05
"""Time in which a support takes over the weight of a lowered package, s."""

FRICTION = 0.2
"""Moment of a support about the vertical, relative to its moments about level axes: the friction
coefficient of smooth packages."""

FLAT = 0.98
"""Smallest cosine between the cup's axis and gravity of a package that is turned flat."""

MODEL_ERROR_SHARE = 3e-4
"""Largest initial variance of the model error, relative to that of the lip's displacement; the
stated relative variance of K if smaller, because a well-known cup needs no correction."""

FIRST_JITTER = 2e-3
"""Initial standard deviation of the random error of a stamp, s."""

FIRST_MEMORY = 0.043
"""Initial correlation time of the noise, s."""

LEAST_TOOL_NOISE = 5e-7, 2.5e-6
"""Smallest noise of the tool's position (m) and rotation (rad), of the size of the filter's step
errors."""

TOOL_LATENCY = 5e-3
"""Largest delay of the tool's poses, s."""

FIRST_PERIOD = 0.03
"""Initial time between measurements, s."""

FIRST_SQUARES = 100.0
"""
Initial sum of squares of the noise, as after 33 measurements. With a smaller sum, an initially
wrong payload would appear as noise with a long memory.
"""

WRENCH_ROWS = np.arange(states.WRENCH, states.WRENCH + 6)
COM_ROWS = np.arange(states.COM, states.COM + 3)
MARKER_ROWS = np.arange(states.MARKER, states.MARKER + 6)
SLIP = np.array([5e-3, 5e-3, 0.0])
"""Standard deviations of the shift of a lip that slips over the package, m."""
SLIPPING_ROWS = np.r_[COM_ROWS, WRENCH_ROWS, MARKER_ROWS]
"""Rows of what a slip or a push changes for good."""
INERTIAS = slice(states.INERTIA, states.INERTIA + 3)
STIFFNESSES = slice(states.STIFFNESS, states.STIFFNESS + 6)

DIFFERING_ROWS = np.arange(states.MASS, states.COM + 3)
"""Rows of the parameters that may differ. A stiffness that differs raised six false alarms in
0.3 h, by errors of the spring law."""


def first_memory() -> Array:
    """Return the initial memory of the noise, see `correlations`."""
    products = FIRST_SQUARES * math.exp(-FIRST_PERIOD / FIRST_MEMORY)
    memory: Array = np.r_[
        FIRST_PERIOD, [FIRST_SQUARES] * 2, [products] * 2, np.zeros(6), np.ones(2),
        MODEL_ERROR_SHARE, FIRST_JITTER**2, 0.0, 0.0]
    return memory


class Correction:
    """
    The filter of one model; each method takes an estimate and returns another.

    Parameters
    ----------
    values : mapping
        Parameters by name, as in `Observer`.
    marker : tuple
        Marker of the `PoseSensor`.
    model : tuple
        Nominal model.
    max_step, reach : float
        Longest step (s) of the model, and largest plausible displacement (m) of a lip from the
        prediction.

    Attributes
    ----------
    initial : Estimate
        Prior of all estimates, without a motion.
    holding_reach : float
        Largest displacement (m) of the lip of a holding cup from its place without load.
    false_per_hour : float
        Allowed rate of false alarms; 0 for no alarms.

    """

    def __init__(
        self, values: Values, marker: Any, model: ModelTuple, max_step: float,
        reach: float,
    ) -> None:
        self.nominal, self.max_step, self.reach = model, max_step, reach
        self.holding_reach = model[0][1] + LARGEST_LOAD * sag(model)
        self.law = law_of(model)
        self.row = model_row(model)
        self.weight, self.prior, inertia, walk = states.priors_of(values, model)
        prior = np.diag(np.square(self.prior))
        prior[INERTIAS, INERTIAS] = inertia
        n, memory = states.ROWS_WITHOUT_SENSOR, first_memory()
        memory[ekf.SHARE] = min(np.square(self.prior[STIFFNESSES]).min(), MODEL_ERROR_SHARE)
        self.initial = Estimate(
            0, ORIGIN, ORIGIN, np.zeros(n - STATE), prior[:n, :n].copy(), memory)
        self._prior_of_differing = np.square(self.prior[DIFFERING_ROWS])
        self._prior_after_slip = self._prior_of_differing + np.r_[0.0, [math.inf] * 3]  # untested
        self.largest = LARGEST.copy()
        self.largest[WRENCH_ROWS] *= self.weight
        self._walk = np.square(walk)
        self._marker, self.false_per_hour = marker, values.alarm.false_per_hour
        self._tool_noise = np.repeat(np.maximum(values.tool_noise, LEAST_TOOL_NOISE), 3)

    def _weight_in(self, body: State) -> Array:
        """Return the weight (3,) of a package in lip axes, N."""
        g = np.array(t3.apply_transposed(t3.rotation_matrix(body[1]), self.nominal[2]))
        return np.asarray(self.weight / max(float(np.linalg.norm(g)), 1e-9) * g)

    def _support_std(self, estimate: Estimate) -> Array:
        """
        Return the standard deviations (6,) of a support's wrench in lip axes, N and N m.

        Its force is of the size of the weight; its moment, with half of the weight at the distance
        of the centre of mass, turns the package flat; friction keeps it from turning.
        """
        com, variance = np.array(self.nominal[1][1]), np.diag(estimate.covariance)[COM_ROWS]
        distance = math.sqrt(0.5 * (np.square(com) + variance)[:2].sum())
        moment = 0.5 * self.weight * distance
        return np.asarray(np.r_[
            self._weight_in(estimate.body), moment, moment, FRICTION * moment])

    def start(
        self, stamp_ns: int, tool: State, body: State, initial: Estimate, std: Array | None,
        rests_on_support: bool,
    ) -> Estimate:
        """
        Return the initial estimate of a package.

        Its state errs by the swing, of standard deviations (12,), if known, and by the errors of
        the parameters, which displace the equilibrium of a hanging package. The slope of this
        displacement errs by the relative errors of mass and K.
        """
        self._drive = dynamics.driving(self.nominal, tool, body, self._tool_noise)
        P = initial.covariance.copy()
        swing = self.prior[:STATE] if std is None else std
        P[:STATE, :STATE] = np.diag(np.square(swing))
        if not rests_on_support:
            slope = dynamics.equilibrium_slope(self.nominal, initial.theta, tool, body)
            of_parameters = initial.covariance[STATE:states.MARKER, STATE:]
            P[:6, STATE:] = slope @ of_parameters
            P[STATE:, :6] = P[:6, STATE:].T
            displaced = P[:6, STATE:states.MARKER] @ slope.T
            variance = np.diag(initial.covariance)
            share = variance[states.MASS] + variance[STIFFNESSES].max()  # of the slope's error
            P[:6, :6] += 0.5 * (displaced + displaced.T) + share * np.diag(np.diag(displaced))
        return Estimate(stamp_ns, tool, body, initial.theta, P, initial.memory)

    def _step(
        self, before: Estimate, track: ekf.Track, stamp_ns: int,
        measurement: Measurement = NO_MEASUREMENT, gate: float = 0.0, support: int = 0,
    ) -> tuple[measured.Corrected, Estimate]:
        """Return result and estimate of `filter_step`; with gate 0 propagate only."""
        walk = self._walk
        if support == CONTACT:
            walk = walk.copy()
            walk[WRENCH_ROWS] += np.square(self._support_std(before)) / TOUCHDOWN
        prior = self._prior_after_slip if before.has_slipped else self._prior_of_differing
        seen = MeasuredPose(
            measurement.position, measurement.quaternion_xyzw, measurement.noise, self._marker,
            self.holding_reach, self.largest, gate, before.evidence.means, prior)
        is_early = before.evidence.poses < alarms.KNOWN_COUNT
        learns = before.memory[ekf.COUNT] < alarms.KNOWN_COUNT or bool(
            before.evidence.means[2].max() <= USUAL)
        result = measured.filter_step(
            self.row, self.law, before[:6], track.samples, stamp_ns, self.max_step,
            (self._drive, walk, self._marker[3][0]), seen, is_early, learns)
        later_ns, tool, body, theta, P, memory = result.estimate
        return result, before._replace(
            stamp_ns=later_ns, tool=tool, body=body, theta=theta, covariance=P, memory=memory,
            support=support)

    def propagated(self, estimate: Estimate, track: ekf.Track, stamp_ns: int) -> Estimate:
        """Return an estimate at a later stamp, which the package has already passed."""
        return estimate if estimate.stamp_ns >= stamp_ns else self._step(
            estimate, track, stamp_ns, support=estimate.support)[1]

    def with_noise_of_sample(self, estimate: Estimate) -> Estimate:
        """
        Return an estimate at a sample of the tool, whose noise appears at once in its twist.

        A latency between tool and camera may be a delay of the tool.
        """
        P = estimate.covariance.copy()
        P[6:STATE, 6:STATE] += self._drive[0, :6, :6]
        late = min(abs(estimate.theta[states.LATENCY - STATE]), TOOL_LATENCY)
        lag = late * np.r_[estimate.body[2], estimate.body[3]]
        P[:6, :6] += lag[:, None] * lag
        return estimate._replace(covariance=P)

    def body_at_end(self, estimate: Estimate, track: ekf.Track) -> State:
        """Return the package at the newest sample of the tool, and write it into the samples."""
        return ekf.followed(self.row, self.law, estimate.moving, track.samples, 0, estimate.tool,
                            self.max_step, math.inf)[0]

    def updated(
        self, before: Estimate, track: ekf.Track, measurement: Measurement, support: int = 0,
    ) -> tuple[Estimate, str, Alarm | None]:
        """
        Return the estimate after a measurement, or before it if the pose is not of the package.

        Further results are the verdict (`used`, `recovered`, `outlier` or `out_of_reach`),
        and an alarm, if any. While a support may be near, deviations do not count.
        """
        stamp_ns, is_pose = measurement.stamp_ns, measurement.is_pose
        result, after = self._step(
            before, track, stamp_ns, measurement if is_pose else NO_MEASUREMENT,
            measured.GATE * is_pose, support)
        if not is_pose:
            return after, '', self._differing(after, after.evidence, result.changes)[1]
        if result.verdict == measured.OUT_OF_REACH:
            return before._replace(
                evidence=before.evidence._replace(seen=result)), 'out_of_reach', None
        gated = (*before.gated_ns, stamp_ns) if result.verdict == measured.OUTSIDE else ()
        name = 'used' if not gated else 'recovered' if (
            len(gated) >= RESTART_COUNT and stamp_ns - gated[0] >= RESTART_NS) else 'outlier'
        after = after._replace(
            gated_ns=gated, away_ns=before.away_ns if gated else 0,
            evidence=before.evidence._replace(seen=result))
        alarm = None
        if not support:
            after, alarm = self._judged(before, after, result)
        if alarm is None and name == 'recovered':
            after = self._restarted(after, before.memory)
        return after, name, alarm

    def met(self, before: Estimate, track: ekf.Track, stamp_ns: int) -> Estimate:
        """
        Return an estimate after a stop of the tool, which may put the package on a support.

        A support and no support are equally likely; the estimate has the mean and the variance of
        both cases.
        """
        after = self._step(before, track, stamp_ns, support=before.support)[1]
        half = 0.5 * self._put_down(after)
        body, theta = changed_by(after.body, after.theta, half)
        return after._replace(
            body=body, theta=theta, covariance=after.covariance + half[:, None] * half,
            support=CONTACT)

    def _put_down(self, estimate: Estimate) -> Array:
        """
        Return the error (n,) of an estimate in the air, if a support keeps the package flat.

        The package turns about the middle of the bending cup. The moment balances the weight, of
        which the support takes half.
        """
        cup, (_, com, _, _), _ = dynamics.model_at(
            self.row, self.law, estimate.theta)
        error, turn = np.zeros(len(estimate.covariance)), self._turn_to_flat(estimate.body)
        if turn is None:
            return error
        arm, (a, b, _) = t3.subtract(com, (0.0, 0.0, 0.5 * cup[1])), estimate.body[3]
        spin = -a, -b, 0.0
        error[:STATE] = *t3.cross(turn, arm), *turn, *t3.cross(spin, arm), *spin
        moment = self.weight * com[1], -self.weight * com[0]
        rows = slice(states.WRENCH + 3, states.WRENCH + 5)
        error[rows] = moment - estimate.theta[rows.start - STATE:rows.stop - STATE]
        error[WRENCH_ROWS[:3]] = -0.5 * self._weight_in(estimate.body)
        return error

    def _turn_to_flat(self, body: State) -> Vector | None:
        """Return the rotation (rad) of a package to a level support; None if tilted too far."""
        gravity = self.nominal[2]
        x, y, z = t3.apply_transposed(t3.rotation_matrix(body[1]), gravity)
        return None if -z < FLAT * t3.norm(gravity) else (-y / z, x / z, 0.0)

    def _judged(
        self, before: Estimate, after: Estimate, seen: measured.Corrected
    ) -> tuple[Estimate, Alarm | None]:
        """Return an estimate with the evidence of a pose, and the alarm on it."""
        since_ns = before.evidence.since_ns
        is_brief = seen.stamp_ns - since_ns < (
            alarms.VIEW_NS if self._marker[3][0] else alarms.CONFUSED_NS)
        if is_brief and after.gated_ns:
            return after, None
        after, alarm = self._differing(after, before.evidence.after(seen, after), seen.changes)
        memory, (means, _, squares) = after.memory, seen.means
        if alarm or is_brief or memory[ekf.COUNT] <= alarms.KNOWN_COUNT or not (
                alarms.is_deviation(squares.max(), self.false_per_hour, memory[ekf.PERIOD])):
            return after, alarm
        alarm = alarms.deviation(seen, means[squares.argmax()], since_ns)
        return self._reopened(after, before), alarm

    def _differing(
        self, estimate: Estimate, evidence: Evidence, sizes: Array
    ) -> tuple[Estimate, Alarm | None]:
        """
        Return an estimate with evidence and its count of a parameter that differs.

        Poses that do not fit the corrected prediction are evidence of no parameter.
        """
        fits = evidence.means[2].max() <= USUAL and not estimate.gated_ns
        differs = fits and sizes.max() > alarms.SIGNIFICANCE
        estimate = estimate._replace(
            evidence=evidence._replace(differing=evidence.differing + 1 if differs else 0))
        if estimate.evidence.differing < alarms.DIFFERING or not self.false_per_hour:
            return estimate, None
        return estimate, self._difference(estimate, int(sizes.argmax()))

    def _difference(self, estimate: Estimate, place: int) -> Alarm:
        """Return the alarm on a parameter that differs, by its place among `DIFFERING_ROWS`."""
        theta, std = alarms.shown_alone(
            estimate.theta[DIFFERING_ROWS - STATE], self._prior_of_differing,
            np.diag(estimate.covariance)[DIFFERING_ROWS])
        mass, com = self.nominal[1][:2]
        alarm = Alarm(estimate.stamp_ns, alarms.DIFFERS)
        if place > 0:
            shown = np.add(com, theta[1:]).tolist()
            return alarm._replace(
                parameter='package.com', value=tuple(shown), std=tuple(std[1:].tolist()))
        if len(estimate.covariance) == states.ROWS:  # a force sensor weighs the package
            mass *= math.exp(theta[0])
            return alarm._replace(parameter='package.mass', value=(mass,), std=(std[0] * mass,))
        ratio = math.exp(-theta[0])
        return alarm._replace(parameter=alarms.RATIO, value=(ratio,), std=(std[0] * ratio,))

    @staticmethod
    def _renewed(estimate: Estimate) -> Estimate:
        """Return an estimate without evidence of deviations."""
        return estimate._replace(
            gated_ns=(), evidence=Evidence(seen=estimate.evidence.seen))

    def released(self, estimate: Estimate) -> Estimate:
        """Return an estimate of a package just released by its support."""
        return self._renewed(
            estimate.with_rows(self.initial, WRENCH_ROWS)._replace(support=0, away_ns=0))

    def _reopened(self, estimate: Estimate, before: Estimate) -> Estimate:
        """
        Return an estimate after a deviation from the estimate before.

        Parameters are those of the last usual estimate; a slip or a push changes the centre of
        mass, the marker and the wrench, which are unknown again; that centre of mass is no longer
        compared with the stated one.
        """
        usual = before.evidence.usual or before
        reopened = estimate.with_rows(usual, states.KNOWN_ROWS).with_rows(
            self.initial, SLIPPING_ROWS)._replace(has_slipped=True)
        reopened.covariance[COM_ROWS, COM_ROWS] += np.square(SLIP)
        return self._restarted(reopened, before.memory)

    def _restarted(self, estimate: Estimate, memory: Array) -> Estimate:
        """Return an estimate with initial uncertainty, for the next pose to correct."""
        rows, P = np.r_[:STATE, WRENCH_ROWS], estimate.covariance.copy()
        P[rows, rows] += np.square(self.prior[rows])
        return self._renewed(estimate._replace(covariance=P, memory=memory, away_ns=0))
