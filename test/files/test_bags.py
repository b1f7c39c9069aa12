"""Recordings of rosbags in all storages and compressions: whole, damaged and written ones."""

from contextlib import closing
import json
import os
import re
import sqlite3
import time
import tracemalloc

from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import as_messages, read_streams, STORAGES, topics, write_bag
from bellows_ros.files.decompression import ExpansionError, largest, of_lz4, of_zstd, zstd
import lz4.frame
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

from . import recordings as made

COUNT = 20
PATIENCE = 5.0  # s of this process, for what takes milliseconds


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
    'nan', 'zero_quaternion', 'not_unit', 'zero_stamp', 'duplicate_stamp', 'backward_stamp',
    'future_stamp', 'frame_id', 'copy', 'malformed', 'out_of_range'])
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


def test_a_folder_is_judged_by_its_content(tmp_path):
    """Also a recording whose folder has the suffix of ROS 1."""
    assert topics(one_topic(tmp_path / 'pick.bag', made.poses(4)))[0].messages == 4


def is_read(path, name='/tool/pose'):
    """Return whether a recording is read, all of it; otherwise it is refused with a remedy."""
    begin = time.process_time()
    try:
        topics(path)
        stream = read_streams(path, {'p': name})['p']
    except BellowsError as error:
        assert str(path) in str(error) and len(str(error)) < 2000 and error.exit_code == 2
        return False
    finally:
        assert time.process_time() - begin < PATIENCE
    assert np.all(np.isfinite(stream.position)) and np.all(np.diff(stream.stamps_ns) > 0)
    assert len(stream) + sum(map(len, stream.refused.values())) == COUNT
    return True


def test_a_file_truncated_anywhere_is_refused(bag):
    file = made.storage_file(bag)
    whole, rng = file.read_bytes(), np.random.default_rng(1)
    places = {0, 1, 8, 9, 16, 100, len(whole) - 1, len(whole) - 8, len(whole) - 37}
    for size in places | {int(x) for x in rng.integers(0, len(whole), size=30)}:
        file.write_bytes(whole[:size])
        assert not is_read(bag), f'truncated to {size} of {len(whole)} bytes'
    file.write_bytes(whole)
    assert is_read(bag)


def test_damage_is_named_with_the_messages_before_it_and_the_remedy(tmp_path):
    """Of a recording of several chunks, with damage in the last one."""
    one = made.poses(1)[0][1]
    bag = made.write(tmp_path / 'b', {('/a', made.POSE): [
        (int(t), one) for t in made.stamps(30_000)]}, compression='STORAGE')
    file = made.storage_file(bag)
    whole = bytearray(file.read_bytes())
    whole[whole.rindex(b'\x28\xb5\x2f\xfd')] ^= 1  # where a compressed chunk begins
    file.write_bytes(whole)
    with pytest.raises(BellowsError, match=r"after [1-9]\d+ messages.*'mcap recover'"):
        read_streams(bag, {'p': '/a'})


def test_a_folder_that_was_not_closed_is_refused_with_reindex(tmp_path):
    bag = made.write(tmp_path / 'b', {('/a', made.POSE): made.poses(COUNT)}, 'sqlite3')
    journal = bag / 'b.db3-wal'
    journal.write_bytes(b'log')
    with pytest.raises(BellowsError, match=r'b\.db3 was not closed.*ros2 bag reindex'):
        topics(bag)
    journal.unlink()
    (bag / 'metadata.yaml').unlink()
    with pytest.raises(BellowsError, match=r'metadata\.yaml.*ros2 bag reindex'):
        topics(bag)
    assert is_read(made.storage_file(bag), '/a')


def recorded(**options):
    """Return poses to record."""
    return as_messages('/a', made.POSE, made.stamps(COUNT), made.pose_values(COUNT), **options)


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('zstd', [False, True])
def test_every_form_is_read_by_this_package_and_by_rosbags(tmp_path, storage, zstd):
    path = tmp_path / 'bag'
    write_bag(path, [recorded()], storage, zstd)
    stream = read_streams(path, {'p': 'a'})['p']
    assert_array_equal(stream.position, made.pose_values(COUNT)[:, :3])
    assert_array_equal(stream.stamps_ns, made.stamps(COUNT))
    with AnyReader([path]) as reader:
        messages = [(t, reader.deserialize(data, c.msgtype)) for c, t, data in reader.messages()]
    assert [t for t, _ in messages] == list(made.stamps(COUNT))
    assert_array_equal(
        [[m.pose.position.x, m.pose.orientation.w] for _, m in messages],
        made.pose_values(COUNT)[:, [0, 6]])
    assert list(tmp_path.iterdir()) == [path]


def test_topics_are_recorded_in_the_order_messages_were_received_in(tmp_path):
    t = made.stamps(COUNT)
    late = t + 5_000_000
    write_bag(
        tmp_path / 'b',
        [
            recorded(log_times_ns=late[::-1]),
            as_messages('/b', made.TWIST, t, made.twist_values(COUNT))])
    with AnyReader([tmp_path / 'b']) as reader:
        order = [(t, c.topic) for c, t, _ in reader.messages()]
    assert order == sorted([(x, '/a') for x in late] + [(x, '/b') for x in t])
    stream = read_streams(tmp_path / 'b', {'p': 'a'})['p']
    assert_array_equal(stream.stamps_ns, t[-1:])
    assert stream.refused == {'backward_stamp': tuple(range(1, COUNT))}


