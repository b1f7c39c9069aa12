"""Arms on walls and ceilings: recordings of worlds in which gravity has any direction."""

from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_identify import CLEAN

MARKERS = {'noise': {'position': 1e-5, 'rotation': 1e-5}}
MOTION = {
    'kind': 'multi_sine', 'duration': 6.0, 'rest_duration': 1.5, 'ramp_duration': 0.5,
    'multi_sine': {
        'position': {
            'x': {'amplitude': [0.03], 'frequency': [1.3]},
            'y': {'amplitude': [0.03], 'frequency': [1.7]},
            'z': {'amplitude': [0.01], 'frequency': [4.1]},
        },
        'rotation': {'z': {'amplitude': [0.4], 'frequency': [0.9]}},
    },
    'tool': {'rate_hz': 200.0, 'marker': {'rotation': [0.3, -0.2, 1.5]}, **MARKERS},
    'package': {'rate_hz': 200.0, 'marker': {'rotation': [0.2, 0.1, -0.4]}, **MARKERS},
}


@pytest.fixture(scope='module')
def fitted(tmp_path_factory):
    """Give a function that simulates, identifies and replays a recording of one world."""
    def run(direction, world='z_up'):
        bag = tmp_path_factory.mktemp('world') / 'bag'
        values = {**CLEAN, 'topics.tool_twist': '', 'gravity.direction': direction}
        simulate_recording(values, {**MOTION, 'world': world}, bag)
        settings = {
            **values, 'bags': [str(bag)], 'recording.world': world,
            'recording.align_at_rest': True, 'recording.rest_duration': 1.2}
        result = identify(settings)
        return result.fit, replay(bag, {**settings, **result.parameters()})

    return run


@pytest.fixture(scope='module')
def level(fitted):
    """Give the fit and the replay where z is up."""
    return fitted([0.0, 0.0, -1.0])


@pytest.mark.parametrize(('direction', 'world'), [
    ([1.0, 0.0, 0.0], 'z_up'), ([-1.0, 2.0, 1.0], 'motive_y_up')])
def test_a_fit_and_a_replay_are_the_same_in_any_world(direction, world, level, fitted):
    fit, played = fitted(direction, world)
    there, played_there = level
    # Noise is drawn in recorded axes, and so is not the same.
    assert_allclose(np.diag(fit.stiffness), np.diag(there.stiffness), rtol=5e-3)
    assert_allclose(played.live.scores.rms, played_there.live.scores.rms, rtol=0.3, atol=1e-6)
    assert np.all(played.validation.scores.rms[:3] < 1e-4)
