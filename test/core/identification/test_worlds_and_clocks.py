"""A camera in a world of its own, late, with a marker anywhere, is found with the cup."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3, quaternion_to_rotation
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.alignment import rough_offsets
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.recordings import prepare_settings, prepare_streams
import numpy as np
import pytest

from .test_output_error import measured
from ...cell.cup import PLATE, THESIS
from ...cell.motion import shake, standstills
from ...cell.sensors import record

LATE_NS = 40_000_000


def test_world_clock_and_marker_are_found_together():
    rng, own = np.random.default_rng(3), measured(21, duration=16.0)
    way, R_marker = np.array([0.02, -0.015, 0.015]), exp_so3(rng.uniform(-2, 2, 3))
    R_world, o_world = exp_so3(rng.uniform(-2, 2, 3)), rng.uniform(-1, 1, 3)
    body = own.package
    position = (body.position + apply(body.rotation, way) - o_world) @ R_world
    values = resolve({
        'bags': ('x',), 'fit.method': 'output_error',
        'recording.package_world': 'estimate', 'fit.free': ('time_offset', 'package_marker'),
        'recording.package_frame': 'com', 'recording.world': 'z_up',
        'recording.align_at_rest': False, 'package.mass': PLATE.mass,
        'package.com': tuple(PLATE.com), 'cup.length': 0.0481,
        'package.inertia': (*np.diag(PLATE.inertia), 0.0, 0.0, 0.0),
        'topics.tool_pose': '/tool', 'topics.package_pose': '/package'})
    tool = PoseStream('/tool', 'base', own.tool.stamps_ns, own.tool.position, own.tool.rotation)
    recording = prepare_streams({'tool_pose': tool, 'package_pose': PoseStream(
        '/package', 'camera', body.stamps_ns - LATE_NS, position,
        R_world.T @ body.rotation @ R_marker)}, prepare_settings(values), values)
    offset, world = recording.report.time_offset, recording.report.package_world
    assert abs(offset.value - 1e-9 * LATE_NS) < 4.0 * offset.std < 4e-3
    aligned = recording.aligned_package
    assert np.max(np.abs(aligned.position - body.position[-len(aligned):]).mean(axis=0)) < 2e-3
    assert np.all(world.std < 5e-3)


def test_clocks_of_motions_that_are_not_alike_are_refused():
    t = np.arange(400) * 20_000_000
    turn = np.random.default_rng(1).standard_normal((2, 400, 3))
    one, other = (Trajectory(t, np.zeros((400, 3)), exp_so3(0.1 * own)) for own in turn)
    with pytest.raises(BellowsError):
        rough_offsets(one, other)


def test_of_lags_at_which_a_repeated_motion_is_alike_the_nearest_comes_first():
    t = np.arange(3000) / 50.0
    turn = np.stack([np.sin(2.0 * np.pi * f * t) for f in (0.5, 0.75, 1.25)], axis=1)
    rotation = exp_so3(0.2 * turn)
    one, other = (Trajectory(np.rint(1e9 * own).astype(np.int64), np.zeros((3000, 3)), rotation)
                  for own in (t, t - 0.06))
    lags = rough_offsets(one, other)
    assert abs(lags[0] - 0.06) < 0.011
    assert np.allclose(np.sort(np.abs(lags[1:])), [1.94, 2.06], atol=0.011)


NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}

SOFT = Cup(
    np.diag([2100.0, 2100.0, 3900.0, 1.6, 1.6, 0.7]),
    np.diag([14.0, 14.0, 9.0, 0.02, 0.02, 0.03]), THESIS.length)


def reported(recording, **settings):
    """Return the report of a recording that is prepared with some settings."""
    values = resolve({'cup.length': THESIS.length, 'fit.structure': 'axisymmetric',
                      **{name.replace('__', '.'): value for name, value in settings.items()}})
    return prepare_streams({
        'tool_pose': recording.tool_pose, 'package_pose': recording.package_pose
    }, recording.settings, values).report


def found(recording, structure='axisymmetric'):
    """Return the offset found in a recording."""
    return reported(recording, fit__free=['time_offset'], fit__structure=structure).time_offset


@pytest.mark.parametrize('later', [-0.19, -0.0002, 0.0, 0.048, 0.24])
def test_an_offset_is_found_without_noise(later):
    recording = record(shake(seed=3), later=later)
    assert abs(found(recording).value - later) < 1e-5


@pytest.mark.parametrize(('cup', 'structure'), [(THESIS, 'full'), (SOFT, 'axisymmetric')])
def test_error_under_noise_agrees_with_the_stated_size(cup, structure):
    recording = record(shake(seed=3), cup=cup, seed=5, later=0.0123, **NOISE)
    offset = found(recording, structure)
    assert offset.std < 1e-4
    assert abs(offset.value - 0.0123) < 4.0 * offset.std


def test_standstills_do_not_tell_it():
    recording = record(standstills([(0.0, 0.0, 0.0)]), **NOISE)
    assert found(recording) is None


def test_least_squares_takes_no_world_that_is_hardly_known():
    recording = record(
        shake(axes=(2,), duration=2.0, seed=5), tool=(0.005, 0.05), package=(0.005, 0.05))
    with pytest.raises(BellowsError, match=r'recording\.package_world is not identifiable'):
        reported(recording, recording__package_world='estimate', fit__method='least_squares')


def test_a_marker_that_rest_aligns_is_found_with_the_world():
    """The first guess of the world is too rough to align the marker by."""
    tilts = [(0.25, 0.0, 0.1), (-0.15, 0.2, 0.5), (-0.1, -0.25, -0.4), (0.0, 0.0, 0.0)]
    recording = record(standstills(tilts, hold=1.2), **NOISE)
    R, marker = exp_so3(np.array([0.2, -0.3, 1.0])), exp_so3(np.array([0.05, -0.08, 0.4]))
    poses = recording.package_pose
    seen = replace(poses, position=poses.position @ R, rotation=R.T @ poses.rotation @ marker)
    world = reported(
        replace(recording, package_pose=seen, settings=replace(
            recording.settings, align_at_rest=True)),
        recording__package_world='estimate').package_world
    back = quaternion_to_rotation(world.pose[3:])
    middle = seen.position.mean(axis=0)
    off = np.concatenate([back @ middle + world.pose[:3] - R @ middle, log_so3(back @ R.T)])
    assert np.all(np.abs(off) < 4.0 * world.std) and np.all(world.std < 2e-4)
