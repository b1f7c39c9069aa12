"""Reading recordings that rosbags wrote, in every storage and compression, and what is refused."""

import json
import re

from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams, topics
from bellows_ros.files.messages import REASONS
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from ruamel.yaml import YAML

from . import recordings as made

COUNT = 20


def change_metadata(folder, **changes):
    """Change entries of metadata.yaml, return all of them."""
    content = YAML(typ='safe').load((folder / 'metadata.yaml').read_text())
    content['rosbag2_bagfile_information'].update(changes)
    (folder / 'metadata.yaml').write_text(json.dumps(content))
    return content['rosbag2_bagfile_information']


def one_topic(path, messages, kind=made.POSE, storage='mcap', **options):
    """Write a recording with the topic /a."""
    return made.write(path, {('/a', kind): messages}, storage, **options)


def error_of(path, wanted=None):
    """Return the message a recording is refused with."""
    with pytest.raises(BellowsError) as error:
        read_streams(path, wanted or {'tool_pose': '/a'})
    assert error.value.exit_code == 2
    return str(error.value)


@pytest.fixture
def folder(tmp_path):
    """Provide a recording of four messages."""
    return one_topic(tmp_path / 'b', made.poses(4))


@pytest.fixture(params=made.FORMS, ids='-'.join)
def bag(request, tmp_path):
    """Provide a recording with three topics, in each storage and compression."""
    storage, compression = request.param
    t = made.stamps(COUNT)
    content = {
        ('/tool/pose', made.POSE): made.poses(COUNT),
        ('/tool/twist', made.TWIST): [
            (int(t[i]), made.encoded(made.TWIST, t[i], twist=made.twist_values(COUNT)[i]))
            for i in range(COUNT)],
        ('/unused', made.POSE): made.poses(3)}
    return made.write(tmp_path / 'bag', content, storage, compression)


def test_streams_are_read_from_every_storage_and_compression(bag):
    wanted = {'tool_pose': '/tool/pose', 'tool_twist': 'tool/twist', 'other_twist': ''}
    streams = read_streams(bag, wanted)
    assert set(streams) == {'tool_pose', 'tool_twist'}
    pose, twist = streams['tool_pose'], streams['tool_twist']
    values = made.pose_values(COUNT)
    assert isinstance(pose, PoseStream) and isinstance(twist, TwistStream)
    assert pose.name == '/tool/pose' and pose.frame_id == 'world' and pose.refused == {}
    assert_array_equal(pose.stamps_ns, made.stamps(COUNT))
    assert_array_equal(pose.position, values[:, :3])
    assert_array_equal(pose.rotation, quaternion_to_rotation(values[:, 3:]))
    assert_array_equal(np.hstack([twist.linear, twist.angular]), made.twist_values(COUNT))
    assert_array_equal(twist.stamps_ns, made.stamps(COUNT))
    assert twist.frame_id == 'world'
    assert topics(bag) == [
        ('/tool/pose', made.POSE, COUNT), ('/tool/twist', made.TWIST, COUNT),
        ('/unused', made.POSE, 3)]


@pytest.mark.parametrize(
    'kind', [made.POSE_COVARIANCE, made.TRANSFORM, made.ODOMETRY])
def test_other_types_are_read_with_the_frame_their_axes_are_in(tmp_path, kind):
    t, values, twists = made.stamps(4), made.pose_values(4), made.twist_values(4)
    messages = [(int(t[i]), made.encoded(kind, t[i], pose=values[i], twist=twists[i]))
                for i in range(4)]
    path = one_topic(tmp_path / 'b', messages, kind)
    stream = read_streams(path, {'p': 'a'})['p']
    assert_array_equal(stream.position, values[:, :3])
    assert_array_equal(stream.rotation, quaternion_to_rotation(values[:, 3:]))
    assert stream.frame_id == 'world'
    if kind == made.ODOMETRY:
        stream = read_streams(path, {'tool_twist': 'a'})['tool_twist']
        assert_array_equal(np.hstack([stream.linear, stream.angular]), twists)
        assert stream.frame_id == 'body'


def test_a_bare_storage_file_is_a_recording_too(folder):
    stream = read_streams(made.storage_file(folder), {'p': 'a'})['p']
    assert_array_equal(stream.position, made.pose_values(4)[:, :3])


