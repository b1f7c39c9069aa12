"""
The Fisher information of a motion on K and P, before or after it is recorded.

It is that of the output error, by its own code: of the poses in units of what noise of both bodies
makes of their differences from the simulated ones (see `identification.whitening`). For small
motions it follows from the linear response, which is what a search can afford.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import covariance_of
from bellows_ros.core.identification.search import MeasuredSegment, Search, Segment
from bellows_ros.core.model.cup_package import Cup, gripper_of, Package
from bellows_ros.core.model.equilibrium import linearise, pose_error, static_equilibrium
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording import recording
from bellows_ros.core.recording.recording import BodyNoise, Noise
from bellows_ros.core.signals.savgol import weights
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

DIFFERENCE = 1e-4
"""Step of numerical derivatives by parameters, in units of their scale."""


class Tracking(NamedTuple):
    """Time between poses (s) and their white noise, of tool and package."""

    tool_period: float
    tool: Noise
    package_period: float
    package: Noise


def motion_information(
    cup: Cup, package: Package, gravity: Array | float, tool: Trajectory, tracking: Tracking,
    structure: Structure,
) -> Array:
    """
    Return the information (2 n, 2 n) of a motion on the n parameters of K and n of P.

    Parameters
    ----------
    cup, package, gravity
        The model, as `simulate` takes it.
    tool : Trajectory
        Of E with body twists, at the stamps at which the package is tracked, from rest.
    tracking : Tracking
        How both are tracked.
    structure : Structure
        Of K and P.

    """
    body = simulate(gripper_of(cup, structure.places), package, tool, gravity=gravity)
    density = np.sqrt(tracking.tool_period / tracking.package_period)
    of_tool, of_package = (BodyNoise(np.repeat(std, 3)) for std in (
        density * np.array(tracking.tool), tracking.package))
    measured = MeasuredSegment(tool, body, package, gravity, of_tool, of_package)
    search = Search([Segment(measured)], structure, cup, {})
    (part,), _, _ = search.system(search.start)
    return np.asarray(part.jacobian.T @ part.jacobian / np.outer(search.units, search.units))


def standard_errors(information: Array) -> Array:
    """Return the standard errors (n,) of unbiased estimates; infinite without information."""
    return np.asarray(np.sqrt(np.diag(covariance_of(information))))


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
    Return the linear response and its information on the parameters.

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
        rests.append(np.ravel(pose_error(down[2], *up[2][:2])) / (2.0 * DIFFERENCE))
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
    dynamics: Any = s**2 * np.eye(6) - s * J.body_twist - J.body_pose
    package = np.linalg.solve(dynamics, J.tool_pose + s * J.tool_twist)
    if tracking is None:
        return package, package, rest
    period = tracking.package_period
    value, slope, _ = weights(recording.TOOL_HALF_WINDOW, recording.TOOL_ORDER, 1.0 / period)
    lags: Any = np.arange(-recording.TOOL_HALF_WINDOW, recording.TOOL_HALF_WINDOW + 1) * period
    wave = np.exp(s[:, :, 0] * lags)
    driven = np.linalg.solve(
        dynamics, (wave @ value)[:, None, None] * J.tool_pose
        + (wave @ slope)[:, None, None] * J.tool_twist)
    variances = [np.repeat(noise, 3) ** 2 for noise in (tracking.tool, tracking.package)]
    density = variances[0] * tracking.tool_period / period
    noise = np.diag(variances[1]) + (driven * density) @ np.conj(np.swapaxes(driven, 1, 2))
    return package, noise, rest
