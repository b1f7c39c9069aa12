"""
An error-state Kalman filter on SE(3) x R^6, including the errors of an ordinary cell.

The rows of the error have the names below: pose and twist of the package in its own axes, as in
`jacobians`; parameters of the model, which change its motion; and errors of measured poses. All
rows but the state are the vector theta. A row without uncertainty is constant until `alarms`
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
from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector, ZERO
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import linearise, substeps_for
from bellows_ros.core.model.jacobians import Square
from bellows_ros.core.model.kernels import Blocks, LawTuple, ModelTuple, State, Wrench
from bellows_ros.core.model.simulation import body_row, first_after, row_state, write_row
from bellows_ros.core.recording.measurement_model import Sensor, sizes_of
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

SHIFT, TURN, SPEED, SPIN, MASS, COM, WRENCH = 0, 3, 6, 9, 12, 13, 16
"""
Rows of shift (m), rotation (rad), linear and angular twist (m/s, rad/s); logarithm of mass and
inertia; centre of mass (m); and additional wrench on the package at the lip, in S axes, at the
nominal mass, proportional to the mass (N, N m).
"""

LENGTH, LENGTHENING, STIFFNESS = 22, 23, 24
"""
Rows of the cup's length (m) and its rate (m/s), and of the logarithms s of K along each axis,
exp(s/2) K exp(s/2). A common scale of K, P, mass, inertia and wrench does not change the motion
and is not observable. In logarithms this direction of the error is constant; otherwise the filter
would take noise for information on the scale.
"""

MARKER, CAMERA, LATENCY, NOISE = 30, 36, 42, 43
"""
Rows of the pose of the marker in B axes, and of the camera in the world (m, rad); of the delay of
stamps (s); and of the noise with memory of the measured pose, in B axes (m, rad).
"""

DAMPING, INERTIA, ROWS = 49, 55, 58
"""Rows of the logarithms of P along each axis, and of the moments of inertia at the nominal mass
(kg m^2); number of rows."""

STATE = 12
SECONDS, FALL_SPEED, FALL = 0, 1, 4
"""Columns in row `STATE` of a transition: its duration, and speed and shift of the fall (m/s, m;
world)."""

ONSETS = 12
"""Number of tested onsets of each fault."""

FALLEN = 7
"""Number of rows of the fall, after the rows of the error: see `alarms`."""

FORCE_LOSS = -FALLEN
"""Row of the lost fraction of the cup's force, the first of the fall."""

COVARIANCE_STEPS = 12
"""Largest ratio of the steps of the covariance and of the state."""

STEP_MARGIN = 1.5
"""Factor by which the fastest mode may become faster before steps are shortened."""

NO_MATRIX: Array = np.zeros((0, 0))
"""Placeholder for a transition and a covariance that are not computed."""

MAX_CORRELATION = 0.97
"""Largest correlation of the noise of successive measurements."""

VIEW_LENGTH = 0.15
"""Path of a tag over which the correlation of its errors decays to 1 / e, m."""

VIEW_ANGLE = 0.1
"""Rotation of a tag over which the correlation of its errors falls to 1 / e, rad."""

STILL_TIME = 5.0
"""Time over which the correlation of the errors of a tag at rest decays to 1 / e, s."""

MODEL_ERROR_TIME = 0.05
"""
Time over which the lip's relative twist gives the displacement equivalent to the model error, s:
unmodelled relaxation and damping are forces proportional to the displacement.
"""

SHARE, JITTER = 13, 14
"""
Indices in the memory: variance of the model error relative to the lip's displacement, and variance
of the random error of a stamp (s^2).
"""


class Evidence(NamedTuple):
    """Evidence of faults after a measurement."""

    signatures: Any
    """Signatures (n + 7, columns), in single precision for speed."""
    statistics: Array
    """Score of each signature, and its products with the components up to its own."""
    distances: Array
    """Sum of squared distances since each onset."""
    onsets: Stamps
    """Number of measurements since each onset, and its stamp (ns): (2, onsets)."""
    suspect_ns: tuple[int, ...] = ()
    """Stamps since half the threshold, ns."""
    from_start: bool = True
    """Whether faults from the start are tested: no alarm has been raised."""


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
    """Memory (15,) of the noise, see `correlations`."""
    evidence: Evidence = NO_EVIDENCE
    """Evidence of faults."""
    lost_cups: tuple[int, ...] = ()
    """Lost cups of a gripper, by index among the cups that held."""
    gated_ns: tuple[int, ...] = ()
    """Stamps (ns) of consecutive measurements outside the gate."""
    away_ns: int = 0
    """Stamp of the first of consecutive measurements out of reach, after one within reach; 0 for
    none, -1 after their assessment."""
    falls: bool = False
    """Whether all poses out of reach are consistent with a fall."""
    is_supported: bool = False
    """Whether a support may have carried the package."""
    late_ns: int = 0
    """Shift of the last measurement before its stamp, ns."""


