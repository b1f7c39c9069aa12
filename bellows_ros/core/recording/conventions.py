"""Units and quaternion orders with which poses of tool and package are consistent."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.signals.trajectory import Posed, Trajectory
import numpy as np

MAX_DISTANCE = 2.0
"""Largest distance of a package from the tool, m: ten times the longest cup with its package."""

MAX_MOTION = 20.0
"""Largest motion of a tool, m: a larger one is in millimetres."""

MIN_REACH = 0.01
"""Smallest distance of a package on a cup from the tool, m: a cup of one bellow."""

MAX_REACH = 0.5
"""Largest distance of a package on a cup from the tool, m: a long cup and half a box."""

MAX_CHANGE = 0.25
"""Largest relative variation of this distance: a cup stretched by a quarter."""

MIN_SIMILARITY = 0.95
"""Smallest similarity of two bodies' rotations with another quaternion order."""

MAX_DIFFERENCE_RATIO = 0.25
"""Largest ratio of the remaining differences: with w first, a rotation is inverted in world
axes."""


class Convention(NamedTuple):
    """Convention of recorded poses: positions in mm, quaternions with w first."""

    millimetres: bool = False
    w_first: bool = False


def reordered(rotation: Array) -> Array:
    """Return rotations (N, 3, 3) of quaternions stored with w first but read with w last."""
    return lie.quaternion_to_rotation(np.roll(lie.rotation_to_quaternion(rotation), -1, axis=-1))


def converted(poses: Posed, convention: Convention) -> Posed:
    """Return poses in metres, with w last, from poses of another convention."""
    return replace(
        poses, position=poses.position * (1e-3 if convention.millimetres else 1.0),
        rotation=reordered(poses.rotation) if convention.w_first else poses.rotation)


def conventions_of(
    bodies: Sequence[Trajectory], one_frame: bool
) -> tuple[Convention, Convention]:
    """Return the conventions of two bodies in one frame or two: standard ones if consistent."""
    units = Convention(), Convention()
    if not one_frame:
        return _of_two_worlds(bodies)
    if distance_of(bodies, units)[0] > MAX_DISTANCE:
        both = [(Convention(a), Convention(b)) for a, b in product((False, True), repeat=2)]
        units = min((each for each in both if _is_on_cup(bodies, each)),
                    key=lambda each: distance_of(bodies, each)[1], default=units)
    if not _is_on_cup(bodies, units):
        return units
    orders = [(units[0]._replace(w_first=a), units[1]._replace(w_first=b))
              for a, b in product((False, True), repeat=2)]
    motions = [motion_in_tool(bodies, each) for each in orders]
    best = min(range(4), key=lambda i: sum(motions[i]))
    (moves, tilt), (moves_read, tilt_read) = motions[best], motions[0]
    upright = moves < moves_read and tilt < 0.2 and 0.5 < tilt_read  # rad
    # the threshold for another order
    return orders[best] if moves < 0.4 * moves_read or upright else units


def _of_two_worlds(bodies: Sequence[Trajectory]) -> tuple[Convention, Convention]:
    """Return the conventions with which motions of two bodies agree, each in its world."""
    lengths = [float(np.linalg.norm(np.ptp(np.percentile(body.position, (1, 99), axis=0), axis=0)))
               for body in bodies]
    units = [Convention(x > 100.0 * min(lengths) or min(lengths) > MAX_MOTION)
             for x in lengths]
    turns = [[lie.log_so3(R[len(R) // 2].T @ R) for R in (body.rotation, reordered(body.rotation))]
             for body in bodies]  # relative to the middle of the path
    alike = {(a, b): similarity(turns[0][a], turns[1][b])
             for a, b in ((0, 0), (1, 0), (0, 1))}
    a, b = max(alike, key=lambda order: alike[order])
    if alike[a, b] < MIN_SIMILARITY or (
            1.0 - alike[a, b] > MAX_DIFFERENCE_RATIO * (1.0 - alike[0, 0])):
        a = b = 0
    return units[0]._replace(w_first=bool(a)), units[1]._replace(w_first=bool(b))


def similarity(first: Array, second: Array) -> float:
    """Return the correlation of vectors (N, 3) up to a rotation between them, 1 if equal."""
    U, sizes, V = np.linalg.svd(first.T @ second)
    sizes[2] *= np.sign(np.linalg.det(U @ V))
    return float(sizes.sum() / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-12))


def _is_on_cup(bodies: Sequence[Trajectory], units: tuple[Convention, Convention]) -> bool:
    """Return whether the distance of the bodies is plausible for a cup, in given units."""
    distance, change = distance_of(bodies, units)
    return MIN_REACH < distance < MAX_REACH and change < MAX_CHANGE


def distance_of(
    bodies: Sequence[Trajectory], units: tuple[Convention, Convention]
) -> tuple[float, float]:
    """Return the median distance of the bodies, m, and its relative variation."""
    tool, package = map(converted, bodies, units)
    distance = np.linalg.norm(package.position - tool.position, axis=1)
    low, middle, high = np.percentile(distance, (25, 50, 75))
    return float(middle), float((high - low) / max(middle, 1e-12))


def motion_in_tool(
    bodies: Sequence[Trajectory], given: tuple[Convention, Convention]
) -> tuple[float, float]:
    """
    Return the motion of the package in the tool, and its misalignment with the tool's z axis.

    The motion is a rotation (rad) plus a path in units of the distance, the misalignment a sum of
    two deviations of cosines from 1.
    """
    tool, package = map(converted, bodies, given)
    back = np.swapaxes(tool.rotation, 1, 2)
    offset, turned = lie.apply(back, package.position - tool.position), back @ package.rotation
    offset = offset / np.median(np.linalg.norm(offset, axis=1))
    rotation = lie.log_so3(turned[len(turned) // 2].T @ turned)
    return (spread(offset) + spread(rotation),
            2.0 + float(np.mean(offset[:, 2]) - np.mean(turned[:, 2, 2])))


def spread(values: Array) -> float:
    """Return the norm of the interquartile ranges of values (N, 3)."""
    return float(np.linalg.norm(np.subtract(*np.percentile(values, (75, 25), axis=0))))
