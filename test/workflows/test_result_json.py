"""Every number of a result has its unit beside it, whatever the method."""

import json

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identify import identify
import pytest

PLAIN = ('settings', 'provenance', 'numbers')
"""Blocks whose units are those of the parameters, and what has none."""


def without_unit(content, path=''):
    """Yield the paths of numbers, other than counts, whose unit is not beside them."""
    units = content.get('units', {})
    for key, value in content.items():
        here = f'{path}.{key}'
        if key in (*PLAIN, 'units') or key in units or key.endswith(('_hz', '_s', '_ns')):
            continue
        if key == 'value' and 'unit' in content or key == 'std' and 'unit' in content:
            continue
        yield from numbers(value, here)


def numbers(value, path):
    """Yield the paths of numbers in a value that has no unit of its own."""
    if isinstance(value, dict):
        yield from without_unit(value, path)
    elif isinstance(value, list):
        for item in value:
            yield from numbers(item, f'{path}[]')
    elif isinstance(value, float):
        yield path


@pytest.fixture(scope='module')
def settings(root, known):
    """Return all that can be asked of recordings."""
    bags = root / 'bags'
    return {
        **known, 'bags': [str(bags / 'identification')],
        'static.bags': [str(bags / 'static')], 'validation.bags': [str(bags / 'validation')],
        'fit.free': ['time_offset'], 'recording.end': 8.0}


@pytest.mark.parametrize(('method', 'unit'), [
    ('least_squares', ['N'] * 3 + ['N m'] * 3),
    pytest.param('output_error', ['m'] * 3 + ['rad'] * 3, marks=pytest.mark.skipif(
        not COMPILED, reason='numba is not installed: the fit takes minutes'))])
def test_every_number_has_its_unit(settings, method, unit):
    short = {'bags': settings['validation.bags'], 'validation.bags': [], 'fit.free': [],
             'recording.end': 4.0}
    asked = {**settings, 'fit.method': method, **(
        {} if method == 'least_squares' else short)}
    content = json.loads(format_json(identify(asked).as_json()))
    assert sorted(set(without_unit(content))) == []
    assert content['units']['residual_rms'] == unit
    assert content['units']['stiffness'][0] == ['N/m'] * 3 + ['N'] * 3
