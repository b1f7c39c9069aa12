"""
A force-torque sensor in a fit by simulation, the third kind of sensor beside poses and corners.

The sensor shows `(1 + k) X + s Y phi + b`, with the load X of the simulated package by Newton and
Euler, the gripper phi, and gain errors k of each axis. Means of measured and predicted wrenches
over blocks are compared, so that both pass one low pass: noise of the tool at a mode of the cup
would bias K. The bias b follows a random walk. The other noise is estimated, at least as stated:
successive means with a correlation c count less, by (1 - c) / (1 + c).
"""

from collections.abc import Mapping
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.model.simulation import tool_rows
from bellows_ros.core.sensors.wrench import (
    BLOCK_NS,
    gripper_regressors,
    INERTIAL_NUMBERS,
    Mount,
    Readings,
    WrenchSensor,
)
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np
from scipy.sparse import csr_matrix

DELAY_STD = 5e-3
"""Standard deviation of the stated delay of a force-torque sensor, s."""

GRIPPER_STD = np.repeat([10.0, 1.0, 0.1], (1, 3, 6))
"""Standard deviations of the inertial numbers of an unknown gripper: kg, kg m, kg m^2."""

MAX_CORRELATION = 0.95
"""Largest correlation of successive means."""


class Blocks(NamedTuple):
    """
    Means (B, 6) of wrenches, and the matrix (B, M) of the same means of values at nodes.

    Further values are the times (B,) of the blocks, s, and the usual number of wrenches in one.
    """

    means: Array
    average: csr_matrix
    seconds: Array
    size: int

    @classmethod
    def of(cls, felt: Readings, nodes_ns: Stamps) -> 'Blocks':
        """Return the blocks of wrenches within nodes (M,), with their delay subtracted."""
        stamps = felt.stamps_ns - felt.sensor.delay_ns
        used = (stamps >= nodes_ns[0]) & (stamps < nodes_ns[-1])
        number = (stamps - nodes_ns[0]) // BLOCK_NS
        counts = np.bincount(number[used], minlength=1)
        used[used] = 2 * counts[number[used]] >= counts.max()
        _, number, counts = np.unique(number[used], return_inverse=True, return_counts=True)
        after = np.searchsorted(nodes_ns, stamps[used], side='right')
        part = (stamps[used] - nodes_ns[after - 1]) / (nodes_ns[after] - nodes_ns[after - 1])
        weight, shape = 1.0 / counts[number], (len(counts), len(nodes_ns))
        average = csr_matrix((
            np.append((1.0 - part) * weight, part * weight),
            (np.tile(number, 2), np.append(after - 1, after))), shape)
        means = csr_matrix((weight, (number, np.arange(len(number))))) @ felt.values[used]
        return cls(means, average, average @ (nodes_ns / NS_PER_S), int(counts.max(initial=1)))

    def averaged(self, values: Array) -> Array:
        """Return the means (B, ...) of values at nodes (M, ...)."""
        means = self.average @ values.reshape(len(values), -1)
        return np.asarray(means.reshape(-1, *values.shape[1:]))


def of_gripper(tool: Array, seconds: Array, gravity: Array, mount: Mount) -> Array:
    """Return the regressors (M, 6, 10) of a gripper along states of the tool (M, 13)."""
    return gripper_regressors(tool, np.gradient(tool[:, 7:], seconds, axis=0), gravity, mount)


def sizes_of(phi: Array) -> Array:
    """Return the sizes (3,) of mass, first moments and inertia of inertial numbers (10,)."""
    return np.array([abs(phi[0]), np.linalg.norm(phi[1:4]), np.linalg.norm(phi[4:])])


