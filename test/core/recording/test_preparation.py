"""Recorded streams prepared for identification, against the motion they were made from."""

from dataclasses import replace

from bellows_ros.core.findings import Level
from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.recording.outliers import find_outliers, LastingStep
from bellows_ros.core.recording.preparation import prepare, remarks_on
from bellows_ros.core.recording.recording import noise_at_rest, PrepareSettings, StreamReport
from bellows_ros.core.signals.resampling import on_grid, timing
from bellows_ros.core.signals.savgol import correlated, savgol
from bellows_ros.core.signals.trajectory import (
    PoseStream,
    Trajectory,
    TwistStream,
    uniform_rate_hz,
)
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from ...cell.motion import held, START
from ...cell.sensors import displaced, Noise, noisy, with_errors

COM = (0.0, 0.0, -0.03)
WINDOWS = {f'{body}_{name}': size for body in ('tool', 'package')
           for name, size in (('half_window', 25), ('order', 4))}


def weighing(com):
    """Return a package with this centre of mass."""
    return Package(1.0, 0.01 * np.eye(3), com)


PLAIN = PrepareSettings(payload=weighing(COM), **WINDOWS)
AT_REST = replace(PLAIN, align_at_rest=True)
R_MOTIVE_WORLD = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def stream(poses, name='/tool', index=slice(None)):
    """Give poses as a recorded topic."""
    part = poses.select(index)
    return PoseStream(name, 'world', part.stamps_ns, part.position, part.rotation)


def difference(actual, expected, valid):
    """Give differences of positions and rotation vectors where valid."""
    turn = log_so3(np.swapaxes(expected.rotation, -1, -2) @ actual.rotation)
    return (actual.position - expected.position)[valid], turn[valid]


def at(poses, stamps_ns):
    """Give the poses at some of their stamps."""
    return poses.select(np.searchsorted(poses.stamps_ns, stamps_ns))


def test_poses_that_need_nothing_are_only_filtered():
    tool, package = held(60)
    found = prepare(stream(tool), stream(package, '/package'), PLAIN)
    assert found.valid.all() and found.measured.all()
    assert_array_equal(found.package.stamps_ns, package.stamps_ns[25:-25])
    for filtered, poses in ((found.tool, tool), (found.package, package)):
        expected = savgol(poses, 25, 4)
        assert_allclose(filtered.position, expected.position, atol=1e-14)
        assert_allclose(filtered.twist, expected.twist, atol=1e-12)
    assert_allclose(found.package.acceleration, savgol(package, 25, 4).acceleration, atol=1e-9)
    assert_array_equal(found.measured_tool.position, tool.position[25:-25])
    assert_allclose(found.measured_package.position, package.position[25:-25], atol=1e-15)
    assert len(found.valid) == np.count_nonzero(found.valid) == len(package) - 50
    assert found.report.remarks == ()
    assert found.start_ns == tool.stamps_ns[0]
    assert_allclose(found.since_start(package.stamps_ns), package.seconds)


def test_noise_at_rest_with_a_memory_is_that_of_fewer_poses():
    """So 51 poses that keep 72 % of it say by chance that there is far less."""
    rng, stamps_ns = np.random.default_rng(1), np.rint(np.arange(51) * 1e9 / 30.0).astype(np.int64)
    still = Trajectory(stamps_ns, np.zeros((51, 3)), np.tile(np.eye(3), (51, 1, 1)))
    seen = [noise_at_rest(with_errors(still, 1e-3 * correlated(
        rng.standard_normal((51, 6)), 0.72))) for _ in range(200)]
    squares = np.array([noise.std**2 for noise in seen]) / 1e-6
    assert abs(squares.mean() - 1.0) < 0.05
    independent = np.median([noise.independent for noise in seen])
    assert 0.6 < squares[:, :3].mean(axis=1).std() / np.sqrt(2.0 / 3.0 / independent) < 1.0


