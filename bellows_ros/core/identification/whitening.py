"""
Whitened differences between measured and simulated poses of the package.

The package is simulated along a path of the tool near the measured one. Its difference from the
true package is a small state x (12,) in body axes, as in `jacobians`. The state x follows the
linearised model, driven by the difference of the tool's path from its measured poses, and by their
noise: a sample d of the tool (m, rad) acts while it is the nearest one,

    dx/dt = A x + B d,    B = [T_v; A_v T_v + T_p + T_v ad(v_tool)],

with T_p, T_v and A_v the derivatives of the acceleration by pose and twist of the tool, and twist
of the package (the noise's slope is integrated by parts). Over a step between nodes, A and B are
constant and d is linear: a stiff cup settles within one step. A cup that relaxes has 12 more
states, its internal strains. A Kalman filter on x whitens the differences and their derivatives by
parameters. With exact poses of the tool this is output error; with noisy ones, chi² is the minimum
over all paths of the tool (total least squares), and a second, backward pass gives the likeliest
path (Bryson and Frazier).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Mask, Places, Stamps
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.identification.result import CHANCE
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.equilibrium import moved, moved_by
from bellows_ros.core.model.kernels import ModelTuple, State, Strains
from bellows_ros.core.model.simulation import row_state, write_row
from bellows_ros.core.model.structure import RELAXATION_TIMES
from bellows_ros.core.sensors.body import observe, Views
import numpy as np

HUBER_STD = 3.0
"""Size beyond which differences count linearly instead of quadratically (Huber), standard
deviations."""

MAX_EXPONENTIAL_STEPS = 4
"""Largest number of integration steps in one exponential. A step has 0.4 rad of the quickest mode;
the exponential, of fourth order, is stable up to 2.7 rad."""

RIGID_STATES = 12
"""Number of states of a package whose cup does not relax; internal strains are 12 more."""

NO_STRAINS: Strains = ((t3.ZERO, t3.ZERO), (t3.ZERO, t3.ZERO))
"""Internal strains of a cup that does not relax."""

NO_BRANCHES = tuple((0.0, tau) for tau in RELAXATION_TIMES)
"""Branches of a cup that does not relax."""

PARAMETER_COUNT = jac.PARAMETER_COLUMNS + 2
"""Number of parameters: `jacobians.PARAMETER_COLUMNS`, and two strengths of relaxation."""

BLOCK_DURATION = 1.0
"""Length of the parts of a recording whose information is stored, s: some periods of a swing."""

WHITE_SIGMAS = 4.0
"""Largest correlation of white innovations, standard deviations; false-alarm rate 1 in 900."""

MAX_WHITE_CORRELATION = 0.1
"""Largest correlation of innovations that count as white."""


class WhitenedSegment(NamedTuple):
    """
    The whitened differences of a segment.

    Innovations (6 N,), their derivatives (6 N, q) by the unknowns of the recording, the variance
    (N, 6) of each difference, the variance (6,) of the innovation of a pose's noise, the mask of
    the used poses of the package, the effect (6,) of a residual on a pose, 1 or of views of a tag
    in m and rad per rad, the likeliest changes of the tool's path and first state of the package,
    information (c, q, q) and slope (c, q) of each second, and the smear (N,) of views, rad.
    """

    innovations: Array
    jacobian: Array
    variance: Array
    new_variance: Array
    used: Mask
    scale: Array
    tool_change: Array
    start: State
    information: Array
    slope: Array
    smear: Array

    @property
    def residuals(self) -> Array:
        """Differences (N, 6) without whitening, m and rad."""
        return np.asarray(
            self.scale * self.innovations.reshape(-1, 6) * np.sqrt(self.variance))

    @property
    def is_white(self) -> bool:
        """Whether successive innovations are uncorrelated."""
        e = np.clip(self.innovations.reshape(-1, 6), -CHANCE, CHANCE)
        correlation = [np.sum(e[lag:] * e[:-lag], axis=0) / np.sum(e**2, axis=0)
                       for lag in (1, 2, 3) if lag < len(e)]
        limit = max(MAX_WHITE_CORRELATION, WHITE_SIGMAS / np.sqrt(len(e)))
        return bool(np.max(np.abs(correlation), initial=0.0) < limit)


def sums_of_blocks(slopes: Array, innovations: Array, period: float) -> tuple[Array, Array]:
    """Return information (c, q, q) and slope (c, q) of each second of a segment."""
    length = max(round(BLOCK_DURATION / period), 1)
    blocks = [(slopes[first:first + length].reshape(-1, slopes.shape[-1]),
               innovations[first:first + length].ravel())
              for first in range(0, len(slopes), length)]
    return np.array([J.T @ J for J, _ in blocks]), np.array([J.T @ r for J, r in blocks])


def relaxing(model: ModelTuple) -> ModelTuple:
    """Return a model with branches of relaxation, of zero strength if it has none."""
    cup, package, gravity = model
    return (*cup[:4], *(cup[4:] or NO_BRANCHES)), package, gravity


def with_inner(body: State) -> State:
    """Return a state with internal strains, zero if it has none."""
    return kernels.with_strains(body, body[4:] or NO_STRAINS)


def shifted(body: State, x: Array) -> State:
    """Return a state shifted by x (m,), with internal strains if any."""
    moved = with_mean(with_inner(body), x.reshape(-1, 1).copy(), len(x))
    return moved if body[4:] else (moved[0], moved[1], moved[2], moved[3])


@kernel
def _derivatives(
    model: ModelTuple, tool: State, body: State, last: int, A: Any, C: Any, B: Any
) -> None:
    """Write the derivatives of dx/dt by x (m, m) and by the parameters (m, 64), and B (m, 6)."""
    jac.write_slope(model, tool, body, A)
    jac.parameter_jacobian(model, tool, body, 0, last, C[6:])
    of_pose, of_twist = jac.tool_jacobians(model, tool, body)
    jac.write_square(B, 0, 0, of_twist)
    jac.write_square(B, 6, 0, jac.add_scaled_square(
        of_pose, 1.0, jac.times_twist(of_twist, tool[2], tool[3])))
    t3.add_product(A[6:12, 6:12], B[:6], B[6:12])
    if len(A) > RIGID_STATES:
        _strain_derivatives(model, tool, body, A, C, B)


@kernel
def _strain_derivatives(
    model: ModelTuple, tool: State, body: State, A: Any, C: Any, B: Any
) -> None:
    """Add internal strains to the derivatives: dz_b/dt = (h - z_b) / tau_b, and their force."""
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
    """The tool's path (M, 13) at M nodes, with times (s) and integration steps (M - 1,)."""

    rows: Array
    lengths: Array
    steps: Stamps


