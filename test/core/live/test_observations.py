"""Load of the cup and vacuum, as the diagnostics report them."""

from functools import partial
import math

from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import vacuum
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.live.vacuum import ALL, Load, Vacuum
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
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


def test_pressure_switch_has_hysteresis():
    update = partial(
        Vacuum().update, resolve({'vacuum.thresholds': (60e3, 80e3)}))
    held = [update(pressure, 'cup_7') for pressure in (
        101e3, 70e3, 59e3, 70e3, 79e3, 81e3, 70e3)]
    assert held == [((each, ALL),) for each in (False, False, True, True, True, False, False)]
    assert update(math.nan, '') == 'nan'
    with pytest.raises(BellowsError):
        vacuum.check_live(Values({'vacuum.thresholds': (2.0, 1.0)}))


def prediction(force=(0.0, 0.0, 20.0), moment=ZERO, tilt=0.0):
    """Return a package that hangs below the origin, tilted about x."""
    q = (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    return Prediction(1, (0.0, 0.0, -0.08), q, ZERO, ZERO, force, moment)


MODEL = model_tuple(Cup.thesis(), Package(2.0, np.diag([0.01, 0.02, 0.025]), (0, 0, -0.03)), 9.81)


def test_deflection_is_that_of_the_lip():
    shift, *_ = vacuum.deflection(MODEL, prediction())
    assert_allclose(shift, (0.0, 0.0, 0.0481 - 0.05), atol=1e-15)
    assert_allclose(vacuum.lip_position(MODEL, prediction()), (0.0, 0.0, -0.05), atol=1e-15)


def test_smallest_margin_and_largest_distance_are_kept():
    values = resolve({
        **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 6e4,
        'cup.valid_low': [-1e-3] * 6 + [-1.0] * 6 + [2.0, 0.0],
        'cup.valid_high': [1e-3] * 6 + [1.0] * 6 + [2.0, 0.0]})
    load = Load(values)
    assert load.grip and load.has_envelope
    for case in (prediction(), prediction((0.0, 0.0, 30.0)), prediction(moment=(0.0, 0.05, 0.0))):
        load.watch_force(MODEL, case)
    load.watch_deflection(MODEL, prediction(tilt=0.2))
    safety, away, bending = load.reset()
    assert_allclose(safety[0], 6e4 * math.pi * 0.02**2 / 30.0)
    assert safety[1] == 'peel'
    assert away.value > 1.0 and 'bending about x' in away.outside[0]
    assert_allclose(bending, 0.2)
    assert load.reset() == (None, None, 0.0)
    unknown = Load(resolve(PACKAGE))
    unknown.watch_force(MODEL, prediction())
    assert not unknown.grip and not unknown.has_envelope and unknown.reset()[0] is None


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
