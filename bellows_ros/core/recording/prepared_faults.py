"""
Faults of a prepared recording, detected without a fit.

The cup's lip must hang below the tool, and the package follows its tool at once. `faults` has the
table of tests.
"""

from collections.abc import Iterator
from contextlib import suppress
from operator import attrgetter

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.model.structure import THESIS_LENGTH
from bellows_ros.core.signals.resampling import common_span
from bellows_ros.core.signals.residuals import spectrum
from bellows_ros.core.signals.trajectory import earlier, NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

from . import alignment, conventions
from .pose_faults import noise_of
from .preparation import lasting_steps, MAX_POSE_STEPS, prepare
from .recording import LOW_RATE_HZ, Recording

TAG_ROTATION = 2e-3
"""Smallest noise of the orientation of a detected tag, rad: ten times a tracked body's."""

TAG_DEPTH = 2.5
"""Smallest ratio of depth noise to lateral noise of a detected tag: distance over side."""

TAG_RATE_HZ = 70.0
"""Largest rate of a tag detector, Hz: usual cameras have 30 or 60."""

MAX_EXCURSIONS = 1e-3
"""Largest fraction of excursions in the poses of a tracked body."""

MAX_LIP_DEPTH = 0.3
"""Largest distance of a lip below its tool, m; beyond, tool and package are in two worlds."""

MIN_LENGTH_OFFSET = 0.02
"""Smallest error of cup.length detected without a fit, m. The lip must also be nearer by half of
the length, or farther by all of it, more than by any weight."""

MAX_SPREAD = 0.1
"""Largest plausible spread of the lip in the tool frame, m; see `conventions.spread`."""

MAX_SPREAD_RATIO = 0.3
"""Largest ratio of the lip's spread in its own world to the spread in another world."""

SAMPLE_STEP = 20
"""Step between the samples that determine the arrangement of tool and package."""

MIN_SWING = -0.2
"""Smallest time offset explained by the swing of the package, which rotates after its tool, s."""

MAX_SWING = 0.05
"""Largest time offset left to a fit, s."""

SWING_DELAY = 0.07
"""Usual delay of the package's rotation behind the tool's, s."""

MIN_CORRELATION_RATIO = 0.5
"""Ratio of the correlation of rotations at lag 0 to the largest correlation over all lags, below
which the package does not follow its tool as stamped."""

MIN_CORRELATION_GAP = 0.1
"""Smallest significant difference of two correlations of rotations by Fisher's transform (atanh),
above chance and nearly repetitive motion."""

HALVES = ((0.0, 0.45), (0.55, 1.0))
"""Parts of a recording that are compared for a step of a clock between them."""

MIN_STEP_GAP = 0.5
"""Smallest difference, by Fisher's transform, of the correlations of rotations in each half and in
the whole that shows a step of a clock."""

SPECTRUM_SECONDS = 1.0
"""Length of the periodograms of poses, s."""

MIN_RATE_HZ = 100.0
"""Lowest rate of poses with a spectrum of noise above the motion, Hz."""

DIFFERENCES = 4
"""Order of the differences that suppress motion."""

NOISE_HZ = 25.0
"""Lowest frequency of noise without motion, Hz."""

NYQUIST_PART = 0.9
"""Highest frequency of noise as a fraction of the Nyquist frequency."""

MAX_NOISE_ORDER = 3.4
"""Largest exponent of the decay of noise density with frequency. Noise with memory has an exponent
of 2, with heavy tails up to 3, and noise behind a filter of second order 4."""

TAIL_SHARE = 0.25
"""Relative size of other jumps that indicates noise with heavy tails."""

MAX_SLIP_ANGLE = 1.2
"""Largest rotation of a package on the lip between two poses, rad."""

MIN_DENSITY = 1e-18
"""Smallest density of noise from which a filter is detected, m^2/Hz: 10 nm in 100 Hz."""

MAX_DENSITY_RATIO = 10.0
"""Largest ratio of the densities in two seconds of stationary noise, 90 % and 10 % quantiles."""


