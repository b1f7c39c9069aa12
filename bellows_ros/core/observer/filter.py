"""
An error-state Kalman filter on SE(3) x R^6, with a wrench bias and what a payload is off by.

The error (22,) is in the package's own axes: shift (m), turn (rad), linear and angular twist
(m/s, rad/s), as in `jacobians`; then the relative error of mass and inertia, that of the centre
of mass (m), and the wrench (N, N m) on the package at the lip, in S axes, beside the cup's.

`alarms` extends it by faults, from `LENGTHENED` on: the cup's length (m) and its rate (m/s), and
the part by which its spring's force and moment are too small. A passage (13, 26) is what becomes
of the state's error since the measurement before, by all of these; its last row holds the seconds,
and speed and shift (m/s, m; world) since then of what falls.

The state goes through all samples of the tool with the predictor's steps. The covariance follows
where it is asked for, in steps as long as the package's modes allow.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import COMPILED, kernel
from bellows_ros.core.geometry.tuples import (
    add,
    add_scaled,
    apply,
    hat,
    rotation_matrix,
    scale,
    scale_matrix,
    Vector,
)
from bellows_ros.core.model.equilibrium import linearise, moved, substeps_for
from bellows_ros.core.model.jacobians import (
    acceleration_at,
    body_jacobians,
    parameter_jacobian,
    write_block,
    write_column,
    write_square,
)
from bellows_ros.core.model.kernels import (
    advance,
    lip_wrench,
    ModelTuple,
    State,
    tool_at,
    tool_segment,
    with_twist,
    Wrench,
)
from bellows_ros.core.model.simulation import body_row, row_state, write_row
import numpy as np

CENTRE = slice(13, 16)
LENGTHENED, LENGTHENING, FORCE, MOMENT = 22, 23, 24, 25
ZERO = (0.0, 0.0, 0.0)

UNPASSED: Array = np.vstack([np.eye(12, 26), np.zeros((1, 26))])
"""The transition over no time."""

COARSE = 8
"""The covariance is propagated in steps up to this many times longer than the state's."""

NOT_FOLLOWED: Array = np.zeros((0, 0))
"""Stands for a covariance or transition that is not computed."""


if COMPILED:
    @kernel
    def add_product(A: Array, B: Array, out: Array) -> Array:
        """Add A B, and return the sum: four columns of A at once, and none that are zero."""
        n = A.shape[1]
        for i in range(A.shape[0]):
            for k in range(0, n - 3, 4):
                a, b, c, d = A[i, k], A[i, k + 1], A[i, k + 2], A[i, k + 3]
                if a != 0.0 or b != 0.0 or c != 0.0 or d != 0.0:
                    for j in range(B.shape[1]):
                        out[i, j] += (
                            a * B[k, j] + b * B[k + 1, j] + c * B[k + 2, j] + d * B[k + 3, j])
            for k in range(n - n % 4, n):
                if A[i, k] != 0.0:
                    for j in range(B.shape[1]):
                        out[i, j] += A[i, k] * B[k, j]
        return out
else:
    def add_product(A: Array, B: Array, out: Array) -> Array:
        """Add A B, and return the sum."""
        out += A @ B
        return out


@kernel
def product(A: Array, B: Array, out: Array) -> Array:
    """Write A B and return it: two columns of A at a time, skipping zero ones."""
    out[:] = 0.0
    return add_product(A, B, out)


@kernel
def turned_over(A: Array) -> Array:
    """Return A^T, its rows one after the other in memory."""
    return np.ascontiguousarray(A.T)


class Estimate(NamedTuple):
    """The estimated package at one stamp."""

    stamp_ns: int
    tool: State
    body: State
    theta: Array
    """The relative error of mass and inertia, that of the centre of mass, and the wrench (10,)."""
    covariance: Array
    """Of the error (22, 22)."""
    refused: int = 0
    """Consecutive measurements outside the gate."""
    passage: Array = NOT_FOLLOWED
    """Transition since the previous measurement (13, 26), if it is computed."""


Driving = tuple[Array, Array]
"""
What drives the error: the covariance of the state (12, 12) due to noise of the tool's pose, held
for a second, and variances of the random walk of the error (22,) per second.
"""


