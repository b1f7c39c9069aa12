"""Steered motions against an independent integrator, closed forms and Monte Carlo."""

import math

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation, transform
from bellows_ros.core.model.cup_package import Cup, mean_square, model_tuple, model_with
from bellows_ros.core.model.simulation import rest, tool_rows
from bellows_ros.core.parameters.conversion import parameter_std, parameter_vector, uncertain_of
from bellows_ros.core.planning import steering
from bellows_ros.core.planning.limits import demands
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import curve_of
from bellows_ros.core.planning.steering import SwingMode
from bellows_ros.core.signals.resampling import resample
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from .test_fastest import VALUES
from ..plans import Batch, CUP, Move, PACKAGE

MODEL = model_tuple(CUP, PACKAGE, 9.81)
SLIDE = Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5)


class Smooth(Move):
    """A move whose step has four continuous derivatives, or as many as `order` says."""

    order = 4

    def steps(self, s):
        """Return the step and its slope: the integral of (s (1 - s))^order, scaled."""
        slope = np.polynomial.Polynomial([0.0, 1.0, -1.0]) ** self.order
        step = slope.integ()
        return step(s) / step(1.0), slope(s) / step(1.0)


def followed(tool, cup=CUP, after=0.1, rate=1000):
    """Return poses (N, 4, 4) of the package along a motion, and later, by plain RK4."""
    at = tool.seconds
    way, turn = CubicSpline(at, tool.position), RotationSpline(
        at, Rotation.from_matrix(tool.rotation))

    def tools(t):
        t = min(t, at[-1])
        R = turn(t).as_matrix()
        v = np.concatenate([R.T @ way(t, 1), turn(t, 1)])  # body rates both
        return transform(R, way(t))[None], v[None] * (t < at[-1])

    batch = Batch(cup, [SLIDE], [PACKAGE])
    batch.tools = tools
    start = rest(model_tuple(cup, PACKAGE, 9.81), tool_rows(tool)[0])
    T = transform(quaternion_to_rotation(np.array(start[1])), np.array(start[0]))[None]
    duration = float(at[-1]) + after
    rows = list(batch.run(T, np.zeros((1, 6)), duration, round(duration * rate)))
    return np.array([row[0] for row in rows]), np.array([row[2][0] for row in rows])


def angle(R, reference):
    """Return the angles (N,) between rotations, degrees."""
    return np.degrees(np.linalg.norm(
        log_so3(np.swapaxes(reference, -1, -2) @ R), axis=-1))


