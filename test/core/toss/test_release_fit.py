"""The law of release from drops: against what made them, and real ones of masses left out."""

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.model.grip import Law
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import release_factor
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss import release_fit
from bellows_ros.core.toss.release_fit import _tracked, fit_release, release_parameters
from bellows_ros.errors import BellowsError, UndeterminedError, UnexplainedError
import numpy as np
import pytest

from .. import drops

LAW: Law = (0.015, 0.5, 0.0, 22.0, 19.0, 0.0204, 25.0, 2.42)
STIFFNESS, LENGTH = 6500.0, 0.05
SECONDS, VALVE = np.arange(80) / 360.0, 0.04

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='interpreted fits take too long; see numba')


def made(masses, rng, law=LAW, stiffness=STIFFNESS):
    """Return two drops of each mass with noise and a scattered instant, of a true cup."""
    out = []
    for mass in np.repeat(masses, 2):
        z = drops.simulated(mass, stiffness, LENGTH, law, SECONDS, VALVE + 5e-4 * rng.normal())
        z += 1e-4 * rng.standard_normal(len(z)) + 1.5e-4 * rng.normal()
        out.append(drops.made_drop(
            mass, STIFFNESS, LENGTH, SECONDS, np.zeros(len(z)), z, VALVE))
    return out


def test_finds_the_law_that_made_the_drops_and_no_more_numbers():
    """Within its own standard errors; tau, hardly visible in a release, is not fitted."""
    found = fit_release(made((0.3, 0.8, 1.8), np.random.default_rng(2)))
    assert found.free == (0, 3, 4, 5, 6, 7)
    free = list(found.free)
    off = (np.array(found.law) - LAW)[free] / found.std[free]
    assert np.abs(off).max() < 5.0
    np.testing.assert_allclose(np.array(found.law)[free], np.array(LAW)[free], rtol=0.1)
    assert found.position < 2e-4


def test_a_number_that_one_mass_does_not_determine_is_not_fitted():
    """It stays as given, what is not known of it reaches the others, and all are honest."""
    rng, each = np.random.default_rng(2), np.array(LAW)
    vague = []  # all numbers of the law differ from drop to drop, not its instant alone
    for _ in range(6):
        law = each.copy()
        law[3:] *= 1.0 + 0.02 * rng.standard_normal(5)
        vague += made((0.8,), rng, tuple(law.tolist()))[:1]
    given_std = (0.0,) * 3 + (2.0, 2.0, 2e-3, 12.0, 0.25)
    found = fit_release(vague, LAW, given_std)
    assert found.not_identifiable == (6,) and 6 not in found.free
    assert found.law[6] == LAW[6] and found.std[6] == pytest.approx(12.0)
    for k in found.free:
        assert found.std[k] < 0.5 * found.law[k]
        assert abs(found.law[k] - LAW[k]) < 3.0 * found.std[k]
    sure = fit_release(vague, LAW, (0.0,) * 6 + (0.1, 0.0))
    free = list(found.free)
    assert sure.law == found.law and (sure.std[free] < 0.9 * found.std[free]).any()
    assert (sure.std[free] < found.std[free]).all()


def test_an_impulse_that_the_drops_do_not_determine_is_refused():
    """Drops that differ too much have none in common."""
    rng, several = np.random.default_rng(3), []
    for _ in range(4):
        law = np.array(LAW)
        law[3:] *= 1.0 + 0.05 * rng.standard_normal(5)
        several += made((0.8,), rng, tuple(law.tolist()))[:1]
    with pytest.raises(UndeterminedError, match=r'release\.impulse'):
        fit_release(several)


def test_refuses_too_few_drops_and_a_law_that_does_not_explain_them():
    """The second with exit code 1: the answer is no."""
    rng = np.random.default_rng(4)
    few = made((0.3,), rng)
    with pytest.raises(BellowsError, match=r'\b3\b.*drops\b.* 2\b'):
        fit_release(few)
    other = (0.08, *LAW[1:])  # as if the valves of the heavy packages were of another clock
    mixed = made((0.3, 0.8), rng) + made((1.8,), rng, other)
    with pytest.raises(UnexplainedError) as refused:
        fit_release(mixed)
    assert refused.value.exit_code == 1


