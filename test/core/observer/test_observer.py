"""Correct a package whose true motion is known."""

from bellows_ros.core.geometry.tuples import quaternion_product
from bellows_ros.core.live import Predictor
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import largest_step, moved_by, pose_error, substeps_for
from bellows_ros.core.model.kernels import advance, ORIGIN
from bellows_ros.core.observer.dynamics import DIFFERENCE
from bellows_ros.core.observer.filter import JITTER, SHARE
from bellows_ros.core.observer.measurement import at_com
from bellows_ros.core.observer.pose_sensor import MAX_VARIANCE
from bellows_ros.core.observer.states import (
    COM,
    DAMPING,
    MASS,
    priors_of,
    SAME_PACKAGE,
    STIFFNESS,
    WRENCH,
)
from bellows_ros.report.findings import text
import numpy as np
import pytest
from scipy.stats import chi2

from .cases import (
    at_once,
    Cell,
    CUP,
    error_of,
    follow,
    gripper_of,
    HEAVY,
    later,
    measured,
    NOISE,
    observer,
    OF_GRIPPER,
    PACKAGE,
    PERIOD_NS,
    tool_motion,
    truth,
    values,
    with_noise,
)


def scene(seed, seconds=2.0, every=8):
    """Give stamps, the tool, the package, and its measured poses by sample."""
    rng = np.random.default_rng(seed)
    stamps, tool = tool_motion(rng, seconds)
    body = truth(tool)
    return stamps, tool, body, {
        k: with_noise(rng, body[k], NOISE) for k in range(every, len(tool), every)}


def shifted(pose, *by):
    """Give a pose that is off by a shift (m) and a turn (rad) in its own axes."""
    return moved_by(pose, np.concatenate([by, np.zeros(12 - len(by))]))


def assert_same(made, other):
    """
    Compare estimates in standard deviations, up to the rounding of compiled copies of a kernel.

    Slopes are differences over 1e-6, which multiply a rounding of 2e-16 by 1e6. Those of 1,000
    steps add up at random; four standard deviations of their sum are allowed.
    """
    (one, P), (two, Q) = ((each, each.covariance) for each in (made, other))
    std = np.sqrt(np.diag(Q))
    unit = np.where(std > 0.0, std, 1.0)
    change = np.r_[error_of(one.body, two.body), one.theta - two.theta]
    limit = 4.0 * 1000.0 ** 0.5 * np.finfo(float).eps / DIFFERENCE
    np.testing.assert_allclose(change / unit, 0.0, atol=limit)
    np.testing.assert_allclose(
        (P - Q) / np.outer(unit, unit), 0.0, atol=limit)


def put_down():
    """Give stamps and states of a tool that lifts by 0.1 m, and stops on its way down."""
    t = np.arange(0.0, 2.2, PERIOD_NS * 1e-9)
    way = [np.clip((t - begin) / 0.6, 0.0, 1.0) for begin in (0.1, 0.9)]
    height, speed = (0.1 * f(way[0]) - 0.08 * f(way[1]) for f in (
        lambda s: s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
        lambda s: 30.0 * s**2 * (1.0 - s)**2 / 0.6))
    return np.arange(len(t)) * PERIOD_NS + 1_000_000_000, [
        ((0.0, 0.0, z), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, v), (0.0, 0.0, 0.0))
        for z, v in zip(height.tolist(), speed.tolist(), strict=True)]


def test_any_order_of_arrival_ends_with_the_same_estimate():
    """Let poses come before the tool's, late, twice and shuffled, also at a stop of the tool."""
    stamps, tool = put_down()
    body, orders, ends = truth(tool), [None, *range(20)], []
    rng = np.random.default_rng(1)
    seen = {k: with_noise(rng, body[k], NOISE) for k in range(8, len(tool) - 8, 8)}
    for seed in orders:
        rng, came = np.random.default_rng([2, seed or 0]), {}
        for k, pose in seen.items():
            late = [0] if seed is None else rng.integers(
                -12, 100, 1 + (rng.random() < 0.2)).tolist()
            for by in late:
                came.setdefault(min(max(k + by, 1), len(tool) - 1), []).append((stamps[k], pose))
        made = observer(payload__estimate=True)
        made.grip()
        follow(made, stamps, tool, body[0], came)
        assert made.counts['used'] + made.counts['outlier'] == len(seen)
        assert made._support.is_near
        ends.append(made)
    for end in ends[1:]:
        assert_same(end.estimate, ends[0].estimate)


