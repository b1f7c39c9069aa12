"""From points to a plan: splines against known motions, and what no arm does refused."""

from bellows_ros.core.geometry.lie import log_so3, rotation_to_quaternion
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


def rates(function, t, h=1e-4):
    """Return the derivative of a function of time by central differences of fourth order."""
    return (8 * (function(t + h) - function(t - h))
            - (function(t + 2 * h) - function(t - 2 * h))) / (12 * h)


def test_twists_of_a_path_are_those_of_a_spline_from_rest_to_rest():
    stamps, poses, v = MOVE.points(100)
    poses[::2, 3:] *= -1.0  # either sign
    plan = plan_of(stamps, poses).trajectory()
    assert_allclose(plan.twist, v, atol=2e-3)  # m/s, rad/s; h^3 of the spline
    two = plan_of(stamps[[0, -1]], poses[[0, -1]]).trajectory()
    middle = two.select(slice(len(two) // 2, len(two) // 2 + 1))
    assert_allclose(middle.twist[0, :3] @ middle.twist[0, :3], (1.5 / 0.8) ** 2 * 0.38, rtol=1e-6)


@pytest.mark.parametrize('rate_hz', [10, 20])
def test_sparse_points_are_joined_by_quintics_where_accelerations_are_given(rate_hz):
    stamps, poses, v = MOVE.points(rate_hz)
    t = stamps * 1e-9
    body = rates(lambda at: MOVE.at(at)[2], np.clip(t, 3e-4, 0.8 - 3e-4))
    world = rates(lambda at: in_world(*MOVE.at(at)[1:]), np.clip(t, 3e-4, 0.8 - 3e-4))
    world[[0, -1]] = body[[0, -1]] = 0.0
    R = MOVE.at(t)[1]
    cubic, in_tool, in_world_axes = (plan_of(stamps, poses, *rest).trajectory() for rest in (
        (v, None, 'tool'), (v, body, 'tool'), (in_world(R, v), world)))
    fine_o, fine_R, fine_v = MOVE.at(in_tool.stamps_ns * 1e-9)
    errors = [np.abs(plan.position - fine_o).max() for plan in (in_tool, cubic)]
    turns = [np.abs(log_so3(np.swapaxes(fine_R, -1, -2) @ plan.rotation)).max()
             for plan in (in_tool, cubic)]
    assert errors[0] < 0.05 * errors[1] and turns[0] < 0.2 * turns[1]
    assert np.diff(in_tool.stamps_ns).max() <= 10_000_000
    assert_allclose(in_world_axes.position, in_tool.position, atol=1e-7)
    assert_allclose(in_world_axes.twist, in_tool.twist, atol=1e-5)


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


def test_velocities_in_the_wrong_axes_are_noticed():
    stamps, poses, v = Move([0.5, 0.0, 0.0], [0.0, 0.0, 3.0], 0.8).points(250)
    with pytest.raises(BellowsError, match=r'tool_twist\.frame'):
        plan_of(stamps, poses, v, twist_frame='world')
    with pytest.raises(BellowsError):
        plan_of(stamps, poses, v * [1, 1, 1, 5, 5, 5.0], twist_frame='tool')


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


@pytest.mark.parametrize(('part', 'factor', 'reason'), [
    (0, -1.0, 'opposite sign'), (0, 1e-3, 'too small by 1000'), (0, 0.0, 'zero'),
    (1, -1.0, 'opposite sign'), (1, 180.0 / np.pi, 'degrees'), (1, 0.0, 'zero')])
def test_velocities_of_few_points_in_another_unit_or_sign_are_named(part, factor, reason):
    """From three points on; a plan of two may be a move in its first or last half."""
    rng = np.random.default_rng(5)
    for count in range(3, 20):
        stamps, poses, twist, _ = sampled(count, rng)
        twist[:, 3 * part:3 * part + 3] *= factor
        with pytest.raises(BellowsError, match=reason):
            plan_of(stamps, poses, twist)


def test_velocities_of_two_points_and_their_frame_are_checked():
    stamps, poses, twist = np.array([0, 10**8]), np.zeros((2, 7)), np.zeros((2, 6))
    poses[:, 6], poses[1, 0], twist[:, 0] = 1.0, 0.05, 0.5
    plan_of(stamps, poses, twist)
    with pytest.raises(BellowsError, match='opposite sign'):
        plan_of(stamps, poses, -twist)
    quarter = [0.0, 0.0, 0.5**0.5, 0.5**0.5]
    poses[:, 3:] = quarter
    plan_of(stamps, poses, twist)
    with pytest.raises(BellowsError, match=r'other tool_twist\.frame'):
        plan_of(stamps, poses, twist, twist_frame='tool')


@pytest.mark.parametrize('count', [4, 8, 30])
def test_accelerations_are_checked_against_velocities(count):
    t = np.linspace(0.0, 0.8, count)
    stamps, (o, R, v) = np.round(t * 1e9).astype(np.int64), MOVE.at(t)
    poses = np.hstack([o, rotation_to_quaternion(R)])
    bent = np.zeros((count, 6))
    bent[1:-1] = rates(lambda at: in_world(*MOVE.at(at)[1:]), t[1:-1])
    plan_of(stamps, poses, in_world(R, v), bent)
    for factor, reason in ((-1.0, 'opposite sign'), (1e3, 'too large by 1000')):
        with pytest.raises(BellowsError, match=f'accelerations.*{reason}'):
            plan_of(stamps, poses, in_world(R, v), factor * bent)


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
