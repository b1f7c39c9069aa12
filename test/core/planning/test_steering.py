"""Shaped motions against an independent integrator and closed forms."""

import math

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation, transform
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.simulation import rest, tool_rows
from bellows_ros.core.planning import steering
from bellows_ros.core.planning.plan_prediction import PlanSimulation, SETTLED_ANGLE
from bellows_ros.core.planning.steering import SwingMode
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from ..oracle import Batch
from ...cell.cup import CUP, PACKAGE
from ...cell.motion import Move

MODEL = model_tuple(CUP, PACKAGE, 9.81)
SLIDE = Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)


def followed(tool, after, rate):
    """Return rotations (N, 3, 3) of the package after a motion's end, by plain RK4."""
    at = tool.seconds
    way, turn = CubicSpline(at, tool.position), RotationSpline(
        at, Rotation.from_matrix(tool.rotation))

    def tools(t):
        t = min(t, at[-1])
        R = turn(t).as_matrix()
        v = np.concatenate([R.T @ way(t, 1), turn(t, 1)])  # body rates both
        return transform(R, way(t))[None], v[None] * (t < at[-1])

    batch = Batch(CUP, [SLIDE], [PACKAGE])
    batch.tools = tools
    start = rest(MODEL, tool_rows(tool)[0])
    T = transform(quaternion_to_rotation(np.array(start[1])), np.array(start[0]))[None]
    duration = float(at[-1]) + after
    rows = batch.run(T, np.zeros((1, 6)), duration, round(duration * rate))
    return np.array([row[2][0, :3, :3] for row in rows if row[0] > at[-1]])


def test_shaping_is_as_in_the_table():
    """0.6 m in 0.5 s: added time and residual swing of ZV and ZVD, also with K 5 % too high."""
    plan = SLIDE.plan()
    softer = model_tuple(Cup(0.95 * CUP.stiffness, CUP.damping, CUP.length), PACKAGE, 9.81)
    for method, *expected in (('zv', 0.155, 0.27, 0.74), ('zvd', 0.310, 0.04, 0.05)):
        found = steering.steer(MODEL, plan, method)
        run = PlanSimulation(MODEL, None, found.tool)
        assert len(found.modes) == 1 and found.method == method
        assert_allclose((float(found.tool.seconds[-1]) - 0.5, *(
            math.degrees(each.predict().residual_swing)
            for each in (run, run.with_model(softer)))), expected, atol=0.02)
    assert PlanSimulation(MODEL, None, plan).predict().residual_swing > math.radians(14.0)


@pytest.mark.parametrize('method', ['zv', 'zvd'])
def test_impulses_cancel_a_mode(method):
    """Sum of A exp(-s t) is zero at the mode's s; for ZVD its derivative by s, too."""
    modes = [SwingMode(3.2, 0.1, 1.0), SwingMode(11.0, 0.4, 0.5)]
    delays, sizes = steering.impulses(modes, method)
    assert_allclose(sizes.sum(), 1.0)
    assert (sizes > 0.0).all()
    for mode in modes:
        s = 2 * np.pi * mode.frequency * (
            -mode.damping_ratio + 1j * math.sqrt(1 - mode.damping_ratio ** 2))
        terms = sizes * np.exp(-s * delays)
        assert abs(terms.sum()) < 1e-12 * abs(terms).sum()
        if method == 'zvd':
            assert abs((delays * terms).sum()) < 1e-12 * abs(terms).sum()


def test_modes_are_those_of_mass_and_spring():
    """With the centre of mass on the axis the axial mode is on its own; so is torsion."""
    found = PlanSimulation(MODEL, None, SLIDE.plan(), tail=0.0).predict()
    modes = steering.residual_modes(MODEL, found)
    for k, d, m in ((9200.0, 24.0, 1.8), (1.35, 0.1, 0.00984)):
        frequency, damping = math.sqrt(k / m) / (2 * math.pi), d / (2 * math.sqrt(k * m))
        near = min(modes, key=lambda mode: abs(mode.frequency - frequency))
        assert_allclose(near[:2], (frequency, damping), rtol=0.02)  # at rest it is stretched
        assert near.swing < 1e-6  # a slide does not drive them


def test_equal_modes_are_merged():
    modes = (3.0, 0.1, 0.1), (3.1, 0.2, 0.3), (5.0, 0.1, 0.001), (11.0, 0.4, 0.1)
    found = steering.to_shape([SwingMode(*mode) for mode in modes])
    assert_allclose(found, [(3.075, 0.175, 0.25), (11.0, 0.4, 0.1)])


@pytest.mark.parametrize(('move', 'method'), [
    (Move([0.0, 0.0, 0.0], [0.0, 0.0, 0.6], 0.5), 'zvd'),
    (Move([0.1, 0.0, 0.0], [0.0, 0.3, 0.6], 0.4), 'zv')], ids=['turn', 'tilt'])
def test_a_shaper_leaves_the_residual_that_it_states(move, method):
    """Also of a mode that decays before its shaper ends, against an independent integrator."""
    found = steering.steer(MODEL, move.plan(500), method)
    assert found.modes and found.residual < SETTLED_ANGLE
    hanging = quaternion_to_rotation(np.array(rest(MODEL, tool_rows(found.tool)[-1])[1]))
    swing = np.linalg.norm(log_so3(hanging.T @ followed(found.tool, 0.4, 500)), axis=-1).max()
    assert swing == pytest.approx(found.residual, abs=math.radians(0.02))


@pytest.mark.parametrize(('stiffness', 'damping', 'duration', 'used'), [
    (0.25, 0.005, 0.5, 'zv'),  # 0.8 Hz: ZVD would add 1.25 s
    (5.9, 1.84 * (5.9 * 0.00984) ** 0.5, 0.2, 'none'),  # 0.92 of critical: 0.64 s, settles before
    (4.0, 1.996 * (4.0 * 0.00984) ** 0.5, 0.2, 'none')])  # 0.998 of critical: 4 s
def test_a_shaper_that_takes_longer_than_allowed_is_not_taken(stiffness, damping, duration, used):
    """Longer than a second, or than the package needs to settle after the plan."""
    K, P = np.diag(CUP.stiffness).copy(), np.diag(CUP.damping).copy()
    K[5], P[5] = stiffness, damping
    model = model_tuple(Cup(np.diag(K), np.diag(P), 0.046), PACKAGE, 9.81)
    plan = Move([0.0] * 3, [0.0, 0.0, 0.6], duration).plan(500)
    found = steering.steer(model, plan, 'zvd')
    assert found.method == used
    assert found.residual == pytest.approx(PlanSimulation(
        model, None, found.tool, tail=2.0).predict().residual_swing)
    assert (found.residual > SETTLED_ANGLE) == (used == 'none')


def test_a_plan_that_ends_in_motion_is_refused():
    with pytest.raises(BellowsError, match='rest'):
        steering.steer(MODEL, SLIDE.plan().select(slice(0, 200)), 'zv')
