"""
An error-state Kalman filter on SE(3) x R^6 with errors of cup, package, camera and noise.

The rows of the error are listed in `states`. A row without uncertainty is constant.

The state is propagated through all samples of the tool with the predictor's steps. Between
measurements, the transition T of the state's error (12, n) and the covariance Q by the tool's
noise are accumulated in steps as long as the package's modes allow; the covariance is then
propagated at once.
"""

from __future__ import annotations

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import pose_error, substeps_for
from bellows_ros.core.model.kernels import LawTuple, ModelTuple, State, Wrench
from bellows_ros.core.model.simulation import body_row, first_after, row_state, write_row
from bellows_ros.core.observer import dynamics
from bellows_ros.core.observer.states import MARKER, NOISE, STATE
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

MIN_SAMPLES = 4096
"""Smallest size of the buffer of tool samples, a few seconds."""

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

COUNT = SAME + 1
"""Index in the memory of the noise: number of measurements from which the noise is known."""


Samples = tuple[Any, Any, Any, Any, int]
"""
Samples of the tool: arrays of stamps (ns), of tool states (13,) at begin and end of the motion
from the previous sample, and of packages; and the number of samples.
"""

Moving = tuple[int, State, State, Array]
"""Fields of a moving package: stamp (ns), tool, package and theta."""

EstimateTuple = tuple[int, State, State, Array, Array, Array]
"""Fields of an estimate: `Moving`, covariance and memory."""

Noise = tuple[Array, Array, bool]
"""
Drive of `driving`, walk of `propagated_covariance`, and whether the errors of measured poses
decorrelate with the view.
"""


class Track:
    """
    The recent tool samples and the package at each, as the kernels take them.

    Attributes
    ----------
    rows : tuple of array or list
        Stamp (ns), tool at begin and end of the motion from the previous sample, and package (with
        internal strains, if any), of each sample.
    count, newest_ns : int
        Number of samples, and stamp of the newest.

    """

    def __init__(self) -> None:
        self._allocate(MIN_SAMPLES)
        self.count = self.newest_ns = 0

    def _allocate(self, size: int) -> None:
        stamps, (starts, ends) = np.zeros(size, np.int64), np.zeros((2, size, 13))
        self.rows = as_inputs(stamps, starts, ends, np.zeros((size, 25)))

    def begin(self, stamp_ns: int, tool: State, body: State) -> None:
        """Discard all but the start of a motion."""
        self.count = 0
        self.add(stamp_ns, tool, tool, body)

    def add(self, stamp_ns: int, start: State, end: State, body: State) -> None:
        """Store a sample of tool and package."""
        stamps, starts, ends, bodies = self.rows
        stamps[self.count] = stamp_ns
        for rows, state in ((starts, start), (ends, end), (bodies, body)):
            write_row(rows[self.count], state)
        self.count, self.newest_ns = self.count + 1, stamp_ns

    @property
    def samples(self) -> Samples:
        """All samples, as kernels take them."""
        return *self.rows, self.count

    def after(self, stamp_ns: int) -> int:
        """Return the index of the first sample after a stamp."""
        return int(first_after(self.rows[0], stamp_ns, self.count))

    def discard_before(self, since_ns: int) -> None:
        """Make room for another sample by discarding samples before a stamp."""
        if self.count < len(self.rows[0]):
            return
        before, first, end = self.rows, self.after(since_ns) - 1, self.count
        self.count = end - first
        self._allocate(max(MIN_SAMPLES, 4 * self.count))
        for old, new in zip(before, self.rows, strict=True):
            new[:self.count] = old[first:end]


@kernel
def accumulate(A: Array, B: Array, h: float, drive: Array, T: Array, Q: Array) -> None:
    """
    Propagate a transition (12, m) and the noise's covariance (12, 12) over a step, in place.

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

    """
    X, F, half = np.empty((12, 12)), np.empty((12, 12)), 0.5 * h
    G = identity_plus(0.25 * half, A, np.empty((12, 12)))
    for k in (3.0, 2.0):
        identity_plus(half / k, t3.product(A, G, X), G)
    identity_plus(half, t3.product(A, G, X), F)
    t3.add_array(drive, Q)
    t3.product(F, t3.transpose(t3.product(F, Q, X)), Q)
    t3.add_array(drive, Q)
    by_twist = np.empty((12, 6))
    for i in range(12):
        for j in range(6):
            by_twist[i, j] = half * G[i, 6 + j]
    t3.add_product(by_twist, B, t3.product(F, T.copy(), T))


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
    """Return the transition (12, m) over no time, of the rows that change the motion."""
    T = np.zeros((STATE, MARKER))
    for i in range(STATE):
        T[i, i] = 1.0
    return T


