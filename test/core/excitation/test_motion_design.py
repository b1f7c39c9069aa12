"""A designed motion: within its limits by differences and simulation, and better than ours."""


from bellows_ros.core.excitation import motion_design
from bellows_ros.core.excitation.motion_design import (
    ArmLimits,
    Checks,
    FourierMotion,
    limits_from,
    MotionObjective,
    response,
    standard_errors,
)
from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion, rpy_rotation
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.grip import safety_factors
from bellows_ros.core.model.kernels import lip_wrench
from bellows_ros.core.model.simulation import row_state, simulate, state_row, tool_rows
from bellows_ros.core.synthetic.motion import Pose
from bellows_ros.core.synthetic.recipe import read_recipe
from bellows_ros.errors import BellowsError
from bellows_ros.files import safe_yaml
import numpy as np
from numpy.testing import assert_allclose
import pytest

from .test_information import (
    cup_of,
    expected,
    model_of,
    PACKAGE,
    stamps,
    STRUCTURE,
    TRACKING,
    TRUTH,
)
from .. import oracle
from ...conftest import ROOT

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: a design takes minutes interpreted')

GRIP = (170.0, 0.03, 0.5)
CONTENT = safe_yaml.load(ROOT / 'config' / 'limits_example.yaml')
LIMITS = limits_from(CONTENT, 1.5)[0]


def response_at(omega):
    """Return the response of the truth, at rest at the start of the motion."""
    at = state_row(LIMITS.start.position, [0.0, 0.0, 0.0, 1.0], np.zeros(6))
    return response(model_of, TRUTH, TRUTH, at, omega, TRACKING)


def designed(guess=TRUTH, limits=LIMITS, duration=20.0, grip=None, seed=0):
    return motion_design.design(
        cup_of(guess), PACKAGE, 9.81, STRUCTURE, checks_of(guess, limits, grip), TRACKING,
        duration, seed, lambda what, part: None)


def checks_of(guess, limits, grip):
    models = [model_tuple(cup, PACKAGE, 9.81) for cup in motion_design.cups_near(cup_of(guess))]
    return Checks(limits, models, grip)


@pytest.mark.parametrize('grip', [None, GRIP])
def test_ends_with_a_hold_of_a_tilt_within_limits(grip):
    """Steady for its time, from rest to rest, with zero jerk; none where the tool may not tilt."""
    checks = checks_of(TRUTH, LIMITS, grip)
    held = motion_design._held(checks, 5.0, 7.0)
    assert held.hold == 7.0 and 0.1 < np.linalg.norm(held.tilt) and held.tilt[2] == 0.0
    begin = held.rest_duration + held.period + held.move
    *_, R, w = held.state(np.linspace(begin, begin + 7.0, 50))
    assert np.abs(w).max() < 1e-12
    assert_allclose(
        R, np.broadcast_to(LIMITS.start.rotation @ exp_so3(held.tilt), R.shape), atol=1e-12)
    *_, R, w = held.state(np.array([begin - held.move, held.duration]))
    assert_allclose(R, np.stack([LIMITS.start.rotation] * 2), atol=1e-12)
    t, h = np.array([begin - held.move, begin, begin + 7.0, held.duration]), 1e-4
    _, _, _, far = held.state(t + h)
    _, _, _, near = held.state(t - h)
    _, _, _, at = held.state(t)
    jerk = (far - 2.0 * at + near) / h**2
    assert np.abs(jerk).max() < 1e-2 * LIMITS.rates['angular_jerk']
    assert max(checks.ratios(held).values()) <= 1.0
    rigid = LIMITS._replace(bending=1e-9)
    assert motion_design._held(checks._replace(limits=rigid), 5.0, 7.0).hold == 0.0


def errors_of(motion):
    return expected(motion.trajectory(stamps(360.0, 20.0), 10**9))


