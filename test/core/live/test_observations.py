"""What is watched for the diagnostics: timing, load, vacuum, and the words and levels of it."""

import math

from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import health, REFUSALS, RESTARTS
from bellows_ros.core.live.health import (
    Arrivals,
    InputSeen,
    KEPT,
    Level,
    Mismatch,
    PredictionSeen,
    Quantiles,
    Rhythm,
    Window,
)
from bellows_ros.core.live.load import (
    ALL,
    check_thresholds,
    deflection,
    equivalent_box,
    lip_position,
    Load,
    Safety,
    Vacuum,
)
from bellows_ros.core.live.samples import Prediction
from bellows_ros.core.model.cup_package import box_inertia, Cup, model_tuple, Package
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

MS = 1_000_000
PACKAGE = {
    'package.mass': 2.0, 'package.inertia': (0.01, 0.02, 0.025, 0.0, 0.0, 0.0),
    'package.com': (0.0, 0.0, -0.03)}
GOOD = Rhythm(500, 500.0, 1e-5, Quantiles(1e-3, 2e-3, 3e-3))
SILENT = Rhythm(0, math.nan, 0.0, Quantiles(math.nan, math.nan, math.nan))


def test_window_keeps_the_newest_and_begins_again():
    window = Window()
    for value in range(KEPT + 1000):
        window.add(float(value))
    p50, p99, largest = window.take()
    assert largest == KEPT + 999
    assert_allclose((p50, p99), (1000 + 0.5 * KEPT, 1000 + 0.99 * KEPT), rtol=1e-3)
    assert all(map(math.isnan, window.take()))


def test_rate_jitter_and_age():
    arrivals, rng = Arrivals(), np.random.default_rng(1)
    times = np.cumsum(rng.normal(2 * MS, 0.2 * MS, 2000)).astype(int)
    for k, time in enumerate(times):
        arrivals.add(int(time), 1e-3 * k)
    rhythm = arrivals.take()
    assert rhythm.messages == 2000
    assert_allclose(rhythm.rate_hz, 500.0, rtol=0.01)
    assert_allclose(rhythm.jitter, 0.2e-3, rtol=0.1)
    assert_allclose(rhythm.age, (0.9995, 1.97901, 1.999))
    assert arrivals.take().messages == 0 and arrivals.last_ns == times[-1]


def test_pressure_switch_has_hysteresis():
    vacuum = Vacuum(resolve({'vacuum.attach_below': 60e3, 'vacuum.detach_above': 80e3}))
    seen = [vacuum.update(pressure, 'cup_7') for pressure in (
        101e3, 70e3, 59e3, 70e3, 79e3, 81e3, 70e3)]
    assert seen == [((held, ALL),) for held in (False, False, True, True, True, False, False)]
    assert [vacuum.update(p, '') for p in (math.nan, -70.0, 0.0)] == [
        'nan', 'negative', ((True, ALL),)]
    with pytest.raises(BellowsError):
        check_thresholds({'vacuum.attach_below': 2.0, 'vacuum.detach_above': 1.0})


def test_vacuum_of_each_cup():
    """Hold while one cup does, say which do not, and keep that when the package is lost."""
    vacuum = Vacuum(resolve({'cup.layout': [0.05, 0.0, 0.0, -0.05, 0.0, 0.0]}))
    assert vacuum.update(50e3, 'cup_0') == ((True, 0), (True, ALL))
    assert vacuum.update(40e3, 'left/cup_1') == ((True, 1), (True, ALL))
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (True, 50e3, ())
    assert vacuum.update(90e3, 'cup_0') == ((False, 0), (True, ALL))
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (True, 40e3, (0,))
    assert vacuum.update(90e3, 'cup_2') == 'no_such_cup'
    assert vacuum.update(90e3, 'cup_1') == ((False, ALL),)
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (False, None, (0,))


