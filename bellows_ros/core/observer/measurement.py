"""Update of an estimate with a measured pose, converted to the centre of mass."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import moved, moved_by, pose_error
from bellows_ros.core.model.kernels import LawTuple, ModelTuple, State
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.dynamics import (
    acceleration,
    is_possible,
    with_theta,
    wrench_bias,
)
from bellows_ros.core.observer.pose_sensor import Marker
from bellows_ros.core.observer.states import CAMERA, COM, LATENCY, MARKER, MASS, NOISE, STATE
from bellows_ros.core.sensors.corners import equivalent_pose, SAME_VIEW, write_image
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


SHARES: Array = 1.0 / np.array([3.0, 9.0, 24.0, 66.0])
"""Shares of the newest pose in the moving means: a push, and shifts of 1, 0.6 and 0.4 standard
deviations at the threshold."""

Means = tuple[Array, Array, Array]
"""Moving means of whitened innovations (k, 6), their variances without faults (k,), and their
normalised squares (k,)."""

NO_MEANS: Means = np.zeros((len(SHARES), 6)), np.zeros(len(SHARES)), np.zeros(len(SHARES))
"""Means before the first pose."""


class MeasuredPose(NamedTuple):
    """A pose for the kernels, and its limits."""

    position: Vector
    quaternion_xyzw: Quaternion
    noise: Array
    """Covariance of the pose, see `Measurement`."""
    marker: Marker
    reach: float
    """Largest displacement (m) of a lip from its place without load, to which uncertainties of
    centre of mass, camera and stamps are added."""
    largest: Array
    """Largest physical value of each row of the error."""
    gate: float
    """Largest squared Mahalanobis distance, 0 without a measurement."""
    means: Means
    """Moving means of the innovations before."""
    prior: Array
    """Prior variances of mass and centre of mass (4,)."""


WHITE_SHARE = 0.05
"""Fraction of the noise's variance without memory, for bodies."""

WHITE_SHARE_OF_TAG = 1.0 - SAME_VIEW
"""Fraction of the noise's variance without memory, for tags."""

JITTER_RANGE = 1e-8, 4e-4
"""Bounds of the variance of the random error of a stamp, s^2."""

GATE = 27.86
"""Squared Mahalanobis distance exceeded by 1 in 10,000 good measurements (chi^2 of 6)."""

OUTLIER_DISTANCE = 16.81
"""
Largest squared Mahalanobis distance (99 % of chi^2 of 6) of a measurement with its own covariance:
beyond, the covariance is enlarged, as the noise of cameras has heavy tails.
"""

MEMORY_COUNT = 1000.0
"""Number of measurements in the memory of the noise."""

LEAST_KNOWN = 1e-3
"""Smallest fraction of a variance that counts as its reduction by poses; rounding hides less."""

ERROR_COUNT = 20.0
"""Number of measurements, all with errors of the model, after which the variance of the model
error has adapted."""

SHARE_RANGE = 1e-4, 1.0
"""Bounds of the model error's variance, relative to the lip's displacement."""


@entry
def at_com(
    position: Vector, quaternion_xyzw: Quaternion, noise: Array, marker: Marker, com: Vector
) -> tuple[Vector, Quaternion, Array]:
    """
    Return the pose of B, and its noise (6, 6) in B axes, from the measured pose of a marker.

    B is at com (m) from the lip; other arguments are of a `Measurement` and of `PoseSensor`.
    """
    offset, rotation, of_lip, _ = marker
    arm = t3.subtract(com if of_lip else ZERO, offset)
    q = t3.quaternion_product(quaternion_xyzw, t3.quaternion_conjugate(rotation))
    R = t3.rotation_matrix(q)
    across = t3.multiply(t3.hat(arm), t3.transposed(R))
    T = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            T[i, j] = T[3 + i, 3 + j] = R[3 * j + i]
            T[i, 3 + j] = -across[3 * i + j]
    noise = t3.product(t3.product(T, noise, np.empty((6, 6))), t3.transpose(T), np.empty((6, 6)))
    return t3.add(position, t3.apply(R, arm)), q, noise


@kernel
def vector_at(theta: Array, row: int) -> Vector:
    """Return three components of theta, from a row of the error on."""
    return theta[row - STATE], theta[row - STATE + 1], theta[row - STATE + 2]