@pytest.mark.parametrize('move', [
    Smooth([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.5),
    Smooth([0.3, -0.2, 0.1], [0.1, 0.2, 0.8], 0.8), SLIDE], ids=['slide', 'turn', 'quintic'])
def test_the_inverse_moves_the_package_as_wanted(move):
    """Within 0.05 mm of its path, at rest when the plan is, and not swinging afterwards."""
    plan = move.plan()
    found = steering.steer(MODEL, plan, 'inverse')
    t, T = followed(found.tool)
    wanted = CubicSpline(found.package.seconds, found.package.position)
    at = np.minimum(t, found.package.seconds[-1])
    assert np.linalg.norm(T[:, :3, 3] - wanted(at), axis=1).max() < 0.05e-3
    assert angle(T[:, :3, :3], RotationSpline(
        found.package.seconds, Rotation.from_matrix(found.package.rotation))(at).as_matrix()
    ).max() < 0.01
    goal = rest(MODEL, tool_rows(plan)[-1])
    arrived = T[t >= plan.seconds[-1]]  # no time is added
    assert np.linalg.norm(arrived[:, :3, 3] - goal[0], axis=1).max() < 0.05e-3
    assert angle(arrived[:, :3, :3], quaternion_to_rotation(np.array(goal[1]))).max() < 0.01
    assert_allclose(found.tool.position[-1], plan.position[-1], atol=1e-5)
    smooth = isinstance(move, Smooth)
    assert (found.smoothed == 0.0) == smooth and steering.is_smooth(curve_of(found.package))
    if smooth:
        halfway = steering.hanging(MODEL, plan).position[len(plan) // 2]
        assert_allclose(wanted(0.5 * plan.seconds[-1]), halfway, atol=1e-7)


@pytest.mark.parametrize(('order', 'smooth'), [(2, False), (3, False), (4, True), (5, True)])
def test_four_continuous_derivatives_are_distinguished_from_fewer(order, smooth):
    move = Smooth([0.6, 0.1, 0.0], [0.0, 0.0, 0.3], 0.6)
    move.order = order
    assert steering.is_smooth(curve_of(move.plan())) == smooth
    assert steering.is_smooth(curve_of(move.plan(500))) == smooth


def test_shaping_is_as_in_the_table():
    """0.6 m in 0.5 s: time added, largest tilt and swing left of quintic, ZV, ZVD, inverse."""
    plan = SLIDE.plan()
    softer = model_tuple(Cup(0.95 * CUP.stiffness, CUP.damping, CUP.length), PACKAGE, 9.81)

    def row(tool, wanted):
        run = PlanSimulation(MODEL, None, tool)
        found = run.predict()
        tilt = angle(quaternion_to_rotation(found.states[:, 3:7]), wanted.rotation).max()
        return (float(tool.seconds[-1]) - 0.5, tilt,
                *(math.degrees(each.summary()['swing_left'])
                  for each in (found, run.with_model(softer).predict())))

    assert_allclose(row(plan, steering.hanging(MODEL, plan))[1:3], (27.4, 14.4), atol=0.1)
    zv, zvd = (steering.steer(MODEL, plan, name) for name in ('zv', 'zvd'))
    assert [len(each.modes) for each in (zv, zvd)] == [1, 1]
    assert_allclose(row(zv.tool, zv.package), (0.155, 14.0, 0.27, 0.74), atol=0.05)
    assert_allclose(row(zvd.tool, zvd.package), (0.310, 8.7, 0.04, 0.05), atol=0.02)
    found = steering.steer(MODEL, plan, 'inverse')
    _, tilt, swing, soft = row(found.tool, found.package)
    assert tilt < 0.004 and swing < 0.01
    assert_allclose(soft, 1.83, atol=0.05)  # where zvd leaves 0.05; see the next test
    assert_allclose(demands(found.tool)['angular_acceleration'], 230.0, atol=5.0)


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
    plan = move.plan(500)
    found = steering.steer(MODEL, plan, method)
    assert found.modes and found.residual < steering.MIN_RESIDUAL_SWING
    for tool, swing in ((found.tool, found.residual), (plan, None)):
        _, T = followed(tool, after=0.4, rate=500)
        last = T[round(float(tool.seconds[-1]) * 500) + 1:, :3, :3]
        hanging = quaternion_to_rotation(np.array(rest(MODEL, tool_rows(tool)[-1])[1]))
        largest = angle(last, hanging[None]).max()
        if swing is None:
            assert largest > 2.0
        else:
            assert largest == pytest.approx(math.degrees(swing), abs=0.02)


def test_a_shaper_that_takes_longer_than_allowed_is_not_taken():
    """At 0.998 of the critical damping it would take 4 s; the residual is stated then, too."""
    stiff, inertia = 4.0, 0.00984
    slow = np.diag([5400, 5400, 9200, 4.2, 4.2, stiff])
    damping = np.diag([55, 55, 24, 0.06, 0.06, 2.0 * 0.998 * (stiff * inertia) ** 0.5])
    model = model_tuple(Cup(slow, damping, 0.046), PACKAGE, 9.81)
    found = steering.steer(model, Move([0.0] * 3, [0.0, 0.0, 0.6], 0.2).plan(500), 'zvd')
    assert found.method == 'none' and found.residual > steering.MIN_RESIDUAL_SWING


def test_zv_is_taken_where_zvd_takes_too_long():
    """A torsion of 0.8 Hz: ZVD would add 1.25 s; the residual is that of the simulated motion."""
    slow = np.diag([5400, 5400, 9200, 4.2, 4.2, 0.25])
    damping = np.diag([55, 55, 24, 0.06, 0.06, 0.005])
    model = model_tuple(Cup(slow, damping, 0.046), PACKAGE, 9.81)
    plan = Move([0.0] * 3, [0.0, 0.0, 0.6], 0.5).plan(500)
    found = steering.steer(model, plan, 'zvd')
    run = PlanSimulation(model, None, found.tool, tail=2.0).predict()
    assert found.method == 'zv' and found.residual == pytest.approx(run.residual_swing)
    assert found.residual < 0.1 * PlanSimulation(model, None, plan).predict().residual_swing
    assert steering.steer(model, plan, 'zv').residual == found.residual


@pytest.mark.parametrize('move', [SLIDE, Smooth([0.2, 0.0, 0.1], [0.0, 0.4, 0.0], 0.8)])
def test_the_inverse_ends_without_a_step_of_its_twist(move):
    """At 1 kHz its last 0.1 s ask for less acceleration and jerk than any arm would notice."""
    tool = steering.steer(MODEL, move.plan(), 'inverse').tool
    end = resample(tool, tool.stamps_ns[-1] + 1_000_000 * np.arange(-100, 1))
    twist = np.pad(end.twist, ((0, 3), (0, 0)))
    assert not np.asarray(tool.twist)[-1].any()
    for order, most in ((1, 1.0), (2, 200.0)):
        assert np.abs(np.diff(twist, order, axis=0)[80:]).max() / 1e-3**order < most


@pytest.mark.parametrize('method', ['inverse', 'zv'])
def test_a_plan_of_the_package_is_one(method):
    """What moves the package as wanted moves it as wanted when the package's motion is given."""
    plan = Smooth([0.3, 0.0, 0.0], [0.0, 0.0, 0.5], 0.6).plan()
    wanted = steering.hanging(MODEL, plan)
    of_tool, of_package = (steering.steer(MODEL, each, method, of is not None)
                           for each, of in ((plan, None), (wanted, True)))
    assert_allclose(of_package.tool.position[[0, -1]], plan.position[[0, -1]], atol=2e-5)
    assert_allclose(of_package.tool.position, of_tool.tool.position, atol=2e-5)


def test_what_cannot_be_steered_is_refused():
    plan = SLIDE.plan()
    with pytest.raises(BellowsError):
        steering.steer(MODEL, plan.select(slice(0, 200)), 'zv')
    undamped = model_tuple(Cup(CUP.stiffness, 0.0 * CUP.damping, CUP.length), PACKAGE, 9.81)
    with pytest.raises(BellowsError):
        steering.inverse(undamped, steering.hanging(undamped, plan))
    with pytest.raises(BellowsError, match=r'\b45\b'):
        steering.steer(MODEL, Smooth([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.3).plan(), 'inverse')


def test_the_expected_swing_is_that_of_monte_carlo():
    """100 draws have a root mean square to 7 %; the second order of the rest is a few percent."""
    plan = Smooth([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 0.6).plan(500)
    tool = steering.steer(MODEL, plan, 'inverse').tool
    run = PlanSimulation(MODEL, None, tool, tail=0.5)

    def swing(model):
        return run.with_model(model).predict().summary()['swing_left']

    rng = np.random.default_rng(3)
    std = parameter_std(VALUES)
    draws = parameter_vector(VALUES) + std * rng.standard_normal((100, 52))
    drawn = math.sqrt(np.mean([swing(model_with(MODEL, each)) ** 2 for each in draws]))
    assert_allclose(math.sqrt(mean_square(uncertain_of(VALUES), MODEL, swing)), drawn, rtol=0.15)