def test_delay_and_publishing_leave_the_estimate():
    """Begin with the same uncertainty with a pose at once or 0.2 s late, published or not."""
    stamps, tool, body, seen = scene(9, seconds=1.2)
    ends = []
    for delay, publishes in ((0, False), (50, False), (50, True), (0, True)):
        live = Predictor(CUP, PACKAGE, 9.81, 'tool')
        live.expect_twists(True)
        for k, (stamp_ns, (position, q, linear, angular)) in enumerate(
                zip(stamps.tolist(), tool, strict=True)):
            live.on_twist(stamp_ns, linear, angular)
            live.on_pose(stamp_ns, 'world', position, q)
            if publishes:
                live.covariance(stamp_ns)
            if pose := seen.get(k - delay):
                live.on_measured(int(stamps[k - delay]), 'world', *pose[:2])
        made = live.package.observer
        assert made.counts['late'] == 0
        ends.append({each.stamp_ns: each for each in made._estimates})
    last = max(set.intersection(*map(set, ends)))
    for end in ends[1:]:
        assert_same(end[last], ends[0][last])


def test_start_errs_by_the_errors_of_the_parameters():
    """Displace the equilibrium of a hanging package as other parameters do, with their rows."""
    made, (body,) = observer(payload__estimate=True), truth([ORIGIN])
    made.start(1, ORIGIN, body)
    made.settle(lambda stamp_ns: np.full(12, 1e-9))
    made._begin_estimates()
    P, std = made._estimates[0].covariance, made._correction.prior
    for row, by in ((COM, 1e-4), (COM + 1, 1e-4), (STIFFNESS + 2, 1e-3), (MASS, 1e-3)):
        factor = np.exp(by) if row in (MASS, STIFFNESS + 2) else 1.0
        stiffness = CUP.stiffness.copy()
        stiffness[2, 2] *= factor if row == STIFFNESS + 2 else 1.0
        m = factor if row == MASS else 1.0
        com = PACKAGE.com + (by * np.eye(3)[row - COM] if COM <= row < COM + 3 else 0.0)
        other = truth([ORIGIN], Package(m * PACKAGE.mass, m * PACKAGE.inertia, com),
                      Cup(stiffness, CUP.damping, CUP.length))[0]
        np.testing.assert_allclose(
            P[:6, row] / std[row]**2, error_of(body, other)[:6] / by, rtol=0.02, atol=5e-4)


def test_prediction_without_measured_poses_is_unchanged():
    """Predict bit for bit what the model alone does, observed or not, until something is seen."""
    stamps, tool, body, _ = scene(8, seconds=0.3)
    alone, watched = (Predictor(CUP, PACKAGE, 9.81, 'tool') for _ in range(2))
    watched.package.observer.has_sensor = True
    model, states = model_tuple(CUP, PACKAGE, 9.81), []
    for stamp_ns, (position, q, linear, angular) in zip(stamps.tolist(), tool, strict=True):
        for live in (alone, watched):
            live.expect_twists(True)
            live.on_twist(stamp_ns, linear, angular)
            states += live.on_pose(stamp_ns, 'world', position, q)
    true = states[0].body
    for before, after in zip(states[::2], states[2::2], strict=False):
        steps = substeps_for(PERIOD_NS * 1e-9, largest_step(model))
        true = advance(model, true, before.tool, after.tool, PERIOD_NS * 1e-9, steps)
        np.testing.assert_allclose(
            np.concatenate(after.body), np.concatenate(true), rtol=1e-9)
    for without, observed in zip(states[::2], states[1::2], strict=True):
        np.testing.assert_allclose(
            np.concatenate(observed[1:7]), np.concatenate(without[1:7]), rtol=1e-9, atol=1e-12)


def test_between_samples_and_ahead_of_the_tool():
    """Take measurements between two poses of the tool before and after the later one comes."""
    stamps, tool, body, seen = scene(2)
    made, other = observer(), observer()
    between = {k: [(stamps[k] - 1_234_567, pose)] for k, pose in seen.items()}
    follow(made, stamps, tool, body[0], {}, before=lambda k: [
        made.update(measured(made, *one)) for one in between.get(k, [])])
    follow(other, stamps, tool, body[0], between)
    assert_same(made.estimate, other.estimate)
    assert made.counts['used'] == len(between)


