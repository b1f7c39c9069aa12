"""
The prediction of a held package, corrected by measured poses whenever they come.

Measurements come late and out of order. The tool's samples of the last moments are kept, each with
the estimate after it: a measurement goes to its stamp, and all that followed is worked out again,
so that the outcome is that of measurements that came in order.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.equilibrium import resting_on_tool
from bellows_ros.core.kernels import ModelTuple, State, tool_at, tool_segment
from bellows_ros.core.observer.alarms import Alarm, Alarms, extended
from bellows_ros.core.observer.filter import (
    BIAS,
    carried,
    CENTRE,
    changed,
    corrected,
    driving,
    Estimate,
    EXTENDED,
    Innovation,
    innovation,
    payload_model,
    SIZE,
    steps,
    transition,
)
from bellows_ros.core.observer.measurement import lip_shift, Measurement, Sight
from bellows_ros.core.tuples import Matrix, Quaternion, Vector
import numpy as np

LATEST_NS = 500_000_000
"""A measurement may be so late (ns), or so far ahead of the tool's newest pose."""

GATE = 27.86
"""Squared Mahalanobis distance that 1 in 10,000 good measurements exceeds (6 numbers)."""

WRONG_GATE = 8
"""After so many outside the gate, one after the other, the gate is wrong: start anew there."""

START = np.repeat([0.01, 0.1, 0.5, 1.0], 3)
"""Standard deviations at the start: m, rad, m/s, rad/s."""

MASS_SHARE, COM_UNCERTAIN = 0.1, 0.01
"""Standard deviations of a payload of which none is given: by mass, m."""

BIAS_WALK, WALK_ARM = 0.01, 0.02
"""By how much of the weight the wrench bias walks in a second; its moment by its force (m)."""

BIAS_SHARE = 0.1
"""The bias at the start, by what a payload would make of which nothing is given."""

VERDICTS = (
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'covariance', 'frame_id', 'not_held',
    'late', 'future_stamp', 'duplicate_stamp', 'out_of_reach', 'gate',
)
"""Why a measured pose is not used."""


class Slot(NamedTuple):
    """From one sample of the tool to the next."""

    stamp_ns: int
    """Of its end."""
    start: State
    """Of the tool."""
    end: State
    seen: tuple[Measurement, ...]
    """In order."""
    after: Estimate