class ToolNoise(NamedTuple):
    """
    Noise of the tool's poses at the nodes: shift and rotation from the path, m and rad.

    Innovations (M, 6), each at the first node whose nearest sample it belongs to, with their
    variances (M, 6), and the correlation (M,) with the noise at the previous node.
    """

    innovations: Array
    variances: Array
    correlations: Array


class Poses(NamedTuple):
    """
    Measured poses of B.

    Their indices at the nodes (M,), -1 for none, and the N views; the variances of their errors,
    m^2 and rad^2: (N, 6) of white noise, and (6,) of correlated noise, with its correlation (M -
    1,) between nodes.
    """

    place: Places
    views: Views
    white_variance: Array
    variance: Array
    correlations: Array


class Unknowns(NamedTuple):
    """
    Effect of p unknowns on the model.

    Fields in order: number of used `jacobians.PARAMETER_COLUMNS`; derivatives (64, p + 1) of the
    model's parameters; factors of the columns at the nodes (M, p); values (p,) of unknowns outside
    the model, with a linear effect on the mean (empty without such unknowns); index of the first
    unknown of the tool's marker frame, -1 for none.
    """

    last: int
    columns: Array
    scales: Array
    extra: Array
    marker: int


@entry
def whiten(
    model: ModelTuple, body: State, mean: Array, std: Array, path: Path, tool_noise: ToolNoise,
    poses: Poses, unknowns: Unknowns, walk: Array,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """
    Return whitened differences and their derivatives, and the inputs of `smooth`.

    The states are x (12,), with 12 internal strains if the cup relaxes, then the tool's deviation
    from its path (6,), and, if correlated, the noise of the package's pose (6,).

    Parameters
    ----------
    model, body : tuples
        Model, and the package at the first node.
    mean, std : ndarray (m,), (n,)
        Mean of x, and standard deviations of the states, before the tool's first pose.
    path, tool_noise, poses, unknowns : tuples
        Arrays of M nodes, N poses and p unknowns.
    walk : ndarray (6,)
        Variance of the twist in x per second by a white acceleration. If nonzero, the
        linearisation follows the estimated x.

    Returns
    -------
    innovations, slopes : ndarray (N, 6), (N, 6, p)
        Innovations and derivatives in units of their standard deviations.
    T, B, K : ndarray (M, n, n), (M, n, 6), (N, 6, n + 1)
        Transitions, effects of the tool's samples on the previous step, and gains with the inverse
        standard deviations.
    maps : ndarray (N, 6, 6)
        Derivatives of the residuals by the package's error.

    """
    (rows, lengths, steps), place, views = path, poses.place, poses.views
    columns = unknowns.columns
    m, n, nodes, count = len(mean), len(std), len(rows), len(views.rows)
    S, P = np.zeros((n, columns.shape[1])), np.zeros((n, n))
    for i in range(n):
        P[i, i] = std[i] * std[i]
    for i in range(m):
        S[i, columns.shape[1] - 1] = mean[i]
    out, slopes = np.empty((count, 6)), np.empty((count, 6, columns.shape[1] - 1))
    T, B, K = np.zeros((nodes, n, n)), np.zeros((nodes, n, 6)), np.zeros((count, 6, n + 1))
    maps = np.zeros((count, 6, 6))
    A, C, E = np.zeros((2, m, m)), np.zeros((2, m, PARAMETER_COUNT)), np.zeros((2, m, 6))
    for k in range(nodes):
        here, slot = row_state(rows[k]), k % 2
        if k > 0:
            body = _advanced(model, body, rows[k - 1], rows[k], lengths[k - 1], steps[k - 1])
        _derivatives(model, here, body, unknowns.last, A[slot], C[slot], E[slot])
        for i in range(6):
            B[k, m + i, i] = 1.0
        if k > 0:
            _propagate(k, path, tool_noise, poses, unknowns, walk, (A, C, E),
                       (B[k], S, P, T[k]))
        _add_tool_noise(k, tool_noise, unknowns.marker, B[k], S, P)
        i = place[k]
        if i >= 0:
            observe(body, views, i, maps[i], out[i])
            _update(poses.white_variance[i], maps[i], views.columns[i], m + 6, S, P, out[i],
                    slopes[i], K[i])
            if walk[0] > 0.0:
                body = with_mean(body, S, m)
    return out, slopes, T, B, K, maps


@kernel
def _advanced(
    model: ModelTuple, body: State, before: Any, after: Any, length: float, steps: int
) -> State:
    """Return the body after a step of the tool from one row to the next."""
    return kernels.advance(model, body, row_state(before), row_state(after), length, steps)


@entry
def write_motion(
    model: ModelTuple, body: State, path: Path, place: Places, delays: Array, out: Any
) -> None:
    """
    Write the simulated package at its views (N, 19): its state, and its acceleration.

    Delays (N,) of the views after their nodes in s; the acceleration in body axes of a point, and
    of the rate, m/s^2 and rad/s^2.
    """
    rows, lengths, steps = path
    for k in range(len(rows)):
        here = row_state(rows[k])
        if k > 0:
            body = _advanced(model, body, rows[k - 1], rows[k], lengths[k - 1], steps[k - 1])
        i = place[k]
        if i >= 0:
            at = delays[i]
            dv, dw = kernels.body_acceleration(model, here, body)
            late = moved(body, t3.scale(at, body[2]), t3.scale(at, body[3]), t3.ZERO, t3.ZERO)
            write_row(out[i][:13], (late[0], late[1], late[2], late[3]))
            bend = t3.add(dv, t3.cross(body[3], body[2]))
            for j in range(3):
                out[i][13 + j], out[i][16 + j] = bend[j], dw[j]


@entry
def with_mean(body: State, S: Any, m: int) -> State:
    """Return a package shifted by the mean of x, the last column, whose m rows become zero."""
    x = S[:, S.shape[1] - 1]
    moved = moved_by(body, x)
    strains = NO_STRAINS
    if m > RIGID_STATES:
        strains = kernels.strains_of(x[12:24])
    for i in range(m):
        x[i] = 0.0
    return kernels.with_strains(moved, kernels.moved_strains(body[4:], 1.0, strains))


@kernel
def _step_mean(pair: Any, length: float, out: Any) -> Any:
    """Write the mean of two matrices, times a length."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0.5 * length * (pair[0, i, j] + pair[1, i, j])
    return out


@kernel
def _propagate(
    k: int, path: Path, tool_noise: ToolNoise, poses: Poses, unknowns: Unknowns, walk: Array,
    derivatives: tuple[Array, Array, Array], states: tuple[Array, Array, Array, Array],
) -> None:
    """Propagate states, derivatives and covariance over a step to node k; write T and B."""
    (A, C, E), (B, S, P, T) = derivatives, states
    (_, lengths, steps), (_, _, tool_correlations) = path, tool_noise
    variance, correlations = poses.variance, poses.correlations
    columns, scales, extra = unknowns.columns, unknowns.scales, unknowns.extra
    n, m, length = len(P), A.shape[1], lengths[k - 1]
    mean, ramp, entered = np.zeros((m, m)), np.zeros((m, m)), np.empty((m, 6))
    tool_correlation, noise_correlation = tool_correlations[k], correlations[k - 1]
    F = _exponential(
        _step_mean(A, length, np.empty((m, m))), steps[k - 1], mean, ramp)
    held = _step_mean(E, length, np.empty((m, 6)))
    t3.product(mean, held, entered)
    t3.product(ramp, held, B[:m])
    for i in range(m):
        for j in range(m):
            T[i, j] = F[i, j]
        for j in range(6):
            T[i, m + j] = entered[i, j] + (tool_correlation - 1.0) * B[i, j]
    for i in range(m, n):
        T[i, i] = tool_correlation if i < m + 6 else noise_correlation
    slopes = _step_mean(C, length, np.empty((m, PARAMETER_COUNT)))
    effect = t3.product(slopes, columns, np.empty((m, S.shape[1])))
    _scale_changes(effect, scales[k - 1:k + 1], extra)
    moved = t3.add_product(mean, effect, t3.product(T, S, np.empty(S.shape)))
    for i in range(n):
        for j in range(S.shape[1]):
            S[i, j] = moved[i, j]
    t3.product(T, t3.transpose(t3.product(T, P, np.empty((n, n)))), P)
    for i in range(6):
        P[6 + i, 6 + i] += walk[i] * length
    for i in range(m + 6, n):
        P[i, i] += (1.0 - noise_correlation * noise_correlation) * variance[i - m - 6]


@kernel
def _scale_changes(effect: Any, scales: Any, extra: Any) -> None:
    """Scale columns by their mean factor, and add the effect of extra values to the mean."""
    for j in range(len(extra)):
        factor = 0.5 * (scales[0, j] + scales[1, j])
        for i in range(len(effect)):
            effect[i, j] *= factor
            effect[i, effect.shape[1] - 1] += effect[i, j] * extra[j]


@kernel
def _exponential(M: Any, steps: int, mean: Any, ramp: Any) -> Any:
    """
    Return exp(M), modifying M; write the means over t of exp(t M) and (1 - t) exp(t M), t <= 1.

    To fourth order over `MAX_EXPONENTIAL_STEPS` of the integrator's steps at most, doubled to all
    of them.
    """
    doublings = 0
    while steps > MAX_EXPONENTIAL_STEPS:
        steps, doublings = (steps + 1) // 2, doublings + 1
    size, factor = len(M), 0.5**doublings
    for i in range(size):
        for j in range(size):
            M[i, j] *= factor
    F, other, more = _short_exponential(M, mean, ramp), np.empty(M.shape), np.empty(M.shape)
    for _ in range(doublings):
        t3.product(F, ramp, other)
        t3.product(F, mean, more)
        for i in range(size):
            for j in range(size):
                ramp[i, j] = 0.25 * (ramp[i, j] + mean[i, j] + other[i, j])
                mean[i, j] = 0.5 * (mean[i, j] + more[i, j])
        F, other = t3.product(F, F, other), F
    return F


@kernel
def _short_exponential(M: Any, mean: Any, ramp: Any) -> Any:
    """Return exp(M), and write its means, to fourth order."""
    X, Y = np.empty(M.shape), np.empty(M.shape)
    for i in range(len(M)):
        for j in range(len(M)):
            X[i, j] = M[i, j]
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


@kernel
def _add_tool_noise(k: int, tool_noise: ToolNoise, marker: int, B: Any, S: Any, P: Any) -> None:
    """
    Add the innovation of the tool's noise at node k, and its variances, to the states.

    A constant offset of the tool's samples, the unknowns from `marker` on, is added likewise.
    """
    innovations, all_variances, correlations = tool_noise
    innovation, variances = innovations[k], all_variances[k]
    part = 1.0 - correlations[k] if k > 0 else 1.0
    for i in range(P.shape[0] if marker >= 0 else 0):
        for j in range(6):
            S[i, marker + j] += part * B[i, j]
    noise = np.empty((6, P.shape[0]))
    for i in range(P.shape[0]):
        for j in range(6):
            noise[j, i] = variances[j] * B[i, j]
            S[i, S.shape[1] - 1] += B[i, j] * innovation[j]
    t3.add_product(B, noise, P)


@kernel
def _update(
    variance: Any, M: Any, by_pose: Any, noise_state: int, S: Any, P: Any, out: Any,
    slopes: Any, K: Any,
) -> None:
    """Correct the states by the difference (6,) of a pose, component by component; whiten it."""
    n, p = P.shape[0], S.shape[1] - 1
    gain, p_row, s_row = np.empty((n, 1)), np.empty((1, n)), np.empty((1, p + 1))
    for j in range(6):
        for i in range(n):  # loops, as temporary arrays would cost a tenth of the fit
            p_row[0, i] = P[noise_state + j, i] if n > noise_state else 0.0
        for i in range(p + 1):
            s_row[0, i] = S[noise_state + j, i] if n > noise_state else 0.0
        _add_mapped(M[j], P, p_row)
        _add_mapped(M[j], S, s_row)
        for i in range(p):
            s_row[0, i] += by_pose[j, i]
        e = out[j] - s_row[0, p]
        s = variance[j] + (p_row[0, noise_state + j] if n > noise_state else 0.0)
        for k in range(6):
            s += M[j, k] * p_row[0, k]
        s = max(s, s * abs(e) / (HUBER_STD * np.sqrt(s)))  # Huber's weight as a larger variance
        scale = 1.0 / np.sqrt(s)
        for i in range(p):
            slopes[j, i] = s_row[0, i] * scale
        for i in range(n):
            gain[i, 0] = -p_row[0, i] / s
            K[j, i] = -gain[i, 0]
        out[j], s_row[0, p], K[j, n] = e * scale, -e, scale
        t3.add_product(gain, p_row, P)
        t3.add_product(gain, s_row, S)


@kernel
def _add_mapped(factors: Any, rows: Any, out: Any) -> None:
    """Add the first six rows times factors (6,) to a row (1, n)."""
    for k in range(6):
        if factors[k] != 0.0:
            for i in range(out.shape[1]):
                out[0, i] += factors[k] * rows[k, i]


@entry
def smooth(
    whitened: tuple[Array, Array, Array, Array, Array, Array], place: Places, variances: Array,
    noise_state: int,
) -> tuple[Array, Array]:
    """
    Return the innovations (M, 6) of the likeliest noise of the tool's poses, in a backward pass.

    Inputs are results of `whiten`; `noise_state` is the first state of the package's noise. The
    second result is the slope (n,) of the first states; the likeliest change of the first states
    is minus their covariance times this slope.
    """
    out, _, T, B, K, maps = whitened
    innovations, slope = np.zeros(variances.shape), np.zeros(T.shape[1])
    for k in range(len(place) - 1, -1, -1):
        n = place[k]
        for j in range(5 if n >= 0 else -1, -1, -1):
            total = out[n, j] * K[n, j, len(slope)]
            for i in range(len(slope)):
                total += K[n, j, i] * slope[i]
            for i in range(6):
                slope[i] -= maps[n, j, i] * total
            if len(slope) > noise_state:
                slope[noise_state + j] -= total
        for i in range(len(slope)):
            for j in range(6):
                innovations[k, j] -= variances[k, j] * B[k, i, j] * slope[i]
        if k > 0:
            slope = _times_transposed(T[k], slope)
    return innovations, slope


@kernel
def _times_transposed(T: Any, x: Any) -> Any:
    out = np.zeros(T.shape[1])
    for i in range(T.shape[0]):
        for j in range(T.shape[1]):
            out[j] += T[i, j] * x[i]
    return out