Samples = tuple[Any, Any, Any, Any, int]
"""
Samples of the tool: stamp (ns), states (13,) at begin and end of its motion from the previous
sample, and the package, of each; and their number.
"""

Moving = tuple[int, State, State, Array]
"""Stamp (ns), tool, package and theta."""

EstimateTuple = tuple[int, State, State, Array, Array, Array]
"""Beginning of an `Estimate`: `Moving`, covariance and memory."""

Noise = tuple[Array, Array, Sensor]
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
def with_theta(model: ModelTuple, theta: Array) -> ModelTuple:
    """Return a model with its parameters changed by theta."""
    cup, (mass, com, inertia, inverse), gravity = model
    k, longer = math.exp(theta[0]), theta[LENGTH - STATE]
    (oo, oR, RR), P = _scaled(cup[2], theta[STIFFNESS - STATE:]), cup[3]
    P = _scaled(P, theta[DAMPING - STATE:])
    x, y, z = theta[INERTIA - STATE], theta[INERTIA - STATE + 1], theta[INERTIA - STATE + 2]
    more = (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)
    inertia = t3.add_scaled_matrix(inertia, 1.0, more)
    inverse = t3.add_scaled_matrix(
        inverse, -1.0, t3.multiply(inverse, t3.multiply(more, inverse)))
    return (cup[0] + 0.5 * longer, cup[1] + longer, (oo, oR, RR, *cup[2][3:]), P, *cup[4:]), (
        k * mass, t3.add(com, (theta[1], theta[2], theta[3])), t3.scale_matrix(k, inertia),
        t3.scale_matrix(1.0 / k, inverse)), gravity


@kernel
def model_at(row: Any, law: LawTuple, theta: Array) -> ModelTuple:
    """Return the model of `kernels.model_of` with its parameters changed by theta."""
    return with_theta(kernels.model_of(row, law), theta)


@kernel
def _scaled(M: Blocks, s: Array) -> tuple[Matrix, Matrix, Matrix]:
    """Return exp(s / 2) M exp(s / 2), with s (6,) on a diagonal."""
    a = math.exp(0.5 * s[0]), math.exp(0.5 * s[1]), math.exp(0.5 * s[2])
    b = math.exp(0.5 * s[3]), math.exp(0.5 * s[4]), math.exp(0.5 * s[5])
    return _scaled_block(M[0], a, a), _scaled_block(M[1], a, b), _scaled_block(M[2], b, b)


@kernel
def _scaled_block(A: Matrix, a: Vector, b: Vector) -> Matrix:
    """Return a 3x3 block of `_scaled`."""
    return (
        A[0] * a[0] * b[0], A[1] * a[0] * b[1], A[2] * a[0] * b[2],
        A[3] * a[1] * b[0], A[4] * a[1] * b[1], A[5] * a[1] * b[2],
        A[6] * a[2] * b[0], A[7] * a[2] * b[1], A[8] * a[2] * b[2])


@kernel
def stable_step(max_step: float, theta: Array) -> float:
    """Return the longest step (s) for a model changed by theta, shorter if much stiffer."""
    stiffer = damped = 0.0
    for i in range(6):
        stiffer = max(stiffer, theta[STIFFNESS - STATE + i] - theta[0])
        damped = max(damped, theta[DAMPING - STATE + i] - theta[0])
    return max_step * min(1.0, STEP_MARGIN * math.exp(-max(0.5 * stiffer, damped)))


@kernel
def wrench_bias(theta: Array) -> Wrench:
    """Return the additional wrench (N, N m)."""
    k = math.exp(theta[0])
    return t3.scale(k, (theta[4], theta[5], theta[6])), t3.scale(
        k, (theta[7], theta[8], theta[9]))


