"""Reading recordings that rosbags wrote, in every storage and compression, and what is refused."""

import hashlib
import json
import os
import re
import shutil
import sqlite3

from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.signals.trajectory import PoseStream, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, storage
from bellows_ros.files.bag_folder import digests
from bellows_ros.files.bags import read_streams, topics
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
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


def test_a_bare_storage_file_is_a_recording_too(bag):
    from_folder = read_streams(bag, {'tool_pose': '/tool/pose'})['tool_pose']
    from_file = read_streams(made.storage_file(bag), {'tool_pose': '/tool/pose'})['tool_pose']
    assert_array_equal(from_file.position, from_folder.position)
    renamed = made.storage_file(bag).rename(bag / 'renamed')
    assert topics(renamed) == topics(os.fspath(renamed))


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
    reason for reason in bags.messages.REASONS if not reason.startswith('tag_')])
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


def test_quaternions_with_small_rounding_are_normalised(tmp_path):
    values = made.pose_values(10)
    rounded = np.hstack([values[:, :3], np.round(values[:, 3:], 3)])
    stream = read_streams(one_topic(tmp_path / 'b', made.poses(10, rounded)), {'p': 'a'})['p']
    assert stream.refused == {}
    # Three decimals leave up to 0.5e-3 per component, twice that in an angle.
    assert_allclose(stream.rotation, quaternion_to_rotation(values[:, 3:]), rtol=0, atol=3e-3)


def test_messages_come_in_the_order_they_were_received_in(tmp_path):
    messages = made.poses(6)
    logged = [(messages[i][0], messages[j][1]) for i, j in enumerate([0, 2, 1, 3, 5, 4])]
    for plugin in made.PLUGINS:
        path = one_topic(tmp_path / plugin, logged[::-1], storage=plugin)
        stream = read_streams(path, {'p': 'a'})['p']
        assert stream.refused == {'backward_stamp': (2, 5)}
        assert_array_equal(stream.stamps_ns, made.stamps(6)[[0, 2, 3, 5]])


def test_one_topic_may_serve_two_roles_and_batches_join(tmp_path, monkeypatch):
    monkeypatch.setattr(storage, 'BATCH', 7)
    messages = made.poses(50)
    messages[3] = (messages[3][0], faulty(3, 'malformed'))
    messages[20] = (messages[20][0], faulty(20, 'frame_id'))
    path = one_topic(tmp_path / 'b', messages, storage='sqlite3')
    streams = read_streams(path, {'p': 'a', 'q': '/a'})
    for stream in streams.values():
        assert stream.refused == {'malformed': (3,), 'frame_id': (20,)}
        kept = np.setdiff1d(np.arange(50), [3, 20])
        assert_array_equal(stream.position, made.pose_values(50)[kept, :3])


def test_a_recording_in_several_files_is_one(tmp_path):
    messages = made.poses(30)
    folder = one_topic(tmp_path / 'first', messages[:10])
    for i, part in ((1, messages[10:20]), (2, messages[20:])):
        more = made.storage_file(one_topic(tmp_path / f'more{i}', part))
        shutil.copy(more, folder / f'first_{i}.mcap')
    change_metadata(folder, relative_file_paths=['first.mcap', 'first_1.mcap', 'first_2.mcap'])
    assert topics(folder) == [('/a', made.POSE, 30)]
    stream = read_streams(folder, {'p': 'a'})['p']
    assert_array_equal(stream.position, made.pose_values(30)[:, :3])


@pytest.mark.parametrize('version', range(1, 10))
@pytest.mark.parametrize('storage', made.PLUGINS)
def test_metadata_of_every_version_is_read(tmp_path, version, storage):
    folder = one_topic(tmp_path / 'b', made.poses(4), storage=storage)
    info = change_metadata(folder, version=version)
    later = {
        3: ['compression_format', 'compression_mode'], 5: ['files'], 6: ['custom_data'],
        8: ['ros_distro']}
    for since, keys in later.items():
        for key in keys if version < since else ():
            del info[key]
    if version < 4:  # the folder's own name came first
        info['relative_file_paths'] = [f'b/{x}' for x in info['relative_file_paths']]
    for topic in info['topics_with_message_count']:
        topic['topic_metadata']['offered_qos_profiles'] = '- history: 3\n  depth: 0\n' if (
            version < 9) else [{'history': 'unknown', 'deadline': {'sec': 1, 'nsec': 0}}]
        topic['topic_metadata'].pop('type_description_hash')
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': info}))
    assert len(read_streams(folder, {'p': 'a'})['p']) == 4


def test_what_is_no_recording_is_refused(tmp_path):
    """Also a device; and a name of thousands of letters is not repeated."""
    for path in (tmp_path, tmp_path / 'nothing', 'nul\0byte', '/dev/zero', 'a' * 5000):
        assert len(error_of(path)) < 300
    with pytest.raises(BellowsError):
        topics(tmp_path / 'nothing')


