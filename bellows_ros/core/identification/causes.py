"""
Causes of a misfit: faults of a recording, or of quantities given with it.

Each cause has a name; its parameter and a sentence with a remedy are in the texts of the room
'causes'. Some causes are detected in a recording without a fit, and corrected; the others are
tested by simulation (`diagnosis`). Each becomes a `Finding`.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
import tomllib
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.structure import THESIS_LENGTH
from bellows_ros.core.recording import alignment, conventions
from bellows_ros.core.recording.preparation import lasting_steps, MAX_POSE_STEPS, prepare
from bellows_ros.core.recording.recording import LOW_RATE_HZ, NOISE_SAMPLES, Recording
from bellows_ros.core.signals.resampling import in_bursts
from bellows_ros.core.signals.residuals import spectrum
from bellows_ros.core.signals.savgol import savgol
from bellows_ros.core.signals.trajectory import earlier, NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

MATERIAL = 0.05
"""Smallest material relative change of an entry of K, or of a twist."""

DISTINCT = 0.5
"""Share of a misfit, and of the likeliest cause's, that counts as half."""

MISREAD: Mapping[str, str] = tomllib.loads(Path(__file__).with_name('misread.toml').read_text())

NONE = np.empty(0)

MAX_LIP_DEPTH = 0.3
"""Largest distance of a lip below its tool, m; beyond, tool and package are in two worlds."""

MIN_UP = 0.01
"""Least change of the lip's depth by the other sign of z of a centre of mass, m."""

MIN_LENGTH_OFFSET = 0.02
"""Smallest error of cup.length detected without a fit, m. The lip must also be nearer by half of
the length, or farther by all of it, more than by any weight."""

MAX_COM_HEIGHT = 1e-3
"""Largest height of a centre of mass above the lip, m: z of the lip points into the cup."""

MAX_SPREAD = 0.1
"""Largest plausible spread of the lip in the tool frame, m; see `conventions.spread`."""

MAX_SPREAD_RATIO = 0.3
"""Largest ratio of the lip's spread in its own world to the spread in another world."""

SAMPLE_STEP = 20
"""Step between the samples that determine the arrangement of tool and package."""

MIN_SWING, MAX_SWING = -0.2, 0.05
"""Range of time offsets explained by the swing of the package, which rotates after its tool, s.
Smaller offsets of clocks are fitted."""

SWING_DELAY = 0.07
"""Usual delay of the package's rotation behind the tool's, s."""

ROUGH_STD = 0.05
"""Standard deviation of a clock offset by correlated rotations, due to swing, s."""

MIN_CORRELATION_GAP = 0.1
"""Smallest significant difference of two correlations of rotations by Fisher's transform (atanh),
above chance and nearly repetitive motion."""

SPECTRUM_SECONDS, MIN_RATE_HZ, DIFFERENCES = 1.0, 100.0, 4
"""Length of the periodograms of poses (s), their lowest rate of poses (Hz), and the order of
differences that suppress motion."""

NOISE_HZ, NYQUIST_PART = 25.0, 0.9
"""Lowest frequency (Hz) of noise without motion, and its highest as a fraction of the Nyquist
frequency."""

MAX_NOISE_ORDER = 3.4
"""Largest exponent of the decay of noise density with frequency: 2 with memory, up to 3 with heavy
tails; 4 behind a filter of second order."""

TAIL_SHARE = 0.25
"""Relative size of other jumps that indicates noise with heavy tails."""

MAX_SLIP_ANGLE = 1.2
"""Largest rotation of a package on the lip between two poses, rad."""

MIN_DENSITY, MAX_DENSITY_RATIO = 1e-18, 10.0
"""Smallest density of noise from which a filter is detected, m^2/Hz, and largest ratio of the
densities in two seconds of stationary noise, 90 % and 10 % quantiles."""


class Finding(NamedTuple):
    """
    A confirmed or possible deviation from a given quantity or setting.

    Parameters
    ----------
    name, value : str
        Name of the cause: a name of fit.free, a parameter, or a property of the cup; and its
        correct setting, or the body of a marker, '' for freed quantities.
    theta, std : ndarray (n,)
        Estimates of the freed quantities, and their standard errors.
    share : float
        Share of the chi² beyond noise that the cause explains.
    moved : float
        Largest relative change of an identifiable diagonal entry of K.
    datum, certain : bool
        Whether the cause is a given quantity, and whether no other cause explains the recordings
        equally well.
    instead : str
        Name or value of another given quantity that cannot be distinguished from the cause; '' for
        none.
    is_fact : bool
        Whether the cause is detected without a fit.
    sentence : str
        Message about the cause, if other than the text of its name in the room 'causes'.

    """

    name: str
    value: str
    theta: Array = NONE
    std: Array = NONE
    share: float = 1.0
    moved: float = 0.0
    datum: bool = True
    certain: bool = True
    instead: str = ''
    is_fact: bool = False
    sentence: str = ''

    @property
    def material(self) -> bool:
        """Whether the cup is wrong without the cause."""
        return self.certain and self.datum


