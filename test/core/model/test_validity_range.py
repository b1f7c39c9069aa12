"""What a fit has seen, against motions made by hand."""


from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import envelope
from bellows_ros.core.model import validity_range
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope, outside_loads
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import parameter_std, stiffness_std
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

LENGTH = 0.05
COM = np.array([0.0, 0.0, -0.03])
RATE = 200.0


def motion(mass=2.0, frequency=2.0, valid=True):
    """Return 10 s in which the lip moves 3 mm along x and turns 0.1 rad about z, at rest tool."""
    t = np.arange(2000) / RATE
    stamps = (t * 1e9).round().astype(np.int64)
    omega = 2 * np.pi * frequency
    x, v = 3e-3 * np.sin(omega * t), 3e-3 * omega * np.cos(omega * t)
    angle, w = 0.1 * np.sin(omega * t), 0.1 * omega * np.cos(omega * t)
    z, zero = np.array([0.0, 0.0, 1.0]), np.zeros_like(t)
    R = exp_so3(angle[:, None] * z)
    lip = np.column_stack([x, zero, np.full_like(t, -LENGTH)])
    velocity = np.einsum('nji,nj->ni', R, np.column_stack([v, zero, zero]))
    twist = np.hstack([velocity, np.column_stack([zero, zero, w])])
    eye = np.tile(np.eye(3), (len(t), 1, 1))
    # B lies on the axis of torsion, so its velocity is that of the lip
    package = Trajectory(stamps, lip + COM, R, twist, np.zeros((len(t), 6)), valid)
    tool = Trajectory(stamps, np.zeros((len(t), 3)), eye, np.zeros((len(t), 6)))
    return tool, package, Package(mass, np.eye(3) * 0.01, COM), LENGTH


def test_ranges_are_those_of_the_valid_motion():
    """Find the amplitudes, the largest rates and the mass."""
    found = envelope(*motion())
    amplitude = np.array([3e-3, 0, 0, 0, 0, 0.1])
    assert_allclose(found.high[:6], amplitude, rtol=1e-3, atol=1e-12)
    assert_allclose(found.low[:6], -amplitude, rtol=1e-3, atol=1e-12)
    omega = 2 * np.pi * 2.0
    # where the lip is fastest its torsion is zero, and its own axes are the tool's
    assert_allclose(found.high[[6, 11, 12]], [3e-3 * omega, 0.1 * omega, 2.0], rtol=1e-3)
    assert_allclose(found.low[6:12], -found.high[6:12])
    half = envelope(*motion(valid=motion()[1].position[:, 0] > 0))
    assert half.low[0] > 0.0
    with pytest.raises(BellowsError):
        envelope(*motion(valid=np.zeros(2000, dtype=bool)))


def test_several_recordings_widen_every_range():
    """Take the smallest and the largest of all."""
    both = validity_range.joined_envelopes(
        [envelope(*motion(1.5, 2.0)), envelope(*motion(2.5, 5.0))], 2e4)
    assert_allclose([both.low[12:], both.high[12:]], [[1.5, 2e4], [2.5, 2e4]])
    assert_allclose(both.high[11], 0.1 * 2 * np.pi * 5.0, rtol=1e-3)


KNOWN = Envelope(
    np.array([-0.01, -0.01, -0.004, -0.2, -0.3, -0.1, *[-1.0] * 6, 2.0, 0.0]),
    np.array([0.01, 0.01, 0.0, 0.2, 0.3, 0.1, *[1.0] * 6, 2.0, 0.0]))
MIDDLE = np.array([0.0, 0.0, -0.002, *[0.0] * 9, 2.0, 0.0])


@pytest.mark.parametrize(('place', 'state', 'expected', 'words'), [
    (0, 0.0, 0.0, ()), (4, 0.3, 1.0, ()),
    (4, 0.45, 1.5, ('bending about y is 25.8 deg, seen up to 17.2 deg',)),
    (12, 2.6, 3.0, ('the mass is 2.6 kg, seen 2 kg',)), (13, 4e4, 0.0, ())])
