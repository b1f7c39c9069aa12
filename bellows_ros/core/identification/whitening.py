"""
Whitened differences between measured poses of the package and those that the model simulates.

The package is simulated from a path of the tool near the measured one. What separates it from the
true package is a small state x (12,) in its own axes, as in `jacobians`. It follows the linearised
model, and is driven by what separates the tool's path from its measured poses, and by their noise:
a sample d of the tool (m, rad) acts as long as it is held,

    x <- x + held B d,    B = [T_v; A_v T_v + T_p + T_v ad(v_tool)],

with T_p, T_v and A_v the derivatives of the acceleration by pose and twist of the tool, and twist
of the package (the noise's slope is integrated by parts). The internal strains of a cup that
relaxes are 12 states more. A Kalman filter on x whitens the differences and their derivatives by
parameters. With exact poses of the tool that is output error; with noisy ones the squares that are
left are those over all paths the tool may have gone (total least squares), and the second pass,
backwards, finds the likeliest path (Bryson and Frazier).
"""

from __future__ import annotations

from typing import Any

from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.geometry.tuples import (
    add_product,
    add_scaled_matrix,
    apply,
    multiply,
    product,
    scale,
    scale_matrix,
    ZERO,
)
from bellows_ros.core.model.equilibrium import moved_by, pose_error
from bellows_ros.core.model.jacobians import (
    add_scaled_square,
    COM,
    ends_of_spring,
    LENGTH,
    NOTHING,
    parameter_jacobian,
    PARAMETERS,
    relaxation_jacobian,
    scale_square,
    shift_right,
    Square,
    strain_jacobian,
    strain_jacobians,
    times_twist,
    tool_jacobians,
    turn_right,
    write_block,
    write_column,
    write_slope,
    write_square,
)
from bellows_ros.core.model.kernels import (
    advance,
    ModelTuple,
    moved_strains,
    State,
    strains_of,
    with_strains,
)
from bellows_ros.core.model.simulation import row_state
import numpy as np

CLIPPED = 3.0
"""Differences beyond so many standard deviations count linearly, not by their squares (Huber)."""

AT_ONCE = 8
"""Most steps of the integrator in which the exponential of a linearised model is taken at once."""

NUMBERS = PARAMETERS + 2
"""Those of `jacobians.PARAMETERS`, then the two strengths of relaxation."""


@array_kernel
def _derivatives(
    model: ModelTuple, tool: State, body: State, last: int, A: Any, C: Any, B: Any
) -> None:
    """Write the slope of x by x (m, m) and by `NUMBERS` (m, 64), and B (m, 6)."""
    by_twist = write_slope(model, tool, body, A)
    parameter_jacobian(model, tool, body, 0, last, C[6:])
    of_pose, of_twist = tool_jacobians(model, tool, body)
    write_square(B, 0, 0, of_twist)
    write_square(B, 6, 0, add_scaled_square(add_scaled_square(
        of_pose, 1.0, times_twist(of_twist, tool[2], tool[3])), 1.0,
        multiply_squares(by_twist, of_twist)))
    if len(body) == 6:
        _strain_derivatives(model, tool, body, A, C, B)


@kernel
def multiply_squares(A: Square, B: Square) -> Square:
    """Return A B."""
    return (
        add_scaled_matrix(multiply(A[0], B[0]), 1.0, multiply(A[1], B[2])),
        add_scaled_matrix(multiply(A[0], B[1]), 1.0, multiply(A[1], B[3])),
        add_scaled_matrix(multiply(A[2], B[0]), 1.0, multiply(A[3], B[2])),
        add_scaled_matrix(multiply(A[2], B[1]), 1.0, multiply(A[3], B[3])),
    )


