"""Limits of motions as a file gives them."""

from bellows_ros.core.planning.limits import demands, NO_LIMIT, RATES
from bellows_ros.core.planning.points import timed
from bellows_ros.core.planning.steering import steer
from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.steer import read_limits, steer_plan
import numpy as np
import pytest


@pytest.mark.parametrize(('content', 'named'), [
    ({'linear': {'speed': 0.0}}, r"'linear.speed'.* 0 \(m/s\)"),
    ({'workspace': {'lower': [0, 0, 0], 'upper': [1, -1, 1]}}, r'\bworkspace.lower')])
def test_bad_limits_are_refused(content, named):
    with pytest.raises(BellowsError, match=named):
        read_limits(content)
    assert read_limits({}).rates == dict.fromkeys(RATES, NO_LIMIT)
    assert np.all(read_limits(None).high == NO_LIMIT)


def test_one_file_serves_excite_too(root):
    """Read the file that explains every limit, and leave the rest of it alone."""
    limits = read_limits(safe_yaml.load(root / 'config/limits_example.yaml'))
    assert limits.rates['speed'] == 1.5 and limits.rates['angular_jerk'] == 2000.0
    assert limits.high.tolist() == [1.3, 0.5, 1.2] and limits.safety_factor == 1.5


@pytest.mark.parametrize('plan', ['transport', 'throw'])
def test_the_sample_plans_are_steered_within_the_sample_limits(root, plan):
    """As a user tries both files first; the time is the shortest, to a percent."""
    file = root / 'config/limits_example.yaml'
    found = steer_plan(root / f'bags/{plan}.yaml', read_parameters(root / 'bags/tossing.yaml'),
                       'zvd', file)
    limits = read_limits(safe_yaml.load(file))
    assert found.limit == 'speed'
    asked = demands(found.steered.tool)
    assert all(asked[name] <= limits.rates[name] * (1.0 + 1e-6) for name in RATES)
    quicker = steer(found.source.model, timed(found.source.tool, 0.99 * found.time_scale), 'zvd')
    assert demands(quicker.tool)['speed'] > limits.rates['speed']


def test_zvd_is_blamed_only_where_it_was_asked_for(root):
    """Say of zv what it leaves, and nothing of zvd."""
    found = steer_plan(root / 'bags/transport.yaml', read_parameters(root / 'bags/tossing.yaml'),
                       'zv')
    said = ' '.join(found.notes)
    assert 'zv shapes 1 mode and leaves' in said and 'zvd' not in said
