"""
One-step prediction errors of the package's pose, from a model corrected by measurements.

A simulation that runs freely from a noisy tool motion drifts away from the package along its
lightly damped modes, and its error is coloured. The innovations form corrects the state at every
sample with the steady-state Kalman gain of the linearised model, in which the tool's noise is
process noise and the package's is measurement noise: what is left is white, with a covariance
that is known beforehand. With an exact tool the gain is zero and it is the free simulation.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.equilibrium import (
    largest_step,
    moved,
    static_equilibrium,
    substeps_of,
)
from bellows_ros.core.identification.segments import in_motion
from bellows_ros.core.jit import as_inputs, kernel
from bellows_ros.core.kernels import advance, ModelTuple, State
from bellows_ros.core.lie import rotation_to_quaternion
from bellows_ros.core.recording.recording import Noise, TOOL_HALF_WINDOW, TOOL_ORDER
from bellows_ros.core.resampling import weights
from bellows_ros.core.residuals import (
    portmanteau,
    Spectrum,
    spectrum,
    Whiteness,
)
from bellows_ros.core.sensitivities import sensitivities
from bellows_ros.core.simulation import row_state, state_row, tool_rows
from bellows_ros.core.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
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

LEAST_NOISE = 1e-7
"""Noise (m, rad) below which rounding dominates and the observer has nothing to weigh."""

CLIPPED_AT = 4.0
"""Innovations are clipped at this many standard deviations."""


LAGS = 2 * TOOL_HALF_WINDOW + 1
"""Past innovations in the next prediction: one for each pose in a tool twist."""

ZERO = (0.0, 0.0, 0.0)
NO_INNOVATION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NO_INNOVATIONS = (NO_INNOVATION,) * LAGS

MOST_DOUBLINGS = 60

Change = tuple[Vector, Vector, Vector, Vector]
"""Of position (m), rotation (rad), velocity (m/s) and rate (rad/s), in body axes."""


class Observer(NamedTuple):
    """
    The steady-state Kalman filter of small motions about the rest under the first tool pose.

    Gain (LAGS, 12, 6): displacement and twist of B in its own axes that the innovations of this
    sample and of those before it add to the next prediction; covariance (6, 6) of the innovations,
    m and rad.
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
    noise of the tool's pose j steps later: the tool's twists are differences of its poses, so one
    pose acts in several steps. The filter estimates these noises beside x. Noise of another rate
    than the package's counts by its density.
    """
    still = (tool[0], tool[1], ZERO, ZERO)
    F, inputs = _one_step(model, still, rest, period)
    process = np.array(_variances(tool_noise)) * tool_period / period
    noise = np.array(_variances(package_noise))
    # in units in which all noises are near one
    scale = np.sqrt(np.concatenate([noise, noise / period**2]))
    A, drive = _with_tool_noise(
        F * scale / scale[:, None], [B * np.sqrt(process) / scale[:, None] for B in inputs])
    size = len(A)
    information = np.diag(np.concatenate([np.ones(6), np.zeros(size - 6)]))
    X = _stationary_covariance(A, information, drive @ drive.T)
    covariance = X[:6, :6] + np.eye(6)
    kalman = X[:, :6] @ np.linalg.inv(covariance)
    unit = scale[:6]
    gain = _lagged(A[:12], kalman) * scale[:, None] / unit
    return Observer(gain, covariance * np.outer(unit, unit))


def _with_tool_noise(F: Array, inputs: list[Array]) -> tuple[Array, Array]:
    """
    Return the transition and the drive of the state with the tool's noises that act on it.

    The state is followed by the noises that have acted and will act again, oldest first; the
    newest is the drive.
    """
    known = len(inputs) - 1
    size = 12 + 6 * known
    A, drive = np.zeros((size, size)), np.zeros((size, 6))
    A[:12, :12] = F
    A[:12, 12:] = np.hstack(inputs[:-1])
    A[12:-6, 18:] = np.eye(size - 18)
    drive[:12], drive[-6:] = inputs[-1], np.eye(6)
    return A, drive


def _lagged(A: Array, kalman: Array) -> Array:
    """
    Return the contribution of the current and past innovations to the next state.

    A noise is estimated from the innovations since it first acted: an innovation changes the
    estimates of all noises known at its time, and these act until they have shifted out.
    """
    gain = np.zeros((LAGS, 12, 6))
    estimates = kalman.copy()
    for lag in range(LAGS):
        gain[lag] = A @ estimates
        estimates[:12] = 0.0
        estimates[12:-6] = estimates[18:]
        estimates[-6:] = 0.0
    return gain


def _one_step(
    model: ModelTuple, tool: State, body: State, period: float
) -> tuple[Array, list[Array]]:
    """
    Return the transition (12, 12) of one step, and the effects B_j (12, 6) of the tool's poses.

    The first of the poses lies half a window of the twists before the step, the last one as much
    behind it.
    """
    changes = np.zeros((2, 12, 24))
    changes[0, :, :12], changes[1, :, 12:] = np.eye(12), np.eye(12)
    durations = np.array([period])
    _, (_, by) = sensitivities(
        model, body, np.array([np.concatenate(tool)] * 2), durations,
        substeps_of(durations, largest_step(model)), changes=changes)
    value, slope, _ = weights(TOOL_HALF_WINDOW, TOOL_ORDER, 1.0 / period)
    inputs = [np.zeros((12, 6)) for _ in range(LAGS + 1)]
    for offset, effect in enumerate((by[:, 12:24], by[:, 24:])):
        for j in range(LAGS):
            inputs[j + offset] += value[j] * effect[:, :6] + slope[j] * effect[:, 6:]
    return by[:, :12], inputs


@kernel
def between(first: State, second: State) -> Change:
    """Return the change that moves one state to another."""
    return (
        apply_transposed(rotation_matrix(first[1]), subtract(second[0], first[0])),
        log_quaternion(quaternion_product(quaternion_conjugate(first[1]), second[1])),
        subtract(second[2], first[2]), subtract(second[3], first[3]),
    )


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
    valid: Mask,
    durations: Array,
    substeps: Stamps,
    filtering: Observer,
) -> Array:
    """
    Return the one-step prediction errors of a recording, zero at missing samples.

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
    _innovations(model, start, *as_inputs(
        tool, package, valid, durations, substeps, filtering.gain, limit), out)
    return out