@kernel
def _strain_derivatives(
    model: ModelTuple, tool: State, body: State, A: Any, C: Any, B: Any
) -> None:
    """Write what internal strains add: dz_b/dt = (h - z_b) / tau_b, and their force."""
    by_strain, by_pose = strain_jacobians(model, tool, body)
    _, o, R, _, _, o_E_S1, _, _ = ends_of_spring(model, tool, body)
    J_oo, J_oR, J_RR = strain_jacobian(o, R)
    by_tool = shift_right(turn_right((J_oo, J_oR, NOTHING, J_RR), R), scale(-1.0, o_E_S1))
    relaxation_jacobian(model, tool, body, C[6:], PARAMETERS)
    branches, along = model[0][4:], (0.5 * R[6], 0.5 * R[7], 0.5 * R[8] + 0.5)
    for b in range(2):
        (strength, time), first = branches[b], 12 + 6 * b
        rate = 1.0 / time
        write_square(A, 6, first, scale_square(strength, by_strain))
        write_square(A, first, 0, scale_square(rate, by_pose))
        write_square(B, first, 0, scale_square(-rate, by_tool))
        write_column(C[first:], LENGTH.start, scale(rate, apply(J_oo, along)), ZERO)
        write_block(C, first, COM.start, scale_matrix(-rate, J_oo))
        for i in range(6):
            A[first + i, first + i] = -rate


@kernel
def inner_states(body: State) -> int:
    """Return the size of x."""
    return 24 if len(body) == 6 else 12


@array_kernel
def whiten(
    model: ModelTuple, body: State, S: Any, P: Any, tool: Any, lengths: Any, steps: Any,
    held: Any, innovations: Any, tool_variances: Any, tool_correlations: Any, walk: Any,
    follows: bool, place: Any, poses: Any, variance: Any, noise_variance: Any,
    noise_correlations: Any, last: int, numbers: Any, scales: Any, beyond: Any, delay: int,
    moves: Any, out: Any, slopes: Any, T: Any, B: Any, K: Any,
) -> None:
    """
    Write whitened differences and their derivatives, and what `likeliest` needs.

    The states are x (12,), with 12 internal strains where the cup relaxes, then how far the tool
    is from its path (6,), and, where it is correlated, the noise of the package's pose (6,).

    Parameters
    ----------
    model, body : tuples
        And the package at the first node.
    S, P : ndarray (n, p + 1), (n, n)
        Derivatives of the states by p parameters, then their mean, and their covariance: at the
        first node, before the tool's pose there; changed.
    tool, lengths, steps : ndarray (M, 13), (M - 1,), (M - 1,)
        The tool's path at M nodes, the time between them (s), and the steps of the integrator.
    held : ndarray (M,)
        Time (s) that a measured pose of the tool at a node stands for, 0 where there is none.
    innovations, tool_variances, tool_correlations : ndarray (M, 6), (M, 6), (M,)
        Of the noise of the tool's poses, its shift and turn from the path (m, rad): those there,
        their variances, and the correlation of the noise with that at the node before.
    walk : ndarray (6,)
        Variance that a white acceleration gives to the twist in x, per second.
    follows : bool
        Whether the package that is linearised about takes on what is estimated of x.
    place : int ndarray (M,)
        Number of the package's pose at a node, or -1.
    poses, variance : ndarray (N, 8), (N, 6)
        Measured poses of B with the little time (s) that each is after its node, and the variances
        (m^2, rad^2) of white noise in its own axes.
    noise_variance, noise_correlations : ndarray (6,), (M - 1,)
        The variance of its correlated noise, and its correlation from node to node.
    last, numbers : int, ndarray (64, p + 1)
        How many of `jacobians.PARAMETERS` are used, and `NUMBERS` by parameters.
    scales, beyond : ndarray (M, p), (p,)
        What `numbers` are multiplied by at the nodes, and the values of parameters that the model
        is without: their effect, as far as it is linear, is in the mean. Empty where it has all.
    delay : int
        The parameter by which the tool's stamps are late; -1 for none.
    moves : ndarray (N, 6, p)
        Minus the package's measured pose, in its own axes, by parameters.
    out, slopes : ndarray (N, 6), (N, 6, p)
        In units of their standard deviation.
    T, B, K : ndarray (M, n, n), (M, n, 6), (N, 6, n + 1)
        Transitions, effects of the tool's samples, half of x's there, and gains with one over the
        standard deviation of what each is of.

    """
    m = inner_states(body)
    A, C, B0, later, twist = (
        np.zeros((2, m, m)), np.zeros((2, m, NUMBERS)), np.zeros((m, 6)), np.zeros((len(P), 6)),
        np.zeros(6))
    for k in range(tool.shape[0]):
        here, own = row_state(tool[k]), k % 2
        if k > 0:
            body = advance(model, body, row_state(tool[k - 1]), here, lengths[k - 1], steps[k - 1])
        _derivatives(model, here, body, last, A[own], C[own], B0)
        _enter(0.5 * held[k], B0, B[k])  # half of a sample acts behind the package's pose
        if k > 0:
            _pass(lengths[k - 1], steps[k - 1], A, C, numbers, scales[k - 1:k + 1], beyond,
                  tool_correlations[k], noise_correlations[k - 1], walk, noise_variance, later,
                  B[k], S, P, T[k])
        _push(innovations[k], tool_variances[k], B[k], S, P)
        _enter(0.5 * held[k], B0, later)
        n = place[k]
        if n >= 0:
            pose = poses[n]
            shift, turn = pose_error(
                body, (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))
            for i in range(3):
                twist[i], twist[3 + i] = body[2][i], body[3][i]
                out[n, i] = shift[i] - pose[7] * twist[i]
                out[n, 3 + i] = turn[i] - pose[7] * twist[3 + i]
            _measure(
                variance[n], moves[n], twist, delay, m + 6, S, P, out[n], slopes[n], K[n])
            if follows:
                body = with_mean(body, S)


