"""
The motion of a package with estimated parameters, and its slopes by all errors.

The vector theta has the rows of `states` from `MASS` on.
"""

from __future__ import annotations

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector, ZERO
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import linearise
from bellows_ros.core.model.jacobians import Square
from bellows_ros.core.model.kernels import Blocks, LawTuple, ModelTuple, State, Wrench
from bellows_ros.core.model.pseudo_inertia import second_moments, stretched
from bellows_ros.core.observer import states
from bellows_ros.core.observer.states import (
    COM,
    DAMPING,
    LENGTH,
    MASS,
    SPEED,
    SPIN,
    STATE,
    STIFFNESS,
)
import numpy as np

STEP_MARGIN = 1.5
"""Largest factor on the fastest mode without shorter steps."""

MAX_SUBSTEPS = 10_000
"""Largest number of substeps of one advance; a state that needs more substeps counts as
diverged."""

MAX_SHORTENING = 30.0
"""Largest ratio of the nominal step to the step of a model changed by theta, which limits the
work."""


@kernel
def with_theta(model: ModelTuple, theta: Array) -> ModelTuple:
    """Return a model with its parameters changed by theta."""
    cup, (mass, com, inertia, inverse), gravity = model
    k, longer = math.exp(theta[0]), theta[LENGTH - STATE]
    (oo, oR, RR), P = _scaled(cup[2], theta[STIFFNESS - STATE:]), cup[3]
    P = _scaled(P, theta[DAMPING - STATE:])
    s = theta[states.INERTIA - STATE:]
    if s[0] != 0.0 or s[1] != 0.0 or s[2] != 0.0:
        inertia = stretched(inertia, (0.5 * s[0], 0.5 * s[1], 0.5 * s[2]))
        inverse = t3.inverse(inertia)
    return (cup[0] + 0.5 * longer, cup[1] + longer, (oo, oR, RR, *cup[2][3:]), P, *cup[4:]), (
        k * mass, t3.add(com, (theta[1], theta[2], theta[3])), t3.scale_matrix(k, inertia),
        t3.scale_matrix(1.0 / k, inverse)), gravity


@entry
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


@entry
def stable_step(max_step: float, theta: Array) -> float:
    """Return the longest step (s) for a model changed by theta, shorter if much stiffer."""
    stiffer = damped = lighter = 0.0
    for i in range(3):
        lighter = min(lighter, theta[states.INERTIA - STATE + i])
    for i in range(6):
        mass = theta[0] + (lighter if i > 2 else 0.0)
        stiffer = max(stiffer, theta[STIFFNESS - STATE + i] - mass)
        damped = max(damped, theta[DAMPING - STATE + i] - mass)
    return max_step * min(1.0, STEP_MARGIN * math.exp(-max(0.5 * stiffer, damped)))


@kernel
def is_possible(body: State, theta: Array, largest: Array) -> bool:
    """Return whether motion and theta are within their ranges (n,), and steps not too short."""
    for i in range(3):
        if not (abs(body[2][i]) <= largest[SPEED + i] and abs(body[3][i]) <= largest[SPIN + i]):
            return False
    for i in range(len(theta)):
        if not abs(theta[i]) <= largest[STATE + i]:  # also true for NaN
            return False
    return stable_step(MAX_SHORTENING, theta) >= 1.0


@kernel
def wrench_bias(theta: Array) -> Wrench:
    """Return the additional wrench (N, N m)."""
    k = math.exp(theta[0])
    return t3.scale(k, (theta[4], theta[5], theta[6])), t3.scale(
        k, (theta[7], theta[8], theta[9]))


def driving(model: ModelTuple, tool: State, body: State, noise: Array) -> Array:
    """
    Return the covariances of the state by white noise (6,) of the tool, held for 1 s.

    The result is (3, 12, 12): for the whole noise, and for noise of position or of rotation alone
    with unit variance. The noise of the tool's twist is the derivative of the pose noise e;
    integrated by parts, the slope T_v of the twist becomes the slope A T_v of e. The derivatives
    are linearised about a state.
    """
    by = linearise(model, tool, body)
    drive = np.vstack([by.tool_twist, by.tool_pose + by.body_twist @ by.tool_twist])
    each = noise, np.repeat([1.0, 0.0], 3), np.repeat([0.0, 1.0], 3)
    return np.stack([drive * np.square(std) @ drive.T for std in each])


