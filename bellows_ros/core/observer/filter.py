"""
An error-state Kalman filter on SE(3) x R^6, with a wrench bias and what a payload is off by.

The error (22,) is in the package's own axes: shift (m), turn (rad), linear and angular twist
(m/s, rad/s), as in `jacobians`; then the relative error of mass and inertia, that of the centre
of mass (m), and the wrench (N, N m) on the package at the lip, in S axes, beside the cup's.
"""

from __future__ import annotations

from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.equilibrium import linearise, substeps_for
from bellows_ros.core.jacobians import COM, INERTIA, LENGTH, MASS, PARAMETERS, WRENCH
from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import ModelTuple, PackageTuple, State
from bellows_ros.core.lie import hat
from bellows_ros.core.sensitivities import advance_changes, workspace
from bellows_ros.core.tuples import (
    add,
    apply,
    apply_transposed,
    exp_quaternion,
    log_quaternion,
    normalised,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    scale_matrix,
    subtract,
    Vector,
)
import numpy as np

STATE, CENTRE, BIAS = slice(0, 12), slice(13, 16), slice(16, 22)
SIZE, EXTENDED = 22, 41
ZERO = (0.0, 0.0, 0.0)

FIRST = LENGTH.start
"""Of the parameters by which is derived."""
COLUMNS = 12 + PARAMETERS - FIRST
NO_CHANGES: Array = np.zeros((12, 0))
IDENTITY = np.eye(SIZE)

ENTRIES = 0, 4, 8, 1, 2, 5
"""Of an inertia's nine numbers those that `INERTIA` is by."""


class Estimate(NamedTuple):
    """What is known of the package at one stamp."""

    stamp_ns: int
    body: State
    theta: Array
    """The relative error of mass and inertia, that of the centre of mass, and the wrench (10,)."""
    covariance: Array
    """Of the error (22, 22)."""
    refused: int = 0
    """Measurements outside the gate, one after the other."""
    passage: Array = np.eye(EXTENDED)
    """Of the extended error, see `alarms`, since the measurement before (41, 41)."""


class Driving(NamedTuple):
    """What drives the error, beside itself."""

    noise: Array
    """Of the state (12, 12) by noise of the tool's pose that is held for a second."""
    walk: Array
    """Variances of the steps of theta in a second (10,)."""


@kernel
def moved(
    body: State, shift: Vector, turn: Vector, linear: Vector, angular: Vector
) -> State:
    """Return a state changed in its own axes."""
    return (
        add(body[0], apply(rotation_matrix(body[1]), shift)),
        normalised(quaternion_product(body[1], exp_quaternion(turn))),
        add(body[2], linear), add(body[3], angular),
    )


@kernel
def pose_error(body: State, position: Vector, q: Quaternion) -> tuple[Vector, Vector]:
    """Return shift and turn that `moved` takes from a body to a pose: log(T_hat^-1 Z)."""
    return (
        apply_transposed(rotation_matrix(body[1]), subtract(position, body[0])),
        log_quaternion(quaternion_product(quaternion_conjugate(body[1]), q)),
    )


@kernel
def with_payload(model: ModelTuple, scale: float, shift: Vector) -> ModelTuple:
    """Return a model with mass and inertia 1 + scale times as large, and B shifted (m)."""
    cup, package, gravity = model
    mass, com, inertia, inverse = package
    k = 1.0 + scale
    return cup, (
        k * mass, add(com, shift), scale_matrix(k, inertia), scale_matrix(1.0 / k, inverse),
    ), gravity


def payload_model(model: ModelTuple, theta: Array) -> ModelTuple:
    """Return the model with the payload as it is estimated."""
    if not theta[:4].any():
        return model
    k, x, y, z = theta[:4].tolist()
    return with_payload(model, k, (x, y, z))


def changed(body: State, error: Array) -> State:
    """Return a state changed by an error (12,)."""
    a, b, c, d, e, f, g, h, i, j, k, m = error.tolist()
    return moved(body, (a, b, c), (d, e, f), (g, h, i), (j, k, m))


def driving(model: ModelTuple, tool: State, body: State, noise: Array, walk: Array) -> Driving:
    """
    Return what white noise (6,) of the tool's pose does, with small motions about a state.

    The tool's twist is the derivative of its noise e. Integrated by parts, its slope T_v acts
    like the slope A T_v of e.
    """
    by = linearise(model, tool, body)
    drive = np.vstack([by.tool_twist, by.tool_pose + by.body_twist @ by.tool_twist]) * noise
    return Driving(drive @ drive.T, walk)