def seems_tag(noise: Array, rate_hz: float, excursions: float) -> bool:
    """Return whether poses with a noise (6,), a rate and a share of excursions are of a tag."""
    lateral, rotation = (float(np.sqrt(np.mean(part**2))) for part in (noise[:2], noise[3:]))
    return rate_hz < TAG_RATE_HZ and (
        excursions > MAX_EXCURSIONS or rotation > TAG_ROTATION
        or float(noise[2]) > TAG_DEPTH * lateral)


def wrong_sensors(recording: Recording) -> Iterator[Finding]:
    """Yield poses of a detected tag given as poses of a tracked body, or vice versa."""
    report, body = recording.report.package, recording.tracked_package
    yield from sensor_remarks(
        body.select(body.valid), report.timing.rate_hz,
        report.outliers.excursions / len(report.recorded), recording.settings.tag is not None,
        report.recorded.corners is not None)


def sensor_remarks(
    body: Trajectory, rate_hz: float, excursions: float, is_tag: bool, has_corners: bool
) -> Iterator[Finding]:
    """Yield the fault of poses whose excursions contradict the stated sensor, a tag or a body."""
    noise = noise_of(body)
    sizes = {'rate': rate_hz, 'rotation': float(np.sqrt(np.mean(noise[3:]**2)))}
    if not np.isfinite(noise).all():
        return
    if not is_tag and seems_tag(noise, rate_hz, excursions):
        yield Finding('sensor', Level.WARN, {'kind': 'detected tag', **sizes}, 'package')
    elif is_tag and rate_hz > TAG_RATE_HZ and not has_corners and (
            not seems_tag(noise, 0.0, excursions)):
        yield Finding('sensor', Level.WARN, {'kind': 'tracked body', **sizes}, 'package')


def misplaced(recording: Recording) -> Iterator[Finding]:
    """Yield the reason why a package is mostly not below the tool."""
    tool, package, in_world = _arrangement(recording)
    if not len(tool):
        return
    back = np.swapaxes(tool.rotation, 1, 2)
    lip = apply(back, in_world)
    away, above = float(np.median(np.linalg.norm(lip, axis=1))), float(np.median(lip[:, 2]))
    if away <= conventions.MAX_DISTANCE and above <= 0.0 and conventions.spread(lip) < MAX_SPREAD:
        return
    with suppress(BellowsError):  # too short with other stamps
        for late in clocks_apart(recording):
            if late.code == 'clock_shift' or not [*misplaced(_earlier(
                    recording, late.numbers['late']))]:
                yield late
                return
    if apart := [*_two_worlds(recording, tool, package, lip)]:
        yield from apart
    elif away > conventions.MAX_DISTANCE:
        yield Finding('package_world', Level.ERROR, {
            'why': f': the lip of the cup would be {away:.3g} m from the tool tip'})
    elif above > 0.0:  # mostly: the package may have fallen
        centre = apply(back, package.position - tool.position)
        is_frame = recording.settings.package_frame == 'com' and np.median(centre[:, 2]) < 0.0
        yield Finding('package_frame' if is_frame else 'tool_z', Level.ERROR, {'above': above})


def turned_frames(recording: Recording) -> Iterator[Finding]:
    """Yield frames that are turned by more than a cup bends."""
    yield from (remark._replace(level=Level.ERROR) for remark in recording.report.remarks
                if remark.code == 'turned' and remark.numbers['turned'] > alignment.MAX_TURN)


def _arrangement(recording: Recording) -> tuple[Trajectory, Trajectory, Array]:
    """Return selected poses of tool and package, and the lip from the tool in A (N, 3), m."""
    some = np.flatnonzero(recording.whole)[::SAMPLE_STEP]
    tool, package = recording.measured_tool.select(some), recording.measured_package.select(some)
    lip = package.position - apply(package.rotation, recording.payload.com)
    return tool, package, lip - tool.position