@entry
def advanced_with_wrench(
    model: ModelTuple, bias: Wrench, body: State, start: State, end: State, seconds: float,
    substeps: int,
) -> State:
    """Return a state after a motion of the tool; half of the push acts before, half after."""
    dv, dw = jac.acceleration_at(model[1], model[1][1], bias[0], bias[1])
    dv, dw = t3.scale(0.5 * seconds, dv), t3.scale(0.5 * seconds, dw)
    body = kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))
    body = kernels.advance(model, body, start, end, seconds, substeps)
    return kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))


@kernel
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
    c = jac.ends_of_spring(model, tool, body)[0]
    B[:, STIFFNESS:] = 0.0
    _by_cup(model, tool, body, B)
    _, dw = kernels.body_acceleration(model, tool, body)
    for i in range(3):
        jac.write_column(B, states.INERTIA + i, ZERO, _by_second_moment(package, turning, dw, i))
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
        jac.write_column(B, states.WRENCH + i, dv, dw)
        dw = t3.apply(package[3], t3.unit(i, mass_ratio))
        jac.write_column(B, states.WRENCH + 3 + i, ZERO, dw)
    return t3.apply(t3.rotation_matrix(body[1]), f)


@kernel
def _by_cup(model: ModelTuple, tool: State, body: State, B: Array) -> None:
    """Add the slopes of the twist by the logarithms of K and P."""
    c, o, R, v, w, _, _, _ = jac.ends_of_spring(model, tool, body)
    package = model[1]
    h = kernels.effective_strain(kernels.strain(o, R), model[0][4:], body[4:])
    J_oo, J_oR, J_RR = jac.strain_jacobian(o, R)
    _by_axes(-0.125, model[0][2], jac.accelerations(package, jac.shift_left(
        c, (t3.transposed(J_oo), jac.ZERO_MATRIX, t3.transposed(J_oR), t3.transposed(J_RR)))),
        h[0], h[1], B[:, STIFFNESS:])
    far, R_back = t3.apply(R, w), t3.transposed(R)
    at_S1 = jac.IDENTITY, jac.ZERO_MATRIX, jac.ZERO_MATRIX, jac.IDENTITY
    at_S2 = R_back, jac.ZERO_MATRIX, t3.transposed(t3.multiply(t3.hat(o), R)), R_back
    _by_axes(-0.25, model[0][3], jac.accelerations(package, jac.shift_left(c, at_S1)),
             v, w, B[:, DAMPING:])
    _by_axes(-0.25, model[0][3], jac.accelerations(package, jac.shift_left(c, at_S2)),
             t3.add(t3.apply(R, v), t3.cross(o, far)), far, B[:, DAMPING:])


@kernel
def _by_second_moment(package: Any, w: Vector, dw: Vector, axis: int) -> Vector:
    """Return the slope of the angular acceleration dw at a rate w by a logarithm of S."""
    inertia, along, k = package[2], t3.unit(axis, 1.0), 3 * axis
    r = t3.scale(0.5, t3.add_scaled(
        (inertia[k], inertia[k + 1], inertia[k + 2]), -inertia[k + axis], along))
    dI = t3.add_scaled_matrix(
        t3.add_scaled_matrix(t3.outer(along, r), 1.0, t3.outer(r, along)),
        second_moments(inertia)[axis], t3.add_scaled_matrix(
            jac.IDENTITY, -1.0, t3.outer(along, along)))
    by = t3.add(t3.apply(dI, dw), t3.cross(w, t3.apply(dI, w)))
    return t3.scale(-1.0, t3.apply(package[3], by))


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


@kernel
def write_losses(
    nominal: ModelTuple, theta: Array, cups: Array, tool: State, body: State, out: Array
) -> None:
    """
    Write M^-1 [W_i, w_i] of each cup into (6 n, 13): accelerations by error, and without.

    A gripper that loses cup i loses the wrench w_i(x) of this cup. The error e of an estimate x
    with all cups has the slope A e - M^-1 (w_i(x) + W_i e), with A of all cups and W_i the
    derivative of w_i. The linear slope has its own transition (12, 13), whose last column is the
    effect of the loss.
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
