"""The integrator and rubber that relaxes, against second implementations."""

from dataclasses import replace

from bellows_ros.core.geometry import jit, lie
from bellows_ros.core.geometry.lie import (
    log_so3,
    quaternion_to_rotation,
)
from bellows_ros.core.model import equilibrium
from bellows_ros.core.model.cup_package import box_inertia, Cup, model_tuple, Package
from bellows_ros.core.model.kernels import (
    advance,
    lip_wrench,
    tool_at,
    tool_segment,
    with_strains,
)
from bellows_ros.core.model.simulation import simulate, state_row
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import oracle
from ...cell.cup import (
    K_THESIS,
    orthonormal,
    random_cup,
    random_package,
    state_of,
    T_WORLD_PACKAGE,
    T_WORLD_TOOL,
)
from ...cell.motion import ShakenTool, still_tool

GRAVITY = 9.81


def angle_between(Ra, Rb):
    """Return the angles (rad) between rotations."""
    return np.linalg.norm(log_so3(np.swapaxes(Ra, -1, -2) @ Rb), axis=-1)


def test_energy_is_that_of_the_thesis_and_constant_without_damping():
    """Simulate the validation case (3.45)-(3.49)."""
    cup = Cup(K_THESIS, np.zeros((6, 6)), 0.0482)
    package = Package(2.0, box_inertia(2.0, 0.2, 0.2, 0.2), (0.0, 0.0, -0.1))
    tool = still_tool(orthonormal(T_WORLD_TOOL), 2 * 10**9, 2000)
    T = orthonormal(T_WORLD_PACKAGE)
    body = simulate(cup, package, tool, state_of(T[:3, 3], T[:3, :3]), substeps=1)
    gravity = np.array([0.0, 0.0, -GRAVITY])
    energies = np.array([
        oracle.energies(cup, package, gravity, *each) for each in zip(
            lie.transform(tool.rotation, tool.position),
            lie.transform(body.rotation, body.position), body.twist, strict=True)])
    # the poses are printed with four digits
    assert_allclose(energies[0], [0.0, 2.0425, 0.5906], rtol=5e-4, atol=1e-15)
    assert np.ptp(energies.sum(axis=1)) < 1e-6


def pair(h):
    """Return six numbers as a strain of the kernels."""
    return tuple(h[:3].tolist()), tuple(h[3:].tolist())


def random_strains(rng, size=0.01):
    """Return internal strains (2, 6) of two branches."""
    return size * rng.standard_normal((2, 6)) * [1.0, 1.0, 1.0, 10.0, 10.0, 10.0]


NONE, RUBBER, STRETCH = (0.0, 0.0), (0.3, 0.2), (-2e4, -5.0)


@pytest.fixture(scope='module', params=[(NONE, NONE), (RUBBER, STRETCH)])
def shaken(request):
    """Return a model, a tool motion, a start, and the solution of DOP853 (0.24 s at 1 ms)."""
    rng = np.random.default_rng(7)
    cup, package, motion = random_cup(rng), random_package(rng), ShakenTool(rng)
    relaxation, stretch = request.param
    z = random_strains(rng)[:2 * any(relaxation)]
    cup = replace(cup, relaxation=relaxation, stretch=stretch)
    T = np.eye(4)
    T[:3, 3] = package.com - np.array([0.0, 0.0, cup.length])
    times = np.arange(0, 241) * 1e-3
    gravity = np.array([0.0, 0.0, -GRAVITY])
    solution = oracle.solve(cup, package, gravity, motion.at, T, np.zeros(6), times, z.ravel())
    start = state_of(T[:3, 3], T[:3, :3])
    return cup, package, motion, with_strains(start, tuple(map(pair, z))) if len(z) else start, (
        solution)


def test_agrees_with_dop853_on_the_plain_equations(shaken):
    cup, package, motion, start, (position, rotation, twist) = shaken
    body = simulate(cup, package, motion.trajectory(0.24, 2000), start, substeps=2)
    body = body.select(slice(None, None, 2))
    assert np.abs(body.position - position).max() < 1e-9
    assert angle_between(body.rotation, rotation).max() < 1e-8
    assert_allclose(body.twist, twist, atol=1e-6)


