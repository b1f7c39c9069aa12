"""
Whitened differences between measured poses of the package and those that the model simulates.

The package is simulated from a path of the tool near the measured one. What separates it from the
true package is a small state x (12,) in its own axes, as in `jacobians`. It follows the linearised
model, and is driven by what separates the tool's path from its measured poses, and by their noise:
a sample d of the tool (m, rad) acts as long as it is held,

    x <- x + held B d,    B = [T_v; A_v T_v + T_p + T_v ad(v_tool)],

with T_p, T_v and A_v the derivatives of the acceleration by pose and twist of the tool, and twist
of the package (the noise's slope is integrated by parts). A Kalman filter on x whitens the
differences and their derivatives by parameters. With exact poses of the tool that is output error;
with noisy ones the squares that are left are those over all paths the tool may have gone (total
least squares), and the second pass, backwards, finds the likeliest path (Bryson and Frazier).
"""

from __future__ import annotations

from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import hat, scale_matrix
from bellows_ros.core.model.equilibrium import moved, pose_error
from bellows_ros.core.model.jacobians import (
    body_jacobians,
    parameter_jacobian,
    tool_jacobians,
    write_block,
    write_square,
)
from bellows_ros.core.model.kernels import advance, ModelTuple, State
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.observer.filter import add_product, product, transpose
import numpy as np

CLIPPED = 3.0
"""Differences beyond so many standard deviations count linearly, not by their squares (Huber)."""


@kernel
def _derivatives(
    model: ModelTuple, tool: State, body: State, numbers: Any, A: Any, D: Any, B: Any
) -> None:
    """Write the slope of x by x (12, 12) and by parameters (12, p), and B (12, 6)."""
    by_pose, by_twist = body_jacobians(model, tool, body)
    v_hat, w_hat = hat(body[2]), hat(body[3])
    write_block(A, 0, 0, scale_matrix(-1.0, w_hat))
    write_block(A, 0, 3, scale_matrix(-1.0, v_hat))
    write_block(A, 3, 3, scale_matrix(-1.0, w_hat))
    write_square(A, 6, 0, by_pose)
    write_square(A, 6, 6, by_twist)
    columns = np.zeros((6, len(numbers)))
    parameter_jacobian(model, tool, body, 0, len(numbers), columns, 0)
    D[6:] = product(columns, numbers, np.empty((6, numbers.shape[1])))
    of_pose, of_twist = tool_jacobians(model, tool, body)
    pose, twist = np.empty((6, 6)), np.empty((6, 6))
    write_square(pose, 0, 0, of_pose)
    write_square(twist, 0, 0, of_twist)
    turning = np.zeros((6, 6))
    write_block(turning, 0, 0, hat(tool[3]))
    write_block(turning, 0, 3, hat(tool[2]))
    write_block(turning, 3, 3, hat(tool[3]))
    still = product(twist, turning, np.empty((6, 6)))
    moving = product(np.ascontiguousarray(A[6:, 6:]), twist, np.empty((6, 6)))
    for i in range(6):
        A[i, 6 + i] = 1.0
        for j in range(6):
            B[i, j] = twist[i, j]
            B[6 + i, j] = moving[i, j] + pose[i, j] + still[i, j]


@kernel
def _exponential(h: float, A: Any, F: Any) -> Array:
    """Write exp(h A) to fourth order; return the mean of exp(t A) over the step."""
    G, X = np.eye(12) + 0.25 * h * A, np.empty((12, 12))
    for n in (3.0, 2.0):
        G = np.eye(12) + (h / n) * product(A, G, X)
    F[:] = np.eye(12) + h * product(A, G, X)
    return G  # type: ignore[no-any-return]


