"""Structures of K and P, and a gripper of several cups against the sum over its cups."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3, transform
from bellows_ros.core.model.cup_package import Cup, LAW, model_with, TERMS
from bellows_ros.core.model.grip import least_factors, mode_name, safety_factors
from bellows_ros.core.model.kernels import cup_wrench
from bellows_ros.core.model.structure import (
    composition,
    has_coupling,
    STRUCTURES,
    UPPER,
)
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from hypothesis import given, settings, strategies
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_kernels import pair
from .. import oracle
from ...cell.cup import random_cup

COUPLED = STRUCTURES['axisymmetric_coupled']
SCALE = np.array([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_parameters_and_matrices_undo_each_other(name):
    structure = STRUCTURES[name]
    x = np.random.default_rng(1).standard_normal(2 * structure.size)
    K, P = structure.matrices(x)
    assert np.array_equal(K, K.T)
    assert_allclose(structure.parameters(K, P), x, rtol=1e-14)
    for number, (i, j) in enumerate(structure.leads):
        assert K[i, j] == x[number]


def test_the_coupled_structure_is_a_centre_of_stiffness_off_the_middle():
    """Move a diagonal K along z by the adjoint (2.24): what comes out is of this structure."""
    shift = 0.004
    X = np.eye(6)
    X[:3, 3:] = [[0.0, -shift, 0.0], [shift, 0.0, 0.0], [0.0, 0.0, 0.0]]
    K = X.T @ np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35]) @ X
    assert_allclose(COUPLED.matrices(COUPLED.parameters(K, K))[0], K, rtol=1e-13)
    assert K[0, 4] == pytest.approx(-K[1, 3], rel=1e-13)
    assert COUPLED.labels[:5] == ('K x', 'K x-ry', 'K z', 'K rx', 'K rz')


@pytest.mark.parametrize('name', list(STRUCTURES))
def test_pooled_covariances_are_those_of_pooled_vectors(name):
    """Stack the vectors of tied blocks, signs applied: their covariance stands in each block."""
    structure = STRUCTURES[name]
    vectors = np.random.default_rng(4).standard_normal((50, 6)) @ np.diag(SCALE) + SCALE
    mean = vectors.mean(axis=0)
    scatter = (vectors - mean).T @ (vectors - mean)
    Q = structure.covariance(len(vectors), mean, scatter)
    expected = np.zeros((6, 6))
    for blocks in structure.blocks:
        signed = [vectors[:, [i for i, _ in block]] * [s for _, s in block] for block in blocks]
        pooled = np.atleast_2d(np.cov(np.concatenate(signed).T))
        for block in blocks:
            for one, (i, s) in enumerate(block):
                for other, (j, t) in enumerate(block):
                    expected[i, j] = s * t * pooled[one, other]
    assert_allclose(Q, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(('shift', 'expected'), [(0.0, False), (5e-5, False), (4.6e-3, True)])
def test_a_centre_of_stiffness_in_the_middle_is_no_coupling(shift, expected):
    """A shift below the uncertainty of a cup's length is none; 4.6 mm is one of a real bellows."""
    K = np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])
    K[0, 4] = K[4, 0] = 5400.0 * shift
    assert has_coupling(K) == expected


FOUR = (0.06, 0.04, 0.0, 0.06, -0.04, 0.0, -0.06, 0.04, 0.0, -0.06, -0.04, 0.01)
PACKAGE = {'package.mass': 2.0, 'package.com': [0.0, 0.0, -0.03],
           'package.inertia': [0.01, 0.01, 0.01, 0.0, 0.0, 0.0]}


