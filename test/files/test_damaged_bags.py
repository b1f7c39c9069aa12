"""Damaged recordings: each is refused with the remedy, none ends in another exception."""

import time

from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams, topics
import numpy as np
import pytest

from . import recordings as made

COUNT = 60
PATIENCE = 5.0  # s of this process, for what takes milliseconds


def is_read(path):
    """Return whether a recording is read, all of it; otherwise it is refused with a remedy."""
    begin = time.process_time()
    try:
        topics(path)
        stream = read_streams(path, {'p': '/a'})['p']
    except BellowsError as error:
        assert str(path) in str(error) and len(str(error)) < 2000 and error.exit_code == 2
        return False
    finally:
        assert time.process_time() - begin < PATIENCE
    assert np.all(np.isfinite(stream.position)) and np.all(np.diff(stream.stamps_ns) > 0)
    assert len(stream) + sum(map(len, stream.refused.values())) == COUNT
    return True


@pytest.fixture(params=made.FORMS, ids='-'.join)
def bag(request, tmp_path):
    """Provide a recording with two topics, in each storage and compression."""
    return made.write(tmp_path / 'bag', {
        ('/a', made.POSE): made.poses(COUNT), ('/b', made.POSE): made.poses(3)}, *request.param)


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
    assert is_read(made.storage_file(bag))
