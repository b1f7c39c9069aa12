"""
Damaged and hostile recordings: each is an error that can be named, or a loss that is counted.

Nothing here may end in another exception, take long, or fill the memory.
"""

import io
import struct
import sys
import time

from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import MAX_RECORD_BYTES
from bellows_ros.files.bags import read_contents, read_streams, topics
from bellows_ros.files.storage import MCAP_MAGIC
import lz4.frame
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from . import recordings as made

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

COUNT = 60
WANTED = {'p': '/a'}
PATIENCE = 5.0  # s of this process, for what takes milliseconds


def outcome(path):
    """Return what is in a recording, which must add up, or None if it is refused."""
    begin = time.process_time()
    try:
        contents = read_contents(path, WANTED)
        for problem in contents.problems.values():
            raise problem
        stream = contents.streams['p']
    except BellowsError as error:
        assert len(str(error)) < 2000
        assert str(path) in str(error)
        return None
    finally:
        assert time.process_time() - begin < PATIENCE
    assert np.all(np.isfinite(stream.position)) and np.all(np.diff(stream.stamps_ns) > 0)
    lost = [i for indices in stream.refused.values() for i in indices]
    assert len(set(lost)) == len(lost)
    read, counted = len(stream) + len(lost), {n: m for n, _, m in topics(path)}['/a']
    assert read == counted or read < counted and contents.notes
    return contents


@pytest.mark.parametrize('form', made.FORMS, ids='-'.join)
def test_a_file_truncated_anywhere_is_refused_or_read_to_the_break_with_a_note(tmp_path, form):
    content = {('/a', made.POSE): made.poses(COUNT), ('/b', made.POSE): made.poses(3)}
    bag = made.write(tmp_path / 'bag', content, *form)
    file = made.storage_file(bag)
    whole = file.read_bytes()
    rng = np.random.default_rng(1)
    places = {0, 1, 8, 9, 16, 100, len(whole) - 1, len(whole) - 8, len(whole) - 37}
    places |= {int(x) for x in rng.integers(0, len(whole), size=40)}
    for size in places:
        file.write_bytes(whole[:size])
        found = outcome(bag)
        assert found is None or found.notes, f'truncated to {size} of {len(whole)} bytes'
    file.write_bytes(whole)
    assert len(outcome(bag).streams['p']) == COUNT


# MCAP files made by hand: the pieces, and what can be wrong with each.


def record(kind, body):
    """Return a record."""
    return struct.pack('<BQ', kind, len(body)) + body


def text(value):
    """Return a string."""
    return struct.pack('<I', len(value)) + value.encode()


SCHEMA = record(3, struct.pack('<H', 1) + text(made.POSE) + text('ros2msg') + text(''))
HEADER = record(1, text('ros2') + text('test'))


def channel(number=1, topic='/a', schema=1):
    """Return a channel record."""
    fields = struct.pack('<HH', number, schema) + text(topic) + text('cdr')
    return record(4, fields + struct.pack('<I', 0))


def message(i, number=1):
    """Return a message record."""
    return message_of(*made.poses(i + 1)[i], number)


def message_of(log_time_ns, data, number=1):
    """Return the record of a message."""
    return record(5, struct.pack('<HIQQ', number, 0, log_time_ns, log_time_ns) + data)


def chunk(records, compression='', stored=None, size=None, checksum=0):
    """Return a chunk record."""
    stored = records if stored is None else stored
    size = len(records) if size is None else size
    head = struct.pack('<QQQI', 0, 0, size, checksum)
    return record(6, head + text(compression) + struct.pack('<Q', len(stored)) + stored)


def statistics(counts):
    """Return a statistics record, of which only the counts by channel matter."""
    counted = b''.join(struct.pack('<HQ', *item) for item in counts.items())
    return record(0x0B, bytes(42) + struct.pack('<I', len(counted)) + counted)


def write_mcap(path, *records, ended=True):
    """Write a file of records."""
    end = record(0x0F, bytes(4)) + record(2, bytes(20)) + MCAP_MAGIC if ended else b''
    path.write_bytes(MCAP_MAGIC + HEADER + b''.join(records) + end)
    return path


BASE = SCHEMA + channel()
PACK = {'zstd': zstd.compress, 'lz4': lz4.frame.compress}


@pytest.mark.parametrize('whole', [lambda records: [records], lambda records: [chunk(records)]])
def test_messages_before_one_of_an_unknown_channel_are_read(tmp_path, whole):
    """Of a recording that was not closed; and the channel has to come before its messages."""
    records = BASE + message(0) + message(1) + message(2, 7) + channel(7, '/b') + message(3)
    path = write_mcap(tmp_path / 'a.mcap', *whole(records), ended=False)
    found = outcome(path)
    assert_array_equal(found.streams['p'].position, made.pose_values(2)[:, :3])
    assert any('channel 7' in note for note in found.notes)


