"""A recording with a camera: what it adds to the prediction."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import Encoded, read_streams, write_bag
from bellows_ros.files.messages import BOOL
from bellows_ros.report.findings import text
from bellows_ros.workflows.replay import replay
import numpy as np
import pytest

from ..files.recordings import again, header, serialized

NOISE = 2e-3, 1e-2
CALIBRATED = {'measured.camera_std': (0.3e-3, 1e-3), 'measured.marker_std': (0.3e-3, 1e-3)}
"""Standard deviations of a camera and a marker that are calibrated well."""
ROLES = {'tool': 'tool_arm/pose', 'twist': 'tool_arm/twist', 'package': 'package/pose'}
CAMERA = 'camera/box'
SEEN = {'tool': ROLES['tool'], 'package': ROLES['package'], 'camera': CAMERA}


@pytest.fixture(scope='module')
def filmed(root, known, true_cup, tmp_path_factory):
    """Give the shipped validation with a camera of 30 Hz, and its parameters."""
    streams = read_streams(root / 'bags' / 'validation', ROLES)
    package = streams['package']
    rng = np.random.default_rng(1)
    which = np.arange(12, len(package.stamps_ns), 12)
    position = package.position[which] + rng.normal(size=(len(which), 3)) * NOISE[0]
    turns = lie.exp_so3(rng.normal(size=(len(which), 3)) * NOISE[1])
    position[20::20] += 0.2  # wild ones
    folder = tmp_path_factory.mktemp('filmed') / 'bag'
    camera = replace(package, stamps_ns=package.stamps_ns[which], position=position,
                     rotation=package.rotation[which] @ turns)
    write_bag(folder, [*map(again, streams.values()), again(camera, '/' + CAMERA)])
    return folder, Values({**true_cup, **known})


def test_slow_poses_are_compared_at_their_own_stamps(filmed):
    """The live prediction errs as the free simulation does, not by interpolated poses."""
    bag, values = filmed
    found = replay(bag, values.replaced({'topics.package_pose': CAMERA}), observe=CAMERA)
    free, live = found.validation.scores.rms, found.live.scores.rms
    np.testing.assert_allclose(live, free, rtol=0.1)
    alone = found.observed.estimates['prediction alone']
    np.testing.assert_allclose(alone.scores.rms, live, rtol=0.01)
    assert not any('fit.method' in each for each in found.warnings), 'a replay is no fit'


def test_measured_describes_the_observed_poses_alone(filmed):
    """The reference of motion capture has its own place, latency and scale."""
    bag, values = filmed
    tag = {'measured.tag_size': 0.05, 'recording.package_world': '0 0 0 1 0 0 0'}
    as_tag, moved = (replay(bag, values.replaced(more), observe=CAMERA) for more in (
        tag, {**tag, 'measured.latency': (0.03, 0.008), 'measured.scale': 1.1,
              'measured.offset': (0.05, 0.0, 0.0, 0.0, 0.0, 0.0)}))
    np.testing.assert_array_equal(moved.validation.scores.rms, as_tag.validation.scores.rms)


def test_both_are_better_than_either(filmed):
    """Grip the package 10 mm beside its middle: the camera says so, and the model its noise."""
    bag, values = filmed
    wrong = values.replaced({
        **CALIBRATED, 'package.com': (0.01, 0.0, -0.03), 'package.com_std': (0.01,) * 3,
        'cup.stiffness_std': (0.01 * np.array(values['cup.stiffness'])).tolist(),
        'cup.damping_std': (0.01 * np.array(values['cup.damping'])).tolist(),
        'payload.estimate': True})
    found = replay(bag, wrong, observe=CAMERA).observed
    alone, both = (each.scores.rms.reshape(2, 3) for each in found.estimates.values())
    shift, turn = np.linalg.norm(both, axis=1)
    of_camera = np.sqrt(3.0) * np.array(NOISE)
    assert (np.array([shift, turn]) < 0.2 * np.minimum(
        of_camera, np.linalg.norm(alone, axis=1))).all()
    assert found.counts['used'] > 300
    assert found.payload.com_std.max() < 1e-3
    assert abs(np.subtract(found.payload.com, (0.0, 0.0, -0.03))).max() < 1e-3
    assert f'package.mass was estimated: {found.payload.mass:.5g} kg' in text(found.findings[1])
    assert found.counts['out_of_reach'] + found.counts.get('outlier', 0) >= 15


def test_poses_of_no_use_are_counted_with_what_to_check(filmed, tmp_path):
    """Say why poses of another clock and in another frame are not used."""
    bag, values = filmed
    streams = read_streams(bag, SEEN)
    camera = streams['camera']

    def seen(name, late_ns=0, frame_id='world'):
        write_bag(tmp_path / name, [*(again(streams[role]) for role in ('tool', 'package')),
                                    again(replace(camera, frame_id=frame_id), late_ns=late_ns)])
        return replay(
            tmp_path / name, values.replaced({'topics.tool_twist': ''}), observe=CAMERA).observed

    early = seen('early', late_ns=-3_600_000_000_000)
    assert early.counts == {'not_held': len(camera.stamps_ns)}
    assert 'Check that one clock stamps tool and camera' in text(early.findings[0])
    with pytest.raises(BellowsError, match="'world'.*'/camera/box'"):
        seen('framed', frame_id='cam')


def breaking(stamps, at_ns, bad=False):
    """Give pressures (ns, Pa) that rise at a time, as they are recorded."""
    kind = 'sensor_msgs/msg/FluidPressure'
    data = [serialized(kind, (
        header(ns, ''), np.nan if bad else 40e3 if ns < at_ns else 100e3, 0.0))
        for ns in stamps.tolist()]
    return Encoded('/cell/vacuum/pressure', kind, stamps, data)


def test_the_recorded_vacuum_shows_a_lost_package(filmed, tmp_path):
    """Sooner than the camera; a pressure that is none is refused."""
    bag, values = filmed
    streams = read_streams(bag, SEEN)
    at_ns, recorded = int(streams['tool'].stamps_ns[0]) + 5_000_000_000, []
    for role, own in streams.items():
        position, falls = own.position.copy(), role != 'tool'
        position[:, 2] -= falls * 4.9 * np.square(np.maximum(own.stamps_ns - at_ns, 0) * 1e-9)
        seen = own.stamps_ns < at_ns + (320_000_000 if falls else 10**15)
        recorded.append(again(replace(own, stamps_ns=own.stamps_ns[seen],
                                      position=position[seen], rotation=own.rotation[seen])))
    values = values.replaced({'topics.tool_twist': '', 'recording.start': 3.0})
    pressures = streams['tool'].stamps_ns[::20]
    values = values.replaced({'vacuum.signal': 'pressure'})
    write_bag(tmp_path / 'heard', [*recorded, breaking(pressures, at_ns)])
    found = replay(tmp_path / 'heard', values, observe=CAMERA)
    (seconds, alarm), = found.observed.alarms
    assert (alarm.kind, alarm.shown_by) == ('lost', 'vacuum')
    assert 2.0 <= seconds < 2.06
    write_bag(tmp_path / 'deaf', [*recorded, breaking(pressures, at_ns, bad=True)])
    with pytest.raises(BellowsError, match="vacuum.signal .*'pressure'.*vacuum/pressure"):
        replay(tmp_path / 'deaf', values, observe=CAMERA)


def test_several_packages_of_one_recording_are_predicted_while_held(filmed, tmp_path):
    """Attach and detach by vacuum/held as the node does, and rate the cup in all holds."""
    bag, values = filmed
    streams = read_streams(bag, SEEN)
    stamps = streams['tool'].stamps_ns[::20]
    seconds = 1e-9 * (stamps - stamps[0])
    held = ((seconds > 1.0) & (seconds < 5.0)) | (seconds > 7.0)
    switch = Encoded('/cell/vacuum/held', BOOL, stamps, [
        serialized(BOOL, (bool(each),)) for each in held])
    recorded = [switch]
    for own in streams.values():  # lifted by 30 mm after each grip, and set down
        t, position = 1e-9 * (own.stamps_ns - stamps[0]), own.position.copy()
        for at, height in ((1.2, 0.03), (5.2, -0.03), (7.2, 0.03)):
            s = np.clip((t - at) / 0.5, 0.0, 1.0)
            position[:, 2] += height * s * s * (3.0 - 2.0 * s)
        recorded.append(again(replace(own, position=position)))
    write_bag(tmp_path / 'two', recorded)
    found = replay(tmp_path / 'two', values.replaced({
        'topics.tool_twist': '', 'vacuum.signal': 'bool'}), observe=CAMERA)
    assert len(found.validation.runs) == 2
    assert found.observed.counts['not_held'] > 50
    at = 1e-9 * (found.live.stamps_ns - stamps[0])
    assert not np.any((at > 5.2) & (at < 6.9)) and at.min() > 0.9 and at.max() > 8.0
