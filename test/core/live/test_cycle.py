"""States of a package in a cycle, by valve, vacuum, camera and the tool's motion together."""

from bellows_ros import LivePredictor
from bellows_ros.core.live.cycle import Cycle, FALL_NS, holds
from bellows_ros.errors import BellowsError
import numpy as np
import pytest

from ...cell.motion import MS, START, UPRIGHT

VALUES = {
    'package.mass': 1.8, 'package.inertia': [0.005, 0.008, 0.01, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03], 'cup.length': 0.046, 'vacuum.signal': 'bool',
    'cup.lip_radius': 0.02, 'vacuum.holding': 5e4}
PERIOD = 4 * MS


class SwitchedCell:
    """A tool that moves up and down, and may stand, with a predictor of its package."""

    def __init__(self, with_camera=False, **more):
        self.live = LivePredictor.from_parameters({**VALUES, **more})
        self.k, self.height, self.with_camera = 0, 0.5, with_camera
        self.rng, self.dropped_ns, self.predictions = np.random.default_rng(3), None, []

    @property
    def now_ns(self):
        return START + self.k * PERIOD

    def go(self, seconds, speed=0.0):
        """Move the tool vertically, and see the package, which falls once it is dropped."""
        for _ in range(round(seconds * 1e9 / PERIOD)):
            self.k += 1
            self.height += speed * PERIOD * 1e-9
            found = self.live.on_pose(
                self.now_ns, 'world', (0.3, 0.0, self.height), UPRIGHT, self.now_ns)
            self.predictions += found
            if self.with_camera and self.k % 8 == 0:
                fallen = 0.0 if self.dropped_ns is None else (
                    4.905 * (1e-9 * (self.now_ns - self.dropped_ns)) ** 2)
                at = np.array([0.3, 0.0, self.height - 0.078 - fallen])
                self.live.on_measured(
                    self.now_ns, 'world', at + 1e-3 * self.rng.normal(size=3), UPRIGHT)

    def vacuum(self, held):
        self.live.on_vacuum(held, self.now_ns)

    def valve(self, on):
        self.live.on_valve(on, self.now_ns)

    def pick(self, with_valve=False):
        self.go(0.1)
        self.vacuum(False)
        if with_valve:
            self.valve(True)
        self.go(0.1)
        assert self.live.state not in ('gripped', 'held')
        self.vacuum(True)
        assert self.live.state == 'gripped'
        self.go(0.4, 0.2)
        assert self.live.state == 'held' and not self.live.is_ok  # for half a second

    @property
    def causes(self):
        return [alarm.kind for alarm in self.live.alarms]


def test_a_loss_is_an_alarm_until_the_next_package():
    """Of vacuum that ends with the valve on, at rest and in sight of a camera."""
    cell = SwitchedCell(with_camera=True)
    cell.pick(with_valve=True)
    cell.go(1.6)
    assert cell.live.is_ok
    cell.vacuum(False)
    assert (cell.live.state, cell.causes, cell.live.is_ok) == ('lost', ['lost'], False)
    count = len(cell.predictions)
    cell.go(6.0)
    assert cell.live.alarm.kind == 'lost' and len(cell.predictions) == count
    cell.valve(False)
    cell.pick(with_valve=True)
    assert cell.live.alarm is None


STEPS = {
    'on': lambda cycle: cycle.on_valve(True), 'off': lambda cycle: cycle.on_valve(False),
    'grip': lambda cycle: cycle.on_vacuum(True, 1, False, 0),
    'lift': lambda cycle: [cycle.on_height(height) for height in (0.5, 0.6)],
    'open': lambda cycle: cycle.on_vacuum(False, 2, False, 0),
    'open in motion': lambda cycle: cycle.on_vacuum(False, 2, True, 0),
    'open in sight': lambda cycle: cycle.on_vacuum(False, 2, False, 100)}
"""Readings of valve, vacuum (with and without a camera) and height."""


