"""Output error finds cups from any sensor, with honest errors, and knows what moved them."""

from dataclasses import replace

from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3, transform
from bellows_ros.core.identification import residuals
from bellows_ros.core.identification.estimate import (
    damped_step,
    evaluated,
    measured_courses,
    minimise,
    renewed,
)
from bellows_ros.core.identification.fitting import OFF, output_error
from bellows_ros.core.identification.segments import Segment
from bellows_ros.core.identification.unknowns import KINDS, Problem, weak_prior
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Cup, varied
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.recording import BodyNoise
from bellows_ros.core.sensors import body as tracked
from bellows_ros.core.sensors.corners import Tag, TagViews
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.savgol import correlated
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError, UndeterminedError, UnstableError
from benchmarks import rubber
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import GRAVITY, PLATE
from ...cell.motion import Shake
from ...cell.sensors import noisy, with_errors

TRUTH = Cup.thesis()
AXISYMMETRIC = STRUCTURES['axisymmetric']
ROBOT, CAMERA, CAPTURE = (2e-5, 5e-5), (1e-3, 5e-3), (3e-4, 1e-3)
NUMBERS = AXISYMMETRIC.parameters(TRUTH.stiffness, TRUTH.damping)


def measured(
    seed, tool_noise=ROBOT, package_noise=CAMERA, tool_hz=250.0, package_hz=30.0, duration=12.0,
    late_ns=0, silent=False, cup=TRUTH, exposed=0,
):
    """Return a simulated recording, its package's stamps between those of the tool."""
    truth = Shake(seed).trajectory(duration + 0.1, 500.0)
    body, rng = simulate(cup, PLATE, truth, gravity=GRAVITY), np.random.default_rng(100 + seed)
    if exposed:  # for that number of samples of 2 ms before and after each
        near = np.clip(np.add.outer(np.arange(len(body)), np.arange(-exposed, exposed + 1)),
                       0, len(body) - 1)
        turns = log_so3(np.swapaxes(body.rotation, 1, 2)[:, None] @ body.rotation[near])
        body = Trajectory(body.stamps_ns, body.position[near].mean(axis=1),
                          body.rotation @ exp_so3(turns.mean(axis=1)))

    def at(poses, rate, offset_ns, noise):
        stamps = offset_ns + np.rint(np.arange(int(duration * rate)) * 1e9 / rate).astype(np.int64)
        return noisy(rng, resample(poses, stamps), (0.0 if silent else 1.0) * np.array(noise))

    tool = at(truth, tool_hz, 0, tool_noise)
    package = at(body, package_hz, 0 if tool_hz == package_hz else 1_300_000, package_noise)
    package = Trajectory(package.stamps_ns - late_ns, package.position, package.rotation)
    return Segment(tool, package, PLATE, GRAVITY, BodyNoise(np.repeat(tool_noise, 3)),
                   BodyNoise(np.repeat(package_noise, 3)))


def scaled(factor):
    """Return the true cup, K and P times a factor."""
    return Cup(factor * TRUTH.stiffness, factor * TRUTH.damping, TRUTH.length)


def posed(own, cup=TRUTH, free=None, **more):
    """Return the problem of one recording."""
    return Problem.of([own], AXISYMMETRIC, cup, free or {}, **more)


def z_of(fit):
    """Return the errors (8,) in standard errors, 0 where it is not identifiable."""
    return (fit.parameters - NUMBERS) / np.sqrt(np.diag(fit.covariance))


@pytest.mark.stress
def test_held_out_parameters_are_nearly_those_of_the_first_four_fifths():
    """Of a cup that becomes softer by 3 % before the last fifth."""
    own, softer = (measured(23, package_noise=CAPTURE, package_hz=100.0, duration=10.0, cup=cup)
                   for cup in (TRUTH, scaled(0.97)))
    poses = own.package
    early = poses.stamps_ns < poses.stamps_ns[0] + 8_000_000_000
    mixed = replace(
        poses, position=np.where(early[:, None], poses.position, softer.package.position),
        rotation=np.where(early[:, None, None], poses.rotation, softer.package.rotation))
    whole, first = (output_error([replace(own, package=package)], AXISYMMETRIC, TRUTH)
                    for package in (mixed, poses.select(early)))
    std = np.sqrt(np.diag(first.covariance))
    held_out, moved = (np.linalg.norm((end - first.parameters) / std)
                       for end in (whole.held_out, whole.parameters))
    assert moved > 10.0 and held_out < 0.3 * moved