@kernel
def with_payload(model: ModelTuple, theta: Array) -> ModelTuple:
    """Return a model with mass and inertia 1 + theta[0] times as large, and B shifted (m)."""
    cup, package, gravity = model
    mass, com, inertia, inverse = package
    k = 1.0 + theta[0]
    return cup, (
        k * mass, add(com, (theta[1], theta[2], theta[3])),
        scale_matrix(k, inertia), scale_matrix(1.0 / k, inverse),
    ), gravity


@kernel
def wrench_of(theta: Array) -> Wrench:
    """Return the wrench bias (N, N m)."""
    return (theta[4], theta[5], theta[6]), (theta[7], theta[8], theta[9])


def changed(body: State, error: Array) -> State:
    """Return a state changed by an error (12,)."""
    a, b, c, d, e, f, g, h, i, j, k, m = error.tolist()
    return moved(body, (a, b, c), (d, e, f), (g, h, i), (j, k, m))


def driving(model: ModelTuple, tool: State, body: State, noise: Array, walk: Array) -> Driving:
    """
    Return the effect of white noise (6,) of the tool's pose, linearised about a state.

    The tool's twist is the derivative of its noise e. Integrated by parts, its slope T_v acts
    like the slope A T_v of e.
    """
    by = linearise(model, tool, body)
    drive = np.vstack([by.tool_twist, by.tool_pose + by.body_twist @ by.tool_twist]) * noise
    return drive @ drive.T, walk


@kernel
def pushed(
    model: ModelTuple, push: Wrench, body: State, start: State, end: State, seconds: float,
    substeps: int,
) -> State:
    """Return a state after a motion of the tool: half of the push before and half after it."""
    dv, dw = acceleration_at(model[1], model[1][1], push[0], push[1])
    half = 0.5 * seconds
    body = with_twist(body, add_scaled(body[2], half, dv), add_scaled(body[3], half, dw))
    body = advance(model, body, start, end, seconds, substeps)
    return with_twist(body, add_scaled(body[2], half, dv), add_scaled(body[3], half, dw))


@kernel
def slopes(
    model: ModelTuple, push: Wrench, grown: float, tool: State, body: State, A: Array, B: Array
) -> Vector:
    """
    Write the slope of the state's error, and return the force of the cup in the world (N).

    Parameters
    ----------
    model, push, tool, body : tuples
        With the payload as it is estimated.
    grown : float
        By how much mass and inertia are times the nominal ones.
    A : ndarray (12, 12)
        Slope by the state's error: pose and twist change in axes that turn with the body.
    B : ndarray (12, 13)
        By the rest of the error, and by the faults from `LENGTHENED` to `MOMENT` but the rate.

    """
    package, com = model[1], model[1][1]
    v_hat, w_hat = hat(body[2]), hat(body[3])
    by_pose, by_twist = body_jacobians(model, tool, body)
    write_block(A, 0, 0, scale_matrix(-1.0, w_hat))
    write_block(A, 0, 3, scale_matrix(-1.0, v_hat))
    write_block(A, 3, 3, scale_matrix(-1.0, w_hat))
    for i in range(6):
        A[i, 6 + i] = 1.0
    write_square(A, 6, 0, by_pose)
    write_square(A, 6, 6, by_twist)
    columns = np.zeros((6, 20))
    parameter_jacobian(model, tool, body, 42, 62, columns, 0)
    f, m = lip_wrench(model, tool, body)
    dv, dw = acceleration_at(package, com, add(f, push[0]), add(m, push[1]))
    write_column(B[6:], 0, scale(-1.0 / grown, dv), scale(-1.0 / grown, dw))
    x, y, z = push[0]
    # by the centre of mass (m), the push has another arm: -e x push
    ex = apply(package[3], (0.0, z, -y))
    ey = apply(package[3], (-z, 0.0, x))
    ez = apply(package[3], (y, -x, 0.0))
    for i in range(6):
        for j in range(9):
            B[6 + i, 1 + j] = columns[i, 11 + j]
        B[6 + i, 10] = columns[i, 0]
    for i in range(3):
        B[9 + i, 1] += ex[i]
        B[9 + i, 2] += ey[i]
        B[9 + i, 3] += ez[i]
    still = lip_wrench(model, with_twist(tool, ZERO, ZERO), with_twist(body, ZERO, ZERO))
    dv, dw = acceleration_at(package, com, still[0], ZERO)
    write_column(B[6:], 11, dv, dw)
    dv, dw = acceleration_at(package, com, ZERO, still[1])
    write_column(B[6:], 12, dv, dw)
    return apply(rotation_matrix(body[1]), f)


