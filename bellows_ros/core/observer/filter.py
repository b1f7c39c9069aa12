"""
An error-state Kalman filter on SE(3) x R^6 with errors of cup, package, camera and noise.

The rows of the error are listed in `states`. A row without uncertainty is constant until `alarms`
detects a fault, a step in some rows.

The state is propagated through all samples of the tool with the predictor's steps. Between
measurements, the transition T of the state's error (12, n) and the covariance Q by the tool's
noise are accumulated in steps as long as the package's modes allow; the covariance is then
propagated at once.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import pose_error, substeps_for
from bellows_ros.core.model.kernels import LawTuple, ModelTuple, State, Wrench
from bellows_ros.core.model.simulation import body_row, first_after, row_state, write_row
from bellows_ros.core.observer import dynamics
from bellows_ros.core.observer.states import LENGTH, LENGTHENING, MARKER, NOISE, STATE
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

SECONDS = 0
"""Column in row `STATE` of a transition: its duration, s."""

FALL_SPEED = 1
"""First of three columns in row `STATE` of a transition: speed of a fall in the world, m/s."""

FALL = 4
"""First of three columns in row `STATE` of a transition: shift of a fall in the world, m."""

ONSETS = 12
"""Number of tested onsets of each fault."""

FALLEN = 7
"""Number of rows of the fall, after the rows of the error: see `alarms`."""

FORCE_LOSS = -FALLEN
"""Row of the lost fraction of the cup's force, the first of the fall."""

COVARIANCE_STEPS = 12
"""Largest ratio of the steps of the covariance and of the state."""

MAX_CORRELATION = 0.97
"""Largest correlation of the noise of successive measurements."""

VIEW_LENGTH = 5e-4
"""Displacement of the package at which the errors of a tag have a correlation of exp(-1/2), m."""

VIEW_ANGLE = 5e-3
"""Rotation of the package at which the errors of a tag have this correlation, rad."""

MAX_RESTING = 2.0
"""Largest motion of a package between two views that counts as rest, in standard deviations."""

MODEL_ERROR_TIME = 0.05
"""
Time by which the lip's relative twist is multiplied to a displacement, s, whose variance
represents unmodelled relaxation and damping.
"""

PERIOD = 0
"""Index in the memory of the noise: mean time between measurements, s."""

SQUARES = PERIOD + 1
"""Index in the memory of the noise: sums of squares of the noise of position and rotation, in
squared standard deviations."""

PRODUCTS = SQUARES + 2
"""Index in the memory of the noise: sums of products of successive noise of position and rotation,
in squared standard deviations."""

LAST = PRODUCTS + 2
"""Index in the memory of the noise: the last noise (6,), in standard deviations."""

FACTORS = LAST + 6
"""Index in the memory of the noise: ratios of the variances of position and rotation to the stated
variances."""

SHARE = FACTORS + 2
"""Index in the memory of the noise: variance of the model error relative to the squared
displacement of the lip."""

JITTER = SHARE + 1
"""Index in the memory of the noise: variance of the random error of a stamp, s^2."""

SAME = JITTER + 1
"""Index in the memory of the noise: correlation by the view since the last pose, 0 for bodies."""


class Evidence(NamedTuple):
    """Evidence of faults after a measurement, as the kernels take it."""

    signatures: Any
    """Signatures (n + 7, columns), in single precision for speed."""
    statistics: Array
    """Score of each signature, and products of the signature with the earlier components."""
    distances: Array
    """Sum of squared distances since each onset."""
    onsets: Stamps
    """Number of measurements since each onset, and its stamp (ns): (2, onsets)."""
    from_start: bool = True
    """Whether faults from the start are tested, because there was no alarm and no wrench."""


NO_EVIDENCE = Evidence(
    np.zeros((0, 0), np.float32), np.zeros((0, 0)), np.zeros(0), np.zeros((2, 0), np.int64))
"""Evidence without a test of faults."""


