"""
Correction by a force-torque sensor, in blocks of wrenches between two estimates.

The mean of the wrenches of a block is compared with the mean of the predicted wrenches at the same
times; a mean over `BLOCK_NS` has -3 dB at 7 Hz. The derivative of the mean by the error at the
begin of the block is the mean of H(t) T(t), with the transition T. The estimate at the begin of
the block is corrected, and propagated again.

Bias and gain are states. Crosstalk, hysteresis and errors of the gripper are proportional to the
wrench, `GAIN_STD` of force and moment in each axis, and persist over many blocks: the
variance of these errors is multiplied by `PERSISTENCE`, so that they do not average out too fast.
Factors of the variances are learned from the innovations. Wrenches leave the estimates of K and P,
whose errors the covariance includes (Schmidt-Kalman): errors of the spring law would change K and
P, and raise false alarms of a worn cup. Persistent errors would also add up to evidence of a wrong
payload, which is not tested with wrenches: `Observer.departs_from_file` compares the estimates.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import substeps_for
from bellows_ros.core.model.kernels import LawTuple, ModelTuple, State, Wrench
from bellows_ros.core.model.simulation import body_row, first_after, row_state, stands
from bellows_ros.core.observer import dynamics, states
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.filter import Moving, Samples
from bellows_ros.core.observer.measurement import changed_by, GATE
from bellows_ros.core.observer.results import Estimate
from bellows_ros.core.observer.states import COM, DAMPING, MARKER, ROWS, STATE, STIFFNESS
from bellows_ros.core.sensors.set_up import COS_MIN_TILT, Fault, fault_of, Still
from bellows_ros.core.sensors.wrench import (
    cup_load,
    GAIN_STD,
    gripper_load,
    Mount,
    SAMPLE_NOISE,
    WrenchSensor,
)
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

if TYPE_CHECKING:
    from bellows_ros.core.observer.correction import Correction

NODE_NS = 4_000_000
"""Interval of the derivatives, ns."""

KEPT = 2048
"""Number of stored wrenches, two seconds at 1 kHz."""

SMOOTH_NS = 12_000_000
"""Time over which the tool's acceleration is a difference of twists, ns."""

CUP = np.array(states.CUP_ROWS)
"""Rows of the error that wrenches leave unchanged: K and P."""

WITH_CAMERA = np.append(CUP, COM + 2)
"""The same beside a camera: also the depth of the centre of mass, which errors of the spring law
would change by 1 mm."""

MIN_COUNT = 3
"""Smallest number of wrenches in a block."""

PERSISTING = 3
"""Number of successive blocks outside the gate from which they are used, and check the set-up in
motion: 0.2 s, longer than a collision and than the time in which a loss is noticed."""

LEARNING_COUNT = 40.0
"""Number of blocks over which the noise is learned, 2.5 s."""

FIRST_FACTOR = 4.0
"""Initial factor of the variance of the noise."""

PERSISTENCE = 100.0
"""Number of blocks over which errors proportional to the wrench persist: 6 s, a cycle."""

LOST_SHARE = 0.35
"""Largest measured fraction of the predicted force after the loss of a package."""

LOSS_NS = 10_000_000
"""Time for which the measured fraction must be smaller before a loss is reported, ns."""

LEAST_LOAD = 0.5
"""Smallest predicted force before a loss, and largest force after the loss, in weights."""

KEPT_BLOCKS = 8
"""Number of blocks at rest that are kept of each tilt."""

Buffer = tuple[Any, Any]
"""Stamps (N,) and wrenches (N, 6) of a block, ns, N and N m."""