@entry
def corrected_pose(
    position: Vector, q: Quaternion, noise: Array, marker: Marker, theta: Array, com: Vector
) -> tuple[Vector, Quaternion, Array]:
    """Return the result of `at_com` corrected by estimated errors of camera, marker and noise."""
    back = t3.exp_quaternion(t3.scale(-1.0, vector_at(theta, CAMERA + 3)))
    shift, marker_shift = vector_at(theta, CAMERA), vector_at(theta, MARKER)
    position = t3.apply(t3.rotation_matrix(back), t3.subtract(position, shift))
    position, q, noise = at_com(position, t3.quaternion_product(back, q), noise, marker, com)
    back = t3.exp_quaternion(t3.scale(-1.0, vector_at(theta, MARKER + 3)))
    q = t3.quaternion_product(q, back)
    position = t3.subtract(position, t3.apply(t3.rotation_matrix(q), marker_shift))
    return position, q, noise


@kernel
def at_exposure(model: ModelTuple, tool: State, body: State, theta: Array) -> State:
    """Return the package earlier by the remaining latency, to second order."""
    late = theta[LATENCY - STATE]
    if abs(late) < 1e-9:  # below the resolution of a stamp
        return body
    half, (dv, dw) = 0.5 * late * late, acceleration(model, wrench_bias(theta), tool, body)
    dv = t3.add(dv, t3.cross(body[3], body[2]))
    return moved(
        body, t3.add_scaled(t3.scale(-late, body[2]), half, dv),
        t3.add_scaled(t3.scale(-late, body[3]), half, dw), ZERO, ZERO)


class Innovation(NamedTuple):
    """The difference of a measured pose from an estimate: m and rad in B axes."""

    z: Array
    """The difference times its whitener (6,)."""
    H: Array
    """Derivative of the difference by the error (6, n)."""
    whitener: Array
    """Triangular matrix (6, 6) that makes the covariance of the difference the identity."""
    distance: float
    """Squared Mahalanobis distance, before an outlier's covariance is enlarged."""
    gain: Array
    """The whitener times H P (6, n), whose square a measurement subtracts from P."""


@entry
def cholesky(S: Array) -> tuple[Array, Array]:
    """Return the Cholesky factor of a covariance (6, 6), and its inverse."""
    L, W = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            a = S[i, j]
            for k in range(j):
                a -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(max(a, 1e-12 * S[i, i])) if i == j else a / L[j, j]
        for j in range(i + 1):
            a = 1.0 if i == j else 0.0
            for k in range(j, i):
                a -= L[i, k] * W[k, j]
            W[i, j] = a / L[i, i]
    return L, W


@kernel
def observation(n: int, body: State, root: Array, of_lip: bool, white: float) -> Array:
    """
    Return the derivative (6, n) of an innovation by the error.

    The root (6, 6) of the stated noise has the white fraction and the fraction with a memory.
    """
    H = np.zeros((6, n))
    R = t3.rotation_matrix(body[1])
    lever = t3.multiply(t3.transposed(R), t3.hat(body[0]))
    v = body[2] + body[3]
    for i in range(6):
        H[i, i] = H[i, MARKER + i] = 1.0
        H[i, LATENCY] = -v[i]
        for j in range(i + 1):
            H[i, NOISE + j] = math.sqrt(1.0 - white) * root[i, j]
    for i in range(3):
        if of_lip:
            H[i, COM + i] = -1.0
        for j in range(3):
            H[i, CAMERA + j] = H[3 + i, CAMERA + 3 + j] = R[3 * j + i]
            H[i, CAMERA + 3 + j] = -lever[3 * i + j]
    return H


@kernel
def innovation_of(
    body: State, theta: Array, P: Array, difference: Array, root: Array, noise: Array,
    marker: Marker, jitter: float,
) -> Innovation:
    """
    Return an `Innovation` of a difference (6,), see `pose_error`.

    The root of the stated noise and the covariance of the noise (6, 6) are in B axes, jitter is
    the variance of a stamp (s^2).
    """
    n, of_lip, is_tag = len(P), marker[2], marker[3][0]
    white = WHITE_SHARE_OF_TAG if is_tag else WHITE_SHARE
    y = difference.copy()
    H = observation(n, body, root, of_lip, white)
    for i in range(6):
        for j in range(i + 1):
            y[i] -= H[i, NOISE + j] * theta[NOISE - STATE + j]
    HP = t3.product(H, P, np.empty((6, n)))
    S = t3.product(HP, t3.transpose(H), np.empty((6, 6)))
    for i in range(6):
        for j in range(6):
            S[i, j] += white * noise[i, j] + jitter * H[i, LATENCY] * H[j, LATENCY]
    _, W = cholesky(S)
    z = np.zeros(6)
    for i in range(6):
        for j in range(i + 1):
            z[i] += W[i, j] * y[j]
    distance = (z * z).sum()
    if distance > OUTLIER_DISTANCE:
        weight = math.sqrt(OUTLIER_DISTANCE / distance)
        z, W = weight * z, weight * W
    return Innovation(z, H, W, distance, t3.product(W, HP, np.empty((6, n))))


