"""
Kalman filter and smoother of the package's small motions about a simulation.

The path of the tool that drives the simulation is without a change w, m and rad in body axes of
the tool: the noise of its poses behind the filter of the path. The package then moves by small
displacements d in its body axes, which are those of a linear, time-varying model,

    d'' = (A_d - ad(a)) d + (A_r - ad(v)) d' + B_w w + B_r w',

with twist v and acceleration a of the simulated package, and derivatives A and B of its
acceleration by displacements and their rates, of package and tool. The numbers of a sensor are
M d + s with its derivatives M by the pose of the package, and its noise s. The states of the
filter are d, d', and the last values of w and s, two autoregressive processes.

The innovations are the whitened numbers: they have the likelihood of all numbers together. The
smoother gives the likeliest w and first state (Bryson and Frazier 1963). A bin without poses is a
step without an update.
"""

import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.identification.result import CHANCE
from bellows_ros.core.identification.segments import moved, noise_spectrum, Segment
from bellows_ros.core.model import simulation
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

MAX_STEP_NS = 12_500_001
"""Largest time between steps, ns: three poses at 240 Hz, with their stamps rounded to 1 ns."""

PATH_ORDER = 4
"""Order of the autoregressive process of a path's noise: with 2 or 3 chi² of exactly modelled
recordings is 1.13 to 1.17, with 4 to 8 it is 1.02."""

SENSOR_ORDER = 2
"""Order of the process of a sensor's noise: that of means of noise of first order is of the first
order with a moving average."""

ROUNDING = 1e-6
"""Share of white noise in that of a path, whose spectrum is nearly zero above its band."""

FREQUENCIES = 4096
"""Number of frequencies at which the noise of a path is integrated."""

DIFFERENCE = 1e-5
"""Step of differences of the acceleration, m, rad, m/s and rad/s."""

TERMS = 12
"""Number of terms of an exponential: the first left out is 1e-13 for a norm of 1 / 2."""

MOTION = slice(0, 12)
NOW = slice(12, 18)
PATH = slice(12, 12 + 6 * PATH_ORDER)
SEEN = slice(PATH.stop, PATH.stop + 6)
SENSOR = slice(PATH.stop, PATH.stop + 6 * SENSOR_ORDER)
STATES = SENSOR.stop
"""Parts of the state: d and d'; w at a step, and all its values; s alike; number of states."""


class Steps(NamedTuple):
    """
    Steps of the filter.

    Stamps (N,), ns; time between them but for the first, s; place (K,) of the step of each bin.
    """

    stamps_ns: Stamps
    period: float
    places: Places


