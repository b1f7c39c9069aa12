"""A cup and its package for MuJoCo (MJCF): six joints in the middle of the cup."""

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import Cup, LAW, Package
import numpy as np

JOINT = '<joint name="cup_{}_{}" type="{}" axis="{}" stiffness="{!r}" damping="{!r}"/>'
MODEL = """\
<mujoco model="bellows_cup">
  <!-- Put the body "tool" at the end of the arm, and move it with joints, as a mocap body has no
       velocity. The springs are linear along the axes of the tool, rotations follow each other:
       natural frequencies are right to 1.5 % if the weight bends the cup by up to 6 degrees. -->
  <compiler angle="radian" balanceinertia="false"/>
  <option timestep="0.0005" integrator="RK4" gravity="{gravity}"/>
  <worldbody>
    <body name="tool" pos="0 0 1">
      <site name="E"/>
      <body name="package" pos="0 0 {middle!r}">
        {joints}
        <inertial pos="{com}" mass="{mass!r}" fullinertia="{inertia}"/>
        <site name="S" pos="0 0 {middle!r}"/>
        <site name="B" pos="{com}"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def mjcf(cup: Cup, package: Package, gravity: Array) -> tuple[str, list[str]]:
    """
    Return the model in MJCF, and the properties of the cup that the joints lack.

    The joints have the diagonals of K and P, about axes of the tool through the middle of the cup.

    Parameters
    ----------
    cup, package
        Cup and package.
    gravity : array (3,)
        In the world, m/s^2.

    """
    middle, K, P = -cup.length / 2.0, cup.stiffness, cup.damping
    joints = [
        JOINT.format(kind, axis, kind, _row(row), float(K[i, i]), float(P[i, i]))
        for i, (kind, axis, row) in enumerate(
            (kind, *each) for kind in ('slide', 'hinge')
            for each in zip('xyz', np.eye(3, dtype=int), strict=True))]
    lacking = [f'off-diagonal entries of {name}' for name, matrix in (('K', K), ('P', P))
               if np.any(matrix != np.diag(np.diag(matrix)))]
    lacking += [term.parameter for term in LAW.values() if any(getattr(cup, term.name))]
    return MODEL.format(
        gravity=_row(gravity), middle=middle, joints='\n        '.join(joints), mass=package.mass,
        com=_row(package.com + [0.0, 0.0, middle]),
        inertia=_row(package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])), lacking


def _row(numbers: Array) -> str:
    """Return numbers with every digit, separated by blanks."""
    return ' '.join(map(repr, numbers.tolist()))
