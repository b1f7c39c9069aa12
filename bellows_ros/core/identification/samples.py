"""
The filtered motions of a recording, as inputs of the identification.

The lip's motion, the required wrench c, and the equations L x = c, with x the parameters of K and
P (4.66-4.68).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.model.cup_package import gravity_vector, Package, regressor
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import interpolated, Spectrum, spectrum
from bellows_ros.core.signals.savgol import BLOCK
from bellows_ros.core.signals.trajectory import Trajectory, uniform_rate_hz
import numpy as np
from numpy.typing import ArrayLike

MAX_STORED = 50_000
"""Largest number of samples of a recording whose lip motion is stored for reuse."""

MOMENT_LEVER = 0.01
"""Lever with which moments are compared with forces, m."""

MIN_RELATIVE_VARIANCE, ADDED_VARIANCE = 1e-10, 1e-8
"""Relative variance below which a component of the wrench is zero, and its replacement."""


@dataclass(frozen=True, eq=False)
class LipMotion:
    """
    Motion of the lip in the tool, and the required wrench, at the valid samples.

    Parameters
    ----------
    index : ndarray (N,)
        Indices of the valid samples in the recording.
    stamps_ns : ndarray (N,)
        Stamps, ns.
    position, rotation, twist : ndarray (N, 3), (N, 3, 3), (N, 6)
        E_o_S (m), E_R_S and S_v_ES (m/s, rad/s).
    wrench : ndarray (N, 6)
        c of (4.68), N and N m.

    """

    index: Stamps
    stamps_ns: Stamps
    position: Array
    rotation: Array
    twist: Array
    wrench: Array

    def displacement(self, cup_length: float) -> Array:
        """Return the displacement of the lip from nominal (N, 6): E_o_S + l0 z (m), rotation."""
        moved = np.empty((len(self.position), 6))
        moved[:, :3] = self.position + [0.0, 0.0, cup_length]
        for start in range(0, len(moved), BLOCK):
            block = slice(start, start + BLOCK)
            moved[block, 3:] = log_so3(self.rotation[block])
        return moved

    def equations(self, cup_length: float, structure: Structure) -> Iterator[Array]:
        """
        Yield rows [L c] (N, 6, p + 1) of (4.67), (4.68) in blocks.

        Parameters
        ----------
        cup_length : float
            Cup length l0, m.
        structure : Structure
            Structure of K and P.

        """
        for start in range(0, max(len(self.index), 1), BLOCK):
            block = slice(start, min(start + BLOCK, len(self.index)))
            L = regressor(
                cup_length, structure.model_basis, self.position[block], self.rotation[block],
                self.twist[block])
            yield np.dstack([L, self.wrench[block]])


@dataclass(frozen=True, eq=False)
class Samples:
    """
    Filtered motions of tool and package at the same stamps.

    Parameters
    ----------
    tool : Trajectory
        N poses of E in the world with body twists.
    package : Trajectory
        N poses of B with body twists and accelerations, at the same stamps.
    payload : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float
        m/s^2 along -z of the world.
    window : float
        Duration of the package's filter window, the correlation length of residuals, s.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: float
    window: float

    @property
    def valid(self) -> Mask:
        """Mask (N,) of the samples with usable motion of both bodies."""
        return self.tool.valid & self.package.valid

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.valid))

    @cached_property
    def lip(self) -> LipMotion:
        """The motion of the lip, the basis of the equations."""
        index = np.flatnonzero(self.valid)
        position, rotation, twist, wrench = (
            np.empty((len(index), *shape)) for shape in ((3,), (3, 3), (6,), (6,)))
        for number, block in enumerate(self.blocks()):
            part = slice(number * BLOCK, (number + 1) * BLOCK)
            position[part], rotation[part], twist[part] = lip_relative(
                block.tool, block.package, self.payload.com)
            wrench[part] = needed_wrench(self.payload, block.package, self.gravity)
        return LipMotion(index, self.tool.stamps_ns[index],
                         position, rotation, twist, wrench)

    def spectrum_of(self, values: Array) -> Spectrum:
        """Return the spectrum of numbers (N, 6) at the valid samples; others are interpolated."""
        return spectrum(self._interpolated(values), uniform_rate_hz(self.package.stamps_ns))

    def _interpolated(self, values: Array) -> Array:
        """Return numbers (N, 6) at all samples from those at the valid ones."""
        every = np.full((len(self.tool), 6), np.nan)
        every[self.valid] = values
        return interpolated(every)

    def select(self, index: slice | Mask | Stamps) -> 'Samples':
        """Return the samples selected by a slice, a mask or increasing indices."""
        return replace(
            self, tool=self.tool.select(index), package=self.package.select(index))

    def blocks(self) -> 'Iterator[Samples]':
        """Yield the valid samples in blocks, in the order of time."""
        valid = np.flatnonzero(self.valid)
        for start in range(0, len(valid), BLOCK):
            yield self.select(valid[start:start + BLOCK])

    @property
    def window_samples(self) -> float:
        """Number of samples in a window of the filter."""
        return max(self.window * uniform_rate_hz(self.package.stamps_ns), 1.0)


