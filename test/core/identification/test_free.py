"""What is found together with K and P: its derivatives, and the truth where the given is wrong."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.identification.motion_equations import Segment
from bellows_ros.core.identification.prediction_error import prediction_error
from bellows_ros.core.identification.quantities import KINDS
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .recordings import PLATE, segments

TRUTH, AXISYMMETRIC = Cup.thesis(), STRUCTURES['axisymmetric']
NOISE = {'tool_noise': (2e-5, 1e-4), 'package_noise': (5e-5, 2e-4)}


@pytest.fixture(scope='module')
def recording():
    """Return a recording of which the lip's poses are known."""
    (own,) = segments(3, 10.0, rate_hz=200.0, margin=0.05, **NOISE)
    return replace(own, moves_with_com=(True, True, False))


@pytest.mark.parametrize('name', KINDS)
def test_columns_are_differences_of_the_errors(recording, name):
    """Compare with central differences, on the smoothed motion that both see."""
    (exact,) = segments(3, 4.0, rate_hz=200.0, margin=0.05, package_noise=(0.0, 0.0))
    kind, cup = KINDS[name], TRUTH
    if name == 'relaxation':  # whatever the internal strains are
        exact = replace(exact, history=np.zeros((len(exact.package), 2, 9)))
        cup = replace(cup, relaxation=(0.2, 0.1))
    segment = Segment(replace(exact, moves_with_com=(True, True, False)))
    noise = np.zeros((len(exact.package), 12))
    at = {name: np.zeros(kind.size)}
    columns = segment.equations(cup, noise, at).jacobian[:, :, 42:]
    assert columns.shape[2] == kind.size
    for i in range(kind.size):
        ends = [segment.equations(cup, noise, {name: side * 0.1 * kind.unit * np.eye(kind.size)[
            i]}).errors for side in (1.0, -1.0)]
        by_difference = (ends[0] - ends[1]) / (0.2 * kind.unit)
        size = np.abs(by_difference).max()
        inner = slice(40, -40)  # beside the ends the motion is smoothed less
        assert_allclose(
            -columns[inner, :, i], by_difference[inner], rtol=0, atol=0.02 * size, err_msg=str(i))


WRONG = {
    'com': lambda own: replace(own, payload=Package(
        PLATE.mass, PLATE.inertia, PLATE.com + [0.003, -0.002, 0.0])),
    'length': lambda own: own,
    'inertia': lambda own: replace(own, payload=Package(
        PLATE.mass, PLATE.inertia * np.outer(*2 * [np.sqrt([1.1, 0.95, 1.0])]), PLATE.com)),
    'mass': lambda own: replace(own, payload=Package(
        1.07 * PLATE.mass, PLATE.inertia, PLATE.com)),
}
TRUE = {
    'com': [-0.003, 0.002, 0.0], 'length': [0.001], 'inertia': -np.log([1.1, 0.95, 1.0]),
    'mass': [-np.log(1.07)],
}


@pytest.mark.parametrize('name', WRONG)
def test_what_was_given_wrong_is_found_with_k_and_p(recording, name):
    own = WRONG[name](replace(recording, moves_with_com=(False, False, False)))
    start = replace(TRUTH, length=TRUTH.length - (0.001 if name == 'length' else 0.0))
    fit = prediction_error([own], AXISYMMETRIC, start, free=(name,))
    (freed,) = fit.freed
    std = np.array(freed.std)
    assert freed.name == name and np.all(np.isfinite(std))
    assert np.all(np.abs(np.array(freed.change) - TRUE[name]) < 3.5 * std)
    assert np.all(np.array(freed.std) < 0.2 * np.abs(TRUE[name]).max())
    z = (AXISYMMETRIC.parameters(fit.stiffness - TRUTH.stiffness, fit.damping - TRUTH.damping)
         / np.sqrt(np.diag(fit.covariance)))
    assert np.all(np.abs(z) < 4.0)


def test_another_world_of_the_package_is_taken_out(recording):
    way, R = np.array([1e-3, -2e-3, 1.5e-3]), exp_so3(np.array([2e-3, -1e-3, 3e-3]))
    package = recording.package
    moved = Trajectory(package.stamps_ns, apply(R, package.position) + way, R @ package.rotation,
                       valid=package.valid)
    other = replace(recording, package=moved, moves_with_com=(False, False, False))
    given, found = (prediction_error([other], AXISYMMETRIC, TRUTH, free=free)
                    for free in ((), ('package_world',)))
    assert abs(given.stiffness[2, 2] / TRUTH.stiffness[2, 2] - 1.0) > 0.05
    assert_allclose(np.diag(found.stiffness), np.diag(TRUTH.stiffness), rtol=0.01)
    assert 0.9 < found.chi2 < 1.1


def test_mass_and_inertia_together_are_not_identifiable(recording):
    """K and P scaled with mass and inertia make the same motion."""
    fit = prediction_error([recording], AXISYMMETRIC, TRUTH, free=('mass', 'inertia'))
    assert all(np.all(np.isinf(own.std)) for own in fit.freed)