def test_residuals_that_all_drops_have_in_common_refute_a_law():
    """Where noise hides them from chi^2; noise with memory, another in each drop, does not."""
    rng = np.random.default_rng(7)
    drop = made((0.8,), rng)[0]
    wave = 4e-3 * np.sin(30.0 * SECONDS)

    def lack(common, own):
        several = []
        for _ in range(8):
            z = drop.package.position[:, 2] + common * wave + own * np.cumsum(
                4e-4 * rng.standard_normal(len(SECONDS)))
            several.append(drops.made_drop(0.8, STIFFNESS, LENGTH, SECONDS, np.zeros(len(z)), z,
                                           VALVE, noise=(4e-3, 5e-4)))
        problem = [release_fit._DropFit(one, (0,)) for one in several]
        return release_fit._in_common(problem, np.array(LAW))

    wrong, size = lack(1.0, 1.0)
    assert wrong > release_fit.MAX_COMMON_RESIDUAL and size == pytest.approx(
        float(np.sqrt(np.mean(wave**2))), rel=0.3)
    assert lack(0.0, 1.0)[0] < release_fit.MAX_COMMON_RESIDUAL
    fit = release_fit.ReleaseFit(
        LAW, (0,), np.eye(8), np.zeros(8),
        (release_fit.Explained(0.8, 0.1, 0.0, 3e-3, 0.0, 1.0, 1.1),), wrong, size)
    assert not fit.explains and fit._replace(lack=1.0).explains


REAL = pytest.mark.skipif(not drops.SHARED.exists(), reason='the measured drops are not here')


@REAL
@pytest.mark.parametrize(('left_out', 'most'), [
    ((0.452, 1.181), 3),
    *(pytest.param((mass,), 99, marks=pytest.mark.stress) for mass in (0.452, 0.714, 1.181)),
    pytest.param((0.452, 1.181), 99, marks=pytest.mark.stress)])
def test_predicts_real_drops_of_masses_left_out(left_out, most):
    """Within 0.6 mm and 20 mm/s over 139 ms, parting within 5 ms, the flight to 30 mm/s."""
    data, by_mass = drops.real_drops(most=most)
    found = fit_release(
        [drop for mass in by_mass if mass not in left_out for drop in by_mass[mass]])
    for mass in left_out:
        off = drops.misses(data, by_mass[mass][:3], found.law)
        position, velocity = np.sqrt(np.mean(off[:, :2]**2, axis=0))
        assert position < 6e-4 and velocity < 0.02
        assert np.abs(off[:, 2] - 0.094).max() < 5e-3  # as the lip says that stays behind
        assert off[:, 3].max() < 0.04 and off[:, 3].mean() < 0.03


@REAL
@pytest.mark.parametrize('left_out', [0.16, 2.187])
def test_the_lightest_and_the_heaviest_left_out_are_where_their_uncertainty_says(left_out):
    """Height and velocity at the end of each drop within 95 %, which is no more than needed."""
    data, by_mass = drops.real_drops(most=3)
    others = [mass for mass in by_mass if mass != left_out]
    found = fit_release([drop for mass in others for drop in by_mass[mass]])
    values = resolve({**release_parameters(found), 'package.mass': left_out})
    errors, std = drops.at_the_end(data, by_mass[left_out], np.array(found.law),
                                   release_factor(values))
    assert (np.abs(errors) < 1.96 * std).all()
    assert std[0, 0] < 0.015 and std[0, 1] < 0.25
    inside = drops.at_the_end(data, by_mass[left_out], np.array(found.law), release_factor(
        values.replaced({'package.mass': 0.714})))[1]
    assert (std > 1.5 * inside).all()


@pytest.mark.parametrize(('wrong', 'begin_ms', 'end_ms'), [
    ((), -150, 200), ((-60, -100, 80, 120), -58, 80), ((-6,), -4, 200), ((2,), -150, 2)])
def test_a_drop_is_tracked_without_a_gap_about_the_valve(wrong, begin_ms, end_ms):
    """From 0.15 s before the valve or the last gap before it, to the first gap after it."""
    times_ms = np.arange(-400, 400, 2)
    n = len(times_ms)
    valve_ns = 10**18
    poses = Trajectory(valve_ns + 10**6 * times_ms, np.zeros((n, 3)),
                       np.tile(np.eye(3), (n, 1, 1)), valid=~np.isin(times_ms, wrong))
    found = _tracked(poses, valve_ns, valve_ns + 200 * 10**6)
    assert (found.stamps_ns[0] - valve_ns) // 10**6 == begin_ms
    assert (found.stamps_ns[-1] - valve_ns) // 10**6 == end_ms - 2


def test_a_drop_that_is_tracked_only_after_the_valve_is_refused():
    stamps_ns = 10**18 + 10**6 * np.arange(12, 100)
    poses = Trajectory(stamps_ns, np.zeros((88, 3)), np.tile(np.eye(3), (88, 1, 1)))
    with pytest.raises(UndeterminedError, match='not tracked'):
        _tracked(poses, 10**18, int(stamps_ns[-1]))
