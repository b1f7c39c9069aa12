"""What tracking makes of a motion: noise, jumps, gaps, frames, worlds and stamps."""

from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic import recipe as sensing
from bellows_ros.core.synthetic.recipe import Faults, Sensor, TwistSensor
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

EPOCH_NS = 1_700_000_000_000_000_000
DURATION, REST = 20.0, 2.0
Z_UP, MOTIVE = sensing.WORLDS['z_up'], sensing.WORLDS['motive_y_up']
# (4.1) as printed: from Motive's frame M to the world A.
A_R_M = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])


def draw(seed=0):
    return np.random.default_rng(seed)


def plan_of(sensor, seed=0):
    return sensing.schedule(sensor, DURATION, REST, EPOCH_NS, draw(seed))


def tumbling(stamps_ns):
    """Give a motion with large turns, at rest for two seconds."""
    t = np.maximum((stamps_ns - EPOCH_NS) / 1e9 - REST, 0.0)[:, None]
    position = np.array([0.5, -0.2, 0.8]) + 0.1 * np.sin(t * [1.0, 2.0, 3.0])
    rotation = exp_so3(0.8 * np.sin(t * [0.7, 1.1, 1.3]))
    twist = np.hstack([np.cos(t), np.sin(t), t, -t, 2.0 + t, 0.0 * t])
    return Trajectory(stamps_ns, position, rotation, twist)


def measured(sensor, world=Z_UP, seed=0):
    """Return plan, truth and what is recorded of it."""
    plan = plan_of(sensor, seed)
    truth = tumbling(plan.sampled_ns)
    return plan, truth, sensing.measure_poses(truth, sensor, plan, world, draw(seed + 100))


def turned(R, other):
    """Return the rotation vectors from R to the other rotation, in axes of R."""
    return log_so3(np.swapaxes(R, -1, -2) @ other)


def test_noise_has_the_standard_deviation_that_was_asked_for():
    sensor = Sensor('tool', 500.0, position_noise=1e-4, rotation_noise=5e-4)
    _, truth, poses = measured(sensor)
    noise = np.hstack([(poses.position - truth.position) / 1e-4,
                       turned(truth.rotation, poses.rotation) / 5e-4])
    count = len(noise)
    assert count == 10_001
    # Five standard errors of mean, deviation, correlation with each other and with the past.
    assert_allclose(noise.mean(0), 0.0, atol=5.0 / np.sqrt(count))
    assert_allclose(noise.std(0), 1.0, atol=5.0 / np.sqrt(2.0 * count))
    assert_allclose(np.corrcoef(noise.T), np.eye(6), atol=5.0 / np.sqrt(count))
    assert_allclose((noise[1:] * noise[:-1]).mean(0), 0.0, atol=5.0 / np.sqrt(count))


def test_marker_frame_and_origin_are_fixed_to_the_body():
    marker, origin = np.array([0.04, -0.07, 0.9]), np.array([0.0008, -0.0006, 0.03])
    _, truth, poses = measured(Sensor('package', 100.0, origin=origin, marker=marker))
    assert_allclose(poses.position, truth.position + apply(truth.rotation, origin), atol=1e-15)
    assert_allclose(turned(truth.rotation, poses.rotation), np.tile(marker, (2001, 1)), atol=1e-12)


def test_motive_world_is_undone_by_the_printed_matrix():
    _, truth, poses = measured(Sensor('tool', 100.0), MOTIVE)
    assert_allclose(poses.position @ A_R_M.T, truth.position, atol=1e-15)
    assert_allclose(A_R_M @ poses.rotation, truth.rotation, atol=1e-15)
    # y is up: the second coordinate is the height.
    assert_allclose(poses.position[:, 1], truth.position[:, 2], atol=1e-15)


@pytest.mark.parametrize('seed', range(2))
def test_jumps_and_gaps_are_as_many_as_asked_for_and_apart(seed):
    sensor = Sensor('tool', 200.0, jumps=Faults(6, 0.02, 0.03, 0.3), dropouts=Faults(4, 0.1))
    plan, truth, poses = measured(sensor, seed=seed)

    rest = int(REST * 200)
    jumping = plan.jump >= 0
    faulty = jumping | ~plan.sent
    assert (len(plan.jumps), len(plan.dropouts)) == (6, 4)
    assert jumping.sum() == 6 * 4 and (~plan.sent).sum() == 4 * 20
    assert not np.any(jumping & ~plan.sent)
    assert np.sum(np.diff(faulty.astype(int)) == 1) == 10  # no two of them touch
    assert not faulty[: rest + 1].any() and not faulty[-1]

    assert len(poses.stamps_ns) == len(truth) - 80
    off = poses.position - truth.position[plan.sent]
    turn = turned(truth.rotation[plan.sent], poses.rotation)
    size = np.where(jumping[plan.sent], 1.0, 0.0)
    assert_allclose(np.linalg.norm(off, axis=1), 0.03 * size, atol=1e-12)
    assert_allclose(np.linalg.norm(turn, axis=1), 0.3 * size, atol=1e-7)
    # While one lasts, it is the same.
    for number, start in enumerate(plan.jumps):
        during = off[plan.jump[plan.sent] == number]
        assert_allclose(during, np.tile(during[0], (4, 1)), atol=1e-12)
        assert plan.jump[start] == number and plan.jump[start - 1] == -1


def test_faults_that_fit_exactly_are_placed_and_one_more_is_refused():
    def sensor(count):
        return Sensor('package', 10.0, dropouts=Faults(count, 0.5))

    # 201 samples, 21 of them in the rest: 180 hold 29 gaps of 5 and the samples around them.
    assert len(plan_of(sensor(29)).dropouts) == 29
    with pytest.raises(BellowsError, match=r"'package'.*\b181\b"):
        plan_of(sensor(30))


def test_jitter_moves_stamps_and_keeps_their_order():
    plan = plan_of(Sensor('tool', 500.0, jitter=1e-4))
    off = (plan.stamps_ns - plan.sampled_ns) * 1e-9
    assert off.std() == pytest.approx(1e-4, rel=5.0 / np.sqrt(2.0 * len(off)))
    wild = plan_of(Sensor('tool', 500.0, jitter=1.0))
    assert np.all(np.diff(wild.stamps_ns) > 0)
    assert_array_equal(plan_of(Sensor('tool', 500.0)).stamps_ns, plan.sampled_ns)


@pytest.mark.parametrize('world', ['z_up', 'motive_y_up'])
def test_twists_are_in_the_axes_that_were_asked_for(world):
    marker = np.array([0.1, -0.4, 0.9])
    plan, truth, poses = measured(Sensor('tool', 100.0, marker=marker), sensing.WORLDS[world])
    for frame in ('world', 'tool'):
        twists = sensing.measure_twists(
            truth, TwistSensor(frame), marker, plan, sensing.WORLDS[world], draw())
        # Whatever the world, turned by the recorded pose both are the velocities in marker axes.
        R_T = np.swapaxes(poses.rotation, -1, -2) if frame == 'world' else np.eye(3)
        seen = exp_so3(marker).T
        assert_allclose(apply(R_T, twists[:, :3]), truth.twist[:, :3] @ seen.T, atol=1e-13)
        assert_allclose(apply(R_T, twists[:, 3:]), truth.twist[:, 3:] @ seen.T, atol=1e-13)
