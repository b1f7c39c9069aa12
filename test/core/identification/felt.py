"""Recordings of a package under a tool with a force-torque sensor, simulated independently."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.identification.methods import fitted
from bellows_ros.core.model.cup_package import Cup, gravity_vector, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.sensors import weighing
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.workflows.gripper import gripper_of, prepared_tool
from bellows_ros.workflows.recordings import prepare_settings, prepare_streams
import numpy as np

from .simulated import GRAVITY, shake
from ..sensors import wrench_cell

RATE_HZ = 500.0
CUP = Cup(
    np.diag([5400, 5400, 9200, 4.2, 4.2, 1.35]), np.diag([55, 55, 24, 0.06, 0.06, 0.1]), 0.046)
PACKAGE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, -0.03))
T_TOOL_SENSOR = lie.transform(np.eye(3), [0.0, 0.0, 0.1])
GRIPPER = wrench_cell.points_of(0.6, np.array([2e-3, -3e-3, -0.05]), np.diag([1e-3, 1.2e-3, 6e-4]))
PLACES = [0, 2, 3, 5]
"""Entries x, z, rx and rz of K."""
SENSORS = {'ATI': wrench_cell.ATI, 'UR': wrench_cell.UR}


def settings(sensor, **more):
    """Return the stated parameters: the gripper as it is, the package's mass unknown."""
    kind, (mass, com, inertia) = SENSORS[sensor], wrench_cell.numbers_of(*GRIPPER)
    return resolve({
        'cup.length': CUP.length, 'fit.method': 'output_error', 'fit.structure': 'axisymmetric',
        'recording.package_frame': 'com', 'topics.tool_wrench': 'wrench',
        'package.mass': PACKAGE.mass, 'package.com': PACKAGE.com.tolist(),
        'package.inertia': [*np.diag(PACKAGE.inertia).tolist(), 0.0, 0.0, 0.0],
        'wrench.frame': '0 0 0.1 0 0 0 1', 'wrench.noise': list(kind['noise']),
        'wrench.drift': list(kind['drift']), 'wrench.delay': kind['delay'],
        'gripper.mass': float(mass), 'gripper.com': com.tolist(),
        'gripper.inertia': inertia.tolist(), **more})


def motions(cup, package, seconds, seed):
    """Return the motions of tool and package, or of the tool alone."""
    tool = shake(duration=seconds, seed=seed).at_rate(RATE_HZ, 1_000_000_000)
    return tool, package and simulate(cup, package, tool, gravity=GRAVITY)


def readings(tool, body, package, sensor, seed, errors=0.01, gripper=GRIPPER):
    """Return recorded wrenches, with gain errors of each axis and hysteresis, of one sensor."""
    both = [(each.position, each.rotation) for each in (tool, body or tool)]
    points = wrench_cell.points_of(package.mass, np.zeros(3), package.inertia) if package else (
        np.zeros(1), np.zeros((1, 3)))
    loads = wrench_cell.loads(*both, points, gripper, T_TOOL_SENSOR, 1.0 / RATE_HZ)
    empty = wrench_cell.loads(*both, (np.zeros(1), np.zeros((1, 3))), gripper, T_TOOL_SENSOR,
                              1.0 / RATE_HZ)[0]
    gains = 1.0 + errors * np.random.default_rng([seed, 8]).choice([-1.0, 1.0], 6)
    shown = wrench_cell.Errors(**SENSORS[sensor], gain=0.0, hysteresis=errors).applied(
        gains * (loads - empty), 1.0 / RATE_HZ, np.random.default_rng([seed, 9, body is None]))
    return TwistStream('wrench', 'sensor', tool.stamps_ns[2:-2], shown[:, :3], shown[:, 3:])


def streams(seed, sensor, seconds=10.0, cup=CUP, package=PACKAGE, errors=0.01):
    """Return poses of tool and package with noise, and wrenches; of the tool without a package."""
    return noisy(*motions(cup, package, seconds, 100 + seed + 1000 * (package is None)),
                 package, sensor, seed, errors)


def noisy(tool, body, package, sensor, seed, errors=0.01):
    """Return poses of tool and package, if any, with noise, and wrenches."""
    rng = np.random.default_rng([seed, 7])
    poses = [
        PoseStream(name, 'world', each.stamps_ns,
                   each.position + noise[0] * rng.standard_normal((len(each), 3)),
                   each.rotation @ lie.exp_so3(noise[1] * rng.standard_normal((len(each), 3))))
        for name, each, noise in (('tool', tool, (2e-5, 5e-5)), ('package', body, (1e-4, 5e-4)))
        if each]
    return *poses, readings(tool, body, package, sensor, seed, errors)


def recorded(seed, sensor, seconds=10.0, cup=CUP, package=PACKAGE, values=None):
    """Return a prepared recording with wrenches; its stated package is `PACKAGE`."""
    return _prepared(*streams(seed, sensor, seconds, cup, package), values or settings(sensor))


def recording_of(tool, body, package, sensor, seed, values):
    """Return a prepared recording of given motions with wrenches."""
    return _prepared(*noisy(tool, body, package, sensor, seed), values)


def _prepared(tool, body, wrenches, values):
    """Return a prepared recording of streams; its stated package is `PACKAGE`."""
    recording = prepare(tool, body, PrepareSettings(payload=PACKAGE, gravity=GRAVITY))
    return replace(recording, further=(weighing.Wrenches.of(
        wrenches, recording.aligned_tool, 'world', np.eye(3), values),))


def empty_run(seed, sensor, values):
    """Return the information and slope of 10 s with the empty gripper."""
    pose, wrenches = streams(seed, sensor, package=None)
    return weighing.information_on_gripper(*prepared_tool(
        {'tool_pose': pose, 'tool_wrench': wrenches}, values), gravity_vector(9.81))


def joint_fit(seed, sensor, seconds=10.0, with_poses=True):
    """
    Return a fit with an empty run, the errors of K and mass, and their standard errors.

    Without poses of the package the wrenches alone are fitted.
    """
    rng = np.random.default_rng([seed, 3])
    stiffer, heavier = 1.0 + np.array([0.05, 0.1]) * rng.choice([-1.0, 1.0], 2)
    cup = Cup(stiffer * CUP.stiffness, CUP.damping, CUP.length)
    package = Package(
        heavier * PACKAGE.mass, heavier * PACKAGE.inertia, PACKAGE.com)
    values = settings(sensor, **{
        'package.inertia_std': [*0.1 * np.diag(PACKAGE.inertia), 0.0, 0.0, 0.0]})
    values = values.replaced(gripper_of(*empty_run(seed, sensor, values)))
    if with_poses:
        recording = recorded(seed, sensor, seconds, cup, package, values=values)
    else:
        values = values.replaced({'topics.package_pose': ''})
        pose, _, wrenches = streams(seed, sensor, seconds, cup, package)
        recording = prepare_streams(
            {'tool_pose': pose, 'tool_wrench': wrenches}, prepare_settings(values), values)
    fit = fitted([recording], values)
    true, (mass,) = np.diag(cup.stiffness)[PLACES], fit.freed
    return fit, np.append(
        np.diag(fit.stiffness)[PLACES] / true - 1.0,
        mass.change[0] + np.log(PACKAGE.mass / package.mass)), np.append(
        np.diag(fit.stiffness_std)[PLACES] / true, mass.std[0])
