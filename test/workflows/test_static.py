"""Static recordings of a known cup: its length and its spring, from bags on disk."""


from bellows_ros.core.model.cup_package import Cup
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.static import save_length, static_check, StaticResult
import pytest

from ..core.identification import simulated


@pytest.fixture(scope='module')
def truth(true_cup):
    """Return the parameters of the cup that recordings are simulated with."""
    return {**true_cup, 'topics.tool_pose': '/tool_arm/pose',
            'topics.package_pose': '/package/pose'}


@pytest.fixture(scope='module')
def picked(weights):
    """Return static recordings, each with the mass of its package."""
    return [(bag, {'package.mass': mass}) for bag, mass in weights.items()]


def without_cup(truth):
    """Return what a user knows: all but the cup."""
    return {name: value for name, value in truth.items() if not name.startswith('cup.')}


def test_the_spring_is_checked_with_the_length_that_was_found(picked, truth):
    given = {name: value for name, value in truth.items() if name != 'cup.length'}
    result = static_check(picked, given)
    assert result.passed
    assert result.cup_length == result.length.length


def test_a_wrong_length_is_warned_about(picked, truth):
    result = static_check(picked, {**truth, 'cup.length': 0.044})
    assert not result.passed
    assert any('cup.length is 44.00 mm' in warning for warning in result.warnings)


def test_poses_of_the_shipped_recording(root, truth):
    result = static_check([(str(root / 'bags/static'), {})], truth)
    assert result.passed and len(result.spring) == 7
    assert result.length is None and 'two or more different masses' in result.no_length
    softer = [0.8 * k for k in truth['cup.stiffness']]
    wrong = static_check([(str(root / 'bags/static'), {})], {
        **truth, 'cup.stiffness': softer})
    assert not wrong.passed


def test_a_list_with_centres_needs_no_package(picked, truth):
    centre = tuple(truth['package.com'])
    bags = [(bag, {**own, 'package.com': centre}) for bag, own in picked]
    bare = {k: v for k, v in without_cup(truth).items() if not k.startswith('package.')}
    with_package = static_check(picked, without_cup(truth))
    assert static_check(bags, bare).length.length == with_package.length.length


def test_mistakes_are_named(picked, truth, root):
    with pytest.raises(BellowsError):
        static_check([], without_cup(truth))
    with pytest.raises(BellowsError, match='package.mass'):
        static_check([(picked[0][0], {})], {
            name: value for name, value in without_cup(truth).items() if name != 'package.mass'})
    with pytest.raises(BellowsError, match=r'recording\.pack'):
        static_check(picked[:1], {**without_cup(truth), 'recording.package_world': 'estimate'})
    with pytest.raises(BellowsError, match=r'cup\.stiffness'):
        static_check(picked[:1], without_cup(truth))
    moving = static_check([(str(root / 'bags/static'), {})], truth)
    with pytest.raises(BellowsError):
        save_length(moving, 'nowhere.yaml')


def test_creep_of_rubber_is_reported():
    """And nothing where nothing creeps."""
    cup = Cup(simulated.CUP.stiffness, simulated.CUP.damping, simulated.CUP.length, (0.1, 0.25))
    tilts = simulated.standstills([(0.3, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.3, 0.0)], hold=4.0)
    noise = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}
    found = StaticResult((simulated.record(tilts, cup, **noise),), None, '', cup.length)
    assert 'The rubber creeps in' in found.creep and 'static stiffness' in found.creep
    still = StaticResult((simulated.record(tilts, **noise),), None, '', cup.length)
    assert not still.creep
