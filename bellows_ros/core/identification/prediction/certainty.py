"""
How sure the prediction error is of what it found, and where noise has pulled it.

Noise of the poses is also in the derivatives of the innovations, where it looks like information:
how much it adds is seen by adding as much again. The observer is that of small motions about the
rest; what it neglects pulls the minimum a little and lets it scatter more. Both are seen in
replicas: recordings simulated with the cup that was found, with fresh noise of the same size. The
mean of their scores (gradients at the truth) gives the pull, which is taken out to first order,
their variance the scatter.
"""

from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.identification.noise import Noise, TOOL_HALF_WINDOW, TOOL_ORDER
from bellows_ros.core.identification.prediction.objective import Objective, Stretch
from bellows_ros.core.lie import apply, exp_so3, quaternion_to_rotation
from bellows_ros.core.savgol import weights
from bellows_ros.core.simulation import simulate_rows
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HUBER_FROM = 3.0
"""Standard deviations from which an innovation counts linearly."""

MORE_NOISE = 3
"""Times that noise is added to see what it contributes to the derivatives."""

REPLICAS = 16

LEAST_SIGNAL = 0.05
"""A direction whose apparent information is signal to a smaller part is taken as unknown."""

IN_UNKNOWN = 0.05
"""A number whose part in unknown directions is more than this of its spread is unknown."""


class Certainty(NamedTuple):
    """
    What is known of m free numbers.

    Pull (m,): how far noise has moved their estimates on average. Covariance (m, m) along the
    directions that the recordings tell; unknown (m, k): the k directions of which they tell
    nothing. Chi2: of the innovations that are no outliers, per degree of freedom.
    """

    pull: Array
    covariance: Array
    unknown: Array
    chi2: float

    def without(self, numbers: Mask) -> 'Certainty':
        """Return the same with some free numbers (m,) unknown."""
        return self._replace(unknown=np.hstack([self.unknown, np.eye(len(numbers))[:, numbers]]))

    @property
    def told(self) -> Mask:
        """Which of the numbers (m,) have no part to speak of in the unknown directions."""
        spread = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        part = np.linalg.norm(self.unknown, axis=1)
        return np.asarray(part <= IN_UNKNOWN * spread)


def certainty(objective: Objective, theta: Array) -> Certainty:
    """Return how sure the minimum of an objective is."""
    r = objective.residuals(theta)
    information = _information(objective, theta, r)
    rng = np.random.default_rng(0)
    noisier = np.mean(
        [_information(_with_more_noise(objective, rng), theta, r) for _ in range(MORE_NOISE)],
        axis=0,
    )
    inverse, unknown = _inverse(2.0 * information - noisier, information)
    usual = np.abs(r) <= 2.0 * HUBER_FROM
    degrees = max(int(np.count_nonzero(usual)) - len(theta), 1)
    chi2 = float(np.sum(r[usual] ** 2)) / degrees
    mean, excess = _scores(objective, theta, information)
    scatter = information * np.sqrt(np.outer(excess, excess)) * max(chi2, 1.0)
    return Certainty(-inverse @ mean, inverse @ scatter @ inverse, unknown, chi2)


def _scores(objective: Objective, theta: Array, information: Array) -> tuple[Array, Array]:
    """
    Return the mean score of the replicas, and its variance over the information.

    Both of K, P and delays; the starts, which touch little, have mean 0 and variance as told.
    """
    columns = np.r_[0:objective.chart.size, objective.size - objective.delays:objective.size]
    perfect = [_simulated(objective, theta, i) for i in range(len(objective.stretches))]
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(REPLICAS):
        replica = objective.with_stretches([_noisy(stretch, rng) for stretch in perfect])
        r = replica.residuals(theta)
        J = replica.jacobian(theta, columns.tolist())
        scores.append(J.T @ (_weight(r) * r))
    mean, excess = np.zeros(len(theta)), np.ones(len(theta))
    mean[columns] = np.mean(scores, axis=0)
    apparent = np.maximum(np.diag(information)[columns], 1e-300)
    # at least as told: a variance of few replicas errs to both sides
    excess[columns] = np.maximum(np.var(scores, axis=0, ddof=1) / apparent, 1.0)
    return mean, excess * (1.0 + 1.0 / REPLICAS)


