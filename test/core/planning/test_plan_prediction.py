"""Prediction along plans against an independent integrator, brute force and Monte Carlo."""

import math

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.planning.plan_prediction import PlanSimulation, SETTLED_ANGLE
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..oracle import Batch
from ...cell.cup import CUP, GRAVITY_VECTOR, GRIP, PACKAGE, random_case
from ...cell.motion import Move

MODEL = model_tuple(CUP, PACKAGE, 9.81)
SLIDE = Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)
TWIST = Move([0.4, -0.2, 0.1], [0.3, -0.2, 0.6], 0.6)


def batch_start(cases):
    """Return poses and twists of packages at rest under upright tools at the origin."""
    states = [
        static_equilibrium(
            model_tuple(CUP, package, 9.81), state_row(np.zeros(3), [0, 0, 0, 1], np.zeros(6)))
        for _, package, _ in cases]
    T = [lie.transform(lie.quaternion_to_rotation(q), np.array(o)) for o, q, _, _ in states]
    return np.array(T), np.zeros((len(cases), 6))


def truths(cases, after=0.5, rate=1000):
    """Return the smallest safety factor of each case by the independent integrator."""
    batch = Batch(CUP, [move for move, _, _ in cases], [package for _, package, _ in cases])
    duration = max(move.duration for move, _, _ in cases) + after
    smallest, rigid = np.full((2, len(cases)), math.inf)
    grips = np.array([grip for _, _, grip in cases])
    mass, com, before = batch.packages.mass[:, None], batch.packages.com, None
    arm = com - [0.0, 0.0, CUP.length]
    for _, (T_E, v_E), _, _, wrench in batch.run(
            *batch_start(cases), duration, round(rate * duration)):
        R = T_E[:, :3, :3]
        velocity = np.einsum('nij,nj->ni', R, v_E[:, :3] + np.cross(v_E[:, 3:], arm))
        pull = -GRAVITY_VECTOR if before is None else (velocity - before) * rate - GRAVITY_VECTOR
        before = velocity
        f = mass * np.einsum('nji,nj->ni', R, np.broadcast_to(pull, arm.shape))
        load = np.hstack([f, np.cross(com, f)])  # of m (a - g) at B, held at the lip
        smallest = np.minimum(smallest, 1 / loads(grips, wrench))
        rigid = np.minimum(rigid, 1 / loads(grips, load))
    return smallest, rigid


def loads(grips, wrench):
    """Return the larger of 1 / safety factor against peel and slip, as the equations say."""
    V, r, friction = grips.T
    f, m = wrench[:, :3], wrench[:, 3:]
    peel = (f[:, 2] + 2 * np.hypot(m[:, 0], m[:, 1]) / r) / V
    q = np.sqrt(f[:, 0] ** 2 + f[:, 1] ** 2 + (m[:, 2] / r) ** 2)
    return np.maximum(np.maximum(peel, (q + friction * f[:, 2]) / (friction * V)), 1e-9)


def test_states_and_figures_are_those_of_an_independent_integrator():
    plan = TWIST.plan()
    found = PlanSimulation(MODEL, GRIP, plan).predict()
    figures = found.summary()
    batch = Batch(CUP, [TWIST], [PACKAGE])
    rows, turns, settled, T_world_package, wrenches = [], [], 0.0, [], []
    end = plan.stamps_ns[-1] * 1e-9
    rest = lie.quaternion_to_rotation(np.array(static_equilibrium(MODEL, state_row(
        plan.position[-1], lie.rotation_to_quaternion(plan.rotation[-1]), np.zeros(6)))[1]))
    for t, (T_E, _), T, _, wrench in batch.run(
            *batch_start([(TWIST, PACKAGE, GRIP)]), 1.5, 1500):
        T_world_package.append(T[0])
        wrenches.append(wrench[0])
        R = T_E[0, :3, :3].T @ T[0, :3, :3]
        o = T_E[0, :3, :3].T @ (T[0, :3, 3] - T[0, :3, :3] @ PACKAGE.com - T_E[0, :3, 3])
        rows.append((
            loads(np.array([GRIP]), wrench)[0], math.acos(R[2, 2]),
            np.linalg.norm(o + [0, 0, CUP.length]),
            np.linalg.norm(wrench[0, :3]), np.linalg.norm(wrench[0, 3:])))
        if t > end - 1e-9:
            turn = float(np.linalg.norm(lie.log_so3(rest.T @ T[0, :3, :3])))
            turns.append(turn)
            settled = t - end if turn > SETTLED_ANGLE else settled
    T = np.array(T_world_package[:len(plan)])
    assert np.abs(found.states[:, :3] - T[:, :3, 3]).max() < 0.2e-6
    turn = lie.log_so3(
        np.swapaxes(T[:, :3, :3], -1, -2) @ lie.quaternion_to_rotation(found.states[:, 3:7]))
    assert np.abs(turn).max() < 3e-6
    assert_allclose(found.wrench, wrenches[:len(plan)], atol=1e-3)
    load, *others = (top(column) for column in np.transpose(rows))
    assert_allclose(1 / figures['smallest_safety_factor'], load, rtol=1e-5)
    for name, largest in zip(('bending', 'deflection', 'force', 'moment'), others, strict=True):
        assert_allclose(figures[f'peak_{name}'], largest, rtol=1e-5, err_msg=name)
    assert_allclose(figures['swing_left'], top(np.array(turns)), rtol=1e-4)
    assert_allclose(figures['settled_after'], settled, atol=1e-3)