def test_a_step_to_a_negative_cup_length_is_rejected():
    """Of poses 6 cm above the true ones, which a free length would explain."""
    own = measured(3, duration=6.0, package_hz=60.0)
    higher = replace(own.package, position=own.package.position + [0.0, 0.0, 0.06])
    problem = posed(replace(own, package=higher), free=weak_prior(['length']))
    length = problem.reported(minimise(problem).theta)[-1]
    assert -TRUTH.length < length < -0.02


@pytest.mark.parametrize('damping', [1e5, 1e8])
def test_a_cup_with_which_a_package_would_need_endless_steps_is_no_cup(damping):
    """As a wrong recording leads to: its simulation would take minutes."""
    damped = replace(TRUTH, damping=TRUTH.damping * (damping / TRUTH.damping[2, 2]))
    problem = posed(measured(3, duration=2.0), damped)
    with pytest.raises(BellowsError, match='package.mass'):
        evaluated(problem, problem.start, measured_courses(problem))


def test_the_steps_of_a_fit_shift_its_poses_by_less_than_a_hundredth_of_their_noise(monkeypatch):
    problem = posed(measured(
        3, duration=4.0, tool_hz=100.0, package_hz=50.0, package_noise=(1e-4, 5e-4)))
    parts, step = [], residuals.model_step
    for ratio in (0.1, 1.0, 2.0):
        monkeypatch.setattr(residuals, 'model_step', lambda *own, by=ratio: by * step(*own))
        parts.append(settled(problem, 1).innovations)
    fine, used, coarser = parts
    assert np.abs(used - fine).max() < 0.01 < np.abs(coarser - fine).max()


def test_a_simulation_that_diverges_is_refused():
    """As of a package on top of a soft cup."""
    upside_down = posed(replace(measured(3, duration=3.0), gravity=-GRAVITY), scaled(0.01))
    with pytest.raises(UnstableError, match='diverges'):
        evaluated(upside_down, upside_down.start, measured_courses(upside_down))


@pytest.mark.parametrize('package_hz', [30.0, 250.0])
@pytest.mark.parametrize('factor', [1 / 40, 1 / 7, 5.0, 30.0])
def test_a_cup_is_found_from_any_stiffness_of_the_start(factor, package_hz):
    """The nearest minimum from these starts is none of the true cup."""
    own = measured(3, package_hz=package_hz)
    found = minimise(posed(own, scaled(factor)))
    assert found.converged
    assert_allclose(np.diag(found.cup.stiffness), np.diag(TRUTH.stiffness), rtol=0.05)


def settled(problem, steps=3):
    """Return the part after steps: about the measured path, then about the likeliest."""
    courses = measured_courses(problem)
    for _ in range(steps):
        found = evaluated(problem, problem.start, courses)
        courses, _ = renewed(found)
    return found.parts.pool.results(tuple, found.parts)[0][0]


def require_white(part):
    """Check that differences are white and of unit variance."""
    white = part.innovations[20:]
    within = 4.5 / np.sqrt(len(white))
    assert_allclose(np.mean(white**2, axis=0), 1.0, atol=1.5 * within)
    for lag in (1, 2, 5, 20):
        assert np.all(np.abs(np.mean(white[lag:] * white[:-lag], axis=0)) < within)


