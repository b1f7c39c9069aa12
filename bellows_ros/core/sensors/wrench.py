"""
A force-torque sensor between flange and cup, with its frame F fixed in the tool.

Its wrench is `(1 + k) s [-X(S_H_F)^T f_S + Y phi] + b`: the wrench f_S of the cup on the package,
the weight and the inertia of the gripper between sensor and cup with its ten inertial numbers phi
(mass, first moments, moments of inertia xx, yy, zz, xy, xz, yz at F), a gain error k, a bias b and
a sign s, +1 for a sensor that shows the load on it. Derivatives are by the error of the package in
body axes, as in `core.model.jacobians`.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector
from bellows_ros.core.model import jacobians as jac
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import ModelTuple, ORIGIN, State, Wrench
from bellows_ros.core.model.simulation import row_state
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

Mount = tuple[Vector, Matrix, float]
"""Position (m) and axes of F in the tool, and the sign s."""

Twist = tuple[Vector, Vector]
"""Velocity and angular velocity, or their derivatives, in axes of the tool."""

INERTIAL_NUMBERS = 10
"""Number of inertial numbers of the gripper."""

BLOCK_NS = 62_500_000
"""Longest block of averaged wrenches, ns: the low pass has its first zero at 16 Hz, -3 dB at
7 Hz."""

GAIN_STD = 0.01
"""Relative standard deviation of a sensor's gain: the usual 1 % of data sheets."""

GRIPPER_STD = 0.02
"""Relative standard deviation of a gripper's mass, first moments and inertia from CAD, with hoses
and screws left out."""