class Estimate(NamedTuple):
    """The estimated package at one stamp."""

    stamp_ns: int
    tool: State
    body: State
    theta: Array
    """Rows of the error from `MASS` on (n - 12,)."""
    covariance: Array
    """Covariance (n, n) of the error."""
    memory: Array
    """Memory (16,) of the noise, with indices from `PERIOD` on."""
    evidence: Evidence = NO_EVIDENCE
    """Evidence of faults."""
    suspect_ns: tuple[int, ...] = ()
    """Stamps (ns) since the evidence exceeded half the threshold."""
    lost_cups: tuple[int, ...] = ()
    """Lost cups of a gripper, by index among the cups that held."""
    gated_ns: tuple[int, ...] = ()
    """Stamps (ns) of consecutive measurements outside the gate."""
    away_ns: int = 0
    """Stamp of the first of consecutive measurements out of reach, after a measurement within
    reach; 0 for none, -1 after an assessment."""
    falls: bool = False
    """Whether all poses out of reach are consistent with a fall."""
    support: int = 0
    """Whether a support was `NEAR` or in `CONTACT`; 0 without."""
    contact: float = 0.0
    """Log-likelihood ratio of a contact since its likeliest begin."""
    fall: float = 0.0
    """Log-likelihood ratio of a fall near a support since its likeliest begin."""
    late_ns: int = 0
    """Shift of the last measurement before its stamp, ns."""
    wrench_memory: tuple[float, ...] = ()
    """Factors of the variances of force and moment, see `wrenches`; empty before the first."""

    @property
    def moving(self) -> Moving:
        """The moving package, as the kernels take it."""
        return self.stamp_ns, self.tool, self.body, self.theta

    def numbers(self, theta: Array) -> EstimateTuple:
        """Return the kernels' form of the estimate, with a given theta."""
        return self.stamp_ns, self.tool, self.body, theta, self.covariance, self.memory


Samples = tuple[Any, Any, Any, Any, int]
"""
Samples of the tool: arrays of stamps (ns), of tool states (13,) at begin and end of the motion
from the previous sample, and of packages; and the number of samples.
"""

Moving = tuple[int, State, State, Array]
"""Fields of a moving package: stamp (ns), tool, package and theta."""

EstimateTuple = tuple[int, State, State, Array, Array, Array]
"""Beginning of an `Estimate`: `Moving`, covariance and memory."""

Noise = tuple[Array, Array, bool]
"""
Drive of `driving`, walk of `propagated_covariance`, and whether the errors of measured poses
decorrelate with the view.
"""

Transition = tuple[Array, Array, Array]
"""
Transition (13, m), covariance of the noise (12, 12), and transitions (cups, 12, 13) without each
cup of a gripper.
"""


@kernel
def accumulate(
    A: Array, B: Array, h: float, drive: Array, T: Array, Q: Array, fall_acceleration: Vector,
    losses: Array, without_cup: Array,
) -> None:
    """
    Propagate a transition (13, m) and the noise's covariance (12, 12) over a step, in place.

    With G the mean of exp(A t) over the step, to fourth order, the error becomes (I + h A G) x + h
    G B theta. Half of the drive acts before and half after the step.

    Parameters
    ----------
    A, B : ndarray
        Sums of the results of `slopes` at both ends of the step.
    h : float
        Length of the step, s.
    drive : ndarray (12, 12)
        Half of the added covariance.
    T, Q : ndarray
        Transition and noise, updated in place.
    fall_acceleration : tuple
        Acceleration of the fall relative to the model, which holds the package (m/s^2, world).
    losses, without_cup : ndarray (6 cups, 13), (cups, 12, 13)
        Sums of results of `write_losses`, and the transitions without each cup, updated in place.

    """
    X, F, half = np.empty((12, 12)), np.empty((12, 12)), 0.5 * h
    G = identity_plus(0.25 * half, A, np.empty((12, 12)))
    for k in (3.0, 2.0):
        identity_plus(half / k, t3.product(A, G, X), G)
    identity_plus(half, t3.product(A, G, X), F)
    t3.add_array(drive, 1.0, Q)
    t3.product(F, t3.transpose(t3.product(F, Q, X)), Q)
    t3.add_array(drive, 1.0, Q)
    last, by_twist = T[STATE], np.empty((12, 6))
    for i in range(12):
        for j in range(6):
            by_twist[i, j] = half * G[i, 6 + j]
    for c in range(len(without_cup)):
        _accumulate_loss(F, by_twist, losses[6 * c:6 * c + 6], without_cup[c])
    t3.add_product(by_twist, B, t3.product(F, T[:STATE].copy(), T[:STATE]))
    for i in range(12):
        for k in range(6):
            T[i, LENGTHENING] += (last[SECONDS] + 0.5 * h) * by_twist[i, k] * B[k, LENGTH]
    _accumulate_fall(last, h, fall_acceleration)


