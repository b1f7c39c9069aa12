"""Recordings as the prediction-error method sees them: segments, and the noise of their poses."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.recording.recording import (
    Recording,
    ripple,
    ripple_part,
    TOOL_HALF_WINDOW,
    TOOL_ORDER,
)
from bellows_ros.core.signals.savgol import bridged, savgol
from bellows_ros.core.signals.timing import MAD_TO_STD
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import UndeterminedError
import numpy as np

CUT_AT = 5.0
"""Residuals are clipped at this many typical deviations, so that outliers do not count."""

SMALLEST = np.repeat([2e-7, 2e-6], 3)
"""Smallest noise of a pose (m, rad): interpolation and rounding."""


class PoseNoise(NamedTuple):
    """
    First-order noise of the poses of one body, n_k = kept n_(k-1) + e_k, in its own axes.

    Ripple (6,): the standard deviation (m, rad) that white noise would have of which a local
    polynomial leaves as much.
    """

    ripple: Array
    kept: float = 0.0

    @classmethod
    def of(cls, std: Array, kept: float) -> 'PoseNoise':
        """Return noise with standard deviations (6,), m and rad."""
        return cls(std / cls(np.ones(6), kept).std, kept)

    @property
    def fresh(self) -> Array:
        """Standard deviations (6,) of e."""
        return self.std * float(np.sqrt(1.0 - self.kept**2))

    @property
    def std(self) -> Array:
        """Standard deviations (6,) of n."""
        return np.asarray(self.ripple * np.sqrt(ripple_part(0.0) / ripple_part(self.kept)))


def pose_noise(poses: Trajectory) -> PoseNoise:
    """
    Estimate the noise of poses at a uniform rate, per axis, as white.

    Raises
    ------
    BellowsError
        If there is no window of valid samples.

    """
    left, rotation = ripple(poses)
    left[:, :3] = apply(np.swapaxes(rotation, 1, 2), left[:, :3])
    typical = MAD_TO_STD * np.median(np.abs(left), axis=0)
    squares = np.mean(np.minimum(left**2, (CUT_AT * typical) ** 2), axis=0)
    return PoseNoise(np.maximum(np.sqrt(squares / ripple_part(0.0)), SMALLEST))


LONGEST_GAP = 0.15
"""Longest gap (s) that is bridged; at longer ones the recording is split."""

SHORTEST_SEGMENT = 1.0
"""Shortest segment (s) between gaps that is used."""

MOST_POSES = 16_384
"""Longer segments are split into equal parts, so that memory is bounded."""

BLIND_STEPS = 3.0
"""Poses in gaps of the tool longer than this many steps are ignored."""


@dataclass(frozen=True, eq=False)
class Measured:
    """
    One segment of a recording.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world with body twists at stamps that cover the package's.
    package : Trajectory
        N poses of B at a uniform rate, not smoothed; in short gaps they are bridged, and not
        valid.
    payload : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float or array (3,)
        m/s^2 along -z of the world, or as a vector there.
    tool_noise, package_noise : PoseNoise
        Noise of the measured poses; the tool's has its density at the package's rate.
    recording : int
        Number of the recording it is of.
    moves_with_com : tuple of 3 bool
        Components of the centre of mass with which the poses of B move, as those of the lip are
        known.
    history : ndarray (N, 2, 9), optional
        What the internal strains of a cup that relaxes follow from; see `strain_history`.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: Array | float
    tool_noise: PoseNoise
    package_noise: PoseNoise
    recording: int = 0
    moves_with_com: tuple[bool, bool, bool] = (False, False, False)
    history: Array | None = None


def measured_segments(
    tool: Trajectory,
    package: Trajectory,
    payload: Package,
    gravity: float,
    margin: float = 0.0,
) -> list[Measured]:
    """
    Return the segments of a recording without gaps in either motion.

    Parameters
    ----------
    tool, package : Trajectory
        Aligned poses of E and B in the world, each at its own uniform rate, with what is wrong
        in them marked.
    payload : Package
        What hung on the cup.
    gravity : float
        m/s^2 along -z of the world.
    margin : float
        Time (s) before and after a segment for which the tool must be known, too.

    Raises
    ------
    BellowsError
        If no segment is long enough.

    """
    tool_rate, rate = (uniform_rate_hz(body.stamps_ns) for body in (tool, package))
    noises = PoseNoise(pose_noise(tool).ripple * np.sqrt(rate / tool_rate)), pose_noise(package)
    seen = package.stamps_ns[package.valid & _tool_seen(tool, package, BLIND_STEPS / tool_rate)]
    segments = []
    for part in _parts(in_motion(tool), LONGEST_GAP):
        for own in _parts(bridged(package, LONGEST_GAP), 1.5 / rate):
            edge = round(margin * NS_PER_S)
            inside = own.select(
                (own.stamps_ns >= part.stamps_ns[0] + edge)
                & (own.stamps_ns <= part.stamps_ns[-1] - edge))
            for indices in np.array_split(np.arange(len(inside)), len(inside) // MOST_POSES + 1):
                piece = inside.select(indices)
                if len(piece) >= SHORTEST_SEGMENT * rate:
                    piece = replace(piece, valid=np.isin(piece.stamps_ns, seen))
                    segments.append(Measured(part, piece, payload, gravity, *noises))
    if not segments:
        raise UndeterminedError(
            f'No segment of {SHORTEST_SEGMENT:g} s in which both bodies are tracked. Record '
            'longer, or check the gaps and outliers in the report.'
        )
    return segments


def segments_of(recording: Recording, margin: float = 0.0) -> list[Measured]:
    """Return the segments of a recording; see `measured_segments`."""
    return recording.once(('segments', margin), lambda: measured_segments(
        recording.aligned_tool, recording.aligned_package, recording.payload,
        recording.settings.gravity, margin))


def _parts(poses: Trajectory, longest: float) -> Iterator[Trajectory]:
    """Yield the valid parts of a motion between longer steps (s) in time."""
    known = poses.select(poses.valid)
    steps = np.diff(known.stamps_ns) / NS_PER_S
    cuts = [0, *(np.flatnonzero(steps > longest) + 1).tolist(), len(known)]
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        if last - first > 1:
            yield known.select(slice(first, last))


def in_motion(poses: Trajectory) -> Trajectory:
    """
    Return measured poses of the tool with twists, smoothed a little.

    Short gaps are bridged first: a filter that stopped at each gap would lose half a window more
    before it and behind it.
    """
    return savgol(bridged(poses, LONGEST_GAP), TOOL_HALF_WINDOW, TOOL_ORDER)


def _tool_seen(tool: Trajectory, package: Trajectory, longest: float) -> Mask:
    """Return which of the package's stamps are not in a gap of the tool longer than that (s)."""
    tracked, stamps = tool.stamps_ns[tool.valid], package.stamps_ns
    after = np.clip(np.searchsorted(tracked, stamps), 1, len(tracked) - 1)
    step = (tracked[after] - tracked[after - 1]) / NS_PER_S
    return np.asarray((tracked[after] == stamps) | (step <= longest))