def steps_of(begin_ns: int, first_ns: int, bin_ns: int, bins: Places) -> Steps:
    """Return steps from a begin through bins (K,), of which bin 0 is at a first stamp."""
    parts = -(-bin_ns // MAX_STEP_NS)
    step = bin_ns / parts
    first = first_ns + bin_ns * int(bins[0])
    before = max(math.ceil((first - begin_ns) / step), 0)
    count = before + parts * int(bins[-1] - bins[0]) + 1
    stamps = first + np.rint(step * (np.arange(count) - before)).astype(np.int64)
    stamps[0] = begin_ns
    if count > 1 and stamps[1] - begin_ns < 0.1 * step:  # the first bin is at the begin
        stamps, before = np.append(begin_ns, stamps[2:]), before - 1
    return Steps(stamps, step / NS_PER_S, before + parts * (bins - bins[0]))


class SmallMotion(NamedTuple):
    """
    Small motions x = (d, d') between N steps: x[k+1] = F[k] x[k] + B0[k] w[k] + B1[k] w[k+1].

    Transitions (N-1, 12, 12), and inputs (N-1, 12, 6) by the path's change at both steps.
    """

    transition: Array
    before: Array
    after: Array


class Process(NamedTuple):
    """
    Autoregressive process in six axes at steps.

    Weights (p, 6) of the last values, variance (6,) of what is new, and covariance (6, p, p).
    """

    weights: Array
    variance: Array
    covariance: Array

    @classmethod
    def of(cls, correlation: Array) -> 'Process':
        """Return the process with given covariances (p + 1, 6) of lags (Yule-Walker equations)."""
        order = len(correlation) - 1
        lag = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
        covariance = np.moveaxis(correlation[lag], 2, 0)
        weights = np.asarray(np.linalg.solve(
            covariance, correlation[1:].T[..., None])[..., 0].T, np.float64)
        return cls(weights, correlation[0] - np.sum(weights * correlation[1:], axis=0), covariance)

    @property
    def transition(self) -> Array:
        """Transition (6 p, 6 p) of the last values, the newest first."""
        size = 6 * len(self.weights)
        out = np.eye(size, k=-6)
        out[:6] = self.to_next
        return out

    @property
    def to_next(self) -> Array:
        """Weights (6, 6 p) of the last values in the next one."""
        return np.hstack([np.diag(each) for each in self.weights])

    @property
    def stationary(self) -> Array:
        """Covariance (6 p, 6 p) of the last values."""
        order = len(self.weights)
        out = np.zeros((order, 6, order, 6))
        out[:, range(6), :, range(6)] = self.covariance
        return out.reshape(6 * order, 6 * order)


class Sensor(NamedTuple):
    """
    Noise of a sensor with numbers at some steps.

    Places (K,) of the steps, and times (K,) after them, s; derivatives (K, 6, 6) by the pose of
    the package; noise of numbers of whole bins, and white variance (K, 6) of bins with fewer
    poses beyond.
    """

    places: Places
    after: Array
    by_pose: Array
    noise: Process
    more: Array

    @property
    def variance(self) -> Array:
        """Variance (6,) of whole bins."""
        return self.noise.covariance[:, 0, 0]

    def by_motion(self, bin_: int) -> Array:
        """Return the derivative (6, 12) of a bin's numbers by d and d'."""
        return np.hstack([self.by_pose[bin_], self.after[bin_] * self.by_pose[bin_]])


class Innovations(NamedTuple):
    """
    Whitened numbers (K, 6, c), and what the smoother needs.

    Sum of the logarithms of the variances, and a likelier variance (6,) of the sensor; inverse
    roots (K, 6, 6) of the innovations' covariances, with their gains (K, n, 6); predictions (N, 6)
    of the path's change, with their covariances (N, 6, n) with all states.
    """

    white: Array
    logs: float
    variance: Array
    roots: Array
    gains: Array
    change: Array
    covariance: Array


def lie_bracket(twists: Array) -> Array:
    """Return the matrices ad (N, 6, 6) of twists (N, 6)."""
    out = np.zeros((len(twists), 6, 6))
    for column, axis in enumerate(np.eye(3)):
        turned = np.cross(twists[:, 3:], axis)
        out[:, :3, column], out[:, 3:, 3 + column] = turned, turned
        out[:, :3, 3 + column] = np.cross(twists[:, :3], axis)
    return out


def small_motion(model: ModelTuple, tool: Array, body: Array, durations: Array) -> SmallMotion:
    """
    Return small motions about states (N-1, 13) of tool and body amid steps of durations (s).

    The path's change is linear in a step.
    """
    by_tool, by_body = np.empty((2, len(tool), 6, 12))
    for place, shift in enumerate(DIFFERENCE * np.eye(12)):
        by_tool[:, :, place] = 0.5 / DIFFERENCE * (
            simulation.accelerations(model, moved(tool, shift), body)
            - simulation.accelerations(model, moved(tool, -shift), body))
        by_body[:, :, place] = 0.5 / DIFFERENCE * (
            simulation.accelerations(model, tool, moved(body, shift))
            - simulation.accelerations(model, tool, moved(body, -shift)))
    A = np.zeros((len(tool), 12, 12))
    A[:, :6, 6:] = np.eye(6)
    A[:, 6:, :6] = by_body[:, :, :6] - lie_bracket(simulation.accelerations(model, tool, body))
    A[:, 6:, 6:] = by_body[:, :, 6:] - lie_bracket(body[:, 7:13])
    by_change, by_rate = np.zeros((2, len(tool), 12, 6))
    by_change[:, 6:], by_rate[:, 6:] = by_tool[:, :, :6], by_tool[:, :, 6:]
    T = durations[:, None, None]
    transition, mean, ramp = exponentials(A * T)
    after = T * ramp @ by_change + mean @ by_rate
    return SmallMotion(transition, T * mean @ by_change - after, after)


def exponentials(Z: Array) -> tuple[Array, Array, Array]:
    """Return exp(Z), (exp(Z) - 1) / Z and (exp(Z) - 1 - Z) / Z² of matrices (N, n, n)."""
    norm = float(np.abs(Z).sum(axis=2).max(initial=1e-9))
    halvings = max(int(np.ceil(np.log2(norm))) + 1, 0)
    Z, one = Z / 2.0**halvings, np.eye(Z.shape[-1])
    ramp = np.broadcast_to(one, Z.shape)
    for k in range(TERMS, 2, -1):  # Horner's form of twice the sum of Z^j / (j + 2)!
        ramp = one + Z @ ramp / k
    ramp = 0.5 * ramp
    mean = one + Z @ ramp
    whole = one + Z @ mean
    for _ in range(halvings):
        ramp = 0.25 * (whole @ ramp + mean + ramp)
        mean = 0.5 * (whole @ mean + mean)
        whole = whole @ whole
    return whole, mean, ramp


def path_noise(segment: Segment, step: float) -> Process:
    """Return the noise of the path of a segment at steps (s)."""
    period, weights = segment.tool_period, segment.weights[0]
    frequency = np.asarray(
        (np.arange(FREQUENCIES) + 0.5) / (2.0 * FREQUENCIES * period), np.float64)
    lags = np.arange(len(weights)) - len(weights) // 2
    gain = np.abs(weights @ np.exp(2j * np.pi * period * np.outer(lags, frequency))) ** 2
    density = gain[:, None] * noise_spectrum(segment.tool_noise, period, frequency)
    waves = np.cos(2.0 * np.pi * step * np.outer(np.arange(PATH_ORDER + 1), frequency))
    correlation = waves @ density / (FREQUENCIES * period)
    correlation[0] *= 1.0 + ROUNDING
    return Process.of(correlation)


def noise_of_means(
    std: Array, kept: Array | float, poses: int, per_step: float
) -> Process:
    """
    Return the noise of means of poses at steps, which are a number of periods of the poses.

    The noise of poses has standard deviations (6,), and correlations (6,) from pose to pose.
    """
    between = np.subtract.outer(np.arange(poses), np.arange(poses)).ravel()
    lags = np.abs(per_step * np.arange(SENSOR_ORDER + 1)[:, None] + between)
    return Process.of(std**2 * np.mean(np.power.outer(np.broadcast_to(kept, 6), lags), axis=2).T)


def response(motion: SmallMotion, first: Array, change: Array) -> Array:
    """Return d and d' (N, 12) by the first ones (12,) and a change (N, 6) of the path."""
    forced = motion.before @ change[:-1, :, None] + motion.after @ change[1:, :, None]
    out = np.empty((len(change), 12))
    out[0] = first
    for k in range(len(change) - 1):
        out[k + 1] = motion.transition[k] @ out[k] + forced[k, :, 0]
    return out


def _transition(motion: SmallMotion, noise: Process, sensor: Sensor, k: int) -> Array:
    """Return the transition (n, n) of all states from step k."""
    F = np.zeros((STATES, STATES))
    F[MOTION, MOTION] = motion.transition[k]
    F[MOTION, PATH] = motion.after[k] @ noise.to_next
    F[MOTION, NOW] += motion.before[k]
    F[PATH, PATH] = noise.transition
    F[SENSOR, SENSOR] = sensor.noise.transition
    return F


def filtered(
    motion: SmallMotion, noise: Process, sensor: Sensor, first: Array, numbers: Array
) -> Innovations:
    """
    Return the whitened columns of numbers (K, 6, c), without a mean at first.

    The first covariance (12, 12) is that of d and d'. The first column has the numbers, others
    have derivatives.
    """
    count, white, logs = len(motion.transition) + 1, np.empty_like(numbers), 0.0
    score, information = np.zeros((2, 6))
    roots, gains = np.empty((len(numbers), 6, 6)), np.empty((len(numbers), STATES, 6))
    change, covariance = np.empty((count, 6)), np.empty((count, 6, STATES))
    x, P = np.zeros((STATES, numbers.shape[2])), _first_covariance(noise, sensor, first)
    bins = _bins(sensor, count)
    for k in range(count):
        if k > 0:
            F = _transition(motion, noise, sensor, k - 1)
            x, P = F @ x, F @ P @ F.T
            enters = np.vstack([motion.after[k - 1], np.eye(6)])
            P[:18, :18] += (enters * noise.variance) @ enters.T
            P[SEEN, SEEN] += np.diag(sensor.noise.variance)
        change[k], covariance[k] = x[NOW, 0], P[NOW]
        if bins[k] < 0:
            continue
        M = sensor.by_motion(bins[k])
        with_numbers = P[:, MOTION] @ M.T + P[:, SEEN]
        S = M @ with_numbers[MOTION] + with_numbers[SEEN] + np.diag(sensor.more[bins[k]])
        e = numbers[bins[k]] - M @ x[MOTION] - x[SEEN]
        root = np.linalg.inv(np.linalg.cholesky(S))
        gain = with_numbers @ root.T
        white[bins[k]], roots[bins[k]], gains[bins[k]] = root @ e, root, gain
        x, P = x + gain @ (root @ e), P - gain @ gain.T
        logs -= 2.0 * float(np.sum(np.log(np.diag(root))))
        expected = np.diag(S)
        score += (np.minimum(e[:, 0] ** 2, CHANCE**2 * expected) - expected) / expected**2
        information += expected**-2
    likelier = sensor.variance + score / information
    return Innovations(white, logs, likelier, roots, gains, change, covariance)


def _first_covariance(noise: Process, sensor: Sensor, first: Array) -> Array:
    """Return the covariance (n, n) of the first states."""
    P = np.zeros((STATES, STATES))
    P[MOTION, MOTION] = first
    P[PATH, PATH], P[SENSOR, SENSOR] = noise.stationary, sensor.noise.stationary
    return P


def _bins(sensor: Sensor, count: int) -> Places:
    """Return the index of the numbers at each step (N,), -1 without."""
    bins = np.full(count, -1)
    bins[sensor.places] = np.arange(len(sensor.places))
    return bins


def smoothed(
    motion: SmallMotion, noise: Process, sensor: Sensor, first: Array, found: Innovations,
    innovations: Array,
) -> tuple[Array, Array]:
    """Return the likeliest first d and d' (12,), and change (N, 6) of the path."""
    count = len(found.change)
    adjoint, change, bins = np.zeros(STATES), np.empty((count, 6)), _bins(sensor, count)
    for k in range(count - 1, -1, -1):
        if bins[k] >= 0:
            root, gain = found.roots[bins[k]], found.gains[bins[k]]
            of_numbers = root.T @ (innovations[bins[k]] + gain.T @ adjoint)
            adjoint[MOTION] -= sensor.by_motion(bins[k]).T @ of_numbers
            adjoint[SEEN] -= of_numbers
        change[k] = found.change[k] - found.covariance[k] @ adjoint
        if k > 0:
            adjoint = _transition(motion, noise, sensor, k - 1).T @ adjoint
    return -first @ adjoint[MOTION], change
