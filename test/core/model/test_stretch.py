"""Stretch: gradient of the energy, columns of the regressor, passivity, rest, and refusals."""

from dataclasses import replace
import time

from bellows_ros.core.geometry import jit
from bellows_ros.core.model import equilibrium, kernels
from bellows_ros.core.model.cup_package import Cup, cup_of, gripper_of, model_tuple, regressor
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.model.structure import require_stretch, STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm

from .. import complex_step, oracle
from ..cases import random_cup, random_package, random_pose, still_tool

STRETCH = (-2e4, -5.0)
STILL = state_row(np.zeros(3), [0.1, 0.0, 0.0, np.sqrt(0.99)])


def random_stretched(rng):
    return replace(random_cup(rng), stretch=STRETCH)


@pytest.mark.parametrize('seed', range(3))
def test_the_spring_wrench_is_the_gradient_of_the_energy(seed):
    rng = np.random.default_rng(seed)
    cup, H = random_stretched(rng), random_pose(rng, 0.5, 0.02)

    def energy(xi):
        twist = np.zeros((4, 4), dtype=complex)
        twist[:3, :3], twist[:3, 3] = complex_step.hat(xi[3:]), xi[:3]
        return np.array([oracle.potential(cup, H @ expm(twist))])

    gradient = complex_step.derivative(energy, np.zeros(6))[0]
    wrench = kernels.spring_wrench(
        tuple(H[:3, 3].tolist()), tuple(H[:3, :3].ravel().tolist()), cup.as_tuple[2])
    assert_allclose(np.hstack(wrench), -gradient, rtol=1e-11)


def test_the_regressor_has_two_more_columns():
    rng = np.random.default_rng(4)
    cup, full = random_stretched(rng), STRUCTURES['full']
    T = np.array([random_pose(rng, 0.5, 0.02) for _ in range(7)])
    T[:, 2, 3] -= cup.length
    v = rng.standard_normal((7, 6))
    L = regressor(cup.length, full.basis, T[:, :3, 3], T[:, :3, :3], v, True)
    x = np.hstack([full.parameters(cup.stiffness, cup.damping), cup.stretch])
    assert_allclose(L @ x, oracle.wrench_at_lip(cup, T, v), rtol=1e-10, atol=1e-9)


def test_zero_is_no_stretch_bit_for_bit():
    cup = random_cup(np.random.default_rng(7))
    assert replace(cup, stretch=(0.0, -0.0)).as_tuple == cup.as_tuple


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(-5e4, 5e4), st.floats(-20.0, 20.0))
def test_the_energy_is_positive_within_the_validity_range_or_refused(seed, a, b):
    rng = np.random.default_rng(seed)
    K, (low, high) = random_cup(rng).stiffness, (-0.008, 0.004)
    h = rng.standard_normal((2000, 6)) * [0.01, 0.01, 1.0, 0.3, 0.3, 0.3]
    h[:, 2] = rng.uniform(2 * low, 2 * high, len(h))
    energy = np.einsum('ni,ij,nj->n', h, K, h) / 8 + a * h[:, 2] ** 3 + b * h[:, 2] * (
        h[:, 3:5] ** 2).sum(axis=1)
    try:
        require_stretch(K, (a, b), low, high)
    except BellowsError:
        # at one of the ends of the range a direction of no energy exists
        D = np.diag([0.0, 0.0, a, b, b, 0.0])
        assert min(np.linalg.eigvalsh(K + 16 * end * D)[0] for end in (low, high)) <= 0.0
    else:
        assert energy.min() > 0.0


def test_a_cup_file_with_too_much_stretch_is_refused_with_the_reason():
    package = {'package.mass': 1.0, 'package.inertia': [1e-3] * 3 + [0.0] * 3,
               'package.com': [0.0, 0.0, -0.03]}
    soft = resolve({'cup.stretch': [-1e5, 0.0], **package})
    assert cup_of(soft).stretch == (-1e5, 0.0)
    wide = {'envelope.deflection_low': [-0.01] * 6, 'envelope.deflection_high': [0.01] * 6}
    with pytest.raises(BellowsError, match=r'cup\.stretch is \[-100000, 0\].* shift of 10 mm'):
        cup_of(resolve({'cup.stretch': [-1e5, 0.0], **package, **wide}))


def test_several_cups_have_no_stretch():
    two = np.array([[0.05, 0.0, 0.0, 0.0], [-0.05, 0.0, 0.0, 1.0]])
    cup = replace(Cup.thesis(), stretch=STRETCH)
    assert gripper_of(cup, np.zeros((1, 4))).stretch == STRETCH
    with pytest.raises(BellowsError, match=r'cup\.stretch.*2 cups'):
        gripper_of(cup, two)


@pytest.mark.parametrize('stretch', [(np.nan, 0.0), (1.0,), ('a', 'b')])
def test_coefficients_are_two_finite_numbers(stretch):
    with pytest.raises(BellowsError, match=r'cup\.stretch'):
        replace(Cup.thesis(), stretch=stretch)


@pytest.mark.parametrize('seed', range(3))
def test_at_rest_the_second_implementation_does_not_accelerate(seed):
    rng = np.random.default_rng(seed)
    cup, package, tool = random_stretched(rng), random_package(rng), random_pose(rng, 0.2)
    gravity, zero = np.array([0.0, 0.0, -9.81]), np.zeros(6)
    held = still_tool(tool, 10**9, 1)
    body = simulate(cup, package, held)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = body.rotation[0], body.position[0]
    residual = oracle.acceleration(cup, package, gravity, tool, zero, T, zero)
    assert_allclose(residual, 0.0, atol=1e-6)
    model, plain = (model_tuple(each, package, gravity) for each in (
        cup, replace(cup, stretch=(0.0, 0.0))))
    assert_allclose(equilibrium.nominal_system_matrix(model),
                    equilibrium.nominal_system_matrix(plain), rtol=0.0)


def test_undamped_energy_is_constant():
    rng = np.random.default_rng(3)
    cup, package = replace(random_cup(rng, damping=False), stretch=STRETCH), random_package(rng)
    start = state_row(package.com - [0.002, 0.0, cup.length], [0.0, 0.06, 0.0, np.sqrt(0.9964)],
                      0.1 * np.ones(6))
    body = simulate(cup, package, still_tool(np.eye(4), 10**9, 1000), start, substeps=5)
    total = []
    for o, R, v in zip(body.position, body.rotation, body.twist, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, o
        total.append(oracle.energies(
            cup, package, np.array([0.0, 0.0, -9.81]), np.eye(4), T, v).sum())
    assert np.ptp(total) < 1e-6


@pytest.mark.skipif(not jit.COMPILED, reason='the time of compiled kernels')
def test_a_step_with_stretch_takes_hardly_longer():
    package = random_package(np.random.default_rng(1))
    models = [model_tuple(replace(Cup.thesis(), stretch=each), package, 9.81)
              for each in ((0.0, 0.0), STRETCH)]
    hangs = [equilibrium.static_equilibrium(model, STILL) for model in models]
    times = [[], []]
    for _ in range(150):  # alternately, and the shortest: load of the machine counts for both
        for model, body, each in zip(models, hangs, times, strict=True):
            begin = time.perf_counter()
            kernels.advance(model, body, STILL, STILL, 0.2, 400)
            each.append(time.perf_counter() - begin)
    assert min(times[1]) < 1.1 * min(times[0])
