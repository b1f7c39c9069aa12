"""Results of a fit as JSON: every digit comes back, and nothing that is not JSON goes in."""

from bellows_ros.errors import BellowsError
from bellows_ros.files.results import read_result, write_json
import numpy as np
from numpy.testing import assert_array_equal
import pytest

RNG = np.random.default_rng(0)
RESULT = {
    'method': 'least_squares', 'structure': 'axisymmetric',
    'stiffness': RNG.normal(size=(6, 6)) * 1e4, 'damping': RNG.normal(size=(6, 6)),
    'stiffness_std': RNG.normal(size=(6, 6)) ** 2, 'damping_std': np.full((6, 6), np.nan),
    'samples_used': np.int64(7051), 'samples_rejected': 99, 'condition_number': np.float64(np.inf),
    'more': {'bags': ('a', 'ü\u2028"'), 'refused': {'nan': [1, 2]},
             'ok': np.bool_(True), 'none': None}}


def changed(**values):
    """Return the result with some values changed; those that are None are left out."""
    return {k: v for k, v in {**RESULT, **values}.items() if v is not None}


def test_every_digit_comes_back(tmp_path):
    write_json(tmp_path / 'fit.json', RESULT)
    result = read_result(tmp_path / 'fit.json')
    assert list(result) == list(RESULT)
    for key in ('stiffness', 'damping', 'stiffness_std'):
        assert_array_equal(np.array(result[key]), RESULT[key])
    assert result['samples_used'] == 7051 and isinstance(result['samples_used'], int)
    assert result['more'] == {
        'bags': ['a', 'ü\u2028"'], 'refused': {'nan': [1, 2]}, 'ok': True, 'none': None}
    assert result['condition_number'] is None  # what is not known
    assert result['damping_std'] == [[None] * 6] * 6


@pytest.mark.parametrize('values, reason', [
    ({'more': {1: 2}}, 'key 1'), ({'more': object}, 'cannot hold type'),
    ({'more': 1j}, 'cannot hold complex'),
    ({'more': {'a': [{'b': {1, 2}}]}}, 'cannot hold set')])
def test_what_has_no_place_in_a_result_is_refused(tmp_path, values, reason):
    path = tmp_path / 'fit.json'
    path.write_text('old')
    with pytest.raises(BellowsError, match=reason):
        write_json(path, changed(**values))
    assert path.read_text() == 'old'


@pytest.mark.parametrize('data, reason', [
    (b'', 'not JSON'), (b'{', 'not JSON'), (b'\xff', 'not text in UTF-8'),
    (b'[1]', 'no stiffness'), (b'{}', 'no stiffness'),
    (b'{"method": NaN}', 'NaN is not allowed'),
    (b'{"method": -Infinity}', 'not JSON: -Infinity'), (b'[' * 200_000, 'nested too deeply'),
    (b'1' * 5000, 'not JSON')])
def test_what_is_no_result_is_refused(tmp_path, data, reason):
    (tmp_path / 'fit.json').write_bytes(data)
    with pytest.raises(BellowsError, match=reason):
        read_result(tmp_path / 'fit.json')
