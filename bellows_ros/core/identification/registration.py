"""
Two clocks, two worlds and a marker anywhere on the package: found from one recording.

First guesses come from what needs no cup: both bodies turn alike, and at about the same distance.
Then all is free beside K and P in the output error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import (
    apply,
    exp_so3,
    mean_rotation,
    rotation_to_quaternion,
)
from bellows_ros.core.identification.quantities import anything, KINDS
from bellows_ros.core.identification.search import measured_of, Search, Segment
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.alignment import Alignment, slow_poses, turn_of
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
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
    """Values and standard errors by names of `KINDS`, SI units, and the middle of the way."""

    values: Mapping[str, Array]
    std: Mapping[str, Array]
    middle: Array


def registered(
    recording: Recording, structure: Structure, start: Cup, names: Sequence[str]
) -> Registered:
    """
    Find what is free beside K and P in one recording; leave out a clock that it does not tell.

    Raises
    ------
    BellowsError
        If the search ends nowhere, and not for the clock alone.

    """
    measured = measured_of(recording)
    search = Search([Segment(own) for own in measured], structure, start, anything(names))
    found = search.found(lambda cup, chi2: None)
    middle = np.asarray(measured[0].middle)
    if not found.converged and list(names) == ['time_offset']:
        return Registered({}, {}, middle)
    if not found.converged:
        raise BellowsError(
            f'{", ".join(names)} cannot be found: the search did not converge. Check package.mass '
            'and package.com, and tilt and turn the tool more.')
    x = search.units * found.theta
    std = search.units * np.sqrt(np.diag(np.linalg.inv(found.information)))
    places = {name: own[0] for name, own in search.places.items()
              if name != 'time_offset' or std[own[0, 0]] < KINDS[name].known}
    return Registered({name: x[own] for name, own in places.items()},
                      {name: std[own] for name, own in places.items()}, middle)


def regripped(known: Alignment, theta: Array) -> Alignment:
    """Return an alignment with B moved and turned in its own axes by theta (6,), m and rad."""
    R = exp_so3(theta[3:])
    return replace(known, R_package_markers_lip=known.R_package_markers_lip @ R,
                   origin_to_com=R.T @ (known.origin_to_com + theta[:3]))
