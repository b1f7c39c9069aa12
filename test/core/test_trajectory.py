"""Streams and trajectories: their checks, and resampling against motions in closed form."""

from bellows_ros.core import lie
from bellows_ros.core.trajectory import (
    common_stamps,
    Filtered,
    PoseStream,
    resample,
    Trajectory,
    TwistStream,
    uniform_rate_hz,
    valid_windows,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

# An epoch in 2023: a float of seconds would round such stamps to 0.2 us.
EPOCH_NS = 1_700_000_000_000_000_000


def stamps(count, rate_hz):
    return EPOCH_NS + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def poses_at(stamps_ns):
    """Give positions, rotations and body twists of a motion with changing axis, in closed form."""
    t = (np.asarray(stamps_ns) - EPOCH_NS)[:, None] / 1e9
    amplitude, phase = np.array([0.6, -0.4, 0.5]), np.array([0.0, 0.7, 1.9])
    frequency = np.array([3.0, 4.0, 5.0])
    o = amplitude * np.sin(frequency * t + phase)
    o_rate = amplitude * frequency * np.cos(frequency * t + phase)
    phi = 2.0 * o + np.array([0.5, 0.2, -0.4])
    R = lie.exp_so3(phi)
    body_rate = lie.apply(lie.dexp(-phi), 2.0 * o_rate)
    v = lie.apply(np.swapaxes(R, -1, -2), o_rate)
    return o, R, np.concatenate([v, body_rate], axis=1)


def motion(count, rate_hz, with_twist=True):
    o, R, twist = poses_at(stamps(count, rate_hz))
    return Trajectory(stamps(count, rate_hz), o, R, twist if with_twist else None)


def errors(trajectory):
    """Return the largest errors of position, rotation and twist of a trajectory on the motion."""
    o, R, twist = poses_at(trajectory.stamps_ns)
    turn = lie.log_so3(np.swapaxes(R, -1, -2) @ trajectory.rotation)
    twist_error = 0.0 if trajectory.twist is None else np.abs(trajectory.twist - twist).max()
    return np.array([np.abs(trajectory.position - o).max(), np.abs(turn).max(), twist_error])


def test_hermite_is_of_fourth_order():
    wanted = EPOCH_NS + np.arange(10_000_000, 1_900_000_000, 1_234_567)
    coarse, fine = (errors(resample(motion(2 * f + 1, f), wanted)) for f in (50, 100))
    order = np.log2(coarse / fine)
    assert np.all(order[:2] > 3.9)
    # The twist is the derivative of a fourth-order interpolant.
    assert order[2] > 2.9
    assert np.all(fine[:2] < 1e-6)


def test_geodesic_is_of_second_order_and_has_no_twist():
    wanted = EPOCH_NS + np.arange(10_000_000, 1_900_000_000, 1_234_567)
    results = [resample(motion(2 * f + 1, f, with_twist=False), wanted) for f in (50, 100)]
    assert results[0].twist is None
    order = np.log2(errors(results[0])[:2] / errors(results[1])[:2])
    assert_allclose(order, 2.0, atol=0.1)


@pytest.mark.parametrize('with_twist', [True, False])
def test_constant_twist_is_interpolated_exactly(with_twist):
    twist = np.array([0.0, 0.0, 0.4, 0.0, 0.0, 2.0])  # a screw: both interpolants hold it
    coarse, fine = stamps(11, 10.0), stamps(101, 100.0)
    T = lie.exp_se3(np.multiply.outer((fine - EPOCH_NS) / 1e9, twist))
    twists = np.tile(twist, (11, 1)) if with_twist else None
    result = resample(Trajectory(coarse, T[::10, :3, 3], T[::10, :3, :3], twists), fine)
    assert_allclose(result.position, T[:, :3, 3], atol=1e-15)
    assert_allclose(result.rotation, T[:, :3, :3], atol=2e-15)
    if with_twist:
        assert_allclose(result.twist, np.tile(twist, (101, 1)), atol=1e-13)


def test_twist_is_the_derivative_of_the_interpolated_pose():
    trajectory, h = motion(11, 10.0), 10_000
    at = trajectory.stamps_ns[:-1] + 37_000_000
    here, before, after = (resample(trajectory, at + s * h) for s in (0, -1, 1))
    R_inverse = np.swapaxes(here.rotation, -1, -2)
    v = lie.apply(R_inverse, after.position - before.position) / (2 * h * 1e-9)
    turn = lie.log_so3(np.swapaxes(before.rotation, -1, -2) @ after.rotation) / (2 * h * 1e-9)
    # Rounding of poses over 20 us, and h^2 times third derivatives of some 1e3.
    assert_allclose(here.twist, np.concatenate([v, turn], axis=1), atol=2e-7)


def test_interpolation_does_not_depend_on_the_world_frame():
    trajectory = motion(21, 20.0)
    R_new_old, shift = lie.exp_so3([0.3, -2.0, 1.0]), np.array([10.0, -3.0, 5.0])
    moved = Trajectory(
        trajectory.stamps_ns,
        lie.apply(R_new_old, trajectory.position) + shift,
        R_new_old @ trajectory.rotation,
        trajectory.twist,
    )
    wanted = trajectory.stamps_ns[:-1] + 12_345_678
    here, there = resample(trajectory, wanted), resample(moved, wanted)
    assert_allclose(there.position, lie.apply(R_new_old, here.position) + shift, atol=1e-14)
    assert_allclose(there.rotation, R_new_old @ here.rotation, atol=1e-14)
    assert_allclose(there.twist, here.twist, atol=1e-12)


@pytest.mark.parametrize('with_twist', [True, False])
def test_coinciding_stamps_repeat_the_samples(with_twist):
    trajectory = motion(11, 10.0, with_twist)
    result = resample(trajectory, trajectory.stamps_ns)
    assert_array_equal(result.position, trajectory.position)
    assert_array_equal(result.rotation, trajectory.rotation)
    if with_twist:
        assert_array_equal(result.twist, trajectory.twist)


def test_one_sample_and_no_stamps():
    one = motion(1, 10.0)
    assert_array_equal(resample(one, one.stamps_ns).position, one.position)
    assert len(resample(one, [])) == 0


@pytest.mark.parametrize('offset_ns', [-1, 1])
def test_never_extrapolates(offset_ns):
    trajectory = motion(11, 10.0)
    with pytest.raises(BellowsError, match='never extrapolated'):
        resample(trajectory, trajectory.stamps_ns + offset_ns)
    with pytest.raises(BellowsError, match='empty'):
        resample(trajectory.select(slice(0, 0)), trajectory.stamps_ns)


def test_validity_of_resampled_samples():
    trajectory = motion(6, 10.0)
    valid = np.array([True, True, False, True, True, True])
    trajectory = Trajectory(
        trajectory.stamps_ns, trajectory.position, trajectory.rotation, valid=valid
    )
    wanted = EPOCH_NS + np.array([100, 150, 200, 250, 300, 350]) * 1_000_000
    result = resample(trajectory, wanted)
    assert_array_equal(result.valid, [True, False, False, False, True, True])


def test_long_gaps_are_not_valid():
    trajectory = motion(11, 10.0).select(np.array([0, 1, 2, 6, 7, 8]))
    wanted = EPOCH_NS + np.array([150, 200, 300, 500, 600, 650]) * 1_000_000
    result = resample(trajectory, wanted, longest_gap_ns=100_000_000)
    assert_array_equal(result.valid, [True, True, False, False, True, True])
    assert resample(trajectory, wanted).valid.all()


def test_common_stamps():
    trajectory = motion(3, 10.0)
    wanted = EPOCH_NS + np.array([-1, 0, 50, 200_000_000, 200_000_001])
    assert_array_equal(common_stamps(wanted, trajectory), wanted[1:4])
    with pytest.raises(BellowsError, match='do not overlap'):
        common_stamps(wanted + 1_000_000_000, trajectory)
    with pytest.raises(BellowsError, match='do not overlap'):
        common_stamps([], trajectory)


def test_uniform_rate():
    assert_allclose(uniform_rate_hz(stamps(7201, 360.0)), 360.0, rtol=1e-9)
    jumpy = stamps(100, 360.0)
    jumpy[50] += 40_000
    with pytest.raises(BellowsError, match='Resample'):
        uniform_rate_hz(jumpy)
    with pytest.raises(BellowsError, match='at least 2'):
        uniform_rate_hz(jumpy[:1])


def test_a_dropout_is_no_uniform_rate():
    with pytest.raises(BellowsError, match='sample 40 comes'):
        uniform_rate_hz(np.delete(stamps(100, 360.0), 40))


def test_valid_windows():
    valid = np.arange(10) != 4
    assert_array_equal(valid_windows(valid, 1), np.abs(np.arange(1, 9) - 4) > 1)


def test_spatial_twist_is_the_world_rate_of_the_pose():
    trajectory = motion(11, 10.0)
    # T_dot T^-1 of the motion, by its parts: (4.37) and w = R w_B.
    rate = lie.apply(trajectory.rotation, trajectory.twist[:, 3:])
    o_rate = lie.apply(trajectory.rotation, trajectory.twist[:, :3])
    expected = np.concatenate([o_rate - np.cross(rate, trajectory.position), rate], axis=1)
    assert_allclose(trajectory.spatial_twist, expected, atol=1e-14)
    with pytest.raises(BellowsError, match='no accelerations'):
        _ = trajectory.spatial_acceleration


def test_seconds_and_select():
    trajectory = motion(11, 10.0)
    assert_allclose(trajectory.seconds, np.arange(11) / 10, atol=1e-15)
    part = trajectory.select(trajectory.seconds > 0.45)
    assert len(part) == 6
    assert_array_equal(part.twist, trajectory.twist[5:])
    assert_array_equal(part.valid, True)


def test_arrays_are_copies_and_read_only():
    position = np.zeros((2, 3))
    trajectory = Trajectory(stamps(2, 1.0), position, np.tile(np.eye(3), (2, 1, 1)))
    position[:] = 1.0
    assert_array_equal(trajectory.position, 0.0)
    for name in ('position', 'rotation', 'stamps_ns', 'valid'):
        array = getattr(trajectory, name)
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 0
    with pytest.raises(AttributeError):
        trajectory.position = position


def test_streams():
    eyes = np.tile(np.eye(3), (2, 1, 1))
    stream = PoseStream('/pose', 'world', stamps(2, 1.0), np.ones((2, 3)), eyes, {'nan': (3,)})
    assert len(stream) == 2
    assert stream.refused == {'nan': (3,)}
    assert_array_equal(stream.trajectory().position, 1.0)
    assert stream.trajectory().valid.all()
    twists = TwistStream('/twist', 'world', stamps(2, 1.0), np.ones((2, 3)), np.zeros((2, 3)))
    assert len(twists) == 2
    empty = PoseStream('/pose', 'world', [], np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert len(empty) == len(empty.trajectory()) == 0


GOOD = {
    'stamps_ns': stamps(3, 10.0),
    'position': np.zeros((3, 3)),
    'rotation': np.tile(np.eye(3), (3, 1, 1)),
}
BAD = [
    ({'stamps_ns': stamps(3, 10.0) / 1e9}, 'integers'),
    ({'stamps_ns': stamps(3, 10.0)[[0, 2, 1]]}, 'increase strictly'),
    ({'stamps_ns': stamps(3, 10.0)[[0, 1, 1]]}, 'increase strictly'),
    ({'position': np.zeros((2, 3))}, r'position must have shape \(3, 3\)'),
    ({'position': np.array([[0.0] * 3, [np.nan] * 3, [0.0] * 3])}, 'position of sample 1'),
    ({'rotation': np.full((3, 3, 3), np.inf)}, 'rotation of sample 0'),
    ({'rotation': np.stack([np.eye(3), np.eye(3), np.diag([1, 1, 1.0001])])}, 'sample 2'),
    ({'rotation': np.tile(np.diag([1.0, 1.0, -1.0]), (3, 1, 1))}, 'right-handed'),
    ({'twist': np.zeros((3, 3))}, r'twist must have shape \(3, 6\)'),
    ({'acceleration': np.full((3, 6), np.nan)}, 'acceleration of sample 0'),
    ({'valid': np.ones(3)}, 'booleans'),
    ({'valid': np.array([True])}, 'booleans'),
]


@pytest.mark.parametrize('changed, message', BAD)
def test_a_bad_trajectory_is_refused(changed, message):
    with pytest.raises(BellowsError, match=message):
        Trajectory(**{**GOOD, **changed})


@pytest.mark.parametrize('changed, message', BAD[:8])
def test_a_bad_pose_stream_is_refused_by_name(changed, message):
    with pytest.raises(BellowsError, match=message) as refusal:
        PoseStream('/arm/pose', 'world', **{**GOOD, **changed})
    assert "'/arm/pose'" in str(refusal.value)


def test_weights_of_a_bad_shape_are_refused():
    with pytest.raises(BellowsError, match='weights'):
        Filtered(
            **GOOD, twist=np.zeros((3, 6)), acceleration=np.zeros((3, 6)), weights=np.ones((2, 5))
        )
