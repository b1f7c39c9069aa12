"""
Faults of a prepared recording, detected without a fit.

The cup's lip must hang below the tool, and the package follows its tool at once. `faults` has the
table of tests.
"""

from collections.abc import Iterator

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.signals.resampling import timing
from bellows_ros.core.signals.residuals import spectrum
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory, uniform_rate_hz
import numpy as np

from . import alignment
from .pose_faults import MAX_REACH, noise_of
from .recording import Recording

TAG_ROTATION = 2e-3
"""Smallest noise of the orientation of a detected tag, rad: ten times a tracked body's."""

TAG_DEPTH = 2.5
"""Smallest ratio of depth noise to lateral noise of a detected tag: distance over side."""

TAG_TILT = 2.0
"""Smallest ratio of the noise about two axes of a detected tag, whose tilt is less certain than
its rotation about the line of sight; the noise of a tracked body is similar about all axes."""

TAG_RATE_HZ = 70.0
"""Largest rate of a tag detector, Hz: usual cameras have 30 or 60."""

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

MIN_DENSITY = 1e-18
"""Smallest density of noise from which a filter is detected, m^2/Hz: 10 nm in 100 Hz."""

MAX_DENSITY_RATIO = 10.0
"""Largest ratio of the densities in two seconds of stationary noise, 90 % and 10 % quantiles."""


def detected_tags(package: PoseStream) -> Iterator[Finding]:
    """Yield poses that seem to be of a detected tag, by their noise."""
    noise, rate_hz = noise_of(package.trajectory()), timing(package.stamps_ns).rate_hz
    lateral, rotation = (float(np.sqrt(np.mean(part**2))) for part in (noise[:2], noise[3:]))
    is_tilting = rotation > TAG_ROTATION and max(noise[3:]) > TAG_TILT * min(noise[3:])
    if rate_hz < TAG_RATE_HZ and (is_tilting or noise[2] > TAG_DEPTH * lateral):
        yield Finding('sensor', Level.WARN, {'rate': rate_hz, 'rotation': rotation}, 'package')


def wrong_sensors(recording: Recording) -> Iterator[Finding]:
    """Yield poses of a detected tag given as poses of a tracked body."""
    if recording.settings.tag is None:
        yield from detected_tags(recording.package_pose)


def misplaced(recording: Recording) -> Iterator[Finding]:
    """Yield the reason why a package is mostly not below the tool."""
    some = np.flatnonzero(recording.whole)[::SAMPLE_STEP]
    tool, package = recording.measured_tool.select(some), recording.measured_package.select(some)
    back, centre = np.swapaxes(tool.rotation, 1, 2), package.position - tool.position
    lip = apply(back, centre - apply(package.rotation, recording.payload.com))
    away, above = (float(np.median(size)) for size in (np.linalg.norm(lip, axis=1), lip[:, 2]))
    if away > MAX_REACH:
        yield Finding('package_world', Level.ERROR, {
            'why': f': the lip of the cup would be {away:.3g} m from the tool tip'})
    elif above > 0.0:  # mostly: the package may have fallen
        is_frame = recording.settings.package_frame == 'com' and np.median(
            apply(back, centre)[:, 2]) < 0.0
        yield Finding('package_frame' if is_frame else 'tool_z', Level.ERROR, {'above': above})


def turned_frames(recording: Recording) -> Iterator[Finding]:
    """Yield frames that are turned by more than a cup bends."""
    yield from (remark._replace(level=Level.ERROR) for remark in recording.report.remarks
                if remark.code == 'turned' and remark.numbers['turned'] > alignment.MAX_TURN)


def clocks_apart(recording: Recording) -> Iterator[Finding]:
    """
    Yield the offset of the clocks, if the rotations of both bodies agree at a lag.

    Two parts of a motion may be similar by chance. If the correlation at small lags is less than
    half of the largest, the package does not follow the tool as stamped, and a lower threshold is
    used. If the rotations agree in axes without a lag, the larger correlation of angles at another
    lag is due to nearly repetitive motion.
    """
    if late := _lag(recording.aligned_tool, recording.aligned_package):
        yield Finding('time_offset', Level.ERROR, {
            'late': late, 'size': abs(late),
            'side': 'later' if late > 0.0 else 'earlier'}, 'tool')


def _lag(tool: Trajectory, package: Trajectory) -> float:
    """Return the tool's delay (s) if beyond the usual swing, else 0."""
    lags, correlation = alignment.rotation_correlation(tool, package)
    if not len(lags):
        return 0.0
    best, near = int(np.argmax(correlation)), (lags >= MIN_SWING) & (lags <= MAX_SWING)
    largest, small = float(correlation[best]), np.max(correlation[near], initial=0.0)
    limit = alignment.MIN_CORRELATION * (1.0 if small < MIN_CORRELATION_RATIO * largest else 2.0)
    if largest < limit or near[best] or _correlation_gap(small, largest) < MIN_CORRELATION_GAP:
        return 0.0
    in_axes = alignment.rotation_correlation(tool, package, one_world=True)[1]
    near_in_axes = np.max(in_axes[near], initial=0.0)
    is_late = near_in_axes <= alignment.MIN_CORRELATION or (
        _correlation_gap(near_in_axes, np.max(in_axes)) >= MIN_CORRELATION_GAP)
    return float(lags[best]) + SWING_DELAY if is_late else 0.0


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
