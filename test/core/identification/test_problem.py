"""Own unknowns of recordings are eliminated as by a dense solve; sums have one order."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.causes import significant
from bellows_ros.core.identification.estimate import minimise
from bellows_ros.core.identification.result import Arrow
from bellows_ros.core.identification.segments import here
from bellows_ros.core.identification.unknowns import Problem, weak_prior
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_output_error import AXISYMMETRIC, measured, TRUTH

FREE = weak_prior(['time_offset', 'package_marker', 'length'])


def problem_of(seeds, change):
    """Return the problem of recordings with three kinds of free quantities."""
    return Problem.of([
        change(replace(measured(seed, package_hz=60.0, duration=4.0), recording=number))
        for number, seed in enumerate(seeds)], AXISYMMETRIC, TRUTH, FREE)


def test_steps_and_variances_are_those_of_the_whole():
    """Of three recordings with two own unknowns each, beside four shared ones."""
    rng, places = np.random.default_rng(5), np.array([[4, 5], [6, 7], [8, 9]])
    J = [rng.standard_normal((30, 10)) for _ in places]
    for rows, own in zip(J, places, strict=True):
        rows[:, np.setdiff1d(np.arange(4, 10), own)] = 0.0
    H, g = sum(rows.T @ rows for rows in J), rng.standard_normal(10)
    arrow = Arrow(H[:4, :4], np.array([H[np.ix_(own, range(4))] for own in places]),
                  np.array([H[np.ix_(own, own)] for own in places]), places)
    C, used = np.linalg.inv(H), np.arange(10) % 3 > 0
    assert_allclose(arrow.solve(g), C @ g, rtol=1e-9)
    assert_allclose(arrow.variances, np.diag(C), rtol=1e-9)
    assert_allclose(arrow.times(g), H @ g, rtol=1e-9)
    chosen = [0, 1, 2, 3, *places[1]]
    assert_allclose(arrow.block(1), C[np.ix_(chosen, chosen)], rtol=1e-9, atol=1e-12)
    assert_allclose(arrow.fall(g, used), g[used] @ np.linalg.solve(
        H[np.ix_(used, used)], g[used]), rtol=1e-9)


@pytest.mark.parametrize('is_off', [False, True])
def test_a_wrong_world_of_all_recordings_is_seen(is_off):
    """By chance chi² falls by six for each recording, by some 50 for all."""
    problem = problem_of(range(1, 9), in_another_world if is_off else lambda each: each)
    found = minimise(replace(problem, free={}))
    assert found.converged
    assert ('package_world' in significant(found, {})) == is_off


def in_another_world(each):
    """Return a recording whose package is 2 mm and 0.3 degrees aside."""
    poses = each.package
    return replace(each, package=replace(
        poses, position=poses.position + [2e-3, 0.0, 0.0],
        rotation=exp_so3(np.array([0.0, 0.0, 5e-3])) @ poses.rotation))


def longer(values, more):
    """Return a longer value, and its sum."""
    return [*values, more], sum(values) + more


def test_a_part_of_a_value_is_kept_and_the_other_one_returned():
    values = here([[1], [2], [3]])
    for more in (10, 20):
        values, sums = values.pool.hold(longer, values, [more] * 3)
    assert values.pool.results(list, values) == [[1, 10, 20], [2, 10, 20], [3, 10, 20]]
    assert sums == [31, 32, 33]
    assert values.pool.results(sum, values.only(2)) == [33]


def test_the_first_error_of_recordings_is_raised():
    values = here([2, 0, 1])
    with pytest.raises(BellowsError, match='of 0'):
        values.pool.results(refused, values)


def refused(number):
    """Refuse small numbers."""
    if number < 2:
        raise BellowsError(f'of {number}')
