"""
Standstills of tool and package in a recording.

At rest, damping and inertia vanish: the package hangs in balance of spring and gravity (3.9), and
the mean of a standstill has little noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import exp_so3, log_so3, mean_rotation
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.structure import RELAXATION_TIMES
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.recording import PoseNoise, PrepareSettings, Recording
from bellows_ros.core.signals.residuals import relative_coordinates
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

MIN_DURATION = 0.5
"""Shortest standstill, s."""

MAX_MOTION = PoseNoise(1.5e-4, 1.5e-3)
"""Largest difference of block means of a body at rest, without noise, m and rad."""

NOISE_DEVIATIONS = 5.0
"""Largest difference of block means due to noise, standard deviations."""

CREEP_CHI2 = 45.0
"""Smallest chi^2 of significant creep with 6 degrees of freedom (false-alarm rate 5e-8)."""

MAX_SPREAD = 8.0
"""Largest ratio of the standard errors of the rest pose and the mean pose."""

BLOCK_SECONDS = 0.1
"""Duration of a block, shorter than a period of swing, s."""

MIN_BLOCK_SAMPLES = 3
"""Smallest number of samples of a block."""


@dataclass(frozen=True, eq=False)
class Standstill:
    """
    A standstill of tool and package.

    Parameters
    ----------
    start_ns, duration : int, float
        Begin (ns) and duration (s) of the standstill.
    tool, package : Trajectory
        One pose each: the means of E and B in the world.
    samples : int
        Number of averaged package poses.
    error : PoseNoise
        Standard error of the relative pose, m and rad per axis.
    payload : Package
        Package on the cup.
    creep : array (6,)
        Remaining motion of the relative pose from the begin of the standstill on (m, rad) by creep
        of rubber; `package` is then the final rest pose.
    gravity : float
        Gravitational acceleration along -z of the world, m/s^2.
    moves_with_com : tuple of bool
        See `PrepareSettings`.

    """

    start_ns: int
    duration: float
    tool: Trajectory
    package: Trajectory
    samples: int
    error: PoseNoise
    payload: Package
    creep: Array = field(default_factory=lambda: np.zeros(6))
    gravity: float = 9.81
    moves_with_com: tuple[bool, bool, bool] = (True, True, True)

    @property
    def lip(self) -> Array:
        """E_o_S (m) and the rotation vector (rad) of the lip in the tool, (6,)."""
        lip = self.package.position - self.package.rotation @ self.payload.com
        moved = Trajectory(self.package.stamps_ns, lip, self.package.rotation)
        return np.asarray(relative_coordinates(self.tool, moved)[0])

    @property
    def tilt(self) -> float:
        """Angle between the tool's axis and the vertical, rad."""
        return float(np.arccos(np.clip(self.tool.rotation[0, 2, 2], -1.0, 1.0)))


def standstills_of(recording: Recording) -> tuple[tuple[Standstill, ...], int]:
    """
    Return the standstills of a recording in the order of time, and the number of failed ones.

    The unfiltered poses are averaged over short blocks. Blocks are added backwards from the end of
    a standstill while both bodies keep their poses, which excludes the swing after a move. A
    standstill of the tool fails if the package does not come to rest.

    Raises
    ------
    BellowsError
        If there are too few valid poses to separate noise from motion, or no standstill.

    """
    bodies = recording.measured_tool, recording.measured_package
    noise, blocks = recording.noise, _blocks(*bodies)
    spans = _spans_at_rest(bodies, noise, blocks)
    if not spans:
        raise BellowsError(
            f'The recording contains no standstill of {MIN_DURATION:g} s or more: the tool and '
            'the package must both come to rest. Hold each pose until the package has stopped '
            'swinging, some 3 s.')
    settled = np.array([span[0] for span in spans], dtype=np.int64)
    failed = sum(
        not np.any((settled >= span[0] - len(blocks[0])) & (settled <= span[-1]))
        for span in _spans_at_rest(bodies[:1], noise[:1], blocks))
    tool, package = bodies
    return tuple(
        _standstill(tool.select(span), package.select(span), noise, recording.settings)
        for span in spans), failed


def _standstill(
    tool: Trajectory, package: Trajectory, noise: tuple[PoseNoise, PoseNoise],
    settings: PrepareSettings,
) -> Standstill:
    """
    Return a standstill from its samples.

    Creep is fitted as c exp(-t / tau_2) plus a rest pose, with the longer time constant of the
    model of relaxing rubber. If the creep is significant, the rest pose replaces the mean.
    """
    every = np.arange(len(package))
    at_rest, hanging = _means(tool, [every]), _means(package, [every])
    relative, stamps_ns = relative_coordinates(tool, package), package.stamps_ns
    mean = Standstill(int(stamps_ns[0]), _seconds(stamps_ns, every), at_rest, hanging, len(every),
                      _error(relative, stamps_ns, noise), settings.payload,
                      gravity=settings.gravity, moves_with_com=settings.moves_with_com)
    design = np.stack([np.ones(len(every)), np.exp(-package.seconds / RELAXATION_TIMES[1])], 1)
    rest, creep = np.linalg.lstsq(design, relative, rcond=None)[0]
    # ratio to the error of a mean
    spread = np.sqrt(len(every) * np.diag(np.linalg.inv(design.T @ design)))
    error = _error(relative - design @ [rest, creep], stamps_ns, noise)
    chi2 = np.sum((creep / (spread[1] * np.repeat(error, 3))) ** 2)
    if chi2 < CREEP_CHI2 or spread[0] > MAX_SPREAD:
        return mean
    R = at_rest.rotation[0]
    return replace(
        mean, package=Trajectory(
            hanging.stamps_ns, at_rest.position + R @ rest[:3], (R @ exp_so3(rest[3:]))[None]),
        error=PoseNoise(*(spread[0] * np.array(error))), creep=-creep)