@kernel
def _innovations(
    model: ModelTuple, body: State, tool: Any, package: Any, valid: Any, durations: Any,
    substeps: Any, gain: Any, limit: Any, out: Array,
) -> None:
    """Predict, compare and correct from row to row."""
    now = row_state(tool[0])
    recent = NO_INNOVATIONS
    for k in range(len(tool)):
        newest = NO_INNOVATION
        if valid[k]:
            row = package[k]
            seen = ((row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]), ZERO, ZERO)
            e, phi, _, _ = between(body, seen)
            out[k, 0], out[k, 1], out[k, 2] = e
            out[k, 3], out[k, 4], out[k, 5] = phi
            newest = (
                clipped(e[0], limit[0]), clipped(e[1], limit[1]), clipped(e[2], limit[2]),
                clipped(phi[0], limit[3]), clipped(phi[1], limit[4]), clipped(phi[2], limit[5]),
            )
        recent = (newest,) + recent[:-1]
        if k + 1 < len(tool):
            later = row_state(tool[k + 1])
            body = advance(model, body, now, later, durations[k], substeps[k])
            now = later
            body = moved(body, *correction(gain, recent))


@kernel
def clipped(value: float, limit: float) -> float:
    """Return the value, held between -limit and limit."""
    return min(max(value, -limit), limit)


@kernel
def correction(gain: Any, recent: Any) -> Change:
    """Return the correction of the next state by the last innovations, the newest first."""
    d, r, v, w = ZERO, ZERO, ZERO, ZERO
    for lag in range(len(recent)):
        d = add(d, rows_product(gain[lag], 0, recent[lag]))
        r = add(r, rows_product(gain[lag], 3, recent[lag]))
        v = add(v, rows_product(gain[lag], 6, recent[lag]))
        w = add(w, rows_product(gain[lag], 9, recent[lag]))
    return d, r, v, w


