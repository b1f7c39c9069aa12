"""A start from doubtful data waits, or says so by its state and by its covariance."""

import math

from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.checks import resolve
import numpy as np
import pytest

from ..cases import MS, PLATE, START, UPRIGHT

STATED = resolve({
    'tool_noise': (1e-4, 5e-4), 'package.mass': PLATE.mass})
NOISE = 1e-4
SOON_NS = 60 * MS
"""Within so long of a clean stream, or a few poses, it predicts again."""


class Cell:
    """A predictor, its covariance, and a clock."""

    def __init__(self, period_ns):
        self.live = LivePredictor(Cup.thesis(), PLATE, 9.81)
        self.live.package.observer.use_values(STATED)
        self.live.package.set_model(Cup.thesis(), PLATE)
        self.period_ns, self.stamp = period_ns, START

    def send(self, position, twist=None):
        """Send a pose and maybe a twist; return the newest prediction, phase and covariance."""
        self.stamp += self.period_ns
        out = self.live.on_pose(self.stamp, 'world', position, UPRIGHT, self.stamp)
        if twist is not None:
            out += self.live.on_twist(self.stamp, *twist, 'world')
        phase = self.live.phase(self.stamp)
        return [(p, phase, self.live.covariance(p.stamp_ns)) for p in out[-1:]]

    def stands_still(self, position, twist=None, seconds=4.0):
        """Send a clean stream of a tool at rest, and judge every prediction of it."""
        rest = LivePredictor(Cup.thesis(), PLATE, 9.81).on_pose(
            START, 'world', position, UPRIGHT)[0].position
        begin, first = self.stamp, None
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            for p, phase, covariance in self.send(position, twist):
                first = first or p.stamp_ns
                error = np.subtract(p.position, rest)
                size, std = np.linalg.norm(error), math.sqrt(np.trace(covariance[:3, :3]))
                assert size < 2e-3 or phase == 'settling', (size, p.stamp_ns - begin)
                assert size < max(2e-3, 4.0 * std), (size, std, p.stamp_ns - begin)
        assert first - begin <= max(SOON_NS, 6 * self.period_ns)
        assert phase == 'predicting' and size < 1e-3


@pytest.mark.parametrize(('period_ns', 'speed', 'rate', 'kind'), [
    (2 * MS, 5.0, 0.0, 'random'), (2_777_778, 11.0, 0.0, 'constant'),
    (8 * MS, 0.0, 30.0, 'random'), (10 * MS, 0.5, 0.0, 'constant'),
    (20 * MS, 7.0, 20.0, 'random')])
def test_after_false_twists(period_ns, speed, rate, kind):
    rng = np.random.default_rng(period_ns)
    cell = Cell(period_ns)
    cell.live.expect_twists(True)
    for _ in range(max(20, round(1e9 / period_ns))):
        draw = rng.standard_normal((2, 3)) if kind == 'random' else np.eye(2, 3)
        linear, angular = (draw * [[speed], [rate]]).tolist()
        cell.send(ZERO, (tuple(linear), tuple(angular)))
    cell.stands_still(ZERO, (ZERO, ZERO))


def test_a_package_is_never_further_from_its_tool_than_a_cup_reaches():
    """Whatever has been sent: 15 cm are more than this cup, its length and its sag allow."""
    rng = np.random.default_rng(7)
    live, stamp = LivePredictor(Cup.thesis(), PLATE, 9.81), START
    live.expect_twists(True)
    farthest = 0.0
    for _ in range(3000):
        stamp += int(rng.integers(1, 450)) * MS
        o = tuple((1.5 * rng.standard_normal(3)).tolist())
        out = live.on_pose(stamp, 'world', o, UPRIGHT, stamp)
        out += live.on_twist(stamp, o, tuple((10.0 * rng.standard_normal(3)).tolist()))
        for p in out:
            lip = np.subtract(p.position, np.subtract(p.tool[0], (0.0, 0.0, 0.0481 + 0.03)))
            farthest = max(farthest, np.linalg.norm(lip))
    assert live.restarts['diverged'] > 0
    assert 0.05 < farthest < 0.16 + 2 * 0.03  # the centre of mass turns about the lip
