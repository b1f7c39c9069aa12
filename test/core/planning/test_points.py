"""From points to a plan: splines against known motions, and what no arm does refused."""

from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.planning.points import MAX_POINTS, plan_of, require_consistent
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..plans import Move

MOVE = Move([0.5, -0.3, 0.2], [0.4, -0.6, 0.9], 0.8)
POINTS = MOVE.points(250)


def in_world(R, v):
    """Return body twists in world axes."""
    return np.hstack([np.einsum('nij,nj->ni', R, part) for part in (v[:, :3], v[:, 3:])])


def test_twists_of_a_path_are_those_of_a_spline_from_rest_to_rest():
    stamps, poses, v = MOVE.points(100)
    poses[::2, 3:] *= -1.0  # either sign
    plan = plan_of(stamps, poses).trajectory()
    assert_allclose(plan.twist, v, atol=2e-3)  # m/s, rad/s; h^3 of the spline
    two = plan_of(stamps[[0, -1]], poses[[0, -1]]).trajectory()
    middle = two.select(slice(len(two) // 2, len(two) // 2 + 1))
    assert_allclose(middle.twist[0, :3] @ middle.twist[0, :3], (1.5 / 0.8) ** 2 * 0.38, rtol=1e-6)


def changed(index, where, value):
    """Return the points with one number changed."""
    parts = [part.astype(part.dtype).copy() for part in POINTS]
    parts[index][where] = value
    return parts


@pytest.mark.parametrize(('parts', 'figures'), [
    ([part[:1] for part in POINTS], r'\b1 point\b.* 2 to 100000'),
    ([np.repeat(part[:1], MAX_POINTS + 1, axis=0) for part in POINTS],
     '100001 points.* 2 to 100000'),
    (changed(1, (7, 0), np.nan), r'point 7\b.* 1 of 201\b'),
    (changed(1, (9, slice(3, 7)), [0.0, 0.0, 0.0, 2.0]), r'point 9\b.* 1 of 201\b'),
    (changed(0, 20, 1), r'point 20\b.* 0.000000 s\b.* 0.076000 s\b'),
    (changed(0, -1, 700 * 10 ** 9), r'\b700 s\b.* 600\b'),
    (changed(1, (50, 2), 3.0), r'points 49 and 50\b.* 2.\d+ m\b'),
    (changed(1, (50, slice(3, 7)), [1.0, 0.0, 0.0, 0.0]), r'points 49 and 50\b.* rad\b'),
    (changed(2, (60, 1), 30.0), r'point 60\b.* 20 m/s'),
])
def test_what_no_arm_does_is_refused(parts, figures):
    with pytest.raises(BellowsError, match=figures):
        plan_of(*parts, twist_frame='tool')


def sampled(count, rng, stretch=0.0):
    """Return points of a random move at few, unevenly spaced times, with twists in the world."""
    move = Move(rng.normal(0.0, 0.4, 3), rng.normal(0.0, 0.1, 3), 0.8)
    t = np.linspace(0.0, 0.8, count)
    t[1:-1] += stretch * rng.uniform(-0.4, 0.4, count - 2) * 0.8 / (count - 1)
    o, R, v = move.at(t)
    return np.round(t * 1e9).astype(np.int64), np.hstack([o, rotation_to_quaternion(R)]), (
        in_world(R, v)), R


def test_plans_of_few_points_are_accepted():
    rng = np.random.default_rng(3)
    for count in range(2, 25):
        for stretch in (0.0, 1.0):
            stamps, poses, twist, _ = sampled(count, rng, stretch)
            plan_of(stamps, poses, twist)
    there = np.array([[x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for x in (0.0, 0.3, 0.3, 0.0)])
    plan_of(np.arange(4) * 10**9, there, np.zeros((4, 6)))  # stops at each, and comes back


@pytest.mark.parametrize(('count', 'factor'), [
    (3, -1.0), (19, -1.0), (25, -1.0), (25, 1e-3), (25, 180.0 / np.pi), (25, 0.0)])
@pytest.mark.parametrize('part', [0, 1])
def test_velocities_that_contradict_the_points_are_refused(count, factor, part):
    """Another sign from three points on, another unit or none from 20; in other axes, too."""
    stamps, poses, twist, _ = sampled(count, np.random.default_rng(5))
    twist[:, 3 * part:3 * part + 3] *= factor
    with pytest.raises(BellowsError):
        plan_of(stamps, poses, twist)
    stamps, poses, v = Move([0.5, 0.0, 0.0], [0.0, 0.0, 3.0], 0.8).points(250)
    with pytest.raises(BellowsError, match=r'tool_twist\.frame'):
        plan_of(stamps, poses, v, twist_frame='world')


@pytest.mark.parametrize('speed', [0.0, 0.02, 0.1])
def test_noise_of_recorded_poses_is_no_other_motion(speed):
    """Accept rates that are right, whatever the noise of the steps; refuse their negatives."""
    rng = np.random.default_rng(3)
    t = np.arange(1000) / 360.0
    rates = speed * np.column_stack([np.sin(3.0 * t), np.cos(2.0 * t), np.sin(5.0 * t)])
    poses = np.cumsum(rates, axis=0) / 360.0 + 2e-5 * rng.standard_normal(rates.shape)
    durations, steps = np.diff(t), np.diff(poses, axis=0)
    require_consistent(durations, steps, rates, 'Rates')
    if speed:
        with pytest.raises(BellowsError, match='Rates'):
            require_consistent(durations, steps, -rates, 'Rates')
