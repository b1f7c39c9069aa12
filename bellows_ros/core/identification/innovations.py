"""
One-step prediction errors of the package's pose: the model steered by what was measured.

A simulation that runs freely from a noisy tool motion drifts away from the package along its
lightly damped modes, and its error is coloured. The innovations form corrects the state at every
sample with the steady-state Kalman gain of the linearised model, in which the tool's noise is
process noise and the package's is measurement noise: what is left is white, with a covariance
that is known beforehand. With an exact tool the gain is zero and it is the free simulation.
"""

from typing import Any, NamedTuple

from bellows_ros.core.identification.noise import Noise, TWIST_HALF_WINDOW, TWIST_ORDER
from bellows_ros.core.integrator import advance
from bellows_ros.core.jit import COMPILED, kernel
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.linearisation import displaced, largest_step, substeps_for
from bellows_ros.core.savgol import weights
from bellows_ros.core.simulation import row_state
from bellows_ros.core.tuples import (
    add,
    apply_transposed,
    log_quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    subtract,
    Vector,
)
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLIPPED_AT = 4.0
"""Standard deviations of an innovation beyond which it corrects the state no further."""


MOST_DOUBLINGS = 60

_DIFFERENCE = 1e-6  # m, rad, m/s and rad/s, of central differences


class Observer(NamedTuple):
    """
    The steady-state Kalman filter of small motions about the rest under the first tool pose.

    Gain (12, 6): displacement and twist of B in its own axes, per innovation; covariance (6, 6)
    of the innovations, m and rad.
    """

    gain: Array
    covariance: Array


def observer(
    model: ModelTuple,
    tool: State,
    rest: State,
    period: float,
    tool_period: float,
    tool_noise: Noise,
    package_noise: Noise,
) -> Observer:
    """
    Return the observer for package poses a period (s) apart, tool poses another.

    About the package's rest under the tool, one step is x' = F x + sum_j B_j n_j, with n_j the
    noise of the tool's pose j steps later: the tool's twists are differences of its poses. A step
    at which all of these act as one, sum_j F^j B_j n, leaves the same motion but for a direct
    part, which the poses see as more measurement noise. Noise of another rate than the package's
    counts by its density.
    """
    zero = (0.0, 0.0, 0.0)
    still = (tool[0], tool[1], zero, zero)
    F, inputs = _one_step(model, still, rest, period)
    drive, direct = _collected(F, inputs)
    variances = np.array(_variances(tool_noise)) * tool_period / period
    process = drive * variances @ drive.T
    noise = np.diag(_variances(package_noise))
    noise += sum(part[:6] * variances @ part[:6].T for part in direct)
    # in units in which all noises are near one
    scale = np.sqrt(np.concatenate([np.diag(noise), np.diag(noise) / period**2]))
    unit = np.outer(scale, scale)
    H = np.eye(6, 12)
    X = unit * _stationary_covariance(
        F * scale / scale[:, None], H.T @ np.linalg.inv(noise / unit[:6, :6]) @ H, process / unit
    )
    covariance = X[:6, :6] + noise
    return Observer(X[:, :6] @ np.linalg.inv(covariance), covariance)


def _one_step(
    model: ModelTuple, tool: State, body: State, period: float
) -> tuple[Array, dict[int, Array]]:
    """
    Return the transition (12, 12) of one step, and the effects B_j (12, 6) of the tool's poses.

    By central differences of the integrator itself about a rest.
    """
    slopes = np.empty((3, 12, 12))
    substeps = substeps_for(period, largest_step(model))
    _step_slopes(model, tool, body, period, substeps, slopes)
    F, first, last = slopes
    slope = weights(TWIST_HALF_WINDOW, TWIST_ORDER, 1.0 / period)[1]
    inputs = {j: np.zeros((12, 6)) for j in range(-TWIST_HALF_WINDOW, TWIST_HALF_WINDOW + 2)}
    for offset, effect in ((0, first), (1, last)):
        inputs[offset] += effect[:, :6]
        for j, weight in enumerate(slope, start=offset - TWIST_HALF_WINDOW):
            inputs[j] += weight * effect[:, 6:]
    return F, inputs


