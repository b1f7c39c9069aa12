"""Limits of an arm with a package on the cup, and the part of each that a motion uses."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3, transform
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.planning.arm import Arm
from bellows_ros.core.planning.limits import largest_rates, read_rates
from bellows_ros.core.synthetic.motion import Motion, Pose, pose_from
import numpy as np
from scipy.interpolate import CubicSpline

CHECK_RATE, JOINT_RATE = 1000.0, 250.0
"""Rates (Hz) at which limits are checked, and at which joint positions are computed for that."""

BENDING, TORSION, MAX_FREQUENCY = math.radians(20.0), math.radians(30.0), 12.0
"""Defaults for real cups (rad; beyond 45 degrees the model's moment falls) and real arms (Hz)."""


class Bound(NamedTuple):
    """
    A limit (above 0) on the length of a linear function of the tool's displacement.

    `order` is how often the displacement (6: m in world axes, rotation vector in rad) is derived
    by time before the rows (d, 6) are applied.
    """

    name: str
    order: int
    rows: Array
    limit: float


class ArmLimits(NamedTuple):
    """
    Limits of an arm, SI units.

    Parameters
    ----------
    start : Pose
        Of E, at rest and amid the motion.
    lower, upper : array (3,)
        Corners of the workspace in the world, m.
    turn : array (3,)
        Largest components of the rotation vector from the start, rad.
    rates : mapping of str to float
        Largest speed, acceleration and jerk, and the angular ones, as in `motion_limits.RATES`.
    bending, torsion : float
        Of the cup, rad.
    safety : float
        Least safety factor of the grip.
    highest_frequency : float
        Of the motion, Hz.
    arm : Arm or None
        Its joints' ranges and speeds are limits, too.
    joints : array (M,)
        Positions of its moving joints at the start.

    """

    start: Pose
    lower: Array
    upper: Array
    turn: Array
    rates: Mapping[str, float]
    bending: float
    torsion: float
    safety: float
    highest_frequency: float
    arm: Arm | None
    joints: Array

    @property
    def axes(self) -> Array:
        """Return the map (6, 6) from displacements of the tool to its axes at the start."""
        turned = np.eye(6)
        turned[:3, :3] = self.start.rotation.T
        return turned

    def bounds(self) -> list[Bound]:
        """Return the limits on the tool, those of joints for small motions."""
        eye, start = np.eye(6), self.start.position
        headroom = np.concatenate(
            [np.minimum(self.upper - start, start - self.lower), self.turn]).tolist()
        bounds = [Bound('workspace' if i < 3 else 'rotation', 0, eye[i:i + 1], headroom[i])
                  for i in range(6)]
        for i, (name, limit) in enumerate(self.rates.items()):
            part = slice(3) if i < 3 else slice(3, 6)
            bounds.append(Bound(name.replace('_', ' '), 1 + i % 3, eye[part], limit))
        if self.arm is not None:
            rows = np.linalg.pinv(self.arm.jacobian(self.joints[None])[0], rcond=1e-3) @ self.axes
            for joint, row, at in zip(self.arm.moving_joints, rows, self.joints, strict=True):
                ends = min(joint.upper - at, at - joint.lower)
                bounds += [
                    Bound(f'{joint.name} {what}', order, row[None], float(limit))
                    for what, order, limit in (('range', 0, ends), ('speed', 1, joint.speed))
                    if math.isfinite(limit)]
        return bounds

    def ratios(self, motion: Motion) -> dict[str, float]:
        """Return the largest part of each limit that a motion takes, at `CHECK_RATE`."""
        tool = motion.at_rate(CHECK_RATE)
        o, R = tool.position, tool.rotation
        shift, turn = o - self.start.position, log_so3(self.start.rotation.T @ R)
        headroom = np.where(shift > 0.0, self.upper - self.start.position,
                            self.start.position - self.lower)
        ratios = {'workspace': np.abs(shift / headroom).max(),
                  'rotation': np.abs(turn / self.turn).max()}
        for name, peak in largest_rates(R, np.asarray(tool.twist), 1.0 / CHECK_RATE).items():
            ratios[name.replace('_', ' ')] = peak / self.rates[name]
        if self.arm is not None:
            coarse = slice(None, None, round(CHECK_RATE / JOINT_RATE))
            joints = self.arm.positions(transform(R[coarse], o[coarse]), self.joints)
            spline = CubicSpline(tool.seconds[coarse], joints)
            q, speed = spline(tool.seconds), spline(tool.seconds, 1)
            for joint, at, position, rate in zip(
                    self.arm.moving_joints, self.joints, q.T, speed.T, strict=True):
                headroom = np.where(position > at, joint.upper - at, at - joint.lower)
                ratios[f'{joint.name} range'] = np.abs((position - at) / headroom).max()
                ratios[f'{joint.name} speed'] = np.abs(rate).max() / joint.speed
        return {name: float(ratio) for name, ratio in ratios.items()}


def limits_from(
    content: Mapping[str, Any], safety: float, arm: Arm | None = None
) -> tuple[ArmLimits, Settings]:
    """
    Return the limits in a file, and how both bodies are tracked, which is read elsewhere.

    Parameters
    ----------
    content : mapping
        As config/limits_example.yaml explains it.
    safety : float
        Least safety factor of the grip where the file gives none.
    arm : Arm, optional
        Whose `joints` at the start are given instead of `start`.

    Raises
    ------
    BellowsError
        If a setting is missing, unknown or not allowed, or the start is outside of the limits.

    """
    settings = Settings(content)
    joints = np.zeros(0)
    if arm is None:
        start = pose_from(settings.block('start'))
    else:
        block = settings.block('joints')
        joints = np.array([block.number(name, unit='rad or m') for name in arm.moving])
        for joint, at in zip(arm.moving_joints, joints.tolist(), strict=True):
            if not joint.lower < at < joint.upper:
                raise block.refuse(joint.name, f'in its range, {joint.lower:g} to '
                                   f'{joint.upper:g}', at)
        T = arm.tool(joints[None])[0][0]
        start = Pose(T[:3, 3], T[:3, :3])
    space = settings.block('workspace')
    turn, box = space.vector('rotation', 3, unit='rad'), settings.block('excitation')
    lower, upper = (
        box.vector(name, 3, tuple(space.vector(name, 3, unit='m')), 'm')
        for name in ('lower', 'upper'))
    if not ((lower < start.position) & (start.position < upper)).all() or turn.min() <= 0.0:
        raise settings.error(
            'workspace', f"The start {start.position.tolist()} m is not inside of 'workspace' or "
            f"'excitation' ({lower.tolist()} to {upper.tolist()} m), or 'workspace.rotation' is "
            'not above 0. Move the start or widen the box.')
    limits = ArmLimits(
        start, lower, upper, turn, read_rates(settings),
        settings.number('bending', BENDING, 'rad', above=0.0, maximum=0.5 * math.pi),
        settings.number('torsion', TORSION, 'rad', above=0.0, maximum=0.5 * math.pi),
        settings.number('safety_factor', safety, minimum=0.0),
        settings.number('highest_frequency', MAX_FREQUENCY, 'Hz', above=0.0, maximum=50.0),
        arm, joints)
    tracking = settings.block('tracking')
    settings.done(ignored=('tracking', 'joint_acceleration'))
    return limits, tracking