def require_within(found, limits, guess, grip=None):
    """Check a motion at 1 kHz by differences of its poses alone, and by plain simulations."""
    tool = found.motion.at_rate(1000.0)
    o, R = tool.position, tool.rotation
    assert (o > limits.lower).all() and (o < limits.upper).all()
    still = slice(0, 1900)
    assert np.ptp(o[still], axis=0).max() < 1e-12 and np.abs(o[-1] - o[0]).max() < 1e-9
    turned = np.einsum('nji,njk->nik', R[:-1], R[1:])
    rate = 1e3 * 0.5 * oracle.vee(turned - np.swapaxes(turned, 1, 2))
    allowed = list(limits.rates.values())
    for moved, most in ((1e3 * np.diff(o, axis=0), allowed[:3]),
                        (np.einsum('nij,nj->ni', R[1:], rate), allowed[3:])):
        for limit in most:
            assert np.linalg.norm(moved, axis=1).max() <= limit * (1.0 + 1e-6)
            moved = 1e3 * np.diff(moved, axis=0)
    for factor in (1.0, 0.7, 1.3):
        x = guess * np.repeat([factor, 1.0], 4)
        body = simulate(cup_of(x), PACKAGE, tool)
        bent = np.arccos(np.sum(R[:, :, 2] * body.rotation[:, :, 2], axis=1))
        assert bent.max() <= limits.bending * 1.001
        if grip:
            poses = np.hstack([body.position, rotation_to_quaternion(body.rotation), body.twist])
            held = [safety_factors(grip, *lip_wrench(model_of(x), row_state(a), row_state(b)))
                    for a, b in zip(tool_rows(tool)[::7], poses[::7], strict=True)]
            assert np.min(held) >= limits.safety * 0.999


@pytest.fixture(scope='module')
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(motion_design, 'STAGES', ((8, 60), (16, 20)))
        return designed(grip=GRIP)


@pytest.fixture(scope='module')
def found():
    return designed()


@pytest.fixture(scope='module')
def ours():
    recipe = read_recipe(safe_yaml.load(ROOT / 'bags' / 'identification.yaml'), PACKAGE.com)
    return errors_of(recipe.motion)


def test_no_limit_is_violated(quick):
    require_within(quick, LIMITS, TRUTH)
    assert 0.97 < max(quick.ratios.values()) <= 1.0
    assert sum(quick.shares.values()) == pytest.approx(1.0)


def test_a_search_cut_short_is_better_than_our_multisine(quick, ours):
    new = errors_of(quick.motion)
    assert_allclose(new, standard_errors(quick.information), rtol=1e-3)
    assert (new <= ours / 2.0).all(), ours / new


@pytest.mark.stress
@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('grip', [None, GRIP])
def test_all_errors_are_a_third_of_those_of_our_multisine(grip, seed, ours):
    new = errors_of(designed(grip=grip, seed=seed).motion)
    assert (new <= ours / 3.0).all(), ours / new


@pytest.mark.stress
@pytest.mark.parametrize('factor', [0.7, 1.3])
def test_a_guess_that_is_off_costs_little(found, factor, ours):
    """With K guessed 30 % off all errors are less than half of those of our multisine."""
    other = designed(TRUTH * np.repeat([factor, 1.0], 4))
    new = errors_of(other.motion)
    assert (new < 0.45 * ours).all(), new / ours
    assert np.exp(np.mean(np.log(new / errors_of(found.motion)))) < 1.25


@pytest.mark.parametrize('seeds', [range(1), *(
    pytest.param(range(s, s + 50), marks=[pytest.mark.stress, pytest.mark.timeout(600)])
    for s in range(1, 1001, 50))])
def test_short_motions_of_a_tilted_tool_hold_the_grip(monkeypatch, seeds):
    """No limit is violated at 1 kHz, from 1,000 seeds of the search and of the arm's limits."""
    monkeypatch.setattr(motion_design, 'STAGES', ((8, 30), (64, 30)))
    for seed in seeds:
        rng = np.random.default_rng(seed)
        start = Pose(LIMITS.start.position, rpy_rotation(np.array([0.2, -0.1, 1.0])))
        limits = ArmLimits(
            start, LIMITS.lower, LIMITS.upper, LIMITS.rotation,
            LIMITS.rates | {
                name: most * rng.uniform(0.2, 1.0)
                for name, most in LIMITS.rates.items() if 'angular' not in name},
            LIMITS.bending, LIMITS.torsion, 1.5, 6.0, None, np.zeros(0))
        short = designed(limits=limits, duration=6.0, grip=GRIP, seed=seed)
        require_within(short, limits, TRUTH, GRIP)
        assert max(short.ratios.values()) <= 1.0


