"""Spring, damper and Newton-Euler against the plain 6x6 formulas and against mathematics."""

from contextlib import nullcontext

from bellows_ros.core.geometry.lie import (
    adjoint,
    exp_se3,
    inverse_transform,
    rotation_to_quaternion,
)
from bellows_ros.core.model.cup_package import box_inertia, Cup, model_tuple, Package, regressor
from bellows_ros.core.model.kernels import body_acceleration, cup_wrench, spring_frames, strain
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.model.structure import check_inertia
from bellows_ros.core.parameters.checks import validate
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .. import oracle
from ..cases import random_cup, random_package, random_pose


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


def potential_energy(cup, T):
    """Return the elastic energy P0 (J) (3.17) with the lip at a pose in the tool."""
    R = tuple(T[:3, :3].ravel().tolist())
    o = spring_frames(cup.as_tuple, tuple(T[:3, 3].tolist()), R)
    h = np.concatenate(strain(o, R))
    return h @ cup.stiffness @ h / 8.0


def test_spring_wrench_is_the_gradient_of_the_potential(rng):
    cup, h = random_cup(rng, damping=False), 1e-6
    T = lip_pose(rng, cup)
    slope = [
        (potential_energy(cup, T @ exp_se3(h * d)) - potential_energy(cup, T @ exp_se3(-h * d)))
        / (2 * h)
        for d in np.eye(6)
    ]
    wrench = wrench_at_lip(cup, T, np.zeros(6))
    # central differences of an energy of some 10 J: 1e-16 * 10 / 1e-6
    assert_allclose(wrench, -np.array(slope), atol=5e-8 * np.abs(slope).max())


def test_potential_is_port_indifferent(rng):
    cup = random_cup(rng)
    T = lip_pose(rng, cup)
    H = oracle.spring_frames(cup.length, T)
    assert_allclose(potential_energy(cup, T), oracle.potential(cup.stiffness, H), rtol=1e-12)
    swapped = oracle.potential(cup.stiffness, inverse_transform(H))
    assert_allclose(potential_energy(cup, T), swapped, rtol=1e-12)


def test_damper_takes_energy_and_equals_p_at_nominal(rng):
    cup = random_cup(rng)
    no_spring = Cup(np.zeros((6, 6)), cup.damping, cup.length)
    T, v = lip_pose(rng, cup), rng.standard_normal(6)
    assert wrench_at_lip(no_spring, T, v) @ v < 0.0
    nominal = np.eye(4)
    nominal[2, 3] = -cup.length
    T_S_S1 = np.eye(4)
    T_S_S1[2, 3] = 0.5 * cup.length
    X = adjoint(inverse_transform(T_S_S1))
    assert_allclose(
        wrench_at_lip(no_spring, nominal, v), -X.T @ cup.damping @ X @ v, rtol=1e-12, atol=1e-12
    )


def test_acceleration_equals_newton_euler_with_matrices(rng):
    cup, package, gravity = random_cup(rng), random_package(rng), rng.standard_normal(3)
    T_A_E = random_pose(rng, 2.0, 1.0)
    T_A_B = T_A_E @ lip_pose(rng, cup) @ np.block([
        [np.eye(3), package.com[:, None]], [np.zeros((1, 3)), 1.0]])
    v_E, v_B = rng.standard_normal((2, 6))
    tool, body = (
        state_row(T[:3, 3], rotation_to_quaternion(T[:3, :3]), v)
        for T, v in ((T_A_E, v_E), (T_A_B, v_B))
    )
    rate = np.ravel(body_acceleration(model_tuple(cup, package, gravity), tool, body))
    expected = oracle.acceleration(cup, package, gravity, T_A_E, v_E, T_A_B, v_B)
    assert_allclose(rate, expected, rtol=1e-11, atol=1e-9)


def symmetric_basis():
    """Return the 21 unit matrices of symmetric 6x6 ones, and the entries they stand for."""
    rows, columns = np.triu_indices(6)
    basis = []
    for i, j in zip(rows, columns, strict=True):
        unit = np.zeros((6, 6))
        unit[i, j] = unit[j, i] = 1.0
        basis.append(unit)
    return basis, rows, columns


def test_regressor_times_parameters_is_the_wrench(rng):
    cup = random_cup(rng)
    basis, rows, columns = symmetric_basis()
    T = np.array([lip_pose(rng, cup) for _ in range(7)])
    v = rng.standard_normal((7, 6))
    L = regressor(cup.length, basis, T[:, :3, 3], T[:, :3, :3], v)
    x = np.concatenate([cup.stiffness[rows, columns], cup.damping[rows, columns]])
    expected = [oracle.wrench_at_lip(cup, T[k], v[k]) for k in range(7)]
    assert L.shape == (7, 6, 42)
    assert_allclose(L @ x, expected, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize(('arguments', 'word'), [
    ((np.eye(5), np.eye(6), 0.05), 'stiffness'),
    ((np.eye(6), np.full((6, 6), np.nan), 0.05), 'damping'),
    ((np.triu(np.ones((6, 6))), np.eye(6), 0.05), 'symmetric'),
    ((np.eye(6), np.eye(6), 0.0), 'length'),
])
def test_cup_names_what_is_wrong(arguments, word):
    with pytest.raises(BellowsError, match=word):
        Cup(*arguments)


def of_points(points, masses):
    """Return the inertia of point masses about their centre of mass."""
    r = points - masses @ points / masses.sum()
    return np.einsum('n,nij->ij', masses, (
        np.einsum('ni,ni->n', r, r)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None, :]))


def midpoints(length, count):
    """Return the centres of equal slices of a length around zero."""
    return (np.arange(count) + 0.5) / count * length - length / 2


def test_box_is_that_of_its_points():
    d, w, h, n = 0.3, 0.2, 0.1, 40
    points = np.stack(np.meshgrid(*(midpoints(s, n) for s in (d, w, h))), -1).reshape(-1, 3)
    masses = np.full(len(points), 2.0 / len(points))
    # midpoint sums fall short of the integral of x^2 by 1 / n^2
    assert_allclose(box_inertia(2.0, d, w, h), of_points(points, masses) / (1 - 1 / n**2),
                    atol=1e-12)


@pytest.mark.parametrize(('inertia', 'word'), [
    (np.diag([1.0, 1.0, 3.0]), 'sum of the other two'),
    (np.diag([1.0, 1.0, -1.0]), 'above zero'),
    (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), 'symmetric'),
])
def test_inertia_no_body_can_have_is_refused(inertia, word):
    with pytest.raises(BellowsError, match=word):
        check_inertia(inertia)


@pytest.mark.parametrize(('largest', 'is_taken'), [(2.001999, True), (2.002001, False)])
def test_packages_and_parameters_take_the_same_rounded_inertia(largest, is_taken):
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        Package(1.0, np.diag([1.0, 1.0, largest]), np.zeros(3))
    with nullcontext() if is_taken else pytest.raises(BellowsError):
        validate('package.inertia', [1.0, 1.0, largest, 0.0, 0.0, 0.0])
