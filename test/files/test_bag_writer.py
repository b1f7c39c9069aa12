"""Recordings that are written: read back by this package and by rosbags, whole or not at all."""

from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import as_messages, read_streams, STORAGES, write_bag
import numpy as np
from numpy.testing import assert_array_equal
import pytest
from rosbags.highlevel import AnyReader

from . import recordings as made

FORMS = [(storage, zstd) for storage in STORAGES for zstd in (False, True)]
COUNT = 30


def recorded(**options):
    """Return poses to record."""
    return as_messages('/a', made.POSE, made.stamps(COUNT), made.pose_values(COUNT), **options)


@pytest.mark.parametrize('storage, zstd', FORMS)
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
