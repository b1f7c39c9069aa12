"""What recordings can tell, against recordings that tell it and recordings that do not."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import whitening_of
from bellows_ros.core.identification.samples import Samples, samples_of, with_noise
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import FilterNoise, Noise
from bellows_ros.core.signals.savgol import savgol
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import simulated

ROUND, FULL = STRUCTURES['axisymmetric'], STRUCTURES['full']
L0 = simulated.CUP.length


def described(recording, structure=ROUND, **changes):
    """Return samples of a recording, the identifiability by them, and their fit."""
    samples = samples_of(recording)
    return samples, *simulated.excitation(
        [samples], L0, structure, [recording.noise], **changes)


@pytest.fixture(scope='module')
def rich():
    """Return an exact recording of a motion of all axes."""
    return simulated.record(simulated.shake())


def test_a_rich_exact_recording_tells_everything(rich):
    _, found, fit = described(rich)
    assert found.warnings == ()
    assert (found.rank, found.pairs) == (8, ())
    assert fit.condition_number < 10.0
    assert not any(not p.identifiable or p.weak for p in found.parameters)
    assert [p.value for p in found.parameters] == fit.parameters.tolist()


def test_axes_are_described_as_they_move(rich):
    samples, found, _ = described(rich)
    twist = samples.lip.twist
    z = found.axes[2]
    # Gravity stretches the cup by m g / K z, about which it moves; bending lifts the lip a little.
    segment = simulated.HELD.mass * simulated.GRAVITY / simulated.CUP.stiffness[2, 2]
    assert_allclose(z.strain, np.hypot(segment, z.motion), rtol=0.1)
    assert_allclose([a.twist for a in found.axes], np.sqrt(np.mean(twist**2, axis=0)))
    assert [a.name for a in found.axes] == ['x', 'y', 'z', 'rx', 'ry', 'rz']
    # Torsion follows the lines of 0.4 and 1.9 Hz that the tool turns with.
    low, high = found.axes[5].band_hz
    assert 0.3 <= low < high < 2.6
    assert_allclose(samples.twist_spectrum.peak[5], 1.9, atol=0.5)


@pytest.fixture(scope='module')
def poor():
    """Return a noisy recording of a motion of two axes."""
    return simulated.record(
        simulated.shake(axes=(0, 2)), tool=(1e-4, 5e-4), package=(1e-4, 5e-4))


def test_missing_torsion_is_said_in_plain_words(poor):
    _, found, _ = described(poor)
    (torsion,) = (w for w in found.warnings if w.startswith('Torsion'))
    assert torsion == (
        'Torsion is hardly excited: its stiffness and damping are not identifiable from this '
        'recording; turn the tool about z at 1-3 Hz.')
    unknown = {p.label for p in found.parameters if not p.identifiable}
    assert {'K rz', 'P rz'} <= unknown and not {'K x', 'K z', 'K rx', 'P rx'} & unknown, unknown


@pytest.mark.parametrize(('tool', 'package'), [
    ((2e-4, 5e-4), (1e-5, 5e-5)), ((1e-5, 5e-5), (2e-4, 5e-4))])
def test_expected_bias_is_the_bias(tool, package):
    """Compare with what noise really did, on average over recordings."""
    expected, found = [], []
    for seed in range(8):
        recording = simulated.record(
            simulated.shake(), tool=tool, package=package, seed=seed, rate_hz=240.0)
        _, own, fit = described(recording)
        expected.append([p.bias for p in own.parameters])
        found.append(fit.parameters + fit.bias)  # as without compensation
    truth = ROUND.parameters(simulated.CUP.stiffness, simulated.CUP.damping)
    actual = np.mean(found, axis=0) / truth - 1.0
    scatter = np.std(found, axis=0, ddof=1) / truth / np.sqrt(len(found))
    off = np.abs(np.mean(expected, axis=0) - actual)
    # An eighth of the bias for the extrapolation, 0.1 % for the filter, the rest is chance.
    assert np.all(off < 0.125 * np.abs(actual) + 1e-3 + 3.5 * scatter)
    assert actual[4] < -0.03  # there is a bias to predict


@pytest.mark.parametrize(('name', 'axes'), [('diagonal', (0, 2, 4, 5)), ('full', (0, 1, 2))])
def test_pairs_are_those_of_the_covariance(name, axes):
    """Compare with the inverse of the normal equations, made from all rows."""
    structure = STRUCTURES[name]
    recording = simulated.record(simulated.shake(axes=axes, duration=6.0))
    samples = samples_of(recording)
    whitening = whitening_of(simulated.wrench_covariance(samples, structure))
    A = simulated.whitened_rows(samples, L0, structure, whitening)[:, :-1]
    size = np.linalg.norm(A, axis=0)
    covariance = np.linalg.inv((A / size).T @ (A / size)) / np.outer(size, size)
    _, found, _ = described(recording, structure, covariance=covariance)
    assert found.rank == len(found.parameters)
    spread = np.sqrt(np.diag(covariance))
    correlation = np.triu(covariance / np.outer(spread, spread), 1)
    expected = {(structure.labels[i], structure.labels[j])
                for i, j in np.argwhere(np.abs(correlation) > 0.95)}
    assert {(a, b) for a, b, _ in found.pairs} == expected
    assert bool(expected) == (name == 'full')


def test_a_full_fit_of_a_poor_motion_is_advised_against(poor):
    _, found, _ = described(poor, FULL)
    couplings = next(w for w in found.warnings if 'couplings' in w)
    assert 'use a simpler fit.structure' in couplings


def test_added_noise_is_that_of_filtered_white_noise():
    """Filter white noise about a body at rest, and compare moments of all that comes out."""
    rng, count, sigma = np.random.default_rng(3), 20_000, Noise(1e-3, 2e-3)
    R = exp_so3(np.array([0.3, -0.2, 0.5]))
    filtered = savgol(Trajectory(
        10_000_000 * np.arange(count), sigma.position * rng.standard_normal((count, 3)),
        R @ exp_so3(sigma.rotation * rng.standard_normal((count, 3)))), 6, 4)
    n = len(filtered)
    rest = Trajectory(
        filtered.stamps_ns, np.zeros((n, 3)), np.tile(R, (n, 1, 1)), *np.zeros((2, n, 6)))
    added = with_noise(
        Samples(rest, rest, simulated.HELD, simulated.GRAVITY, 0.1),
        FilterNoise(sigma, sigma, filtered.weights, filtered.weights), rng).package
    for name in ('position', 'twist', 'acceleration'):
        assert_allclose(np.std(getattr(added, name), axis=0),
                        np.std(getattr(filtered, name), axis=0), rtol=0.08)
    real, made = (np.corrcoef((body.position @ R)[:, 0], body.acceleration[:, 0])[0, 1]
                  for body in (filtered, added))
    assert_allclose(made, real, atol=0.03)
    assert made < -0.3  # value and second derivative go against each other
