"""
Whitened differences between measured poses of the package and those that the model simulates.

The package is simulated from a path of the tool near the measured one. What separates it from the
true package is a small state x (12,) in body axes, as in `jacobians`. It follows the linearised
model, and is driven by what separates the tool's path from its measured poses, and by their noise:
a sample d of the tool (m, rad) acts while it is the nearest one,

    dx/dt = A x + B d,    B = [T_v; A_v T_v + T_p + T_v ad(v_tool)],

with T_p, T_v and A_v the derivatives of the acceleration by pose and twist of the tool, and twist
of the package (the noise's slope is integrated by parts). Over a step between nodes A and B are
held, and d is linear: a stiff cup settles within one. The internal strains of a cup that
relaxes are 12 states more. A Kalman filter on x whitens the differences and their derivatives by
parameters. With exact poses of the tool that is output error; with noisy ones the squares that are
left are those over all paths the tool may have gone (total least squares), and the second pass,
backwards, finds the likeliest path (Bryson and Frazier).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import moved_by, pose_error
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import row_state
import numpy as np

HUBER_STD = 3.0
"""Differences beyond so many standard deviations count linearly, not by their squares (Huber)."""

MAX_EXPONENTIAL_STEPS = 8
"""Largest number of the integrator's steps that one fourth-order exponential covers."""

PARAMETER_COUNT = jac.PARAMETER_COLUMNS + 2
"""Those of `jacobians.PARAMETER_COLUMNS`, then the two strengths of relaxation."""


@array_kernel
def _derivatives(
    model: ModelTuple, tool: State, body: State, last: int, A: Any, C: Any, B: Any
) -> None:
    """Write the slope of x by x (m, m) and by the model's parameters (m, 64), and B (m, 6)."""
    jac.write_slope(model, tool, body, A)
    jac.parameter_jacobian(model, tool, body, 0, last, C[6:])
    of_pose, of_twist = jac.tool_jacobians(model, tool, body)
    jac.write_square(B, 0, 0, of_twist)
    jac.write_square(B, 6, 0, jac.add_scaled_square(
        of_pose, 1.0, jac.times_twist(of_twist, tool[2], tool[3])))
    t3.add_product(A[6:12, 6:12], B[:6], B[6:12])
    if len(body) == 6:
        _strain_derivatives(model, tool, body, A, C, B)


@kernel
def _strain_derivatives(
    model: ModelTuple, tool: State, body: State, A: Any, C: Any, B: Any
) -> None:
    """Write what internal strains add: dz_b/dt = (h - z_b) / tau_b, and their force."""
    by_strain, by_pose = jac.strain_jacobians(model, tool, body)
    _, o, R, _, _, o_E_S1, _, _ = jac.ends_of_spring(model, tool, body)
    J_oo, J_oR, J_RR = jac.strain_jacobian(o, R)
    by_tool = jac.shift_right(
        jac.rotate_right((J_oo, J_oR, jac.ZERO_MATRIX, J_RR), R), t3.scale(-1.0, o_E_S1))
    jac.relaxation_jacobian(model, tool, body, C[6:], jac.PARAMETER_COLUMNS)
    branches, by_length = model[0][4:], (0.5 * R[6], 0.5 * R[7], 0.5 * R[8] + 0.5)
    for b in range(2):
        (strength, time), first = branches[b], 12 + 6 * b
        rate = 1.0 / time
        jac.write_square(A, 6, first, jac.scale_square(strength, by_strain))
        jac.write_square(A, first, 0, jac.scale_square(rate, by_pose))
        jac.write_square(B, first, 0, jac.scale_square(-rate, by_tool))
        jac.write_column(C[first:], jac.BY_LENGTH.start,
                         t3.scale(rate, t3.apply(J_oo, by_length)), t3.ZERO)
        jac.write_block(C, first, jac.BY_COM.start, t3.scale_matrix(-rate, J_oo))
        for i in range(6):
            A[first + i, first + i] = -rate


class Path(NamedTuple):
    """The tool's path (M, 13) at M nodes, with time (s) and integration steps (M - 1,) between."""

    rows: Array
    lengths: Array
    steps: Stamps


