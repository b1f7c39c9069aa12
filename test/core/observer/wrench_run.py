"""
A package under a tool with a force-torque sensor: parameters, sensor and tool have errors.

The sensor is `test/core/sensors/wrench_cell.py`. The package is gripped 10 mm off its centre, its
mass is 10 % off and K 5 %; with errors the gripper's mass is also 2 % off, and the sensor has 1 %
of gain errors by axis and 1 % of hysteresis.
"""

from typing import Any, NamedTuple

from bellows_ros import LivePredictor
from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.kernels import advance
import numpy as np

from .cases import pick_and_place, with_noise
from ..sensors import wrench_cell
from ...cell.cup import CUP, PACKAGE

STEP_NS = 2_000_000
MARGIN = 2
"""Samples at each end without an acceleration."""
GRIPPER = wrench_cell.points_of(0.6, np.array([2e-3, -3e-3, -0.05]), np.diag([1e-3, 1.2e-3, 6e-4]))
SENSORS = {'ATI': wrench_cell.ATI, 'UR': wrench_cell.UR}
CAMERA_EVERY, CAMERA_NOISE = 17, np.repeat([2e-3, 1e-2], 3)
TOOL_NOISE = np.repeat([2e-5, 5e-5], 3)
SLIP = 5e-3
"""Size of a slip, m."""
SLIP_TIME = 0.01
"""Duration of a slip, s."""
OFF = {'grip': 10e-3, 'mass': 0.1, 'stiffness': 0.05}


class Run(NamedTuple):
    """A simulated motion with its package and sensor."""

    stamps: Any
    tool: list[Any]
    body: list[Any]
    readings: Any
    parameters: dict[str, Any]
    mass: float


def simulated(
    seed: int, sensor: str, errors: bool, seconds: float = 8.0, fault: str = '', at: float = 6.0
) -> Run:
    """Return a run with wrong parameters; a package slips or is lost at a time (s)."""
    rng = np.random.default_rng(seed)
    sign = dict(zip((*OFF, 'gripper'), rng.choice([-1.0, 1.0], 4), strict=True))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    com = PACKAGE.com + OFF['grip'] * np.array([np.cos(angle), np.sin(angle), 0.0])
    growth = 1.0 + sign['mass'] * OFF['mass']
    package = Package(growth * PACKAGE.mass, growth * PACKAGE.inertia, com)
    stiffer = 1.0 + sign['stiffness'] * OFF['stiffness']
    cup = Cup(stiffer * CUP.stiffness, CUP.damping, CUP.length)
    model = model_tuple(cup, package, 9.81)
    stamps, tool = pick_and_place(rng, seconds, STEP_NS)
    body = [static_equilibrium(model, tool[0])]
    for k, (before, now) in enumerate(zip(tool[:-1], tool[1:], strict=True), 1):
        since, last = k * STEP_NS * 1e-9 - at, body[-1]
        if fault == 'lost' and since > 0.0:
            model = model_tuple(Cup(1e-9 * cup.stiffness, 1e-9 * cup.damping, cup.length),
                                package, 9.81)
        if fault == 'slip' and 0.0 < since <= SLIP_TIME:
            step = SLIP * STEP_NS * 1e-9 / SLIP_TIME * np.array([0.6, 0.8, 0.0])
            com = com + step  # the lip slides over the package
            model = model_tuple(cup, Package(package.mass, package.inertia, com), 9.81)
        body.append(advance(model, last, before, now, STEP_NS * 1e-9, 4))
    T_tool_sensor = lie.transform(np.eye(3), [0.0, 0.0, 0.1])
    masses, places = GRIPPER
    off = 1.0 + 0.02 * sign['gripper'] * errors
    loads = wrench_cell.loads(
        poses(tool), poses(body), wrench_cell.points_of(
            package.mass, np.zeros(3), package.inertia), (off * masses, places),
        T_tool_sensor, STEP_NS * 1e-9)
    bias = wrench_cell.loads(
        poses(tool[:5]), poses(body[:5]), (np.zeros(1), np.zeros((1, 3))), (off * masses, places),
        T_tool_sensor, STEP_NS * 1e-9)[0]
    kind = SENSORS[sensor]
    part = 0.01 * errors
    readings = wrench_cell.Errors(**kind, gain=part, hysteresis=part).applied(
        loads - bias, STEP_NS * 1e-9, rng)
    mass, at, _ = wrench_cell.numbers_of(masses, places)
    return Run(stamps, tool, body, readings, {
        'wrench.frame': '0 0 0.1 0 0 0 1', 'wrench.delay': kind['delay'],
        'gripper.mass': float(mass), 'gripper.com': at.tolist(),
        'package.mass': PACKAGE.mass, 'package.com': list(PACKAGE.com),
        'package.inertia': [*np.diag(PACKAGE.inertia).tolist(), 0.0, 0.0, 0.0],
        'package.mass_std': OFF['mass'] * PACKAGE.mass, 'package.com_std': [7e-3, 7e-3, 1e-3],
        'cup.stiffness': CUP.stiffness.ravel().tolist(), 'cup.length': CUP.length,
        'cup.damping': CUP.damping.ravel().tolist(),
        'cup.stiffness_std': (OFF['stiffness'] * np.diag(np.diag(CUP.stiffness))).ravel().tolist(),
        'tool_noise': (2e-5, 5e-5),
        'measured.camera_std': [0.0, 0.0], 'measured.marker_std': [0.0, 0.0],
        'measured.latency': [0.0, 0.0]}, package.mass)


def poses(states: list[Any]) -> tuple[Any, Any]:
    """Return positions (N, 3) and rotations (N, 3, 3) of states."""
    return (np.array([state[0] for state in states]),
            lie.quaternion_to_rotation(np.array([state[1] for state in states])))


def predict(
    run: Run, seed: int, camera: bool = False, wrench: bool = True, before: Any = None
) -> tuple[LivePredictor, Any]:
    """
    Return a predictor after a run, and errors of B (N,) in m.

    Calls before(k, predictor, reading) with each reading (6,), which returns another.
    """
    rng = np.random.default_rng([seed, 1])
    live = LivePredictor.from_parameters(run.parameters)
    live.expect_twists(True)
    errors = []
    for k, (stamp, state) in enumerate(zip(run.stamps.tolist(), run.tool, strict=True)):
        noisy = with_noise(rng, state, TOOL_NOISE)
        R = lie.quaternion_to_rotation(np.array(state[1]))
        live.on_twist(stamp, tuple(R @ state[2]), tuple(R @ state[3]), 'world')
        predictions = live.on_pose(stamp, 'world', noisy[0], noisy[1], stamp)
        if wrench and MARGIN <= k < MARGIN + len(run.readings):
            reading = run.readings[k - MARGIN]
            reading = (before(k, live, reading) if before else reading).tolist()
            live.on_wrench(stamp, 'tool0', tuple(reading[:3]), tuple(reading[3:]))
        if camera and k % CAMERA_EVERY == 0:
            seen = with_noise(rng, run.body[k], CAMERA_NOISE)
            live.on_measured(stamp, 'world', seen[0], seen[1])
        if predictions:
            errors.append(np.linalg.norm(np.subtract(predictions[-1].position, run.body[k][0])))
    return live, np.array(errors)
