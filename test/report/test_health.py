"""Timing of messages, and levels and words of the diagnostics."""

import math

from bellows_ros.core.live import load as loads
from bellows_ros.core.live.load import Load
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.report import health
from bellows_ros.report.health import InputReport, Level, quantiles
import numpy as np
from numpy.testing import assert_allclose
import pytest

MS = 1_000_000
REPORT = InputReport('/topic', 1, '', 500, 500.0, 1e-5, {'p50': 2e-3}, 3.0, {}, {'nan': 7})


def test_window_keeps_the_newest_and_begins_again():
    window = health.window()
    for value in range(health.WINDOW_LENGTH + 1000):
        window.append(float(value))
    p50, p99, largest = quantiles(health.taken(window)).values()
    assert largest == health.WINDOW_LENGTH + 999
    assert_allclose((p50, p99), 1000 + np.multiply((0.5, 0.99), health.WINDOW_LENGTH), rtol=1e-3)
    assert all(map(math.isnan, quantiles(health.taken(window)).values()))


def test_rate_jitter_and_age():
    arrivals, rng = health.Arrivals(), np.random.default_rng(1)
    times = np.cumsum(rng.normal(2 * MS, 0.2 * MS, 2000)).astype(int)
    for k, time in enumerate(times):
        arrivals.add(int(time), 1e-3 * k)
    messages, rate_hz, jitter, age = arrivals.reset()
    assert messages == 2000
    assert_allclose((rate_hz, jitter), (500.0, 0.2e-3), rtol=0.1)
    assert_allclose([*age.values()], (0.9995, 1.97901, 1.999))
    assert arrivals.reset()[0] == 0 and arrivals.last_ns == times[-1]


def of_input(optional=False, **changes):
    return health.input_status('x', REPORT._replace(**changes), optional)


def of_twists(messages, unpaired):
    return health.twist_status('x', REPORT._replace(messages=messages), 500, unpaired)


def of_vacuum(held, latched, **changes):
    return health.vacuum_status('x', REPORT._replace(**changes), held, latched)


def of_prediction(**changes):
    return health.prediction_status('x', **{
        'state': 'active', 'phase': 'predicting', 'cup': 'cup.*', 'compute': np.full(9, 1e-4),
        'counts': {}, 'restarts': {'gap': 0}, 'twist_verdict': 'fits', 'has_covariance': True,
        'above': False, **changes})


def of_load(factor, bending):
    safety = factor and loads.Safety(factor, 'peel')
    load = Load(resolve({'cup.lip_radius': 0.02, 'vacuum.holding': 6e4 if factor else 0.0}))
    return health.load_status('x', load, safety, None, bending)


@pytest.mark.parametrize(('status', 'level', 'words'), [
    (of_input(), Level.OK, '500 Hz'),
    (of_input(messages=0, mismatch='no link'), Level.ERROR, 'no link'),
    (of_input(refused={'nan': 3, 'jump': 0}), Level.WARN, '3 of 500'),
    (of_input(refused={'frame_id': 500}), Level.ERROR, '500 of 500'),
    (of_input(age={'p50': 5.0}), Level.WARN, '5 s behind'),
    (of_input(age={'p50': -2.0}), Level.WARN, '2 s ahead'),
    (of_input(True, messages=0, publishers=0), Level.OK, '/topic'),
    (of_input(True, messages=0), Level.WARN, '/topic'),
    (of_twists(500, 0), Level.OK, '500 Hz'), (of_twists(500, 240), Level.OK, '500 Hz'),
    (of_twists(500, 260), Level.WARN, '260 of 500'), (of_twists(100, 400), Level.OK, '500 Hz'),
    (of_vacuum(True, True, messages=0), Level.OK, 'Held'),
    (of_vacuum(True, False, messages=0), Level.WARN, '3.0 s'),
    (of_vacuum(False, False, messages=0), Level.ERROR, '3.0 s'),
    (of_vacuum(False, True, messages=0, silent=math.inf), Level.WARN, '/topic'),
    (of_vacuum(True, True, mismatch='durability'), Level.WARN, 'durability'),
    (of_prediction(state='inactive'), Level.OK, 'Inactive'),
    (of_prediction(phase='coasting'), Level.WARN, 'Coasting'),
    (of_prediction(restarts={'gap': 2}), Level.WARN, '2 x'),
    (of_prediction(restarts={'no_equilibrium': 1}), Level.ERROR, 'package.mass'),
    (of_prediction(twist_verdict='does_not_fit'), Level.WARN, 'tool_twist.frame'),
    (of_prediction(has_covariance=False), Level.WARN, 'package/odometry'),
    (of_load(None, 0.1), Level.OK, 'cup.lip_radius'), (of_load(2.0, 0.1), Level.OK, 'Within'),
    (of_load(1.234, 0.1), Level.WARN, '1.23 (peel), below safety.least, 1.5'),
    (of_load(0.8, 0.1), Level.ERROR, '0.80 (peel)'), (of_load(2.0, 0.7), Level.WARN, '40 degrees'),
])
def test_level_of_a_status(status, level, words):
    assert status.level == level
    assert words in status.message