def test_slopes_of_the_search_are_its_differences():
    rng = np.random.default_rng(4)
    models = [model_of(TRUTH)]
    search = MotionObjective(
        Checks(LIMITS, models, GRIP), 4.0, lambda omega: [response_at(omega)], 360.0)
    shape = rng.standard_normal(2 * search.size.size)
    for power, allowed in ((8, np.ones(search.load_count)), (60, np.full(search.load_count, 0.7))):
        value, slope = search(shape, power, allowed)
        way = rng.standard_normal(len(shape))
        up, down = (search(shape + s * 1e-6 * way, power, allowed)[0] for s in (1, -1))
        assert (up - down) / 2e-6 == pytest.approx(slope @ way, rel=1e-4)
        larger = search(3.0 * shape, power, allowed)[0]
        assert larger == pytest.approx(value)  # only the shape counts


def test_small_loads_are_linear():
    """Bending and grip of a slow small motion, simulated, against the rows the search takes."""
    c = np.zeros((30, 6), dtype=complex)
    c[27] = [0.001, 0.0005j, 0.0, 0.002j, 0.004, 0.01]
    motion = FourierMotion(LIMITS.start, 8.0, c)
    omega = 2.0 * np.pi * np.array([28 / 8.0])
    rows = motion_design.load_rows(response_at(omega), model_of(TRUTH), LIMITS, None, omega)
    wave = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 400))
    expected = [np.linalg.norm((np.outer(wave, row[0] @ c[27])).real, axis=1).max()
                for row in rows]
    found = Checks(LIMITS, [model_of(TRUTH)], None).loads(motion)[0, :2]
    assert_allclose(found, expected, rtol=0.1)  # the ramps add a little


def test_small_motions_have_the_information_of_the_linear_response():
    rng = np.random.default_rng(8)
    c = 1e-4 * (rng.standard_normal((60, 6)) + 1j * rng.standard_normal((60, 6)))
    c *= np.array([1, 1, 1, 5, 5, 5]) / (1.0 + np.arange(60)[:, None] / 6.0)
    motion = FourierMotion(LIMITS.start, 8.0, c)
    whole = expected(motion.at_rate(360.0))
    u = motion.displacement(2.0 + np.arange(1024) / 128.0)[0]
    lines = np.fft.rfft(u, axis=0)[1:120] / 512.0
    found = response_at(2.0 * np.pi * np.arange(1, 120) / 8.0)
    y = np.einsum('nfij,fj->nfi', found.changes, lines).reshape(8, -1)
    linear = 0.5 * 360.0 * 8.0 * np.real(y.conj() @ y.T) + 360.0 * 10.0 * found.constant
    assert_allclose(standard_errors(linear), whole / TRUTH, rtol=0.05)


def test_motion_agrees_with_its_derivatives():
    rng = np.random.default_rng(1)
    c = 0.01 * (rng.standard_normal((10, 6)) + 1j * rng.standard_normal((10, 6)))
    motion = FourierMotion(Pose(np.ones(3), exp_so3([0.1, 0.2, 0.3])), 5.0, c)
    t, h = np.linspace(0.0, 7.0, 200), 1e-6
    o, v, R, w = motion.state(t)
    (o0, _, R0, _), (o1, _, R1, _) = motion.state(t - h), motion.state(t + h)
    assert_allclose((o1 - o0) / (2 * h), v, atol=1e-6)
    W = np.einsum('nji,njk->nik', R, R1 - R0) / (2 * h)
    assert_allclose(oracle.vee(W), w, atol=1e-6)


def test_a_start_outside_of_the_workspace_is_refused():
    with pytest.raises(BellowsError, match='workspace'):
        limits_from(CONTENT | {'start': {'position': [9.0, 0.0, 0.0]}}, 1.5)


def test_impossible_values_are_reported():
    weak = (10.0, 0.03, 0.5)  # does not hold the package's weight
    with pytest.raises(BellowsError):
        motion_design._within(
            FourierMotion(LIMITS.start, 4.0, np.full((2, 6), 1e-3 + 0j)),
            Checks(LIMITS, [model_of(TRUTH)], weak))
