"""What is watched for the diagnostics: timing, load, vacuum, and the words and levels of it."""

import math

from bellows_ros.core.live.load import deflection, equivalent_box, lip_position, Load
from bellows_ros.core.live.samples import ORIGIN, Prediction
from bellows_ros.core.live.timing import Arrivals, KEPT, Window
from bellows_ros.core.live.vacuum import check_thresholds, is_held, why_no_pressure
from bellows_ros.core.model.cup_package import box_inertia, Cup, model_tuple, Package
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import with_chosen_cup
import numpy as np
from numpy.testing import assert_allclose
import pytest

MS = 1_000_000
ZERO = (0.0, 0.0, 0.0)
PACKAGE = {
    'package.mass': 2.0, 'package.inertia': (0.01, 0.02, 0.025, 0.0, 0.0, 0.0),
    'package.com': (0.0, 0.0, -0.03)}


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
    values, held, seen = {'vacuum.attach_below': 60e3, 'vacuum.detach_above': 80e3}, False, []
    for pressure in (101e3, 70e3, 59e3, 70e3, 79e3, 81e3, 70e3):
        held = is_held(pressure, held, values)
        seen.append(held)
    assert seen == [False, False, True, True, True, False, False]
    assert [why_no_pressure(p) for p in (math.nan, -70.0, 0.0)] == ['nan', 'negative', '']
    with pytest.raises(BellowsError):
        check_thresholds({'vacuum.attach_below': 2.0, 'vacuum.detach_above': 1.0})


def prediction(force=(0.0, 0.0, 20.0), moment=ZERO, tilt=0.0):
    """Return a package that hangs below the origin, tilted about x."""
    q = (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    return Prediction(1, (0.0, 0.0, -0.08), q, ZERO, ZERO, force, moment, ORIGIN)


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
        load.watch_force(case)
    load.watch_deflection(MODEL, prediction(tilt=0.2))
    safety, away, bending = load.take()
    assert_allclose(safety.factor, 6e4 * math.pi * 0.02**2 / 30.0)
    assert safety.mode == 'peel'
    assert away.value > 1.0 and 'bending about x' in away.text
    assert_allclose(bending, 0.2)
    assert load.take() == (None, None, 0.0)
    unknown = Load(resolve(PACKAGE))
    unknown.watch_force(prediction())
    assert not unknown.grip and not unknown.envelope_known and unknown.take()[0] is None


def test_box_of_an_inertia_is_the_box():
    inertia = box_inertia(3.0, 0.2, 0.3, 0.1)
    values = {'package.mass': 3.0, 'package.inertia': (*np.diag(inertia), 0.0, 0.0, 0.0)}
    assert_allclose(equivalent_box(values), (0.2, 0.3, 0.1))


def test_the_safety_factor_follows_the_vacuum_that_is_heard():
    values = resolve({**PACKAGE, 'cup.lip_radius': 0.02, 'cup.suction_area': 1e-3,
                      'cup.friction': 0.4, 'vacuum.holding': 6e4})
    load = Load(values)
    assert load.grip
    case = prediction(moment=(0.0, 0.1, 0.0))
    assert_allclose(load.watch_force(case), (60 / (20 + 2 * 0.1 / 0.02), 60 / 20))
    assert load.take()[0] == (2.0, 'peel')
    load.hear(101325.0 - 3e4)
    assert_allclose(load.watch_force(case), (1.0, 1.5))
    assert Load(values, load.pressure).watch_force(case) == load.watch_force(case)
    assert Load({**values, 'cup.lip_radius': 0.0}).grip is None


def test_cup_is_chosen_by_name():
    soft = tuple(np.eye(6).ravel())
    values = resolve({
        **PACKAGE, 'cups.soft.stiffness': soft, 'cups.soft.length': 0.03, 'cup.name': 'soft'})
    chosen = with_chosen_cup(values)
    assert chosen['cup.stiffness'] == soft and chosen['cup.length'] == 0.03
    assert chosen['cup.damping'] == values['cup.damping']
    assert with_chosen_cup({**values, 'cup.name': ''}) == {**values, 'cup.name': ''}
    with pytest.raises(BellowsError, match="'soft'"):
        with_chosen_cup({**values, 'cup.name': 'sofd'})
    with pytest.raises(BellowsError, match=r'cups\.soft\.stiffness'):
        resolve({**PACKAGE, 'cups.soft.stiffness': [0.0] * 36})
