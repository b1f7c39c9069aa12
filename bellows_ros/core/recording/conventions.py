"""
Wrong units and orders of quaternions of recorded poses.

Each is a correction of one body or of both, after which the package moves least in its tool.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.signals.trajectory import Trajectory
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

MIN_UNIT_RATIO = 100.0
"""Smallest ratio of the paths of two bodies in two units, between 1 and 1000."""

MAX_MISFIT_RATIO = 0.4
"""Largest ratio of relative motion after and before the correction of a convention."""

SIMPLER = 0.9
"""Ratio of misfits below which a later candidate replaces an earlier one."""

UPRIGHT = 0.2
"""Largest misalignment of a package that hangs below its tool, a sum of two cosines from 1: 36
degrees of one of the two."""

TILTED = 0.5
"""Smallest misalignment for which another order of quaternions is tested; 60 degrees of one
body."""

Bodies = tuple[Trajectory, Trajectory]

Change = Callable[[Trajectory], Trajectory]

WRONG = {'package': (False, True), 'tool': (True, False), 'both': (True, True)}
"""Whether tool and package are wrong, by the name of the body."""


def reordered(rotation: Array) -> Array:
    """Return rotations (N, 3, 3) of quaternions stored with w first but read with w last."""
    return lie.quaternion_to_rotation(np.roll(lie.rotation_to_quaternion(rotation), -1, axis=-1))


def w_last(body: Trajectory) -> Trajectory:
    """Return poses from poses of quaternions with w first."""
    return replace(body, rotation=reordered(body.rotation))


def in_metres(body: Trajectory) -> Trajectory:
    """Return poses from poses in millimetres."""
    return replace(body, position=1e-3 * body.position)


def changed(bodies: Bodies, wrong: Sequence[bool], change: Change) -> Bodies:
    """Return both bodies, the wrong ones changed."""
    tool, package = (change(body) if is_wrong else body
                     for body, is_wrong in zip(bodies, wrong, strict=True))
    return tool, package


def units_of(bodies: Bodies, one_frame: bool) -> tuple[bool, bool]:
    """Return whether tool and package are in millimetres."""
    if not one_frame:
        tool, package = (float(np.linalg.norm(np.ptp(np.percentile(
            body.position, (1, 99), axis=0), axis=0))) for body in bodies)
        least = min(tool, package)
        return (tool > MIN_UNIT_RATIO * least or least > MAX_MOTION,
                package > MIN_UNIT_RATIO * least or least > MAX_MOTION)
    if distance_of(bodies)[0] <= MAX_DISTANCE:
        return False, False
    tried = [((a, b), changed(bodies, (a, b), in_metres))
             for a, b in product((False, True), repeat=2)]
    return min(((distance_of(both)[1], wrong) for wrong, both in tried if is_on_cup(both)),
               default=(0.0, (False, False)))[1]


def wrong_order(bodies: Bodies) -> str:
    """Return the body with w first in its quaternions, 'both', or '' for none."""
    before, found, least = misfit(bodies), '', float('inf')
    for body, wrong in WRONG.items():
        both = changed(bodies, wrong, w_last)
        own = misfit(both)
        is_less = own < MAX_MISFIT_RATIO * before or _is_righted(bodies, both)
        if is_less and own < SIMPLER * least:
            found, least = body, own
    return found


def _is_righted(before: Bodies, after: Bodies) -> bool:
    """Return whether a package hangs below its tool only after a correction, and moves less."""
    (moved, tilted), (moves, tilt) = (motion_in_tool(both) for both in (before, after))
    return is_on_cup(before) and moves < moved and tilt < UPRIGHT and TILTED < tilted


def is_on_cup(bodies: Bodies) -> bool:
    """Return whether the distance of the bodies is plausible for a cup."""
    distance, change = distance_of(bodies)
    return MIN_REACH < distance < MAX_REACH and change < MAX_CHANGE


def distance_of(bodies: Bodies) -> tuple[float, float]:
    """Return the median distance of the bodies, m, and its relative variation."""
    tool, package = bodies
    distance = np.linalg.norm(package.position - tool.position, axis=1)
    low, middle, high = np.percentile(distance, (25, 50, 75))
    return float(middle), float((high - low) / max(middle, 1e-12))


def misfit(bodies: Bodies) -> float:
    """Return the relative motion (1, rad) of a package in its tool; infinite if too distant."""
    distance, change = distance_of(bodies)
    if not (1e-3 < distance < MAX_REACH and change < MAX_CHANGE):
        return float('inf')
    tool, package = bodies
    offset = lie.apply(np.swapaxes(tool.rotation, 1, 2), package.position - tool.position)
    hangs = np.median(offset[:, 2]) < 0.0
    return (1.0 if hangs else 1.0 / SIMPLER**2) * motion_in_tool(bodies)[0]


def motion_in_tool(bodies: Bodies) -> tuple[float, float]:
    """
    Return the motion of the package in the tool, and its misalignment with the tool's z axis.

    The motion is a rotation (rad) plus a path in units of the distance, the misalignment a sum of
    two deviations of cosines from 1.
    """
    tool, package = bodies
    back = np.swapaxes(tool.rotation, 1, 2)
    offset, turned = lie.apply(back, package.position - tool.position), back @ package.rotation
    offset = offset / max(float(np.median(np.linalg.norm(offset, axis=1))), 1e-12)
    rotation = lie.log_so3(turned[len(turned) // 2].T @ turned)
    return (spread(offset) + spread(rotation),
            2.0 + float(np.mean(offset[:, 2]) - np.mean(turned[:, 2, 2])))


def spread(values: Array) -> float:
    """Return the norm of the interquartile ranges of values (N, 3)."""
    return float(np.linalg.norm(np.subtract(*np.percentile(values, (75, 25), axis=0))))
