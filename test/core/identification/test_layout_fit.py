"""One cup's numbers from the motion of a gripper of three."""

import functools

from bellows_ros.core.identification.fitting import output_error
from bellows_ros.core.identification.least_squares import least_squares, samples_of, statistics
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.model.cup_package import Cup, gripper_of
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.parameters.conversion import given_structure
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import BodyNoise, PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import GRAVITY, PLATE
from ...cell.motion import Shake
from ...cell.sensors import noisy

ONE = Cup(np.diag([900.0, 900.0, 1500.0, 1.2, 1.2, 0.5]),
          np.diag([12.0, 12.0, 9.0, 0.02, 0.02, 0.02]), 0.0481)
PLACES = np.array([[0.06, 0.05, 0.0], [-0.06, 0.03, 0.0], [0.01, -0.07, 0.0]])
LAYOUT = given_structure(Values({
    'fit.structure': 'layout', 'cup.layout': tuple(PLACES.ravel())}))
NUMBERS = LAYOUT.parameters(ONE.stiffness, ONE.damping)
HZ, DURATION = 500.0, 8.0


@functools.cache
def truth():
    """Return poses of tool and package, of the cups' sum: that of `core/model/test_layout`."""
    tool = Shake(3).trajectory(DURATION, HZ)
    package = simulate(gripper_of(ONE, PLACES), PLATE, tool, gravity=GRAVITY)
    return [Trajectory(body.stamps_ns, body.position, body.rotation) for body in (
        own.select(slice(int(0.5 * HZ), None)) for own in (tool, package))]


def by_output_error(package_noise):
    """Return the fit to a robot's poses and a camera's of 62.5 Hz, from a start far off."""
    rng, tool_noise = np.random.default_rng(1), (2e-5, 5e-5)
    tool, package = (noisy(rng, body, noise) for body, noise in zip(
        truth(), (tool_noise, package_noise), strict=True))
    return output_error(
        [Segment(tool, package.select(slice(0, None, 8)), PLATE, GRAVITY,
                 *(BodyNoise(np.repeat(std, 3)) for std in (tool_noise, package_noise)))],
        LAYOUT, Cup(2.0 * ONE.stiffness, 0.6 * ONE.damping, ONE.length))


def test_one_cup_is_found_by_output_error_with_honest_errors():
    fit = by_output_error((1e-4, 5e-4))
    std = np.sqrt(np.diag(fit.covariance))
    assert fit.converged and not fit.notes
    assert np.all(np.abs(fit.parameters - NUMBERS) < 4.0 * std)
    assert np.all(std < np.array([0.01, 0.005, 0.02, 0.1, 0.02, 0.1, 0.1, 0.1]) * NUMBERS)
    assert fit.labels == STRUCTURES['axisymmetric'].labels
    assert_allclose(fit.stiffness, np.diag(np.diag(fit.stiffness)))  # that of one cup


def test_what_the_other_cups_hide_is_named():
    fit = by_output_error((2e-3, 1e-2))
    std = np.sqrt(np.diag(fit.covariance))
    known = dict(zip(fit.labels, np.isfinite(std), strict=True))
    assert known['K x'] and known['K z'] and known['K rx'] and known['P x']
    assert not known['K rz'] and not known['P rz']
    assert all(any(note.numbers.get('label') == label and 'one cup alone' in note.numbers['how']
                   for note in fit.notes) for label in ('K rz', 'P rz'))
    seen = np.isfinite(std)
    assert np.all(np.abs(fit.parameters - NUMBERS)[seen] < 4.0 * std[seen])


@pytest.mark.parametrize(('noise', 'within'), [(0.0, 1e-5), (1.0, 0.1)])
def test_one_cup_is_found_by_least_squares(noise, within):
    rng = np.random.default_rng(2)
    streams = [PoseStream(name, 'world', body.stamps_ns, body.position, body.rotation)
               for name, body in zip(('tool', 'package'), (
                   noisy(rng, own, (2e-5 * noise, 1e-4 * noise)) for own in truth()), strict=True)]
    recording = prepare(*streams, PrepareSettings(
        payload=PLATE, gravity=GRAVITY, tool_half_window=12, package_half_window=12))
    fit = least_squares([statistics(samples_of(recording), ONE.length, LAYOUT)])
    assert_allclose(fit.parameters, NUMBERS, rtol=within)


@pytest.mark.parametrize('layout', [(0.0, 0.0, 0.0), (0.05, 0.0), (0.05, 0.0, 0.0) * 2])
def test_a_layout_of_one_cup_or_none_is_refused(layout):
    with pytest.raises(BellowsError, match=r'cup\.layout'):
        given_structure(Values({'fit.structure': 'layout', 'cup.layout': layout}))
