"""Recordings at rest: standstills, cup length, the spring alone."""

from dataclasses import replace
import functools

from bellows_ros.core.identification.residuals import at_rest
from bellows_ros.core.identification.statics import cup_length_of
from bellows_ros.core.identification.unknowns import Problem, weak_prior
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import PoseNoise
from bellows_ros.core.recording.standstills import Standstill, standstills_of
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError, UnexplainedError
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_output_error import measured
from ..drops import SHARED
from ...cell.cup import GRAVITY, PLATE, THESIS
from ...cell.motion import shake, standstills
from ...cell.sensors import record

G = GRAVITY

TILTS = [(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.2, 0.2, 1.0), (0.0, 0.0, 0.0)]

NOISE = {'tool': (2e-5, 5e-5), 'package': (1e-4, 5e-4)}


@pytest.fixture(scope='module')
def tilted():
    """Return a recording of a start at rest and four poses, held for 3.5 s after 0.8 s each."""
    return record(standstills(TILTS, hold=3.5), **NOISE)


def upright(length, mass, tilt=0.0, error=1e-6):
    """Return a standstill of a cup of known length."""
    c, s = np.cos(tilt), np.sin(tilt)
    R = np.array([[[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]])
    com = np.asarray(PLATE.com)
    at = np.array([0])
    tool = Trajectory(at, np.zeros((1, 3)), R)
    package = Trajectory(at, (R[0] @ (com - [0.0, 0.0, length]))[None], R)
    return Standstill(0, 1.0, tool, package, 100, PoseNoise(error, error), replace(
        PLATE, mass=mass))  # at rest its inertia takes no part


def test_every_standstill_is_found_without_the_swinging_before_it(tilted):
    found, failed = standstills_of(tilted)
    assert len(found) == 5 and failed == 0
    motion = standstills(TILTS, hold=3.5)
    for number, still in enumerate(found):
        begin = 4.3 * number
        start = still.start_ns * 1e-9
        # A smooth move is as good as over a little before its end.
        assert begin - 0.3 <= start <= begin + 2.5
        assert_allclose(start + still.duration, begin + 3.5, atol=0.25)
        t = np.array([start + 0.5 * still.duration])
        _, _, R, _ = motion.state(t)
        assert_allclose(still.tool.rotation, R, atol=2e-4)
        assert_allclose(still.tilt, np.arccos(R[0, 2, 2]), atol=2e-4)


def test_rubber_that_creeps_counts_where_it_comes_to_rest():
    """Find the static equilibrium of a cup that still creeps when its standstill ends."""
    cup = Cup(THESIS.stiffness, THESIS.damping, THESIS.length, (0.15, 0.2))
    creeping = record(standstills(TILTS, hold=3.5), cup, **NOISE)
    found, _ = standstills_of(creeping)
    for still in found[1:]:
        shown = still.lip[3:] @ still.creep[3:]
        assert shown > 0.0 or np.linalg.norm(still.lip[3:]) < 5e-3  # towards the deflection
    # a mean over the creep would be off


def test_standstills_too_short_for_the_package_are_counted():
    short = record(standstills(TILTS, hold=1.6), **NOISE)
    found, failed = standstills_of(short)
    assert failed == len(TILTS) + 1 - len(found) > 0


def test_a_motion_without_rest_has_no_standstill():
    motion = shake(duration=6.0, rest=0.3)
    recording = record(motion)
    with pytest.raises(BellowsError, match=r'\b0\.5 s\b'):
        standstills_of(recording)


def test_length_and_stiffness_of_a_known_polynomial():
    """Give lengths of a degressive cup, exactly, and find it again."""
    l0, slope, bend = 0.0481, 1.0 / 11530.0, 4e-9
    masses = np.array([0.3, 0.8, 1.4, 1.9, 2.6, 4.0])
    loads = masses * G
    lengths = l0 + slope * loads + bend * loads**3
    standstills = [upright(length, mass) for length, mass in zip(lengths, masses, strict=True)]
    found = cup_length_of(standstills, G)
    assert_allclose(found.length, l0, atol=1e-9)
    assert_allclose(found.stiffness, 1.0 / slope, rtol=1e-6)
    assert_allclose(found.coefficients, [l0, slope, 0.0, bend], rtol=1e-5, atol=1e-10)
    assert found.remarks == ()


def test_picks_scatter_and_the_line_is_straight_as_masses_left_out_say():
    """Five masses picked ten times each: 0.17 mm from pick to pick, named, and no cubic."""
    rng = np.random.default_rng(8)
    still = [
        upright(0.0478 + mass * G / 6760.0 + 1.7e-4 * rng.normal(), mass, error=1e-5)
        for mass in (0.16, 0.452, 0.714, 1.181, 2.187) for _ in range(10)]
    found = cup_length_of(still, G)
    assert len(found.coefficients) == 2 and found.remarks == ()
    assert_allclose(found.pick_std, 1.7e-4, rtol=0.25)
    assert_allclose(found.stiffness, 6760.0, rtol=0.06)
    assert abs(found.length - 0.0478) < 4.0 * found.length_std < 4e-4


@pytest.mark.skipif(not SHARED.exists(), reason='the measured drops are not here')
@pytest.mark.parametrize(('name', 'stiffness', 'within'), [
    ('package_z_m', 6800.0, 300.0), ('lip_z_m', 9640.0, 400.0)])
def test_measured_lengths_are_straight_in_the_load(name, stiffness, within):
    """Five masses picked 53 times: as published with them, and 0.17 mm from pick to pick."""
    data = np.load(SHARED)
    hang = (data['tool_z_m'] - data[name])[:, :3].mean(axis=1)
    found = cup_length_of([
        upright(length, mass, error=3e-5)
        for length, mass in zip(hang, data['mass_kg'], strict=True)], G)
    assert len(found.coefficients) == 2
    assert abs(found.stiffness - stiffness) < within
    assert 1.0e-4 < found.pick_std < 2.2e-4


def test_lengths_on_no_line_are_refused_with_exit_code_1():
    """Up and down, and shorter under load."""
    for lengths in ((0.048, 0.0502, 0.0481, 0.0503), (0.05, 0.0495, 0.049, 0.0486)):
        still = [upright(x, m) for x, m in zip(lengths, (0.5, 1.0, 1.5, 2.0), strict=True)]
        with pytest.raises(UnexplainedError) as refused:
            cup_length_of(still, G)
        assert refused.value.exit_code == 1


def test_tilted_standstills_and_repeated_masses_do_not_count():
    standstills = [upright(0.0491, 1.0), upright(0.0491, 1.0), upright(0.3, 2.0, tilt=0.2)]
    with pytest.raises(BellowsError):
        cup_length_of(standstills, G)
    two = cup_length_of([*standstills, upright(0.0501, 2.0)], G)
    assert_allclose(two.length, 0.0481, atol=1e-9)
    assert len(two.coefficients) == 2 and two.degrees_of_freedom == 0
    assert np.isinf(two.length_std)
    assert two.remarks[0].code == 'uncertain_length'


@pytest.mark.parametrize('count', [3, 4, 5])
def test_a_wrong_mass_is_noticed(count):
    """Keep a degree of freedom, and warn where one of some masses is 3 % off."""
    masses = np.array([0.5, 1.0, 1.5, 2.0, 2.5])[:count]
    lengths = 0.0481 + masses * G / 11530.0
    right = [upright(x, m, error=2e-6) for x, m in zip(lengths, masses, strict=True)]
    found = cup_length_of(right, G)
    assert found.degrees_of_freedom == count - 2 and np.isfinite(found.length_std)
    assert abs(found.length - 0.0481) < 1e-7
    assert not any(remark.code == 'wrong_mass' for remark in found.remarks)
    given = masses * np.where(np.arange(count) == 1, 1.03, 1.0)
    wrong = cup_length_of(
        [upright(x, m, error=2e-6) for x, m in zip(lengths, given, strict=True)], G)
    assert any(remark.code == 'wrong_mass' for remark in wrong.remarks)
    assert abs(wrong.length - 0.0481) < 3.0 * wrong.length_std


@functools.cache
def resting(seed):
    """Return standstills in several poses."""
    return standstills_of(record(
        standstills(TILTS, hold=3.5), seed=seed, **NOISE))[0]


def problem_at_rest(free, seed=1, standstills=None):
    """Return the problem of a motion with standstills, and the unknowns of the truth."""
    own = measured(seed, tool_hz=100.0, duration=6.0)
    problem = Problem.of(
        [own], STRUCTURES['full'], THESIS, weak_prior(free),
        standstills=standstills or resting(seed))
    return problem, problem.start


def test_standstills_of_the_truth_have_the_chi2_of_their_errors():
    sizes = [problem_at_rest([], seed)[0] for seed in range(4)]
    chi2 = [at_rest(problem, problem.start)[2] for problem in sizes]
    assert 0.3 < np.mean(chi2) < 2.0
    stiffer = problem_at_rest([])[0]
    theta = stiffer.start.copy()
    theta[:stiffer.count // 2] += 0.1 * np.equal(*np.transpose(stiffer.structure.leads))
    J, r, chi2 = at_rest(stiffer, theta)
    assert chi2 > 10.0 and np.mean(r**2) == pytest.approx(1.0)