@pytest.mark.parametrize('tool_noise', [(0.0, 0.0), (5e-4, 2e-3)])
@pytest.mark.parametrize('runs', [20, pytest.param(100, marks=pytest.mark.stress)])
def test_error_agrees_with_the_covariance(runs, tool_noise):
    """Keep the mean of many runs' normalised squared errors within its 95 % band."""
    total = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        stamps, tool = tool_motion(rng, 0.4)
        made = observer(tool_noise=tool_noise)
        made._known.memory[SHARE] = 0.0  # the model is exact
        made.start(int(stamps[0]), tool[0], truth(tool[:1])[0])
        std = np.sqrt(np.diag(made.estimate.covariance))
        body = [moved_by(made.estimate.body, rng.normal(size=12) * std[:12])]
        walk = made._correction._walk[WRENCH:WRENCH + 6]
        theta = rng.normal(size=10) * std[12:22]
        for k in range(1, len(tool)):
            body.append(later(body[-1], theta, tool[k - 1], tool[k], 0.004))
            theta[4:] += rng.normal(size=6) * np.sqrt(0.004 * walk)
        seen, noise = {}, rng.normal(size=6)
        for k in range(8, len(tool), 8):  # with the memory that is expected at the beginning
            noise = 0.5 * noise + np.sqrt(0.75) * rng.normal(size=6)
            seen[k] = moved_by(body[k], np.r_[noise * NOISE, np.zeros(6)])
        tool = [with_noise(rng, state, np.repeat(tool_noise, 3)) for state in tool]
        follow(made, stamps, tool, None, at_once(stamps, seen))
        error = error_of(made.body, body[-1])
        total.append(error @ np.linalg.solve(made.estimate.covariance[:12, :12], error))
    low, high = chi2.ppf([0.025, 0.975], 12 * len(total)) / len(total)
    assert low < np.mean(total) < high


def test_outliers_are_left_out():
    """Refuse every fifth pose, which is wild."""
    stamps, tool, body, seen = scene(3)
    wild = list(seen)[5::5]
    for k in wild:
        seen[k] = shifted(seen[k], 0.05, -0.04, 0.03, 0.4, 0.0, 0.3)
    made = observer()
    follow(made, stamps, tool, body[0], at_once(stamps, seen))
    assert made.counts['outlier'] + made.counts['out_of_reach'] == len(wild)
    assert made.counts['used'] == len(seen) - len(wild)
    assert np.linalg.norm(error_of(made.body, body[-1])[:3]) < 5e-4


def test_wrong_gate_opens_again():
    """Go where the poses are when they stay elsewhere, after some of them."""
    stamps, tool, body, seen = scene(3)
    made, worst = observer(alarm__false_per_hour=0.0), []
    seen = {k: shifted(pose, 0.0, 0.0, 0.0, 0.3) if k >= 240 else pose
            for k, pose in seen.items()}
    follow(made, stamps, tool, body[0], at_once(stamps, seen), after=lambda k: worst.append(
        error_of(made.body, body[k])[3]))
    assert made.counts['recovered'] >= 1
    assert made.counts['outlier'] >= 4
    assert max(np.abs(worst[:230])) < 0.05 < 0.1 < max(np.abs(worst[270:]))


def test_what_cannot_be_used_is_counted():
    """Say why, and go on."""
    stamps, tool, body, seen = scene(4, seconds=0.8)
    made, first = observer(), seen[8]
    assert made.update(measured(made, stamps[3], seen[16])) == 'not_held'
    follow(made, stamps, tool, body[0], at_once(stamps, seen))
    before = made.estimate
    assert made.update(measured(made, stamps[-1] + 600_000_000, first)) == 'future_stamp'
    assert made.update(measured(made, stamps[1], seen[16])) == 'late'
    assert made.update(measured(made, stamps[192], first)) == 'duplicate_stamp'
    assert made.sensor.measurement(int(stamps[191]), *first[:2]) == 'repeated'
    assert made.update(measured(made, stamps[190], shifted(first, 1.0))) == ''
    assert_same(made.estimate, before)
    wrong = {name: made.counts[name] for name in (
        'not_held', 'future_stamp', 'late', 'duplicate_stamp', 'out_of_reach')}
    assert wrong == dict.fromkeys(wrong, 1)