@kernel
def spread(
    A: Array, B: Array, h: float, held: float, noise: Array, walk: Array, P: Array
) -> tuple[Array, Array]:
    """
    Propagate a covariance (22, 22) in place; return the transition (12, 12 + 13).

    With G the mean of exp(A t) over the step, to fourth order, the error becomes
    (I + h A G) x + h G B theta. What drives it acts half before and half after the step.

    Parameters
    ----------
    A, B : ndarray
        As `slopes` gives them, for the whole step.
    h, held : float
        Length of the step (s); sum of products (s^2) with the times the tool's noise is held.
    noise, walk : ndarray
        Of `Driving`.
    P : ndarray (22, 22)
        Covariance of the error.

    """
    X, F = np.empty((12, 12)), np.empty((12, 12))
    G = _beside_unity(0.25 * h, A, np.empty((12, 12)))
    for n in (3.0, 2.0):
        _beside_unity(h / n, product(A, G, X), G)
    _beside_unity(h, product(A, G, X), F)
    D = product(G[:, 6:], B[6:], np.empty((12, 13)))  # rows of poses are zero in B
    T, side = np.empty((12, 22)), np.empty((22, 12))
    for i in range(12):
        for j in range(13):
            D[i, j] *= h
        for j in range(22):
            T[i, j] = F[i, j] if j < 12 else D[i, j - 12]
    _drive(P, 0.5 * h, 0.5 * held, noise, walk)
    product(P, turned_over(T), side)
    product(T, side, X)
    for i in range(12):
        for j in range(12):
            P[i, j] = X[i, j]
        for j in range(12, 22):
            P[i, j] = P[j, i] = side[j, i]
    _drive(P, 0.5 * h, 0.5 * held, noise, walk)
    return F, D


@kernel
def _beside_unity(factor: float, A: Array, out: Array) -> Array:
    """Write I + factor A, and return it."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = factor * A[i, j]
        out[i, i] += 1.0
    return out


@kernel
def _drive(P: Array, h: float, held: float, noise: Array, walk: Array) -> None:
    """Add the process noise to the error's covariance."""
    for i in range(12):
        for j in range(12):
            P[i, j] += held * noise[i, j]
    for i in range(22):
        P[i, i] += h * walk[i]


@kernel
def pass_on(M: Array, F: Array, D: Array, h: float, falling: Vector) -> None:
    """
    Carry a passage (13, 26) through a step that `spread` has described, in place.

    What falls is accelerated by `falling` (m/s^2, world) against the model, which holds it.
    """
    X, last = product(F, M[:12], np.empty((12, 26))), M[12]
    for i in range(12):
        for j in range(26):
            M[i, j] = X[i, j]
        for j in range(11):
            M[i, 12 + j] += D[i, j]
        M[i, LENGTHENING] += (last[0] + 0.5 * h) * D[i, 10]
        M[i, FORCE] += D[i, 11]
        M[i, MOMENT] += D[i, 12]
    for i in range(3):
        last[4 + i] += h * (last[1 + i] + 0.5 * h * falling[i])
        last[1 + i] += h * falling[i]
    last[0] += h


@kernel
def is_coarse(stamp_ns: int, next_ns: int, longest: float) -> bool:
    """Return whether a covariance step ends at a sample, regardless of where it began."""
    length_ns = int(1e9 * min(COARSE * longest, 1.0))
    return stamp_ns // length_ns != next_ns // length_ns


