"""
Two clocks, two worlds and a marker anywhere on the package: found from one recording.

First guesses come from what needs no cup: both bodies turn alike, and at about the same distance.
Then all is free beside K and P in the output error, whatever the method of the fit.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, exp_so3, mean_rotation, rotation_to_quaternion
from bellows_ros.core.identification.quantities import anything, KINDS
from bellows_ros.core.identification.search import measured_segments, Search, Segment
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.alignment import Alignment, slow_poses, turn_of
from bellows_ros.core.recording.recording import Recording, TimeOffset
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import UndeterminedError
import numpy as np


def hand_eye(
    tool: Trajectory, package: Trajectory, length: float, com: Array
) -> tuple[Array, Alignment]:
    """
    Return first guesses of the pose (7,) of the package's world, and of the marker's alignment.

    The slowest poses are taken for those of one rigid body.

    Parameters
    ----------
    tool, package : Trajectory
        Poses of E, and of the marker, each in its own world.
    length : float
        Of the cup, m.
    com : ndarray (3,)
        Of B in the lip frame, m.

    Raises
    ------
    BellowsError
        If the tool turns too little.

    """
    hand, eye = slow_poses(tool, package)
    R = turn_of(hand.rotation, eye.rotation)
    R_marker_lip = mean_rotation(np.swapaxes(eye.rotation, 1, 2) @ R.T @ hand.rotation)
    # o + R o_M + R_E c = o_E + R_E (below + com)
    A = np.concatenate([np.tile(np.eye(3), (len(hand), 1, 1)), hand.rotation], axis=2)
    b = (hand.position + apply(hand.rotation, com - [0.0, 0.0, length])
         - apply(R, eye.position))
    x = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=1e-6)[0]
    return np.concatenate([x[:3], rotation_to_quaternion(R)]), Alignment(
        np.eye(3), R_marker_lip, x[3:], np.zeros(3))


class Registered(NamedTuple):
    """
    What was found beside K and P in one recording, None where it is not wanted or identifiable.

    The motion of the package's world (6,) about a point (3,), with its standard errors (6,), the
    alignment with which the streams are to be filtered again, and the time offset.
    """

    world: Array | None
    world_std: Array
    middle: Array
    alignment: Alignment
    offset: TimeOffset | None

    def require_world(self) -> None:
        """Refuse a world that is not identifiable, for a method that takes it as exact."""
        if np.any(self.world_std > KINDS['package_world'].known):
            each = [f'{1e3 * x:.2g}' for x in self.world_std]
            raise UndeterminedError(
                'recording.package_world is not identifiable from this recording: the standard '
                f'errors are {", ".join(each[:3])} mm and {", ".join(each[3:])} mrad. Tilt '
                'and turn the tool more, best with three standstills tilted to different sides, '
                'or set its seven numbers.')


def registered(
    recording: Recording, structure: Structure, start: Cup, names: Sequence[str]
) -> Registered:
    """
    Find what is free beside K and P by simulation; leave out a clock that it does not tell.

    Raises
    ------
    UndeterminedError
        If the search ends nowhere, and not for the clock alone.

    """
    measured = measured_segments(recording)
    search = Search(list(map(Segment, measured)), structure, start, anything(names))
    minimum = search.minimum()
    middle, alignment = np.asarray(measured[0].middle)[:3], recording.alignment
    if not minimum.converged and list(names) == ['time_offset']:
        return Registered(None, np.zeros(6), middle, alignment, None)
    if not minimum.converged:
        raise UndeterminedError(
            f'{", ".join(names)} cannot be found: the search did not converge. Check package.mass '
            'and package.com, and tilt and turn the tool more.')
    estimates = {name: search.estimate(minimum, name) for name in search.places}
    if 'package_marker' in estimates:
        alignment = _gripped(alignment, *np.split(estimates['package_marker'][0], 2))
    offset = None
    if 'time_offset' in estimates:
        (seconds,), (std,) = estimates['time_offset']
        if std < KINDS['time_offset'].known:
            offset = TimeOffset(float(seconds), float(std))
    world, world_std = estimates.get('package_world', (None, np.zeros(6)))
    return Registered(world, world_std, middle, alignment, offset)


def _gripped(alignment: Alignment, way: Array, turn: Array) -> Alignment:
    """Return an alignment with B moved (m) and turned (rad) in its own axes."""
    R = exp_so3(turn)  # origin_to_com is in axes of the lip, which has turned by R
    return replace(alignment, R_package_markers_lip=alignment.R_package_markers_lip @ R,
                   origin_to_com=R.T @ (alignment.origin_to_com + way))