def test_poses_and_covariances_that_are_none():
    """Say what is wrong with them; all zeros mean that nothing is known."""
    sight, unit = observer().sensor, (0.0, 0.0, 0.0, 1.0)
    here = (0.1, 0.2, 0.3)
    assert sight.measurement(1, (np.nan, 0.0, 0.0), unit) == 'nan'
    assert sight.measurement(1, here, (0.0, 0.0, 0.0, 0.0)) == 'zero_quaternion'
    assert sight.measurement(1, here, (0.0, 0.0, 0.0, 2.0)) == 'not_unit'
    assert sight.measurement(0, here, unit) == 'zero_stamp'
    for wrong in (np.full((6, 6), np.nan), -np.eye(6), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]),
                  np.full((6, 6), np.inf), 1e308 * np.eye(6), np.full((6, 6), -1e308),
                  2.0 * MAX_VARIANCE * np.eye(6)):
        with np.errstate(all='raise'):
            assert sight.measurement(1, here, unit, wrong) == 'covariance'
    unknown = np.diag([1e-6, 1e-6, 1e-6, *[0.5 * MAX_VARIANCE] * 3])
    assert sight.measurement(1, here, unit, unknown).noise[5, 5] > 1e11
    zero = sight.measurement(1, (0.1, 0.2, 0.4), unit, np.zeros((6, 6)))
    np.testing.assert_array_equal(zero.noise, np.zeros((6, 6)))