def test_a_folder_with_anything_else_is_never_replaced(tmp_path):
    path = tmp_path / 'b'
    write_bag(path, [recorded()])
    (path / 'thesis.tex').write_text('precious')
    with pytest.raises(BellowsError, match=r"'thesis\.tex'"):
        write_bag(path, [recorded()], replace=True)
    (path / 'thesis.tex').rename(tmp_path / 'file')
    (path / 'metadata.yaml').unlink()
    with pytest.raises(BellowsError, match=r'metadata\.yaml'):
        write_bag(path, [recorded()], replace=True)
    with pytest.raises(BellowsError, match='file'):
        write_bag(tmp_path / 'file', [recorded()], replace=True)
    assert (tmp_path / 'file').read_text() == 'precious'


def test_what_cannot_be_recorded_is_refused(tmp_path):
    t = made.stamps(3)
    with pytest.raises(BellowsError, match="'/a'.* 1970"):
        as_messages('/a', made.POSE, t - 2 * made.EPOCH_NS, np.zeros((3, 7)))
    with pytest.raises(BellowsError):
        write_bag(tmp_path / 'b', [])
    with pytest.raises(BellowsError):
        write_bag(tmp_path / 'none' / 'b', [recorded()])
    assert list(tmp_path.iterdir()) == []


BOMB = bytes(2**27)
"""Content that is a thousandth as large when compressed."""


def write_bomb(kind, path):
    """Write a small recording that expands without bound."""
    storage, compression = kind.split()
    several = [(made.EPOCH_NS + k, BOMB[:2**24]) for k in range(6)]
    messages = several if compression == 'messages' else [(made.EPOCH_NS, BOMB)]
    one_topic(path, messages, storage=storage, compression={
        'messages': 'MESSAGE', 'message': 'MESSAGE', 'file': 'FILE', 'chunk': 'STORAGE',
        'index': 'STORAGE'}[compression])
    if compression == 'index':  # without one
        file = made.storage_file(path)
        data = file.read_bytes()
        file.write_bytes(data[:-28] + bytes(20) + data[-8:])


@pytest.mark.parametrize('kind', [
    'sqlite3 message', 'sqlite3 messages', 'sqlite3 file', 'mcap message', 'mcap file',
    'mcap chunk', 'mcap index'])
def test_a_recording_that_expands_without_bound_is_refused_with_the_sizes(kind, tmp_path):
    write_bomb(kind, tmp_path / 'b')
    size = sum(file.stat().st_size for file in (tmp_path / 'b').iterdir())
    assert size < len(BOMB) / 500
    tracemalloc.start()
    try:
        message = error_of(tmp_path / 'b')
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    compressed, most = map(int, re.search(
        r'([0-9]+) bytes expand to more than ([0-9]+)', message).groups())
    assert compressed <= size and most == largest(compressed) and peak < 3 * most


@pytest.mark.parametrize(('compress', 'read'), [
    (zstd.compress, of_zstd), (lz4.frame.compress, of_lz4)], ids=['zstd', 'lz4'])
def test_frames_are_decompressed_up_to_a_bound(compress, read):
    data = np.random.default_rng(0).bytes(1000)
    assert read(compress(data) + compress(data[:10])) == data + data[:10]
    with pytest.raises(ExpansionError, match='expand'):
        read(compress(BOMB) + compress(BOMB[:2**26]))
    with pytest.raises(EOFError):
        read(compress(data)[:-5])


@pytest.mark.parametrize('compression', ['NONE', 'FILE'])
def test_a_file_that_is_listed_repeatedly_is_refused(compression, tmp_path):
    path = one_topic(tmp_path / 'b', made.poses(4), compression=compression)
    name = made.storage_file(path).name
    change_metadata(path, relative_file_paths=[name, 'x/' + name] * 500)
    assert f"lists '{name}' 1000 times" in error_of(path)


@pytest.mark.parametrize('place', ['c.mcap', 'c.db3', 'b/metadata.yaml', 'b/c.db3', 'b/b.mcap'])
def test_a_pipe_is_no_part_of_a_recording(place, folder, tmp_path):
    """And is not opened, which would wait for ever."""
    (tmp_path / place).unlink(missing_ok=True)
    os.mkfifo(tmp_path / place)
    assert 'is no plain file' in error_of(tmp_path / place.split('/')[0])


@pytest.mark.parametrize('change', [
    "UPDATE messages SET data = 'text'", 'UPDATE messages SET data = 7',
    "UPDATE messages SET timestamp = 'soon'", "UPDATE topics SET name = x'00'",
    "UPDATE topics SET type = x'00'"])
def test_values_of_a_wrong_type_in_a_database_are_refused(change, tmp_path):
    path = one_topic(tmp_path / 'b', made.poses(4), storage='sqlite3')
    with closing(sqlite3.connect(made.storage_file(path))) as database:
        database.execute(change)
        database.commit()
    for recording in (path, made.storage_file(path)):
        error_of(recording)