@pytest.mark.parametrize('rate_hz', [125.0, 500.0])
def test_a_tool_at_another_rate_comes_to_the_stamps_of_the_package(rate_hz):
    tool, package = (poses.select(slice(None, None, 25)) for poses in held(62, 9000.0))
    every = held(62, 9000.0)[0].select(slice(7, None, int(9000 / rate_hz)))
    settings = replace(PLAIN, tool_half_window=int(0.035 * rate_hz), package_half_window=12)
    found = prepare(stream(every), stream(package, '/package'), settings)
    assert_array_equal(found.tool.stamps_ns, found.package.stamps_ns)
    position, turn = difference(found.tool, at(tool, found.tool.stamps_ns), found.valid)
    # What a quartic over 70 ms and a cubic over 8 ms leave of 10 m/s^2 at 2 Hz.
    assert_allclose(position, 0.0, atol=2e-6)
    assert_allclose(turn, 0.0, atol=2e-5)


def test_marker_frames_and_motive_axes_are_undone():
    tool, package = held(63)
    turned = []
    for poses, turn in ((tool, [0.1, 2.0, 0.3]), (package, [-0.5, 0.2, 1.0])):
        rotation = R_MOTIVE_WORLD @ poses.rotation @ exp_so3(turn)
        position = apply(R_MOTIVE_WORLD, poses.position)
        turned.append(Trajectory(poses.stamps_ns, position, rotation))
    settings = replace(AT_REST, world='motive_y_up', package_frame='com')
    found = prepare(stream(turned[0]), stream(turned[1], '/package'), settings)
    for poses, expected in ((found.measured_tool, tool), (found.measured_package, package)):
        position, turn = difference(poses, at(expected, poses.stamps_ns), found.valid)
        assert_allclose(position, 0.0, atol=1e-12)
        assert_allclose(turn, 0.0, atol=1e-12)


def test_what_a_window_touches_is_dropped_and_counted():
    tool, package = held(64)
    bad = displaced(tool, slice(3000, 3005), np.array([0.1, 0, 0]), np.zeros(3), True)
    gap = np.delete(np.arange(len(package)), slice(5000, 5010))
    found = prepare(stream(bad), stream(package, '/package', gap), PLAIN)
    dropped = np.flatnonzero(~found.valid) + 25
    assert_array_equal(dropped, np.concatenate([np.arange(2975, 3030), np.arange(4975, 5035)]))
    assert_array_equal(np.flatnonzero(~found.measured) + 25,
                       np.concatenate([np.arange(3000, 3005), np.arange(5000, 5010)]))
    report = found.report
    assert [(own.marked, own.overlapping_gap) for own in (report.tool, report.package)] == [
        (5, 50), (0, 50)]
    assert_array_equal(np.flatnonzero(~report.tool.outliers.good), np.arange(3000, 3005))
    (hole,) = report.package.timing.gaps
    assert hole.start_ns == package.stamps_ns[4999]


@pytest.mark.parametrize('axes', ['world', 'tool'])
def test_a_recorded_twist_goes_to_the_measured_tool_alone(axes):
    tool, package = held(65)
    exact = savgol(tool, 3, 4)
    markers = exp_so3([0.4, 1.0, -2.0])
    R = exact.rotation if axes == 'world' else np.broadcast_to(markers.T, exact.rotation.shape)
    kept = np.delete(np.arange(len(exact)), slice(4000, 4020))
    twist = TwistStream('/twist', axes, exact.stamps_ns[kept], *(
        apply(R, part)[kept] for part in (exact.twist[:, :3], exact.twist[:, 3:])))
    turned = Trajectory(tool.stamps_ns, tool.position, tool.rotation @ markers)
    settings = replace(AT_REST, tool_twist_frame=axes)
    with_twist = prepare(stream(turned), stream(package, '/package'), settings, twist)
    without = prepare(stream(turned), stream(package, '/package'), settings)
    expected = at(exact, with_twist.tool.stamps_ns)
    # The filter of `exact` moves its poses, and with them the axes, by parts of a microradian.
    valid = with_twist.measured_tool.valid
    assert_allclose(with_twist.measured_tool.twist[valid], expected.twist[valid], atol=2e-6)
    assert_array_equal(np.flatnonzero(~valid) + 25, np.arange(4003, 4023))
    assert with_twist.valid.all()
    assert_array_equal(with_twist.tool.twist, without.tool.twist)
    assert without.measured_tool.twist is None


