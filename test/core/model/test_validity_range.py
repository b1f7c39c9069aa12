"""What a fit has seen, against motions made by hand."""


from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import envelope, Samples
from bellows_ros.core.model import validity_range
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.validity_range import Envelope, outside_loads
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import parameter_std, stiffness_std
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.recording.standstills import Standstill, with_standstills
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest

LENGTH = 0.05
COM = np.array([0.0, 0.0, -0.03])
RATE = 200.0


def samples(mass=2.0, frequency=2.0, valid=True):
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
    return Samples(tool, package, Package(mass, np.eye(3) * 0.01, COM), 9.81, 0.1)


def test_ranges_are_those_of_the_motion():
    """Find the amplitudes, the largest rates and the frequency."""
    found = envelope(samples(), LENGTH)
    amplitude = np.array([3e-3, 0, 0, 0, 0, 0.1])
    assert_allclose(found.deflection_high, amplitude, rtol=1e-3, atol=1e-12)
    assert_allclose(found.deflection_low, -amplitude, rtol=1e-3, atol=1e-12)
    omega = 2 * np.pi * 2.0
    # where the lip is fastest its torsion is zero, and its own axes are the tool's
    assert_allclose(found.rates[[0, 5]], [3e-3 * omega, 0.1 * omega], rtol=1e-3)
    assert np.all(found.frequencies[:, 0] >= 1.0) and np.all(found.frequencies[:, 1] <= 3.0)
    assert_allclose(found.mass, 2.0)


def test_several_recordings_widen_every_range():
    """Take the smallest and the largest of all."""
    both = validity_range.joined_envelopes(
        [envelope(samples(1.5, 2.0), LENGTH), envelope(samples(2.5, 5.0), LENGTH)])
    assert_allclose(both.mass, [1.5, 2.5])
    assert_allclose(both.rates[5], 0.1 * 2 * np.pi * 5.0, rtol=1e-3)
    assert np.all(both.frequencies[:, 0] <= 2.0) and np.all(both.frequencies[:, 1] >= 5.0)


def test_samples_that_are_not_valid_do_not_count():
    """See half of a motion."""
    whole = samples()
    half = whole.package.position[:, 0] > 0
    found = envelope(samples(valid=half), LENGTH)
    assert found.deflection_low[0] > 0.0
    with pytest.raises(BellowsError):
        envelope(samples(valid=np.zeros(2000, dtype=bool)), LENGTH)


KNOWN = Envelope(
    np.array([-0.01, -0.01, -0.004, -0.2, -0.3, -0.1]),
    np.array([0.01, 0.01, 0.0, 0.2, 0.3, 0.1]),
    np.array([0.1, 0.1, 0.05, 2.0, 2.0, 1.0]),
    np.array([[0.5, 5.0], [0.5, 4.0]]), np.array([2.0, 2.0]))


def test_distance_is_one_on_the_edge():
    """Be 0 in the middle, 1 on the edge, and say which direction is left beyond it."""
    middle = np.array([0.0, 0.0, -0.002, 0.0, 0.0, 0.0])
    assert validity_range.distance(KNOWN, middle, np.zeros(6), 2.0).value == 0.0
    edge = np.where(np.arange(6) == 4, 0.3, middle)
    assert_allclose(validity_range.distance(KNOWN, edge, np.zeros(6), 2.0).value, 1.0)
    beyond = np.where(np.arange(6) == 4, 0.45, middle)
    far = validity_range.distance(KNOWN, beyond, np.zeros(6), 2.0)
    assert_allclose(far.value, 1.5)
    assert far.outside == ('bending about y is 25.8 deg, seen up to 17.2 deg',)


def test_beyond_names_what_another_recording_leaves():
    """Say nothing about ranges inside, and the end that is farther outside."""
    low = KNOWN.deflection_low.copy()
    low[5] = -0.2
    wider = Envelope(low, KNOWN.deflection_high, KNOWN.rates, KNOWN.frequencies, [2.0, 2.6])
    assert validity_range.beyond(KNOWN, wider) == (
        'the mass is 2.6 kg, seen 2 kg', 'torsion is -11.5 deg, seen up to 5.73 deg')


def test_a_file_holds_at_least_what_was_seen():
    """Round outward: what the fit has seen is not beyond the six digits of it in a file."""
    assert conversion.parameter_envelope(resolve({})) is None
    ends = np.random.default_rng(6).uniform(-1.0, 1.0, size=(500, 6))
    for low, high in zip(ends - 2.0, ends + 2.0, strict=True):
        seen = Envelope(low, high, high, high[:4].reshape(2, 2) + [0.0, 3.0], np.sort(high[:2]))
        written = conversion.parameter_envelope(resolve(seen.parameters()))
        assert validity_range.beyond(written, seen) == ()
        for name in ('deflection_low', 'deflection_high', 'rates', 'frequencies', 'mass'):
            assert_allclose(getattr(written, name), getattr(seen, name), rtol=2e-5)


@pytest.mark.parametrize('change', [
    {'mass': [3.0, 2.0]}, {'rates': [-1.0] * 6}, {'rates': [1.0] * 5}, {'mass': [np.nan, 1.0]},
])
def test_what_is_no_range_is_refused(change):
    """Check on construction."""
    with pytest.raises(BellowsError):
        Envelope(**{**vars(KNOWN), **change})


def test_standstills_widen_only_deflections():
    known = envelope(samples(), LENGTH)
    at = np.array([0])
    tool = Trajectory(at, np.zeros((1, 3)), np.eye(3)[None])
    package = Trajectory(at, np.array([[0.0, 0.0, -LENGTH - 0.002]]) + COM, np.eye(3)[None])
    payload = Package(2.0, np.eye(3) * 0.01, COM)
    still = Standstill(0, 1.0, tool, package, 100, Noise(1e-6, 1e-6), payload)
    wide = with_standstills(known, [still], LENGTH)
    assert_allclose(wide.deflection_low[2], -0.002, atol=1e-12)
    assert_allclose(wide.deflection_high, np.maximum(known.deflection_high, 0.0))
    assert_allclose(wide.rates, known.rates)


def used(**more):
    """Return parameter values of a cup that was identified with 1.8 kg and 20 kPa."""
    return resolve({
        'package.mass': 1.8, 'package.inertia': [1e-3] * 3 + [0.0] * 3, 'vacuum.holding': 20e3,
        'package.com': [0.0, 0.0, -0.03], 'cup.valid_mass': [1.8, 1.8],
        'cup.valid_vacuum': [20e3, 20e3], 'cup.stiffness_std': np.diag([9.0] * 6).ravel().tolist(),
        **{name.replace('__', '.'): value for name, value in more.items()}})


def test_other_masses_and_vacuums_are_named():
    def outside(**changed):
        values = used(**changed)
        return outside_loads((values.cup.valid_mass, values.cup.valid_vacuum), values.package.mass,
                             values.vacuum.holding)

    assert outside() == outside(package__mass=1.9) == ()
    assert outside(package__mass=2.5) == ('the mass is 2.5 kg, seen 1.8 kg',)
    assert outside(vacuum__holding=40e3) == ('the vacuum is 40 kPa, seen 20 kPa',)
    assert outside(package__mass=2.5, cup__valid_mass=[0.0, 0.0]) == ()
    assert outside(package__mass=2.0, cup__valid_mass=[1.0, 2.5]) == ()


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
