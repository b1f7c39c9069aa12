"""Output is written whole or not at all."""

import json
import os
import re

from bellows_ros.errors import BellowsError
from bellows_ros.files.atomic import require_target, whole, write_bytes, write_text
from bellows_ros.files.results import write_json
import numpy as np
from numpy.testing import assert_array_equal
import pytest


def test_a_new_file_has_the_permissions_of_any_and_a_replaced_one_keeps_them(tmp_path):
    write_bytes(tmp_path / 'a', b'x')
    (tmp_path / 'b').write_bytes(b'x')
    assert (tmp_path / 'a').stat().st_mode == (tmp_path / 'b').stat().st_mode
    (tmp_path / 'a').chmod(0o640)
    (tmp_path / 'link').symlink_to('a')
    write_text(tmp_path / 'link', 'new')
    assert (tmp_path / 'link').is_symlink()
    assert (tmp_path / 'a').read_text() == 'new'
    assert (tmp_path / 'a').stat().st_mode & 0o777 == 0o640


def test_what_cannot_be_written_is_refused(tmp_path):
    for path in (tmp_path / 'none' / 'a', tmp_path, '/dev/null', 'a\0b', tmp_path / ('x' * 300)):
        named = f"Output '{path}".replace('\0', '\\x00')[:80]
        with pytest.raises(BellowsError, match=re.escape(named)):
            write_text(path, 'x')
    assert os.listdir(tmp_path) == []
    (tmp_path / 'file').write_text('x')
    with pytest.raises(BellowsError, match='no folder'):
        require_target(tmp_path / 'file', is_folder=True)


def test_a_folder_appears_when_it_is_complete(tmp_path):
    for content in ('x', 'y'):
        with whole(tmp_path / 'bag', is_folder=True) as folder:
            folder.mkdir()
            (folder / 'file').write_text(content)
            assert (tmp_path / 'bag').exists() == (content == 'y')
    for failure in (RuntimeError, BellowsError):
        with pytest.raises(failure), whole(tmp_path / 'bag', is_folder=True) as folder:
            if failure is RuntimeError:
                folder.mkdir()
                raise RuntimeError('half way')  # in the other case nobody makes the folder
    assert (tmp_path / 'bag' / 'file').read_text() == 'y'
    assert os.listdir(tmp_path) == ['bag']


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
