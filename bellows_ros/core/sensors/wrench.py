"""
A force-torque sensor between flange and cup, with its frame F fixed in the tool.

Its wrench is `(1 + k) s [-X(S_H_F)^T f_S + g_F] + b`: the wrench f_S of the cup on the package,
weight and inertia g_F of the gripper between sensor and cup, a gain error k, a bias b and a sign
s, +1 for a sensor that shows the load on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Wrench
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

Mount = tuple[Vector, Matrix, float]
"""Position (m) and axes of F in the tool, and the sign s."""

Gripper = tuple[float, Vector, Matrix]
"""Mass (kg), mass times com (kg m) and inertia (kg m^2) between sensor and cup, in F."""

Twist = tuple[Vector, Vector]
"""Velocity and angular velocity, or their derivatives, in axes of the tool."""

BLOCK_NS = 62_500_000
"""Longest block of averaged wrenches, ns: the low pass has its first zero at 16 Hz, -3 dB at
7 Hz."""

SAMPLE_NOISE = (0.1, 0.005)
"""Standard deviation of a sample by data sheets, N and N m; a larger one is estimated."""

GAIN_STD = 0.01
"""Relative standard deviation of a sensor's gain: the usual 1 % of data sheets."""


class WrenchSensor(NamedTuple):
    """Settings of a sensor, SI units; pairs are of force and moment."""

    mount: Mount
    bias_std: tuple[float, float]
    delay_ns: int
    gripper: Gripper

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> WrenchSensor:
        """Return the sensor of the parameters wrench.* and gripper.*."""
        pose = np.array([float(part) for part in values['wrench.frame'].split()])
        (x, y, z), R = pose[:3].tolist(), kernels.matrix_of(
            lie.quaternion_to_rotation(pose[3:]).ravel().tolist())
        return cls(
            ((x, y, z), R, 1.0 if values['wrench.sign'] == 'load' else -1.0),
            values['wrench.bias_std'], round(NS_PER_S * values['wrench.delay']),
            gripper_at_sensor(values['gripper.mass'], np.array(values['gripper.com'])))


def gripper_at_sensor(mass: float, com: Array) -> Gripper:
    """
    Return a gripper from its mass (kg) and com (3,) in F (m), with the inertia of a point.

    Raises
    ------
    BellowsError
        For a centre of mass without a mass.

    """
    if mass == 0.0 and com.any():
        raise BellowsError(
            'gripper.com is given, but gripper.mass is 0. Set gripper.mass to the mass between '
            'sensor and cup.')
    x, y, z = (mass * com).tolist()
    at_sensor = mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, (x, y, z), kernels.matrix_of(at_sensor.ravel().tolist())


@entry
def cup_load(model: ModelTuple, tool: State, body: State, mount: Mount) -> Wrench:
    """Return the wrench of the cup on the sensor, -s X(S_H_F)^T f_S, in F axes (N, N m)."""
    f, m = kernels.wrench_at_com(model[1][1], *kernels.lip_wrench(model, tool, body))
    R_A_E, R_A_B = t3.rotation_matrix(tool[1]), t3.rotation_matrix(body[1])
    R = t3.multiply_transposed(t3.multiply(R_A_E, mount[1]), R_A_B)
    arm = t3.subtract(t3.subtract(body[0], tool[0]), t3.apply(R_A_E, mount[0]))
    m = t3.add(m, t3.cross(t3.apply_transposed(R_A_B, arm), f))
    return t3.scale(-mount[2], t3.apply(R, f)), t3.scale(-mount[2], t3.apply(R, m))


@kernel
def load_of_gripper(
    tool: State, acceleration: Twist, gravity: Vector, mount: Mount, gripper: Gripper
) -> Wrench:
    """
    Return the wrench of a gripper on the sensor, s g_F, in F axes (N, N m).

    With the acceleration a of F's origin, the force is m (g - a) - alpha x h - w x (w x h), and
    the moment h x (g - a) - I alpha - w x I w. The tool accelerates by the derivative of its twist
    (m/s^2, rad/s^2).
    """
    (o, R, s), (mass, h, inertia) = mount, gripper
    v, w = tool[2], tool[3]
    dv, dw = acceleration
    centre = t3.add(t3.add(dv, t3.cross(dw, o)), t3.cross(w, t3.add(v, t3.cross(w, o))))
    g = t3.apply_transposed(t3.rotation_matrix(tool[1]), gravity)
    pull = t3.apply_transposed(R, t3.subtract(g, centre))
    alpha, w = t3.apply_transposed(R, dw), t3.apply_transposed(R, w)
    by_rate = t3.add(t3.cross(alpha, h), t3.cross(w, t3.cross(w, h)))
    by_inertia = t3.add(t3.apply(inertia, alpha), t3.cross(w, t3.apply(inertia, w)))
    return (t3.scale(s, t3.subtract(t3.scale(mass, pull), by_rate)),
            t3.scale(s, t3.subtract(t3.cross(h, pull), by_inertia)))


@entry
def gripper_load(
    tool: State, acceleration: Twist, gravity: Vector, mount: Mount, gripper: Gripper
) -> tuple[Wrench, Wrench]:
    """Return `load_of_gripper`, and the load that the sensor was zeroed with."""
    down = 0.0, 0.0, -t3.norm(gravity)
    return (load_of_gripper(tool, acceleration, gravity, mount, gripper),
            load_of_gripper(ORIGIN, (t3.ZERO, t3.ZERO), down, mount, gripper))