@kernel
def _add_node(
    nominal: ModelTuple, theta: Array, tool: State, body: State, mount: Mount, T: Array,
    weight: float, H: Array,
) -> None:
    """Add a weighted derivative (6, n) of the load, by the state after T and by the cup."""
    model, changed = dynamics.with_theta(nominal, theta), theta.copy()
    now, L, G = cup_load(model, tool, body, mount), np.zeros((6, STATE)), np.zeros((6, MARKER))
    for j in range(STATE):
        dynamics.write_difference(now, cup_load(
            model, tool, dynamics.shaken(body, j, dynamics.DIFFERENCE), mount), j, L)
    for j in range(COM, DAMPING + 6):
        if j < COM + 3 or j >= STIFFNESS:
            changed[j - STATE] += dynamics.DIFFERENCE
            dynamics.write_difference(now, cup_load(
                dynamics.with_theta(nominal, changed), tool, body, mount), j, G)
            changed[j - STATE] = theta[j - STATE]
    product = t3.product(L, T, np.empty((6, MARKER)))
    for i in range(6):
        for j in range(MARKER):
            H[i, j] += weight * (product[i, j] + G[i, j])


@entry
def block(
    row: Any, law: LawTuple, beginning: Moving, samples: Samples, wrenches: Buffer, until_ns: int,
    max_step: float, mount: Mount,
) -> tuple[Array, Array, State, State]:
    """
    Return the mean load of the cup (6,) at wrenches of a block, and its derivative H (6, n).

    Further results are the tool at both ends. The wrenches are after the beginning.
    """
    now_ns, tool, body, theta = beginning
    nominal = kernels.model_of(row, law)
    model = dynamics.with_theta(nominal, theta)
    bias, max_step = dynamics.wrench_bias(theta), dynamics.stable_step(max_step, theta)
    stamps, count = samples[0], samples[4]
    k, i, n, first, at_node = first_after(stamps, now_ns, count), 0, len(wrenches[0]), tool, now_ns
    load, pending = cup_load(model, tool, body, mount), 0
    H, mean = np.zeros((6, ROWS)), np.zeros(6)
    A, B, T, Q = (np.zeros((STATE, STATE)), np.zeros((6, MARKER)), ekf.identity_transition(),
                  np.zeros((STATE, STATE)))
    A1, B1, still = A.copy(), B.copy(), Q.copy()
    dynamics.slopes(nominal, theta, tool, body, A, B)
    while now_ns < until_ns and k < count:
        tool, end, later_ns = ekf.part_of_motion(samples, k, now_ns, until_ns, tool, max_step)
        seconds = (later_ns - now_ns) / NS_PER_S
        body = dynamics.advanced_with_wrench(
            model, bias, body, tool, end, seconds, substeps_for(seconds, max_step))
        before, load = load, cup_load(model, end, body, mount)
        while i < n and wrenches[0][i] <= later_ns:
            part = (wrenches[0][i] - now_ns) / (later_ns - now_ns)
            for j in range(3):
                mean[j] += (before[0][j] + part * (load[0][j] - before[0][j])) / n
                mean[3 + j] += (before[1][j] + part * (load[1][j] - before[1][j])) / n
            i, pending = i + 1, pending + 1
        tool, now_ns, k = end, later_ns, k + (later_ns == stamps[k])
        if now_ns - at_node >= NODE_NS or now_ns == until_ns:
            dynamics.slopes(nominal, theta, tool, body, A1, B1)
            ekf.accumulate(A + A1, B + B1, (now_ns - at_node) / NS_PER_S, still, T, Q)
            _add_node(nominal, theta, tool, body, mount, T, pending / n, H)
            A, B, A1, B1, pending, at_node = A1, B1, A, B, 0, now_ns
    return mean, H, first, tool