def prediction(force=(0.0, 0.0, 20.0), moment=ZERO, tilt=0.0):
    """Return a package that hangs below the origin, tilted about x."""
    q = (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    return Prediction(1, (0.0, 0.0, -0.08), q, ZERO, ZERO, force, moment)


MODEL = model_tuple(Cup.thesis(), Package(2.0, np.diag([0.01, 0.02, 0.025]), (0, 0, -0.03)), 9.81)


def test_deflection_is_that_of_the_lip():
    lip = deflection(MODEL, prediction())
    assert_allclose(lip.shift, (0.0, 0.0, 0.0481 - 0.05), atol=1e-15)
    assert_allclose(lip_position(MODEL, prediction()), (0.0, 0.0, -0.05), atol=1e-15)


def test_smallest_margin_and_largest_distance_are_kept():
    values = resolve({
        **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 6e4,
        'envelope.deflection_low': [-1e-3] * 6, 'envelope.deflection_high': [1e-3] * 6,
        'envelope.rates': [1.0] * 6, 'envelope.frequencies': [0.0, 9.0, 0.0, 9.0],
        'envelope.mass': [2.0, 2.0]})
    load = Load(values)
    assert load.grip and load.envelope_known
    for case in (prediction(), prediction((0.0, 0.0, 30.0)), prediction(moment=(0.0, 0.05, 0.0))):
        load.watch_force(MODEL, case)
    load.watch_deflection(MODEL, prediction(tilt=0.2))
    safety, away, bending = load.take()
    assert_allclose(safety.factor, 6e4 * math.pi * 0.02**2 / 30.0)
    assert safety.mode == 'peel'
    assert away.value > 1.0 and 'bending about x' in away.text
    assert_allclose(bending, 0.2)
    assert load.take() == (None, None, 0.0)
    unknown = Load(resolve(PACKAGE))
    unknown.watch_force(MODEL, prediction())
    assert not unknown.grip and not unknown.envelope_known and unknown.take()[0] is None


def test_box_of_an_inertia_is_the_box():
    inertia = box_inertia(3.0, 0.2, 0.3, 0.1)
    values = {'package.mass': 3.0, 'package.inertia': (*np.diag(inertia), 0.0, 0.0, 0.0)}
    assert_allclose(equivalent_box(values), (0.2, 0.3, 0.1))


@pytest.mark.parametrize(('seen', 'level', 'words'), [
    ({}, Level.OK, '500 Hz.'),
    ({'rhythm': SILENT, 'mismatch': Mismatch('frames', 'no way')}, Level.ERROR,
     'No pose of the tool from /tool: no way. Check frames.world and frames.tool'),
    ({'refused': {'nan': 3, 'jump': 0}}, Level.WARN,
     '3 of 500 messages refused: 3 x nan (a number in it is not finite).'),
    ({'refused': {'frame_id': 500}}, Level.ERROR, '500 of 500'),
    ({'rhythm': GOOD._replace(age=Quantiles(*3 * [5.0]))}, Level.WARN, '5 s behind the clock'),
    ({'rhythm': GOOD._replace(age=Quantiles(*3 * [-2.0]))}, Level.WARN, '2 s ahead of the clock'),
])
def test_words_on_an_input(seen, level, words):
    base = InputSeen('/tool', 1, None, GOOD, 3.0, {}, {'nan': 7})
    status = health.input_status('predictor: tool pose', base._replace(**seen))
    assert status.level == level
    assert words in status.message
    assert status.values['refused: nan'] == '7'


def test_an_optional_input_may_be_absent():
    absent = InputSeen('/twist', 0, None, SILENT, math.inf, {}, {})
    assert health.input_status('x', absent, optional=True).level == Level.OK
    assert health.input_status('x', absent._replace(publishers=1), True).level == Level.WARN


@pytest.mark.parametrize(('messages', 'alone', 'level'), [
    (500, 0, Level.OK), (500, 240, Level.OK), (500, 260, Level.WARN), (100, 400, Level.OK)])
def test_twists_that_serve_no_pose_are_said(messages, alone, level):
    seen = InputSeen('/twist', 1, None, GOOD._replace(messages=messages), 0.0, {}, {})
    status = health.twist_status('x', seen, 500, alone)
    assert status.level == level
    assert (f'{alone} of 500 poses had no twist' in status.message) is (level == Level.WARN)


@pytest.mark.parametrize(('seen', 'held', 'latched', 'level', 'words'), [
    ({'rhythm': SILENT}, True, True, Level.OK, 'Held.'),
    ({'rhythm': SILENT}, True, False, Level.WARN, 'silent for 3.0 s: the package counts as held'),
    ({'rhythm': SILENT}, False, False, Level.ERROR, 'the package counts as not held'),
    ({'rhythm': SILENT, 'silent': math.inf}, False, True, Level.WARN, 'No message on /vacuum'),
    ({'mismatch': Mismatch('qos', 'durability')}, True, True, Level.WARN, 'durability'),
])
def test_words_on_the_vacuum(seen, held, latched, level, words):
    base = InputSeen('/vacuum', 1, None, GOOD, 3.0, {}, {})
    status = health.vacuum_status('x', base._replace(**seen), held, latched)
    assert status.level == level
    assert words in status.message


@pytest.mark.parametrize(('seen', 'level', 'words'), [
    ({'state': 'inactive'}, Level.OK, 'Inactive: nothing is published.'),
    ({'phase': 'coasting'}, Level.WARN, 'Coasting'),
    ({'restarts': {'gap': 2}}, Level.WARN, 'equilibrium: 2 x no usable pose arrived for more'),
    ({'restarts': {'no_equilibrium': 1}}, Level.ERROR, 'cannot hold'),
    ({'twist_verdict': 'other_axes'}, Level.WARN, 'tool_twist.frame'),
    ({'covariance_known': False}, Level.WARN, 'package/odometry is unknown'),
])
def test_words_on_the_prediction(seen, level, words):
    base = PredictionSeen(
        'active', 'predicting', 'cup.*', Quantiles(1e-4, 2e-4, 3e-4), {}, {'gap': 0}, 'fits')
    status = health.prediction_status('x', base._replace(**seen))
    assert status.level == level
    assert words in status.message
    assert status.values['compute time p99 (us)'] == '200'


def test_the_safety_factor_follows_the_measured_vacuum():
    values = resolve({**PACKAGE, 'cup.lip_radius': 0.02, 'cup.suction_area': 1e-3,
                      'cup.friction': 0.4, 'vacuum.holding': 6e4})
    load = Load(values)
    assert load.grip
    case = prediction(moment=(0.0, 0.1, 0.0))
    assert_allclose(load.watch_force(MODEL, case), (60 / (20 + 2 * 0.1 / 0.02), 60 / 20))
    assert load.take()[0] == (2.0, 'peel')
    load.set_pressure(101325.0 - 3e4)
    assert_allclose(load.watch_force(MODEL, case), (1.0, 1.5))
    assert Load(values, load.pressure).watch_force(MODEL, case) == load.watch_force(MODEL, case)
    assert Load({**values, 'cup.lip_radius': 0.0}).grip is None


@pytest.mark.parametrize(('factor', 'bending', 'level', 'words'), [
    (None, 0.1, Level.OK, 'The limits of the cup are unknown'), (2.0, 0.1, Level.OK, 'Within'),
    (1.234, 0.1, Level.WARN, '1.23 (peel), below safety.least, 1.5'),
    (0.8, 0.1, Level.ERROR, '0.80 (peel), below 1: the cup lets go'),
    (2.0, 0.7, Level.WARN, 'bends by 0.7 rad'),
])
def test_words_on_the_load(factor, bending, level, words):
    safety = factor and Safety(factor, 'peel')
    status = health.load_status('x', safety, None, bending, factor is not None, False, 1.5)
    assert status.level == level
    assert words in status.message
    assert status.values['distance from envelope'] == 'not known'
    detached = health.load_status('x', None, None, 0.0, True, False, 1.5)
    assert detached.message == 'No load: no package is held.'


def test_every_count_has_words():
    assert {*health.REASONS, 'no_equilibrium', 'failure'} == {*REFUSALS, *RESTARTS}