@pytest.mark.parametrize('is_tag', [False, True])
def test_every_derivative_is_that_of_the_differences(is_tag):
    """Of steps that change them by their noise at most, and the logarithms of K and P by 1 %."""
    cup = replace(TRUTH, relaxation=(0.2, 0.15))
    own = measured(4, package_noise=(1e-4, 5e-4), tool_hz=125.0, duration=4.0, silent=True,
                   cup=cup)
    own = seen_as_tag(own) if is_tag else own
    problem = posed(own, cup, {
        name: np.full(kind.size, kind.prior_std) for name, kind in KINDS.items()
        if name != 'tool_marker'}, slip_ns=2_000_000_000)
    courses = measured_courses(problem)
    at = evaluated(problem, problem.start, courses)
    for number in range(len(problem.units)):
        size = np.sqrt(at.information.shared[number, number]) if number < problem.shared else (
            np.sqrt(at.information.own[0, number - problem.shared, number - problem.shared]))
        step = np.eye(len(problem.units))[number] / max(size, 100.0 * (number < problem.count))
        moved = evaluated(problem, problem.start + step, courses)
        expected = at.information.times(step)
        assert_allclose(  # the weights of views follow their smear by the motion
            at.slope - moved.slope, expected, atol=(0.2 if is_tag else 0.1) * np.abs(
                expected).max(), err_msg=f'{number}')


@pytest.mark.parametrize(('tool_noise', 'package_noise'), [
    (CAPTURE, CAPTURE), ((1e-7, 1e-6), CAPTURE)])
def test_differences_of_the_truth_are_white_and_of_unit_variance(tool_noise, package_noise):
    own = measured(3, tool_noise, package_noise, package_hz=250.0)
    require_white(settled(posed(own)))


def test_the_likeliest_path_takes_nothing_from_the_step_to_the_unknowns():
    """Of a cup that moves much, so that its response is not that of its rest."""
    problem = posed(measured(5, CAPTURE, CAPTURE, 120.0, 120.0))
    start = evaluated(problem, problem.start, measured_courses(problem))
    stds = np.sqrt(start.information.variances)

    def step_from(theta):
        at = evaluated(problem, theta, measured_courses(problem))
        for _ in range(6):
            at = evaluated(problem, theta, renewed(at)[0])
        return at.information.solve(at.slope)

    for number, std in enumerate(stds):
        change = std * np.eye(len(stds))[number]
        ahead, back = (step_from(problem.start + sign * change)[number] for sign in (1.0, -1.0))
        assert -1.4 < (ahead - back) / (2.0 * std) < -0.7, number  # -0.3 with a cup at rest


def seen_as_tag(own):
    """Return a recording with the corners of a tag of 80 mm, 1.2 m from a camera."""
    camera = transform(exp_so3(np.array([0.0, -0.5 * np.pi, 0.0])), own.package.position.mean(
        axis=0) + [1.2, 0.02, 0.05])
    tag = transform(exp_so3(np.array([0.2, 0.5 * np.pi, 0.4])), [0.1, 0.02, -0.01])
    poses = PoseStream('tag', 'world', own.package.stamps_ns, own.package.position + apply(
        own.package.rotation, tag[:3, 3]), own.package.rotation @ tag[:3, :3])
    return replace(own, views=TagViews.of(Tag(0.08, T_world_camera=camera), poses, tag))


STILL = (
    [5], [0, 1, 3, 4, 5], [1, 2, 3, 4, 5], [0, 1, 2, 5], [2], [], [0, 1, 2, 3, 4], [0, 1, 3, 4])
"""Axes of the tool that do not move in weak recordings."""


