"""Demands against closed forms, shortest times against scans, deviations against draws."""

from dataclasses import replace
import math

from bellows_ros.core.model import cup_package
from bellows_ros.core.parameters.conversion import parameter_std, parameter_vector, uncertain_of
from bellows_ros.core.planning.limits import (
    demands,
    fastest,
    first_allowed,
    RATES,
    read_limits,
    used_parts,
)
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import plan_of, timed
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import CUP, GRIP, PACKAGE, VALUES
from ...cell.motion import Move

MODEL = cup_package.model_tuple(CUP, PACKAGE, 9.81)
VALUES = VALUES.replaced({
    'cup.stiffness_std': 0.01 * CUP.stiffness.ravel(),
    'cup.damping_std': 0.05 * CUP.damping.ravel(),
    'package.mass_std': 0.01, 'package.com_std': (0.001, 0.001, 0.001),
    'package.inertia_std': (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0)})
EXACT = VALUES.replaced({
    name: np.zeros_like(value) for name, value in VALUES.items() if name.endswith('_std')})
PLAN = Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.9], 0.8).plan()
NO_LIMITS = read_limits({})


def test_demands_are_those_of_the_quintic():
    """15/8 D/T, 10/sqrt(3) D/T^2 and 60 D/T^3, the last one reached at the very ends."""
    found = demands(PLAN)
    for names, size in ((tuple(RATES)[:3], 0.6), (tuple(RATES)[3:], 0.9)):
        truth = (15 / 8 * size / 0.8, 10 / math.sqrt(3) * size / 0.8**2, 60 * size / 0.8**3)
        assert_allclose([found[name] for name in names[:2]], truth[:2], rtol=1e-3)
        assert_allclose(found[names[2]], truth[2], rtol=0.03)


def test_a_step_of_one_millisecond_counts():
    """Drives take set points at 1 kHz; between points 4 ms apart this jolt is four times less."""
    rows = PLAN.twist.copy()
    at = np.linspace(0.0, 0.8, len(PLAN))
    rows[:, 0] += 0.01 * np.exp(-((at - 0.4) / 7e-4) ** 2)
    jolted = replace(PLAN, twist=rows)
    assert demands(jolted)['acceleration'] > 1.5 * demands(PLAN)['acceleration']


def test_each_limit_counts():
    def exceeded(limits, factor=0.0):
        return [name for name, part in used_parts(limits, PLAN, factor).items() if part > 1.0]

    assert exceeded(NO_LIMITS) == []
    for name, size in demands(PLAN).items():
        for factor, expected in ((0.99, [name]), (1.01, [])):
            limits = NO_LIMITS._replace(rates={**NO_LIMITS.rates, name: factor * size})
            assert exceeded(limits) == expected
    assert exceeded(NO_LIMITS._replace(safety_factor=2.0), 1.9) == ['safety_factor']
    box = NO_LIMITS._replace(low=np.full(3, -0.1), high=np.array([0.5, 0.1, 0.1]))
    assert exceeded(box) == ['workspace']


def test_the_first_allowed_time_is_found_though_slower_ones_are_not_allowed():
    """Allowed from 1.3 to 1.4 and above 2; the limit of the time just before is named."""
    def limit_at(scale):
        return '' if 1.3 <= scale <= 1.4 or scale > 2.0 else 'fast' if scale < 1.2 else 'later'

    scale, limit = first_allowed(limit_at)
    assert limit == 'later' and 1.3 <= scale < 1.3 * 1.001
    assert first_allowed(lambda scale: '') == (1.0, '')
    with pytest.raises(BellowsError, match='jerk even at 20'):
        first_allowed(lambda scale: 'jerk')


def shake(size, duration=2.0, cycles=6):
    """Return a tool that shakes sideways, swelling and fading: it meets the bending mode."""
    t = np.linspace(0.0, duration, 501)
    w = 2 * np.pi * cycles / duration
    swell, slope = np.sin(np.pi * t / duration) ** 2, np.pi / duration * np.sin(
        2 * np.pi * t / duration)
    poses, v = np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(t), 1)), np.zeros((len(t), 6))
    poses[:, 0] = size * swell * np.sin(w * t)
    v[:, 0] = size * (slope * np.sin(w * t) + swell * w * np.cos(w * t))
    return plan_of(np.round(t * 1e9).astype(np.int64), poses, v).trajectory()


def smallest(model, plan, scale):
    """Return the smallest safety factor of a plan driven so many times as slowly."""
    run = PlanSimulation(model, GRIP, timed(plan, scale), tail=1.0)
    return np.array(run.predict().smallest_safety[0])


def lower_end(plan, scale):
    """Return the smallest safety factor minus two standard deviations."""
    _, parts = cup_package.contributions(
        uncertain_of(VALUES), MODEL, lambda m: smallest(m, plan, scale))
    return smallest(MODEL, plan, scale) - 2 * np.linalg.norm(parts)


def test_the_shortest_safe_time_is_that_of_an_exhaustive_scan():
    plan = Move([0.3, 0.2, -0.2], [0.5, 0.0, 0.8], 0.7).plan(250)
    found = fastest(uncertain_of(VALUES), MODEL, GRIP, plan, 1.5)
    scales = found.scale * np.concatenate([np.geomspace(0.3, 0.98, 3), [0.9975, 1.0025]])
    ends = [lower_end(plan, scale) for scale in scales]
    assert max(ends[:-1]) < 1.5 <= ends[-1]
    assert_allclose(found.factor - 2 * found.std, 1.5, rtol=2e-3)
    weak = (GRIP[0] / 3, *GRIP[1:])
    assert fastest(uncertain_of(EXACT), MODEL, weak, plan, 1.5) is None


def test_finds_the_window_below_a_resonance():
    """Faster than the resonance is safe again: a search that assumes monotony misses it."""
    model = cup_package.model_tuple(
        cup_package.Cup(CUP.stiffness, 0.3 * CUP.damping, CUP.length), PACKAGE, 9.81)
    plan, least = shake(0.005), 1.2
    scales = np.geomspace(0.1, 2.0, 300)
    truth = np.array([smallest(model, plan, scale) for scale in scales])
    first = scales[np.argmax(truth >= least)]
    found = fastest(uncertain_of(EXACT), model, GRIP, plan, least)
    assert_allclose(found.scale, first, rtol=0.01)
    assert found.std == 0.0 and found.factor >= least
    assert truth[(scales > 1.3 * first) & (scales < 1.6 * first)].max() < least


def test_standard_deviations_are_those_of_monte_carlo():
    """Within 15 %: three deviations of chance in 200 draws."""
    plan = Move([0.5, 0.2, -0.1], [0.2, 0.0, 0.4], 0.7).plan(250)
    names = ('smallest_safety_factor', 'peak_bending', 'peak_force', 'peak_moment', 'swing_left')
    run = PlanSimulation(MODEL, GRIP, plan, tail=0.5)

    def figures(model):
        found = run.with_model(model).predict().summary()
        return np.array([found[name] for name in names])

    _, parts = cup_package.contributions(uncertain_of(VALUES), MODEL, figures)
    rng, std = np.random.default_rng(8), parameter_std(VALUES)
    draws = parameter_vector(VALUES) + std * rng.standard_normal((200, 52))
    spread = np.std([figures(cup_package.model_with(MODEL, numbers)) for numbers in draws], axis=0)
    assert_allclose(np.linalg.norm(parts, axis=0), spread, rtol=0.15)
