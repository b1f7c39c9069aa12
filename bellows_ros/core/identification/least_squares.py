"""
The thesis' method: weighted linear least squares on filtered motions (4.66-4.81).

The wrench c that the package's motion requires is linear in the parameters x of K and P, L x = c
(4.66-4.68). The weight W of (4.66) depends on the wrenches of all recordings. The sums over a
recording are therefore products of the rows [L c] for each pair of components of the wrench, which
are weighted later. Noise of the filtered motions is neither compensated nor part of the standard
errors: in motion capture it biases K by less than 0.5 % and P by less than 5 %; output error has
no such bias.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply, log_so3
from bellows_ros.core.identification.result import (
    Fit,
    inverted,
    MAJORITY,
    MAX_CONDITION,
    MAX_RELATIVE_ERROR,
    not_identifiable,
    with_unidentifiable,
)
from bellows_ros.core.model.cup_package import gravity_vector, Package, regressor
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.preparation import with_tool_earlier
from bellows_ros.core.recording.recording import PoseNoise, Recording
from bellows_ros.core.signals.savgol import BLOCK
from bellows_ros.core.signals.trajectory import Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError, UndeterminedError
import numpy as np
from numpy.typing import ArrayLike

DELAYS = np.arange(-25, 26) * 0.01
"""Delays that are compared, s: more than a swinging package lags behind the tool, in steps shorter
than a swing."""

MIN_CONTRAST = 0.2
"""Smallest fall of the mean logarithm of the unexplained wrench at the likeliest delay, relative
to the median of all; by noise alone it is below 0.05."""


class LipMotion(NamedTuple):
    """
    Motion of the lip in the tool, and the required wrench, at the valid samples.

    E_o_S (N, 3) in m, E_R_S (N, 3, 3), S_v_ES (N, 6) in m/s and rad/s, and c (N, 6) of (4.68) in N
    and N m.
    """

    position: Array
    rotation: Array
    twist: Array
    wrench: Array

    def equations(self, cup_length: float, structure: Structure) -> Iterator[Array]:
        """Yield rows [L c] (N, 6, p + 1) of (4.67), (4.68) in blocks, for a cup length l0 in m."""
        for start in range(0, max(len(self.wrench), 1), BLOCK):
            o, R, v, c = (values[start:start + BLOCK] for values in self)
            yield np.dstack([regressor(cup_length, structure.model_basis, o, R, v), c])


@dataclass(frozen=True, eq=False)
class FilteredSamples:
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
        tool, package = (body.select(self.valid) for body in (self.tool, self.package))
        return LipMotion(*lip_relative(tool, package, self.payload.com),
                         needed_wrench(self.payload, package, self.gravity))

    @property
    def windows(self) -> float:
        """Number of filter windows in the valid samples, which have independent residuals."""
        rate_hz = uniform_rate_hz(self.package.stamps_ns)
        return self.count / max(self.window * rate_hz, 1.0)


def samples_of(recording: Recording) -> FilteredSamples:
    """Return the filtered motions of a recording."""
    return recording.cached('filtered samples', lambda: FilteredSamples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.filters[1].weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns)))


def likely_delay(recording: Recording) -> float | None:
    """
    Return the delay (s) of the tool's stamps with which a linear cup explains most of the motion.

    The wrench of the package is regressed on displacement and twist of the lip. The result is
    None if no delay is distinguished, as with standstills alone.
    """
    unexplained = np.zeros(len(DELAYS))
    for number, delay in enumerate(DELAYS.tolist()):
        with suppress(BellowsError):  # nothing in common at this delay
            lip = samples_of(with_tool_earlier(recording, delay)).lip
            A = np.hstack([lip.position, log_so3(lip.rotation), lip.twist,
                           np.ones((len(lip.wrench), 1))])
            left = lip.wrench - A @ np.linalg.lstsq(A, lip.wrench, rcond=None)[0]
            unexplained[number] = np.mean(np.log(left.var(axis=0) / lip.wrench.var(axis=0)))
    best = int(np.argmin(unexplained))
    if not unexplained[best] < np.median(unexplained) - MIN_CONTRAST:
        return None
    return float(DELAYS[best])


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


def envelope(
    tool: Trajectory, package: Trajectory, payload: Package, cup_length: float
) -> Envelope:
    """
    Return the validity range of a motion.

    Parameters
    ----------
    tool, package : Trajectory
        Poses of E and B with body twists, at the same stamps; invalid samples are omitted.
    payload : Package
        Mass and centre of mass of the package.
    cup_length : float
        Cup length l0, m.

    Raises
    ------
    BellowsError
        If there are no valid samples.

    """
    valid, load = tool.valid & package.valid, (payload.mass, 0.0)
    if not valid.any():
        raise BellowsError('The recording has no valid samples, hence no validity range.')
    position, rotation, twist = lip_relative(
        tool.select(valid), package.select(valid), payload.com)
    deflection = np.hstack([position + [0.0, 0.0, cup_length], log_so3(rotation)])
    rates = np.abs(twist).max(axis=0)
    return Envelope(np.hstack([deflection.min(axis=0), -rates, load]),
                    np.hstack([deflection.max(axis=0), rates, load]))


MOMENT_LEVER = 0.01
"""Lever with which moments are compared with forces, m: of the order of a cup's radius."""