def driving(model: ModelTuple, tool: State, body: State, noise: Array) -> Array:
    """
    Return the covariances of the state by white noise (6,) of the tool, held for 1 s.

    They are (3, 12, 12): by all noise, and by position and rotation alone with unit variance.

    The tool's twist is the derivative of its noise e. Integrated by parts, its slope T_v is
    equivalent to the slope A T_v of e. The derivatives are linearised about a state.
    """
    by = linearise(model, tool, body)
    drive = np.vstack([by.tool_twist, by.tool_pose + by.body_twist @ by.tool_twist])
    each = noise, np.repeat([1.0, 0.0], 3), np.repeat([0.0, 1.0], 3)
    return np.stack([drive * np.square(std) @ drive.T for std in each])


@kernel
def advanced_with_wrench(
    model: ModelTuple, bias: Wrench, body: State, start: State, end: State, seconds: float,
    substeps: int,
) -> State:
    """Return a state after a motion of the tool, with half of the push before and half after."""
    dv, dw = jac.acceleration_at(model[1], model[1][1], bias[0], bias[1])
    dv, dw = t3.scale(0.5 * seconds, dv), t3.scale(0.5 * seconds, dw)
    body = kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))
    body = kernels.advance(model, body, start, end, seconds, substeps)
    return kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))


@array_kernel
def slopes(
    model: ModelTuple, bias: Wrench, mass_ratio: float, tool: State, body: State, A: Array,
    B: Array,
) -> Vector:
    """
    Write the slope of the state's error, and return the force of the cup in the world (N).

    Parameters
    ----------
    model, bias, tool, body : tuples
        Tuples with the estimated parameters.
    mass_ratio : float
        Ratio of the mass to the nominal one.
    A : ndarray (12, 12)
        Slope by the state's error: pose and twist change in axes that rotate with the body.
    B : ndarray (6, m)
        Slope of the twist's error by the other rows; m as in `identity_transition`.

    """
    package, com, turning = model[1], model[1][1], body[3]
    jac.write_slope(model, tool, body, A)
    f, m = kernels.lip_wrench(model, tool, body)
    c, o, R, v, w, _, _, _ = jac.ends_of_spring(model, tool, body)
    B[:, STIFFNESS:] = 0.0
    h = kernels.effective_strain(kernels.strain(o, R), model[0][4:], body[4:])
    J_oo, J_oR, J_RR = jac.strain_jacobian(o, R)
    _by_axes(-0.125, model[0][2], jac.accelerations(package, jac.shift_left(
        c, (t3.transposed(J_oo), jac.ZERO_MATRIX, t3.transposed(J_oR), t3.transposed(J_RR)))),
        h[0], h[1], B[:, STIFFNESS:])
    far, R_back = t3.apply(R, w), t3.transposed(R)
    at_S1 = jac.IDENTITY, jac.ZERO_MATRIX, jac.ZERO_MATRIX, jac.IDENTITY
    at_S2 = R_back, jac.ZERO_MATRIX, t3.transposed(t3.multiply(t3.hat(o), R)), R_back
    _by_axes(-0.25, model[0][3], jac.accelerations(package, jac.shift_left(c, at_S1)),
             v, w, B[:, MARKER:])
    _by_axes(-0.25, model[0][3], jac.accelerations(package, jac.shift_left(c, at_S2)),
             t3.add(t3.apply(R, v), t3.cross(o, far)), far, B[:, MARKER:])
    by_inertia = B[:, MARKER + INERTIA - DAMPING:]
    jac.parameter_jacobian(model, tool, body, 43, 46, by_inertia)
    for i in range(6):
        for j in range(3):
            by_inertia[i, j] *= mass_ratio
    dv, dw = jac.by_length(model, tool, body, f)
    jac.write_column(B, LENGTH, dv, dw)
    dv, dw = jac.acceleration_at(package, com, f, m)
    jac.write_column(B, MASS, t3.scale(-1.0, dv), t3.scale(-1.0, dw))
    slopes_S1 = jac.wrench_jacobians(model, tool, body)
    for i in range(3):  # by the centre of mass (m), which also changes the push's lever
        along = t3.unit(i, 1.0)
        dv, dw = jac.by_com(package, c, slopes_S1[0], slopes_S1[1], turning, f, along)
        by_push = t3.apply(package[3], t3.cross(along, bias[0]))
        jac.write_column(B, COM + i, dv, t3.subtract(dw, by_push))
        dv, dw = jac.acceleration_at(package, com, t3.unit(i, mass_ratio), ZERO)
        jac.write_column(B, WRENCH + i, dv, dw)
        jac.write_column(B, WRENCH + 3 + i, ZERO, t3.apply(package[3], t3.unit(i, mass_ratio)))
    return t3.apply(t3.rotation_matrix(body[1]), f)