@kernel
def correlations(memory: Array, seconds: float) -> tuple[float, float]:
    """
    Return the correlation of the noise over a time (s), of position and of rotation.

    Indices of the memory are `PERIOD` to `COUNT`.
    """
    rate = seconds / memory[PERIOD]
    return (_correlation(memory[PRODUCTS] / memory[SQUARES], rate),
            _correlation(memory[PRODUCTS + 1] / memory[SQUARES + 1], rate))


@kernel
def _correlation(of_next: float, rate: float) -> float:
    return math.exp(math.log(min(max(of_next, 1e-3), MAX_CORRELATION)) * rate)


@kernel
def propagated_covariance(
    P: Array, T: Array, Q: Array, h: float, walk: Array, correlation: tuple[float, float],
    factors: Array,
) -> Array:
    """
    Return the covariance (n, n) after a transition in a time h (s), half of the walk before it.

    The walk (n,) is the variance per second of each row; the factors (2,) are the variances of the
    noise of position and rotation.
    """
    n, out = len(P), P.copy()
    side = t3.product(T, P[:MARKER], out[:STATE])
    for i in range(STATE, n):
        out[i, i] += h * walk[i]
        for j in range(STATE if i < MARKER and walk[i] > 0.0 else 0):
            side[j, i] += 0.5 * h * walk[i] * T[j, i]
    square = t3.product(T, t3.transpose(side)[:MARKER], np.empty((STATE, STATE)))
    for i in range(STATE):
        for j in range(STATE):
            side[i, j] = square[i, j] + Q[i, j]
    for i in range(n):  # equal rounding of both halves
        a = correlation[(i - NOISE) // 3] if 0 <= i - NOISE < 6 else 1.0
        for j in range(6):
            out[i, NOISE + j] *= a * correlation[j // 3]
        for j in range(min(i, STATE)):
            out[i, j] = out[j, i]
    for i in range(6):
        for j in range(STATE, n):
            out[NOISE + i, j] = out[j, NOISE + i]
        out[NOISE + i, NOISE + i] += factors[i // 3] * (1.0 - correlation[i // 3] ** 2)
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
    _, _, v, w = kernels.lip_relative_to_tool(model[1][1], tool, body)
    half: Array = 0.5 * (squares * drive[0] + model_error * (
        t3.dot(v, v) * drive[1] + t3.dot(w, w) * drive[2]))
    return half


@kernel
def propagated(
    nominal: ModelTuple, beginning: Moving, T: Array, Q: Array, samples: Samples,
    until_ns: int, max_step: float, drive: Array, model_error: float,
) -> tuple[State, State]:
    """
    Return tool and package at a later stamp, with transition and noise propagated in place.

    Parameters
    ----------
    nominal, beginning : tuple
        Nominal model, and the estimate at the beginning.
    T, Q : ndarray (12, m), (12, 12)
        Transition and covariance of the noise, updated in place.
    samples : tuple
        Samples of the tool, with the package as `followed` has written it.
    until_ns : int
        Stamp of the end, ns.
    max_step : float
        Longest step of the nominal state, s.
    drive : ndarray (3, 12, 12)
        Result of `driving`.
    model_error : float
        Intensity of a displacement of the tool per squared twist of the lip, s^3.

    """
    now_ns, tool, body, theta = beginning
    stamps, _, _, bodies, count = samples
    k, max_step = first_after(stamps, now_ns, count), dynamics.stable_step(max_step, theta)
    model, bias = dynamics.with_theta(nominal, theta), dynamics.wrench_bias(theta)
    is_reset, h, squares = True, 0.0, 0.0
    A0, B0 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    A1, B1 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    while True:
        if is_reset or now_ns == until_ns or now_ns != stamps[k - 1] or ends_step(
                now_ns, stamps[k], max_step):
            dynamics.slopes(nominal, theta, tool, body, A1, B1)
            if not is_reset:
                t3.add_array(A1, A0)
                t3.add_array(B1, B0)
                half = _half_of_drive(model, tool, body, drive, squares, h * model_error)
                accumulate(A0, B0, h, half, T, Q)
            A0, B0, A1, B1 = A1, B1, A0, B0
            is_reset, h, squares = False, 0.0, 0.0
        if now_ns >= until_ns:
            return tool, body
        first = k
        while now_ns == stamps[k - 1] and _is_inside_step(
                stamps, k, until_ns, max_step):
            part = (stamps[k] - now_ns) / NS_PER_S
            h, squares, now_ns, k = h + part, squares + part * part, stamps[k], k + 1
        if k > first:
            body = body_row(bodies[k - 1], body)
        tool, tool_end, later_ns = part_of_motion(samples, k, now_ns, until_ns, tool, max_step)
        part = (later_ns - now_ns) / NS_PER_S
        if later_ns == stamps[k]:
            body = body_row(bodies[k], body)
        else:
            body = dynamics.advanced_with_wrench(
                model, bias, body, tool, tool_end, part, substeps_for(part, max_step))
        h, squares = h + part, squares + part * (stamps[k] - stamps[k - 1]) / NS_PER_S
        tool, now_ns = tool_end, later_ns
        if now_ns == stamps[k]:
            k += 1


@kernel
def correlation_of_view(before: State, after: State, P: Array, T: Array) -> float:
    """
    Return the correlation of the errors of a tag in two views, at two states of the body.

    A motion within its uncertainty by the covariance P (n, n) and the transition T (12, m) counts
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
    model: ModelTuple, estimate: EstimateTuple, samples: Samples, until_ns: int, max_step: float,
    noise: Noise,
) -> tuple[EstimateTuple, Array]:
    """
    Return an estimate at a later stamp, and the gain in covariance (12, 12).

    The gain of the state is by the noise of the tool and the model error.
    """
    now_ns, tool, body, theta, P, memory = estimate
    drive, walk, is_tag = noise
    T, Q, theta = identity_transition(), np.zeros((STATE, STATE)), theta.copy()
    model_error, seconds = memory[SHARE] * MODEL_ERROR_TIME**3, (until_ns - now_ns) / NS_PER_S
    correlation, earlier = correlations(memory, seconds), body
    tool, body = propagated(
        model, (now_ns, tool, body, theta), T, Q, samples, until_ns, max_step, drive, model_error)
    if is_tag:
        memory = memory.copy()
        memory[SAME] = of_view = correlation_of_view(earlier, body, P, T)
        correlation = max(correlation[0], of_view), max(correlation[1], of_view)
    P = propagated_covariance(
        P, T, Q, seconds, walk, correlation, memory[FACTORS:FACTORS + 2])
    for i in range(6):
        theta[NOISE - STATE + i] *= correlation[i // 3]
    return (until_ns, tool, body, theta, P, memory), Q


@entry
def followed(
    row: Any, law: LawTuple, beginning: Moving, samples: Samples, stamp_ns: int, end: State,
    max_step: float, reach: float,
) -> tuple[State, Wrench, bool]:
    """
    Write the package at all samples of the tool after the beginning.

    With a stamp (ns), the last sample is first written: a motion of the tool from the beginning to
    an end. The result has the package at the last sample, and `checked_wrench`.
    """
    stamps, starts, ends, bodies, count = samples
    now_ns, tool, body, theta = beginning
    if stamp_ns > 0:
        stamps[count - 1] = stamp_ns
        write_row(starts[count - 1], tool)
        write_row(ends[count - 1], end)
    stamp_ns = stamps[count - 1]
    model, max_step = dynamics.model_at(row, law, theta), dynamics.stable_step(max_step, theta)
    k, bias = first_after(stamps, now_ns, count), dynamics.wrench_bias(theta)
    while now_ns < stamp_ns:
        tool, tool_end, later_ns = part_of_motion(samples, k, now_ns, stamp_ns, tool, max_step)
        part = (later_ns - now_ns) / NS_PER_S
        body = dynamics.advanced_with_wrench(
            model, bias, body, tool, tool_end, part, substeps_for(part, max_step))
        tool, now_ns = tool_end, later_ns
        if now_ns == stamps[k]:
            write_row(bodies[k], body)
            k += 1
    wrench, is_sound = kernels.checked_wrench(model, end, body, reach)
    return body, wrench, is_sound