def samples_of(recording: Recording) -> Samples:
    """Return the filtered motions of a recording."""
    samples = recording.cached('filtered samples', lambda: Samples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.filters[1].weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns)))
    return samples if len(samples.tool) <= MAX_STORED else replace(samples)


def lip_relative(
    tool: Trajectory, package: Trajectory, com: ArrayLike
) -> tuple[Array, Array, Array]:
    """
    Return E_o_S (N, 3), E_R_S (N, 3, 3) and the body twist S_v_ES (N, 6) of the lip in the tool.

    This is `kernels.lip_relative_to_tool` for arrays: S_v_ES = X(S_H_B) B_v_AB - X(E_H_S)^-1
    E_v_AE.
    """
    assert tool.twist is not None and package.twist is not None  # is filtered
    com = np.asarray(com, dtype=float)
    R_E_A = np.swapaxes(tool.rotation, 1, 2)
    R_E_S = R_E_A @ package.rotation
    o_E_S = apply(R_E_A, package.position - apply(package.rotation, com) - tool.position)
    v_B, w_B = package.twist[:, :3], package.twist[:, 3:]
    v_E, w_E = tool.twist[:, :3], tool.twist[:, 3:]
    R_S_E = np.swapaxes(R_E_S, 1, 2)
    linear = v_B + np.cross(com, w_B) - apply(R_S_E, v_E + np.cross(w_E, o_E_S))
    return o_E_S, R_E_S, np.hstack([linear, w_B - apply(R_S_E, w_E)])


def needed_wrench(package: Package, motion: Trajectory, gravity: ArrayLike) -> Array:
    """
    Return c (N, 6), the cup's wrench at the lip required by the package's motion (4.68).

    c = X(S_H_B)^-T (M dv + v x* M v - f_g) in lip axes; gravity is its magnitude along -z of the
    world, or its vector (3,) there, m/s^2.
    """
    assert motion.twist is not None and motion.acceleration is not None  # is filtered
    v, w = motion.twist[:, :3], motion.twist[:, 3:]
    dv, dw = motion.acceleration[:, :3], motion.acceleration[:, 3:]
    g_B = apply(np.swapaxes(motion.rotation, 1, 2), gravity_vector(gravity))
    force = package.mass * (dv + np.cross(w, v) - g_B)
    moment = dw @ package.inertia + np.cross(w, w @ package.inertia)
    return np.hstack([force, moment + np.cross(package.com, force)])


def sizes(displacement: Array) -> Array:
    """Return sizes of displacements (N, 6), with x and y combined as for a round cup."""
    x, y, z, rx, ry, rz = displacement.T
    radial, bent = np.hypot(x, y), np.hypot(rx, ry)
    return np.asarray(np.abs(np.column_stack([radial, radial, z, bent, bent, rz])))


@dataclass(frozen=True, eq=False)
class Moments:
    """
    First and second moments of six-vectors, such as wrenches (N and N m).

    Parameters
    ----------
    count : int
        Number of vectors.
    mean : ndarray (6,)
        Mean of the vectors.
    scatter : ndarray (6, 6)
        Sum of the products of the deviations from the mean.

    """

    count: int
    mean: Array
    scatter: Array

    @classmethod
    def of(cls, vectors: Array) -> 'Moments':
        """Return the moments of six-vectors (N, 6)."""
        mean = vectors.sum(axis=0) / max(len(vectors), 1)
        deviation = vectors - mean
        return cls(len(vectors), mean, deviation.T @ deviation)

    @property
    def std(self) -> Array:
        """Standard deviations (6,), NaN without samples."""
        return np.sqrt(np.diag(self.scatter) / (self.count or np.nan))

    def covariance(self, structure: Structure) -> Array:
        """Return Q (6, 6) of wrenches in the form of a structure (4.69, 4.80)."""
        return structure.covariance(self.count, self.mean, self.scatter)


def joined(parts: Iterable[Moments]) -> Moments:
    """Return the moments of all parts, from deviations rather than raw squares."""
    parts = list(parts)
    counts, means = np.array([part.count for part in parts]), np.array([p.mean for p in parts])
    mean = counts @ means / max(counts.sum(), 1)
    apart = means - mean
    return Moments(int(counts.sum()), mean, sum((part.scatter for part in parts), np.zeros((6, 6)))
                   + (counts * apart.T) @ apart)


def regularised(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches, regularised in directions without a wrench."""
    force, moment = (float(np.mean(np.diag(covariance)[part]))
                     for part in (slice(0, 3), slice(3, 6)))
    scale = np.repeat([max(force, moment), max(moment, MOMENT_LEVER**2 * force)], 3)
    if not scale[0] > 0.0:
        return np.eye(6)
    unit = np.sqrt(np.outer(scale, scale))
    if np.linalg.eigvalsh(covariance / unit)[0] > MIN_RELATIVE_VARIANCE:
        return covariance
    return np.asarray(covariance + ADDED_VARIANCE * np.diag(scale))