class Diagnosis(NamedTuple):
    """
    The causes of a misfit.

    Parameters
    ----------
    excess : float
        Chi² beyond noise, over the chi² expected of noise.
    findings : tuple of Finding
        Up to three likeliest causes, or all detected without a fit.

    """

    excess: float
    findings: tuple[Finding, ...]


IN_DEGREES = Finding('topics.tool_twist', 'degrees per second')
"""Cause of tool twists in degrees per second instead of rad/s."""


def implausible_inputs(recording: Recording) -> tuple[Finding, ...]:
    """Return the faults of a recording, or of its given quantities, detected without a fit."""
    found = (_bursts(recording), implausible_package(recording.payload), *(
        test(recording) for test in (_clocks, _twists, _smoothed, _jump)))
    return tuple(wrong._replace(is_fact=True) for wrong in found if wrong)


def faults_of(recording: Recording) -> tuple[Finding, ...]:
    """Return the faults of a recording that are detected without a fit."""
    return recording.cached('faults', lambda: (wrong,) if (
        wrong := misread(recording)) else implausible_inputs(recording))


def _fact(name: str, sentence: str) -> Finding:
    return Finding(name, '', is_fact=True, sentence=sentence)


def misread(recording: Recording) -> Finding | None:
    """
    Return the reason why a package is mostly not below the tool, or None.

    Raises
    ------
    BellowsError
        If the fault cannot be corrected automatically.

    """
    return recording.cached('misread', lambda: _misread(recording))


def _arrangement(recording: Recording) -> tuple[Trajectory, Trajectory, Array]:
    """Return selected poses of tool and package, and the lip from the tool in A (N, 3), m."""
    some = np.flatnonzero(recording.whole)[::SAMPLE_STEP]
    tool, package = recording.measured_tool.select(some), recording.measured_package.select(some)
    lip = package.position - apply(package.rotation, recording.payload.com)
    return tool, package, lip - tool.position


def facts(recordings: Sequence[Recording], length: float) -> tuple[Finding, ...]:
    """Return the faults of recordings of a cup with a length (m), detected without a fit."""
    found = tuple(fact for recording in recordings for fact in faults_of(recording))
    off = None if found or not recordings else wrong_length(recordings[0], length)
    return (off,) if off else found


def wrong_length(recording: Recording, length: float) -> Finding | None:
    """Return a finding if the lip's distance below the tool contradicts the cup's length (m)."""
    tool, _, in_world = _arrangement(recording)
    if not len(tool):
        return None
    below = -apply(np.swapaxes(tool.rotation, 1, 2), in_world)
    x, y, depth = np.median(below, axis=0)
    offset, com = float(depth) - length, np.linalg.norm(recording.payload.com)
    if abs(abs(offset) - com) < 0.5 * com:  # poses of the lip instead of the com, or vice versa
        return None
    up = 2.0 * float(recording.payload.com[2])
    if up > MIN_UP and abs(offset - up) < 0.5 * abs(offset):
        sentence, *_ = structure.unit_doubts(1.0, (1e-2,) * 3, 0.5 * up)
        return Finding('com', '', instead='length', is_fact=True, sentence=sentence)
    if abs(offset) < MIN_LENGTH_OFFSET + length * (1.0 if offset > 0.0 else 0.5) or (
            depth > MAX_LIP_DEPTH or np.hypot(x, y) + conventions.spread(below) > abs(offset)):
        return None
    return Finding('length', '', np.array([offset]), np.zeros(1), instead='com', is_fact=True)


def _misread(recording: Recording) -> Finding | None:
    streams = recording.tool_pose, recording.package_pose
    names = {'tool': streams[0].name, 'package': streams[1].name}
    tool, package, in_world = _arrangement(recording)
    if not len(tool):
        return None
    R_tool_world = np.swapaxes(tool.rotation, 1, 2)
    lip, centre = (apply(R_tool_world, offset)
                   for offset in (in_world, package.position - tool.position))
    away, above = float(np.median(np.linalg.norm(lip, axis=1))), float(np.median(lip[:, 2]))
    if away <= conventions.MAX_DISTANCE and above <= 0.0 and conventions.spread(lip) < MAX_SPREAD:
        return None
    with suppress(BellowsError):  # remains unexplained by clocks
        if (clocks := _clocks(recording)) and not misread(_by_one_clock(recording, clocks)):
            return clocks._replace(is_fact=True)
    if apart := _two_worlds(recording, tool, package, lip):
        return _fact('package_world', apart)
    if away > conventions.MAX_DISTANCE:
        raise BellowsError(MISREAD['apart'].format(**names, away=away))
    # mostly below the tool: the package may have fallen
    return _above_the_tool(recording, centre, in_world, 1e3 * above) if above > 0.0 else None