@entry
def changed_by(body: State, theta: Array, e: Array) -> tuple[State, Array]:
    """Return state and theta changed by an error (n,)."""
    theta = theta.copy()
    for i in range(len(theta)):
        theta[i] += e[STATE + i]
    return moved_by(body, e), theta


@kernel
def posterior(
    body: State, theta: Array, P: Array, innovation: Innovation, largest: Array
) -> tuple[bool, State, Array]:
    """
    Return whether an `Innovation` leads to a possible state, and that state and theta.

    P is updated in place. An impossible state changes nothing.
    """
    z, Z = innovation.z, innovation.gain
    error = np.zeros(len(P))
    for i in range(6):
        for j in range(len(P)):
            error[j] += Z[i, j] * z[i]
    changed, moved_theta = changed_by(body, theta, error)
    if not is_possible(changed, moved_theta, largest):
        return False, body, theta
    for i in range(len(P)):
        P[i, i] *= 1.0 + RELATIVE_ROUNDING
    t3.add_product(t3.transpose(-Z), Z, P)
    return True, changed, moved_theta


@kernel
def updated_memory(
    memory: Array, theta: Array, seconds: float, innovation: Innovation, gain: Array, is_used: bool
) -> Array:
    """
    Return the memory of the noise (see `correlations`) after another innovation.

    An innovation larger than expected increases the noise, the model error and the jitter of
    stamps, by their shares in the covariance. A rejected innovation changes only these sizes.
    """
    out, z, W = memory.copy(), innovation.z, innovation.whitener
    count, growth = min(max(out[ekf.SQUARES] / 3.0, 1.0), MEMORY_COUNT), 0.0
    out[ekf.PERIOD] += (min(seconds, 2.0 * out[ekf.PERIOD]) - out[ekf.PERIOD]) / count
    WG = t3.product(W, np.ascontiguousarray(gain[:6, :6]), np.empty((6, 6)))
    unweighted = max(innovation.distance / OUTLIER_DISTANCE, 1.0)
    for i in range(2):
        excess = of_model = 0.0
        for j in range(3 * i, 3 * i + 3):
            excess += z[j] * z[j] / 3.0 - 1.0 / 3.0
            for k in range(6):
                of_model += unweighted * WG[j, k] * W[j, k] / 3.0
        out[ekf.FACTORS + i] = max(out[ekf.FACTORS + i] * (1.0 + excess / count), 1.0)
        growth += excess * min(of_model, 1.0) / ERROR_COUNT
    along = square = 0.0
    for i in range(6):
        by = 0.0
        for j in range(i + 1):
            by += W[i, j] * innovation.H[j, LATENCY]
        along += z[i] * by
        square += by * by
    of_jitter = unweighted * out[ekf.JITTER] * square
    if square > 0.0:
        growth_of_jitter = (along * along / square - 1.0) * min(of_jitter, 1.0) / ERROR_COUNT
        out[ekf.JITTER] = min(max(
            out[ekf.JITTER] * math.exp(growth_of_jitter), JITTER_RANGE[0]), JITTER_RANGE[1])
    least = min(out[ekf.SHARE], SHARE_RANGE[0])
    out[ekf.SHARE] = min(max(out[ekf.SHARE] * math.exp(growth), least), SHARE_RANGE[1])
    out[ekf.COUNT] += 1.0
    if not is_used:
        return out
    other = 1.0 - out[ekf.SAME]  # another view
    for i in range(ekf.SQUARES, ekf.LAST):
        out[i] *= 1.0 - other / MEMORY_COUNT
    for i in range(6):
        noise = theta[NOISE - STATE + i] / math.sqrt(out[ekf.FACTORS + i // 3])
        out[ekf.SQUARES + i // 3] += other * noise * noise
        out[ekf.PRODUCTS + i // 3] += other * noise * out[ekf.LAST + i]
        out[ekf.LAST + i] = noise
    return out


@kernel
def moved_means(before: Means, z: Array) -> Means:
    """Return the moving means after another whitened innovation (6,)."""
    means, variances, squares = before[0].copy(), before[1].copy(), np.zeros(len(SHARES))
    for i in range(len(SHARES)):
        variances[i] = (1.0 - SHARES[i]) ** 2 * variances[i] + SHARES[i] ** 2
        for j in range(6):
            means[i, j] += SHARES[i] * (z[j] - means[i, j])
            squares[i] += means[i, j] ** 2 / variances[i]
    return means, variances, squares


@kernel
def significance(theta: Array, P: Array, prior: Array) -> Array:
    """Return the changes of mass and centre of mass, in deviations; prior variances (4,)."""
    out = np.zeros(len(prior))
    for i in range(len(prior)):
        gained = max(prior[i] - P[MASS + i, MASS + i], LEAST_KNOWN * prior[i], 1e-99)
        out[i] = abs(theta[i]) / math.sqrt(gained)
    return out


RELATIVE_ROUNDING = 1e-12
"""
Smallest fraction of each variance that remains after an update. The fraction is above rounding
errors, so that the covariance stays positive definite.
"""

USED = 0
"""Verdict on a pose within the gate."""

OUTSIDE = 1
"""Verdict on a pose outside the gate, within reach of the cup."""

OUT_OF_REACH = 2
"""Verdict on a pose out of any reach of the cup."""

SPREAD = 5.0
"""Largest error of a pose that is within reach, standard deviations."""


@kernel
def _with_factors(root: Array, memory: Array) -> Array:
    """Return the covariance (6, 6) of the noise with a stated root, by the estimated factors."""
    noise = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(min(i, j) + 1):
                noise[i, j] += memory[ekf.FACTORS + k // 3] * root[i, k] * root[j, k]
    return noise


@kernel
def tag_seen(
    model: ModelTuple, tool: State, exposed: State, theta: Array, position: Vector, q: Quaternion,
    marker: Marker,
) -> tuple[Array, Array]:
    """Return the result of `equivalent_pose` for the corners of a tag at a measured pose."""
    seen, (offset, rotation, of_lip, sensor) = np.empty((1, 8)), marker
    write_image((position, q, ZERO, ZERO), (
        sensor[3], sensor[4], ZERO, IDENTITY, sensor[5]), seen[0])
    back = t3.rotation_matrix(t3.exp_quaternion(
        t3.scale(-1.0, vector_at(theta, CAMERA + 3))))
    turned = t3.rotation_matrix(t3.exp_quaternion(vector_at(theta, MARKER + 3)))
    arm = t3.subtract(offset, model[1][1] if of_lip else ZERO)
    sight = (
        t3.apply(back, t3.subtract(sensor[3], vector_at(theta, CAMERA))),
        t3.multiply(back, sensor[4]),
        t3.add(vector_at(theta, MARKER), t3.apply(turned, arm)),
        t3.multiply(turned, t3.rotation_matrix(rotation)), sensor[5])
    dv, dw = kernels.body_acceleration(model, tool, exposed)
    bend = t3.add(dv, t3.cross(exposed[3], exposed[2])), dw
    return equivalent_pose(exposed, bend, sight, sensor, seen)


@kernel
def _measured_difference(
    model: ModelTuple, tool: State, exposed: State, theta: Array, seen: MeasuredPose,
) -> tuple[Array, Array]:
    """Return the difference (6,) of a measured pose from a body, and its noise in B axes."""
    position, q, noise, marker = seen.position, seen.quaternion_xyzw, seen.noise, seen.marker
    sensor = marker[3]
    if sensor[0]:
        return tag_seen(model, tool, exposed, theta, position, q, marker)
    if noise[0, 0] == 0.0:
        noise = np.zeros((6, 6))
        for i in range(3):
            noise[i, i], noise[3 + i, 3 + i] = sensor[1] * sensor[1], sensor[2] * sensor[2]
    position, q, noise = corrected_pose(position, q, noise, marker, theta, model[1][1])
    shift, rotation = pose_error(exposed, position, q)
    return np.array((
        shift[0], shift[1], shift[2], rotation[0], rotation[1], rotation[2])), noise


@kernel
def _is_out_of_reach(
    model: ModelTuple, tool: State, there: State, theta: Array, P: Array, noise: Array,
    seen: MeasuredPose,
) -> bool:
    """Return whether a pose is beyond any lip's reach, with `SPREAD` deviations of its noise."""
    com, R = model[1][1], t3.rotation_matrix(there[1])
    o = kernels.lip_relative_to_tool(com, tool, there)[0]
    late = 3.0 * math.sqrt(P[LATENCY, LATENCY]) + abs(theta[LATENCY - STATE])
    unknown = np.trace(P[COM:COM + 3, COM:COM + 3]) + np.trace(
        P[CAMERA:CAMERA + 3, CAMERA:CAMERA + 3])
    reach = seen.reach + 3.0 * math.sqrt(unknown) + late * t3.norm(tool[2])
    away = t3.apply(t3.rotation_matrix(tool[1]), (o[0], o[1], o[2] + model[0][1]))
    distance, variance = t3.norm(away), 0.0
    n = t3.scale(1.0 / max(distance, 1e-9), t3.apply_transposed(R, away))
    m = t3.cross(n, com)  # a rotation of the pose moves the lip
    u = n[0], n[1], n[2], m[0], m[1], m[2]
    for i in range(6):
        for j in range(6):
            variance += u[i] * noise[i, j] * u[j]
    return bool(distance > reach + SPREAD * math.sqrt(variance))


class Corrected(NamedTuple):
    """An estimate after a measurement."""

    verdict: int
    """`USED`, `OUTSIDE` the gate or the physical range of a state, or `OUT_OF_REACH` of any lip,
    as of another package."""
    estimate: ekf.EstimateTuple
    """Corrected by a used pose; otherwise unchanged, but for the noise outside the gate."""
    exposed: State
    """Predicted package at the exposure."""
    z: Array
    """Whitened innovation (6,)."""
    whitener: Array
    """Triangular matrix (6, 6)."""
    means: Means
    """Moving means with this innovation."""
    changes: Array
    """Changes of mass and centre of mass (4,), see `significance`."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the estimate, ns."""
        return self.estimate[0]


@entry
def filter_step(
    row: Any, law: LawTuple, estimate: ekf.EstimateTuple, samples: ekf.Samples, until_ns: int,
    max_step: float, noise: ekf.Noise, seen: MeasuredPose, is_early: bool,
    learns: bool,
) -> Corrected:
    """
    Propagate an estimate to a later stamp, and correct it with a pose, if any.

    An early pose is used outside the gate, too. Whether the noise is learned from the pose is
    given. Other inputs are as for `model_of` and `predicted`. One kernel, with the model as an
    array, is faster to call from Python.
    """
    nominal, seconds = kernels.model_of(row, law), (until_ns - estimate[0]) / NS_PER_S
    after, gain = ekf.predicted(
        nominal, estimate, samples, until_ns, max_step, noise)
    _, tool, body, theta, P, memory = after
    if seen.gate == 0.0:
        return Corrected(USED, after, body, np.zeros(6), gain[:6, :6].copy(),
                         seen.means, significance(theta, P, seen.prior))
    model = with_theta(nominal, theta)
    exposed = at_exposure(model, tool, body, theta)
    difference, stated = _measured_difference(model, tool, exposed, theta, seen)
    root = cholesky(stated)[0]
    covariance = _with_factors(root, memory)
    innovation = innovation_of(
        exposed, theta, P, difference, root, covariance, seen.marker, memory[ekf.JITTER])
    there = moved(exposed, (difference[0], difference[1], difference[2]),
                  (difference[3], difference[4], difference[5]), ZERO, ZERO)
    verdict = USED
    if _is_out_of_reach(model, tool, there, theta, P, covariance, seen):
        verdict = OUT_OF_REACH
    else:
        inside = innovation.distance <= seen.gate  # false for NaN
        is_used = inside or is_early
        if is_used:
            is_used, body, theta = posterior(body, theta, P, innovation, seen.largest)
        verdict = USED if is_used and inside else OUTSIDE
        if learns:
            memory = updated_memory(memory, theta, seconds, innovation, gain, verdict == USED)
    weight = math.sqrt(max(innovation.distance / OUTLIER_DISTANCE, 1.0))
    return Corrected(verdict, (until_ns, tool, body, theta, P, memory), exposed,
                     weight * innovation.z, weight * innovation.whitener,
                     moved_means(seen.means, innovation.z), significance(theta, P, seen.prior))