def test_marker_anywhere_on_the_package_says_where_its_centre_of_mass_is():
    """Measure a marker beside the lip: its pose, and the noise as differences of it."""
    _, _, body, _ = scene(5, seconds=0.1)
    offset = np.array([0.08, -0.05, -0.02, 0.3, -0.2, 0.5])
    sight = observer(measured__frame='lip', measured__offset=offset.tolist()).sensor
    com = tuple(PACKAGE.com.tolist())
    at = shifted(shifted(body[5], *(offset[:3] - PACKAGE.com)), 0.0, 0.0, 0.0, *offset[3:])
    rng = np.random.default_rng(6)
    root = rng.normal(size=(6, 6)) * 1e-3
    seen = sight.measurement(1, at[0], at[1], root @ root.T)
    position, q, noise = at_com(*seen[1:4], sight.marker, com)
    found = (position, q, *body[5][2:])
    np.testing.assert_allclose(pose_error(found, *body[5][:2]), 0.0, atol=1e-12)
    columns = []
    for shift, turn in zip(root[:3].T * 1e-3, root[3:].T * 1e-3, strict=True):
        still = (tuple(at[0]), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        turned = quaternion_product(shifted(still, 0.0, 0.0, 0.0, *turn)[1], at[1])
        moved = sight.measurement(1, tuple((at[0] + shift).tolist()), turned)
        there = at_com(*moved[1:4], sight.marker, com)
        columns.append(np.concatenate(pose_error(found, *there[:2])) * 1e3)
    np.testing.assert_allclose(noise, np.transpose(columns) @ columns, rtol=1e-3, atol=1e-10)


@pytest.mark.parametrize('frame', [
    'com', pytest.param('lip', marks=pytest.mark.stress)])
def test_payload_is_found_in_two_seconds(frame):
    """
    Find mass and centre of mass of packages gripped three standard deviations off.

    The bound of Cramer and Rao is the covariance along the true motion, with the true payload.
    """
    errors, bounds = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stamps, tool = tool_motion(rng, 2.0)
        scale, com = 1.0 + 0.1 * rng.normal(), PACKAGE.com + 0.01 * rng.normal(size=3)
        package = Package(scale * PACKAGE.mass, scale * PACKAGE.inertia, com)
        body = truth(tool, package)
        back = com if frame == 'lip' else np.zeros(3)
        true = {k: shifted(body[k], *-back) for k in range(8, len(tool), 8)}
        seen = {k: with_noise(rng, pose, NOISE) for k, pose in true.items()}
        made, ideal = (
            observer(held, payload__estimate=True, measured__frame=frame)
            for held in (PACKAGE, package))
        follow(made, stamps, tool, truth(tool[:1])[0], at_once(stamps, seen))
        follow(ideal, stamps, tool, body[0], at_once(stamps, true))
        found, bound = made.payload, ideal.payload
        errors.append([found.mass - package.mass, *(found.com - com)])
        bounds.append([bound.mass_std, *bound.com_std])
    rms, bound = (np.sqrt(np.mean(np.square(x), axis=0)) for x in (errors, bounds))
    assert rms[0] < 1.5 * bound[0]
    assert rms[1:3].max() < 1e-3


def test_payload_is_kept_for_this_package_alone():
    """Keep what was found over a fresh start, and forget it with another package."""
    stamps, tool, body, seen = scene(7)
    made = observer(payload__estimate=True)
    follow(made, stamps, tool, body[0], at_once(stamps, seen))
    known = made.payload
    made.forget(SAME_PACKAGE)
    made.start(int(stamps[0]), tool[0], body[0])
    assert made.payload[1:5] == (*known[1:4], pytest.approx(known.mass_std))
    made.forget()
    made.start(int(stamps[0]), tool[0], body[0])
    assert made.payload.mass == PACKAGE.mass
    assert made.payload.mass_std == pytest.approx(0.05 * PACKAGE.mass)


def watched(away, vacuum, moves=True):
    """
    Let the last poses be out of reach, three be missing before one, and the vacuum be measured.

    It has whether the cup holds, after the last pose (0), the one before (-1) ...
    """
    stamps, tool, body, seen = scene(3, 1.2)
    made = observer(alarm__false_per_hour=1.0)
    samples = sorted(seen)
    heard = {samples[number - 1]: held for number, held in vacuum.items()}
    seen |= {k: shifted(seen[k], 0.0, 0.0, -0.5) for k in samples[len(seen) - away:]}
    seen = {k: seen[k] for k in samples if away != 1 or k not in samples[-4:-1]}
    follow(made, stamps, tool, body[0], at_once(stamps, seen), after=lambda k: (
        k in heard and made.on_vacuum(heard[k], not heard[k], moves)))
    return made


@pytest.mark.parametrize(('away', 'vacuum', 'moves', 'kind', 'by'), [
    (2, {}, True, 'lost', 'poses'),
    (2, {-9: True, -8: True}, True, 'lost', 'poses'),  # heard every 32 ms, then no more
    (6, {-30: True}, True, 'deviates', 'poses'),  # heard on change
    (6, {-10: True, -7: True, -4: True, -1: True}, True, 'deviates', 'poses'),
    (2, {-1: False}, False, 'lost', 'vacuum'),
    (2, {0: False}, True, 'lost', 'poses'),  # after two poses nothing new is raised
    (0, {0: False}, True, 'lost', 'vacuum'),
    (0, {0: False}, False, '', ''),  # a release
])
def test_lost_package_is_joined_with_the_vacuum(away, vacuum, moves, kind, by):
    """Add what poses out of reach and the vacuum say, as one alarm."""
    raised = [(alarm.kind, alarm.shown_by) for alarm in watched(away, vacuum, moves).alarms]
    assert raised == ([(kind, by)] if kind else [])


def test_vacuum_of_one_cup_that_breaks_down_in_motion_is_its_loss():
    """Name the cup, with what else it may be, once; not at rest, nor where it is open anyhow."""
    for moves, opened, causes in ((True, -1, [2]), (False, -1, []), (True, 2, [])):
        made = observer(HEAVY, gripper_of(CUP), **OF_GRIPPER, alarm__false_per_hour=1.0,
                        cup__open=[opened])
        tool = tool_motion(np.random.default_rng(0), 0.1)[1]
        made.start(1, tool[0], truth(tool[:1], HEAVY, gripper_of(CUP))[0])
        for held, breaks in ((True, False), (False, True), (False, True)):
            made.on_vacuum(held, breaks, moves, 2)
        assert [alarm.cup for alarm in made.alarms] == causes
    made.on_vacuum(False, True, True, 0)
    (alarm,) = made.alarms
    assert text(alarm.finding).startswith(
        'The vacuum of cup 0 of cup.layout, at x 60 mm, y 40 mm, breaks down')


@pytest.mark.parametrize(('before', 'causes'), [(-0.05, ['lost']), (0.0, [])])
def test_package_that_was_falling_is_lost_at_the_first_pose_out_of_reach(before, causes):
    """Need no second pose out of reach where the one before was outside the gate."""
    stamps, tool, body, seen = scene(3, 1.2)
    made = observer(alarm__false_per_hour=1.0)
    *_, last, away = sorted(seen)
    seen[last], seen[away] = (shifted(seen[k], 0.0, 0.0, by) for k, by in (
        (last, before), (away, -0.5)))
    follow(made, stamps, tool, body[0], at_once(stamps[:away + 1], seen))
    assert (made.counts['outlier'], made.counts['out_of_reach']) == (len(causes), 1)
    assert [alarm.kind for alarm in made.alarms] == causes


def test_one_wrong_pose_before_a_silent_camera_is_no_loss():
    """Raise no alarm on it, and take the end of the vacuum at rest for a release."""
    made = watched(1, {-30: True})
    still = made._estimates[-1].tool
    assert made.departs
    for _ in range(40):
        made.follow(made._track.newest_ns + PERIOD_NS, still, still)
    made.on_vacuum(False, True, False)
    assert (made.alarms, made.departs) == ([], False)


def test_a_cup_without_damping_in_an_axis_has_a_known_uncertainty():
    """Zero of zero is no part of it: the observer starts with finite standard deviations."""
    P = CUP.damping.copy()
    P[0, 0] = 0.0
    model = model_tuple(Cup(CUP.stiffness, P, CUP.length), PACKAGE, 9.81)
    assert np.isfinite(priors_of(values(), model).std).all()
    found = priors_of(values(cup__damping_std=np.eye(6).ravel().tolist()), model).std
    assert np.isfinite(found).all() and found[DAMPING] == 1.0


@pytest.mark.parametrize('jitter', [1e-4, 5e-3, 1e-2])
def test_the_jitter_of_stamps_is_estimated(jitter):
    """From 2 ms, assumed at first: within half and twice the true one, or below 0.5 ms."""
    rng = np.random.default_rng(3)
    stamps, tool = tool_motion(rng, 12.0, size=0.15)
    body, std = truth(tool), np.repeat([3e-4, 2e-3], 3)
    made = observer(measured__noise=std[[0, 3]].tolist())
    came = {}
    for k in range(20, len(tool) - 20, 8):
        late = np.r_[jitter * rng.normal() * np.r_[body[k][2], body[k][3]], np.zeros(6)]
        came[k] = [(stamps[k], with_noise(rng, moved_by(body[k], late), std))]
    follow(made, stamps, tool, body[0], came)
    found = np.sqrt(made.estimate.memory[JITTER])
    assert 0.5 * jitter < found < max(2.0 * jitter, 5e-4)


def test_well_known_cup_is_predicted_as_well_with_a_camera_as_without():
    """Compare errors from 2 s on with a K that is off by its stated 0.3 %."""
    squares = np.zeros((2, 2))
    for seed in range(4):
        for squares_of, is_seen in zip(squares, (True, False), strict=True):
            cell, errors = Cell(seed, 8.0, {'stiffness': 0.003}, payload__estimate=False), []
            cell.seen = cell.seen if is_seen else {}
            cell.run(lambda k, cell=cell, errors=errors: errors.append(
                pose_error(cell.made.body, *cell.body[k][:2])))
            squares_of += np.square(errors[250:]).sum(axis=2).mean(axis=0)
    assert (squares[0] < 1.05**2 * squares[1]).all()


@pytest.mark.parametrize('seed', range(3))
def test_a_constant_error_of_a_view_does_not_grow_with_the_estimated_noise(seed):
    """Let a resting tag err by 1 mm, 9 deviations of a view, with all else known exactly."""
    rng, (stamps, _) = np.random.default_rng(seed), tool_motion(np.random.default_rng(seed), 3.0)
    tool = [ORIGIN] * len(stamps)
    body = truth(tool[:1])[0]
    made = observer(
        measured__tag_size=0.05, recording__package_world='0 0 1 1 0 0 0',
        measured__noise=[8e-5, 20.0], tool_noise=(2e-5, 5e-5))

    def seen():
        """Return a pose in axes of the camera, 1 m above the origin, that looks down."""
        (x, y, z), q, *_ = with_noise(
            rng, body, np.array([5e-5, 5e-5, 3e-4, 2e-3, 2e-3, 8e-4]))
        return (x + 1e-3, -y, 1.001 - z), quaternion_product((-1.0, 0.0, 0.0, 0.0), q)

    follow(made, stamps, tool, body, at_once(
        stamps, {k: seen() for k in range(8, len(tool), 8)}))
    assert np.abs(error_of(made.body, body)[3:6]).max() < 5e-5  # rad; 2e-4 if it grows


def test_wrench_of_a_known_package_is_known():
    """Let the bias of the wrench have the shares of the stated mass and centre of mass."""
    model = model_tuple(CUP, PACKAGE, 9.81)
    known, unknown = (priors_of(values(
        package__mass_std=0.01 * size * PACKAGE.mass, package__com_std=[1e-3 * size] * 3), model)
        for size in (0.1, 1.0))
    for each in ('std', 'walk'):
        found, other = (getattr(of, each)[WRENCH:WRENCH + 6] for of in (known, unknown))
        np.testing.assert_allclose(found, 0.1 * other)
        assert found.min() > 0.0
