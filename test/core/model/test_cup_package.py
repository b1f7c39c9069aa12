"""Spring and damper against the plain 6x6 formulas and against mathematics."""

from contextlib import nullcontext

from bellows_ros.core.geometry.lie import exp_se3
from bellows_ros.core.model.cup_package import box_inertia, Package, regressor
from bellows_ros.core.model.kernels import cup_wrench
from bellows_ros.core.model.structure import check_inertia, STRUCTURES
from bellows_ros.core.parameters.checks import validate
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import oracle
from ..cases import random_cup, random_pose


@pytest.fixture(params=range(2))
def rng(request):
    return np.random.default_rng(request.param)


def lip_pose(rng, cup, angle=0.5):
    """Return a pose of the lip near nominal."""
    T = random_pose(rng, angle, 0.02)
    T[2, 3] -= cup.length
    return T


def wrench_at_lip(cup, T, v):
    """Return the wrench (6,) of the kernel for pose and twist of the lip in the tool."""
    parts = (T[:3, 3], T[:3, :3].ravel(), v[:3], v[3:])
    return np.concatenate(cup_wrench(cup.as_tuple, *(tuple(part.tolist()) for part in parts)))


def test_spring_wrench_is_the_gradient_of_the_potential(rng):
    cup, h = random_cup(rng, damping=False), 1e-6
    T = lip_pose(rng, cup)
    before, after = ([
        oracle.potential(cup, oracle.spring_frames(cup.length, T @ exp_se3(side * d)))
        for d in np.eye(6)] for side in (-h, h))
    slope = np.subtract(after, before) / (2 * h)
    wrench = wrench_at_lip(cup, T, np.zeros(6))
    # central differences of an energy of some 10 J: 1e-16 * 10 / 1e-6
    assert_allclose(wrench, -slope, atol=5e-8 * np.abs(slope).max())


def test_regressor_times_parameters_is_the_wrench(rng):
    cup = random_cup(rng)
    T = np.array([lip_pose(rng, cup) for _ in range(7)])
    v = rng.standard_normal((7, 6))
    full = STRUCTURES['full']
    L = regressor(cup.length, full.basis, T[:, :3, 3], T[:, :3, :3], v)
    x, expected = full.parameters(cup.stiffness, cup.damping), oracle.wrench_at_lip(cup, T, v)
    assert L.shape == (7, 6, 42)
    assert_allclose(L @ x, expected, rtol=1e-11, atol=1e-9)


def test_a_box_is_its_two_halves():
    """Halves along x, each moved by a quarter of the depth: only 1/12 of the squares does so."""
    half = box_inertia(1.0, 0.15, 0.2, 0.1) + np.diag([0.0, 1.0, 1.0]) * 0.075**2
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1), 2.0 * half, rtol=1e-14)
    assert_allclose(box_inertia(2.0, 0.3, 0.2, 0.1).diagonal()[[1, 0, 2]],
                    box_inertia(2.0, 0.2, 0.3, 0.1).diagonal(), rtol=1e-14)


@pytest.mark.parametrize(('inertia', 'figures'), [
    (np.diag([1.0, 1.0, 3.0]), '1, 1, 3 kg m'), (np.diag([1.0, 1.0, -1.0]), '-1, 1, 1 kg m'),
    (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), r'row 1, column 2\b.* 0\.1\b')])
def test_inertia_no_body_can_have_is_refused(inertia, figures):
    with pytest.raises(BellowsError, match=rf'package\.inertia.*{figures}'):
        check_inertia(inertia)


@pytest.mark.parametrize(('largest', 'is_taken'), [(2.001999, True), (2.002001, False)])
def test_packages_and_parameters_take_the_same_rounded_inertia(largest, is_taken):
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        Package(1.0, np.diag([1.0, 1.0, largest]), np.zeros(3))
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        validate('package.inertia', [1.0, 1.0, largest, 0.0, 0.0, 0.0])
