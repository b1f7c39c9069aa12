"""
The motion of a package with estimated parameters, and its slopes by all errors.

The vector theta has the rows of `states` from `MASS` on. Slopes are differences of the
acceleration.
"""

from __future__ import annotations

import math

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import moved
from bellows_ros.core.model.kernels import Blocks, ModelTuple, State, Wrench
from bellows_ros.core.model.pseudo_inertia import stretched
from bellows_ros.core.observer.states import (
    COM,
    DAMPING,
    INERTIA,
    MARKER,
    MASS,
    SPEED,
    SPIN,
    STATE,
    STIFFNESS,
    WRENCH,
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

DIFFERENCE = 1e-6
"""Step of the differences, in the unit of each row: by truncation slopes err by 1e-6, and by
rounding of an acceleration of 1000 m/s^2 by 1e-7 of it."""


@kernel
def with_theta(model: ModelTuple, theta: Array) -> ModelTuple:
    """Return a model with its parameters changed by theta."""
    cup, (mass, com, inertia, inverse), gravity = model
    k = math.exp(theta[MASS - STATE])
    (oo, oR, RR), P = _scaled(cup[2], theta[STIFFNESS - STATE:]), cup[3]
    P = _scaled(P, theta[DAMPING - STATE:])
    s, by = theta[INERTIA - STATE:], theta[COM - STATE:]
    if s[0] != 0.0 or s[1] != 0.0 or s[2] != 0.0:
        inertia = stretched(inertia, (0.5 * s[0], 0.5 * s[1], 0.5 * s[2]))
        inverse = t3.inverse(inertia)
    return (cup[0], cup[1], (oo, oR, RR, *cup[2][3:]), P, *cup[4:]), (
        k * mass, t3.add(com, (by[0], by[1], by[2])), t3.scale_matrix(k, inertia),
        t3.scale_matrix(1.0 / k, inverse)), gravity


@entry
def model_at(row: Array, law: kernels.LawTuple, theta: Array) -> ModelTuple:
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
        lighter = min(lighter, theta[INERTIA - STATE + i])
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
    k, by = math.exp(theta[MASS - STATE]), theta[WRENCH - STATE:]
    return t3.scale(k, (by[0], by[1], by[2])), t3.scale(k, (by[3], by[4], by[5]))


@entry
def acceleration(
    model: ModelTuple, bias: Wrench, tool: State, body: State
) -> tuple[Vector, Vector]:
    """Return the rate of the body twist with an additional wrench at the lip."""
    dv, dw = kernels.body_acceleration(model, tool, body)
    by = _by_wrench(model, bias)
    return t3.add(dv, by[0]), t3.add(dw, by[1])


@kernel
def _by_wrench(model: ModelTuple, wrench: Wrench) -> tuple[Vector, Vector]:
    """Return the accelerations by a wrench at the lip (3.5)."""
    f, m = kernels.wrench_at_com(model[1][1], *wrench)
    return t3.scale(1.0 / model[1][0], f), t3.apply(model[1][3], m)


@kernel
def shaken(state: State, row: int, by: float) -> State:
    """Return a state changed in one row of its error, in its own axes."""
    e = t3.unit(row % 3, by)
    return moved(state, e if row < 3 else t3.ZERO, e if 3 <= row < 6 else t3.ZERO,
                 e if 6 <= row < 9 else t3.ZERO, e if row >= 9 else t3.ZERO)


@kernel
def write_difference(
    now: tuple[Vector, Vector], changed: tuple[Vector, Vector], column: int, out: Array
) -> None:
    """Write the slope of an acceleration into a column (6,)."""
    for i in range(3):
        out[i, column] = (changed[0][i] - now[0][i]) / DIFFERENCE
        out[3 + i, column] = (changed[1][i] - now[1][i]) / DIFFERENCE


@kernel
def slopes(
    nominal: ModelTuple, theta: Array, tool: State, body: State, A: Array, B: Array
) -> None:
    """
    Write the slope of the state's error.

    Parameters
    ----------
    nominal, theta, tool, body
        Nominal model, and the estimate.
    A : ndarray (12, 12)
        Slope by the state's error: pose and twist change in axes that rotate with the body.
    B : ndarray (6, m)
        Slope of the twist's error by the other rows before `MARKER`; m is 0 or `MARKER`.

    """
    model, bias = with_theta(nominal, theta), wrench_bias(theta)
    now, (v, w) = acceleration(model, bias, tool, body), body[2:4]
    v_hat, w_hat = t3.hat(v), t3.hat(w)
    for i in range(3):
        A[i, 6 + i] = A[3 + i, 9 + i] = 1.0
        for j in range(3):
            A[i, j] = A[3 + i, 3 + j] = -w_hat[3 * i + j]
            A[i, 3 + j] = -v_hat[3 * i + j]
    for j in range(STATE):
        write_difference(
            now, acceleration(model, bias, tool, shaken(body, j, DIFFERENCE)), j, A[6:])
    changed = theta.copy()
    for j in range(STATE, B.shape[1]):
        changed[j - STATE] += DIFFERENCE
        write_difference(now, acceleration(
            with_theta(nominal, changed), wrench_bias(changed), tool, body), j, B)
        changed[j - STATE] = theta[j - STATE]


@entry
def slopes_at(
    nominal: ModelTuple, theta: Array, tool: State, body: State
) -> tuple[Array, Array]:
    """Return the results of `slopes`, A (12, 12) and B (6, MARKER)."""
    A, B = np.zeros((STATE, STATE)), np.zeros((6, MARKER))
    slopes(nominal, theta, tool, body, A, B)
    return A, B


def equilibrium_slope(
    nominal: ModelTuple, theta: Array, tool: State, body: State
) -> Array:
    """
    Return the derivative (6, k) of an equilibrium's pose by the rows of theta before `MARKER`.

    A change of the parameters changes the acceleration of the package; its pose changes so that
    the acceleration remains.
    """
    A, B = slopes_at(nominal, theta, tool, body)
    return np.asarray(-np.linalg.solve(A[6:, :6], B[:, STATE:]))


@entry
def driving(model: ModelTuple, tool: State, body: State, noise: Array) -> Array:
    """
    Return the covariances of the state by white noise (6,) of the tool, held for 1 s.

    The result is (3, 12, 12): for the whole noise, and for noise of position or of rotation alone
    with unit variance. The noise of the tool's twist is the derivative of the pose noise e;
    integrated by parts, the slope T_v of the twist becomes the slope A T_v of e. The derivatives
    are linearised about a state.
    """
    now, of_tool, of_body = (
        kernels.body_acceleration(model, tool, body), np.zeros((6, 12)), np.zeros((6, 12)))
    for j in range(STATE):
        write_difference(
            now, kernels.body_acceleration(model, shaken(tool, j, DIFFERENCE), body), j, of_tool)
        write_difference(
            now, kernels.body_acceleration(model, tool, shaken(body, j, DIFFERENCE)), j, of_body)
    drive, out = np.zeros((12, 6)), np.zeros((3, 12, 12))
    for i in range(6):
        for j in range(6):
            drive[i, j], drive[6 + i, j] = of_tool[i, 6 + j], of_tool[i, j]
            for k in range(6):
                drive[6 + i, j] += of_body[i, 6 + k] * of_tool[k, 6 + j]
    for i in range(12):
        for j in range(12):
            for k in range(6):
                square = drive[i, k] * drive[j, k]
                out[0, i, j] += noise[k] * noise[k] * square
                out[1 + k // 3, i, j] += square
    return out


@entry
def advanced_with_wrench(
    model: ModelTuple, bias: Wrench, body: State, start: State, end: State, seconds: float,
    substeps: int,
) -> State:
    """Return a state after a motion of the tool; half of the push acts before, half after."""
    dv, dw = _by_wrench(model, bias)
    dv, dw = t3.scale(0.5 * seconds, dv), t3.scale(0.5 * seconds, dw)
    body = kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))
    body = kernels.advance(model, body, start, end, seconds, substeps)
    return kernels.with_twist(body, t3.add(body[2], dv), t3.add(body[3], dw))