def _two_worlds(
    recording: Recording, tool: Trajectory, package: Trajectory, lip: Array
) -> Iterator[Finding]:
    """Yield another world of the package if that reduces the lip's spread."""
    try:
        com = recording.payload.com
        pose, _ = alignment.hand_eye(
            recording.measured_tool, recording.measured_package, THESIS_LENGTH, com, -com)
    except BellowsError:  # too short
        return
    moved = pose[:3] - tool.position + apply(
        lie.quaternion_to_rotation(pose[3:]), package.position - apply(package.rotation, com))
    before, after = map(conventions.spread, (lip, apply(np.swapaxes(tool.rotation, 1, 2), moved)))
    if after <= MAX_SPREAD_RATIO * before:
        body = recording.measured_package
        motion = alignment.motion_of(pose, body.position[body.valid].mean(axis=0))
        yield Finding('package_world', Level.ERROR, {
            'why': alignment.motion_words(motion), 'share': (
                f' Seen from the tool, the lip of the cup moves by {1e3 * before:.0f} mm, and by '
                f'{1e3 * after:.0f} mm without that.')})


def _earlier(recording: Recording, seconds: float) -> Recording:
    """Return a recording prepared from earlier stamps of the tool."""
    twist = recording.tool_twist
    return prepare(earlier(recording.tool_pose, seconds), recording.package_pose,
                   recording.settings, twist and earlier(twist, seconds))


def wrong_length(recording: Recording, length: float) -> Iterator[Finding]:
    """Yield a distance of the lip below the tool that contradicts the cup's length (m)."""
    tool, _, in_world = _arrangement(recording)
    if not len(tool):
        return
    below = -apply(np.swapaxes(tool.rotation, 1, 2), in_world)
    x, y, depth = np.median(below, axis=0)
    offset, com = float(depth) - length, np.linalg.norm(recording.payload.com)
    is_frame = abs(abs(offset) - com) < 0.5 * com  # poses of the lip instead of the com
    if not (is_frame or depth > MAX_LIP_DEPTH or abs(offset) < MIN_LENGTH_OFFSET + length * (
            1.0 if offset > 0.0 else 0.5) or np.hypot(x, y) + conventions.spread(below) > abs(
            offset)):
        yield Finding('length', Level.ERROR, {'offset': abs(offset)})


def clocks_apart(recording: Recording) -> Iterator[Finding]:
    """
    Yield the offset of the clocks, or its step, if the rotations of both bodies agree at lags.

    Two parts of a motion may be similar by chance. If the correlation at small lags is less than
    half of the largest, the package does not follow the tool as stamped, and a lower threshold is
    used. If the rotations agree in axes without a lag, the larger correlation of angles at another
    lag is due to nearly repetitive motion.
    """
    bodies = recording.aligned_tool, recording.aligned_package
    late, whole = _lag(*bodies)
    first, last = common_span(*bodies)
    (before, first_part), (after, last_part) = (_lag(*(
        body.between(*(first + round(part * (last - first)) for part in span)) for body in bodies))
        for span in HALVES)
    if abs(after - before) > MAX_SWING - MIN_SWING and (
            _correlation_gap(whole, min(first_part, last_part)) > MIN_STEP_GAP):
        yield Finding('clock_shift', Level.ERROR, topic='both')
    elif late:
        yield Finding('time_offset', Level.ERROR, {
            'late': late, 'size': abs(late),
            'side': 'later' if late > 0.0 else 'earlier'}, 'tool')