@kernel
def _step_slopes(
    model: ModelTuple, tool: State, body: State, period: float, substeps: int, out: Array
) -> None:
    """Write the derivatives of the next state by the body, the tool now, and the tool then."""
    for slot in range(3):
        for column in range(12):
            size = _DIFFERENCE
            ahead = changed(body, column, size if slot == 0 else 0.0)
            behind = changed(body, column, -size if slot == 0 else 0.0)
            now = changed(tool, column, size if slot == 1 else 0.0)
            before = changed(tool, column, -size if slot == 1 else 0.0)
            then = changed(tool, column, size if slot == 2 else 0.0)
            instead = changed(tool, column, -size if slot == 2 else 0.0)
            ahead = advance(model, ahead, now, then, period, substeps)
            behind = advance(model, behind, before, instead, period, substeps)
            difference = between(behind, ahead)
            for row in range(12):
                out[slot, row, column] = difference[row] / (2.0 * size)


@kernel
def changed(state: State, column: int, size: float) -> State:
    """Return a state displaced in its own axes, or with its twist changed, in one direction."""
    a, b, c = (
        size if column % 3 == 0 else 0.0,
        size if column % 3 == 1 else 0.0,
        size if column % 3 == 2 else 0.0,
    )
    part = column // 3
    zero = (0.0, 0.0, 0.0)
    o, q, v, w = state
    if part == 0:
        o, q, _, _ = displaced(state, (a, b, c), zero)
    if part == 1:
        o, q, _, _ = displaced(state, zero, (a, b, c))
    if part == 2:
        v = add(v, (a, b, c))
    if part == 3:
        w = add(w, (a, b, c))
    return o, q, v, w