@kernel
def _accumulate_fall(last: Any, h: float, acceleration: Vector) -> None:
    """Propagate duration, speed and shift of the fall in the last row of a transition."""
    for i in range(3):
        last[FALL + i] += h * (last[FALL_SPEED + i] + 0.5 * h * acceleration[i])
        last[FALL_SPEED + i] += h * acceleration[i]
    last[SECONDS] += h


@kernel
def _accumulate_loss(F: Any, by_twist: Any, losses: Any, without_cup: Any) -> None:
    """Propagate a transition (12, 13) without a cup, with half the sum of losses at both ends."""
    before, mean, loss = without_cup.copy(), without_cup.copy(), np.empty((6, 13))
    for _ in range(2):  # with the loss at the begin of the step, then with its mean
        t3.product(losses, mean, loss)
        for i in range(6):
            loss[i, 12] += losses[i, 12]
            for j in range(13):
                loss[i, j] = -loss[i, j]
        t3.add_product(by_twist, loss, t3.product(F, before, without_cup))
        for i in range(12):
            for j in range(13):
                mean[i, j] = 0.5 * (before[i, j] + without_cup[i, j])


@kernel
def identity_plus(factor: float, A: Array, out: Array) -> Array:
    """Write I + factor A, and return it."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = factor * A[i, j]
        out[i, i] += 1.0
    return out


@kernel
def identity_transition() -> Array:
    """Return the transition (13, m) over no time, of the rows that change the motion."""
    T = np.zeros((STATE + 1, MARKER))
    for i in range(STATE):
        T[i, i] = 1.0
    return T


@kernel
def times_transition(T: Any, B: Any, out: Any) -> Any:
    """Write the product (12, k) of a transition (13, m) and errors (n, k), and return it."""
    return t3.product(T[:STATE], B[:MARKER], out)


@kernel
def carry_theta(columns: Array, seconds: float, correlation: tuple[float, float]) -> None:
    """Propagate theta, or derivatives of its rows (n - 12, m), in place."""
    for c in range(columns.shape[1]):
        columns[LENGTH - STATE, c] += seconds * columns[LENGTHENING - STATE, c]
        for i in range(6):
            columns[NOISE - STATE + i, c] *= correlation[i // 3]


@kernel
def correlations(memory: Array, seconds: float) -> tuple[float, float]:
    """
    Return the correlation of the noise over a time (s), of position and of rotation.

    Indices of the memory are `PERIOD` to `JITTER`.
    """
    rate = seconds / memory[PERIOD]
    return (_correlation(memory[PRODUCTS] / memory[SQUARES], rate),
            _correlation(memory[PRODUCTS + 1] / memory[SQUARES + 1], rate))


@kernel
def _correlation(of_next: float, rate: float) -> float:
    return math.exp(math.log(min(max(of_next, 1e-3), MAX_CORRELATION)) * rate)


@kernel
def propagated_covariance(
    P: Array, T: Array, Q: Array, walk: Array, correlation: tuple[float, float]
) -> Array:
    """
    Return the covariance (n, n) after a transition, with half of the walk before it.

    The walk (n,) is the variance per second of each row.
    """
    n, h, out = len(P), T[STATE, SECONDS], P.copy()
    side = times_transition(T, P, out[:STATE])
    for i in range(STATE, n):
        out[i, i] += h * walk[i]
        for j in range(STATE if i < MARKER and walk[i] > 0.0 else 0):
            side[j, i] += 0.5 * h * walk[i] * T[j, i]
    square = times_transition(T, t3.transpose(side), np.empty((STATE, STATE)))
    for i in range(STATE):
        for j in range(STATE):
            side[i, j] = square[i, j] + Q[i, j]
    t3.add_array(out[LENGTHENING:LENGTHENING + 1], h, out[LENGTH:LENGTH + 1])
    for i in range(n):  # equal rounding of both halves
        out[i, LENGTH] += h * out[i, LENGTHENING]
        a = correlation[(i - NOISE) // 3] if 0 <= i - NOISE < 6 else 1.0
        for j in range(6):
            out[i, NOISE + j] *= a * correlation[j // 3]
        for j in range(min(i, STATE)):
            out[i, j] = out[j, i]
    for i in range(6):
        for j in range(STATE, n):
            out[NOISE + i, j] = out[j, NOISE + i]
        out[NOISE + i, NOISE + i] += 1.0 - correlation[i // 3] ** 2
    return out


@kernel
def ends_step(stamp_ns: int, next_ns: int, max_step: float) -> bool:
    """Return whether a covariance step ends at a sample, wherever the step began."""
    length_ns = int(NS_PER_S * min(COVARIANCE_STEPS * max_step, 1.0))
    return stamp_ns // length_ns != next_ns // length_ns


@kernel
def _is_inside_step(stamps: Any, k: int, until_ns: int, max_step: float) -> bool:
    """Return whether a covariance step continues after the whole of sample k."""
    seconds = (stamps[k] - stamps[k - 1]) / NS_PER_S
    return stamps[k] < until_ns and seconds <= COVARIANCE_STEPS * max_step and (
        not ends_step(stamps[k], stamps[k + 1], max_step))


@kernel
def part_of_motion(
    samples: Samples, k: int, now_ns: int, until_ns: int, tool: State, max_step: float
) -> tuple[State, State, int]:
    """Return the tool at both ends of the next part of its motion to sample k, and the later."""
    stamps, starts, ends, _, _ = samples
    whole_ns, tool_end = stamps[k] - stamps[k - 1], row_state(ends[k])
    if now_ns == stamps[k - 1]:
        tool = row_state(starts[k])
    later_ns = min(stamps[k], until_ns)
    parts = substeps_for((later_ns - now_ns) / NS_PER_S, COVARIANCE_STEPS * max_step)
    later_ns = now_ns + (later_ns - now_ns) // parts
    if later_ns < stamps[k]:
        segment = kernels.tool_segment(row_state(starts[k]), tool_end, whole_ns / NS_PER_S)
        tool_end = kernels.tool_at(segment, (later_ns - stamps[k - 1]) / whole_ns)
    return tool, tool_end, later_ns


@kernel
def _half_of_drive(
    model: ModelTuple, tool: State, body: State, drive: Array, squares: float, model_error: float
) -> Array:
    """Return half of the added covariance of a step, see `propagated`."""
    _, _, _, v, w, _, _, _ = jac.ends_of_spring(model, tool, body)
    half: Array = 0.5 * (squares * drive[0] + model_error * (
        t3.dot(v, v) * drive[1] + t3.dot(w, w) * drive[2]))
    return half


@kernel
def propagated(
    model: ModelTuple, beginning: Moving, transition: Transition, samples: Samples,
    is_recorded: bool, until_ns: int, max_step: float, drive: Array, model_error: float,
    cups: Array,
) -> tuple[State, State]:
    """
    Return tool and package at a later stamp, with transition and noise propagated in place.

    Parameters
    ----------
    model, beginning : tuple
        Nominal model, and the estimate at the beginning.
    transition, samples : tuple
        Transition, updated in place, or empty; and the tool's samples.
    is_recorded : bool
        Whether the package is read from samples that it has passed, or written to new ones.
    until_ns : int
        Stamp of the end, ns.
    max_step : float
        Longest step of the nominal state, s.
    drive : ndarray (3, 12, 12)
        Result of `driving`.
    model_error : float
        Intensity of a displacement of the tool per squared twist of the lip, s^3.
    cups : ndarray (cups, 54)
        Cups of a gripper, see `cups_of`.

    """
    (now_ns, tool, body, theta), (T, Q, without_cup) = beginning, transition
    stamps, _, _, bodies, count = samples
    k, max_step = first_after(stamps, now_ns, count), dynamics.stable_step(max_step, theta)
    bias = dynamics.wrench_bias(theta)
    nominal, model = model, dynamics.with_theta(model, theta)
    follows, is_reset, h, squares = T.shape[0] > 0, True, 0.0, 0.0
    A0, B0 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    A1, B1 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    losses0, losses1 = np.zeros((6 * len(without_cup), 13)), np.zeros((6 * len(without_cup), 13))
    while True:
        if follows and (is_reset or now_ns == until_ns or now_ns != stamps[k - 1] or ends_step(
                now_ns, stamps[k], max_step)):
            force = dynamics.slopes(model, bias, math.exp(theta[0]), tool, body, A1, B1)
            dynamics.write_losses(nominal, theta, cups[:len(without_cup)], tool, body, losses1)
            if not is_reset:
                t3.add_array(A1, 1.0, A0)
                t3.add_array(B1, 1.0, B0)
                t3.add_array(losses1, 1.0, losses0)
                half = _half_of_drive(model, tool, body, drive, squares, h * model_error)
                accumulate(A0, B0, h, half, T, Q, t3.scale(-1.0 / model[1][0], force), losses0,
                           without_cup)
            A0, B0, losses0, A1, B1, losses1 = A1, B1, losses1, A0, B0, losses0
            is_reset, h, squares = False, 0.0, 0.0
        if now_ns >= until_ns:
            return tool, body
        first = k
        while is_recorded and now_ns == stamps[k - 1] and _is_inside_step(
                stamps, k, until_ns, max_step):
            part = (stamps[k] - now_ns) / NS_PER_S
            h, squares, now_ns, k = h + part, squares + part * part, stamps[k], k + 1
        if k > first:
            body = body_row(bodies[k - 1], body)
        tool, tool_end, later_ns = part_of_motion(samples, k, now_ns, until_ns, tool, max_step)
        part = (later_ns - now_ns) / NS_PER_S
        body = _followed(
            model, bias, body, tool, tool_end, part, max_step, bodies[k], is_recorded,
            later_ns == stamps[k])
        h, squares = h + part, squares + part * (stamps[k] - stamps[k - 1]) / NS_PER_S
        tool, now_ns = tool_end, later_ns
        if now_ns == stamps[k]:
            k += 1


@kernel
def correlation_of_view(before: State, after: State, P: Array, T: Array) -> float:
    """
    Return the correlation of the errors of a tag in two views, at two states of the body.

    A motion within its uncertainty by the covariance P (n, n) and the transition T (13, m) counts
    as rest.
    """
    shift, turn = pose_error(before, after[0], after[1])
    squares = t3.dot(shift, shift), t3.dot(turn, turn)
    change, exponent = T[:6, :STATE].copy(), 0.0
    for i in range(6):
        change[i, i] -= 1.0
    variances = t3.product(change, P[:STATE, :STATE].copy(), np.empty((6, STATE)))
    for k in range(2):
        variance = 0.0
        for i in range(3 * k, 3 * k + 3):
            for j in range(STATE):
                variance += variances[i, j] * change[i, j]
        scale = VIEW_ANGLE if k else VIEW_LENGTH
        exponent += max(squares[k] - MAX_RESTING**2 * variance, 0.0) / (scale * scale)
    return math.exp(-0.5 * exponent)


@kernel
def predicted(
    model: ModelTuple, estimate: EstimateTuple, samples: Samples, is_recorded: bool, until_ns: int,
    max_step: float, noise: Noise, signatures: Any, cups: Array,
) -> tuple[EstimateTuple, Any, Array]:
    """
    Return an estimate at a later stamp, signatures of faults, and the gain in covariance (12, 12).

    The gain of the state is by the noise of the tool and the model error.
    """
    now_ns, tool, body, theta, P, memory = estimate
    drive, walk, is_tag = noise
    T, Q, theta = identity_transition(), np.zeros((STATE, STATE)), theta.copy()
    model_error = memory[SHARE] * MODEL_ERROR_TIME**3
    correlation, earlier = correlations(memory, (until_ns - now_ns) / NS_PER_S), body
    without_cup = np.zeros((len(cups) if len(signatures) > 0 else 0, STATE, STATE + 1))
    for c in range(len(without_cup)):
        for i in range(STATE):
            without_cup[c, i, i] = 1.0
    tool, body = propagated(
        model, (now_ns, tool, body, theta), (T, Q, without_cup), samples, is_recorded, until_ns,
        max_step, drive, model_error, cups)
    if is_tag:
        memory = memory.copy()
        memory[SAME] = of_view = correlation_of_view(earlier, body, P, T)
        correlation = max(correlation[0], of_view), max(correlation[1], of_view)
    P = propagated_covariance(P, T, Q, walk, correlation)
    carry_theta(theta.reshape((-1, 1)), T[STATE, SECONDS], correlation)
    if len(signatures) > 0:
        signatures = propagated_signatures(signatures, T, correlation, without_cup)
    return (until_ns, tool, body, theta, P, memory), signatures, Q


@kernel
def propagated_signatures(
    E: Any, T: Array, correlation: tuple[float, float], without_cup: Array
) -> Any:
    """
    Return the signatures of faults (n + 7, columns) after a transition (13, m).

    The last columns belong to lost cups, one group for each transition (12, 13) without a cup.
    """
    n, last, out = len(E) - FALLEN, T[STATE], E.copy()
    times_transition(T.astype(np.float32), E[:n], out[:STATE])
    carry_theta(out[STATE:n], last[SECONDS], correlation)
    fall_acceleration = np.zeros((6, FALLEN), np.float32)
    for i in range(3):
        fall_acceleration[i, 0], fall_acceleration[3 + i, 0] = last[FALL_SPEED + i], last[FALL + i]
        fall_acceleration[3 + i, 1 + i] = last[SECONDS]
    t3.add_product(fall_acceleration, E[n:], out[n + 1:])
    first = E.shape[1] - len(without_cup) * ONSETS
    for c in range(len(without_cup)):
        other = (without_cup[c, :, :STATE] - T[:STATE, :STATE]).astype(np.float32)
        columns = slice(first + c * ONSETS, first + (c + 1) * ONSETS)
        for i in range(STATE):
            row = out[i, columns]
            row += np.float32(without_cup[c, i, STATE])
            for j in range(STATE):
                row += other[i, j] * E[j, columns]
    return out


@kernel
def _followed(
    model: ModelTuple, bias: Wrench, body: State, start: State, end: State, seconds: float,
    max_step: float, row: Any, is_recorded: bool, is_sample: bool,
) -> State:
    """Return a state after a motion of the tool, read from or written to a sample's row."""
    if is_recorded and is_sample:
        return body_row(row, body)
    substeps = substeps_for(seconds, max_step)
    body = dynamics.advanced_with_wrench(model, bias, body, start, end, seconds, substeps)
    if is_sample:
        write_row(row, body)
    return body


