"""The shortest safe time against an exhaustive scan; standard deviations against Monte Carlo."""


from bellows_ros.core.model import cup_package
from bellows_ros.core.parameters.conversion import parameter_std, parameter_vector, uncertain_of
from bellows_ros.core.planning.limits import fastest
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import plan_of, timed
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import plans
from ..plans import CUP, GRIP, Move, PACKAGE

MODEL = cup_package.model_tuple(CUP, PACKAGE, 9.81)
VALUES = plans.VALUES.replaced({
    'cup.stiffness_std': 0.01 * CUP.stiffness.ravel(),
    'cup.damping_std': 0.05 * CUP.damping.ravel(),
    'package.mass_std': 0.01, 'package.com_std': (0.001, 0.001, 0.001),
    'package.inertia_std': (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0),
})
EXACT = VALUES.replaced({
    name: np.zeros_like(value) for name, value in VALUES.items() if name.endswith('_std')})


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


def lower_end(values, model, plan, scale):
    """Return the smallest safety factor minus two standard deviations."""
    _, parts = cup_package.contributions(
        uncertain_of(values), model, lambda m: smallest(m, plan, scale))
    return smallest(model, plan, scale) - 2 * np.linalg.norm(parts)


@pytest.mark.parametrize(('plan', 'count'), [
    (Move([0.3, 0.2, -0.2], [0.5, 0.0, 0.8], 0.7).plan(250), 6),
    pytest.param(Move([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], 1.0).plan(500), 60,
                 marks=pytest.mark.stress)])
def test_is_that_of_an_exhaustive_scan(plan, count):
    found = fastest(uncertain_of(VALUES), MODEL, GRIP, plan, 1.5)
    scales = found.scale * np.concatenate([np.geomspace(0.3, 0.98, count), [0.9975, 1.0025]])
    ends = [lower_end(VALUES, MODEL, plan, scale) for scale in scales]
    assert max(ends[:-1]) < 1.5 <= ends[-1]
    assert_allclose(found.factor - 2 * found.std, 1.5, rtol=2e-3)


@pytest.mark.parametrize('least', [1.2, 1.27])
def test_finds_the_window_below_a_resonance(least):
    """Faster than the resonance is safe again, in a window of time scales however narrow."""
    cup = cup_package.Cup(CUP.stiffness, 0.3 * CUP.damping, CUP.length)
    model = cup_package.model_tuple(cup, PACKAGE, 9.81)
    plan = shake(0.005)
    scales = np.geomspace(0.1, 2.0, 300)
    truth = np.array([smallest(model, plan, scale) for scale in scales])
    first = scales[np.argmax(truth >= least)]
    found = fastest(uncertain_of(EXACT), model, GRIP, plan, least)
    assert_allclose(found.scale, first, rtol=0.01)
    assert found.std == 0.0 and found.factor >= least
    slower = truth[(scales > 1.3 * first) & (scales < 1.6 * first)]
    assert slower.max() < least  # a search that assumes more time is safer misses it


def test_nothing_helps_a_package_that_is_too_heavy():
    weak = (GRIP[0] / 3, *GRIP[1:])
    plan = Move([0.1, 0, 0], [0, 0, 0], 1.0).plan(100)
    assert fastest(uncertain_of(VALUES), MODEL, weak, plan, 1.5) is None


def test_each_number_is_changed_in_its_place():
    names = [name for name, _, _ in cup_package.perturbed(uncertain_of(VALUES), MODEL)]
    assert len(names) == 12 + 1 + 3 + 3
    for name, up, down in cup_package.perturbed(uncertain_of(VALUES), MODEL):
        if name == 'package.com[y]':
            assert_allclose((up[1][1], down[1][1]), [(0, 5e-4, -0.03), (0, -5e-4, -0.03)])
            assert up[0] == down[0] == MODEL[0]
        if name == 'cup.stiffness[3,3]':
            assert_allclose(np.array(up[0][2][2]) - MODEL[0][2][2], 0.021 * np.eye(3)[0].repeat(
                [1, 4, 4]), atol=1e-12)


def test_an_unidentifiable_entry_has_full_weight():
    unknown = EXACT.replaced({'cup.stiffness_std': np.full(36, 1e9)})
    assert_allclose(parameter_std(unknown)[0], 5400.0)
    assert_allclose(parameter_std(unknown)[2], np.sqrt(5400.0 * 9200.0))


@pytest.mark.parametrize(('count', 'within'), [
    (200, 0.15),  # three deviations of what chance does to so many
    pytest.param(2000, 0.03, marks=pytest.mark.stress)])
def test_standard_deviations_are_those_of_monte_carlo(count, within):
    plan = Move([0.5, 0.2, -0.1], [0.2, 0.0, 0.4], 0.7).plan(250)
    names = ('smallest_safety_factor', 'peak_bending', 'peak_deflection', 'peak_force',
             'peak_moment', 'rigid_peak_moment', 'swing_left')
    run = PlanSimulation(MODEL, GRIP, plan, tail=0.5)

    def figures(model):
        found = run.with_model(model).predict().summary()
        return np.array([found[name] for name in names])

    _, parts = cup_package.contributions(uncertain_of(VALUES), MODEL, figures)
    rng = np.random.default_rng(8)
    std = parameter_std(VALUES)
    draws = parameter_vector(VALUES) + std * rng.standard_normal((count, 52))
    spread = np.std([figures(cup_package.model_with(MODEL, numbers)) for numbers in draws], axis=0)
    assert_allclose(np.linalg.norm(parts, axis=0), spread, rtol=within)