@kernel
def _by_axes(
    factor: float, M: Blocks, S: Square, x: Vector, y: Vector, out: Array
) -> None:
    """
    Add slopes (6, 6) by logarithms along the axes of M (`_scaled`) of terms linear in M.

    Entry jk of M contributes 2 factor (s_j x_k + s_k x_j), with columns s of S and (x, y) for x.
    """
    a, b = kernels.multiply_blocks(M, x, y)
    SM = (
        t3.add_scaled_matrix(t3.multiply(S[0], M[0]), 1.0, t3.multiply(S[1], t3.transposed(M[1]))),
        t3.add_scaled_matrix(t3.multiply(S[0], M[1]), 1.0, t3.multiply(S[1], M[2])),
        t3.add_scaled_matrix(t3.multiply(S[2], M[0]), 1.0, t3.multiply(S[3], t3.transposed(M[1]))),
        t3.add_scaled_matrix(t3.multiply(S[2], M[1]), 1.0, t3.multiply(S[3], M[2])))
    _add_block(out, 0, 0, factor, S[0], SM[0], x, a)
    _add_block(out, 0, 3, factor, S[1], SM[1], y, b)
    _add_block(out, 3, 0, factor, S[2], SM[2], x, a)
    _add_block(out, 3, 3, factor, S[3], SM[3], y, b)


@kernel
def _add_block(
    out: Array, row: int, column: int, factor: float, S: Matrix, SM: Matrix, x: Vector, Mx: Vector
) -> None:
    for i in range(3):
        for j in range(3):
            out[row + i, column + j] += factor * (S[3 * i + j] * Mx[j] + SM[3 * i + j] * x[j])


@array_kernel
def write_losses(
    nominal: ModelTuple, theta: Array, cups: Array, tool: State, body: State, out: Array
) -> None:
    """
    Write M^-1 [W_i, w_i] of each cup into (6 n, 13): accelerations by error, and without.

    Without cup i of a gripper, its wrench w_i(x) is missing. The error e of an estimate x with all
    cups has the slope A e - M^-1 (w_i(x) + W_i e), with A of all cups and W_i the derivative of
    w_i. The linear slope has its own transition (12, 13), whose last column is the effect of the
    loss.
    """
    for i in range(len(cups)):
        cup = nominal[0]
        K, P = kernels.blocks_of(cups[i][:27]), kernels.blocks_of(cups[i][27:])
        one = with_theta(((cup[0], cup[1], K, P, *cup[4:]), nominal[1], nominal[2]), theta)
        by_pose, by_twist = jac.cup_accelerations(one, tool, body)
        jac.write_square(out, 6 * i, 0, by_pose)
        jac.write_square(out, 6 * i, 6, by_twist)
        f, m = kernels.lip_wrench(one, tool, body)
        dv, dw = jac.acceleration_at(one[1], one[1][1], f, m)
        jac.write_column(out[6 * i:], 12, dv, dw)


@array_kernel
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
    for i in range(3):
        last[FALL + i] += h * (last[FALL_SPEED + i] + 0.5 * h * fall_acceleration[i])
        last[FALL_SPEED + i] += h * fall_acceleration[i]
    last[SECONDS] += h


@array_kernel
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
    """
    Return the transition (13, m) over no time.

    It has columns for the rows before `MARKER` and from `DAMPING` on; other rows have no effect on
    the motion.
    """
    T = np.zeros((STATE + 1, MARKER + ROWS - DAMPING))
    for i in range(STATE):
        T[i, i] = 1.0
    return T