def _above_the_tool(
    recording: Recording, centre: Array, in_world: Array, above: float
) -> Finding:
    """Return the cause of a lip above the tool (mm), by positions (N, 3) in tool and world."""
    below, upward = (1e3 * float(np.median(offset[:, 2])) for offset in (-centre, in_world))
    if recording.settings.package_frame == 'com' and below > 0.0:
        return _fact('recording.package_frame', MISREAD['lip'].format(below=below, above=above))
    raise BellowsError(MISREAD['upside_down'].format(above=above, below_in_world=-upward))


def _two_worlds(recording: Recording, tool: Trajectory, package: Trajectory, lip: Array) -> str:
    """Return a sentence if another world of the package reduces the lip's spread, else ''."""
    try:
        pose = _world_of(recording)
    except BellowsError:  # too short
        return ''
    moved = pose[:3] - tool.position + apply(
        lie.quaternion_to_rotation(pose[3:]),
        package.position - apply(package.rotation, recording.payload.com))
    before, after = map(conventions.spread, (lip, apply(np.swapaxes(tool.rotation, 1, 2), moved)))
    if after > MAX_SPREAD_RATIO * before:
        return ''
    body = recording.measured_package
    motion = alignment.motion_of(pose, body.position[body.valid].mean(axis=0))
    return MISREAD['two_worlds'].format(
        motion=alignment.motion_sentence(motion), before=1e3 * before, after=1e3 * after)


def _world_of(recording: Recording) -> Array:
    """Return a first guess (7,) of the pose of the package's world."""
    return alignment.closed_form(
        recording.measured_tool, recording.measured_package, THESIS_LENGTH, -recording.payload.com)


def _by_one_clock(recording: Recording, finding: Finding) -> Recording:
    """Return a recording with the stamps of the tool earlier by the estimated offset."""
    seconds, twist = float(finding.theta[0]), recording.tool_twist
    return _prepared(recording, tool=earlier(recording.tool_pose, seconds),
                     tool_twist=twist and earlier(twist, seconds))


def _prepared(recording: Recording, **changes: Any) -> Recording:
    """Return a recording prepared from other streams, or with other settings."""
    inputs: dict[str, Any] = {
        'tool': recording.tool_pose, 'package': recording.package_pose,
        'settings': recording.settings, 'tool_twist': recording.tool_twist, **changes}
    return replace(prepare(**inputs), name=recording.name)


def _bursts(recording: Recording) -> Finding | None:
    """Return a finding if many poses follow in bursts, as delayed messages do."""
    names = []
    for report in (recording.report.tool, recording.report.package):
        if in_bursts(report.recorded.stamps_ns, report.timing):
            names.append(f"'{report.recorded.name}'")
    return Finding('bursts', ' and '.join(names)) if names else None


def implausible_package(payload: Package) -> Finding | None:
    """Return a finding on an implausible mass or inertia of a package, else None."""
    mass = payload.mass
    gyration = float(np.sqrt(np.trace(payload.inertia) / mass))
    if mass > structure.MAX_MASS:
        return Finding('mass', 'g')
    if sentence := structure.too_dense(mass, gyration):
        return _fact('factor of inertia', sentence)
    if payload.com[2] > MAX_COM_HEIGHT:
        return _fact('com', MISREAD['com_inside'].format(com=1e3 * payload.com[2]))
    return None if gyration < structure.GYRATION[-1] else Finding(
        'inertia', structure.unit_of_inertia(gyration))


def _clocks(recording: Recording) -> Finding | None:
    """
    Return the offset of the clocks if the rotations of both bodies agree only at a lag.

    Two parts of a motion may be similar by chance. If the correlation at small lags is less than
    half of the largest, the package does not follow the tool as stamped, and a lower threshold is
    used. If the rotations agree in axes without a lag, the larger correlation of angles at another
    lag is due to nearly repetitive motion.
    """
    bodies = recording.aligned_tool, recording.aligned_package
    lags, correlation = alignment.rotation_correlation(*bodies)
    if not len(lags):
        return None
    best, near = int(np.argmax(correlation)), (lags >= MIN_SWING) & (lags <= MAX_SWING)
    largest, small = correlation[best], np.max(correlation[near], initial=0.0)
    limit = alignment.MIN_CORRELATION * (1.0 if small < DISTINCT * largest else 2.0)
    if largest < limit or near[best] or _correlation_gap(small, largest) < MIN_CORRELATION_GAP:
        return None
    in_axes = alignment.rotation_correlation(*bodies, one_world=True)[1]
    near_in_axes = np.max(in_axes[near], initial=0.0)
    if near_in_axes > alignment.MIN_CORRELATION and (
            _correlation_gap(near_in_axes, np.max(in_axes)) < MIN_CORRELATION_GAP):
        return None
    return Finding('time_offset', '', lags[[best]] + SWING_DELAY, np.array([ROUGH_STD]))