@kernel
def row_product(gain: Any, i: int, e: Any) -> Any:
    """Return row i of the gain times the innovation."""
    row = gain[i]
    return (
        row[0] * e[0] + row[1] * e[1] + row[2] * e[2]
        + row[3] * e[3] + row[4] * e[4] + row[5] * e[5]
    )


@kernel
def rows_product(gain: Any, i: int, e: Any) -> Vector:
    """Return rows i to i + 2 of the gain times the innovation."""
    return row_product(gain, i, e), row_product(gain, i + 1, e), row_product(gain, i + 2, e)


@dataclass(frozen=True, eq=False)
class OneStep:
    """
    One-step prediction errors: the model corrected by the measurement at every sample.

    Parameters
    ----------
    errors : ndarray (N, 6)
        In axes of B, m and rad; NaN where nothing was measured.
    chi2 : float
        Mean square of the errors in units of their expected covariance; 1 where the model and the
        noise explain all.
    whiteness : Whiteness
        Of the errors: white where the model explains all but noise.
    spectrum : Spectrum
        Of the errors.

    """

    errors: Array
    chi2: float
    whiteness: Whiteness
    spectrum: Spectrum


def _sharp(measured: Trajectory, tool: Trajectory) -> Trajectory:
    """Return the tool smoothed as the observer takes it to be; gaps as bridged."""
    smoothed = in_motion(measured)
    known = smoothed.select(smoothed.valid)
    known = known.select(np.isin(known.stamps_ns, tool.stamps_ns))
    at = np.searchsorted(tool.stamps_ns, known.stamps_ns)
    position, rotation, twist = tool.position.copy(), tool.rotation.copy(), tool_rows(tool)[:, 7:]
    position[at], rotation[at], twist[at] = known.position, known.rotation, known.twist
    return Trajectory(tool.stamps_ns, position, rotation, twist)


def one_step_errors(
    model: ModelTuple,
    start: State,
    measured_tool: Trajectory,
    tool: Trajectory,
    package: Trajectory,
    noises: tuple[Noise, Noise],
) -> OneStep | None:
    """
    Return the one-step prediction errors of a recording, or None without noise.

    Parameters
    ----------
    model : ModelTuple
        Cup, package and gravity.
    start : State
        Of the package at the first sample of the tool.
    measured_tool : Trajectory
        Poses of E as measured, here smoothed as the observer takes them to be.
    tool : Trajectory
        N poses of E with twists, with gaps bridged, for where those are not known.
    package : Trajectory
        N poses of B as measured.
    noises : (Noise, Noise)
        Of the poses of tool and package.

    """
    if any(noise.position < LEAST_NOISE or noise.rotation < LEAST_NOISE for noise in noises):
        return None
    rows = tool_rows(_sharp(measured_tool, tool))
    period = 1.0 / uniform_rate_hz(tool.stamps_ns)
    first = state_row(rows[0, :3], rows[0, 3:7], np.zeros(6))
    try:
        rest = static_equilibrium(model, first)
        filtering = observer(model, first, rest, period, period, *noises)
    except np.linalg.LinAlgError:
        return None
    durations = np.diff(tool.stamps_ns) / NS_PER_S
    errors = innovations(
        model, start, rows,
        np.hstack([package.position, rotation_to_quaternion(package.rotation)]),
        package.valid, durations,
        substeps_of(durations, largest_step(model)),
        filtering,
    )
    white = np.linalg.solve(np.linalg.cholesky(filtering.covariance), errors[package.valid].T)
    shown = np.where(package.valid[:, None], errors, np.nan)
    return OneStep(
        errors=shown,
        chi2=float(np.mean(white**2)),
        whiteness=portmanteau(shown),
        spectrum=spectrum(shown, 1.0 / period),
    )