@kernel
def whiten(
    model: ModelTuple, body: State, x: Any, P: Any, tool: Any, lengths: Any, steps: Any,
    held: Any, way: Any, noise: Any, kept: float, walk: Any, follows: bool, place: Any,
    poses: Any, variance: Any, colour: Any, fading: float, numbers: Any, delay: int, moves: Any,
    out: Any, slopes: Any, F: Any, B: Any, K: Any,
) -> None:
    """
    Write whitened differences and their derivatives, and what `likeliest` needs.

    Parameters
    ----------
    model, body : tuples
        And the package at the first node.
    x, P : ndarray (n,), (n, n)
        What is expected of x there, then of the noise of the tool's pose (6,), and, where it is
        correlated (n = 24), of that of the package's; changed.
    tool, lengths, steps : ndarray (M, 13), (M - 1,), (M - 1,)
        The tool's path at M nodes, the time between them (s), and the steps of the integrator.
    held, way, noise : ndarray (M,), (M, 6), (M, 6)
        Time (s) that a measured pose of the tool at a node stands for, 0 where there is none; its
        shift and turn from the path (m, rad), and the variance of its noise.
    kept : float
        Correlation of this noise between successive poses.
    walk : ndarray (6,)
        Variance that a white acceleration gives to the twist in x, per second.
    follows : bool
        Whether the package that is linearised about takes on what is estimated of x.
    place : int ndarray (M,)
        Number of the package's pose at a node, or -1.
    poses, variance : ndarray (N, 7), (N, 6)
        Measured poses of B, and the variances (m^2, rad^2) of white noise in its own axes.
    colour, fading : ndarray (6,), float
        The variance of its correlated noise, and the rate (1/s) at which that is forgotten.
    numbers : ndarray (n, p)
        The first numbers of `jacobians.PARAMETERS` by parameters.
    delay : int
        The parameter by which the tool's stamps are late; -1 for none.
    moves : ndarray (N, 6, p)
        Minus the package's measured pose, in its own axes, by parameters.
    out, slopes : ndarray (N, 6), (N, 6, p)
        In units of their standard deviation.
    F, B, K : ndarray (M, 12, 12), (M, 12, 6), (N, 6, n + 1)
        Transitions, half the effects of the tool's samples, and gains with one over the standard
        deviation of what each is of.

    """
    size, count = P.shape[0], numbers.shape[1]
    S, A0, B0, D0 = (
        np.zeros((size, count)), np.zeros((12, 12)), np.zeros((12, 6)), np.zeros((12, count)))
    A1, D1 = A0.copy(), D0.copy()
    for k in range(tool.shape[0]):
        here = row_state(tool[k])
        if k > 0:
            body = advance(model, body, row_state(tool[k - 1]), here, lengths[k - 1], steps[k - 1])
        _derivatives(model, here, body, numbers, A1, D1, B0)
        if k > 0:
            _pass(
                lengths[k - 1], 0.5 * (A0 + A1), 0.5 * (D0 + D1), kept > 0.0, walk, x, P, S, F[k])
            if size > 18:
                _forget(18, np.exp(-fading * lengths[k - 1]), colour, x, P, S)
        A0, A1, D0, D1 = A1, A0, D1, D0
        n = place[k]
        if held[k] > 0.0:  # half of a sample acts before, half behind the package's pose
            _forget(12, kept, noise[k], x, P, S)
            B[k] = 0.5 * held[k] * B0
            _push(B[k], way[k], x, P, S, kept > 0.0)
        if n >= 0:
            pose = poses[n]
            shift, turn = pose_error(
                body, (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))
            _measure(
                shift + turn, variance[n], moves[n], body[2] + body[3], delay, x, P, S,
                out[n], slopes[n], K[n])
            if follows:
                body = moved(
                    body, (x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8]),
                    (x[9], x[10], x[11]))
                x[:12] = 0.0
        if held[k] > 0.0:
            _push(B[k], way[k], x, P, S, kept > 0.0 or n >= 0)


@kernel
def _pass(
    h: float, A: Any, D: Any, lasting: bool, walk: Any, x: Any, P: Any, S: Any, F: Any
) -> None:
    """Carry x, its covariance and its derivatives over a time; write the transition."""
    G = _exponential(h, A, F)
    x[:12] = F @ x[:12]
    if lasting or P.shape[0] > 18:
        P[:12] = product(F, P[:12], np.empty((12, P.shape[0])))
        P[:, :12] = product(
            np.ascontiguousarray(P[:, :12]), transpose(F), np.empty((P.shape[0], 12)))
    else:  # what is known of a sample's noise is of no use later
        side = product(np.ascontiguousarray(P[:12, :12]), transpose(F), np.empty((12, 12)))
        P[:12, :12] = product(F, side, np.empty((12, 12)))
    for i in range(6):
        P[6 + i, 6 + i] += walk[i] * h
    S[:12] = add_product(G, h * D, product(F, S[:12], np.empty(D.shape)))