@kernel
def swept(
    model: ModelTuple, theta: Array, tool: State, body: State, P: Array, M: Array,
    stamps: Any, starts: Any, ends: Any, bodies: Any, is_known: bool, k: int, now_ns: int,
    until_ns: int, longest: float, driven: Driving,
) -> tuple[State, State]:
    """
    Return tool and package at a later stamp, and carry covariance and passage there in place.

    Parameters
    ----------
    model, theta : tuple and ndarray
        With the payload and the wrench as they are estimated.
    tool, body : State
        At the beginning.
    P, M : ndarray (22, 22), (13, 26)
        Covariance and passage; of no size where they are not followed.
    stamps, starts, ends : sequences
        Of the tool's samples: stamp (ns), and states (13,) at the beginning and at the end of
        its motion from the sample before.
    bodies : sequence
        The package at each sample (13,).
    is_known : bool
        Whether the package has gone this way before: it is read there, else it is written.
    k : int
        The first sample after the beginning.
    now_ns, until_ns : int
        Beginning, and end.
    longest : float
        Longest step of the state, s.
    driven : tuple of ndarray
        `Driving`.

    """
    push, follows, fresh, h, held = wrench_of(theta), P.shape[0] > 0, True, 0.0, 0.0
    A0, B0 = np.zeros((12, 12)), np.zeros((12, 13))
    A1, B1 = np.zeros((12, 12)), np.zeros((12, 13))
    while True:
        if follows and (fresh or now_ns == until_ns or now_ns != stamps[k - 1] or is_coarse(
                now_ns, stamps[k], longest)):
            force = slopes(model, push, 1.0 + theta[0], tool, body, A1, B1)
            if not fresh:
                F, D = spread(
                    0.5 * (A0 + A1), 0.5 * (B0 + B1), h, held, driven[0], driven[1], P)
                if M.shape[0]:
                    pass_on(M, F, D, h, scale(-1.0 / model[1][0], force))
            A0, B0, A1, B1 = A1, B1, A0, B0
            fresh, h, held = False, 0.0, 0.0
        if now_ns == until_ns:
            return tool, body
        whole_ns = stamps[k] - stamps[k - 1]
        if now_ns == stamps[k - 1]:
            tool = row_state(starts[k])
        later_ns = min(stamps[k], until_ns)
        cuts = substeps_for((later_ns - now_ns) * 1e-9, COARSE * longest)
        later_ns = now_ns + (later_ns - now_ns) // cuts
        there = row_state(ends[k])
        if later_ns < stamps[k]:
            segment = tool_segment(row_state(starts[k]), there, whole_ns * 1e-9)
            there = tool_at(segment, (later_ns - stamps[k - 1]) / whole_ns)
        part = (later_ns - now_ns) * 1e-9
        body = _followed(
            model, push, body, tool, there, part, longest, bodies[k], is_known,
            later_ns == stamps[k])
        tool, now_ns, h, held = there, later_ns, h + part, held + part * whole_ns * 1e-9
        if now_ns == stamps[k]:
            k += 1


@kernel
def _followed(
    model: ModelTuple, push: Wrench, body: State, start: State, end: State, seconds: float,
    longest: float, row: Any, is_known: bool, is_sample: bool,
) -> State:
    """Return a state after a motion of the tool, from or into the row of a sample at its end."""
    if is_known and is_sample:
        return body_row(row, body)
    body = pushed(model, push, body, start, end, seconds, substeps_for(seconds, longest))
    if is_sample:
        write_row(row, body)
    return body


@kernel
def followed(
    model: ModelTuple, theta: Array, body: State, stamps: Any, starts: Any, ends: Any, bodies: Any,
    k: int, stamp_ns: int, start: State, end: State, longest: float,
) -> State:
    """Keep a sample of the tool as number k, and return the package there."""
    stamps[k] = stamp_ns
    write_row(starts[k], start)
    write_row(ends[k], end)
    seconds, tool = (stamp_ns - stamps[k - 1]) * 1e-9, start
    cuts = substeps_for(seconds, COARSE * longest)
    part = seconds / cuts
    for i in range(cuts):
        there = end
        if i < cuts - 1:
            there = tool_at(tool_segment(start, end, seconds), (i + 1) / cuts)
        body = pushed(
            model, wrench_of(theta), body, tool, there, part, substeps_for(part, longest))
        tool = there
    write_row(bodies[k], body)
    return body