@entry
def followed(
    row: Any, law: LawTuple, theta: Array, body: State, samples: Samples,
    stamp_ns: int, start: State, end: State, max_step: float, reach: float,
) -> tuple[State, Wrench, bool]:
    """Store another sample of the tool; return the package there, and `checked_wrench`."""
    model, max_step = dynamics.model_at(row, law, theta), dynamics.stable_step(max_step, theta)
    stamps, starts, ends, bodies, k = samples
    stamps[k] = stamp_ns
    write_row(starts[k], start)
    write_row(ends[k], end)
    seconds, tool, bias = (stamp_ns - stamps[k - 1]) / NS_PER_S, start, dynamics.wrench_bias(theta)
    parts = substeps_for(seconds, COVARIANCE_STEPS * max_step)
    part = seconds / parts
    for i in range(parts):
        tool_end = end
        if i < parts - 1:
            tool_end = kernels.tool_at(kernels.tool_segment(start, end, seconds), (i + 1) / parts)
        body = dynamics.advanced_with_wrench(
            model, bias, body, tool, tool_end, part, substeps_for(part, max_step))
        tool = tool_end
    write_row(bodies[k], body)
    wrench, is_sound = kernels.checked_wrench(model, end, body, reach)
    return body, wrench, is_sound


@entry
def body_at_end(
    row: Any, law: LawTuple, beginning: Moving, samples: Samples, until_ns: int,
    max_step: float,
) -> State:
    """Return the package of an estimate at a later stamp, and write it into the samples."""
    none = np.zeros((0, 0))
    return propagated(
        kernels.model_of(row, law), beginning, (none, none, np.zeros((0, 12, 13))), samples,
        False, until_ns, max_step, np.zeros((0, 0, 0)), 0.0, np.zeros((0, 54)))[1]