class ToolNoise(NamedTuple):
    """
    Noise of the tool's poses at the nodes: its shift and rotation from the path, m and rad.

    Innovations (M, 6), each from the node on from which its sample is the nearest, with their
    variances (M, 6), and the correlation (M,) with the noise at the node before.
    """

    innovations: Array
    variances: Array
    correlations: Array


class Poses(NamedTuple):
    """
    Measured poses of B.

    Their numbers at the nodes (M,), -1 for none; the poses (N, 8) with the little time (s) that
    each is after its node; minus their derivatives (N, 6, p) in body axes by the unknowns, by the
    delay per unit of the simulated twist; the variances (6,) of white noise in body axes, m^2 and
    rad^2, and of correlated noise, with its correlation (M - 1,) from node to node.
    """

    place: Places
    rows: Array
    by_unknowns: Array
    white_variance: Array
    variance: Array
    correlations: Array


class Unknowns(NamedTuple):
    """
    What p unknowns do to the model.

    How many of `jacobians.PARAMETER_COLUMNS` are used, and derivatives (64, p + 1) of the model's
    parameters; what these are multiplied by at the nodes (M, p), and the values (p,) of unknowns
    that the model is without, whose effect, as far as it is linear, is in the mean: empty where it
    has all; and the unknown by which the tool's stamps are late, and the first of those (6,) by
    which the tool's frame is moved and turned in the measured one, -1 for none.
    """

    last: int
    columns: Array
    scales: Array
    extra: Array
    delay: int
    marker: int