@pytest.mark.parametrize(('steps', 'state'), [
    ('', 'none'), ('open', 'none'), ('grip', 'gripped'), ('grip, lift', 'held'),
    ('on, grip, lift, open', 'lost'), ('on, grip, lift, open in motion', 'lost'),
    ('on, grip, lift, off', 'released'), ('on, grip, lift, off, open in motion', 'released'),
    ('grip, lift, open', 'released'), ('grip, lift, open in motion', 'lost'),
    ('grip, open in sight', 'released'), ('grip, lift, open in sight', 'held'),
    ('grip, lift, open in sight, grip', 'held'), ('grip, lift, open, grip', 'gripped')])
def test_valve_vacuum_and_motion_decide(steps, state):
    cycle = Cycle(False)
    for step in filter(None, steps.split(', ')):
        STEPS[step](cycle)
    assert cycle.state == state
    assert cycle.is_due(200) is steps.endswith('lift, open in sight')


@pytest.mark.parametrize('falls', [True, False])
def test_without_a_valve_the_camera_decides_at_rest(falls):
    """Keep the package until the camera has had time to see a fall of 0.1 s."""
    cell = SwitchedCell(with_camera=True)
    cell.pick()
    cell.go(1.0)
    if falls:
        cell.dropped_ns = cell.now_ns
    cell.vacuum(False)
    cell.go(0.5 * FALL_NS * 1e-9)
    assert cell.live.state == 'held'
    cell.go(0.1)
    assert cell.live.state == ('lost' if falls else 'released')
    assert cell.causes == ['lost'] * falls
    cell.dropped_ns = None
    cell.pick()


def test_a_lost_package_without_any_signal_is_found_again():
    cell = SwitchedCell(with_camera=True, **{'vacuum.signal': 'none'})
    assert cell.live.state == 'held'
    cell.go(2.0)
    cell.dropped_ns = cell.now_ns
    cell.go(0.4)
    assert (cell.live.state, cell.causes) == ('lost', ['lost'])
    cell.dropped_ns = None
    cell.go(1.0)
    assert cell.live.state in ('gripped', 'held')


def test_parameters_change_while_the_package_moves_on():
    cell = SwitchedCell()
    cell.pick()
    before = cell.live.latest
    cell.live.set_parameters({'package.mass': 2.0})
    cell.go(PERIOD * 1e-9)
    assert cell.live.model[1][0] == cell.live.payload.mass == 2.0
    assert np.linalg.norm(np.subtract(before.position, cell.live.latest.position)) < 1e-3
    assert cell.live.covariance(cell.live.latest.stamp_ns).shape == (12, 12)
    assert cell.live.covariance(cell.now_ns + 1) is None
    with pytest.raises(BellowsError, match='read_parameters'):
        LivePredictor.from_parameters('cell.yaml')
    for wrong, word in (({'package.mass': -1.0}, 'package.mass'),
                        ({'vacuum.signal': 'none'}, 'another LivePredictor'),
                        ({'package.masss': 1.0}, 'package.mass')):
        with pytest.raises(BellowsError, match=word):
            cell.live.set_parameters(wrong)
        assert cell.live.values.package.mass == 2.0


@pytest.mark.parametrize(('until', 'release', 'last'), [
    (6.0, 0.5, 5.0), (6.0, 0.3, 5.0), (10.0, 0.5, 5.0), (3.0, 0.5, 3.0)])
def test_a_hold_is_free_of_contact(until, release, last):
    """It begins and ends 1 cm above the supports, or with the vacuum or the recording."""
    seconds = np.arange(0.0, 8.0, 0.01)
    heights = np.interp(
        seconds, [0.0, 1.0, 2.0, 4.0, 5.0, 5.02, 5.1], [0.5, 0.5, 0.6, 0.6, release + 0.01] + [
            release] * 2)
    stamps = np.rint(seconds * 1e9).astype(np.int64)
    signals = [(500_000_000, 'vacuum', True, -1), (round(until * 1e9), 'vacuum', False, -1)]
    (begun, ended), = holds(stamps, heights, signals)
    if until > seconds[-1]:
        last = seconds[-1]
    np.testing.assert_allclose([begun * 1e-9, ended * 1e-9], [1.1, last], atol=0.03)
