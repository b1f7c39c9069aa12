"""Pressures in other units and of other references: named, and never taken for a held package."""

import math

from bellows_ros import LivePredictor
import pytest

from .test_cycle import MS, START, UPRIGHT, VALUES

OPEN, HELD = 101_325.0, 41_325.0  # Pa

UNITS = {
    'in_kpa': lambda p: p / 1e3, 'in_bar': lambda p: p / 1e5, 'in_mbar': lambda p: p / 1e2,
    'gauge': lambda p: p - OPEN - 1.0, 'not_absolute': lambda p: OPEN - p}
"""Readings of drivers by absolute pressure, Pa; the last is a positive vacuum."""


@pytest.mark.parametrize('unit', UNITS)
@pytest.mark.parametrize('first', [OPEN, HELD])
def test_another_unit_is_named_at_an_open_cup_and_never_held_again(unit, first):
    live = LivePredictor.from_parameters({**VALUES, 'vacuum.signal': 'pressure'})
    states, reasons = [], []
    for k in range(900):
        live.on_pose(START + k * 2 * MS, 'world', (0.0, 0.0, 0.5), UPRIGHT)
        if k % 10 == 0:
            pressure = first if k < 300 else OPEN if k < 600 else HELD
            reasons.append(live.on_pressure(UNITS[unit](pressure), ''))
        states.append((live.state, live.is_ok))
    assert not any(is_ok or state in ('gripped', 'held') for state, is_ok in states[350:])
    assert set(reasons[35:]) == {'not_absolute'}


def test_single_glitches_lose_no_package():
    live = LivePredictor.from_parameters({**VALUES, 'vacuum.signal': 'pressure'})
    live.on_pose(START, 'world', (0.0, 0.0, 0.5), UPRIGHT)
    assert [live.on_pressure(p, '') for p in (OPEN, HELD, 0.0, HELD, -1.0, 0.0, HELD)] == [
        '', '', 'not_absolute', '', 'not_absolute', 'not_absolute', '']
    assert live.state == 'gripped'


def test_each_cup_holds_by_its_own_vacuum():
    layout = [0.06, 0.0, 0.0, -0.06, 0.0, 0.0, 0.0, 0.06, 0.0]
    live = LivePredictor.from_parameters({
        **VALUES, 'vacuum.signal': 'pressure', 'cup.layout': layout, 'cup.lip_radius': 0.02})
    for cup, pressure in enumerate((41_325.0, 56_325.0)):
        assert not live.on_pressure(pressure, f'gripper/cup_{cup}')
    weakest, *_, cups = live.load.grip
    assert weakest == pytest.approx(4.5e4 * math.pi * 4e-4)
    assert cups[:, 4].tolist() == pytest.approx([4 / 3, 1.0, 1.0])  # the last has no sensor


@pytest.mark.parametrize('speed', [4.0, 0.01, 0.0])
def test_poses_in_millimetres_are_named_at_once_and_never_ok(speed):
    live = LivePredictor.from_parameters({**VALUES, 'vacuum.signal': 'none'})
    oks = []
    for k in range(3000):
        x = 450.0 + 100.0 * math.sin(speed * k * 2e-3)
        live.on_pose(START + k * 2 * MS, 'world', (x, -100.0, 600.0), UPRIGHT)
        oks.append(live.is_ok)
    assert live.refused['millimetres'] == 3000 and not any(oks)


def test_measured_poses_in_millimetres_are_reported_and_ignored():
    live, twin = (LivePredictor.from_parameters({**VALUES, 'vacuum.signal': 'none'})
                  for _ in range(2))
    for k in range(500):
        stamp, still = START + k * 2 * MS, (0.45, -0.1, 0.6)
        (found,) = live.on_pose(stamp, 'world', still, UPRIGHT)
        (expected,) = twin.on_pose(stamp, 'world', still, UPRIGHT)
        assert found.position == expected.position
        live.on_measured(
            stamp, 'world', tuple(1e3 * x + 0.1 * (k % 7) for x in found.position), UPRIGHT)
    counts = live.package.observer.counts
    assert counts['millimetres'] == 500 and not live.alarms