@kernel
def times_transition(T: Any, B: Any, out: Any) -> Any:
    """Write the product (12, k) of a transition (13, m) and errors (n, k), and return it."""
    t3.product(T[:STATE], B[:MARKER], out)
    return t3.add_product(np.ascontiguousarray(T[:STATE, MARKER:]), B[DAMPING:], out)


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

    The memory consists of the mean time (s) between measurements; for position and rotation, the
    sums of squares of the noise and of its products with the previous noise, in standard
    deviations; this noise (6,); the ratio of its variances to the stated ones (2,); the variance
    of the model error relative to the lip's displacement; and the variance of a stamp (s^2).
    """
    rate = seconds / memory[0]
    return _correlation(memory[3] / memory[1], rate), _correlation(memory[4] / memory[2], rate)


@kernel
def _correlation(of_next: float, rate: float) -> float:
    return math.exp(math.log(min(max(of_next, 1e-3), MAX_CORRELATION)) * rate)


@array_kernel
def propagated_covariance(
    P: Array, T: Array, Q: Array, walk: Array, correlation: tuple[float, float]
) -> Array:
    """
    Return the covariance (n, n) after a transition, with half of the walk before it.

    The walk (12,) is the variance per second of wrench and camera.
    """
    n, h, out = len(P), T[STATE, SECONDS], P.copy()
    side = times_transition(T, P, out[:STATE])
    for i in range(6):
        more = 0.5 * h * walk[i]
        out[WRENCH + i, WRENCH + i] += 2.0 * more
        out[CAMERA + i, CAMERA + i] += h * walk[6 + i]
        for j in range(STATE):
            side[j, WRENCH + i] += more * T[j, WRENCH + i]
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
    """Return whether a covariance step ends at a sample, independently of its begin."""
    length_ns = int(NS_PER_S * min(COVARIANCE_STEPS * max_step, 1.0))
    return stamp_ns // length_ns != next_ns // length_ns


@kernel
def _is_inside_step(stamps: Any, k: int, until_ns: int, max_step: float) -> bool:
    """Return whether a covariance step continues after the whole of sample k."""
    seconds = (stamps[k] - stamps[k - 1]) / NS_PER_S
    return stamps[k] < until_ns and seconds <= COVARIANCE_STEPS * max_step and (
        not ends_step(stamps[k], stamps[k + 1], max_step))


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
    stamps, starts, ends, bodies, count = samples
    k = first_after(stamps, now_ns, count)
    bias, follows, is_reset, h, squares = wrench_bias(theta), T.shape[0] > 0, True, 0.0, 0.0
    nominal, model, max_step = model, with_theta(model, theta), stable_step(max_step, theta)
    A0, B0 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    A1, B1 = np.zeros((12, 12)), np.zeros((6, T.shape[1]))
    losses0, losses1 = np.zeros((6 * len(without_cup), 13)), np.zeros((6 * len(without_cup), 13))
    while True:
        if follows and (is_reset or now_ns == until_ns or now_ns != stamps[k - 1] or ends_step(
                now_ns, stamps[k], max_step)):
            force = slopes(model, bias, math.exp(theta[0]), tool, body, A1, B1)
            write_losses(nominal, theta, cups[:len(without_cup)], tool, body, losses1)
            if not is_reset:
                t3.add_array(A1, 1.0, A0)
                t3.add_array(B1, 1.0, B0)
                t3.add_array(losses1, 1.0, losses0)
                _, _, _, v, w, _, _, _ = jac.ends_of_spring(model, tool, body)
                more = 0.5 * h * model_error
                accumulate(A0, B0, h, 0.5 * squares * drive[0] + more * (
                    t3.dot(v, v) * drive[1] + t3.dot(w, w) * drive[2]), T, Q,
                           t3.scale(-1.0 / model[1][0], force), losses0, without_cup)
            A0, B0, losses0, A1, B1, losses1 = A1, B1, losses1, A0, B0, losses0
            is_reset, h, squares = False, 0.0, 0.0
        if now_ns == until_ns:
            return tool, body
        first = k
        while is_recorded and now_ns == stamps[k - 1] and _is_inside_step(
                stamps, k, until_ns, max_step):
            part = (stamps[k] - now_ns) / NS_PER_S
            h, squares, now_ns, k = h + part, squares + part * part, stamps[k], k + 1
        if k > first:
            body = body_row(bodies[k - 1], body)
        whole_ns = stamps[k] - stamps[k - 1]
        if now_ns == stamps[k - 1]:
            tool = row_state(starts[k])
        later_ns = min(stamps[k], until_ns)
        parts = substeps_for((later_ns - now_ns) / NS_PER_S, COVARIANCE_STEPS * max_step)
        later_ns = now_ns + (later_ns - now_ns) // parts
        tool_end = row_state(ends[k])
        if later_ns < stamps[k]:
            segment = kernels.tool_segment(row_state(starts[k]), tool_end, whole_ns / NS_PER_S)
            tool_end = kernels.tool_at(segment, (later_ns - stamps[k - 1]) / whole_ns)
        part = (later_ns - now_ns) / NS_PER_S
        body = _followed(
            model, bias, body, tool, tool_end, part, max_step, bodies[k], is_recorded,
            later_ns == stamps[k])
        h, squares = h + part, squares + part * whole_ns / NS_PER_S
        tool, now_ns = tool_end, later_ns
        if now_ns == stamps[k]:
            k += 1


@kernel
def correlations_of_tag(
    sensor: Sensor, before: State, after: State, age: float
) -> tuple[float, float]:
    """
    Return the result of `correlations` for a tag.

    Errors belong to the view, apart from blur, which the errors at rest do not share.
    """
    of_view = math.exp(-age * (1.0 / STILL_TIME + t3.norm(before[2]) / VIEW_LENGTH
                               + t3.norm(before[3]) / VIEW_ANGLE))
    _, depth0, across0, _ = sizes_of(
        sensor, before[0], t3.apply(t3.rotation_matrix(before[1]), before[2]))
    _, depth1, across1, _ = sizes_of(
        sensor, after[0], t3.apply(t3.rotation_matrix(after[1]), after[2]))
    return (of_view * min(depth0, depth1) / max(depth0, depth1),
            of_view * min(across0, across1) / max(across0, across1))


@array_kernel
def predicted(
    model: ModelTuple, estimate: EstimateTuple, samples: Samples, is_recorded: bool, until_ns: int,
    max_step: float, noise: Noise, signatures: Any, cups: Array,
) -> tuple[EstimateTuple, Any, Array]:
    """
    Return an estimate at a later stamp, signatures of faults, and the gain in covariance (12, 12).

    The gain of the state is by the noise of the tool and the model error.
    """
    now_ns, tool, body, theta, P, memory = estimate
    drive, walk, sensor = noise
    T, Q, theta = identity_transition(), np.zeros((STATE, STATE)), theta.copy()
    model_error = memory[SHARE] * MODEL_ERROR_TIME**3
    age = (until_ns - now_ns) / NS_PER_S
    correlation = correlations(memory, age)
    earlier = body
    without_cup = np.zeros((len(cups) if len(signatures) > 0 else 0, STATE, STATE + 1))
    for c in range(len(without_cup)):
        for i in range(STATE):
            without_cup[c, i, i] = 1.0
    tool, body = propagated(
        model, (now_ns, tool, body, theta), (T, Q, without_cup), samples, is_recorded, until_ns,
        max_step, drive, model_error, cups)
    if sensor[0]:
        correlation = correlations_of_tag(sensor, earlier, body, age)
    P = propagated_covariance(P, T, Q, walk, correlation)
    carry_theta(theta.reshape((-1, 1)), T[STATE, SECONDS], correlation)
    if len(signatures) > 0:
        signatures = propagated_signatures(signatures, T, correlation, without_cup)
    return (until_ns, tool, body, theta, P, memory), signatures, Q


@array_kernel
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
    body = advanced_with_wrench(model, bias, body, start, end, seconds, substeps)
    if is_sample:
        write_row(row, body)
    return body


@kernel
def followed(
    row: Any, law: LawTuple, theta: Array, body: State, samples: Samples,
    stamp_ns: int, start: State, end: State, max_step: float, reach: float,
) -> tuple[State, Wrench, bool]:
    """Store another sample of the tool; return the package there, and `checked_wrench`."""
    model, max_step = model_at(row, law, theta), stable_step(max_step, theta)
    stamps, starts, ends, bodies, k = samples
    stamps[k] = stamp_ns
    write_row(starts[k], start)
    write_row(ends[k], end)
    seconds, tool = (stamp_ns - stamps[k - 1]) / NS_PER_S, start
    parts = substeps_for(seconds, COVARIANCE_STEPS * max_step)
    part = seconds / parts
    for i in range(parts):
        tool_end = end
        if i < parts - 1:
            tool_end = kernels.tool_at(kernels.tool_segment(start, end, seconds), (i + 1) / parts)
        body = advanced_with_wrench(
            model, wrench_bias(theta), body, tool, tool_end, part, substeps_for(part, max_step))
        tool = tool_end
    write_row(bodies[k], body)
    wrench, is_sound = kernels.checked_wrench(model, end, body, reach)
    return body, wrench, is_sound


@array_kernel
def body_at_end(
    row: Any, law: LawTuple, beginning: Moving, samples: Samples, until_ns: int,
    max_step: float,
) -> State:
    """Return the package of an estimate at a later stamp, and write it into the samples."""
    none = np.zeros((0, 0))
    return propagated(
        kernels.model_of(row, law), beginning, (none, none, np.zeros((0, 12, 13))), samples,
        False, until_ns, max_step, np.zeros((0, 0, 0)), 0.0, np.zeros((0, 54)))[1]