@array_kernel
def whiten(
    model: ModelTuple, body: State, mean: Array, std: Array, path: Path, tool_noise: ToolNoise,
    poses: Poses, unknowns: Unknowns, walk: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """
    Return whitened differences and their derivatives, and what `smooth` needs.

    The states are x (12,), with 12 internal strains where the cup relaxes, then how far the tool
    is from its path (6,), and, where it is correlated, the noise of the package's pose (6,).

    Parameters
    ----------
    model, body : tuples
        And the package at the first node.
    mean, std : ndarray (m,), (n,)
        Mean of x, and standard deviations of the states, before the tool's first pose.
    path, tool_noise, poses, unknowns : tuples
        Of M nodes, N poses and p unknowns.
    walk : ndarray (6,)
        Variance that a white acceleration gives to the twist in x, per second. Where there is
        any, the package that is linearised about takes on what is estimated of x.

    Returns
    -------
    innovations, slopes : ndarray (N, 6), (N, 6, p)
        In units of their standard deviation.
    T, B, K : ndarray (M, n, n), (M, n, 6), (N, 6, n + 1)
        Transitions, effects of the tool's samples on the step before, and gains with one over the
        standard deviation of what each is of.

    """
    rows, lengths, steps = path  # by their order, on which the machine code on disk depends
    place, measured, by_unknowns, white_variance, _, _ = poses
    last, columns, _, _, delay, marker = unknowns
    m, n, nodes, count = len(mean), len(std), len(rows), len(measured)
    S, P = np.zeros((n, columns.shape[1])), np.zeros((n, n))
    for i in range(n):
        P[i, i] = std[i] * std[i]
    S[:m, -1] = mean
    out, slopes = np.empty((count, 6)), np.empty((count, 6, S.shape[1] - 1))
    T, B, K = np.zeros((nodes, n, n)), np.zeros((nodes, n, 6)), np.zeros((count, 6, n + 1))
    A, C, E = np.zeros((2, m, m)), np.zeros((2, m, PARAMETER_COUNT)), np.zeros((2, m, 6))
    twist = np.zeros(6)
    for k in range(nodes):
        here, slot = row_state(rows[k]), k % 2
        if k > 0:
            body = kernels.advance(
                model, body, row_state(rows[k - 1]), here, lengths[k - 1], steps[k - 1])
        _derivatives(model, here, body, last, A[slot], C[slot], E[slot])
        for i in range(6):
            B[k, m + i, i] = 1.0
        if k > 0:
            _propagate(k, path, tool_noise, poses, unknowns, walk, (A, C, E),
                       (B[k], S, P, T[k]))
        _add_tool_noise(k, tool_noise, marker, B[k], S, P)
        i = place[k]
        if i >= 0:
            pose = measured[i]
            shift, rotation = pose_error(
                body, (pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))
            for j in range(3):
                twist[j], twist[3 + j] = body[2][j], body[3][j]
                out[i, j], out[i, 3 + j] = shift[j], rotation[j]
            out[i] -= pose[7] * twist
            if delay >= 0:
                by_unknowns[i, :, delay] *= twist
            _update(white_variance, by_unknowns[i], m + 6, S, P, out[i], slopes[i], K[i])
            if walk[0] > 0.0:
                body = with_mean(body, S)
    return out, slopes, T, B, K


@kernel
def with_mean(body: State, S: Any) -> State:
    """Return a package moved by the mean of x, the last column, which becomes zero."""
    x = S[:, S.shape[1] - 1]
    moved = moved_by(body, x)
    if len(body) == 4:
        x[:12] = 0.0
        return moved
    strains = kernels.moved_strains(body[4:], 1.0, kernels.strains_of(x[12:]))
    x[:24] = 0.0
    return kernels.with_strains(moved, strains)


@array_kernel
def _propagate(
    k: int, path: Path, tool_noise: ToolNoise, poses: Poses, unknowns: Unknowns, walk: Array,
    derivatives: tuple[Array, Array, Array], states: tuple[Array, Array, Array, Array],
) -> None:
    """Propagate states, derivatives and covariance over a step to node k; write its T and B."""
    (A, C, E), (B, S, P, T) = derivatives, states
    (_, lengths, steps), (_, _, tool_correlations) = path, tool_noise
    (_, _, _, _, variance, correlations), (_, columns, scales, extra, _, _) = poses, unknowns
    n, m, length = len(P), A.shape[1], lengths[k - 1]
    mean, ramp, entered = np.zeros((m, m)), np.zeros((m, m)), np.empty((m, 6))
    tool_correlation, noise_correlation = tool_correlations[k], correlations[k - 1]
    F = _exponential(0.5 * length * (A[0] + A[1]), steps[k - 1], mean, ramp)
    held = 0.5 * length * (E[0] + E[1])
    t3.product(mean, held, entered)
    t3.product(ramp, held, B[:m])
    for i in range(m):
        for j in range(m):
            T[i, j] = F[i, j]
        for j in range(6):
            T[i, m + j] = entered[i, j] + (tool_correlation - 1.0) * B[i, j]
    for i in range(m, n):
        T[i, i] = tool_correlation if i < m + 6 else noise_correlation
    effect = t3.product(0.5 * length * (C[0] + C[1]), columns, np.empty((m, S.shape[1])))
    for j in range(len(extra)):
        effect[:, j] *= 0.5 * (scales[k - 1, j] + scales[k, j])
        effect[:, -1] += effect[:, j] * extra[j]
    S[:] = t3.add_product(mean, effect, t3.product(T, S, np.empty(S.shape)))
    t3.product(T, t3.transpose(t3.product(T, P, np.empty((n, n)))), P)
    for i in range(6):
        P[6 + i, 6 + i] += walk[i] * length
    for i in range(m + 6, n):
        P[i, i] += (1.0 - noise_correlation * noise_correlation) * variance[i - m - 6]


@array_kernel
def _exponential(M: Any, steps: int, mean: Any, ramp: Any) -> Any:
    """
    Return exp(M), M changed; write the means of exp(t M) and (1 - t) exp(t M) for t from 0 to 1.

    To fourth order over `MAX_EXPONENTIAL_STEPS` of the integrator's steps at most, doubled to all
    of them.
    """
    doublings = 0
    while steps > MAX_EXPONENTIAL_STEPS:
        steps, doublings = (steps + 1) // 2, doublings + 1
    M *= 0.5**doublings
    F, other = _short_exponential(M, mean, ramp), np.empty(M.shape)
    for _ in range(doublings):
        ramp += mean + t3.product(F, ramp, other)
        ramp *= 0.25
        mean += t3.product(F, mean, other)
        mean *= 0.5
        F, other = t3.product(F, F, other), F
    return F


@array_kernel
def _short_exponential(M: Any, mean: Any, ramp: Any) -> Any:
    """Return exp(M), and write its means, to fourth order."""
    X, Y = M.copy(), np.empty(M.shape)
    for constant in (4.0, 12.0, 24.0):  # 4 + M, 12 + M X, 24 + M Y
        if constant > 4.0:
            t3.product(M, X, Y)
            X, Y = Y, X
        for i in range(len(M)):
            X[i, i] += constant
    for i in range(len(M)):
        for j in range(len(M)):
            mean[i, j], ramp[i, j] = X[i, j] / 24.0, Y[i, j] / 24.0
    t3.product(M, mean, Y)
    for i in range(len(M)):
        Y[i, i] += 1.0
    return Y


@array_kernel
def _add_tool_noise(k: int, tool_noise: ToolNoise, marker: int, B: Any, S: Any, P: Any) -> None:
    """
    Add the innovation of the tool's noise at node k, and its variances, to the states.

    A constant offset of its samples, of which the unknowns from `marker` on are, counts likewise.
    """
    innovations, all_variances, correlations = tool_noise
    innovation, variances = innovations[k], all_variances[k]
    if marker >= 0:
        S[:, marker:marker + 6] += (1.0 - correlations[k] if k > 0 else 1.0) * B
    noise = np.empty((6, P.shape[0]))
    for i in range(P.shape[0]):
        for j in range(6):
            noise[j, i] = variances[j] * B[i, j]
            S[i, -1] += B[i, j] * innovation[j]
    t3.add_product(B, noise, P)


@array_kernel
def _update(
    variance: Any, by_pose: Any, noise_state: int, S: Any, P: Any, out: Any, slopes: Any, K: Any
) -> None:
    """Correct the states by the difference (6,) of a pose, number by number; whiten it."""
    n, p = P.shape[0], S.shape[1] - 1
    gain, p_row, s_row = np.empty((n, 1)), np.empty((1, n)), np.empty((1, p + 1))
    for j in range(6):
        for i in range(n):  # loops: temporary arrays would cost a tenth of the fit
            p_row[0, i] = P[j, i] + (P[noise_state + j, i] if n > noise_state else 0.0)
        for i in range(p + 1):
            s_row[0, i] = S[j, i] + (S[noise_state + j, i] if n > noise_state else 0.0)
        for i in range(p):
            s_row[0, i] += by_pose[j, i]
        e = out[j] - s_row[0, p]
        s = p_row[0, j] + (p_row[0, noise_state + j] if n > noise_state else 0.0) + variance[j]
        s = max(s, s * abs(e) / (HUBER_STD * np.sqrt(s)))  # Huber's weight: a larger variance
        scale = 1.0 / np.sqrt(s)
        for i in range(p):
            slopes[j, i] = s_row[0, i] * scale
        for i in range(n):
            gain[i, 0] = -p_row[0, i] / s
            K[j, i] = -gain[i, 0]
        out[j], s_row[0, p], K[j, n] = e * scale, -e, scale
        t3.add_product(gain, p_row, P)
        t3.add_product(gain, s_row, S)


@array_kernel
def smooth(
    whitened: tuple[Array, Array, Array, Array, Array], place: Places, variances: Array,
    noise_state: int,
) -> tuple[Array, Array]:
    """
    Return the innovations (M, 6) of the likeliest noise of the tool's poses, going backwards.

    Of what `whiten` returns; `noise_state` is the first state of the package's noise. And the
    slope (n,) of the first states: their likeliest change is minus their covariance times that.
    """
    out, _, T, B, K = whitened
    innovations, slope = np.zeros(variances.shape), np.zeros(T.shape[1])
    for k in range(len(place) - 1, -1, -1):
        n = place[k]
        for j in range(5 if n >= 0 else -1, -1, -1):
            total = out[n, j] * K[n, j, -1] + np.dot(K[n, j, :-1], slope)
            slope[j] -= total
            if len(slope) > noise_state:
                slope[noise_state + j] -= total
        innovations[k] = -variances[k] * np.dot(B[k].T, slope)
        if k > 0:
            slope[:] = np.dot(T[k].T, slope)
    return innovations, slope