def information_on_gripper(
    tool: Trajectory, felt: Readings, gravity: Array
) -> tuple[Array, Array]:
    """Return information (10, 10) and slope (10,) on a gripper without a package."""
    rows, seconds, sensor = tool_rows(tool), tool.stamps_ns / NS_PER_S, felt.sensor
    blocks = Blocks.of(felt, tool.stamps_ns)
    phi: Array = np.zeros(INERTIAL_NUMBERS)
    regressors = of_gripper(rows, seconds, gravity, sensor.mount)
    means, count = blocks.averaged(regressors), len(blocks.means)
    others = np.concatenate([np.repeat(sensor.bias_std, 3), [DELAY_STD]]) ** -2
    for _ in range(2):  # the delay needs the gripper
        rate = blocks.averaged(np.gradient(regressors @ phi, seconds, axis=0))
        J, r = whitened(np.concatenate([
            means, np.broadcast_to(np.eye(6), (count, 6, 6)), -rate[:, :, None]], axis=2),
            blocks.means, blocks.seconds - seconds[0], sensor, blocks.size)
        A = J.reshape(r.size, -1)
        H, g = A.T @ A, A.T @ r.ravel()
        H[INERTIAL_NUMBERS:, INERTIAL_NUMBERS:] += np.diag(others)
        carried = np.linalg.solve(H[INERTIAL_NUMBERS:, INERTIAL_NUMBERS:], H[INERTIAL_NUMBERS:])
        own = slice(INERTIAL_NUMBERS)
        H, g = H[own, own] - carried[:, own].T @ H[INERTIAL_NUMBERS:, own], g[own] - (
            carried[:, own].T @ g[INERTIAL_NUMBERS:])
        phi = np.asarray(np.linalg.solve(H + np.diag(GRIPPER_STD**-2), g))
    return H, g


def compared(
    blocks: Blocks, load: Array, rate: Array, regressors: Array, sensor: WrenchSensor,
    free: Mapping[str, Array], rows: Mapping[str, Places], slopes: Array,
) -> tuple[Array, Array]:
    """
    Return derivatives (B, 6, q) and residuals (B, 6) of blocks, in standard deviations.

    Parameters
    ----------
    blocks : Blocks
        Measured means.
    load, rate : ndarray (B, 6)
        Means of the package's load, and of the change of the prediction in 1 s.
    regressors : ndarray (B, 6, 10)
        Means of s Y.
    sensor : WrenchSensor
        The sensor, and the stated gripper.
    free, rows : mapping
        Values of quantities, SI units, and their unknowns.
    slopes : ndarray (B, 6, q)
        Derivatives of the load by the unknowns of cup and package, SI units.

    """
    gain, delay = free['wrench_gain'], float(free['wrench_delay'][0])
    J = (1.0 + gain)[:, None] * slopes
    J[:, :, rows['wrench_gain']] = load[:, :, None] * np.eye(6)
    J[:, :, rows['wrench_bias']] = np.eye(6)
    J[:, :, rows['wrench_delay']] = -rate[:, :, None]
    if 'gripper' in rows:
        J[:, :, rows['gripper']] = regressors
    phi = np.array(sensor.gripper) + free.get('gripper', np.zeros(INERTIAL_NUMBERS))
    return J, blocks.means - (1.0 + gain) * load - regressors @ phi - free['wrench_bias'] + (
        delay * rate)


def whitened(
    J: Array, r: Array, seconds: Array, sensor: WrenchSensor, count: int
) -> tuple[Array, Array]:
    """
    Return derivatives (B, 6, q) and residuals (B, 6) of blocks in standard deviations.

    Times (B,) are since the last zero of the random walk of the bias, s; a block has so many
    wrenches.
    """
    least = np.repeat(sensor.noise, 3) / np.sqrt(count)
    A = (J / least[:, None]).reshape(r.size, -1)
    step, _, rank, _ = np.linalg.lstsq(A, (r / least).ravel(), rcond=None)
    e = r / least - (A @ step).reshape(r.shape)
    squares = np.maximum(np.sum(e**2, axis=0), 1e-99)
    kept = np.clip(np.sum(e[1:] * e[:-1], axis=0) / squares, 0.0, MAX_CORRELATION)
    found = squares / len(r) / max(1.0 - rank / r.size, 1e-3) * (1.0 + kept) / (1.0 - kept)
    variance = least**2 * np.maximum(found, 1.0)
    both = without_walk(np.dstack([J, r]), seconds, variance, np.repeat(sensor.drift, 3))
    return both[:, :, :-1], both[:, :, -1]


def without_walk(values: Array, seconds: Array, variance: Array, drift: Array) -> Array:
    """
    Return values (B, 6, q) with the white innovations of a random walk in white noise.

    The walk, with standard deviations (6,) after 1 s, is 0 at time 0; the noise has variances
    (6,). This is the product with the inverse of the Cholesky factor of the covariance, by a
    Kalman filter of one state for each axis.
    """
    out, state, P = np.empty_like(values), np.zeros(values.shape[1:]), np.zeros(6)
    for k, step in enumerate(np.diff(seconds, prepend=0.0).tolist()):
        P = P + drift**2 * step
        difference, spread = values[k] - state, P + variance
        out[k] = difference / np.sqrt(spread)[:, None]
        state = state + (P / spread)[:, None] * difference
        P = P * variance / spread
    return out
