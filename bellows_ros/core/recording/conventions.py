"""
The distance of a package on a cup from its tool, and wrong orders of quaternions.

With w first in one body's quaternions, or in both, the package moves widely in its tool; read with
w last, it moves least.
"""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

MAX_MOTION = 20.0
"""Largest motion of a body, m: a larger one is in millimetres."""

MIN_REACH = 1e-3
"""Smallest distance of a package on a cup from the tool, m; nearer ones are of one body."""

MAX_REACH = 0.5
"""Largest distance of a package on a cup from the tool, m: a long cup and half a box."""

MAX_CHANGE = 0.25
"""Largest relative variation of this distance: a cup stretched by a quarter."""

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

WRONG = {'package': (False, True), 'tool': (True, False), 'both': (True, True)}
"""Whether tool and package are wrong, by the name of the body."""


def in_millimetres(body: Trajectory) -> bool:
    """Return whether a body moves so far that its positions are in millimetres."""
    low, high = np.percentile(body.position, (1, 99), axis=0)
    return bool(np.linalg.norm(high - low) > MAX_MOTION)


def w_last(body: Trajectory) -> Trajectory:
    """Return poses from poses of quaternions with w first."""
    q = np.roll(lie.rotation_to_quaternion(body.rotation), -1, axis=-1)
    return replace(body, rotation=lie.quaternion_to_rotation(q))


def wrong_order(bodies: Bodies) -> str:
    """Return the body with w first in its quaternions, 'both', or '' for none."""
    distance, change = distance_of(bodies)
    if not (MIN_REACH < distance < MAX_REACH and change < MAX_CHANGE):
        return ''
    moved, tilted = motion_in_tool(*bodies)
    found, least = '', float('inf')
    for body, wrong in WRONG.items():
        moves, tilt = motion_in_tool(*(w_last(each) if is_wrong else each
                                       for each, is_wrong in zip(bodies, wrong, strict=True)))
        is_righted = moves < moved and tilt < UPRIGHT and TILTED < tilted
        if (is_righted or moves < MAX_MISFIT_RATIO * moved) and moves < SIMPLER * least:
            found, least = body, moves
    return found


def distance_of(bodies: Bodies) -> tuple[float, float]:
    """Return the median distance of the bodies, m, and its relative variation."""
    tool, package = bodies
    distance = np.linalg.norm(package.position - tool.position, axis=1)
    low, middle, high = np.percentile(distance, (25, 50, 75))
    return float(middle), float((high - low) / max(middle, 1e-12))


def motion_in_tool(tool: Trajectory, package: Trajectory) -> tuple[float, float]:
    """
    Return the motion of the package in the tool, and its misalignment with the tool's z axis.

    The motion is a rotation (rad) plus a path in units of the distance, the misalignment a sum of
    two deviations of cosines from 1.
    """
    back = np.swapaxes(tool.rotation, 1, 2)
    offset, turned = lie.apply(back, package.position - tool.position), back @ package.rotation
    offset = offset / max(float(np.median(np.linalg.norm(offset, axis=1))), 1e-12)
    rotation = lie.log_so3(turned[len(turned) // 2].T @ turned)
    return (sum(float(np.linalg.norm(np.subtract(*np.percentile(values, (75, 25), axis=0))))
                for values in (offset, rotation)),
            2.0 + float(np.mean(offset[:, 2]) - np.mean(turned[:, 2, 2])))