class Statistics(NamedTuple):
    """
    Sufficient statistics of one recording for any weight.

    Parameters
    ----------
    structure : Structure
        Structure of K and P.
    used, rejected : int
        Numbers of valid and of invalid samples.
    windows : float
        Number of filter windows in the valid samples, which have independent residuals.
    wrench : ndarray (6,)
        Sum of the required wrenches, N and N m.
    products : ndarray (6, q, 6, q)
        Sums of the products of the rows [L c] (6, q) of all samples, q = p + 1.
    noise : ndarray (2, 6)
        Sums of the variances of the noise in the lip's displacement (m, rad) and twist.

    """

    structure: Structure
    used: int
    rejected: int
    windows: float
    wrench: Array
    products: Array
    noise: Array


def statistics(
    samples: FilteredSamples, cup_length: float, structure: Structure,
    noise: Sequence[tuple[PoseNoise, Array]] = (),
) -> Statistics:
    """
    Return the statistics of samples for a structure of K and P and a cup length l0, m.

    Noise of poses and weights of the filter are of the tool, then of the package.
    """
    size = 2 * structure.size + 1
    products = np.zeros((6 * size, 6 * size))
    for rows in samples.lip.equations(cup_length, structure):
        flat = rows.reshape(-1, 6 * size)
        products += flat.T @ flat
    return Statistics(
        structure, samples.count, len(samples.tool) - samples.count,
        samples.windows, samples.lip.wrench.sum(axis=0),
        products.reshape(6, size, 6, size), samples.count * (
            lip_noise(noise, samples.payload, cup_length) if noise else np.zeros((2, 6))))


def lip_noise(
    noise: Sequence[tuple[PoseNoise, Array]], payload: Package, cup_length: float
) -> Array:
    """Return the variances (2, 6) of the noise in displacement and twist of the lip."""
    variances = np.zeros((2, 6))
    levers = cup_length, float(np.linalg.norm(payload.com))  # of tool and package
    for (sizes, weights), lever in zip(noise, levers, strict=True):
        rotation = sizes.rotation**2
        position = sizes.position**2 + lever**2 * rotation
        gains = np.sum(weights[:2]**2, axis=1)  # of the filter, for poses and twists
        variances += np.outer(gains, np.repeat([position, rotation], 3))
    return variances


def _energy_of_noise(parts: Sequence[Statistics], W: Array) -> Array:
    """Return the information (2 p,) on K and P that noise alone would give, by weights W."""
    basis = np.array(parts[0].structure.model_basis)
    of_displacement, of_twist = np.sum([each.noise for each in parts], axis=0)
    return np.concatenate([np.einsum('aji,jk,aki,i->a', basis, W, basis, variances)
                           for variances in (of_displacement, of_twist)])


