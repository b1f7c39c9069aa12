"""Levels and words of the diagnostics."""

import math

from bellows_ros.core.live.vacuum import Load
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.report import health
from bellows_ros.report.health import fact, InputReport, Level, quantiles
import numpy as np
from numpy.testing import assert_allclose
import pytest

REPORT = InputReport('/topic', 1, None, 500, np.full(499, 2e-3), np.full(500, 2e-3), 3.0, {},
                     {'nan': 7})


def test_window_keeps_the_newest_and_begins_again():
    window = health.window()
    for value in range(health.WINDOW_LENGTH + 1000):
        window.append(float(value))
    p50, p99, largest = map(float, quantiles('{}', health.taken(window)).values())
    assert largest == health.WINDOW_LENGTH + 999
    assert_allclose((p50, p99), 1000 + np.multiply((0.5, 0.99), health.WINDOW_LENGTH), rtol=1e-3)
    assert set(quantiles('{}', health.taken(window)).values()) == {'none'}


def of_input(worst=Level.ERROR, **changes):
    return health.input_status('x', REPORT._replace(**changes), worst)


def of_twists(messages, unpaired, **changes):
    return health.twist_status('x', REPORT._replace(messages=messages, **changes), 500, unpaired)


def of_vacuum(held, latched, **changes):
    return health.vacuum_status('x', REPORT._replace(**changes), held, (), latched)


def of_prediction(**changes):
    return health.Status('x', health.prediction_finding(**{
        'phase': 'predicting', 'restarts': {'gap': 0}, 'twists_fit': True,
        'has_covariance': True, 'above': False, **changes}), {})


def of_load(factor, bending):
    load = Load(resolve({'cup.lip_radius': 0.02, 'vacuum.holding': 6e4 if factor else 0.0}))
    load.reset = lambda: (factor and (factor, 'peel'), None, bending)
    return health.load_status('x', load)


NO_LINK = fact('publishers', topic='/topic', names='a, b')


@pytest.mark.parametrize(('status', 'level', 'words'), [
    (of_input(), Level.OK, '500 Hz'),
    (of_input(messages=0, mismatch=NO_LINK), Level.ERROR, 'several publishers'),
    (of_input(refused={'nan': 3, 'jump': 0}), Level.WARN, '3 of 500'),
    (of_input(refused={'frame_id': 500}), Level.ERROR, '500 of 500'),
    (of_input(ages=np.full(3, 5.0)), Level.WARN, '5 s behind'),
    (of_input(ages=np.full(3, -2.0)), Level.WARN, '2 s ahead'),
    (of_input(messages=0, silent=math.inf), Level.ERROR, 'No message on /topic so far'),
    (of_twists(0, 0, publishers=0), Level.OK, '/topic'),
    (of_twists(0, 0), Level.WARN, '/topic'),
    (of_twists(500, 0), Level.OK, '500 Hz'), (of_twists(500, 240), Level.OK, '500 Hz'),
    (of_twists(500, 260), Level.WARN, '260 of 500'), (of_twists(100, 400), Level.OK, '500 Hz'),
    (of_vacuum(True, True, messages=0), Level.OK, 'Held'),
    (of_vacuum(True, False, messages=0), Level.WARN, '3.0 s'),
    (of_vacuum(False, False, messages=0), Level.ERROR, '3.0 s'),
    (of_vacuum(False, True, messages=0, silent=math.inf), Level.ERROR, '/topic'),
    (of_vacuum(False, True, messages=1, refused={'not_absolute': 1}), Level.ERROR, 'absolute'),
    (of_vacuum(True, True, mismatch=NO_LINK), Level.WARN, 'several publishers'),
    (of_prediction(phase='coasting'), Level.WARN, 'Coasting'),
    (of_prediction(restarts={'gap': 2}), Level.WARN, '2 x'),
    (of_prediction(restarts={'no_equilibrium': 1}), Level.ERROR, 'package.mass'),
    (of_prediction(twists_fit=False), Level.WARN, 'tool_twist.frame'),
    (of_prediction(has_covariance=False), Level.WARN, 'no covariance'),
    (of_prediction(above=True), Level.ERROR, 'tool_pose.offset'),
    (of_load(None, 0.1), Level.OK, 'cup.lip_radius'), (of_load(2.0, 0.1), Level.OK, 'Within'),
    (of_load(1.234, 0.1), Level.WARN, '1.23 (peel).'),
    (of_load(0.8, 0.1), Level.ERROR, '0.8 (peel)'), (of_load(2.0, 0.7), Level.WARN, '40 degrees'),
])
def test_level_of_a_status(status, level, words):
    assert status.level == level
    assert words in status.message
