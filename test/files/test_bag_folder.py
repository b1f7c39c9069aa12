"""Digests of files; test/workflows/test_routes.py has those of recordings."""

import hashlib

from bellows_ros.errors import BellowsError
from bellows_ros.files.bag_folder import digests
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


def test_a_missing_file_is_named(tmp_path):
    """Say which one."""
    with pytest.raises(BellowsError, match='nowhere'):
        digests(tmp_path / 'nowhere')