def steps(
    model: ModelTuple, body: State, start: State, end: State, seconds: float,
    longest_step: float,
) -> tuple[State, Array]:
    """Return the state under the cup alone, and its derivatives (12, 32): see `FIRST`."""
    S: Array = np.zeros((12, COLUMNS))
    S[:, STATE] = np.eye(12)
    body = advance_changes(
        model, body, start, end, seconds, substeps_for(seconds, longest_step), S,
        (FIRST, PARAMETERS), NO_CHANGES, NO_CHANGES, *workspace(COLUMNS))
    return body, S


def transition(package: PackageTuple, S: Array, theta: Array) -> Array:
    """
    Return by how much an error (22,) before changes the state after (12, 22).

    Scale and centre of mass change what the bias does, too.
    """
    mass, _, inertia, _ = package
    F: Array = np.empty((12, SIZE))
    F[:, STATE] = S[:, STATE]
    F[:, 12] = mass * S[:, _of(MASS).start] + S[:, _of(INERTIA)] @ [inertia[i] for i in ENTRIES]
    F[:, BIAS] = S[:, _of(WRENCH)]
    F[:, 12] -= F[:, BIAS] @ theta[4:] / (1.0 + theta[0])
    F[:, CENTRE] = S[:, _of(COM)] + F[:, 19:] @ hat(theta[4:7])
    return F


def _of(parameters: slice) -> slice:
    """Return the columns of parameters in what `steps` gives."""
    return slice(12 + parameters.start - FIRST, 12 + parameters.stop - FIRST)


def carried(
    model: ModelTuple, estimate: Estimate, start: State, end: State, stamp_ns: int,
    longest_step: float, driven: Driving,
) -> tuple[Estimate, Array]:
    """
    Carry an estimate along with the tool; return derivatives of the state, too.

    They are by the error before, and by the cup's length (12, 23).

    The model is the nominal one. The bias acts through the derivatives by it: to first order in
    what it does from one sample of the tool to the next.
    """
    seconds = (stamp_ns - estimate.stamp_ns) * 1e-9
    theta = estimate.theta
    body, S = steps(
        payload_model(model, theta), estimate.body, start, end, seconds, longest_step)
    F = transition(model[1], S, theta)
    P = estimate.covariance.copy()
    top = F @ P
    P[STATE], P[:, STATE] = top, top.T
    P[STATE, STATE] = top @ F.T + seconds ** 2 * driven.noise
    P[np.diag_indices(SIZE)] += np.concatenate([np.zeros(12), seconds * driven.walk])
    body = changed(body, F[:, BIAS] @ theta[4:])
    after = estimate._replace(stamp_ns=stamp_ns, body=body, covariance=P)
    return after, np.column_stack([F, S[:, _of(LENGTH)]])


class Innovation(NamedTuple):
    """What a measured pose says of an estimate."""

    y: Array
    """Shift (m) and turn (rad) from the estimated to the measured pose, in B axes (6,)."""
    H: Array
    """Its derivative by the error (6, 22)."""
    S: Array
    """Its covariance (6, 6)."""
    distance: float
    """Its squared Mahalanobis distance."""
    gain: Array
    """(22, 6)."""


def innovation(
    estimate: Estimate, position: Vector, quaternion_xyzw: Quaternion, noise: Array, H: Array
) -> Innovation:
    """Return what a measured pose of B, its noise (6, 6) in B axes, says of an estimate."""
    y = np.concatenate(pose_error(estimate.body, position, quaternion_xyzw))
    PH = estimate.covariance @ H.T
    S = H @ PH + noise
    inverse = np.linalg.inv(S)
    return Innovation(y, H, S, float(y @ inverse @ y), PH @ inverse)


def corrected(estimate: Estimate, found: Innovation, noise: Array) -> Estimate:
    """Return an estimate with a measurement taken in, its covariance by Joseph's form."""
    error = found.gain @ found.y
    A = IDENTITY - found.gain @ found.H
    P = A @ estimate.covariance @ A.T + found.gain @ noise @ found.gain.T
    return estimate._replace(
        body=changed(estimate.body, error[STATE]), theta=estimate.theta + error[12:],
        covariance=0.5 * (P + P.T), refused=0)