class WrenchSensor(NamedTuple):
    """Settings of a sensor, SI units; pairs are of force and moment."""

    mount: Mount
    noise: tuple[float, float]
    """Standard deviation of a sample."""
    drift: tuple[float, float]
    """Random walk of the bias in 1 s."""
    bias_std: tuple[float, float]
    delay_ns: int
    gripper: tuple[float, ...]
    """Inertial numbers phi (10,)."""
    gripper_std: tuple[float, ...]
    """Standard deviations of phi (10,)."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> WrenchSensor:
        """Return the sensor of the parameters wrench.* and gripper.*."""
        pose = np.array([float(part) for part in values['wrench.frame'].split()])
        (x, y, z), R = pose[:3].tolist(), kernels.matrix_of(
            lie.quaternion_to_rotation(pose[3:]).ravel().tolist())
        phi = inertial_numbers(values['gripper.mass'], *(
            np.array(values[f'gripper.{name}']) for name in ('com', 'inertia')))
        noise, drift, bias = ((a, b) for a, b in (
            values[f'wrench.{name}'] for name in ('noise', 'drift', 'bias_std')))
        return cls(
            ((x, y, z), R, 1.0 if values['wrench.sign'] == 'load' else -1.0), noise, drift, bias,
            round(NS_PER_S * values['wrench.delay']), phi,
            tuple(np.repeat(GRIPPER_STD * sizes_of(np.array(phi)), (1, 3, 6)).tolist()))


def sizes_of(phi: Array) -> Array:
    """Return the sizes (3,) of mass, first moments and inertia of inertial numbers (10,)."""
    return np.array([abs(phi[0]), np.linalg.norm(phi[1:4]), np.linalg.norm(phi[4:])])


def inertial_numbers(mass: float, com: Array, inertia: Array) -> tuple[float, ...]:
    """
    Return phi (10,) of a gripper from its mass (kg), com (3,) in F (m) and inertia at the com.

    The inertia (6,) is ixx, iyy, izz, ixy, ixz, iyz in axes of F, kg m^2.

    Raises
    ------
    BellowsError
        For a gripper without mass that has inertia.

    """
    if mass == 0.0 and (com.any() or inertia.any()):
        raise BellowsError(
            'gripper.com or gripper.inertia is given, but gripper.mass is 0. Set gripper.mass to '
            'the mass between sensor and cup.')
    x, y, z = com
    steiner = mass * np.array([y*y + z*z, x*x + z*z, x*x + y*y, -x*y, -x*z, -y*z])
    return (mass, *(mass * com).tolist(), *(inertia + steiner).tolist())


@kernel
def from_package(tool: State, body: State, mount: Mount) -> tuple[Matrix, Vector]:
    """Return F_R_B, and the position of B from the origin of F in B axes (m)."""
    R_A_E, R_A_B = t3.rotation_matrix(tool[1]), t3.rotation_matrix(body[1])
    R_A_F = t3.multiply(R_A_E, mount[1])
    arm = t3.subtract(t3.subtract(body[0], tool[0]), t3.apply(R_A_E, mount[0]))
    return t3.multiply_transposed(R_A_F, R_A_B), t3.apply_transposed(R_A_B, arm)


@entry
def cup_load(model: ModelTuple, tool: State, body: State, mount: Mount) -> Wrench:
    """Return the wrench of the cup on the sensor, -s X(S_H_F)^T f_S, in F axes (N, N m)."""
    f, m = kernels.wrench_at_com(model[1][1], *kernels.lip_wrench(model, tool, body))
    R, arm = from_package(tool, body, mount)
    return (t3.scale(-mount[2], t3.apply(R, f)),
            t3.scale(-mount[2], t3.apply(R, t3.add(m, t3.cross(arm, f)))))


@entry
def write_gripper_regressor(
    tool: State, acceleration: Twist, gravity: Vector, mount: Mount, Y: Any
) -> None:
    """
    Write s Y (6, 10): the wrench of the gripper on the sensor by its inertial numbers, F axes.

    Rows of force: [g - a, -(alpha^ + w^ w^), 0]; of moment: [0, -(g - a)^, -(L(alpha) + w^ L(w))],
    with the acceleration a of F's origin, and L(w) I = I w. The tool accelerates by the derivative
    of its twist (m/s^2, rad/s^2).
    """
    o, R, s = mount
    v, w = tool[2], tool[3]
    dv, dw = acceleration
    centre = t3.add(t3.add(dv, t3.cross(dw, o)), t3.cross(w, t3.add(v, t3.cross(w, o))))
    g = t3.apply_transposed(t3.rotation_matrix(tool[1]), gravity)
    pull = t3.scale(s, t3.apply_transposed(R, t3.subtract(g, centre)))
    alpha, w = t3.apply_transposed(R, dw), t3.apply_transposed(R, w)
    w_hat = t3.hat(w)
    turning = t3.add_scaled_matrix(t3.hat(alpha), 1.0, t3.multiply(w_hat, w_hat))
    jac.write_column(Y, 0, pull, t3.ZERO)
    jac.write_block(Y, 0, 1, t3.scale_matrix(-s, turning))
    jac.write_block(Y, 3, 1, t3.scale_matrix(-1.0, t3.hat(pull)))
    for k in range(6):
        of_rate, of_alpha = _times_unit_inertia(k, w), _times_unit_inertia(k, alpha)
        jac.write_column(
            Y, 4 + k, t3.ZERO, t3.scale(-s, t3.add(of_alpha, t3.cross(w, of_rate))))


@entry
def _write_gripper_regressors(
    tool: Array, accelerations: Array, gravity: Vector, mount: Mount, out: Array
) -> None:
    """Write s Y (M, 6, 10) under a moving tool (M, 13) with accelerations (M, 6)."""
    for k in range(len(tool)):
        a = accelerations[k]
        write_gripper_regressor(row_state(tool[k]), (
            (a[0], a[1], a[2]), (a[3], a[4], a[5])), gravity, mount, out[k])


def gripper_regressors(tool: Array, accelerations: Array, gravity: Array, mount: Mount) -> Array:
    """
    Return s Y (M, 6, 10) of a gripper under a moving tool (M, 13) with accelerations (M, 6).

    They are less those at the zero of the sensor: at rest, with z of the tool upwards.
    """
    out = np.zeros((len(tool), 6, INERTIAL_NUMBERS))
    x, y, z = gravity.tolist()
    _write_gripper_regressors(tool, accelerations, (x, y, z), mount, out)
    zero = np.zeros((6, INERTIAL_NUMBERS))
    write_gripper_regressor(
        ORIGIN, (t3.ZERO, t3.ZERO), (0.0, 0.0, -math.hypot(x, y, z)), mount, zero)
    return out - zero


@kernel
def _times_unit_inertia(k: int, w: Vector) -> Vector:
    """Return the product of a matrix of inertia, 1 in its entry k, and a vector."""
    if k < 3:
        return t3.unit(k, w[k])
    i, j = (0, 1) if k == 3 else (0, 2) if k == 4 else (1, 2)
    return t3.add(t3.unit(i, w[j]), t3.unit(j, w[i]))
