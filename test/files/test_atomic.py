"""Output is written whole or not at all."""

import json
import os
import re

from bellows_ros.errors import BellowsError
from bellows_ros.files.atomic import new_folder, require_file_target, write_bytes, write_text
from bellows_ros.files.results import write_json
import numpy as np
from numpy.testing import assert_array_equal
import pytest


def test_new_files_get_the_permissions_of_any_new_file(tmp_path):
    write_bytes(tmp_path / 'a', b'x')
    (tmp_path / 'b').write_bytes(b'x')
    assert (tmp_path / 'a').stat().st_mode == (tmp_path / 'b').stat().st_mode


@pytest.mark.parametrize('mode', [0o600, 0o640, 0o666, 0o755])
def test_a_replaced_file_keeps_its_permissions(tmp_path, mode):
    path = tmp_path / 'a'
    path.write_text('old')
    path.chmod(mode)
    write_text(path, 'new')
    assert path.read_text() == 'new'
    assert path.stat().st_mode & 0o777 == mode


def test_a_link_stays_and_its_file_is_replaced(tmp_path):
    (tmp_path / 'real').write_text('old')
    (tmp_path / 'link').symlink_to('real')
    write_text(tmp_path / 'link', 'new')
    assert (tmp_path / 'link').is_symlink()
    assert (tmp_path / 'real').read_text() == 'new'


def test_what_cannot_be_written_is_refused(tmp_path):
    for path in (tmp_path / 'none' / 'a', tmp_path, '/dev/null', 'a\0b', tmp_path / ('x' * 300)):
        named = f"Output '{path}".replace('\0', '\\x00')[:80]
        with pytest.raises(BellowsError, match=re.escape(named)):
            write_text(path, 'x')
    with pytest.raises(BellowsError):
        require_file_target(tmp_path / 'none' / 'a')
    assert os.listdir(tmp_path) == []


def test_a_folder_appears_when_it_is_complete(tmp_path):
    with new_folder(tmp_path / 'bag') as folder:
        assert folder.name == 'bag'
        folder.mkdir()
        (folder / 'file').write_text('x')
        assert not (tmp_path / 'bag').exists()
    assert (tmp_path / 'bag' / 'file').read_text() == 'x'
    assert os.listdir(tmp_path) == ['bag']


def test_a_failed_folder_leaves_no_files(tmp_path):
    with pytest.raises(RuntimeError), new_folder(tmp_path / 'bag') as folder:
        folder.mkdir()
        raise RuntimeError('half way')
    with pytest.raises(BellowsError), new_folder(tmp_path / 'bag'):
        pass  # nobody makes the folder
    assert os.listdir(tmp_path) == []


def test_a_folder_that_exists_is_replaced_only_when_asked(tmp_path):
    path = tmp_path / 'bag'
    path.mkdir()
    (path / 'old').write_text('x')
    with pytest.raises(BellowsError, match=f"'{path}'"), new_folder(path):
        pass
    with pytest.raises(RuntimeError), new_folder(path, replace=True) as folder:
        folder.mkdir()
        raise RuntimeError
    assert os.listdir(path) == ['old']


def test_a_folder_replaces_neither_files_nor_links(tmp_path):
    (tmp_path / 'file').write_text('x')
    (tmp_path / 'real').mkdir()
    (tmp_path / 'link').symlink_to('real')
    for name in ('file', 'link', 'no/x'):
        with pytest.raises(BellowsError, match=name), new_folder(tmp_path / name, True):
            pass


RNG = np.random.default_rng(0)
RESULT = {
    'method': 'least_squares', 'structure': 'axisymmetric',
    'stiffness': RNG.normal(size=(6, 6)) * 1e4, 'damping': RNG.normal(size=(6, 6)),
    'stiffness_std': RNG.normal(size=(6, 6)) ** 2, 'damping_std': np.full((6, 6), np.nan),
    'samples_used': np.int64(7051), 'samples_rejected': 99, 'condition_number': np.float64(np.inf),
    'more': {'bags': ('a', 'ü\u2028"'), 'refused': {'nan': [1, 2]},
             'ok': np.bool_(True), 'none': None}}


def test_every_digit_survives_a_round_trip(tmp_path):
    write_json(tmp_path / 'fit.json', RESULT)
    result = json.loads((tmp_path / 'fit.json').read_text())
    assert list(result) == list(RESULT)
    for key in ('stiffness', 'damping', 'stiffness_std'):
        assert_array_equal(np.array(result[key]), RESULT[key])
    assert result['samples_used'] == 7051 and isinstance(result['samples_used'], int)
    assert result['more'] == {
        'bags': ['a', 'ü\u2028"'], 'refused': {'nan': [1, 2]}, 'ok': True, 'none': None}
    assert result['condition_number'] is None  # what is not known
    assert result['damping_std'] == [[None] * 6] * 6