@kernel
def with_mean(body: State, S: Any) -> State:
    """Return a package moved by the mean of x, the last column, which becomes zero."""
    x = S[:, S.shape[1] - 1]
    there = moved_by(body, x)
    if len(body) == 4:
        x[:12] = 0.0
        return there
    there = with_strains(there, moved_strains(body[4:], 1.0, strains_of(x[12:])))
    x[:24] = 0.0
    return there


@kernel
def _enter(factor: float, effect: Any, out: Any) -> None:
    """Write how a sample of the tool acts on x, and on what it is a sample of."""
    for i in range(effect.shape[0]):
        for j in range(6):
            out[i, j] = factor * effect[i, j]
    for j in range(6):
        out[effect.shape[0] + j, j] = 1.0


@array_kernel
def _pass(
    length: float, steps: int, A: Any, C: Any, numbers: Any, scales: Any, beyond: Any,
    tool_correlation: float, noise_correlation: float, walk: Any, noise_variance: Any, later: Any,
    B: Any, S: Any, P: Any, T: Any,
) -> None:
    """Carry states, derivatives and covariance over a step; write its transition T."""
    n, m = P.shape[0], A.shape[1]
    mean, effect = np.zeros((m, m)), np.zeros((m, S.shape[1]))
    F = _exponential(_mean(length, A), steps, mean)
    pushed = product(F, later[:m], np.empty((m, 6)))
    for i in range(m):
        for j in range(m):
            T[i, j] = F[i, j]
        for j in range(6):
            T[i, m + j] = pushed[i, j] + tool_correlation * B[i, j]
    for i in range(m, n):
        T[i, i] = tool_correlation if i < m + 6 else noise_correlation
    product(_mean(length, C), numbers, effect)
    for i in range(m):
        for j in range(len(beyond)):
            effect[i, j] *= 0.5 * (scales[0, j] + scales[1, j])
            effect[i, -1] += effect[i, j] * beyond[j]
    _copy(add_product(mean, effect, product(T, S, np.empty(S.shape))), S)
    product(T, _transposed(product(T, P, np.empty((n, n)))), P)
    for i in range(6):
        P[6 + i, 6 + i] += walk[i] * length
    for i in range(m + 6, n):
        P[i, i] += (1.0 - noise_correlation * noise_correlation) * noise_variance[i - m - 6]


@array_kernel
def _mean(factor: float, A: Any) -> Any:
    """Return the mean of two matrices, times a factor."""
    out = np.empty(A.shape[1:])
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0.5 * factor * (A[0, i, j] + A[1, i, j])
    return out


@array_kernel
def _copy(A: Any, out: Any) -> None:
    """Write A."""
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i, j] = A[i, j]


@array_kernel
def _transposed(A: Any) -> Any:
    """Return A^T, its rows one after the other in memory."""
    out = np.empty(A.shape)
    for i in range(A.shape[0]):
        for j in range(A.shape[0]):
            out[i, j] = A[j, i]
    return out


@array_kernel
def _exponential(M: Any, steps: int, mean: Any) -> Any:
    """
    Return exp(M), M changed; write the mean of exp(t M) for t from 0 to 1.

    To fourth order over `AT_ONCE` steps of the integrator at most, doubled to all of them.
    """
    doublings = 0
    while steps > AT_ONCE:
        steps, doublings = (steps + 1) // 2, doublings + 1
    M *= 0.5**doublings
    F, other = _short_exponential(M, mean), np.empty(M.shape)
    for _ in range(doublings):
        mean += product(F, mean, other)
        mean *= 0.5
        F, other = product(F, F, other), F
    return F


