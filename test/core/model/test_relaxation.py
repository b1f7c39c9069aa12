"""Rubber that relaxes, against a second implementation, and its limits."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import adjoint, inverse_transform
from bellows_ros.core.geometry.tuples import unit
from bellows_ros.core.model import equilibrium, jacobians
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.kernels import lip_strain, lip_wrench, spring_wrench, with_strains
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_integrator import pair, random_strains
from .test_jacobians import Case, near, six_by_six
from .. import complex_step
from ..cases import random_cup, random_package, random_pose, state_of, still_tool

R = (0.3, 0.2)
STILL = state_row(np.zeros(3), [0.0, 0.0, 0.0, 1.0])


def test_both_ports_agree():
    rng = np.random.default_rng(1)
    K = random_cup(rng)
    blocks, branches = K.as_tuple[2], ((0.3, 0.06), (0.2, 0.8))
    H = random_pose(rng, 0.5, 0.02)
    back, z = inverse_transform(H), random_strains(rng)
    (f, m), (g, n) = (
        spring_wrench(
            tuple(T[:3, 3].tolist()), tuple(T[:3, :3].ravel().tolist()), blocks, branches,
            tuple(map(pair, sign * z)))
        for T, sign in ((H, 1.0), (back, -1.0)))
    # power at one port is that at the other: the twist at S2 is -X(H) times that at S1
    assert_allclose(np.hstack([f, m]), -adjoint(H).T @ np.hstack([g, n]), rtol=1e-11)


@pytest.mark.parametrize('none', [
    {'relaxation': (0.0, 0.0), 'relaxation_times': (0.01, 0.02)}, {'stretch': (0.0, -0.0)}])
def test_no_strength_and_no_stretch_are_none_bit_for_bit(none):
    plain = random_cup(np.random.default_rng(7))
    assert replace(plain, **none).as_tuple == plain.as_tuple


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


def derivatives_case(seed, relaxes, stretch=(0.0, 0.0)):
    """Return a case, its rows for the kernels, its strains, and its acceleration by all of it."""
    case, rng = Case(seed, stretch), np.random.default_rng(seed)
    r, z = R[:2 * relaxes], random_strains(rng)[:2 * relaxes]
    model = ((*case.model[0], *zip(r, (0.06, 0.8), strict=False)), *case.model[1:])
    rows = model, state_of(*case.tool), with_strains(state_of(*case.body), tuple(map(pair, z)))

    def accelerate(numbers=case.numbers, tool=case.tool, body=case.body, r=r, strains=z):
        return complex_step.acceleration(numbers, tool, body, r, strains)

    return case, rows, z, accelerate


@pytest.mark.parametrize('stretch', [(0.0, 0.0), (-2e4, -5.0)])
@pytest.mark.parametrize('relaxes', [False, True])
def test_accelerations_follow_states_and_parameters(relaxes, stretch):
    case, rows, _, accelerate = derivatives_case(1, relaxes, stretch)
    for name, state, derivatives in (('body', case.body, jacobians.body_jacobians),
                                     ('tool', case.tool, jacobians.tool_jacobians)):
        pose, twist = derivatives(*rows)
        expected = complex_step.derivative(
            lambda x, name=name, state=state: accelerate(
                **{name: complex_step.changed(state, x)}), np.zeros(12))
        near(six_by_six(pose), expected[:, :6], 1e-12)
        near(six_by_six(twist), expected[:, 6:], 1e-12)
    out = np.zeros((6, jacobians.PARAMETER_COLUMNS))
    jacobians.parameter_jacobian(*rows, 0, jacobians.PARAMETER_COLUMNS, out)
    expected = complex_step.derivative(accelerate, case.numbers)
    for column in range(jacobians.PARAMETER_COLUMNS):
        near(out[:, column], expected[:, column], 1e-11)


def test_accelerations_follow_strengths_and_strains():
    _, rows, z, accelerate = derivatives_case(0, True)
    out = np.zeros((6, 2))
    jacobians.relaxation_jacobian(*rows, out, 0)
    near(out, complex_step.derivative(lambda r: accelerate(r=r), R), 1e-12)
    by_strain, by_pose = map(six_by_six, jacobians.strain_jacobians(*rows))
    expected = complex_step.derivative(
        lambda x: accelerate(strains=x.reshape(2, 6)), z.ravel())
    near(np.hstack([R[0] * by_strain, R[1] * by_strain]), expected, 1e-12)
    zero = (0.0, 0.0, 0.0)
    expected = np.transpose([np.subtract(*(np.hstack(lip_strain(*rows[:2], equilibrium.moved(
        rows[2], unit(j, d), unit(j - 3, d), zero, zero))) for d in (1e-6, -1e-6))) / 2e-6
        for j in range(6)])
    near(by_pose, expected, 1e-8)  # central differences


@pytest.mark.parametrize('relaxation', [(0.0, 0.0), R])
def test_nominal_motions_are_those_of_the_linearised_model(relaxation):
    rng = np.random.default_rng(11)
    cup = replace(random_cup(rng), relaxation=relaxation)
    model = model_tuple(cup, random_package(rng), (1.0, -2.0, -9.0))
    tool = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    near(equilibrium.nominal_system_matrix(model), equilibrium.system_matrix(
        model, tool, equilibrium.resting_on_tool(model, tool)), 1e-12)


def test_modes_are_those_of_the_complex_stiffness():
    rng = np.random.default_rng(8)
    cup, package = replace(random_cup(rng), relaxation=R), random_package(rng)
    values = np.linalg.eigvals(equilibrium.nominal_system_matrix(model_tuple(cup, package, 0.0)))
    for s in values[np.abs(values.imag) > 1.0]:
        growth = sum(r * s * tau / (1.0 + s * tau) for r, tau in zip(
            cup.relaxation, cup.relaxation_times, strict=True))
        by_static, by_damping = (
            equilibrium.nominal_system_matrix(model_tuple(Cup(K, P, cup.length), package, 0.0))[6:]
            for K, P in ((cup.stiffness, np.zeros((6, 6))), (np.zeros((6, 6)), cup.damping)))
        A = s * s * np.eye(6) - (1.0 + growth) * by_static[:, :6] - s * by_damping[:, 6:]
        assert np.linalg.svd(A, compute_uv=False)[-1] < 1e-8 * abs(s) ** 2


@pytest.mark.parametrize(('arguments', 'word'), [
    ({'stiffness': np.eye(5)}, 'stiffness'), ({'damping': np.full((6, 6), np.nan)}, 'damping'),
    ({'stiffness': np.triu(np.ones((6, 6)))}, 'symmetric'), ({'length': 0.0}, 'length'),
    *(({'relaxation': wrong}, 'cup.relaxation') for wrong in ((-0.1, 0.2), (0.1,), (0.1, np.nan))),
    *(({'relaxation_times': x}, 'cup.relaxation_times') for x in ((0.8, 0.06), (0.0, 0.06))),
    *(({'stretch': wrong}, 'cup.stretch') for wrong in ((np.nan, 0.0), (1.0,), ('a', 'b')))])
def test_a_cup_names_what_is_wrong(arguments, word):
    with pytest.raises(BellowsError, match=word):
        replace(Cup.thesis(), **arguments)


def test_steps_are_short_enough_for_the_shortest_time():
    cup = replace(Cup.thesis(), relaxation=R, relaxation_times=(1e-5, 0.8))
    rng = np.random.default_rng(9)
    body = simulate(cup, random_package(rng), still_tool(np.eye(4), 10**8, 10))
    assert np.isfinite(body.position).all()