def test_the_alignment_of_one_recording_serves_another_that_never_rests():
    tool, package = held(67)
    settings = AT_REST
    first = prepare(stream(tool), stream(package, '/package'), settings)
    later = slice(1500, None)
    second = prepare(stream(tool, '/tool', later), stream(package, '/package', later), settings,
                     alignment=first.alignment)
    expected = at(first.package, second.package.stamps_ns)
    assert_allclose(second.package.position, expected.position, atol=1e-12)
    with pytest.raises(BellowsError, match='both bodies stand still only'):
        prepare(stream(tool, '/tool', later), stream(package, '/package', later), settings)


def test_steps_jitter_and_a_centre_of_mass_aside_are_warned_about():
    rng = np.random.default_rng(68)
    tool, package = (noisy(rng, poses, Noise()) for poses in held(68))
    step = displaced(tool, slice(4000, None), np.array([0.05, 0, 0]), np.zeros(3), False)
    settings = replace(AT_REST, payload=weighing((0.01, 0.0, -0.03)))
    aside = displaced(package, slice(None), np.array([0.01, 0, 0]), np.zeros(3), True)
    found = prepare(stream(step), stream(aside, '/package'), settings)
    jump, aside = found.report.remarks
    assert (jump.code, jump.topic) == ('slip', '/tool')
    assert (aside.code, aside.numbers) == ('aside', {
        'part': 'centre of mass', 'aside': pytest.approx(0.01)})
    late = tool.stamps_ns + rng.integers(0, 1_000_000, len(tool))
    jittered = Trajectory(late, tool.position, tool.rotation)
    (jitters,) = prepare(stream(jittered), stream(package, '/package'), PLAIN).report.remarks
    assert (jitters.code, jitters.topic) == ('jitter', '/tool')


def test_poses_stamped_in_bursts_on_arrival_are_reported():
    tool, package = held(69, seconds=6.0)
    since = tool.stamps_ns - tool.stamps_ns[0]
    burst = since // 40_000_000
    sent = np.random.default_rng(0).integers(0, 5_000_000, burst[-1] + 1)
    late = tool.stamps_ns[0] + 40_000_000 * burst + sent[burst] + 30_000 * (
        np.arange(len(tool)) - np.searchsorted(burst, burst))
    arrived = [replace(own, stamps_ns=late) for own in (tool, package)]
    with pytest.raises(BellowsError, match='^The poses come in bursts'):
        prepare(stream(arrived[0]), stream(arrived[1], '/package'), PLAIN)
    sound = prepare(stream(tool), stream(package, '/package'), PLAIN)
    assert sound.valid.any() and not sound.report.remarks
    fours = np.arange(len(package)) // 4 * 4 + np.arange(len(package)) % 4 / 50.0
    four = replace(package, stamps_ns=package.stamps_ns[0] + np.rint(
        fours * np.diff(package.stamps_ns).mean()).astype(np.int64))
    arrived = replace(sound.report.package, recorded=stream(four, '/package'))
    (found,) = remarks_on(arrived)
    assert (found.code, found.level) == ('jitter', Level.ERROR)


def test_jitter_of_a_moving_body_is_no_step_and_hides_no_large_one():
    rng = np.random.default_rng(69)
    tool, package = (noisy(rng, poses, Noise()) for poses in held(69))
    late = np.sort(tool.stamps_ns + rng.normal(0.0, 2.5e6, len(tool)).astype(np.int64))
    step = displaced(tool, slice(4000, None), np.array([0.15, 0, 0]), np.zeros(3), False)
    for poses, steps in ((tool, 0), (step, 1)):
        jittered = Trajectory(late, poses.position, poses.rotation)
        found = prepare(stream(jittered), stream(package, '/package'), PLAIN).report.remarks
        codes = [remark.code for remark in found]
        assert codes.count('slip') == steps
        assert codes.count('jitter') == 1


@pytest.mark.parametrize(('rate_hz', 'size', 'warned'), [
    (30, 5e-3, False), (30, 0.15, True), (240, 5e-3, True)])