class Payload(NamedTuple):
    """A payload as it is estimated: kg, m in S, kg m^2 at B, and standard deviations."""

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
        self._H: Array = np.zeros((6, SIZE))
        self._H[:, :6] = np.eye(6)
        if self.sight.of_lip:
            self._H[:3, CENTRE] = -np.eye(3)
        self._slots: list[Slot] = []
        self._ahead: list[Measurement] = []
        self._kept: Estimate | None = None
        self._new: set[int] = set()  # stamps of measurements that are not yet counted
        self._opened_ns: set[int] = set()  # stamps of measurements at which an alarm was raised
        allowed = values['alarm.false_per_hour']
        self._alarms = Alarms(allowed) if allowed > 0.0 else None
        self.alarms: list[Alarm] = []
        self._away, self._were_near = 0, False

    def set_model(self, model: ModelTuple, longest_step: float, reach: float) -> None:
        """Take a nominal model, the longest step (s) of it, and how far (m) a lip can be."""
        self._nominal, self._longest, self._reach = model, longest_step, reach
        weight = model[1][0] * math.hypot(*model[2])
        bias = BIAS_SHARE * weight * np.repeat([MASS_SHARE, COM_UNCERTAIN], 3)
        self._prior = np.concatenate([START, self._payload_std(), bias])
        walk = BIAS_WALK * weight * np.repeat([1.0, WALK_ARM], 3)
        self._walk = np.concatenate([np.zeros(4), np.square(walk)])
        self.forget()

    def _payload_std(self) -> Array:
        """Return the standard deviations (4,) of mass, relative, and centre of mass (m)."""
        values = self._values
        if not values['payload.estimate']:
            return np.zeros(4)
        mass = values['package.mass_std'] / values['package.mass'] or MASS_SHARE
        return np.array([mass, *(std or COM_UNCERTAIN for std in values['package.com_std'])])

    def forget(self, is_another: bool = True) -> None:
        """Begin anew, with the same package or with another."""
        self._kept = None if is_another else self.estimate or self._kept
        self._slots.clear()
        self._ahead.clear()
        self._new.clear()
        self._opened_ns.clear()
        self._away, self._were_near = 0, False
        if self._alarms is not None:
            self._alarms.forget()

    @property
    def estimate(self) -> Estimate | None:
        """What is known at the newest sample of the tool."""
        return self._slots[-1].after if self._slots else None

    @property
    def body(self) -> State:
        """The package at the newest sample of the tool."""
        return self._slots[-1].after.body

    @property
    def covariance(self) -> Array:
        """Of its state (12, 12)."""
        return self._slots[-1].after.covariance[:12, :12]

    @property
    def payload(self) -> Payload | None:
        """What the payload is found to be, where it is estimated."""
        known = self.estimate
        if known is None or not self._values['payload.estimate']:
            return None
        mass, com, inertia, _ = self.model[1]
        std = np.sqrt(np.diag(known.covariance)[12:16])
        return Payload(known.stamp_ns, mass, com, inertia, float(std[0] * self._nominal[1][0]),
                       std[1:])

    @property
    def model(self) -> ModelTuple:
        """The model with the payload as it is estimated."""
        known = self.estimate or self._kept
        return self._nominal if known is None else payload_model(self._nominal, known.theta)

    # ---------------------------------------------------------------- the tool

    def start(self, stamp_ns: int, tool: State, body: State) -> None:
        """Begin with a package at rest."""
        P = np.diag(np.square(self._prior))
        theta = np.zeros(10)
        if self._kept is not None:
            theta[:4] = self._kept.theta[:4]
            P[12:16, 12:16] = self._kept.covariance[12:16, 12:16]
        noise = np.repeat([self._values['tool_noise.position'],
                           self._values['tool_noise.rotation']], 3)
        self._driven = driving(self._nominal, tool, body, noise, self._walk)
        self._slots = [Slot(stamp_ns, tool, tool, (), Estimate(stamp_ns, body, theta, P))]

    def follow(self, stamp_ns: int, start: State, end: State) -> State:
        """Carry the package along with the tool, from the newest sample to this one."""
        seen = tuple(m for m in self._ahead if m.stamp_ns <= stamp_ns)
        self._ahead = [m for m in self._ahead if m.stamp_ns > stamp_ns]
        self._slots.append(self._through(Slot(
            stamp_ns, start, end, seen, self._slots[-1].after)))
        while self._slots[1].stamp_ns < stamp_ns - LATEST_NS:
            del self._slots[0]
        return self.body

    def drifted(self, body: State, start: State, end: State, seconds: float) -> State:
        """Return a package after a motion of the tool that is not kept."""
        theta = self._slots[-1].after.theta
        body, S = steps(self.model, body, start, end, seconds, self._longest)
        return changed(body, transition(self._nominal[1], S, theta)[:, BIAS] @ theta[4:])

    def _through(self, slot: Slot) -> Slot:
        """Return a slot with the estimate after it; it holds the one before."""
        estimate, tool = slot.after, slot.start
        for seen in slot.seen:
            part = (seen.stamp_ns - estimate.stamp_ns) / (slot.stamp_ns - estimate.stamp_ns)
            segment = tool_segment(tool, slot.end, (slot.stamp_ns - estimate.stamp_ns) * 1e-9)
            now = tool_at(segment, part) if part < 1.0 else slot.end
            estimate = self._carried(estimate, tool, now, seen.stamp_ns)
            estimate, tool = self._taken(estimate, seen, now), now
        if estimate.stamp_ns < slot.stamp_ns:
            estimate = self._carried(estimate, tool, slot.end, slot.stamp_ns)
        return slot._replace(after=estimate)

    def _carried(self, estimate: Estimate, start: State, end: State, stamp_ns: int) -> Estimate:
        """Carry an estimate along with the tool."""
        after, F = carried(
            self._nominal, estimate, start, end, stamp_ns, self._longest, self._driven)
        if self._alarms is None:
            return after
        model = payload_model(self._nominal, estimate.theta)
        seconds = (stamp_ns - estimate.stamp_ns) * 1e-9
        return after._replace(passage=extended(
            model, start, estimate.body, F, seconds, estimate.passage))

    # ------------------------------------------------------------ measurements

    def see(self, seen: Measurement) -> str:
        """Take a measured pose in; return why it cannot be, or nothing."""
        verdict = self._place(seen)
        if verdict:
            self.counts[verdict] += 1
        return verdict

    def _place(self, seen: Measurement) -> str:
        """Put a measured pose where it belongs, and work out what followed again."""
        slots, stamp_ns = self._slots, seen.stamp_ns
        if not slots:
            return 'not_held'
        if stamp_ns > slots[-1].stamp_ns + LATEST_NS:
            return 'future_stamp'
        if stamp_ns <= slots[0].stamp_ns:
            return 'late'
        if stamp_ns > slots[-1].stamp_ns:
            insort(self._ahead, seen, key=lambda m: m.stamp_ns)
            self._new.add(stamp_ns)
            return ''
        at = bisect_left(slots, stamp_ns, key=lambda slot: slot.stamp_ns)
        slot = slots[at]
        if any(other.stamp_ns == stamp_ns for other in slot.seen):
            return 'duplicate_stamp'
        self._new.add(stamp_ns)
        slot = slot._replace(seen=tuple(sorted((*slot.seen, seen), key=lambda m: m.stamp_ns)))
        for k in range(at, len(slots)):
            again = slot if k == at else slots[k]
            slots[k] = self._through(again._replace(after=slots[k - 1].after))
        return ''

    def _taken(self, estimate: Estimate, seen: Measurement, tool: State) -> Estimate:
        """Correct an estimate, or leave it where the measurement is outside the gate."""
        x, y, z = (np.array(self._nominal[1][1]) + estimate.theta[1:4]).tolist()
        position, q, noise = self.sight.at_com(seen, (x, y, z))
        shift = lip_shift(position, q, (x, y, z), tool, self._nominal[0][1])
        found = innovation(estimate, position, q, noise, self._H)
        verdict = 'used'
        if math.hypot(*shift) > self._reach + 5.0 * math.sqrt(np.trace(noise[:3, :3])):
            verdict = 'out_of_reach'  # no lip can be there: that is another package
        elif found.distance > GATE:
            verdict = 'recovered' if estimate.refused + 1 >= WRONG_GATE else 'gate'
        if seen.stamp_ns in self._new:
            self._new.remove(seen.stamp_ns)
            self.counts[verdict] += 1
            self._look_for_causes(seen.stamp_ns, estimate, found, verdict, position, q)
        if verdict == 'out_of_reach':
            return estimate
        estimate = estimate._replace(passage=np.eye(EXTENDED))
        if seen.stamp_ns in self._opened_ns:
            verdict = 'recovered'
        if verdict == 'gate':
            return estimate._replace(refused=estimate.refused + 1)
        if verdict == 'recovered':
            estimate = self._opened(estimate)
            found = innovation(estimate, position, q, noise, self._H)
        return corrected(estimate, found, noise)

    def _look_for_causes(
        self, stamp_ns: int, estimate: Estimate, found: Innovation, verdict: str,
        position: Vector, q: Quaternion,
    ) -> None:
        """Raise an alarm where something is wrong; what a fault moves is then followed."""
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
                stamp_ns, estimate.passage, found, verdict == 'used', position, q)
            if verdict == 'recovered':
                alarms.forget()
        else:  # one that came in between, of which what was known did not know
            alarms.forget()
        if alarm is not None:
            self.alarms.append(alarm)
            if alarm.cause not in ('camera', 'lost'):
                self._opened_ns.add(stamp_ns)

    def _opened(self, estimate: Estimate) -> Estimate:
        """Return an estimate of which all but the payload is as uncertain as at the start."""
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
