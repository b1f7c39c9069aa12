"""The checks before a fit, on a tag that a camera sees in a world of its own."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.recording.commission import checks_of
from bellows_ros.core.signals.trajectory import PoseStream
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_faults import OUT, streams
from .tracking import START

DEPTH = 0.07
CAMERA, POINT = exp_so3(np.array([2.2, 0.3, -0.4])), np.array([0.1, 0.2, 1.2])
MARKER, ORIGIN = exp_so3(np.array([0.3, 0.2, 1.0])), np.array([0.1, 0.01, -0.01])


def seen(seed, late=0.0, flips=0, noise=(2e-4, 1.5e-3, 4e-3), outward=True, blur=0.0):
    """Give a flange and a tag at 30 Hz: at rest for 2 s, then in motion; frames are lost."""
    rng = np.random.default_rng(seed)
    tool, package = streams(seed)
    rest = np.full(240, 0)
    kept = np.concatenate([rest, np.arange(len(tool))])
    stamps = START + np.arange(len(kept)) * 8_333_333
    tool, package = (PoseStream(
        body.name, 'base', stamps, body.position[kept], body.rotation[kept])
        for body in (tool, package))
    speed = np.linalg.norm(np.gradient(tool.position, axis=0), axis=1) * 120.0
    frames = np.arange(4, len(kept), 4)
    frames = frames[rng.random(len(frames)) > 0.03]
    R = package.rotation[frames] @ MARKER
    o = package.position[frames] + package.rotation[frames] @ ORIGIN
    lateral, depth, angle = noise
    size = (1.0 + blur * speed[frames])[:, None] * [lateral, lateral, depth]
    R = CAMERA @ R @ exp_so3(angle * (1.0 + blur * speed[frames])[:, None] * rng.normal(
        size=(len(frames), 3)))
    for k in range(flips):
        at = 100 + 37 * k
        R[at:at + 1 + k % 3] = R[at:at + 1 + k % 3] @ exp_so3(np.array([0.9, 0.2, 0.0]))
    camera = PoseStream('/tag', 'camera', stamps[frames] + round(1e9 * late),
                        apply(CAMERA, o) + POINT + size * rng.normal(size=(len(frames), 3)), R)
    return replace(tool, rotation=tool.rotation @ OUT) if outward else tool, camera


def found(*streams, **options):
    return {check.code: check for check in checks_of(
        *streams, np.eye(3), DEPTH, **{'separate': True, **options})}


ORDER = ['tool_z', 'clocks', 'frames', 'marker', 'detector', 'excursions', 'rate', 'blur', 'tilts',
         'excitation']


@pytest.mark.parametrize('outward', [True, False])
def test_the_cell_of_a_tag_is_found_in_order(outward):
    checks = found(*seen(3, late=0.04, flips=6, outward=outward))
    assert list(checks) == ORDER
    assert checks['tool_z'].passed is not outward
    assert checks['tool_z'].settings == (
        {'tool_pose.offset': '0 0 0 1 0 0 0'} if outward else {})
    assert checks['clocks'].numbers['offset'] == pytest.approx(0.04, abs=0.02)
    assert checks['clocks'].settings == {'fit.time_offset': True}
    assert checks['frames'].settings == {'recording.package_world': 'estimate'}
    offset = checks['marker'].settings['measured.offset']
    assert_allclose(offset[:3], ORIGIN, atol=0.03)
    assert_allclose(exp_so3(np.array(offset[3:])), MARKER, atol=0.05)
    detector = checks['detector']
    assert detector.numbers['kind'] == 'tag'
    assert_allclose([detector.numbers[name] for name in ('lateral', 'depth', 'rotation')],
                    [2e-4, 1.5e-3, 4e-3], rtol=0.35)
    assert checks['excursions'].numbers['excursions'] == 6
    assert not checks['excursions'].passed and not checks['rate'].passed
    assert checks['rate'].settings == {'fit.method': 'output_error'}
    assert checks['blur'].passed and checks['tilts'].passed and checks['excitation'].passed


def test_offset_and_camera_are_found_roughly():
    """By the median of 8 seeds."""
    errors = [[abs(checks['clocks'].numbers['offset'] - 0.04), np.linalg.norm(
        checks['frames'].numbers['position'] + CAMERA.T @ POINT)] for checks in (
            found(*seen(seed, late=0.04, flips=6)) for seed in range(8))]
    assert np.all(np.median(errors, axis=0) < [0.02, 0.06])


def test_blur_is_noise_that_grows_with_speed():
    checks = found(*seen(4, blur=30.0))
    assert not checks['blur'].passed
    assert checks['blur'].numbers['ratio'] > 3.0


def test_a_motion_in_noise_does_not_identify_k():
    checks = found(*seen(5, noise=(0.02, 0.02, 0.15)))
    assert not checks['excitation'].passed


def test_a_tool_that_hardly_tilts_cannot_be_registered():
    tool, camera = seen(6, outward=False)
    still = replace(tool, rotation=np.tile(tool.rotation[:1], (len(tool), 1, 1)))
    checks = found(still, replace(
        camera, rotation=np.tile(camera.rotation[:1], (len(camera), 1, 1))))
    assert list(checks) == ['tool_z', 'no_registration']
    assert 'turn' in checks['no_registration'].numbers['reason']


def test_motion_capture_in_one_world_passes():
    checks = found(*streams(7), separate=False)
    assert all(check.passed for check in checks.values())
    assert checks['detector'].numbers['kind'] == 'body'
    assert 'tilts' not in checks


def test_axes_that_follow_from_a_standstill_are_not_judged():
    tool, package = streams(7)
    turned = replace(tool, rotation=tool.rotation @ exp_so3(np.array([2.0, 0.0, 0.0])))
    checks = found(turned, package, separate=False, aligned=True)
    assert not {'tool_z', 'marker'} & set(checks)
