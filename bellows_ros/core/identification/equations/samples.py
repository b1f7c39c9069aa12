"""The filtered motions of a recording as identification sees them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

from bellows_ros.core.arrays import Mask, Stamps
from bellows_ros.core.identification.equations.equations import BLOCK, LipMotion
from bellows_ros.core.identification.equations.wrenches import lip_relative, needed_wrench
from bellows_ros.core.lie import exp_so3
from bellows_ros.core.model import Package
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.score import relative_coordinates
from bellows_ros.core.trajectory import Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

FARTHEST = 2.0
"""Distance (m) of the lip from the tool tip that no cup has: its length is at most 1 m."""

LOOKED_AT_EVERY = 20
"""So many samples are stepped over where only the arrangement is looked at."""


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
        Duration of the package's filter window, s: so far residuals are correlated.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: float
    window: float

    @property
    def valid(self) -> Mask:
        """Where both motions are to be used (N,)."""
        return self.tool.valid & self.package.valid

    @property
    def count(self) -> int:
        """Number of valid samples."""
        return int(np.count_nonzero(self.valid))

    @cached_property
    def lip(self) -> LipMotion:
        """What equations are made of."""
        parts = [(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 6)), np.empty((0, 6)))]
        for block in self.blocks():
            motion = lip_relative(block.tool, block.package, block.payload.com)
            parts.append((*motion, needed_wrench(block.payload, block.package, block.gravity)))
        index = np.flatnonzero(self.valid)
        return LipMotion(
            index, self.tool.stamps_ns[index], self.window,
            *(np.concatenate(part) for part in zip(*parts, strict=True)))

    def select(self, index: slice | Mask | Stamps) -> 'Samples':
        """Return the samples that a slice, a mask or increasing indices pick."""
        return replace(self, tool=self.tool.select(index), package=self.package.select(index))

    def blocks(self) -> 'Iterator[Samples]':
        """Yield the valid samples in blocks, in the order of time."""
        valid = np.flatnonzero(self.valid)
        for start in range(0, len(valid), BLOCK):
            yield self.select(valid[start:start + BLOCK])

    def thinned(self, most: int) -> 'Samples':
        """Return every so many of the samples, about as many as asked for or a few more."""
        step = max(len(self.tool) // most, 1)
        if step == 1:
            return self
        some = self.select(slice(None, None, step))
        if 'lip' in vars(self):  # with what is known of it
            vars(some)['lip'] = self.lip.thinned(step)
        return some


def samples_of(recording: Recording) -> Samples:
    """
    Return what least squares takes, filtered as the parameter filter.relative says.

    Raises
    ------
    BellowsError
        If the package is not on that side of the tool where the cup is.

    """
    return recording.once('samples', lambda: _samples(recording))


def filtered_samples(recording: Recording) -> Samples:
    """Return the filtered motions, whatever filter.relative says."""
    return recording.once('filtered samples', lambda: Samples(
        recording.tool, recording.package, recording.payload, recording.settings.gravity,
        recording.package_weights.shape[1] / uniform_rate_hz(recording.package.stamps_ns)))


def _samples(recording: Recording) -> Samples:
    """Return the samples of a recording that was looked at."""
    _require_below(recording)
    samples = filtered_samples(recording)
    if not recording.settings.relative:
        return samples
    from bellows_ros.core.recording.relative_filter import relatively_filtered  # late: rare

    tool, package = relatively_filtered(recording)
    return replace(samples, tool=tool, package=package)


def _require_below(recording: Recording) -> None:
    """Refuse a recording whose package is mostly not below the tool, along its z axis."""
    some = np.flatnonzero(recording.valid)[::LOOKED_AT_EVERY]
    package = recording.measured_package.select(some)
    relative = relative_coordinates(recording.measured_tool.select(some), package)
    lip = relative[:, :3] - exp_so3(relative[:, 3:]) @ recording.payload.com
    if not len(some):
        return
    away, above = float(np.median(np.linalg.norm(lip, axis=1))), float(np.median(lip[:, 2]))
    if away > FARTHEST:
        raise BellowsError(_millimetres(recording, away))
    if above > 0.0:
        upward = float(np.median(
            (package.position - recording.measured_tool.select(some).position)[:, 2]))
        raise BellowsError(
            f'The lip of the cup is {1e3 * above:.0f} mm above the tool tip in axes of the tool, '
            'but the cup hangs below it. ' + (
                f'The package is {1e3 * upward:.0f} mm above the tool in the world, too: '
                'topics.tool_pose and topics.package_pose are exchanged, or else recording.world '
                'is wrong.' if upward > 0.0 else
                'In the world the package is below the tool: z of the tool points the wrong way, '
                'it must point from the cup back into the arm; or package.com is wrong.')
        )


def _millimetres(recording: Recording, away: float) -> str:
    """Return what is to be said of poses that are so far apart (m)."""
    names = [f"'{stream.name}'" for stream in (recording.tool_pose, recording.package_pose)]
    tool, package = (np.median(stream.position, axis=0)
                     for stream in (recording.tool_pose, recording.package_pose))
    scaled = [float(np.linalg.norm(p * package - t * tool))
              for t, p in ((1e-3, 1.0), (1.0, 1e-3), (1e-3, 1e-3))]
    which = (names[0], names[1], f'{names[0]} and {names[1]}')[int(np.argmin(scaled))]
    if min(scaled) > FARTHEST:
        return (f'The lip of the cup is {away:.3g} m from the tool tip: the poses of {names[0]} '
                f'and {names[1]} are not in one world. Set recording.package_world.')
    return (f'The lip of the cup is {away:.3g} m from the tool tip: the poses of {which} are in '
            'millimetres. They must be in m: change the driver, or convert the recording.')