def test_distance_is_one_on_the_edge(place, state, expected, words):
    """Be 0 in the middle, and name the range that is exceeded."""
    at = MIDDLE.copy()
    at[place] = state
    found = validity_range.distance(KNOWN, at)
    assert_allclose(found.value, expected)
    assert found.outside == words


def test_a_file_holds_at_least_what_was_seen():
    """Round outward: what the fit has seen is not beyond the six digits of it in a file."""
    assert conversion.parameter_envelope(resolve({})) is None
    for ends in np.random.default_rng(6).uniform(-1.0, 1.0, size=(500, 14)):
        seen = Envelope(ends - 2.0, ends + 2.0)
        written = conversion.parameter_envelope(resolve(seen.parameters()))
        assert validity_range.beyond(written, seen) == ()
        assert_allclose([written.low, written.high], [seen.low, seen.high], rtol=2e-5)


@pytest.mark.parametrize('low', [KNOWN.high + 1.0, KNOWN.low[1:], KNOWN.low * np.nan])
def test_what_is_no_range_is_refused(low):
    """Check on construction."""
    with pytest.raises(BellowsError):
        Envelope(low, KNOWN.high)


def used(**more):
    """Return parameter values of a cup that was identified with 1.8 kg and 20 kPa."""
    return resolve({
        'package.mass': 1.8, 'package.inertia': [1e-3] * 3 + [0.0] * 3, 'vacuum.holding': 20e3,
        'package.com': [0.0, 0.0, -0.03], 'cup.valid_low': [0.0] * 12 + [1.8, 20e3],
        'cup.valid_high': [0.0] * 12 + [1.8, 20e3],
        'cup.stiffness_std': np.diag([9.0] * 6).ravel().tolist(),
        **{name.replace('__', '.'): value for name, value in more.items()}})


@pytest.mark.parametrize(('changed', 'words'), [
    ({}, ()), ({'package__mass': 1.9}, ()),
    ({'package__mass': 2.5}, ('the mass is 2.5 kg, seen 1.8 kg',)),
    ({'vacuum__holding': 40e3}, ('the vacuum is 40 kPa, seen 20 kPa',)),
    ({'package__mass': 2.0, 'cup__valid_high': [0.0] * 12 + [2.5, 20e3]}, ())])
def test_other_masses_and_vacuums_are_named(changed, words):
    values = used(**changed)
    assert outside_loads(
        conversion.box_of(values), values.package.mass, values.vacuum.holding) == words


def test_the_stiffness_of_other_loads_is_less_certain():
    stiffness = np.diag(np.reshape(used().cup.stiffness, (6, 6)))
    np.testing.assert_array_equal(stiffness_std(used()), np.diag([9.0] * 6))
    # bending: 30 % of K per kg, or 3 % with stretch; nothing along and about other axes
    for stretch, share in (([0.0, 0.0], 0.3), ([-1e4, -3.0], 0.03)):
        std = np.diag(stiffness_std(used(package__mass=2.5, cup__stretch=stretch)))
        np.testing.assert_allclose(
            np.sqrt(std**2 - 81.0)[3:5], share * 0.7 * stiffness[3:5], rtol=1e-9)
        np.testing.assert_array_equal(std[[0, 1, 2, 5]], 9.0)
    std = np.diag(stiffness_std(used(vacuum__holding=10e3)))
    np.testing.assert_allclose(np.sqrt(std**2 - 81.0)[[2, 4]], stiffness[[2, 4]] * [0.2, 0.23])
    np.testing.assert_allclose(
        parameter_std(used(package__mass=2.5))[:21],
        np.minimum(stiffness_std(used(package__mass=2.5)), np.sqrt(
            np.outer(stiffness, stiffness)))[np.triu_indices(6)])