def _spans_at_rest(
    bodies: Sequence[Trajectory], noise: Sequence[PoseNoise], blocks: list[Stamps]
) -> list[Stamps]:
    """Return the samples of every standstill of all bodies, in the order of time."""
    stamps = bodies[0].stamps_ns
    means = [_means(body, blocks) for body in bodies]
    factor = NOISE_DEVIATIONS / np.sqrt(np.median([len(block) for block in blocks]))
    limits = [PoseNoise(*np.add(MAX_MOTION, np.multiply(factor, n))) for n in noise]
    ends = stamps[[block[-1] for block in blocks]]
    spans, last = [], len(blocks) - 1
    while last >= 0:
        first = last
        while first > 0 and _continues(means, limits, ends, first, last):
            first -= 1
        # The first and the last block may contain some of the moves before and after.
        inner = slice(first + 1, last) if last - first > 3 else slice(first, last + 1)
        span = np.concatenate(blocks[inner])
        is_long = _seconds(stamps, span) >= MIN_DURATION
        spans += [span] if is_long else []
        last = first - 1 if is_long else last - 1
    return spans[::-1]


def _blocks(tool: Trajectory, package: Trajectory) -> list[Stamps]:
    """Return the indices of valid samples by blocks of time."""
    valid = np.flatnonzero(tool.valid & package.valid)
    if not len(valid):
        raise BellowsError('No valid sample is left to find standstills in.')
    number = (tool.stamps_ns[valid] - tool.stamps_ns[0]) // int(BLOCK_SECONDS * NS_PER_S)
    parts = np.split(valid, np.flatnonzero(np.diff(number)) + 1)
    return [part for part in parts if len(part) >= MIN_BLOCK_SAMPLES] or [valid]


def _means(body: Trajectory, spans: Sequence[Stamps]) -> Trajectory:
    """Return the mean pose over each span of samples, at its first stamp."""
    return Trajectory(body.stamps_ns[[span[0] for span in spans]],
                      np.array([body.position[span].mean(axis=0) for span in spans]),
                      np.array([mean_rotation(body.rotation[span]) for span in spans]))


def _continues(
    means: list[Trajectory], limits: list[PoseNoise], ends: Stamps, first: int, last: int
) -> bool:
    """Return whether the block before the first agrees with blocks first to last."""
    if means[0].stamps_ns[first] - ends[first - 1] > BLOCK_SECONDS * NS_PER_S:
        return False
    rest = slice(first, last + 1)
    return all(
        np.linalg.norm(body.position[first - 1] - body.position[rest].mean(axis=0))
        <= limit.position and limit.rotation >= np.linalg.norm(
            log_so3(mean_rotation(body.rotation[rest]).T @ body.rotation[first - 1]))
        for body, limit in zip(means, limits, strict=True))


def _seconds(stamps_ns: Stamps, span: Stamps) -> float:
    return float(stamps_ns[span[-1]] - stamps_ns[span[0]]) / NS_PER_S


def _error(relative: Array, stamps_ns: Stamps, noise: tuple[PoseNoise, PoseNoise]) -> PoseNoise:
    """
    Return the standard errors of the mean of relative poses (N, 6).

    The result is the larger of the standard error by noise and the standard error by the scatter
    of block means, which includes residual swing.
    """
    blocks = (stamps_ns - stamps_ns[0]) // int(BLOCK_SECONDS * NS_PER_S)
    starts = np.unique(blocks, return_index=True)[1]
    counts = np.diff([*starts, len(relative)])[:, None]
    means = np.add.reduceat(relative, starts, axis=0) / counts
    variances = np.var(means, axis=0, ddof=1) / len(means) if len(means) > 1 else np.zeros(6)
    return PoseNoise(*(
        float(np.sqrt(max((a**2 + b**2) / len(relative), np.mean(variances[part]))))
        for a, b, part in zip(*noise, (slice(0, 3), slice(3, 6)), strict=True)))


def with_standstills(
    envelope: Envelope, standstills: Sequence[Standstill], cup_length: float
) -> Envelope:
    """Return a validity range that includes the deflections of standstills, without rates."""
    nominal = np.array([0.0, 0.0, -cup_length, 0.0, 0.0, 0.0])
    return envelope.widened([
        np.pad(still.lip - nominal, (0, 8), constant_values=np.nan) for still in standstills])
