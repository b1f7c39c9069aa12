"""What is found together with K and P because the user set it free, or did not know it."""

from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.hypotheses import variations
from bellows_ros.core.identification.hypotheses.objective import DRAWS, evidence_of, Objective
from bellows_ros.core.identification.hypotheses.refinement import Block, refine
from bellows_ros.core.lie import exp_so3
from bellows_ros.core.recording.alignment import Alignment
from bellows_ros.core.recording.recording import Recording, TimeOffset
from bellows_ros.core.structure import Structure
from bellows_ros.errors import BellowsError
import numpy as np

RASTER = 0.01
"""Time (s) between the offsets tried first: the residuals of motions up to 10 Hz have one dip."""

LARGEST_ERROR = 3e-4
"""An offset whose standard error is larger (s) is not identifiable."""

WORLD_ERROR = 5e-3
"""The same of the transform between two worlds, m and rad."""

FALLS = 0.9
"""Residuals that fall to this part up to the largest offset tell that the true one is larger."""

FEWEST_SECONDS = 3.0
"""Valid samples of less time than this (s) tell nothing."""

_OFFSETS = tuple(RASTER * i for i in range(-10, 11))

_HEIGHTS = (-8e-3, -4e-3, -2e-3, -1e-3, 1e-3, 2e-3, 4e-3, 8e-3)

BLOCKS = {
    'time_offset': Block('time_offset', variations.time_offset, (1e-4,), _OFFSETS, 0, 100.0, True),
    'com': Block('com', variations.com, (1e-5,) * 3, _HEIGHTS, 2, furthest=1000.0),
    'length': Block('length', variations.length, (1e-5,), _HEIGHTS, furthest=500.0),
    'inertia': Block('inertia', variations.inertia, (1e-3,) * 3, furthest=1000.0),
    'mass': Block('mass', variations.mass, (1e-3,), furthest=1000.0),
    'package_world': Block(
        'package_world', variations.package_world, (1e-5,) * 6, _HEIGHTS, 2, 5000.0, True),
    'grip': Block('grip', variations.grip, (1e-5,) * 5, furthest=5000.0, each=True),
}
"""What may be set free, by its name in fit.free; the grip with package_world and alignment."""


class Found(NamedTuple):
    """
    What was found of one recording, None where it was not wanted or is not identifiable.

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
) -> Found:
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
    evidence = evidence_of([recording], length, structure, 0 if rough else DRAWS)
    if evidence.seconds < FEWEST_SECONDS:
        return Found(None, np.zeros(6), np.zeros(3), None, None)
    body = recording.package
    middle = body.position[body.valid].mean(axis=0)
    objective = Objective.of(evidence)
    found = refine(objective, evidence, [BLOCKS[name] for name in names])
    theta, std = found.theta, found.std
    taken = None
    if offset:
        fallen = found.solved.excess < FALLS * objective.solved(evidence).excess
        taken = _offset(float(theta[0]), float(std[0]), fallen)
        theta, std = theta[1:], std[1:]
    if not world:
        return Found(None, np.zeros(6), middle, None, taken)
    if not (rough or np.all(std[:6] < WORLD_ERROR)):
        raise BellowsError(
            'recording.package_world is not identifiable from this recording: the standard errors '
            f'are {_listed(1e3 * std[:3])} mm and {_listed(1e3 * std[3:6])} mrad. Tilt and turn '
            'the tool more, best with three standstills tilted to different sides, or give its '
            'seven numbers.'
        )
    alignment = _gripped(recording, theta[6:11]) if 'grip' in names else recording.alignment
    return Found(theta[:6], std[:6], middle, alignment, taken)


def _offset(value: float, std: float, fallen: bool) -> TimeOffset | None:
    """Return a time offset; None where it is not identifiable."""
    if abs(value) > variations.LARGEST_OFFSET - RASTER / 2.0 and fallen:
        raise BellowsError(
            f'The stamps of tool and package are {1e3 * variations.LARGEST_OFFSET:g} ms or more '
            'apart, and fit.time_offset looks no further. Shift the stamps of one topic by what '
            'is known.'
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