def _correlation_gap(small: float, large: float) -> float:
    """Return the difference of two correlations by Fisher's transform."""
    return float(np.subtract(*np.arctanh(np.minimum([large, small], 1.0 - 1e-12))))


def _twists(recording: Recording) -> Finding | None:
    """Return the correct axes or unit of the tool's recorded twists, None if correct as given."""
    measured, half_window = recording.measured_tool, recording.filters[1].half_window
    if measured.twist is None or len(measured) <= 2 * half_window:
        return None
    if len(measured) > NOISE_SAMPLES:  # the part with most motion
        moved = np.cumsum(np.sum(measured.twist**2, axis=1))
        first = int(np.argmax(moved[NOISE_SAMPLES:] - moved[:-NOISE_SAMPLES]))
        measured = measured.select(slice(first, first + NOISE_SAMPLES))
    tool = savgol(measured, half_window, recording.filters[1].order)
    measured = measured.between(*tool.stamps_ns[[0, -1]]).select(tool.valid)
    assert measured.twist is not None and tool.twist is not None
    given, true = (twist.reshape(-1, 2, 3) for twist in (measured.twist, tool.twist[tool.valid]))
    if not len(given):
        return None
    R, markers = recording.settings.R_world_recorded, recording.alignment.R_tool_markers_tool
    is_of_tool = recording.settings.tool_twist_frame == 'tool'
    rotation = (np.swapaxes(measured.rotation, 1, 2) @ R @ markers if is_of_tool else
                markers.T @ R.T @ measured.rotation)  # from the other axes

    def misfit(twist: Array) -> float:
        """Return the relative mean squared error of twists (N, 2, 3) by the poses' own twists."""
        return float(np.sum(np.mean((twist - true) ** 2, axis=(0, 2))
                            / np.mean(true**2 + 1e-12, axis=(0, 2))))

    before = misfit(given)
    if before < MATERIAL**2:
        return None
    for finding, twist in (
            (Finding('tool_twist.frame', 'world' if is_of_tool else 'tool'),
             given @ np.swapaxes(rotation, 1, 2)),
            (IN_DEGREES, given * [[1.0], [np.pi / 180.0]])):
        if misfit(twist) < DISTINCT**4 * before:
            return finding._replace(share=1.0 - misfit(twist) / before)
    return None


def _jump(recording: Recording) -> Finding | None:
    """Return a finding on the largest of a few jumps without return, of package or marker."""
    stream = recording.report.package
    steps = lasting_steps(stream)
    if not 0 < len(steps) <= MAX_POSE_STEPS:
        return None
    R, stamps_ns = stream.recorded.rotation, stream.recorded.stamps_ns
    before = np.array([step.before for step in steps])
    turns = np.linalg.norm(lie.log_so3(np.swapaxes(R[before], 1, 2) @ R[before + 1]), axis=1)
    *others, largest = sorted(steps, key=attrgetter('position'))
    name, sizes = 'slip', [largest.position, 0.0]
    has_tails = any(step.position > TAIL_SHARE * largest.position for step in others)
    if turns.max() > MAX_SLIP_ANGLE:
        name, largest, sizes = 'turn', steps[np.argmax(turns)], [turns.max()]
    elif has_tails or stream.timing.rate_hz < LOW_RATE_HZ:  # the fit separates slips from tails
        return None
    since = (stamps_ns[largest.before] - stamps_ns[0]) / NS_PER_S
    return Finding(name, '', np.array([*sizes, since]), np.zeros(len(sizes) + 1))


def _smoothed(recording: Recording) -> Finding | None:
    """Return a finding if poses are low-pass filtered: their noise decays too steeply."""
    topics = [topic for topic, poses in (('tool_pose', recording.aligned_tool),
                                         ('package_pose', recording.aligned_package))
              if _noise_order(poses) > MAX_NOISE_ORDER]
    return Finding('low-pass', ' and '.join(topics)) if topics else None


def _noise_order(poses: Trajectory) -> float:
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