def least_squares(parts: Sequence[Statistics]) -> Fit:
    """
    Fit K and P so that the cup's wrench is the wrench required by the motion (4.66, 4.74).

    Parameters
    ----------
    parts : sequence of Statistics
        Statistics of recordings of one cup, all with one structure and cup length.

    Returns
    -------
    Fit
        K and P with standard errors by residuals of any covariance, constant within a filter
        window and independent between windows; infinite for unidentifiable parameters. An
        indefinite result is returned with a warning.

    Raises
    ------
    BellowsError
        If there are too few samples, or no parameter is identifiable.

    """
    structure, used = parts[0].structure, sum(each.used for each in parts)
    if 6 * used <= 2 * structure.size:
        raise UndeterminedError(
            f'{used} valid samples are too few for {2 * structure.size} parameters. Record '
            'longer, or check in the report why samples were rejected.')
    products = np.sum([each.products for each in parts], axis=0)
    mean = np.sum([each.wrench for each in parts], axis=0) / used
    scatter = products[:, -1, :, -1] - used * np.outer(mean, mean)
    W = np.asarray(np.linalg.inv(regularised(structure.covariance(used, mean, scatter))))
    normal = np.einsum('ij,ipjq->pq', W, products)
    inverse, is_separable, condition = inverted(
        normal[:-1, :-1], _sizes_of_columns(normal[:-1, :-1], structure))
    if not is_separable.any():
        raise UndeterminedError(
            f'{", ".join(structure.labels[:4])} and all others are not identifiable from '
            'these recordings: nothing moves. Excite all six directions.')
    x = inverse @ normal[:-1, -1]
    r = np.append(x, -1.0)  # [L c] r is the residual wrench
    values, axes = np.linalg.eigh(np.einsum('p,ipjq,q->ij', r, products, r))
    squares = axes * np.maximum(values, 0.0) @ axes.T  # (6, 6) of residuals, without rounding
    meat = np.einsum('ij,ipjq->pq', W @ squares @ W, products)[:-1, :-1] / used
    freedom = 6.0 * sum(each.windows for each in parts) - len(x)
    inflation = 6.0 * used / freedom if freedom > 0.0 else np.inf
    covariance = inverse @ meat @ inverse * inflation  # of residuals with any covariance
    is_above_noise = _energy_of_noise(parts, W) * np.diag(inverse) < MAJORITY
    sizes = structure.sizes(*structure.matrices(x))
    is_accurate = np.sqrt(np.diag(covariance)) <= MAX_RELATIVE_ERROR * sizes
    is_identifiable = is_separable & is_above_noise & is_accurate
    return Fit(
        method='least_squares',
        structure=structure.name,
        parameters=x,
        covariance=with_unidentifiable(covariance, ~is_identifiable),
        samples_used=used,
        samples_rejected=sum(each.rejected for each in parts),
        condition_number=condition,
        residual_rms=np.sqrt(np.diag(squares) / used),
        notes=_unidentifiable(structure, is_identifiable))


def _unidentifiable(structure: Structure, is_identifiable: Mask) -> tuple[Finding, ...]:
    """Return the findings on unidentifiable parameters (2 n,); on all of them at once a single."""
    if not is_identifiable.any():
        return (Finding('not_identifiable', Level.WARN, {
            'label': 'Each entry of K and P', 'why': 'the recordings are too short',
            'how': 'Record longer'}),)
    unknown = [structure.labels[i] for i in np.flatnonzero(~is_identifiable)]
    return tuple(not_identifiable(
        label, structure, 'its standard error is half of itself, or larger') for label in unknown)


def regularised(covariance: Array) -> Array:
    """Return a covariance (6, 6) of wrenches, regularised in directions without a wrench."""
    force, moment = np.diag(covariance).reshape(2, 3).mean(axis=1)
    scale = np.repeat([max(force, moment), max(moment, MOMENT_LEVER**2 * force)], 3)
    if not scale[0] > 0.0:
        return np.eye(6)
    if np.linalg.eigvalsh(covariance / np.sqrt(np.outer(scale, scale)))[0] > MAX_CONDITION**-2:
        return covariance
    return np.asarray(covariance + MAX_CONDITION**-2 * np.diag(scale))


def _sizes_of_columns(normal: Array, structure: Structure) -> Array:
    """Return the sizes (p,) of columns, infinite without effect among columns of its kind."""
    sizes = np.sqrt(np.diag(normal))
    angular = [(row > 2) + (column > 2) for row, column in structure.leads]
    kinds = np.array([*angular, *(3 + kind for kind in angular)])
    largest = np.array([sizes[kinds == kind].max() for kind in kinds])
    return np.where(sizes > largest / MAX_CONDITION, sizes, np.inf)