@pytest.mark.parametrize('compression', ['', 'zstd', 'lz4'])
def test_chunks_are_read_and_unknown_records_passed_over(tmp_path, compression):
    records = BASE + message(0) + record(0x80, b'private') + message(1)
    pack = PACK.get(compression, bytes)
    attachment, packed = record(9, bytes(3 * 2**20)), pack(records)
    path = write_mcap(
        tmp_path / 'a.mcap', attachment, chunk(records, compression, packed), channel())
    assert len(outcome(path).streams['p']) == 2


@pytest.mark.parametrize('records', [
    [message(0)], [chunk(BASE + message(0)[:-1])],
    [chunk(BASE, 'bz2')], *([chunk(BASE, form, packed)] for form, pack in PACK.items()
                            for packed in (pack(BASE)[:-2], b'nonsense')),
    [chunk(BASE, size=2**62)], [chunk(BASE, checksum=1)], [record(5, b'')],
    [record(3, bytes(2) + b'\xff' * 4)], [struct.pack('<BQ', 5, 2**63)],
    [struct.pack('<BQ', 5, MAX_RECORD_BYTES)], [record(2, bytes(20))]])
def test_records_that_are_not_sound_are_refused(tmp_path, records):
    path = write_mcap(tmp_path / 'a.mcap', *records)
    with pytest.raises(BellowsError, match=r'a\.mcap'):
        read_streams(path, WANTED)
    topics(path)  # lists what is there


@pytest.mark.parametrize('summary', [
    b'', b'\x0b' + bytes(3), record(0x0B, bytes(42) + struct.pack('<I', 13) + bytes(13)),
    record(0x0B, bytes(10)), statistics({1: 5}), record(3, b'\xff' * 9),
    b'\xff' * 40, struct.pack('<BQ', 0x0B, 2**63)])
@pytest.mark.parametrize('ends', [b'', MCAP_MAGIC])
def test_messages_before_a_damaged_summary_are_read(tmp_path, summary, ends):
    """The state of the summary is noted."""
    path = tmp_path / 'a.mcap'
    path.write_bytes(MCAP_MAGIC + HEADER + chunk(BASE + message(0) + message(1))
                     + record(0x0F, bytes(4)) + summary + ends)
    found = outcome(path)
    assert_array_equal(found.streams['p'].position, made.pose_values(2)[:, :3])
    assert any('2 messages' in note for note in found.notes)


@pytest.mark.parametrize('compression', ['', 'zstd', 'lz4'])
def test_a_recording_that_was_not_ended_is_read_up_to_the_break(tmp_path, compression):
    """The last of three chunks is cut near its end."""
    pack, each = PACK.get(compression, bytes), [message_of(*m) for m in made.poses(300)]
    parts = [BASE + each[0], b''.join(each[1:200]), b''.join(each[200:])]
    path = write_mcap(tmp_path / 'a.mcap', *(
        chunk(part, compression, pack(part)) for part in parts), ended=False)
    path.write_bytes(path.read_bytes()[:-30])
    found, count = read_contents(path, WANTED), 200
    assert len(found.streams['p']) == count
    (note,) = found.notes
    seconds = (made.stamps(count)[-1] // 10**6) * 1e-3
    assert f'{count} messages up to {np.datetime64(round(seconds * 1e3), "ms")} UTC' in note
    notes = []
    assert topics(path, notes) == [('/a', made.POSE, count)]
    assert notes == [note]


@pytest.mark.parametrize('tail', [bytes(5000), b'\xff' * 5000, b'\x05' + bytes(300)],
                         ids=['zeros', 'ones', 'message'])
def test_what_a_file_system_leaves_behind_the_break_is_noted(tmp_path, tail):
    path = write_mcap(tmp_path / 'a.mcap', BASE, message(0), message(1), ended=False)
    path.write_bytes(path.read_bytes() + tail)
    found = outcome(path)
    assert len(found.streams['p']) == 2
    assert 'not closed' in found.notes[0] and '2 messages' in found.notes[0]


def test_a_recording_that_was_not_ended_and_has_nothing_is_refused(tmp_path):
    path = write_mcap(tmp_path / 'a.mcap', BASE, ended=False)
    with pytest.raises(BellowsError, match=r'\b0 messages'):
        read_streams(path, WANTED)


def test_small_files_that_inflate_do_not_fill_the_memory(tmp_path):
    out = io.BytesIO()
    with zstd.open(out, 'wb') as file:
        for _ in range(2**9):
            file.write(bytes(2**20))
    inflating = out.getvalue()
    assert len(inflating) < 2**17

    (tmp_path / 'b.db3').write_bytes(inflating)
    assert made.peak_memory(lambda: outcome(tmp_path / 'b.db3')) < 2**24
    head = MCAP_MAGIC + HEADER + struct.pack('<BQ', 9, 2**29)
    (tmp_path / 'a.mcap').write_bytes(zstd.compress(head) + inflating)
    assert made.peak_memory(lambda: outcome(tmp_path / 'a.mcap')) < 2**25