@array_kernel
def _short_exponential(M: Any, mean: Any) -> Any:
    """Return exp(M), and write its mean, to fourth order."""
    X, Y = M.copy(), np.empty(M.shape)
    for order in range(3):  # 4 + M, 12 + M X, 24 + M Y
        if order > 0:
            product(M, X, Y)
            X, Y = Y, X
        for i in range(len(M)):
            X[i, i] += 4.0 if order == 0 else 12.0 * order
    for i in range(len(M)):
        for j in range(len(M)):
            mean[i, j] = X[i, j] / 24.0
    product(M, mean, Y)
    for i in range(len(M)):
        Y[i, i] += 1.0
    return Y


@array_kernel
def _push(innovation: Any, variances: Any, B: Any, S: Any, P: Any) -> None:
    """Add the innovation of a sample of the tool's noise, and its variances, to the states."""
    n, last = P.shape[0], S.shape[1] - 1
    noise = np.empty((6, n))
    for i in range(n):
        for j in range(6):
            noise[j, i] = variances[j] * B[i, j]
            S[i, last] += B[i, j] * innovation[j]
    add_product(B, noise, P)


@array_kernel
def _measure(
    variance: Any, moves: Any, twist: Any, delay: int, noise_state: int, S: Any, P: Any, out: Any,
    slopes: Any, K: Any,
) -> None:
    """Correct the states by the difference (6,) of a pose, number by number; whiten it."""
    n, p = P.shape[0], S.shape[1] - 1
    gain, p_row, s_row = np.empty((n, 1)), np.empty((1, n)), np.empty((1, p + 1))
    for j in range(6):
        for i in range(n):
            p_row[0, i] = P[j, i] + (P[noise_state + j, i] if n > noise_state else 0.0)
        for i in range(p + 1):
            s_row[0, i] = S[j, i] + (S[noise_state + j, i] if n > noise_state else 0.0)
        for i in range(p):
            s_row[0, i] += moves[j, i]
        if delay >= 0:
            s_row[0, delay] += twist[j]
        e = out[j] - s_row[0, p]
        s = p_row[0, j] + (p_row[0, noise_state + j] if n > noise_state else 0.0) + variance[j]
        s = max(s, s * abs(e) / (CLIPPED * np.sqrt(s)))  # Huber's weight: a larger variance
        scale = 1.0 / np.sqrt(s)
        out[j] = e * scale
        for i in range(p):
            slopes[j, i] = s_row[0, i] * scale
        s_row[0, p] = -e
        for i in range(n):
            gain[i, 0] = -p_row[0, i] / s
            K[j, i] = -gain[i, 0]
        K[j, n] = scale
        add_product(gain, p_row, P)
        add_product(gain, s_row, S)


@array_kernel
def likeliest(
    out: Any, place: Any, variances: Any, noise_state: int, T: Any, B: Any, K: Any,
    innovations: Any, slope: Any,
) -> None:
    """
    Write the innovations (M, 6) of the likeliest noise of the tool's poses, going backwards.

    Of the whitened differences `out`; `noise_state` is the first state of the package's noise.
    Slope (n,) becomes that of the first states: their likeliest change is minus their covariance
    times that.
    """
    n = len(slope)
    for k in range(len(place) - 1, -1, -1):
        if place[k] >= 0:
            _pull(out[place[k]], K[place[k]], noise_state, slope)
        for j in range(6):
            for i in range(n):
                innovations[k, j] -= variances[k, j] * B[k, i, j] * slope[i]
        if k > 0:
            later = slope.copy()
            for i in range(n):
                slope[i] = 0.0
                for j in range(n):
                    slope[i] += T[k, j, i] * later[j]


@array_kernel
def _pull(out: Any, K: Any, noise_state: int, slope: Any) -> None:
    """Take the slope by the states back before a pose."""
    n = len(slope)
    for j in range(5, -1, -1):
        total = out[j] * K[j, n]
        for i in range(n):
            total += K[j, i] * slope[i]
        slope[j] -= total
        if n > noise_state:
            slope[noise_state + j] -= total
