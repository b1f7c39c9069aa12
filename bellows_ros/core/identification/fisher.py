"""
The Fisher information of a motion on K and P, before or after it is recorded.

It is that of the prediction-error method: of innovations (see `identification.innovations`), which
know the noise of both bodies, with the package's first state unknown. About a motion without noise
their derivatives follow the sensitivities of the motion, corrected at every sample by the gain.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.equilibrium import largest_step, linearise, static_equilibrium
from bellows_ros.core.identification.innovations import between, observer
from bellows_ros.core.jacobians import DAMPING, STIFFNESS
from bellows_ros.core.jit import COMPILED, kernel
from bellows_ros.core.kernels import ModelTuple, State
from bellows_ros.core.recording.noise import Noise, TOOL_HALF_WINDOW, TOOL_ORDER
from bellows_ros.core.savgol import weights
from bellows_ros.core.sensitivities import advance_changes, columns, workspace
from bellows_ros.core.simulation import row_state, state_row, tool_rows
from bellows_ros.core.structure import Structure
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
import numpy as np

STEPS_PER_LARGEST = 0.4
"""Integration steps may be longer than those of a simulation: derivatives to 1e-3 are enough."""

ENTRIES = slice(STIFFNESS.start, DAMPING.stop)
"""Of the parameters of `jacobians`: the upper triangles of K and P."""

DIFFERENCE = 1e-4
"""Of parameters, in units of their scale, for derivatives of the linear response."""

UPPER = np.triu_indices(6)
OF_MATRICES = (slice(12, 12 + 21), slice(12 + 21, 12 + 42))


class Tracking(NamedTuple):
    """Time between poses (s) and their white noise, of tool and package."""

    tool_period: float
    tool: Noise
    package_period: float
    package: Noise


def motion_information(
    model: ModelTuple, tool: Trajectory, tracking: Tracking, structure: Structure
) -> Array:
    """
    Return the information (2 n, 2 n) of a motion on the n parameters of K and n of P.

    Parameters
    ----------
    model : ModelTuple
        Cup, package and gravity.
    tool : Trajectory
        Of E with body twists, at the stamps at which the package is tracked, from rest.
    tracking : Tracking
        How both are tracked.
    structure : Structure
        Of K and P.

    """
    rows = tool_rows(tool)
    first = state_row(rows[0, :3], rows[0, 3:7], np.zeros(6))
    rest = static_equilibrium(model, first)
    filtering = observer(
        model, first, rest, tracking.package_period, tracking.tool_period, tracking.tool,
        tracking.package)
    durations = np.diff(tool.stamps_ns) / NS_PER_S
    longest = largest_step(model) / STEPS_PER_LARGEST
    substeps = np.maximum(np.ceil(durations / longest), 1.0).astype(np.int64)
    changes = innovation_changes(model, rest, rows, durations, substeps, filtering.gain)
    basis = np.array([unit[UPPER] for unit in structure.basis])
    parts = [changes[:, :, :12], *(changes[:, :, part] @ basis.T for part in OF_MATRICES)]
    return information(np.concatenate(parts, axis=2), filtering.covariance, 12)


def innovation_changes(
    model: ModelTuple, start: State, tool: Array, durations: Array, substeps: Stamps, gain: Array,
) -> Array:
    """
    Return the derivatives (N, 6, 12 + 42) of the innovations of a motion without noise.

    By the first state and by the upper triangles of K and P.

    Parameters
    ----------
    model, start, tool, durations, substeps
        As `sensitivities.sensitivities` takes them.
    gain : ndarray (lags, 12, 6)
        Of the observer.

    """
    n = 12 + ENTRIES.stop - ENTRIES.start
    S: Array = np.zeros((12, n))
    out: Array = np.empty((len(tool), 6, n))
    S[:, :12] = np.eye(12)
    inputs: tuple[Any, Any, Any] = (tool, durations, substeps)
    if not COMPILED:
        inputs = (tool.tolist(), durations.tolist(), substeps.tolist())
    _innovation_changes(
        model, start, *inputs, gain, (ENTRIES.start, ENTRIES.stop), np.zeros((12, 0)), S, out,
        *workspace(n))
    return out


@kernel
def _innovation_changes(
    model: ModelTuple, body: State, tool: Any, durations: Any, substeps: Any, gain: Any,
    parameters: tuple[int, int], none: Any, S: Any, out: Any, tool_changes: Any, work: Any,
) -> None:
    """Carry the changes of the predicted state from row to row, and correct them."""
    before = row_state(tool[0])
    for k in range(len(tool)):
        out[k] = -S[:6]
        if k == len(durations):
            return
        after = row_state(tool[k + 1])
        body = advance_changes(
            model, body, before, after, durations[k], substeps[k], S, parameters, none, none,
            tool_changes, work)
        before = after
        for lag in range(min(k + 1, len(gain))):
            for c in columns(S.shape[1]):
                for i in range(12):
                    for j in range(6):
                        S[i, c] += gain[lag, i, j] * out[k - lag, j, c]


def information(derivatives: Array, covariance: Array, nuisance: int = 0) -> Array:
    """
    Return the Fisher matrix (n, n) of white Gaussian numbers.

    Parameters
    ----------
    derivatives : ndarray (N, m, nuisance + n)
        Of N vectors of m numbers.
    covariance : ndarray (m, m)
        Of each vector.
    nuisance : int
        So many parameters, the first, are unknown and not wanted: the information on the others is
        what is left when they are estimated, too.

    """
    white = np.linalg.solve(np.linalg.cholesky(covariance), derivatives)
    J = white.reshape(-1, derivatives.shape[2])
    own: Any = np.linalg.qr(J, mode='r')
    own = own[nuisance:, nuisance:]
    return np.asarray(own.T @ own)


def standard_errors(information: Array) -> Array:
    """Return the standard errors (n,) of unbiased estimates; infinite without information."""
    scale = np.sqrt(np.diag(information))
    if not scale.all():
        return np.full(len(scale), np.inf)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    with np.errstate(divide='ignore'):
        return np.asarray(np.sqrt(vectors**2 @ (1.0 / np.maximum(values, 0.0))) / scale)


class Response(NamedTuple):
    """
    Small motions of the package about its rest at frequencies, for small motions of the tool.

    Parameters
    ----------
    package : ndarray (F, 6, 6)
        Displacement of B (m, rad, its own axes) by that of E (its own axes).
    changes : ndarray (n, F, 6, 6)
        Its derivatives by parameters, in units of the spread of a pose's innovation there.
    constant : ndarray (n, n)
        Information per pose of where the package rests.

    """

    package: Array
    changes: Array
    constant: Array


def response(
    model_of: Callable[[Array], ModelTuple], parameters: Array, scale: Array, tool: State,
    omega: Array, tracking: Tracking,
) -> Response:
    """
    Return the linear response and what it tells of parameters.

    Parameters
    ----------
    model_of : callable
        From parameters (n,) to cup, package and gravity.
    parameters, scale : ndarray (n,)
        Where, and the units in which derivatives are taken.
    tool : State
        At rest.
    omega : ndarray (F,)
        Angular frequencies, rad/s.
    tracking : Tracking
        How both bodies are tracked.

    """
    changes, rests = [], []
    for step in DIFFERENCE * np.diag(scale):
        up, down = (_linear(model_of(parameters + s), tool, omega) for s in (step, -step))
        changes.append((up[0] - down[0]) / (2.0 * DIFFERENCE))
        rests.append(np.array(between(down[2], up[2])[:2]).ravel() / (2.0 * DIFFERENCE))
    package, noise, _ = _linear(model_of(parameters), tool, omega, tracking)
    root = np.linalg.inv(np.linalg.cholesky(noise))
    at_rest = np.array(rests) @ root[0].T
    return Response(package, np.array([root @ change for change in changes]),
                    np.real(at_rest.conj() @ at_rest.T))


def _linear(
    model: ModelTuple, tool: State, omega: Array, tracking: Tracking | None = None
) -> tuple[Any, Any, State]:
    """Return transfer (F, 6, 6), spectrum of the measured poses' noise (F, 6, 6), and the rest."""
    rest = static_equilibrium(model, tool)
    J, s = linearise(model, tool, rest), 1j * omega.reshape(-1, 1, 1)
    own: Any = s**2 * np.eye(6) - s * J.body_twist - J.body_pose
    package = np.linalg.solve(own, J.tool_pose + s * J.tool_twist)
    if tracking is None:
        return package, package, rest
    period = tracking.package_period
    value, slope, _ = weights(TOOL_HALF_WINDOW, TOOL_ORDER, 1.0 / period)
    lags: Any = np.arange(-TOOL_HALF_WINDOW, TOOL_HALF_WINDOW + 1) * period
    wave = np.exp(s[:, :, 0] * lags)
    driven = np.linalg.solve(
        own, (wave @ value)[:, None, None] * J.tool_pose
        + (wave @ slope)[:, None, None] * J.tool_twist)
    variances = [np.repeat(noise, 3) ** 2 for noise in (tracking.tool, tracking.package)]
    density = variances[0] * tracking.tool_period / period
    noise = np.diag(variances[1]) + (driven * density) @ np.conj(np.swapaxes(driven, 1, 2))
    return package, noise, rest
