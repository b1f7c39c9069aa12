"""Digests of files and of recordings."""

import hashlib

from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import digests, recording_digest
import pytest


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


def test_a_recording_is_known_by_its_messages(tmp_path):
    """Take a folder and the file in it as one, and another file as another."""
    folder = tmp_path / 'bag'
    folder.mkdir()
    (folder / 'bag_0.mcap').write_bytes(b'abc')
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information: {version: 9, relative_file_paths: [bag_0.mcap]}')
    (folder / 'notes.txt').write_text('by hand')
    other = tmp_path / 'other.mcap'
    other.write_bytes(b'abd')
    assert recording_digest(folder) == recording_digest(folder / 'bag_0.mcap')
    assert recording_digest(folder) != recording_digest(other)


def test_a_missing_file_is_named(tmp_path):
    """Say which one."""
    with pytest.raises(BellowsError, match='nowhere'):
        digests(tmp_path / 'nowhere')