def test_a_folder_of_recordings_lists_them(tmp_path):
    for name in ('second', 'first'):
        one_topic(tmp_path / name, made.poses(4))
    (tmp_path / 'pictures').mkdir()
    assert 'it holds 2: first, second.' in error_of(tmp_path)


def test_a_folder_without_metadata_is_read_with_a_note(tmp_path):
    """As a recorder leaves it that crashed in its twelfth file, while it compressed another."""
    folder, messages = tmp_path / 'crashed', made.poses(12)
    folder.mkdir()
    for k, message in enumerate(messages):
        part = made.storage_file(one_topic(tmp_path / f'{k}', [message]))
        shutil.copy(part, folder / f'crashed_{k}.mcap')
    (folder / 'crashed_3.mcap.zstd').write_bytes(b'half')
    (folder / 'notes.txt').write_text('by hand')
    whole = (folder / 'crashed_11.mcap').read_bytes()
    (folder / 'crashed_11.mcap').write_bytes(whole[:len(whole) // 2])
    contents = bags.read_contents(folder, {'p': 'a'})
    stream = contents.streams['p']
    assert_array_equal(stream.stamps_ns, made.stamps(12)[:len(stream)])
    assert len(stream) >= 11 and stream.refused == {}
    first, last = contents.notes
    assert 'metadata.yaml' in first
    assert 'crashed_0.mcap, crashed_1.mcap, crashed_2.mcap, crashed_3.mcap' in first
    assert 'crashed_11.mcap' in last
    (folder / 'other.db3').write_bytes(b'')  # of another storage
    assert re.search(r'crashed_\d+\.mcap and other\.db3', error_of(folder))


def test_wrong_numbers_of_messages_in_metadata_are_noted(tmp_path):
    content = {('/a', made.POSE): made.poses(9), ('/b', made.POSE): made.poses(4)}
    folder = made.write(tmp_path / 'b', content)
    assert bags.read_contents(folder, {'p': 'a'}).notes == ()
    change_metadata(folder, message_count=15)
    (note,) = bags.read_contents(folder, {'p': 'a'}).notes
    assert {'13', '15'} <= set(re.findall(r'\d+', note)) and 'metadata.yaml' in note
    notes = []
    topics(folder, notes)
    assert notes == [note]


def test_links_in_a_circle_and_out_of_the_folder_are_refused(tmp_path, folder):
    file = made.storage_file(folder)
    file.unlink()
    file.symlink_to(file.name)
    assert file.name in error_of(folder)
    assert error_of(file)
    file.unlink()
    file.symlink_to(made.storage_file(one_topic(tmp_path / 'other', made.poses(4))))
    assert file.name in error_of(folder)


@pytest.mark.parametrize('storage', made.PLUGINS)
def test_an_empty_recording_is_refused(tmp_path, storage):
    folder = one_topic(tmp_path / 'b', [], storage=storage)
    error_of(folder)
    assert topics(folder) == [('/a', made.POSE, 0)]
    made.storage_file(folder).write_bytes(b'')
    assert made.storage_file(folder).name in error_of(folder)
    change_metadata(folder, relative_file_paths=[])
    assert 'metadata.yaml' in error_of(folder)


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


def test_another_encoding_is_refused(folder):
    file = made.storage_file(folder)
    file.write_bytes(file.read_bytes().replace(b'\3\0\0\0cdr', b'\3\0\0\0abc'))
    assert f'{made.POSE} in abc' in error_of(folder)


@pytest.mark.parametrize('changes, named', [
    *(({'relative_file_paths': names}, 'relative_file_paths')
      for names in (None, 'b.mcap', [None], [''], ['b' * 5000])),
    *(({'relative_file_paths': [name], 'version': version}, f"'{name}'")
      for name in ('gone.mcap', '.', '/etc/passwd', '../o/other.mcap', 'sub/../../o.mcap',
                   'C:\\b.mcap', '..') for version in (3, 9))])
def test_damaged_metadata_is_refused(folder, changes, named):
    change_metadata(folder, **changes)
    assert named in error_of(folder)


@pytest.mark.parametrize('data', [b'- 1', b'a: [', b'\xff\xfe\0'])
def test_metadata_that_is_no_metadata_is_refused(folder, data):
    (folder / 'metadata.yaml').write_bytes(data)
    assert 'metadata.yaml' in error_of(folder)


def test_a_bag_of_ros_1_is_refused_with_how_to_convert_it(tmp_path):
    path = tmp_path / 'a.mcap'
    path.write_bytes(b'#ROSBAG V2.0\n' + bytes(200))
    for own in (path, tmp_path / 'old.bag'):
        assert 'rosbags-convert --src' in error_of(path.rename(own))


def test_a_path_with_signs_that_mean_something_in_an_address_is_read(tmp_path):
    folder = one_topic(tmp_path / 'a?b#c%20d', made.poses(4), storage='mcap')
    target = tmp_path / 'x?mode=rwc#%41'
    shutil.copytree(one_topic(tmp_path / 'plain', made.poses(4), storage='sqlite3'), target)
    for path in (folder, target):
        assert len(read_streams(path, {'p': 'a'})['p']) == 4


@pytest.mark.parametrize('mode, left', [('WAL', 3), ('PERSIST', 4)])
def test_a_database_that_was_not_closed_is_read_with_its_journal(tmp_path, mode, left):
    """With what a write-ahead log adds, and without what a rollback journal takes back."""
    file = made.storage_file(one_topic(tmp_path / 'b', made.poses(4), storage='sqlite3'))
    database = sqlite3.connect(file, isolation_level=None)
    database.execute(f'PRAGMA journal_mode = {mode}')
    database.execute('PRAGMA cache_size = 1')
    database.execute('BEGIN')
    database.execute('DELETE FROM messages WHERE id = 4')
    database.execute('CREATE TABLE filler AS SELECT zeroblob(100000)')  # leaves the cache
    if mode == 'WAL':
        database.execute('COMMIT')
    crashed = tmp_path / 'crashed'
    shutil.copytree(file.parent, crashed)  # as a recorder leaves it that is killed
    database.close()
    before = {path: path.read_bytes() for path in crashed.iterdir()}
    contents = bags.read_contents(crashed, {'p': 'a'})
    assert len(contents.streams['p']) == left
    (note,) = contents.notes
    assert 'not closed' in note and 'b.db3-' in note
    assert {path: path.read_bytes() for path in crashed.iterdir()} == before


@pytest.mark.parametrize('named, statement', [
    ('topics', 'DROP TABLE topics'),
    ('name', 'ALTER TABLE topics RENAME COLUMN name TO x'),
    ('list of topics', "UPDATE topics SET type = x'00'"),
    ('says 4', 'UPDATE messages SET topic_id = 9'),
    *(('', f"UPDATE messages SET {name} = 'text'") for name in ('data', 'timestamp'))])
def test_a_damaged_database_is_refused(tmp_path, named, statement):
    folder = one_topic(tmp_path / 'b', made.poses(4), storage='sqlite3')
    database = sqlite3.connect(made.storage_file(folder))
    database.execute(statement)
    database.commit()
    database.close()
    assert named in error_of(folder)


def test_a_topic_with_too_many_messages_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(bags, 'MAX_MESSAGES', 9)
    assert len(read_streams(one_topic(tmp_path / 'a', made.poses(9)), {'p': 'a'})['p']) == 9
    assert '9 messages' in error_of(one_topic(tmp_path / 'b', made.poses(10)))


def test_a_compressed_database_that_is_too_large_is_refused(tmp_path, monkeypatch):
    folder = one_topic(tmp_path / 'b', made.poses(9), storage='sqlite3', compression='FILE')
    monkeypatch.setattr(storage, 'MAX_INFLATED', 1000)
    monkeypatch.setattr(storage, 'MAX_INFLATION', 1)
    assert 'far larger than the file' in error_of(folder)


def test_reading_holds_little_more_than_what_it_returns(tmp_path):
    count = 20_000
    one = made.poses(1)[0][1]
    t = made.stamps(count)
    stamped = np.frombuffer(one * count, np.uint8).reshape(count, -1).copy()
    stamped[:, 4:12] = np.stack([t // 10**9, t % 10**9], axis=1).astype('<u4').view(np.uint8)
    messages = [(int(s), row.tobytes()) for s, row in zip(t, stamped, strict=True)]
    path = one_topic(tmp_path / 'b', messages)
    del messages, stamped
    # 650,000 messages in 400 MB are 600 bytes each; fixed costs are below 8 MB.
    assert made.peak_memory(lambda: read_streams(path, {'p': 'a'})) < 600 * count + 8e6


def test_a_folder_gives_every_file_in_order(tmp_path):
    """Sort by name, leave folders in it out, and read files larger than one chunk whole."""
    (tmp_path / 'inner').mkdir()
    large = bytes(range(256)) * 10_000
    (tmp_path / 'b').write_bytes(large)
    (tmp_path / 'a').write_bytes(b'')
    found = digests(tmp_path)
    assert [entry['name'] for entry in found] == ['a', 'b']
    assert found[1]['sha256'] == hashlib.sha256(large).hexdigest()
    assert found[1]['bytes'] == len(large)
    assert digests(tmp_path / 'b') == found[1:]


def test_a_missing_file_is_named(tmp_path):
    """Say which one."""
    with pytest.raises(BellowsError, match='nowhere'):
        digests(tmp_path / 'nowhere')