def faulty(index, reason):
    """Return a PoseStamped message with one fault."""
    before, t = made.stamps(100)[[index - 1, index]]
    pose = made.pose_values(100)[index - (reason == 'copy')]
    t = {'zero_stamp': 0, 'duplicate_stamp': before, 'copy': before, 'backward_stamp': before - 1,
         'future_stamp': t + 3_600_000_000_000}.get(reason, t)
    pose[3:] *= {'zero_quaternion': 1e-9, 'not_unit': 1.02}.get(reason, 1.0)
    if reason == 'nan':
        pose[2 + index % 5] = (np.nan, np.inf, -np.inf)[index % 3]  # of both parts
    if reason == 'out_of_range':
        pose[0] = 1e300
    frame_id = 'elsewhere' if reason == 'frame_id' else 'world'
    data = made.encoded(made.POSE, t, pose=pose, frame_id=frame_id)
    return data[:-9] if reason == 'malformed' else data


@pytest.mark.parametrize('reason', [
    reason for reason in REASONS if not reason.startswith('tag_')])
def test_messages_that_cannot_be_used_are_counted_by_reason(tmp_path, reason):
    bad = (1, 7, 50, 99)
    good = made.poses(100)
    messages = [(log, faulty(i, reason) if i in bad else data)
                for i, (log, data) in enumerate(good)]
    stream = read_streams(one_topic(tmp_path / 'b', messages), {'p': 'a'})['p']
    assert stream.refused == {reason: bad}
    kept = np.setdiff1d(np.arange(100), bad)
    assert_array_equal(stream.stamps_ns, made.stamps(100)[kept])
    assert_array_equal(stream.position, made.pose_values(100)[kept, :3])
    assert stream.frame_id == 'world'


@pytest.mark.parametrize('storage', made.PLUGINS)
def test_an_empty_recording_is_refused(tmp_path, storage):
    folder = one_topic(tmp_path / 'b', [], storage=storage)
    error_of(folder)
    assert topics(folder) == [('/a', made.POSE, 0)]
    made.storage_file(folder).write_bytes(b'')
    assert made.storage_file(folder).name in error_of(folder)
    change_metadata(folder, relative_file_paths=[])
    assert error_of(folder)


def test_a_wrong_topic_or_type_is_refused_with_those_that_fit(bag):
    message = error_of(bag, {'tool_pose': '/tool'})
    assert all(own in message for own in ("'/tool'", '/tool/pose, /unused', 'topics.tool_pose'))
    message = error_of(bag, {'tool_twist': '/tool/pose'})
    assert all(own in message for own in (
        "'/tool/pose'", made.POSE, made.TWIST, made.ODOMETRY, '/tool/twist'))


def test_a_topic_without_usable_messages_is_refused_with_the_counts(tmp_path):
    values = made.pose_values(10)
    values[:6, 0] = np.nan
    values[6:, 3:] = 0.0
    message = error_of(one_topic(tmp_path / 'b', made.poses(10, values)))
    assert re.findall(r'\b\d+\b', message.partition('usable')[2]) == ['10', '6', '0', '4', '6']


def test_a_topic_of_two_types_is_refused(tmp_path):
    t, pose = made.EPOCH_NS, made.pose_values(1)[0]
    kinds = (made.POSE, made.TRANSFORM)
    content = {('/a', k): [(t, made.encoded(k, t, pose=pose))] for k in kinds}
    assert f'{made.POSE} and {made.TRANSFORM}' in error_of(made.write(tmp_path / 'b', content))


def test_what_is_no_recording_is_refused(tmp_path):
    """Also a device, a bag of ROS 1, and a folder of recordings; a long name is not repeated."""
    old, inner = tmp_path / 'old.bag', tmp_path / 'all'
    old.write_bytes(b'#ROSBAG V2.0\n' + bytes(200))
    for name in ('second', 'first'):
        one_topic(inner / name, made.poses(4))
    for path, words in ((tmp_path, ''), (tmp_path / 'nothing', ''), ('nul\0byte', ''),
                        ('/dev/zero', ''), ('a' * 5000, ''), (old, 'rosbags-convert --src'),
                        (inner, 'it holds recordings, first, second.')):
        assert words in error_of(path) and len(error_of(path)) < 700