def weak(seed, duration=12.0):
    """Return a recording by motion capture with little motion, and the true numbers (8,)."""
    rng, still = np.random.default_rng((seed, 77)), STILL[seed % 8]
    scale = np.sqrt(np.exp(rng.uniform(-0.5, 0.5, (2, 4))))[:, [0, 0, 1, 2, 2, 3]]
    cup = Cup(*(s[:, None] * M * s for s, M in zip(
        scale, (TRUTH.stiffness, TRUTH.damping), strict=True)), TRUTH.length)
    shake = Shake(seed)
    shake.a[:, still] = 0.0
    shake.a *= 1.0 if still else 0.1
    tool = shake.trajectory(duration + 0.1, 500.0)
    stamps = np.rint(np.arange(int(120.0 * duration)) * 1e9 / 120.0).astype(np.int64)
    poses = [noisy(rng, resample(each, stamps), np.array(CAPTURE)) for each in (
        tool, simulate(cup, PLATE, tool, gravity=GRAVITY))]
    return Segment(*poses, PLATE, GRAVITY, *[BodyNoise(np.repeat(CAPTURE, 3))] * 2), (
        AXISYMMETRIC.parameters(cup.stiffness, cup.damping))


def weak_errors(seeds, duration=12.0):
    """Return errors of K (n, 4), and standard errors (n, 8) relative to the numbers."""
    errors, std = [], []
    for seed in seeds:
        own, true = weak(seed, duration)
        fit = output_error([own], AXISYMMETRIC, TRUTH, given={
            'length': np.array([1e-3]), 'com': np.full(3, 2e-3), 'mass': np.array([0.01]),
            'inertia': np.full(3, 0.05), 'package_marker': np.full(6, 1e-3)})
        std.append(np.sqrt(np.diag(fit.covariance)) / fit.parameters)
        errors.append((1.0 - true / fit.parameters)[:4])
    return np.array(errors), np.array(std)


@pytest.mark.stress
def test_stiffness_of_weak_recordings_is_within_five_standard_errors():
    """In each of 40 recordings; in two of them it was not, with K rz off by 117 and 309 %."""
    errors, std = weak_errors(range(324, 364))
    assert np.all(np.abs(errors) < 5.0 * std[:, :4])
    assert np.mean(np.isfinite(std[:, :4])) > 0.4


def test_a_robot_and_a_camera_are_enough_from_a_start_far_off():
    own = measured(5, tool_hz=125.0)
    far, near = (output_error([own], AXISYMMETRIC, scaled(k)) for k in (2.0, 1.0))
    assert far.converged
    known = np.isfinite(np.diag(far.covariance))
    assert known[:4].all()  # all of K
    std = np.sqrt(np.diag(far.covariance))
    assert np.all(np.abs(far.parameters - near.parameters)[known] < 0.15 * std[known])
    assert np.all(np.abs(z_of(far)) < 4.0)
    assert 0.9 < far.chi2 < 1.1


def with_memory(own, kept, std, rng):
    """Return a recording without noise with noise that is kept in part from pose to pose."""
    poses = []
    for body in (own.tool, own.package):
        e = rng.standard_normal((len(body), 6))
        for k in range(1, len(e)):
            e[k] = kept * e[k - 1] + np.sqrt(1.0 - kept**2) * e[k]
        e *= np.repeat(std, 3)
        poses.append(with_errors(body, e))
    noise = BodyNoise(np.repeat(std, 3), kept)
    return Segment(*poses, PLATE, GRAVITY, noise, noise)


def test_noise_with_memory_is_whitened():
    own = measured(3, silent=True, package_hz=250.0)
    own = with_memory(own, 0.9, CAPTURE, np.random.default_rng(3))
    require_white(settled(posed(own)))


def test_noise_of_the_tool_does_not_shake_the_simulated_package():
    # plain output error finds P 12 to 58 % too large here
    z = np.array([z_of(output_error(
        [measured(seed, CAPTURE, CAPTURE, package_hz=250.0, duration=8.0)],
        AXISYMMETRIC, scaled(1.5)))
        for seed in range(2)])
    assert np.all(np.abs(z) < 4.0)
    assert np.all(np.abs(z.mean(axis=0)) < 2.8)


def test_noise_of_slow_poses_is_learned_beside_noise_of_the_tool():
    """A robot as noisy as the camera, whose noise else seems to vanish as its path is renewed."""
    fits = [output_error([measured(seed, CAPTURE, CAPTURE)], AXISYMMETRIC, scaled(1.5))
            for seed in range(2)]
    assert all(fit.converged for fit in fits)
    assert np.all(np.abs([z_of(fit)[:4] for fit in fits]) < 3.0)


