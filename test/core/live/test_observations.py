"""What is watched for the diagnostics: timing, load, vacuum, and the words and levels of it."""

from functools import partial
import math

from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import health
from bellows_ros.core.live import load as loads
from bellows_ros.core.live.health import InputReport, Level, quantiles
from bellows_ros.core.live.load import ALL, Load, Vacuum
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.cup_package import box_inertia, Cup, model_tuple, Package
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

MS = 1_000_000
PACKAGE = {
    'package.mass': 2.0, 'package.inertia': (0.01, 0.02, 0.025, 0.0, 0.0, 0.0),
    'package.com': (0.0, 0.0, -0.03)}
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


def test_pressure_switch_has_hysteresis():
    update = partial(
        Vacuum().update, resolve({'vacuum.attach_below': 60e3, 'vacuum.detach_above': 80e3}))
    held = [update(pressure, 'cup_7') for pressure in (
        101e3, 70e3, 59e3, 70e3, 79e3, 81e3, 70e3)]
    assert held == [((each, ALL),) for each in (False, False, True, True, True, False, False)]
    assert [update(p, '') for p in (math.nan, -70.0, 0.0)] == [
        'nan', 'negative', ((True, ALL),)]
    with pytest.raises(BellowsError):
        loads.check_live(Values({'vacuum.attach_below': 2.0, 'vacuum.detach_above': 1.0}))


def test_vacuum_of_each_cup():
    """Hold while one cup does, say which do not, and keep that when the package is lost."""
    vacuum = Vacuum()
    update = partial(
        vacuum.update, resolve({'cup.layout': [0.05, 0.0, 0.0, -0.05, 0.0, 0.0]}))
    assert update(50e3, 'cup_0') == ((True, 0), (True, ALL))
    assert update(40e3, 'left/cup_1') == ((True, 1), (True, ALL))
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (True, 50e3, ())
    assert update(90e3, 'cup_0') == ((False, 0), (True, ALL))
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (True, 40e3, (0,))
    assert update(90e3, 'cup_2') == 'no_such_cup'
    assert update(90e3, 'cup_1') == ((False, ALL),)
    assert (vacuum.held, vacuum.pressure, vacuum.open_cups) == (False, None, (0,))


def prediction(force=(0.0, 0.0, 20.0), moment=ZERO, tilt=0.0):
    """Return a package that hangs below the origin, tilted about x."""
    q = (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    return Prediction(1, (0.0, 0.0, -0.08), q, ZERO, ZERO, force, moment)


MODEL = model_tuple(Cup.thesis(), Package(2.0, np.diag([0.01, 0.02, 0.025]), (0, 0, -0.03)), 9.81)


def test_deflection_is_that_of_the_lip():
    shift, *_ = loads.deflection(MODEL, prediction())
    assert_allclose(shift, (0.0, 0.0, 0.0481 - 0.05), atol=1e-15)
    assert_allclose(loads.lip_position(MODEL, prediction()), (0.0, 0.0, -0.05), atol=1e-15)


def test_smallest_margin_and_largest_distance_are_kept():
    values = resolve({
        **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 6e4,
        'envelope.deflection_low': [-1e-3] * 6, 'envelope.deflection_high': [1e-3] * 6,
        'envelope.rates': [1.0] * 6, 'envelope.frequencies': [0.0, 9.0, 0.0, 9.0],
        'envelope.mass': [2.0, 2.0]})
    load = Load(values)
    assert load.grip and load.has_envelope
    for case in (prediction(), prediction((0.0, 0.0, 30.0)), prediction(moment=(0.0, 0.05, 0.0))):
        load.watch_force(MODEL, case)
    load.watch_deflection(MODEL, prediction(tilt=0.2))
    safety, away, bending = load.reset()
    assert_allclose(safety.factor, 6e4 * math.pi * 0.02**2 / 30.0)
    assert safety.mode == 'peel'
    assert away.value > 1.0 and 'bending about x' in away.text
    assert_allclose(bending, 0.2)
    assert load.reset() == (None, None, 0.0)
    unknown = Load(resolve(PACKAGE))
    unknown.watch_force(MODEL, prediction())
    assert not unknown.grip and not unknown.has_envelope and unknown.reset()[0] is None


def test_box_of_an_inertia_is_the_box():
    inertia = box_inertia(3.0, 0.2, 0.3, 0.1)
    values = Values({
        'package.mass': 3.0, 'package.inertia': (*np.diag(inertia), 0.0, 0.0, 0.0)})
    assert_allclose(loads.equivalent_box(values), (0.2, 0.3, 0.1))


def test_the_safety_factor_follows_the_measured_vacuum():
    values = resolve({**PACKAGE, 'cup.lip_radius': 0.02, 'cup.suction_area': 1e-3,
                      'cup.friction': 0.4, 'vacuum.holding': 6e4})
    load = Load(values)
    assert load.grip
    case = prediction(moment=(0.0, 0.1, 0.0))
    assert_allclose(load.watch_force(MODEL, case), (60 / (20 + 2 * 0.1 / 0.02), 60 / 20))
    assert load.reset()[0] == (2.0, 'peel')
    load.set_pressure(101325.0 - 3e4)
    assert_allclose(load.watch_force(MODEL, case), (1.0, 1.5))
    assert Load(values, load.pressure).watch_force(MODEL, case) == load.watch_force(MODEL, case)
    assert Load(values.replaced({'cup.lip_radius': 0.0})).grip is None


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
    (of_prediction(twist_verdict='other_axes'), Level.WARN, 'tool_twist.frame'),
    (of_prediction(has_covariance=False), Level.WARN, 'package/odometry'),
    (of_load(None, 0.1), Level.OK, 'cup.lip_radius'), (of_load(2.0, 0.1), Level.OK, 'Within'),
    (of_load(1.234, 0.1), Level.WARN, '1.23 (peel), below safety.least, 1.5'),
    (of_load(0.8, 0.1), Level.ERROR, '0.80 (peel)'), (of_load(2.0, 0.7), Level.WARN, '40 degrees'),
])
def test_level_of_a_status(status, level, words):
    assert status.level == level
    assert words in status.message