def test_the_terms_of_a_cup_replace_all_terms_of_the_cup_before():
    """Set a whole cup over a gripper of relaxing cups, and read every term again."""
    law = {name: (0.3,) * len(term.symbols) for name, term in LAW.items()}
    before = {'cup.layout': FOUR, 'cup.relaxation': (0.2, 0.1)}
    for cup in (random_cup(np.random.default_rng(0)), Cup.thesis().with_terms(law)):
        found = conversion.cup_of(resolve({**PACKAGE, **before, **cup.parameters()}))
        for name in TERMS.keys() - {'layout'}:
            assert_allclose(getattr(found, name), getattr(cup, name), rtol=0.0)
    words = r'stretch is \[0.3, 0.3\].* expected \[0.0, 0.0\] with'
    with pytest.raises(BellowsError, match=words):
        conversion.cup_of(resolve({**PACKAGE, **cup.parameters(), 'cup.layout': FOUR}))


def case(seed, count, relaxes=False):
    """Return values of a gripper of full random cups, one of them, and a random motion."""
    rng = np.random.default_rng(seed)
    cup = replace(random_cup(rng), relaxation=(0.2, 0.1) if relaxes else (0.0, 0.0))
    layout = rng.uniform(-0.2, 0.2, (count, 3)) + 0.5 * np.arange(count)[:, None] * [1, 0, 0] / 8
    values = resolve({
        **PACKAGE, 'cup.stiffness': cup.stiffness.ravel(), 'cup.damping': cup.damping.ravel(),
        'cup.length': cup.length, 'cup.relaxation': cup.relaxation,
        'cup.layout': layout.ravel(), 'cup.lip_radius': 0.02, 'vacuum.holding': 6e4})
    axis = rng.normal(size=3)
    R = exp_so3(axis / np.linalg.norm(axis) * np.radians(30.0) * rng.uniform(0.0, 1.0))
    o = np.array([0.0, 0.0, -0.05]) + rng.uniform(-0.02, 0.02, 3)
    strains = rng.normal(size=(2, 6)) * 0.01 if relaxes else np.empty((0, 6))
    return (values, cup, layout, o, R,
            rng.normal(size=6) * [0.3, 0.3, 0.3, 2.0, 2.0, 2.0], strains)


def one_by_one(one, layout, o, R, twist, strains):
    """Return the wrench of each cup (n, 6) at its own lip, in S axes."""
    out = []
    for a in layout:
        moved = twist + np.append(np.cross(twist[3:], a), np.zeros(3))
        inner = [z - np.append(np.cross(a, z[3:]), np.zeros(3)) for z in strains]
        out.append(oracle.wrench_at_lip(
            one, transform(R, o + R @ a - a), moved, np.ravel(inner)))
    return np.array(out)


def kernel_arguments(o, R, twist, strains):
    """Return pose, twist and strains as the kernels take them."""
    return (tuple(o.tolist()), tuple(R.ravel().tolist()), *pair(twist), tuple(map(pair, strains)))


@settings(deadline=None, max_examples=60)
@given(strategies.integers(0, 10**6), strategies.integers(1, 12), strategies.booleans())
def test_the_composed_wrench_is_the_sum_over_the_cups(seed, count, relaxes):
    """To rounding, at any bend, in motion, with full K and P, and rubber that relaxes."""
    values, one, layout, o, R, twist, strains = case(seed, count, relaxes)
    each = one_by_one(one, layout, o, R, twist, strains)
    force = each[:, :3].sum(axis=0)
    moment = (each[:, 3:] + np.cross(layout, each[:, :3])).sum(axis=0)
    f, m = cup_wrench(conversion.cup_of(values).as_tuple, *kernel_arguments(o, R, twist, strains))
    scale = np.abs(each[:, :3]).sum()
    assert_allclose(f, force, rtol=0.0, atol=1e-12 * scale)
    assert_allclose(m, moment, rtol=0.0, atol=1e-12 * scale)


