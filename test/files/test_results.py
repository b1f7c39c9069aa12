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


def test_every_digit_survives_a_round_trip(tmp_path):
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


@pytest.mark.parametrize('more, named', [
    ({1: 2}, '1'), (object, 'type'), (1j, 'complex'), ({'a': [{'b': {1, 2}}]}, 'set')])
def test_what_has_no_place_in_a_result_is_refused(tmp_path, more, named):
    path = tmp_path / 'fit.json'
    path.write_text('old')
    with pytest.raises(BellowsError, match=rf'\b{named}\b'):
        write_json(path, {**RESULT, 'more': more})
    assert path.read_text() == 'old'


@pytest.mark.parametrize('data, named', [
    (b'', ''), (b'{', ''), (b'\xff', 'UTF-8'), (b'[1]', 'stiffness'), (b'{}', 'stiffness'),
    (b'{"method": NaN}', 'NaN'), (b'{"method": -Infinity}', '-Infinity'), (b'[' * 200_000, ''),
    (b'1' * 5000, '')], ids=range(9))
def test_what_is_no_result_is_refused(tmp_path, data, named):
    (tmp_path / 'fit.json').write_bytes(data)
    with pytest.raises(BellowsError, match=rf"fit\.json'.*{named}"):
        read_result(tmp_path / 'fit.json')
