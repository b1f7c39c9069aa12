"""What was given is uncertain, and its uncertainty reaches K and P."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.fitting import output_error
from bellows_ros.core.identification.unknowns import given_std, MARKERS, PACKAGE_STD
from bellows_ros.core.model.cup_package import varied
from bellows_ros.core.model.simulation import row_state, simulate, tool_rows
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.savgol import correlated
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_output_error import (
    AXISYMMETRIC,
    CAMERA,
    CAPTURE,
    measured,
    NUMBERS,
    scaled,
    TRUTH,
)
from ...cell.cup import GRAVITY, PLATE
from ...cell.motion import Shake
from ...cell.sensors import with_errors

QUIET = {'package_noise': (1e-4, 5e-4), 'package_hz': 60.0}
CAPTURED = {'tool_noise': CAPTURE, 'package_noise': CAPTURE, 'package_hz': 100.0}
SAID = resolve({'package.mass': PLATE.mass, 'package.com': PLATE.com.tolist(),
                'package.inertia': [*np.diag(PLATE.inertia).tolist(), 0.0, 0.0, 0.0]})
USUAL = given_std(SAID)


def off(fit):
    """Return the errors (8,) of a fit in standard errors: from the recording, and with both."""
    error, own = fit.parameters - NUMBERS, np.diag(fit.covariance)
    return error / np.sqrt(own), error / np.sqrt(own + np.diag(fit.from_given))


@pytest.mark.stress
def test_recordings_may_share_the_errors_of_a_marker():
    turned, parts = exp_so3(np.array([6e-3, -4e-3, 0.0])), []
    for number, seed in enumerate((7, 8)):
        own = measured(seed, tool_hz=100.0, duration=5.0, **QUIET)
        body = replace(own.package, rotation=own.package.rotation @ turned)
        parts.append(replace(own, package=body, recording=number))
    each, shared = (output_error(parts, AXISYMMETRIC, TRUTH, given=USUAL, common=common)
                    for common in ((), MARKERS))
    assert [len(fit.nuisances['package_marker']) for fit in (each, shared)] == [2, 1]
    assert np.abs(off(shared)[1]).max() < 4.0
    spread = np.ptp(each.nuisances['package_marker'][:, 3:], axis=0)
    assert_allclose(each.nuisances['package_marker'][:, 3:].mean(axis=0),
                    shared.nuisances['package_marker'][0, 3:], atol=spread.max() + 1e-3)


def test_couplings_of_a_frame_that_is_off_are_within_their_errors():
    own, full = measured(8, tool_hz=125.0, duration=8.0, **QUIET), STRUCTURES['full']
    body = own.package
    wrong = replace(own, package=replace(body, position=body.position + body.rotation @ [
        2e-4, -1e-4, 0.0]))
    found = output_error([wrong], full, TRUTH, given=USUAL)
    true = full.parameters(TRUTH.stiffness, TRUTH.damping)
    std = np.sqrt(np.diag(found.covariance + found.from_given))
    known = np.isfinite(std)
    assert known[:21].all()
    assert np.abs((found.parameters - true) / std)[known].max() < 4.5


def test_a_com_that_is_off_is_found_with_k():
    """Where K along z was 88 % off beside the com."""
    factor = 2.5
    own = measured(13, (2e-4, 1e-3), (2e-4, 1e-3), 100.0, 100.0, 8.0, cup=scaled(factor))
    wrong = replace(own, payload=varied(PLATE, com=np.array([0.0, 0.0, 5.5e-3])))
    found = output_error([wrong], AXISYMMETRIC, TRUTH, given=USUAL)
    assert found.converged
    std, off = np.sqrt(np.diag(found.covariance + found.from_given))[:4], np.abs(
        found.parameters / (factor * NUMBERS) - 1.0)[:4]
    assert np.all(off * factor * NUMBERS[:4] < 4.0 * std)
    assert np.all(off < 0.1)  # though z, which hardly moves, is not claimed without its damping


def test_a_lip_that_is_lower_than_it_seems_is_no_soft_cup():
    """K along z would be a tenth, held from swinging by damping that no rubber has."""
    own = measured(5, tool_hz=100.0)
    short = replace(TRUTH, length=TRUTH.length - 6e-3)
    (wrong, *_) = output_error([own], AXISYMMETRIC, short, given=USUAL).causes
    assert wrong.name == 'length' and wrong.instead == 'com'
    assert np.all(np.abs(wrong.theta - 6e-3) < 4.0 * wrong.std)


@pytest.mark.stress
@pytest.mark.parametrize(('memory', 'sensor'), [(0.0, {}), (0.1, {}), (0.0, CAPTURED)])
def test_a_package_that_slips_is_named(memory, sensor):
    """
    Where the noise of slow poses is learned, so that a fit leaves no more than that.

    And where that noise has a memory (s), and a centre of mass in between explains a part.
    """
    own, kept = measured(4, tool_hz=100.0, **sensor), np.exp(-1.0 / (30.0 * max(memory, 1e-9)))
    truth, rng = Shake(4).trajectory(12.1, 500.0), np.random.default_rng(5)
    half, slipped = len(truth) // 2, varied(PLATE, com=np.array([6e-3, -4e-3, 0.0]))
    first = simulate(TRUTH, PLATE, truth.select(slice(half + 1)), gravity=GRAVITY)
    start = row_state(tool_rows(first.select(slice(half, None)))[0])
    second = simulate(TRUTH, slipped, truth.select(slice(half, None)), start, GRAVITY)
    body = Trajectory(*(np.concatenate([getattr(first, name)[:half], getattr(second, name)])
                        for name in ('stamps_ns', 'position', 'rotation', 'twist')))
    noise = correlated(rng.standard_normal((len(own.package), 6)), kept)
    seen = with_errors(resample(body, own.package.stamps_ns), noise * own.package_noise.std)
    (slip, *_), sound = (output_error([each], AXISYMMETRIC, TRUTH, given=USUAL).causes
                         for each in (replace(own, package=seen), own))
    assert slip.name == 'slip' and slip.certain
    largest = 4.0 * np.sqrt((1.0 + kept) / (1.0 - kept)) * slip.std
    assert np.all(np.abs(slip.theta - [6e-3, -4e-3, half / 500.0]) < largest)
    assert not sound


@pytest.mark.parametrize('sensor', [{}, pytest.param(CAPTURED, marks=pytest.mark.stress)])
def test_a_world_that_is_not_level_is_named(sensor):
    """Of both bodies, so that gravity is not along its z; a constant force would look alike."""
    own = measured(3, tool_hz=100.0, **sensor)
    tilt = exp_so3(np.array([0.0, 0.12, 0.0]))
    tilted = replace(own, **{name: replace(body, position=body.position @ tilt.T, rotation=(
        tilt @ body.rotation)) for name, body in (('tool', own.tool), ('package', own.package))})
    causes = output_error([tilted], AXISYMMETRIC, TRUTH, given=USUAL).causes
    gravity, = (each for each in causes if each.name == 'gravity.direction')
    assert gravity.instead == 'force'
    assert not any(each.certain for each in causes if each is not gravity)
    assert np.all(np.abs(gravity.theta - [0.0, -0.12]) < 4.0 * gravity.std)


@pytest.mark.stress
@pytest.mark.parametrize('seed', [1, 2])
def test_a_centre_of_stiffness_on_the_axis_is_no_length_and_com_that_are_wrong(seed):
    """12 mm below the tip, which a length and a centre of mass 23 mm off would explain, too."""
    shift = np.eye(6)
    shift[[0, 1], [4, 3]] = 0.012, -0.012
    coupled = replace(TRUTH, stiffness=shift.T @ TRUTH.stiffness @ shift,
                      damping=shift.T @ TRUTH.damping @ shift)
    own = measured(seed, tool_hz=100.0, duration=8.0, cup=coupled, **CAPTURED)
    found = output_error([own], AXISYMMETRIC, TRUTH, given=USUAL).causes
    assert found and not any(finding.certain for finding in found)


@pytest.mark.parametrize(('seed', 'has_tails'), [(5, False), (27, True)])
def test_what_was_given_a_little_off_is_no_slip_and_no_turned_marker(seed, has_tails):
    """And is found with K and P where a camera knows it better, with heavy tails of its noise."""
    own = measured(seed, tool_hz=100.0, silent=has_tails)
    tails = np.random.default_rng(seed).standard_t(3, (len(own.package), 6)) / np.sqrt(3.0)
    seen = with_errors(own.package, has_tails * tails * np.repeat(CAMERA, 3))
    aside = replace(own, package=seen, payload=varied(PLATE, com=np.array([1e-3, -8e-4, 5e-4])))
    longer = replace(TRUTH, length=TRUTH.length + 1.5e-3)
    found = output_error(
        [aside], AXISYMMETRIC, longer, given={**USUAL, 'com': np.full(3, 1e-3)})
    assert not found.causes
    known = found.parameters[1] / NUMBERS[1]
    assert abs(known - 1.0) < 0.2 and np.abs(off(found)[1]).max() < 4.0


def test_k_has_at_least_the_relative_error_of_the_mass():
    own = measured(9, **QUIET)
    heavy = replace(own, payload=varied(PLATE, mass=0.02, inertia=0.02))
    found = output_error([heavy], AXISYMMETRIC, TRUTH, given={
        name: USUAL[name] for name in ('mass', 'inertia')})
    alone, both = off(found)
    assert_allclose(found.parameters / NUMBERS, np.exp(0.02), rtol=0.05)
    assert np.abs(alone).max() > 6.0 and np.abs(both).max() < 4.0


def test_a_mass_that_is_far_off_is_within_the_errors_that_its_stated_deviation_gives():
    """A mass 10 % off that is stated to 10 %: the inertia, stated to 5 %, says most of it."""
    heavy = replace(measured(9, **QUIET), payload=varied(PLATE, mass=0.1))
    found = output_error([heavy], AXISYMMETRIC, TRUTH, given={**USUAL, 'mass': np.array([0.1])})
    share = np.sqrt(np.diag(found.from_given)) / NUMBERS
    assert 0.02 < share[2] < 0.05 and np.abs(off(found)[1]).max() < 3.0


def test_what_is_not_known_with_what_was_given_is_no_number():
    """Say how exact all entries would be of a package that may be off by a factor."""
    vague = {**USUAL, 'mass': np.array([2.0]), 'inertia': np.full(3, 2.0)}
    found = output_error(
        [measured(9, tool_hz=125.0, **QUIET)], AXISYMMETRIC, TRUTH, given=vague)
    assert np.isinf(found.stiffness_std[np.diag_indices(6)]).all()
    told = [each.numbers for each in found.notes if each.code == 'not_identifiable']
    assert len(told) == 8 and all('package.com_std' in numbers['given'] for numbers in told)


def test_a_given_quantity_and_its_estimate_are_weighted_by_their_precisions():
    """Of a mass that the recording knows from the inertia, which is exact."""
    own, given = measured(10, tool_hz=125.0), 3e-3
    alone, both = (output_error([own], AXISYMMETRIC, TRUTH, given={'mass': np.array([std])})
                   for std in (0.7, given))
    estimate, std = (float(each['mass'][0, 0]) for each in (alone.nuisances, alone.nuisances_std))
    share = given**2 / (given**2 + std**2)
    assert 0.1 < share < 0.9
    assert_allclose(both.nuisances['mass'][0, 0], share * estimate, atol=0.05 * std)
    assert_allclose(both.nuisances_std['mass'][0, 0], np.sqrt(share) * std, rtol=0.1)


def test_what_is_stated_wins_over_the_ordinary():
    vague = given_std(
        SAID.replaced({'package.com_std': (1e-3, 0.0, -1.0), 'cup.length_std': 0.0}))
    assert_allclose(vague['com'], [1e-3, 1e-9, PACKAGE_STD['com']])
    assert 'com' not in given_std(SAID.replaced({'package.com_std': (0.0,) * 3}))
    assert 'length' not in vague
    assert_allclose(vague['mass'], PACKAGE_STD['mass'])
    assert 'package_world' not in USUAL
    assert 'package_world' in given_std(
        SAID.replaced({'recording.package_world': '0 0 0 0 0 0 1'}))


def test_half_a_package_is_ignored():
    """Know no standard deviation of a package whose inertia is not given."""
    half = Values({name: value for name, value in SAID.items() if name != 'package.inertia'})
    assert not {'mass', 'com', 'inertia'} & set(given_std(half))