def top(values):
    """Return the largest value of even samples: the vertex of the parabola there."""
    i = int(np.argmax(values))
    if not 0 < i < len(values) - 1:
        return values[i]
    below, here, above = values[i - 1:i + 2]
    return here - (above - below) ** 2 / (8 * (above - 2 * here + below))


def test_a_plan_at_rest_leaves_the_package_at_rest():
    found = PlanSimulation(MODEL, GRIP, Move([0, 0, 0], [0, 0, 0], 0.3).plan(100)).predict()
    assert_allclose(found.states, np.tile(found.states[0], (31, 1)), atol=1e-9)
    figures = found.summary()
    assert figures['swing_left'] < 1e-7 and figures['settled_after'] == 0.0
    weight = 1.8 * 9.81
    assert_allclose(figures['smallest_safety_factor'], GRIP[0] / weight, rtol=1e-9)


def safety_of(cases):
    """Return the smallest safety factor that is predicted for each case."""
    runs = (PlanSimulation(model_tuple(CUP, package, 9.81), grip, move.plan(250))
            for move, package, grip in cases)
    return np.array([run.predict().smallest_safety[0] for run in runs])


def test_safety_factor_is_below_one_at_a_loss():
    """The safety factor is that of an integrator that samples at 1 kHz."""
    rng = np.random.default_rng(5)
    cases = [random_case(rng) for _ in range(30)]
    (truth, rigid), found = truths(cases, after=0.3), safety_of(cases)
    lets_go = truth < 1.0
    assert 6 < lets_go.sum() < 24  # the cases are not trivial
    assert not (lets_go & (found >= 1.0)).any()
    assert not ((truth >= 1.0) & (found < 1.0)).any()  # nor afraid
    assert (lets_go & (rigid >= 1.0)).sum() >= 3  # which the rigid load would have driven
    sane = truth > 0.5  # below, many fall over, which no cup does before it lets go
    assert_allclose(found[sane], truth[sane], rtol=1e-4)


@pytest.mark.parametrize(('pull', 'rate'), [
    ([4.0, 0.0, 0.0], 0.0), ([1.0, -2.0, 0.5], 0.0), ([0.0, 0.0, 0.0], 3.0)])
def test_a_plan_that_begins_in_steady_motion_continues_steadily(pull, rate):
    """Constant acceleration, or a turn at constant rate 0.4 m from its axis, keep the package."""
    t = np.arange(301) * 2e-3
    R = lie.exp_so3(np.outer(rate * t, [0.0, 0.0, 1.0]))
    arm = np.array([0.4, 0.0, 0.0]) * (rate > 0.0)
    at = np.einsum('nij,j->ni', R, arm) + np.outer(0.3 * t, [1, 0, 0]) * (rate == 0.0) + (
        np.outer(0.5 * t * t, pull))
    v = np.cross([0.0, 0.0, rate], at) * (rate > 0.0) + [0.3 * (rate == 0.0), 0.0, 0.0] + (
        np.outer(t, pull))
    twist = np.hstack([np.einsum('nji,nj->ni', R, v), np.tile([0.0, 0.0, rate], (len(t), 1))])
    tool = Trajectory((t * 1e9).round().astype(np.int64), at, R, twist)
    found = PlanSimulation(model_tuple(CUP, PACKAGE, 9.81), None, tool, tail=0.0).predict()
    R_tool_package = np.swapaxes(R, -1, -2) @ lie.quaternion_to_rotation(found.states[:, 3:7])
    shift = np.einsum('nji,nj->ni', R, found.states[:, :3] - at)
    assert np.ptp(R_tool_package, axis=0).max() < 2e-6 and np.ptp(shift, axis=0).max() < 1e-7
    assert np.arccos(R_tool_package[0, 2, 2]) > math.radians(2.0)