class WrenchFilter:
    """
    The recent wrenches of a sensor, and the correction by them.

    Parameters
    ----------
    sensor : WrenchSensor

    """

    def __init__(self, sensor: WrenchSensor) -> None:
        self.sensor = sensor
        self._stamps, self._values = np.zeros(KEPT, np.int64), np.zeros((KEPT, 6))
        self._count = self._since_ns = 0
        self.set_up = SetUp(sensor)

    def clear(self) -> None:
        """Accept wrenches of any next stamp."""
        self._count = self._since_ns = 0

    def in_own_axes(self, tool: State, of_world: Vector) -> Vector:
        """Return a vector of the world in axes of the sensor."""
        R = t3.multiply(t3.rotation_matrix(tool[1]), self.sensor.mount[1])
        return t3.apply_transposed(R, of_world)

    def add(self, stamp_ns: int, wrench: Wrench) -> int:
        """Store a wrench after the last one; return the stamp (ns) of its force, 0 if late."""
        stamp_ns -= self.sensor.delay_ns
        count, stamps, values = self._count, self._stamps, self._values
        if count and stamp_ns <= stamps[count - 1]:
            return 0
        if count == KEPT:
            count = KEPT // 2
            stamps[:count], values[:count] = stamps[-count:].copy(), values[-count:].copy()
        stamps[count], values[count, :3], values[count, 3:] = stamp_ns, *wrench
        self._count = count + 1
        return stamp_ns

    def corrected(
        self, correction: Correction, before: Estimate, track: ekf.Track, until_ns: int,
        has_camera: bool,
    ) -> Estimate:
        """Return an estimate corrected by the block of wrenches up to a stamp."""
        if self._count < MIN_COUNT or before.support:
            return before
        first, last = np.searchsorted(
            self._stamps[:self._count], [before.stamp_ns + 1, until_ns + 1])
        if last - first < MIN_COUNT:
            return before
        used = self._stamps[first:last], self._values[first:last]
        mean, H, start, end = block(
            correction.row, correction.law, before.moving,
            track.samples, used, until_ns, correction.max_step, self.sensor.mount)
        mean = mean + self._of_gripper(
            start, end, (until_ns - before.stamp_ns) / NS_PER_S, correction.nominal[2])
        own = _with_sensor(before, correction.prior)
        H[:, states.ZERO:states.ZERO + 6], H[:, states.GAIN] = np.eye(6), mean
        gain, zero = (own.theta[row - STATE:][:6] for row in (states.GAIN, states.ZERO))
        after = self._updated(
            correction, own, WITH_CAMERA if has_camera else CUP,
            used[1].mean(axis=0) - (1.0 + gain[0]) * mean - zero, H,
            np.repeat(np.square(SAMPLE_NOISE) / (last - first) + PERSISTENCE * (
                GAIN_STD**2 + before.memory[ekf.SHARE]) * np.square(
                    np.linalg.norm(mean.reshape(2, 3), axis=1)), 3))
        if after.outside == PERSISTING or (
                stands(np.ravel(start[2:4])) and stands(np.ravel(end[2:4]))):
            R = np.reshape(t3.multiply(t3.rotation_matrix(end[1]), self.sensor.mount[1]), (3, 3))
            self.set_up.add(until_ns, Still(used[1].mean(axis=0), mean, R), correction.weight)
        is_used = self.set_up.fault is None and after.outside in (0, PERSISTING)
        return after if is_used else before._replace(outside=after.outside)

    def is_lost(
        self, correction: Correction, estimate: Estimate, track: ekf.Track, stamp_ns: int,
        on_support: bool,
    ) -> bool:
        """Return whether the force of a package in the air has disappeared in last wrenches."""
        if on_support or track.count < 2 or self.set_up.fault is not None:
            self._since_ns = 0
            return False
        stamps, _, ends, bodies = track.rows
        k = max(track.after(stamp_ns) - 1, 1)
        j = max(track.after(stamps[k] - SMOOTH_NS) - 1, 0)
        body = body_row(bodies[k], estimate.body)
        before, now = row_state(ends[j]), row_state(ends[k])
        model = dynamics.model_at(correction.row, correction.law, estimate.theta)
        other = self._of_gripper(
            before, now, (stamps[k] - stamps[j]) / NS_PER_S, correction.nominal[2])
        zero = _with_sensor(estimate, correction.prior).theta[states.ZERO - STATE:][:6]
        force = self._values[self._count - 1, :3] - zero[:3] - other[:3]
        f = np.array(cup_load(model, now, body, self.sensor.mount)[0])
        square, usual = max(float(f @ f), 1e-9), (LEAST_LOAD * correction.weight) ** 2
        is_off = square > usual > force @ force and force @ f < LOST_SHARE * square
        self._since_ns = (self._since_ns or stamp_ns) if is_off else 0
        return bool(is_off) and stamp_ns - self._since_ns >= LOSS_NS

    def _of_gripper(self, start: State, end: State, seconds: float, gravity: Any) -> Array:
        """Return the mean load (6,) of the gripper between two states, less that at the zero."""
        middle = kernels.tool_at(kernels.tool_segment(start, end, seconds), 0.5)
        dv, dw = (t3.scale(1.0 / seconds, t3.subtract(b, a)) for a, b in zip(
            start[2:4], end[2:4], strict=True))
        now, zero = gripper_load(
            middle, (dv, dw), gravity, self.sensor.mount, self.sensor.gripper)
        return np.asarray(np.subtract(np.ravel(now), np.ravel(zero)))

    def _updated(
        self, correction: Correction, before: Estimate, kept: Places, y: Array, H: Array,
        variance: Array,
    ) -> Estimate:
        """Return an estimate corrected by an innovation (6,), with derivative H (6, n)."""
        memory = np.array(before.wrench_memory or (FIRST_FACTOR, FIRST_FACTOR))
        variance = variance * np.repeat(memory, 3)
        P = before.covariance
        HP = H @ P
        S = HP @ H.T + np.diag(variance)
        refused = before._replace(outside=min(before.outside + 1, PERSISTING))
        try:
            inverse = np.linalg.inv(S)
        except np.linalg.LinAlgError:  # the model moves too far in a block for any number
            return refused
        excess = max(float(y @ inverse @ y) / GATE, 1.0)
        S *= excess
        learned = tuple(_learned(
            memory, y / np.sqrt(np.diag(S)), variance / np.diag(S)).tolist())
        gain = HP.T @ inverse / excess  # (n, 6)
        gain[kept] = 0.0
        body, theta = changed_by(before.body, before.theta, gain @ y)
        if not dynamics.is_possible(body, theta, correction.largest):
            return refused._replace(wrench_memory=learned)
        left = np.eye(len(P)) - gain @ H
        updated = left @ P @ left.T + gain @ (S - HP @ H.T) @ gain.T  # Joseph: never indefinite
        return before._replace(
            body=body, theta=theta, covariance=0.5 * (updated + updated.T),
            wrench_memory=learned, outside=refused.outside if excess > 1.0 else 0)