def test_a_step_as_a_slow_camera_sees_many_is_of_the_motion(rate_hz, size, warned):
    seconds = np.arange(10 * rate_hz) / rate_hz
    swing = 0.05 * np.sin(2 * np.pi * 2.5 * seconds)[:, None] * [1.0, 0.5, 0.0]
    poses = Trajectory(START + (seconds * 1e9).astype(np.int64), swing, exp_so3(4.0 * swing))
    found = replace(find_outliers(poses, 10**9), steps=(LastingStep(100, size, 4.0 * size),))
    remarks = remarks_on(StreamReport(stream(poses), timing(poses.stamps_ns), found))
    assert any(remark.code == 'slip' for remark in remarks) is warned


def test_stamps_of_a_slow_clock_are_counted():
    tool, package = held(71)
    kept = np.flatnonzero(np.arange(len(tool)) % 9 % 2 == 0)
    lost = tuple(sorted({*range(len(tool))} - {*kept.tolist()}))
    slow = replace(stream(tool, '/tool', kept), refused={'duplicate_stamp': lost})
    said = prepare(slow, stream(package, '/package'), PLAIN).report.remarks
    assert said[0].code == 'jitter' and f' {len(lost)} poses repeat' in said[0].numbers['instead']


def test_unusable_recordings_get_a_reason():
    tool, package = held(70)
    later = replace(stream(package, '/package'), stamps_ns=package.stamps_ns + 60_000_000_000)
    with pytest.raises(BellowsError, match="'/tool'.*'/package'"):
        prepare(stream(tool), later, PLAIN)
    with pytest.raises(BellowsError, match=r"'/tool'.*\b51\b"):
        prepare(stream(tool, '/tool', slice(0, 40)), stream(package, '/package'), PLAIN)
    with pytest.raises(BellowsError, match=r"'/tool'.*\b3\b"):
        prepare(stream(tool, '/tool', slice(0, 2)), stream(package, '/package'), PLAIN)
    with pytest.raises(BellowsError):
        prepare(stream(tool, '/tool', slice(0, 1040)),
                stream(package, '/package', slice(1000, None)), PLAIN)
    lost = np.arange(len(tool)) % 40
    found = prepare(stream(tool, '/tool', lost > 1), stream(package), PLAIN)
    assert found.whole.all() and found.report.tool.interpolated == 2 * 179
    holes = np.flatnonzero(lost > 2)
    with pytest.raises(BellowsError, match=r"'/tool'.*\b179\b"):
        prepare(stream(tool, '/tool', holes), stream(package, '/package'), PLAIN)
    twist = TwistStream('/twist', 'world', tool.stamps_ns[:2], *np.zeros((2, 2, 3)))
    with pytest.raises(BellowsError, match=r'\b2\b'):
        prepare(stream(tool), stream(package, '/package'), PLAIN, twist)


def lost(poses, *spans):
    """Return a stream without the poses of spans, s from its first stamp."""
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    kept = ~np.any([(seconds > first) & (seconds < last) for first, last in spans], axis=0)
    return replace(poses, stamps_ns=poses.stamps_ns[kept], position=poses.position[kept],
                   rotation=poses.rotation[kept])


@pytest.mark.parametrize(('tool_gaps', 'package_gaps', 'expected'), [
    ((), (), [(0.0, 20.0)]),
    (((8.0, 8.1),), ((5.0, 9.0),), [(0.0, 20.0)]),
    (((8.0, 8.3),), (), [(0.0, 8.0), (8.3, 20.0)]),
    (((8.0, 8.3), (8.8, 9.2), (15.0, 18.0)), (), [(0.0, 8.0), (9.2, 15.0), (18.0, 20.0)]),
    (((8.0, 8.3), (12.0, 12.3)), ((8.0, 12.3),), [(0.0, 8.0), (12.3, 20.0)])])
def test_segments_end_at_gaps_of_the_tool_that_cannot_be_bridged(
        tool_gaps, package_gaps, expected):
    tool, package = (
        PoseStream(f'/{name}', 'world', body.stamps_ns, body.position, body.rotation)
        for name, body in zip(('tool', 'package'), held(3), strict=True))
    first = int(tool.stamps_ns[0])
    recording = prepare(
        lost(tool, *tool_gaps) if tool_gaps else tool,
        lost(package, *package_gaps) if package_gaps else package, PrepareSettings())
    assert_allclose([[(s.first_ns - first) * 1e-9, (s.last_ns - first) * 1e-9]
                     for s in recording.segments()], expected, atol=0.1)
    stamps = recording.measured_tool.stamps_ns
    for segment in recording.segments():
        inside = stamps[segment.samples]
        assert segment.first_ns <= inside[0] <= inside[-1] <= segment.last_ns


