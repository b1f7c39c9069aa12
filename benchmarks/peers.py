"""
The same plate on a cup in the simulators a user may have: MuJoCo and Drake.

Their springs act on joint angles or roll, pitch and yaw instead of the strain (3.18), so the
motions differ; the work of a step is comparable. Each is judged by its own motion at small steps.
"""

from collections.abc import Callable
import importlib
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model.cup_package import Cup, Package
import numpy as np

from .step_case import PUSH, TURN

Advance = Callable[[float, int], Array]
"""Advances from the start by so many steps of h (s); returns displacement and angles (6,)."""

_JOINTS = ('slide', 'slide', 'slide', 'hinge', 'hinge', 'hinge')
_AXES = ('1 0 0', '0 1 0', '0 0 1') * 2


def mujoco_peer(cup: Cup, package: Package) -> Advance:
    """Return MuJoCo's RK4 on a body with six spring joints; raise ImportError without it."""
    mujoco = importlib.import_module('mujoco')
    joints = ''.join(
        f'<joint type="{kind}" axis="{axis}" stiffness="{k}" damping="{d}"/>'
        for kind, axis, k, d in zip(
            _JOINTS, _AXES, np.diag(cup.stiffness), np.diag(cup.damping), strict=True
        )
    )
    inertia = ' '.join(str(value) for value in np.diag(package.inertia))
    com = ' '.join(str(value) for value in package.com)
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option integrator="RK4"/><worldbody>'
        f'<body pos="0 0 {-cup.length}">{joints}'
        f'<inertial pos="{com}" mass="{package.mass}" diaginertia="{inertia}"/>'
        '</body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)

    def advance(h: float, count: int) -> Array:
        mujoco.mj_resetData(model, data)
        model.opt.timestep = h
        data.qpos[:] = np.concatenate([PUSH, TURN])
        mujoco.mj_step(model, data, nstep=count)
        return np.array(data.qpos)

    return advance


def drake_peer(cup: Cup, package: Package) -> Advance:
    """Return Drake's fixed-step RK3 on a body on a linear bushing; raise ImportError without."""
    tree: Any = importlib.import_module('pydrake.multibody.tree')
    plants: Any = importlib.import_module('pydrake.multibody.plant')
    maths: Any = importlib.import_module('pydrake.math')
    analysis: Any = importlib.import_module('pydrake.systems.analysis')
    plant = plants.MultibodyPlant(time_step=0.0)
    about_com = tree.RotationalInertia(*np.diag(package.inertia))
    inertia = tree.SpatialInertia.MakeFromCentralInertia(package.mass, package.com, about_com)
    body = plant.AddRigidBody('package', inertia)
    anchor = plant.AddFrame(tree.FixedOffsetFrame(
        'lip_at_rest', plant.world_frame(), maths.RigidTransform([0.0, 0.0, -cup.length])
    ))
    K, P = np.diag(cup.stiffness), np.diag(cup.damping)
    plant.AddForceElement(tree.LinearBushingRollPitchYaw(
        anchor, body.body_frame(), K[3:], P[3:], K[:3], P[:3]
    ))
    plant.Finalize()
    simulator = analysis.Simulator(plant)
    context = simulator.get_mutable_context()
    start = maths.RigidTransform(
        maths.RollPitchYaw(*TURN), PUSH + np.array([0.0, 0.0, -cup.length])
    )

    def advance(h: float, count: int) -> Array:
        context.SetTime(0.0)
        plant.SetFreeBodyPose(context, body, start)
        plant.SetFreeBodySpatialVelocity(context, body, _still(importlib))
        analysis.ResetIntegratorFromFlags(simulator, 'runge_kutta3', h)
        integrator = simulator.get_mutable_integrator()
        integrator.set_fixed_step_mode(True)
        integrator.set_maximum_step_size(h)
        simulator.Initialize()
        simulator.AdvanceTo(h * count)
        at = plant.EvalBodyPoseInWorld(context, body)
        return np.concatenate([at.translation(), maths.RollPitchYaw(at.rotation()).vector()])

    return advance


def _still(modules: Any) -> Any:
    """Return Drake's zero velocity."""
    return modules.import_module('pydrake.multibody.math').SpatialVelocity(np.zeros(6))


PEERS: dict[str, Callable[[Cup, Package], Advance]] = {
    'MuJoCo RK4': mujoco_peer,
    'Drake RK3': drake_peer,
}