def _with_sensor(estimate: Estimate, prior: Array) -> Estimate:
    """Return an estimate with bias and gain of the sensor, of prior standard deviations (n,)."""
    n = len(estimate.covariance)
    if n == ROWS:
        return estimate
    P = np.diag(np.square(prior))
    P[:n, :n] = estimate.covariance
    return estimate._replace(theta=np.r_[estimate.theta, np.zeros(ROWS - n)], covariance=P)


def _learned(memory: Array, z: Array, share: Array) -> Array:
    """
    Return the factors (2,) of the variances of force and moment after another innovation.

    A factor grows by the share (6,) of the noise in the variance of the innovation (6,), which is
    in its standard deviations.
    """
    growth = ((z * z - 1.0) * share).reshape(2, 3).sum(axis=1) / LEARNING_COUNT
    return np.asarray(np.maximum(memory * np.exp(np.clip(growth, -0.5, 0.5)), 1.0))


class SetUp:
    """
    Check the set-up of a sensor by the weight of a held package, see `sensors.set_up`.

    Attributes
    ----------
    fault : Fault or None
        See `fault_of`.

    """

    def __init__(self, sensor: WrenchSensor) -> None:
        self._sensor = sensor
        self._still: dict[int, Still] = {}
        self.fault: Fault | None = None

    def add(self, stamp_ns: int, now: Still, weight: float) -> None:
        """Check the mean reading of a block at rest, once; the oldest of its tilt is dropped."""
        alike = [at for at, each in self._still.items()
                 if each.R_world_sensor[2] @ now.R_world_sensor[2] > COS_MIN_TILT]
        if len(alike) >= KEPT_BLOCKS:
            del self._still[alike[0]]
        self._still[stamp_ns] = now
        self.fault = fault_of(
            Still(*map(np.array, zip(*self._still.values(), strict=True))), self._sensor, weight)