@kernel
def _forget(first: int, kept: float, variance: Any, x: Any, P: Any, S: Any) -> None:
    """Let six states of noise keep a part of themselves, at a constant variance."""
    for i in range(first, first + 6):
        x[i] *= kept
        for c in range(S.shape[1]):
            S[i, c] *= kept
        for m in range(P.shape[0]):
            P[i, m] *= kept
            P[m, i] *= kept
        P[i, i] += (1.0 - kept * kept) * variance[i - first]


@kernel
def _push(B: Any, way: Any, x: Any, P: Any, S: Any, seen: bool) -> None:
    """
    Let a sample of the tool act on x: where it is from the path, and its noise.

    Unless something was seen of this noise, no parameter says anything of it.
    """
    size = P.shape[0]
    for i in range(12):
        for j in range(6):
            x[i] += B[i, j] * (way[j] + x[12 + j])
            if seen:
                for c in range(S.shape[1]):
                    S[i, c] += B[i, j] * S[12 + j, c]
            for m in range(size):
                P[i, m] += B[i, j] * P[12 + j, m]
    for i in range(size):
        for j in range(6):
            part = P[i, 12 + j]
            for m in range(12):
                P[i, m] += B[m, j] * part


@kernel
def _measure(
    error: Any, variance: Any, moves: Any, twist: Any, delay: int, x: Any, P: Any, S: Any,
    out: Any, slopes: Any, K: Any,
) -> None:
    """Correct x by the difference (6,) of a pose, and write it whitened."""
    size = P.shape[0]
    for j in range(6):
        e, r, slope = error[j] - x[j], variance[j], S[j] + moves[j]
        for i in range(size):
            K[j, i] = P[i, j]
        if size > 18:
            e -= x[18 + j]
            K[j, :size] += P[18 + j]
            r += K[j, 18 + j]
            slope += S[18 + j]
        if delay >= 0:
            slope[delay] += twist[j]
        s = K[j, j] + r
        s = max(s, s * abs(e) / (CLIPPED * np.sqrt(s)))  # Huber's weight: a larger variance
        _correct(K[j, :size], s, e, slope, x, P, S)
        K[j, size] = 1.0 / np.sqrt(s)
        out[j] = e * K[j, size]
        slopes[j] = slope * K[j, size]


@kernel
def _correct(K: Any, s: float, e: float, slope: Any, x: Any, P: Any, S: Any) -> None:
    """Correct x, its derivatives and its covariance by one number; K becomes the gain."""
    size = P.shape[0]
    for i in range(size):
        gain = K[i] / s
        x[i] += gain * e
        for c in range(S.shape[1]):
            S[i, c] -= gain * slope[c]
        for m in range(size):
            P[i, m] -= gain * K[m]
    for i in range(size):
        K[i] /= s


@kernel
def likeliest(
    out: Any, place: Any, held: Any, noise: Any, kept: float, F: Any, B: Any, K: Any, fading: Any,
    way: Any, slope: Any,
) -> None:
    """
    Write what is fresh in the likeliest noise (M, 6) of the tool's poses, going backwards.

    Of the innovations `out`; fading (M - 1,) is what the package's noise keeps over each step.
    Slope (n,) becomes that of the first state: its likeliest change is minus its covariance times
    that.
    """
    size = len(slope)
    for k in range(len(place) - 1, -1, -1):
        if held[k] > 0.0:
            _pull(B[k], slope)
        n = place[k]
        if n >= 0:
            for j in range(5, -1, -1):
                total = out[n, j] * K[n, j, size] + np.sum(K[n, j, :size] * slope)
                slope[j] -= total
                if size > 18:
                    slope[18 + j] -= total
        if held[k] > 0.0:
            _pull(B[k], slope)
            way[k] = -(1.0 - kept * kept) * noise[k] * slope[12:18]
            slope[12:18] *= kept
        if k > 0:
            slope[:12] = transpose(F[k]) @ slope[:12]
            if size > 18:
                slope[18:] *= fading[k - 1]


@kernel
def _pull(B: Any, slope: Any) -> None:
    """Take the slope by x back through a push."""
    for j in range(6):
        for i in range(12):
            slope[12 + j] += B[i, j] * slope[i]
