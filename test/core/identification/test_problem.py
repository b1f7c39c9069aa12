"""Own unknowns of recordings are eliminated one recording at a time, as a dense solve would."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification import diagnosis as ranking
from bellows_ros.core.identification.diagnosis import scores, SIGNIFICANT
from bellows_ros.core.identification.problem import Problem
from bellows_ros.core.identification.quantities import weak_prior
from bellows_ros.core.identification.search import evaluated, measured_courses, minimise
from bellows_ros.core.identification.segments import Segment
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_output_error import AXISYMMETRIC, measured, scaled, TRUTH

FREE = weak_prior(['time_offset', 'package_marker', 'length'])


def problem_of(seeds, cup=TRUTH):
    """Return the problem of recordings with three kinds of free quantities."""
    return Problem.of([
        Segment.of(replace(measured(seed, package_hz=60.0, duration=4.0), recording=number))
        for number, seed in enumerate(seeds)], AXISYMMETRIC, cup, FREE)


def whitened(problem, at):
    """Return the whitened segments of recordings of one segment, with their Jacobians."""
    pool = problem.held.pool
    return pool.results(
        whitened_there, problem.local, pool.each([
            at.theta[problem.index(number)] for number in range(len(problem.outlines))]),
        problem.held, at.courses)


def whitened_there(problem, theta, segments, courses):
    """Return the first segment of a recording whitened."""
    return problem.whitened(theta, segments[0], courses[0])


def dense(problem, at):
    """Return information and slope of everything, by the whole Jacobian of all recordings."""
    rows, residuals = [], []
    for number, part in enumerate(whitened(problem, at)):
        J = np.zeros((len(part.innovations), len(at.theta)))
        J[:, problem.index(number)] = part.jacobian
        rows.append(J)
        residuals.append(part.innovations)
    J, r = np.vstack(rows), np.concatenate(residuals)
    prior, slope = problem.prior(at.theta)
    H = np.diag(problem.weights)
    H[:problem.shared, :problem.shared] = prior.shared
    return J.T @ J + H, J.T @ r + slope


@pytest.fixture(scope='module')
def three():
    """Return a problem of three recordings, and unknowns near its start."""
    problem = problem_of([1, 2, 3])
    shift = 0.02 * np.random.default_rng(5).standard_normal(len(problem.start))
    return problem, evaluated(problem, problem.start + shift, measured_courses(problem))


def test_steps_and_variances_are_those_of_the_whole(three):
    problem, at = three
    H, g = dense(problem, at)
    information = at.information
    assert_allclose(at.slope, g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
    assert_allclose(information.solve(g), np.linalg.solve(H, g), rtol=1e-7, atol=1e-9)
    C = np.linalg.inv(H)
    assert_allclose(information.variances, np.diag(C), rtol=1e-7)
    assert_allclose(information.times(g), H @ g, rtol=1e-9, atol=1e-9 * np.abs(H @ g).max())
    places = np.append(np.arange(problem.shared), problem.own[1])
    size = np.sqrt(np.diag(C)[places])
    assert_allclose(information.block(1) / np.outer(size, size),
                    C[np.ix_(places, places)] / np.outer(size, size), atol=1e-7)


def test_steps_along_some_directions_are_those_of_the_whole(three):
    problem, at = three
    H, g = dense(problem, at)
    information = at.information
    along = np.random.default_rng(1).standard_normal((problem.shared, 3))
    used = np.ones(len(g), dtype=bool)
    used[problem.own[:, 2]] = False
    own = np.flatnonzero(used[problem.shared:]) + problem.shared
    D = np.zeros((len(g), 3 + len(own)))
    D[:problem.shared, :3] = along
    D[own, np.arange(3, D.shape[1])] = 1.0
    expected = D @ np.linalg.solve(D.T @ H @ D, D.T @ g)
    assert_allclose(information.step_by(g, along, used), expected, rtol=1e-6, atol=1e-9)
    without = np.ones(len(g), dtype=bool)
    without[problem.places['length']] = without[problem.places['time_offset']] = False
    part = np.ix_(without, without)
    assert_allclose(information.fall(g, without),
                    g[without] @ np.linalg.solve(H[part], g[without]), rtol=1e-7)


def test_the_minimum_is_that_of_the_whole():
    problem = problem_of([1, 2, 3], scaled(1.3))
    found = minimise(problem)
    assert found.converged
    H, g = dense(problem, found)
    rest = np.linalg.solve(H, g) / np.sqrt(np.diag(np.linalg.inv(H)))
    assert np.abs(rest).max() < 0.1


def test_no_recording_has_columns_of_another_and_none_is_kept():
    one, many = problem_of([1]), problem_of([1, *range(2, 8)])
    sizes = []
    for problem in (one, many):
        start = evaluated(problem, problem.start, measured_courses(problem))
        sizes.append(whitened(problem, start)[0].jacobian.shape)
        assert not any(start.parts.pool.results(jacobian_size, start.parts))
        assert start.information.own.shape == (len(problem.outlines), 7, 7)
    assert sizes[0] == sizes[1]


def jacobian_size(parts):
    """Return the number of derivatives that are kept of a recording, by views, too."""
    return sum(part.jacobian.size if part.jacobian.base is None else part.jacobian.base.size
               for part in parts)


def test_worlds_of_many_sound_recordings_are_no_cause():
    """By chance chi² falls by six for each recording, by some 50 for all."""
    found = minimise(replace(problem_of(range(1, 9)), free={}))
    score = scores(found, ['package_world'])['package_world']
    assert found.converged and score < SIGNIFICANT**2


def test_a_wrong_world_of_all_recordings_is_seen():
    problem = replace(problem_of(range(1, 9)), free={}).changed(in_another_world)
    found = minimise(problem)
    assert scores(found, ['package_world'])['package_world'] > SIGNIFICANT**2


@pytest.mark.parametrize(('count', 'is_off'), [(1, True), (8, False)])
def test_the_largest_deviation_of_many_recordings_is_judged_by_their_number(count, is_off):
    """A clock off by 3.6 standard deviations: one of 3,000, and one of 400 with eight clocks."""
    given = {'time_offset': np.array([1e-3])}
    found = minimise(replace(problem_of(range(1, 1 + count)), free=given))
    place = found.problem.places['time_offset']
    wrong = np.zeros(len(found.theta))
    wrong[place[0]] = 3.6 / np.sqrt(found.problem.weights[place[0]])
    assert ranking.is_off(replace(found, theta=wrong), given) is is_off


def in_another_world(each):
    """Return a recording whose package is 2 mm and 0.3 degrees aside."""
    poses = each.package
    return replace(each, package=replace(
        poses, position=poses.position + [2e-3, 0.0, 0.0],
        rotation=exp_so3(np.array([0.0, 0.0, 5e-3])) @ poses.rotation))
