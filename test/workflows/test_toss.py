"""The valve from a recording of drops, the ellipse of a plan's toss, and an unknown valve."""

from pathlib import Path

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import NoTopicError
from bellows_ros.files.bags import as_messages, Encoded, write_bag
from bellows_ros.files.messages import BOOL, HEAD, POSE
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.toss import identify_release, toss_plan
import numpy as np
import pytest

from ..core import drops

BAGS = Path(__file__).parents[2] / 'bags'
VALUES = Values(read_parameters(BAGS / 'tossing.yaml'))

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='interpreted fits and draws take too long; see numba')


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Give a recording of four drops of a point without orientation, as of a laser."""
    bag = tmp_path_factory.mktemp('drops') / 'bag'
    rng, seconds = np.random.default_rng(4), np.arange(540) / 360.0
    law = (0.015, 0.0217, 19.0, 0.0204, 25.0, 2.42)
    z = 1.5 + np.concatenate([
        drops.simulated(1.8, 6500.0, 0.05, law, seconds, 1.0 + 5e-4 * rng.normal())
        for _ in range(4)])
    stamps_ns = 10**18 + np.round(1e9 * np.add.outer(2.0 * np.arange(4), seconds)).astype(
        np.int64).ravel()
    off_ns = 10**18 + 10**9 * np.arange(8, dtype=np.int64)
    poses = [np.column_stack([noise * rng.standard_normal((len(z), 2)), height, np.tile(
        [0.0, 0.0, 0.0, 1.0], (len(z), 1))]) for noise, height in (
            (2e-5, 1.5 + 2e-5 * rng.standard_normal(len(z))),
            (1e-4, z + 1e-4 * rng.standard_normal(len(z))))]
    write_bag(bag, [
        as_messages('/tool_arm/pose', POSE, stamps_ns, poses[0]),
        as_messages('/package/pose', POSE, stamps_ns, poses[1]),
        Encoded('/vacuum/valve', BOOL, off_ns, [HEAD + bytes([k % 2 == 0]) for k in range(8)])],
        'mcap', False, True)
    return VALUES.replaced({
        'bags': [str(bag)], 'cup.length': 0.05, 'package.com': (0.0, 0.0, 0.0),
        'vacuum.holding': 0.0,
        'cup.stiffness': tuple(np.diag([6500.0, 6500.0, 6500.0, 4.0, 4.0, 1.3]).ravel())})


def test_finds_the_valve_of_drops(recorded):
    found = identify_release(recorded)
    assert len(found.fit.drops) == 4 and found.fit.position < 3e-4
    assert found.fit.law[0] == pytest.approx(0.015, abs=4e-3)
    content = found.fit.parameters()
    assert content['release.mass_range'] == (1.8, 1.8)
    assert resolve(VALUES.replaced(content))
    with pytest.raises(NoTopicError, match='topics.valve'):
        identify_release(recorded.replaced({'topics.valve': '/another'}))


def test_a_valve_that_is_not_given_is_stated_and_drawn():
    """0 to 150 ms of delay: the landing spreads by their way at the speed of the release."""
    unknown = {name: value for name, value in VALUES.items() if not name.startswith('release.')}
    result = toss_plan(BAGS / 'throw.yaml', unknown, 2.95)
    assert [each.code for each in result.findings if each.code == 'assumed_delay']
    assert result.toss.release_time - 2.95 == pytest.approx(0.075, abs=0.02)
    assert result.groups()[0].name == 'release.delay'
    speed = np.linalg.norm(result.toss.release[2])
    assert np.ptp(result.scatter.errors[:, 0]) > 0.15 * 0.5 * speed