def _simulated(objective: Objective, theta: Array, i: int) -> Stretch:
    """Return a stretch as it would be without noise, were its tool's motion the measured one."""
    stretch = objective.stretches[i]
    model, _, substeps, _ = stretch.prepared(objective.cup(theta), objective.inflation)
    rows = simulate_rows(
        model, stretch.start(objective.start_of(theta, i)),
        stretch.tool_rows(objective.delay_of(theta, i)), stretch.durations, substeps,
    )  # fmt: skip
    if not np.isfinite(rows).all():
        raise BellowsError(
            'With the cup that was found the package does not stay on it: its simulated motion '
            'grows without bounds. Check the package, cup.length, recording.world, and whether '
            'the stamps of tool and package are of one clock (fit.time_offset).'
        )
    seen = stretch.measured.package
    package = Trajectory(
        seen.stamps_ns, rows[:, :3], quaternion_to_rotation(rows[:, 3:7]), valid=seen.valid)
    return stretch.with_poses(stretch.measured.tool, package)


def _with_more_noise(objective: Objective, rng: np.random.Generator) -> Objective:
    """Return the same objective with as much noise again on all poses."""
    return objective.with_stretches([_noisy(stretch, rng) for stretch in objective.stretches])


def _noisy(stretch: Stretch, rng: np.random.Generator) -> Stretch:
    """Return a stretch with noise on its poses, and on the tool's twists what comes of it."""
    measured = stretch.measured
    package = _turned(measured.package, *_drawn(measured.package, stretch.noise, rng))
    noise = np.hstack(_drawn(measured.tool, measured.tool_noise, rng))
    value, slope, _ = weights(TOOL_HALF_WINDOW, TOOL_ORDER, 1.0 / measured.tool_period)
    smooth, twist = (correlate1d(noise, w, axis=0, mode='nearest') for w in (value, slope))
    tool = _turned(measured.tool, smooth[:, :3], smooth[:, 3:])
    if tool.twist is not None:
        tool = replace(tool, twist=tool.twist + twist)
    return stretch.with_poses(tool, package)


def _drawn(poses: Trajectory, noise: Noise, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return white noise (N, 3) of positions and rotations."""
    shape = poses.position.shape
    return (
        noise.position * rng.standard_normal(shape), noise.rotation * rng.standard_normal(shape))


def _turned(poses: Trajectory, shift: Array, turn: Array) -> Trajectory:
    """Return poses moved (m) and turned (rad) in their own axes."""
    return replace(
        poses, position=poses.position + apply(poses.rotation, shift),
        rotation=poses.rotation @ exp_so3(turn),
    )  # fmt: skip


def _weight(residuals: Array) -> Array:
    """Return the weights of Huber's loss."""
    return np.asarray(np.minimum(HUBER_FROM / np.maximum(np.abs(residuals), 1e-300), 1.0))


def _information(objective: Objective, theta: Array, residuals: Array) -> Array:
    """Return J^T J with Huber's weights."""
    J = objective.jacobian(theta)
    return np.asarray((J * _weight(residuals)[:, None]).T @ J)


def _inverse(signal: Array, information: Array) -> tuple[Array, Array]:
    """Return the inverse where there is signal, and the directions (m, k) where there is none."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    unit = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(signal / unit)
    apparent = np.einsum('ik,ij,jk->k', vectors, information / unit, vectors)
    known = values > LEAST_SIGNAL * apparent
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return np.asarray(inverse / unit), vectors[:, ~known] / scale[:, None]