def _lag(tool: Trajectory, package: Trajectory) -> tuple[float, float]:
    """Return the tool's delay (s) if beyond the usual swing, else 0, and the best correlation."""
    lags, correlation = alignment.rotation_correlation(tool, package)
    if not len(lags):
        return 0.0, 0.0
    best, near = int(np.argmax(correlation)), (lags >= MIN_SWING) & (lags <= MAX_SWING)
    largest, small = float(correlation[best]), np.max(correlation[near], initial=0.0)
    limit = alignment.MIN_CORRELATION * (1.0 if small < MIN_CORRELATION_RATIO * largest else 2.0)
    if largest < limit or near[best] or _correlation_gap(small, largest) < MIN_CORRELATION_GAP:
        return 0.0, largest
    in_axes = alignment.rotation_correlation(tool, package, one_world=True)[1]
    near_in_axes = np.max(in_axes[near], initial=0.0)
    is_late = near_in_axes <= alignment.MIN_CORRELATION or (
        _correlation_gap(near_in_axes, np.max(in_axes)) >= MIN_CORRELATION_GAP)
    return (float(lags[best]) + SWING_DELAY if is_late else 0.0), largest


def _correlation_gap(small: float, large: float) -> float:
    """Return the difference of two correlations by Fisher's transform."""
    return float(np.subtract(*np.arctanh(np.minimum([large, small], 1.0 - 1e-12))))


def low_pass(recording: Recording) -> Iterator[Finding]:
    """Yield low-pass filtered poses: their noise decays too steeply."""
    for body, poses in (('tool', recording.aligned_tool), ('package', recording.aligned_package)):
        if noise_order(poses) > MAX_NOISE_ORDER:
            yield Finding('low_pass', Level.ERROR, {'above': NOISE_HZ}, body)


def noise_order(poses: Trajectory) -> float:
    """
    Return the exponent of the decay of position noise with frequency, 0 without noise.

    Noise has similar densities in most seconds; otherwise quick modes of the package prevail.
    """
    rate_hz = uniform_rate_hz(poses.stamps_ns)
    changes = np.diff(np.where(poses.valid[:, None], poses.position, np.nan), DIFFERENCES, axis=0)
    size = round(SPECTRUM_SECONDS * rate_hz)
    seconds = [part for part in (changes[start:start + size] for start in range(
        0, len(changes) - size + 1, size)) if np.isfinite(part).all()]
    if rate_hz < MIN_RATE_HZ or len(seconds) < 5:  # too few to tell noise from swings
        return 0.0
    spectra = [spectrum(part, rate_hz, SPECTRUM_SECONDS) for part in seconds]
    hz = spectra[0].frequency
    inside = (hz > NOISE_HZ) & (hz < 0.5 * NYQUIST_PART * rate_hz)
    densities = np.array([one.density[inside].sum(axis=1) for one in spectra]) / (
        2.0 * np.sin(np.pi * hz[inside] / rate_hz)) ** (2 * DIFFERENCES)
    low, high = np.quantile(np.median(densities, axis=1), (0.1, 0.9))
    if low < MIN_DENSITY or high > MAX_DENSITY_RATIO * low:
        return 0.0
    return -float(np.polyfit(np.log(hz[inside]), np.log(densities.mean(axis=0)), 1)[0])


def jumps(recording: Recording) -> Iterator[Finding]:
    """Yield the largest of a few jumps without return, of package or marker."""
    stream = recording.report.package
    steps = lasting_steps(stream)
    if not 0 < len(steps) <= MAX_POSE_STEPS:
        return
    R, stamps_ns = stream.recorded.rotation, stream.recorded.stamps_ns
    before = np.array([step.before for step in steps])
    turns = np.linalg.norm(lie.log_so3(np.swapaxes(R[before], 1, 2) @ R[before + 1]), axis=1)
    *others, largest = sorted(steps, key=attrgetter('position'))
    if turns.max() > MAX_SLIP_ANGLE:
        largest = steps[np.argmax(turns)]
    elif stream.timing.rate_hz < LOW_RATE_HZ or any(
            step.position > TAIL_SHARE * largest.position for step in others):
        return  # the fit separates slips from tails
    yield Finding('slip', Level.ERROR, {
        'position': largest.position, 'rotation': float(turns[steps.index(largest)]),
        'at': float(stamps_ns[largest.before] - stamps_ns[0]) / NS_PER_S}, 'package')