def rounded_stamps(rate_hz, count):
    """Give stamps as a driver rounds them: to whole nanoseconds, downwards."""
    return START + (np.arange(count) * 1_000_000_000) // rate_hz


def moving(stamps_ns):
    """Give a smooth motion at any stamps."""
    t = (stamps_ns - START) / 1e9
    position = np.stack([np.sin(6.0 * t), np.cos(5.0 * t), 0.2 * t], axis=1)
    return Trajectory(stamps_ns, position, exp_so3(0.5 * np.sin(4.0 * t)[:, None] * [1, 2, 0.5]))


@pytest.mark.parametrize('rate_hz', [100, 125, 360, 500, 1000])
def test_rounded_stamps_are_uniform_and_copied(rate_hz):
    poses = moving(rounded_stamps(rate_hz, 2000))
    found = timing(poses.stamps_ns)
    assert found.uniform
    assert found.gaps == ()
    assert_allclose(found.rate_hz, rate_hz, rtol=1e-7)
    grid = on_grid(poses, found)
    assert_array_equal(grid.stamps_ns, poses.stamps_ns)
    assert_array_equal(grid.position, poses.position)
    assert_array_equal(grid.rotation, poses.rotation)
    assert grid.valid.all()


@pytest.mark.parametrize('together', [2, 3, 5])
@pytest.mark.parametrize('count', [400, 401])
def test_poses_in_bursts_have_the_rate_of_their_mean_and_no_gaps(together, count):
    """As a driver sends them that collects a few, each stamped when it is sent."""
    k = np.arange(count)
    stamps = START + (k // together) * 10_000_000 * together + (k % together) * 100_000
    found = timing(stamps)
    assert_allclose(found.rate_hz, 100.0, rtol=0.01)
    assert found.gaps == ()
    assert on_grid(moving(stamps), found).valid.all()


@pytest.mark.parametrize('lost', [1, 2, 12, 39, 400])
def test_gaps_are_filled_on_the_grid_and_invalid(lost):
    poses = moving(rounded_stamps(360, 2000))
    missing = slice(700, 700 + lost)
    kept = poses.select(np.delete(np.arange(2000), missing))
    found = timing(kept.stamps_ns)
    (gap,) = found.gaps
    assert gap.start_ns == poses.stamps_ns[699]
    assert_allclose(gap.duration_s, (lost + 1) / 360, rtol=1e-6)
    grid = on_grid(kept, found)
    # The stamps put in divide the gap evenly: they are those lost, but for the rounding.
    assert np.max(np.abs(grid.stamps_ns - poses.stamps_ns)) <= 1
    assert_array_equal(np.flatnonzero(~grid.valid), np.arange(2000)[missing])
    assert np.isfinite(grid.position).all()
    assert_array_equal(grid.position[grid.valid], kept.position)


def test_jittering_stamps_are_interpolated_at_the_uniform_rate():
    rng = np.random.default_rng(4)
    even = rounded_stamps(360, 4000)
    stamps = even + np.rint(rng.uniform(-0.3, 0.3, 4000) * 1e9 / 360).astype(np.int64)
    found = timing(stamps)
    assert not found.uniform
    assert_allclose(found.rate_hz, 360, rtol=1e-2)
    grid = on_grid(moving(stamps), found)
    assert uniform_rate_hz(grid.stamps_ns) == pytest.approx(found.rate_hz, rel=1e-6)
    assert np.mean(grid.valid) > 0.99
    expected = moving(grid.stamps_ns)
    # A chord misses by at most acceleration h^2 / 8, with h up to 1.6 periods: here 0.09 mm.
    assert_allclose(grid.position, expected.position, atol=1e-4)
    assert savgol(grid, 10, 4).valid.any()


def test_stamps_far_apart_are_refused_and_not_filled():
    stamps = rounded_stamps(360, 1000)
    stamps[999] += 86_400_000_000_000
    poses = moving(stamps)
    with pytest.raises(BellowsError):
        on_grid(poses, timing(stamps))
