"""
A tracked body, measured by its pose.

The residual of a view is the difference of the measured and the simulated pose of B: shift and
rotation in body axes, as of `pose_error`. The nuisances of the sensor are the frames (com, world,
marker), the scale and the clocks.
"""

from collections.abc import Mapping
from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, Trajectory
import numpy as np

Nuisances = Mapping[str, Array]
"""Values of nuisances by name, SI units."""

Context = tuple[Array, Array, Array | float]
"""Components (3,) of the com that shift B, middle (4,) and camera (3,): see `poses_of`."""

EXPOSURE = 1.0 / 30.0
"""Exposure (s) of a quantity `exposure` of 1, its square: the longest of a common camera."""

CLOCKS = 'time_offset', 'clock_rate'
"""Nuisances whose derivatives are in units of the twist."""


def columns_of(
    poses: Trajectory, values: Nuisances, places: Mapping[str, Places], count: int,
    context: Context,
    scaled: Trajectory,
) -> Array:
    """
    Return the negative derivatives (N, 6, p) of the poses of B by p unknowns.

    The derivative by the scale uses positions of other poses, without the noise of the measured
    poses, which would bias the scale towards zero.
    """
    columns = np.zeros((len(poses), 6, count))
    for name, place in places.items():
        known = scaled if name == 'scale' else poses
        columns[:, :, place] = -pose_changes(name, len(place), known, values, *context)
    return columns


def poses_of(
    package: Trajectory, values: Nuisances, moves: Array, middle: Array | None = None,
    camera: Array | float = 0.0,
) -> Trajectory:
    """
    Return the poses of B, and twists if any, for given free quantities.

    Moves (3,) is 1 for the components of the com that shift B, else 0. The world rotates about the
    mean position of the poses, or a given point. Positions are scaled about a camera (3,).
    """
    if 'scale' in values:
        package = replace(
            package, position=package.position + values['scale'] * (package.position - camera))
    if 'package_world' in values:
        middle = middle_of(package) if middle is None else middle
        R = lie.exp_so3(values['package_world'][3:])
        package = replace(
            package, position=middle[:3] + values['package_world'][:3] + lie.apply(
                R, package.position - middle[:3]), rotation=R @ package.rotation)
    if 'com' in values:
        package = of_fixed_frame(package, np.zeros(3), moves * values['com'])
    if 'package_marker' in values:
        shift, rotation = np.split(values['package_marker'], 2)
        package = of_fixed_frame(package, rotation, shift)
    return package


def of_fixed_frame(motion: Trajectory, rotation: Array, shift: Array) -> Trajectory:
    """Return the motion of a frame with a fixed rotation (rad) and position (m) in a body."""
    return at_tip(motion, lie.transform(lie.exp_so3(rotation), shift))


def middle_of(package: Trajectory) -> Array:
    """Return the mean (3,) of the valid positions (m), and their first stamp (s)."""
    used = package.select(package.valid)
    return np.append(used.position.mean(axis=0), used.stamps_ns[0] / NS_PER_S)


def pose_changes(
    name: str, size: int, package: Trajectory, values: Nuisances, moves: Array, middle: Array,
    camera: Array | float = 0.0,
) -> Array:
    """
    Return the derivatives of poses (M, 6, size) by a nuisance at its value, in body axes.

    Derivatives by offset and rate of the clocks are in units of the twist.
    """
    change = np.zeros((len(package), 6, size))
    world, marker = (values.get(each, np.zeros(6)) for each in ('package_world', 'package_marker'))
    R_after_before = lie.exp_so3(-marker[3:])
    if name == 'com':
        change[:, :3] = R_after_before * moves
    elif name == 'time_offset':
        change -= 1.0
    elif name == 'clock_rate':
        change -= (package.stamps_ns / NS_PER_S - middle[3])[:, None, None]
    elif name == 'scale':  # of smooth poses
        camera = middle[:3] + world[:3] + lie.exp_so3(world[3:]) @ (camera - middle[:3])
        change[:, :3, 0] = lie.apply(
            np.swapaxes(package.rotation, 1, 2), package.position - camera) / (
            1.0 + values.get('scale', np.zeros(1)))
    elif name == 'package_marker':
        change[:, :3, :3], change[:, 3:, 3:] = R_after_before, lie.dexp(-marker[3:])
    elif name == 'package_world':
        inverse = np.swapaxes(package.rotation, 1, 2)
        change[:, :3, :3] = change[:, 3:, 3:] = inverse
        change[:, :3, 3:] = -inverse @ lie.hat(package.position - middle[:3] - world[:3])
        change[:, :, 3:] = change[:, :, 3:] @ lie.dexp(world[3:])
    return change