def test_observed_order_is_four(shaken):
    cup, package, motion, start, (position, rotation, _) = shaken
    errors = []
    for rate in (125, 250, 500):
        body = simulate(cup, package, motion.trajectory(0.24, rate), start, substeps=1)
        truth = slice(None, None, 1000 // rate)
        error = np.abs(body.position - position[truth]).max()
        errors.append([error, angle_between(body.rotation, rotation[truth]).max()])
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 3.7), orders


@jit.entry
def repeat(model, body, tool, later, h, count):
    """Advance many times with the same tool motion."""
    for _ in range(count):
        body = advance(model, body, tool, later, h, 1)
    return body


def test_rotation_stays_orthonormal_after_many_steps():
    rng = np.random.default_rng(3)
    model = model_tuple(random_cup(rng), random_package(rng), GRAVITY)
    tool = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.1, 0.4, 3.0)
    turned = tool_at(tool_segment(tool, tool, 1e-3), 0.5)  # a tool that goes on turning
    body = (0.0, 0.0, -0.1), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.5, -0.2, 1.0)
    count = 200_000 if jit.COMPILED else 10_000  # 250 times slower interpreted
    body = repeat(model, body, tool, turned, 1e-3, count)
    R = quaternion_to_rotation(np.array(body[1]))
    assert abs(np.linalg.norm(body[1]) - 1.0) < 1e-14
    assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.all(np.isfinite(np.concatenate(body)))


R = (0.3, 0.2)
STILL = state_row(np.zeros(3), [0.0, 0.0, 0.0, 1.0])


def test_a_step_meets_the_whole_stiffness_and_rest_the_static_one():
    rng = np.random.default_rng(6)
    cup, package = replace(random_cup(rng), relaxation=R), random_package(rng)
    model, plain = (model_tuple(each, package, 9.81) for each in (
        cup, replace(cup, relaxation=(0.0, 0.0))))
    hangs, expected = (equilibrium.static_equilibrium(each, STILL) for each in (model, plain))
    assert_allclose(np.hstack(hangs[:4]), np.hstack(expected), atol=1e-12)
    assert_allclose(np.hstack(lip_wrench(model, STILL, hangs)),
                    np.hstack(lip_wrench(plain, STILL, expected)), atol=1e-9)
    step = equilibrium.moved(hangs, (0.0, 0.0, 1e-6), *((0.0, 0.0, 0.0),) * 3)
    instant, static = (
        np.subtract(lip_wrench(each, STILL, there)[0], lip_wrench(each, STILL, here)[0])
        for each, there, here in ((model, step, hangs), (plain, step[:4], hangs[:4])))
    assert_allclose(instant, (1.0 + sum(R)) * static, rtol=1e-3)  # nor does J's change count
    body = simulate(cup, package, still_tool(np.eye(4), 4 * 10**9, 2000), hangs)
    assert_allclose(body.position[-1], hangs[0], atol=1e-10)


@pytest.mark.parametrize('relaxation', [(0.0, 0.0), R])
def test_nominal_motions_are_those_of_the_linearised_model(relaxation):
    rng = np.random.default_rng(11)
    cup = replace(random_cup(rng), relaxation=relaxation)
    model = model_tuple(cup, random_package(rng), (1.0, -2.0, -9.0))
    tool = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    expected = equilibrium.nominal_system_matrix(model)
    found = equilibrium.system_matrix(model, tool, equilibrium.resting_on_tool(model, tool))
    assert_allclose(found, expected, rtol=0, atol=1e-9 * expected.max())  # differences


def test_steps_are_short_enough_for_the_shortest_time():
    cup = replace(Cup.thesis(), relaxation=R, relaxation_times=(1e-5, 0.8))
    rng = np.random.default_rng(9)
    body = simulate(cup, random_package(rng), still_tool(np.eye(4), 10**8, 10))
    assert np.isfinite(body.position).all()
