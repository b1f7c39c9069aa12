"""
A force-torque sensor in a fit by simulation.

The sensor shows `(1 + k) X + s Y phi + b`, with the load X of the simulated package by Newton and
Euler, the gripper phi, and gain errors k of each axis. Means of measured and predicted wrenches
over blocks are compared, so that both pass one low pass: noise of the tool at a mode of the cup
would bias K. The bias b follows a random walk. The other noise is estimated, at least as stated:
successive means with a correlation c count less, by (1 - c) / (1 + c).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.model.simulation import tool_rows
from bellows_ros.core.sensors.body import Values
from bellows_ros.core.sensors.readings import Kind, SimulatedMotion
from bellows_ros.core.sensors.wrench import (
    BLOCK_NS,
    gripper_regressors,
    INERTIAL_NUMBERS,
    loads,
    Mount,
    WrenchSensor,
)
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, TwistStream
import numpy as np
from scipy.sparse import csr_matrix

DELAY_STD = 5e-3
"""Standard deviation of the stated delay of a force-torque sensor, s."""

GRIPPER_STD = np.repeat([10.0, 1.0, 0.1], (1, 3, 6))
"""Standard deviations of the inertial numbers of an unknown gripper: kg, kg m, kg m^2."""

MAX_CORRELATION = 0.95
"""Largest correlation of successive means."""


@dataclass(frozen=True, eq=False)
class Wrenches:
    """
    Wrenches (N, 6) of a sensor in its axes, N and N m, with stamps by the tool's clock, ns.

    See `Readings` for the members.
    """

    sensor: WrenchSensor
    stamps_ns: Stamps
    values: Array

    quantities: ClassVar[Mapping[str, Kind]] = {
        'wrench_gain': Kind(1e-2, 6, 0.1, 0.1, parameter='wrench.gain_std'),
        'gripper': Kind(1e-3, INERTIAL_NUMBERS, 1.0, 1.0, parameter='gripper.std'),
        'wrench_bias': Kind(0.1, 6, 1.0, 10.0, each=True, parameter='wrench.bias_std'),
        'wrench_delay': Kind(1e-3, 1, 0.01, 0.1, each=True, parameter='wrench.delay')}
    """Relative errors of the gains; inertial numbers of the gripper (kg, kg m, kg m^2); bias (N, N
    m); change of the delay, s."""
    determined: ClassVar[tuple[str, ...]] = ('mass',)
    parameters: ClassVar[tuple[str, ...]] = ('wrench.', 'gripper.')
    remedy: ClassVar[str] = (
        'Check wrench.sign, wrench.frame, gripper.mass and gripper.com, and zero the sensor with '
        'the empty gripper')

    @classmethod
    def of(
        cls, stream: TwistStream, tool: Trajectory, world: str, R_world_recorded: Array,
        values: Mapping[str, Any],
    ) -> Self:
        """
        Return recorded wrenches during the motion of a tool, in the axes of the sensor.

        Those with the frame of the tool's poses, the world, are in recorded axes.
        """
        sensor, stamps = WrenchSensor.of(values), stream.stamps_ns
        used = (stamps >= tool.stamps_ns[0]) & (stamps <= tool.stamps_ns[-1])
        pairs = np.stack([stream.linear, stream.angular])[:, used]
        if stream.frame_id == world:
            R = resample(tool, stamps[used]).rotation @ np.reshape(sensor.mount[1], (3, 3))
            pairs = lie.apply(np.swapaxes(R, 1, 2) @ R_world_recorded, pairs)
        return cls(sensor, stamps[used], np.hstack([*pairs]))

    @property
    def deviations(self) -> Values:
        """Standard deviations of the quantities; a gripper without mass is exact."""
        sensor = self.sensor
        stds = {'wrench_gain': np.full(6, sensor.gain_std),
                'wrench_bias': np.repeat(sensor.bias_std, 3),
                'wrench_delay': np.array([DELAY_STD])}
        if sensor.gripper[0]:
            stds['gripper'] = np.array(sensor.gripper_std)
        return stds

    def compared(
        self, tool: Array, nodes_ns: Stamps, gravity: Array, begin_ns: int
    ) -> 'ComparedWrenches':
        """Return the mean wrenches of blocks within a segment; see `Readings`."""
        return ComparedWrenches(
            self.sensor, Blocks.of(self, nodes_ns), nodes_ns / NS_PER_S, begin_ns / NS_PER_S,
            of_gripper(tool, nodes_ns / NS_PER_S, gravity, self.sensor.mount))


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
    def of(cls, felt: Wrenches, nodes_ns: Stamps) -> 'Blocks':
        """Return the blocks of wrenches within nodes (M,), with their delay subtracted."""
        stamps = felt.stamps_ns - felt.sensor.delay_ns
        used = (stamps >= nodes_ns[0]) & (stamps < nodes_ns[-1])
        number = (stamps - nodes_ns[0]) // BLOCK_NS
        counts = np.bincount(number[used], minlength=1)
        used[used] = 2 * counts[number[used]] >= counts.max()
        _, number, counts = np.unique(number[used], return_inverse=True, return_counts=True)
        weight, shape = 1.0 / counts[number], (len(counts), len(nodes_ns))
        places, parts = _cubic(nodes_ns, stamps[used])
        average = csr_matrix((
            (weight * parts).ravel(), (np.tile(number, 4), places.ravel())), shape)
        means = csr_matrix((weight, (number, np.arange(len(number))))) @ felt.values[used]
        seconds = np.asarray(average @ (nodes_ns / NS_PER_S))
        return cls(means, average, seconds, int(counts.max(initial=1)))

    def averaged(self, values: Array) -> Array:
        """Return the means (B, ...) of values at nodes (M, ...)."""
        means = self.average @ values.reshape(len(values), -1)
        return np.asarray(means.reshape(-1, *values.shape[1:]))


class ComparedWrenches(NamedTuple):
    """
    Blocks of wrenches, and the regressors (M, 6, 10) of the gripper at nodes: `ComparedReadings`.

    Further values are the times (M,) of the nodes and the begin of the recording, s.
    """

    sensor: WrenchSensor
    blocks: Blocks
    seconds: Array
    begin: float
    regressors: Array

    @property
    def values(self) -> Array:
        """Measured means (B, 6)."""
        return self.blocks.means

    @property
    def period(self) -> float:
        """Duration of a block, s."""
        return BLOCK_NS / NS_PER_S

    def predicted(self, motion: SimulatedMotion, free: Values) -> Array:
        """Return the means (B, 6) of predicted wrenches; the rate of the load shows the delay."""
        load = loads(*motion, self.sensor.mount)
        of_gripper = self.regressors @ np.array(self.sensor.gripper)
        shown = (1.0 + free['wrench_gain']) * load + of_gripper + free['wrench_bias'] - (
            free['wrench_delay'] * np.gradient(load + of_gripper, self.seconds, axis=0))
        return self.blocks.averaged(shown + self.regressors @ free.get(
            'gripper', np.zeros(INERTIAL_NUMBERS)))

    def whitened(self, J: Array, r: Array) -> tuple[Array, Array]:
        """Return derivatives (B, 6, q) and residuals (B, 6), see `whitened`."""
        return whitened(J, r, self.blocks.seconds - self.begin, self.sensor, self.blocks.size)


def _cubic(nodes_ns: Stamps, stamps_ns: Stamps) -> tuple[Places, Array]:
    """Return the places (4, n) and weights (4, n) of nodes in cubic interpolation (Lagrange)."""
    after = np.searchsorted(nodes_ns, stamps_ns, side='right')
    places = np.clip(after - 2, 0, len(nodes_ns) - 4) + np.arange(4)[:, None]
    t = (nodes_ns[places] - stamps_ns) / NS_PER_S
    return places, np.array([np.prod([t[k] / (t[k] - t[j]) for k in range(4) if k != j], axis=0)
                             for j in range(4)])


def of_gripper(tool: Array, seconds: Array, gravity: Array, mount: Mount) -> Array:
    """Return the regressors (M, 6, 10) of a gripper along states of the tool (M, 13)."""
    return gripper_regressors(tool, np.gradient(tool[:, 7:], seconds, axis=0), gravity, mount)


def information_on_gripper(
    tool: Trajectory, felt: Wrenches, gravity: Array
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