def test_gaps_and_outliers_are_bridged():
    own = measured(9)
    position, R = own.package.position.copy(), own.package.rotation.copy()
    position[40::37] += 0.05
    R[50::41] = R[50::41] @ exp_so3(np.array([0.3, 0.0, 0.0]))
    seen = (np.arange(len(R)) < 150) | (np.arange(len(R)) > 190)
    package = Trajectory(own.package.stamps_ns, position, R).select(seen)
    fit = output_error([Segment(
        own.tool, package, PLATE, GRAVITY, own.tool_noise, own.package_noise)],
        AXISYMMETRIC, scaled(1.5))
    assert fit.converged
    assert np.all(np.abs(z_of(fit)) < 4.5)


@pytest.mark.parametrize('gaps', [(3, 12, 29), (40, 20, 7)])
def test_gaps_of_a_noisy_tool_are_no_misfit(gaps):
    """Whose bridges by the twists of five poses shook the package, at a chi² of 1.2."""
    own = measured(15, (1e-4, 5e-4), (1e-4, 5e-4), 360.0, 360.0, 10.0)
    valid = np.ones(len(own.tool), dtype=bool)
    for first, count in zip((900, 1900, 2800), gaps, strict=True):
        valid[first:first + count] = False
    whole, lost = (posed(each) for each in (
        own, replace(own, tool=replace(own.tool, valid=valid))))
    without, with_gaps = (
        evaluated(each, each.start, measured_courses(each)).chi2 for each in (whole, lost))
    assert with_gaps < 1.04 * without


def test_a_smooth_path_is_nearer_to_the_motion_than_the_measured_one():
    noise = (3e-4, 1e-3)
    own, exact = (measured(4, each, CAMERA, 120.0, 30.0, 10.0) for each in (noise, (1e-6, 1e-6)))
    rows = own.smooth(own.rows)
    twists = resample(simulation.trajectory_of(exact.rows_ns, exact.rows), own.rows_ns).twist
    inner = slice(50, -50)
    measured_error, smooth_error = (
        np.std((each[:, 7:] - twists)[inner], axis=0) for each in (own.rows, rows))
    assert np.all(smooth_error < 0.7 * measured_error)


def test_unknowns_follow_those_that_stop_at_the_largest_step():
    """From a K x of a sixteenth, with com and length wrong; the others' slope is then zero."""
    own = measured(16, (2e-4, 1e-3), (2e-4, 1e-3), 240.0, 240.0, 10.0)
    wrong = replace(own, payload=varied(PLATE, com=np.array([0.0024, -2e-4, 0.001])))
    K, P = np.diag(TRUTH.stiffness).copy(), np.diag(TRUTH.damping).copy()
    K[:3] *= [0.06, 0.06, 0.33]
    P[:3] *= [4.0, 4.0, 0.5]
    remote = Cup(np.diag(K), np.diag(P), TRUTH.length - 5e-4)
    stds = {'com': np.full(3, 2e-3), 'length': np.array([1e-3]), 'mass': np.array([0.01]),
            'package_marker': np.repeat([1e-3, 5e-3], 3), 'time_offset': np.array([1e-3])}
    problem = posed(wrong, remote, stds)
    at = evaluated(problem, problem.start, measured_courses(problem))
    step = damped_step(at, at.information, at.slope, np.ones(len(at.theta), dtype=bool))
    stopped = np.abs(step) >= 0.999 * problem.max_step
    assert np.all(np.abs(step) <= problem.max_step) and stopped.any() and not stopped.all()
    left = at.slope - at.information.times(step)
    assert np.abs(left[~stopped]).max() < 1e-6 * np.abs(at.slope).max()
    found = output_error([wrong], AXISYMMETRIC, remote, given=stds)
    std = np.sqrt(np.diag(found.covariance + found.from_given))[:4]
    assert found.converged and not found.causes
    assert np.all(np.abs(found.parameters - NUMBERS)[:4] < 4.0 * std)
    assert np.all(np.abs(found.nuisances['com']) < 5e-3)


