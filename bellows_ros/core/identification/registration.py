"""
Two clocks, two worlds and a marker anywhere on the package: found from one recording.

First guesses come from what needs no cup: both bodies turn alike, and at about the same distance.
Then all is free beside K and P in the output error; for least squares, in its objective.
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
from bellows_ros.core.identification.objective import (
    DRAWS,
    ensemble_of,
    FEWEST_SECONDS,
    Objective,
    refine,
)
from bellows_ros.core.identification.quantities import anything, KINDS
from bellows_ros.core.identification.search import measured_of, Search, Segment
from bellows_ros.core.identification.variations import BLOCKS, LARGEST_OFFSET, RASTER
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.alignment import Alignment, slow_poses, turn_of
from bellows_ros.core.recording.recording import Recording, TimeOffset
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


LARGEST_ERROR = 3e-4
"""Largest standard error (s) of an identifiable time offset."""

WORLD_ERROR = 5e-3
"""Largest standard error (m, rad) of an identifiable transform between two worlds."""

BEYOND_RANGE = 0.9
"""If residuals at the largest offset fall below this fraction, the true offset is larger."""


class RefinedPreparation(NamedTuple):
    """
    Estimates for one recording, None if not wanted or not identifiable.

    The motion of the package's world (6,) about a point (3,), its standard errors (6,), the
    alignment that belongs to it, and the time offset.
    """

    world: Array | None
    world_std: Array
    middle: Array
    alignment: Alignment | None
    offset: TimeOffset | None


def refined_preparation(
    recording: Recording, length: float, structure: Structure, world: bool, offset: bool,
    rough: bool = False,
) -> RefinedPreparation:
    """
    Find the package's world and the time offset of a recording, together with K and P.

    Parameters
    ----------
    recording : Recording
        Prepared with a first guess of the world.
    length : float
        Of the cup, m.
    structure : Structure
        Of K and P.
    world, offset : bool
        Which of the two is wanted. Where alignment at rest was made, the grip's offset and turn
        are found with the world.
    rough : bool
        Whether it is for a better first guess alone, without regard to noise.

    Raises
    ------
    BellowsError
        If the offset is beyond those looked for, or the world is not identifiable.

    """
    names = [*(['time_offset'] if offset else []), *(['package_world'] if world else []),
             *(['grip'] if world and recording.settings.align_at_rest else [])]
    ensemble = ensemble_of([recording], length, structure, 0 if rough else DRAWS)
    if ensemble.seconds < FEWEST_SECONDS:
        return RefinedPreparation(None, np.zeros(6), np.zeros(3), None, None)
    body = recording.package
    middle = body.position[body.valid].mean(axis=0)
    objective = Objective.of(ensemble)
    found = refine(objective, ensemble, [BLOCKS[name] for name in names])
    theta, std = found.theta, found.std
    taken = None
    if offset:
        fallen = found.solved.excess < BEYOND_RANGE * objective.solved(ensemble).excess
        taken = _offset(float(theta[0]), float(std[0]), fallen)
        theta, std = theta[1:], std[1:]
    if not world:
        return RefinedPreparation(None, np.zeros(6), middle, None, taken)
    if not (rough or np.all(std[:6] < WORLD_ERROR)):
        raise BellowsError(
            'recording.package_world is not identifiable from this recording: the standard '
            f'errors are {_listed(1e3 * std[:3])} mm and {_listed(1e3 * std[3:6])} mrad. Tilt '
            'and turn the tool more, best with three standstills tilted to different sides, or '
            'set its seven numbers.'
        )
    alignment = _gripped(recording, theta[6:11]) if 'grip' in names else recording.alignment
    return RefinedPreparation(theta[:6], std[:6], middle, alignment, taken)


def _offset(value: float, std: float, fallen: bool) -> TimeOffset | None:
    """Return a time offset, or None if it is not identifiable."""
    if abs(value) > LARGEST_OFFSET - RASTER / 2.0 and fallen:
        raise BellowsError(
            f'The stamps of tool and package are {1e3 * LARGEST_OFFSET:g} ms or more '
            'apart, the limit of fit.time_offset. Shift the stamps of one topic by the known '
            'delay.'
        )
    return TimeOffset(value, std) if std < LARGEST_ERROR else None


def _gripped(recording: Recording, theta: Array) -> Alignment:
    """Return the alignment of a recording with the grip moved and turned by theta (5,)."""
    known, R = recording.alignment, exp_so3(theta[2:])
    way = np.array([theta[0], theta[1], 0.0])
    # B' is at R_B way from B, and origin_to_com is in axes of the lip, which has turned by R.
    return replace(
        known, R_package_markers_lip=known.R_package_markers_lip @ R,
        origin_to_com=R.T @ (known.origin_to_com + way), lateral_offset=known.lateral_offset - way)


def _listed(values: Array) -> str:
    """Return numbers in words."""
    return ', '.join(f'{x:.2g}' for x in values)
