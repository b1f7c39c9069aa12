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


class Cell:
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


@pytest.mark.parametrize('with_camera', [True, False])
@pytest.mark.parametrize('speed', [0.0, -0.2])
def test_vacuum_that_ends_with_the_valve_on_is_a_loss_at_any_speed(with_camera, speed):
    cell = Cell(with_camera)
    cell.pick(with_valve=True)
    cell.go(1.6)
    assert cell.live.is_ok
    cell.go(0.2, speed)
    cell.vacuum(False)
    assert (cell.live.state, cell.causes, cell.live.is_ok) == ('lost', ['lost'], False)
    cell.go(6.0)
    assert cell.live.alarm.kind == 'lost'  # until the next package
    cell.valve(False)
    cell.pick(with_valve=True)
    assert cell.live.alarm is None


@pytest.mark.parametrize('with_camera', [True, False])
def test_a_valve_that_opens_is_a_release(with_camera):
    cell = Cell(with_camera)
    cell.pick(with_valve=True)
    cell.valve(False)
    assert cell.live.state == 'released'
    count = len(cell.predictions)
    cell.go(0.1)
    cell.vacuum(False)
    cell.go(0.1, 0.2)
    assert (cell.live.state, cell.causes, len(cell.predictions)) == ('released', [], count)
    cell.pick(with_valve=True)


@pytest.mark.parametrize('falls', [True, False])
def test_without_a_valve_the_camera_decides_at_rest(falls):
    """Keep the package until the camera has had time to see a fall of 0.1 s."""
    cell = Cell(with_camera=True)
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


def test_without_valve_and_camera_the_motion_decides():
    for speed, state in ((-0.1, 'lost'), (0.0, 'released')):
        cell = Cell()
        cell.pick()
        cell.go(0.5)
        cell.go(0.1, speed)
        cell.vacuum(False)
        assert (cell.live.state, cell.causes) == (state, ['lost'] * (state == 'lost'))


def test_a_lost_package_without_any_signal_is_found_again():
    cell = Cell(with_camera=True, **{'vacuum.signal': 'none'})
    assert cell.live.state == 'held'
    cell.go(2.0)
    cell.dropped_ns = cell.now_ns
    cell.go(0.4)
    assert (cell.live.state, cell.causes) == ('lost', ['lost'])
    cell.dropped_ns = None
    cell.go(1.0)
    assert cell.live.state in ('gripped', 'held')


def test_short_loss_of_vacuum_has_no_effect():
    cycle = Cycle(True)
    cycle.on_vacuum(True, 1, False, 0)
    cycle.on_vacuum(False, 2, False, 100)
    cycle.on_vacuum(True, 50, False, 100)
    assert cycle.state == 'held' and not cycle.is_due(200)


def test_parameters_change_while_the_package_moves_on():
    cell = Cell()
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