@kernel
def between(
    first: State, second: State
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """Return the displacement in the first's axes and the change of twist between two states."""
    d = apply_transposed(rotation_matrix(first[1]), subtract(second[0], first[0]))
    r = log_quaternion(quaternion_product(quaternion_conjugate(first[1]), second[1]))
    v, w = subtract(second[2], first[2]), subtract(second[3], first[3])
    return (d[0], d[1], d[2], r[0], r[1], r[2], v[0], v[1], v[2], w[0], w[1], w[2])


def _collected(F: Array, inputs: dict[int, Array]) -> tuple[Array, list[Array]]:
    """
    Return sum_j F^j B_j, and the direct effects that remain.

    (z - F)^-1 sum_j B_j z^j = (z - F)^-1 sum_j F^j B_j + a polynomial in z and 1/z.
    """
    power = {j: np.linalg.matrix_power(F, j) for j in range(-4, 5)}
    drive = np.sum([power[j] @ B for j, B in inputs.items()], axis=0)
    direct: dict[int, Array] = {}
    for j, B in inputs.items():
        for lead in range(j):
            direct[lead] = direct.get(lead, 0.0) + power[j - 1 - lead] @ B
        for lead in range(j, 0):
            direct[lead] = direct.get(lead, 0.0) - power[j - 1 - lead] @ B
    return drive, list(direct.values())


def _variances(noise: Noise) -> list[float]:
    """Return the variances of the six coordinates of a pose."""
    return [noise.position**2] * 3 + [noise.rotation**2] * 3


def _stationary_covariance(F: Array, information: Array, Q: Array) -> Array:
    """
    Return X = F X (I + information X)^-1 F^T + Q, the covariance of a predicted state.

    By doubling the number of samples seen, which converges for any stable system; the solver for
    the general Riccati equation gives up where modes are lightly damped and the tool is exact.
    """
    A, G, X = F.T, information, Q
    identity = np.eye(len(F))
    for _ in range(MOST_DOUBLINGS):
        W = np.linalg.solve(identity + G @ X, np.hstack([A, G]))
        WA, WG = W[:, : len(F)], W[:, len(F):]
        change = A.T @ X @ WA
        X = X + change
        G = G + A @ WG @ A.T
        A = A @ WA
        if np.abs(change).max() <= 1e-12 * np.abs(X).max():
            break
    return 0.5 * (X + X.T)


def innovations(
    model: ModelTuple,
    start: State,
    tool: Array,
    package: Array,
    valid: NDArray[np.bool_],
    durations: Array,
    substeps: NDArray[np.int64],
    filtering: Observer,
) -> Array:
    """
    Return the one-step prediction errors of a recording, zero where nothing was measured.

    They are (N, 6), in body axes, m and rad.

    Parameters
    ----------
    model : ModelTuple
        Cup, package and gravity.
    start : State
        Of the package at the first sample, before its measurement.
    tool, package : ndarray (N, 13), (N, 7)
        Tool rows with twists; measured package poses as position and quaternion xyzw.
    valid : ndarray (N,)
        Where the package's pose may be used.
    durations, substeps : ndarray (N - 1,)
        Times (s) between samples, and integration steps in each.
    filtering : Observer
        Gain and covariance.

    """
    out: Array = np.zeros((len(tool), 6))
    limit = CLIPPED_AT * np.sqrt(np.diag(filtering.covariance))
    inputs: list[Any] = [tool, package, valid, durations, substeps, filtering.gain, limit]
    if not COMPILED:  # plain floats are several times faster than NumPy's in plain Python
        inputs = [part.tolist() for part in inputs]
    _innovations(model, start, *inputs, out)  # type: ignore[call-arg]
    return out


@kernel
def _innovations(
    model: ModelTuple, body: State, tool: Any, package: Any, valid: Any, durations: Any,
    substeps: Any, gain: Any, limit: Any, out: Array,
) -> None:  # fmt: skip
    """Predict, compare and correct from row to row."""
    now = row_state(tool[0])
    for k in range(len(tool)):
        if valid[k]:
            row = package[k]
            q = (row[3], row[4], row[5], row[6])
            e = apply_transposed(
                rotation_matrix(body[1]), subtract((row[0], row[1], row[2]), body[0]))
            phi = log_quaternion(quaternion_product(quaternion_conjugate(body[1]), q))
            out[k, 0], out[k, 1], out[k, 2] = e
            out[k, 3], out[k, 4], out[k, 5] = phi
            body = corrected(body, gain, (
                clipped(e[0], limit[0]), clipped(e[1], limit[1]), clipped(e[2], limit[2]),
                clipped(phi[0], limit[3]), clipped(phi[1], limit[4]), clipped(phi[2], limit[5]),
            ))
        if k + 1 < len(tool):
            later = row_state(tool[k + 1])
            body = advance(model, body, now, later, durations[k], substeps[k])
            now = later


@kernel
def clipped(value: float, limit: float) -> float:
    """Return the value, held between -limit and limit."""
    return min(max(value, -limit), limit)


@kernel
def row_product(gain: Any, i: int, e: Any) -> Any:
    """Return row i of the gain times the innovation."""
    row = gain[i]
    return (
        row[0] * e[0] + row[1] * e[1] + row[2] * e[2]
        + row[3] * e[3] + row[4] * e[4] + row[5] * e[5]
    )  # fmt: skip


@kernel
def rows_product(gain: Any, i: int, e: Any) -> Vector:
    """Return rows i to i + 2 of the gain times the innovation."""
    return row_product(gain, i, e), row_product(gain, i + 1, e), row_product(gain, i + 2, e)


@kernel
def corrected(body: State, gain: Any, e: Any) -> State:
    """Return the state moved by the gain times the innovation."""
    o, q, _, _ = displaced(body, rows_product(gain, 0, e), rows_product(gain, 3, e))
    return (
        o, q, add(body[2], rows_product(gain, 6, e)), add(body[3], rows_product(gain, 9, e))
    )  # fmt: skip
