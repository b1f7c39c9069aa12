"""A camera in a world of its own, late, with a marker anywhere, is found with the cup."""

from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.alignment import rough_offset
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.recordings import _prepared, prepare_settings
import numpy as np
import pytest

from .recordings import PLATE
from .test_output_error import measured

LATE_NS = 40_000_000


def test_world_clock_and_marker_are_found_together():
    rng, own = np.random.default_rng(3), measured(21, duration=16.0)
    way, R_marker = np.array([0.02, -0.015, 0.015]), exp_so3(rng.uniform(-2, 2, 3))
    R_world, o_world = exp_so3(rng.uniform(-2, 2, 3)), rng.uniform(-1, 1, 3)
    body = own.package
    position = (body.position + apply(body.rotation, way) - o_world) @ R_world
    values = resolve({
        'bags': ('x',), 'fit.method': 'output_error', 'fit.time_offset': True,
        'recording.package_world': 'estimate', 'fit.free': ('package_marker',),
        'recording.package_frame': 'com', 'recording.world': 'z_up',
        'recording.align_at_rest': False, 'package.mass': PLATE.mass,
        'package.com': tuple(PLATE.com), 'cup.length': 0.0481,
        'package.inertia': (*np.diag(PLATE.inertia), 0.0, 0.0, 0.0),
        'topics.tool_pose': '/tool', 'topics.package_pose': '/package'})
    recording = _prepared(
        PoseStream('/tool', 'base', own.tool.stamps_ns, own.tool.position, own.tool.rotation),
        PoseStream('/package', 'camera', body.stamps_ns - LATE_NS, position,
                   R_world.T @ body.rotation @ R_marker),
        None, prepare_settings(values), values)
    offset, world = recording.report.time_offset, recording.report.package_world
    assert abs(offset.value - 1e-9 * LATE_NS) < 4.0 * offset.std < 4e-3
    aligned = recording.aligned_package
    assert np.max(np.abs(aligned.position - body.position[-len(aligned):]).mean(axis=0)) < 2e-3
    assert np.all(world.std < 5e-3)


def test_clocks_of_motions_that_are_not_alike_are_refused():
    t = np.arange(400) * 20_000_000
    turn = np.random.default_rng(1).standard_normal((2, 400, 3))
    one, other = (Trajectory(t, np.zeros((400, 3)), exp_so3(0.1 * own)) for own in turn)
    with pytest.raises(BellowsError, match='not turn alike'):
        rough_offset(one, other)
