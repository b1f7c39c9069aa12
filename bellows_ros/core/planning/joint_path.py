"""Motion of an arm's joints along a path of its tool: inverse kinematics with rates and limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import apply, transform
from bellows_ros.core.planning.arm import Arm
from bellows_ros.core.planning.points import quintic
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

SMALLEST_GAIN = 0.01
"""A pose is singular where a unit speed of the joints (rad/s, m/s) moves the tool less in some
direction, m/s or rad/s."""

LARGEST_JUMP = 0.5
"""Largest step of a joint between points, rad or m: more is another configuration."""

LARGEST_JOINT_STEP = 0.01
"""Largest time between points of a motion of joints, s, however few the request had."""

CHECK_RATE = 1000.0
"""Rate at which limits are checked between the points, Hz."""


class JointPath(NamedTuple):
    """Motion of an arm's moving joints: (N,) s, then (N, M) rad or m, and per s and s^2."""

    seconds: Array
    position: Array
    velocity: Array
    acceleration: Array


def joint_path(arm: Arm, tool: Trajectory, near: Array) -> JointPath:
    """
    Return the motion of the joints that moves the tool along a path.

    Parameters
    ----------
    arm : Arm
        Tool poses are those of its tool link in its root.
    tool : Trajectory
        N points with body twists.
    near : array (N, M)
        Joint positions of a motion close by: the solution in the same configuration is taken,
        and of a redundant arm the one that is nearest.

    Raises
    ------
    BellowsError
        If a point is out of reach or singular, or the arm would have to change its
        configuration; with the time.

    """
    from scipy.interpolate import CubicSpline  # late: the predictor starts without

    seconds = tool.seconds
    position = arm.positions(transform(tool.rotation, tool.position), near)
    J = arm.jacobian(position)
    gains = np.linalg.svd(J, compute_uv=False)[:, -1]
    if (worst := int(np.argmin(gains))) >= 0 and gains[worst] < SMALLEST_GAIN:
        raise BellowsError(
            f'The arm is singular at {seconds[worst]:.3f} s: a joint speed of 1 rad/s moves the '
            f'tool by {gains[worst]:.2g} m/s or rad/s in some direction, expected at least '
            f'{SMALLEST_GAIN:g}. Start in another configuration, or move the path.')
    jumps = np.abs(np.diff(position, axis=0)).max(axis=1)
    if (worst := int(np.argmax(jumps))) >= 0 and jumps[worst] > LARGEST_JUMP:
        raise BellowsError(
            f'The arm changes its configuration at {seconds[worst]:.3f} s: a joint moves by '
            f'{jumps[worst]:.2g} rad or m between two points, expected at most {LARGEST_JUMP:g}. '
            'Start in another configuration, or give more points.')
    slope = CubicSpline(seconds, position)(seconds, 1)
    missing = np.asarray(tool.twist) - apply(J, slope)
    velocity = np.asarray(slope + (np.linalg.pinv(J) @ missing[..., None])[..., 0])
    return JointPath(
        seconds, position, velocity, CubicSpline(seconds, velocity)(seconds, 1))


def joint_excess(arm: Arm, path: JointPath, acceleration: float) -> tuple[float, str]:
    """
    Return the factor on time that the limits of the joints need at least, and the limit.

    Parameters
    ----------
    arm : Arm
        With ranges and speeds of its joints.
    path : JointPath
        Driven along quintic polynomials, as drivers do; checked at `CHECK_RATE`.
    acceleration : float
        Largest of each joint, rad/s^2 or m/s^2.

    Raises
    ------
    BellowsError
        If a joint leaves its range, which no other speed can mend.

    """
    curve = quintic(*path)
    count = max(2, int(np.ceil(path.seconds[-1] * CHECK_RATE)) + 1)
    at = np.linspace(0.0, path.seconds[-1], count)
    position = curve(at)
    found = [(1.0, '')]
    for i, joint in enumerate(arm.moving_joints):
        low, high = (int(np.argmin(position[:, i])), int(np.argmax(position[:, i])))
        for k in (low, high):
            if not joint.lower <= position[k, i] <= joint.upper:
                raise BellowsError(
                    f"Joint '{joint.name}' would be at {position[k, i]:.4g} at {at[k]:.3f} s; its "
                    f'range is {joint.lower:.4g} to {joint.upper:.4g} (rad or m). Start in '
                    'another configuration, or move the path.')
    for order, name, limits in (
            (1, 'speed', [joint.speed for joint in arm.moving_joints]),
            (2, 'acceleration', [acceleration] * len(arm.moving_joints))):
        asked = np.abs(curve(at, order)).max(axis=0) / limits
        worst = int(np.argmax(asked))
        if asked[worst] > 1.0:
            found.append((
                float(asked[worst]) ** (1.0 / order), f'{arm.moving[worst]} {name}'))
    return max(found)


@dataclass(frozen=True, eq=False)
class Joints:
    """
    Joint positions of a plan of an arm's joints.

    Parameters
    ----------
    arm : Arm
    stamps_ns : int array (N,)
        ns.
    position : array (N, M)
        Of the moving joints in their order, rad or m.

    """

    arm: Arm
    stamps_ns: Stamps
    position: Array

    def along(self, tool: Trajectory, planned: Trajectory) -> JointPath:
        """
        Return the motion of the same joints that moves the tool as given.

        Its points are points of the tool, about as dense as the plan's, or as
        `LARGEST_JOINT_STEP` where the plan's are further apart.

        Parameters
        ----------
        tool : Trajectory
            To follow, of the tool link in the arm's root.
        planned : Trajectory
            The tool by the plan: joints at the same part of its time tell the configuration.

        Raises
        ------
        BellowsError
            As `joint_path`.

        """
        from scipy.interpolate import CubicSpline  # late: the predictor starts without

        step = min(float(np.median(np.diff(self.stamps_ns))) / NS_PER_S, LARGEST_JOINT_STEP)
        every = max(1, round(step / float(np.median(np.diff(tool.seconds)))))
        rows = np.arange(0, len(tool), every)
        rows[-1] = len(tool) - 1  # at rest, where the plan ends at rest
        points = tool.select(np.isin(np.arange(len(tool)), rows))
        part = points.seconds / points.seconds[-1]
        since, until = (int(stamp - self.stamps_ns[0]) for stamp in planned.stamps_ns[[0, -1]])
        near = CubicSpline(self.stamps_ns - self.stamps_ns[0], self.position)
        return joint_path(self.arm, points, near(since + part * (until - since)))
