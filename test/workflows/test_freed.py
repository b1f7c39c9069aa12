"""What `fit.free` names is found with the cup, and takes the place of what was given."""

import json

from bellows_ros.errors import BellowsError
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identify import identify, resolved
import numpy as np
import pytest


@pytest.fixture(scope='module')
def settings(root, known):
    """Return the parameters of a short recording."""
    return {**known, 'bags': [str(root / 'bags/validation')]}


def test_a_wrong_length_and_centre_are_found_and_used(settings):
    """Start 2 mm off, where K would be several times too large, with all else as it is."""
    result = identify({
        **settings, 'fit.free': ['length'], 'cup.length': 0.048, 'recording.end': 8.0,
        'package.com_std': (1e-5,) * 3, 'recording.marker_std': (0.0, 0.0)})
    content = json.loads(format_json(result.as_json()))['found_parameters']['cup.length']
    value, std = content['value'], content['std']
    assert abs(value - 0.046) < 4.0 * std < 4e-4 and content['units']['std'] == 'm'
    assert result.parameters()['cup.length'] == result.cup_length == value
    error = result.fit.stiffness[2, 2] - 9200.0
    assert abs(error) < 4.0 * result.fit.stiffness_std[2, 2] < 0.05 * 9200.0
    assert any(line.startswith('cup.length was estimated') for line in result.findings)
    assert result.refusals == () and np.all(result.verdict.simulated[0].rms[:3] < 3e-4)


def test_a_marker_stays_where_the_fit_has_it_with_a_longer_cup(settings):
    """Its place and the length of the cup hang together."""
    (simulated,) = identify({**settings, 'fit.free': ['length', 'package_marker'],
                             'recording.end': 8.0}).verdict.simulated
    assert np.all(simulated.rms < 1.1 * simulated.noise)


@pytest.mark.parametrize(('change', 'named'), [
    ({'fit.free': ['com'], 'fit.method': 'least_squares'}, 'com.* fit.method: output_error'),
    ({'fit.free': ['mass'], 'package.files': ['a', 'b']}, 'mass.* package.files'),
    ({'fit.free': ['length'], 'static.length': True, 'static.bags': ['a']},
     'length.* static.length'),
    ({'fit.free': ['weight']}, "time_offset, clock_rate, com,.* 'weight'"),
    ({'fit.free': ['mass', 'inertia']}, 'mass, inertia'),
])
def test_what_cannot_be_free_is_refused(settings, change, named):
    with pytest.raises(BellowsError, match=f'fit.free.*{named}'):
        identify({**settings, 'recording.end': 4.0, **change})


def test_clocks_and_worlds_are_the_parameters_that_there_are(settings):
    values = resolved({**settings, 'fit.free': ['time_offset', 'package_world'],
                       'fit.method': 'least_squares'})
    assert values['fit.time_offset'] and values['recording.package_world'] == 'estimate'