@settings(deadline=None, max_examples=30)
@given(strategies.integers(0, 10**6), strategies.integers(2, 8), strategies.booleans())
def test_the_margin_is_that_of_the_worst_cup(seed, count, relaxes):
    """Of each cup's own wrench, by the second implementation, to 1e-9; and it is named."""
    values, one, layout, o, R, twist, strains = case(seed, count, relaxes)
    below = 4e4 * np.random.default_rng(seed).uniform(1.0, 1.9, count)
    below[-1] = 4e4  # without a sensor: the least vacuum
    grip = conversion.grip_of(values, 4e4, dict(enumerate(below[:-1].tolist())))
    arguments = kernel_arguments(o, R, twist, strains)
    cup = conversion.cup_of(values).as_tuple
    peel, slip, peeling, slipping = least_factors(grip, cup, *arguments, (), ())
    each = np.array([
        safety_factors((grip[0] * ratio, *grip[1:3]), tuple(w[:3]), tuple(w[3:]))
        for ratio, w in zip(below / 4e4, one_by_one(one, layout, o, R, twist, strains),
                            strict=True)])
    assert_allclose((peel, slip), each.min(axis=0), rtol=1e-9)
    assert (peeling, slipping) == tuple(each.argmin(axis=0))
    assert f'peel of cup {peeling} at x {layout[peeling, 0]:g} m' in mode_name(grip, 0, peeling)


def test_a_cup_that_does_not_hold_leaves_stiffness_and_margin():
    """The rest keep their numbers."""
    values = resolve({**PACKAGE, 'cup.layout': FOUR, 'cup.open': [2], 'cup.lip_radius': 0.02,
                      'vacuum.holding': 6e4})
    left = resolve({**PACKAGE, 'cup.layout': FOUR[:6] + FOUR[9:]})
    found, expected = (conversion.cup_of(each).stiffness for each in (values, left))
    assert_allclose(found, expected, rtol=1e-15)
    assert conversion.grip_of(values)[3][:, 3].tolist() == [0.0, 1.0, 3.0]
    assert mode_name(conversion.grip_of(values), 1, 2).startswith('slip of cup 3 at x -0.06 m')


def test_the_covariance_is_that_of_one_cups_entries():
    """The composed entries vary as one cup's do, by the same linear map."""
    values = resolve({**PACKAGE, 'cup.layout': FOUR, 'cup.stiffness_std': 10.0 * np.ones(36)})
    places, rng = conversion.places_of(values), np.random.default_rng(3)
    cup, numbers = conversion.cup_of(values), conversion.parameter_vector(values)
    model = (cup.as_tuple, (2.0, (0.0,) * 3, (1.0,) * 9, (1.0,) * 9), (0.0,) * 3)
    blocks = model_with(model, numbers, places)[0][2][:3]
    assert_allclose(np.array(blocks), np.array(cup.as_tuple[2][:3]), rtol=1e-14)
    step = conversion.parameter_std(values)[:21] * rng.standard_normal(21)
    other = model_with(model, numbers + np.append(step, np.zeros(31)), places)[0][2]
    K = np.block([[np.reshape(other[0], (3, 3)), np.reshape(other[1], (3, 3))],
                  [np.reshape(other[1], (3, 3)).T, np.reshape(other[2], (3, 3))]])
    assert_allclose((K - cup.stiffness)[UPPER], composition(places) @ step, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(('layout', 'open_cups', 'figures'), [
    ([0.1, 0.0], [], r'layout\b.* 2 numbers'), ([], [], r'layout\b.* 0 numbers'),
    ([0.0] * 6, [], r'layout\b.* 0 and 1\b.* 0 mm'),
    ([0.0, 0.0, 0.0, 0.001, 0.0, 0.0], [], r'layout\b.* 1 mm'),
    ([0.06, 0.0, 0.0, 6.0, 0.0, 0.0], [], r'layout\b.* 6 m\b.* mm\b'),
    ([x for k in range(33) for x in (0.02 * k, 0.0, 0.0)], [], r'layout\b.* 33 cups'),
    (FOUR, [4.0], r'open\b.* 4\b.* 0 to 3\b'), (FOUR, [1.5], r'open\b.* 1\.5\b.* 0 to 3\b'),
    (FOUR, [0, 1, 2, 3], 'open')])
def test_refuses_what_is_no_gripper(layout, open_cups, figures):
    with pytest.raises(BellowsError, match=rf'cup\.{figures}'):
        conversion.cup_of(resolve({**PACKAGE, 'cup.layout': layout, 'cup.open': open_cups}))
