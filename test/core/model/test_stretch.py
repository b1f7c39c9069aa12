"""Spring and damper with and without stretch: energy, regressor, rest, and refusals."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.model import equilibrium, kernels
from bellows_ros.core.model.cup_package import model_tuple, regressor
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import require_stretch, STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import cup_of
from bellows_ros.errors import BellowsError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm

from .. import oracle
from ...cell.cup import random_cup, random_package, random_pose
from ...cell.motion import still_tool

STRETCH = (-2e4, -5.0)


@pytest.mark.parametrize('stretch', [STRETCH, (0.0, 0.0)])
def test_the_spring_wrench_is_the_gradient_of_the_energy(stretch):
    rng = np.random.default_rng(1)
    cup, H = replace(random_cup(rng), stretch=stretch), random_pose(rng, 0.5, 0.02)

    def energy(xi):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = hat(xi[3:]), xi[:3]
        return oracle.potential(cup, H @ expm(twist))

    gradient = [(energy(step) - energy(-step)) / 2e-5 for step in 1e-5 * np.eye(6)]
    wrench = kernels.spring_wrench(
        tuple(H[:3, 3].tolist()), tuple(H[:3, :3].ravel().tolist()), cup.as_tuple[2])
    assert_allclose(np.hstack(wrench), np.negative(gradient), rtol=1e-7)


def test_regressor_times_parameters_is_the_wrench():
    rng, full = np.random.default_rng(4), STRUCTURES['full']
    cup = random_cup(rng)
    T = np.array([random_pose(rng, 0.5, 0.02) for _ in range(7)])
    T[:, 2, 3] -= cup.length
    v = rng.standard_normal((7, 6))
    L = regressor(cup.length, full.basis, T[:, :3, 3], T[:, :3, :3], v)
    assert_allclose(L @ full.parameters(cup.stiffness, cup.damping),
                    oracle.wrench_at_lip(cup, T, v), rtol=1e-10, atol=1e-9)


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
    wide = {'cup.valid_low': [-0.01] * 14, 'cup.valid_high': [0.01] * 14}
    with pytest.raises(BellowsError, match=r'cup\.stretch is \[-100000, 0\].* shift of 10 mm'):
        cup_of(resolve({'cup.stretch': [-1e5, 0.0], **package, **wide}))


def test_at_rest_the_second_implementation_does_not_accelerate():
    rng = np.random.default_rng(0)
    cup, package, tool = (
        replace(random_cup(rng), stretch=STRETCH), random_package(rng), random_pose(rng, 0.2))
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