def test_a_wrong_number_is_named_with_its_size_and_a_sound_recording_is_not_accused():
    own = measured(11, package_noise=(1e-4, 5e-4), tool_noise=ROBOT, tool_hz=125.0)
    assert not output_error([own], AXISYMMETRIC, TRUTH).causes
    wrong = replace(PLATE, com=PLATE.com + [0.003, 0.0, 0.0])
    fit = output_error([replace(own, payload=wrong)], AXISYMMETRIC, TRUTH)
    cause = next(own for own in fit.causes if own.name != 'unknown')
    assert cause.name in ('com', 'package_marker')
    moved = {'com': -1.0, 'package_marker': 1.0}[cause.name] * cause.theta[0]
    assert_allclose(moved, 0.003, atol=1e-3)


@pytest.mark.parametrize('seed', [1, 2])
def test_a_long_exposure_is_named_with_its_size(seed):
    """Without which K z is 15 to 55 % off, at a chi² of noise alone."""
    own = measured(seed, ROBOT, (1e-4, 5e-4), exposed=7)
    cause = output_error([own], AXISYMMETRIC, TRUTH).causes[0]
    assert cause.name == 'exposure' and cause.certain
    assert_allclose(tracked.EXPOSURE * cause.theta[0]**0.5, 0.029, atol=0.003)


@pytest.mark.parametrize('has_tails', [False, True])
def test_noise_of_slow_poses_with_a_memory_is_learned(has_tails):
    """From one that is stated half as large or four times, from a start far off."""
    own, rng = measured(2, tool_hz=100.0, duration=8.0, silent=True), np.random.default_rng(0)
    size, kept = (len(own.package), 6), float(np.exp(-1.0 / 3.0))
    new = rng.standard_t(3, size) if has_tails else rng.standard_normal(size)
    noise = np.repeat(CAMERA, 3) * correlated(new, kept)
    seen, stated = with_errors(own.package, noise), np.repeat(CAMERA, 3) * [1, 0.5, 1, 1, 1, 4]
    found = minimise(posed(
        replace(own, package=seen, package_noise=BodyNoise(stated, kept)), scaled(2.0)))
    assert found.converged
    if not has_tails:  # else its median is that of a smaller one
        ((course,),) = found.courses.pool.results(tuple, found.courses)
        assert_allclose(course.std, np.repeat(CAMERA, 3), rtol=0.12)


def test_rubber_that_relaxes_is_found_with_its_static_stiffness():
    soft = replace(TRUTH, relaxation=(0.15, 0.16))
    fit = output_error(
        [measured(12, cup=soft)], AXISYMMETRIC, scaled(1.5), law={**OFF, 'relaxation': 'auto'})
    off = np.abs(np.subtract(fit.law['relaxation'], soft.relaxation))
    assert np.all(off < 4.0 * np.array(fit.law_std['relaxation']))
    assert max(fit.law_std['relaxation']) < 0.1
    assert np.all(np.abs(z_of(fit)) < 4.0)


@pytest.mark.stress
def test_rubber_without_whose_relaxation_the_search_goes_astray():
    fit = rubber.identified(rubber.recorded(0.3, 1, rubber.multisine(1), 30.0), 'auto')
    assert fit.converged
    assert rubber.error(fit, 0.3, *rubber.VALIDATIONS['hold of 20 degrees, 7 s']) < 0.02


@pytest.mark.stress
def test_a_kelvin_voigt_cup_shows_no_relaxation():
    own = measured(13, package_noise=(1e-4, 5e-4), tool_hz=125.0)  # benchmarks.rubber has 40
    with pytest.raises(UndeterminedError, match='fit.relaxation'):
        output_error([own], AXISYMMETRIC, TRUTH, law={**OFF, 'relaxation': 'on'})
