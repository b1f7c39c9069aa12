"""
Validation of a cup on a recording that was not used for its identification.

The model is simulated freely through the whole recording, driven by the tool's motion alone. The
tool is smoothed lightly, as its noise drives the package. The effect of the noise of both bodies
on the comparison is simulated too: a larger error is a model error.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.identification.least_squares import envelope
from bellows_ros.core.identification.result import Cause, CHANCE, MAJORITY
from bellows_ros.core.identification.segments import path_half_window, PATH_ORDER
from bellows_ros.core.identification.unknowns import as_found, KINDS
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import (
    rest,
    simulate,
    state_row,
    tool_rows,
)
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.recording.alignment import rest_of
from bellows_ros.core.recording.recording import NOISE_SAMPLES, Recording
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.core.signals.savgol import bridged, savgol, weights, with_filtered_noise
from bellows_ros.core.signals.screening import LONGEST_GAP_NS
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError
import numpy as np

LIGHT_HALF_WINDOW = 1 / 60
"""Half window of the light smoothing of the tool, s: a pass band of 20 Hz."""

LIGHT_ORDER = 4
"""Order of the light smoothing of the tool."""

MAX_NRMSE = 0.05
"""Largest NRMSE accepted in the thesis."""

REST_S = 0.3
"""Shortest initial rest of both bodies in a recording that begins at rest, s."""

FRAME_STEP = 1e-4
"""Change of a number of a centre of mass or a marker frame, for its effect, m or rad."""

MIN_SHARE_GAIN = 0.1
"""Smallest additional share of the error that a marker frame explains, which has more numbers than
a centre of mass."""

DRAW_SEED = 0
"""Seed of the added noise, fixed for reproducible results."""


class FreeRun(NamedTuple):
    """
    A free simulation of a segment.

    It has the tool with twists and the package at the stamps of the tool, the first state of the
    package, and its origin: 'equilibrium' or 'measured'.
    """

    tool: Trajectory
    package: Trajectory
    state: State
    start: str


class CornerScores(NamedTuple):
    """
    Errors of a prediction in the corners of a tag, weighted by the variances of the views, rad.

    Parameters
    ----------
    rms, noise, motion : float
        RMS error, its part by noise of the corners, and RMS motion relative to the tool.
    largest : float
        Largest RMS error of one view.
    samples : int
        Number of views.
    focal : float
        Focal length of the camera, pixels; 0 if unknown.

    """

    rms: float
    noise: float
    motion: float
    largest: float
    samples: int
    focal: float = 0.0

    @property
    def chi2(self) -> float:
        """Square of the error over its noise."""
        return (self.rms / self.noise)**2

    @property
    def nrmse(self) -> float:
        """RMS error over RMS motion."""
        return self.rms / self.motion if self.motion > 0.0 else np.nan

    def as_json(self) -> dict[str, object]:
        """Return the content for a JSON file."""
        return {**self._asdict(), 'chi2': self.chi2, 'nrmse': self.nrmse}


def corner_scores(recording: Recording, package: Trajectory) -> CornerScores | None:
    """Return the errors of predicted poses of B in the corners of a tag; None for a body."""
    views, tool = recording.views, recording.aligned_tool
    if views is None:
        return None
    first, last = (end(body.stamps_ns[at] for body in (tool, package))
                   for end, at in ((max, 0), (min, -1)))
    views = views.select((views.stamps_ns >= first) & (views.stamps_ns <= last))
    tool, package = (
        resample(body, views.stamps_ns, LONGEST_GAP_NS) for body in (tool, package))
    valid = tool.valid & package.valid
    views, tool, package = views.select(valid), tool.select(valid), package.select(valid)
    if not len(package):
        return None
    mean = residuals.relative_coordinates(tool, package).mean(axis=0)
    fixed = replace(package, position=tool.position + lie.apply(tool.rotation, mean[:3]),
                    rotation=tool.rotation @ lie.exp_so3(mean[3:]))
    errors, variances = views.errors(package)
    weights = 1.0 / variances / np.sum(1.0 / variances)
    rms, motion = (float(np.sqrt(weights @ np.mean(each**2, axis=1)))
                   for each in (errors, views.errors(fixed)[0]))
    return CornerScores(
        rms, float(np.mean(1.0 / variances)**-0.5), motion,
        float(np.sqrt(np.mean(errors**2, axis=1).max())), len(errors),
        recording.package_pose.focal)


@dataclass(frozen=True, eq=False)
class Validation(residuals.Comparison):
    """
    Comparison of a recording with its free simulation, at the measured package poses.

    Parameters
    ----------
    cup : Cup
        Simulated cup.
    recording : Recording
        Recording.
    runs : tuple of FreeRun
        Simulations of the segments.
    findings : tuple of Finding
        Gaps of the tool.

    """

    cup: Cup
    recording: Recording
    runs: tuple[FreeRun, ...]
    findings: tuple[Finding, ...]

    @cached_property
    def tool(self) -> Trajectory:
        """Motion of E with twists."""
        return _joined([run.tool for run in self.runs])

    @cached_property
    def package(self) -> Trajectory:
        """Motion of B in the free simulation, at the stamps of the tool."""
        return _joined([run.package for run in self.runs])

    @property
    def model(self) -> ModelTuple:
        """The cup with the package of the recording, as the kernels take them."""
        return model_tuple(self.cup, self.recording.payload, self.recording.settings.gravity)

    @cached_property
    def noise(self) -> Array:
        """RMS error (6,) due to measurement noise of package and tool alone, m and rad."""
        poses, settings = self.recording.aligned_tool, self.recording.settings
        rate_hz, rng = uniform_rate_hz(poses.stamps_ns), np.random.default_rng(DRAW_SEED)
        W, squares = weights(half_window_of(poses), LIGHT_ORDER, rate_hz), []
        sizes, correlations = np.transpose(self.recording.ar1_noise[0])
        samples = NOISE_SAMPLES // len(self.runs)
        for run in 2 * self.runs:  # two draws of the noise
            tool, body = (each.select(slice(samples)) for each in (run.tool, run.package))
            noisy = with_filtered_noise(tool, sizes, correlations, W, 1.0 / rate_hz, rng)
            moved = simulate(self.cup, self.recording.payload, noisy, run.state, settings.gravity)
            squares.append(np.subtract(*(
                residuals.relative_coordinates(tool, each) for each in (moved, body)))**2)
        variances = np.mean(np.concatenate(squares), axis=0)
        std = self.recording.body_noise[1].std
        if self.recording.views:
            std = self.recording.poses_near(self.runs[0].package)[1]
        return np.asarray(np.sqrt(variances + std**2))

    @property
    def envelope(self) -> Envelope:
        """Validity range of the free simulation, without noise of the package's poses."""
        return envelope(self.tool, self.package, self.recording.payload, self.cup.length)

    @cached_property
    def corners(self) -> CornerScores | None:
        """Errors in the corners of a tag, which rate the prediction; None for a body."""
        return corner_scores(self.recording, self.package)

    @property
    def moves(self) -> Mask:
        """Mask (6,) of the axes with enough motion for noise to stay within the limit."""
        return np.asarray(self.scores.motion * MAX_NRMSE > self.noise)

    @property
    def model_error(self) -> Array:
        """RMS error (6,) in excess of noise, relative to the motion."""
        excess = np.sqrt(np.maximum(self.scores.rms**2 - self.noise**2, 0.0))
        ratio: Array = np.full(6, np.nan)
        np.divide(excess, self.scores.motion, out=ratio, where=self.scores.motion > 0.0)
        return ratio

    def failing(self, limit: float = MAX_NRMSE) -> tuple[str, ...]:
        """Return the names of the moving axes with NRMSE above a limit; of a tag, 'corners'."""
        if self.corners:
            return () if self.corners.nrmse <= limit else ('corners',)
        above = self.moves & ~(self.scores.nrmse <= limit)
        return tuple(AXES[i] for i in np.flatnonzero(above))

    @property
    def worse_than_noise(self) -> tuple[str, ...]:
        """Names of the failing axes with errors above `CHANCE` times the noise."""
        if self.corners:
            return self.failing() if self.corners.chi2 > CHANCE**2 else ()
        beyond = self.scores.rms > CHANCE * self.noise
        return tuple(name for name in self.failing() if beyond[AXES.index(name)])

    def verdict(self, limit: float = MAX_NRMSE) -> Finding:
        """Return the finding on whether corners or moving axes are within a limit."""
        failing = self.failing(limit)
        if corners := self.corners:
            return Finding('corners', Level.OK, {
                'rms': corners.rms, 'motion': corners.motion, 'ratio': corners.nrmse,
                'pixels': (f'{corners.rms * corners.focal:.2g} pixels, '
                           if corners.focal > 0.0 else ''),
                'chi2': corners.chi2, 'relation': (
                    'above' if self.worse_than_noise else
                    'by noise alone above' if failing else 'within'),
                'limit': limit, 'position': float(self.scores.rms[:3].max()),
                'rotation': float(self.scores.rms[3:].max())})
        if not (failing or self.moves.any()):
            return Finding('small_motion')
        return Finding('above_limit', Level.OK, {'limit': limit, 'axes': failing or ('none',)})


def validate(cup: Cup, recording: Recording) -> Validation:
    """
    Simulate a recording from start to end, and compare both at the rate of the tool.

    Parameters
    ----------
    cup : Cup
        Cup under test.
    recording : Recording
        Recording that was not used for the identification.

    Raises
    ------
    BellowsError
        If the recording is too short, the cup cannot carry the package, or the simulation does
        not stay finite.

    """
    poses = recording.aligned_tool
    first, last = recording.measured_tool.stamps_ns[[0, -1]]
    poses = poses.select(slice(max(int(np.searchsorted(poses.stamps_ns, first, 'right')) - 1, 0),
                               int(np.searchsorted(poses.stamps_ns, last)) + 1))
    runs = [_run(cup, recording, part, is_first=not number)
            for number, part in enumerate(_segments_of(poses, recording))]
    findings = [
        Finding('gap', Level.WARN, {'duration': (after - before) / NS_PER_S,
                                    'begin': (before - recording.start_ns) / NS_PER_S})
        for before, after in ((int(one.tool.stamps_ns[-1]), int(other.tool.stamps_ns[0]))
                              for one, other in pairwise(runs))]
    compared = [_compared(recording, run, first, last) for run in runs]
    stamps, measured, predicted = (np.concatenate([getattr(each, name) for each in compared])
                                   for name in ('stamps_ns', 'measured', 'predicted'))
    return Validation(
        stamps, measured, predicted, residuals.score(measured, predicted), cup=cup,
        recording=recording, runs=tuple(runs), findings=tuple(findings))


def _segments_of(poses: Trajectory, recording: Recording) -> list[Trajectory]:
    """Return the tool's poses in the segments of a recording; all poses for one segment."""
    spans = [span for span in recording.segments() if span.first_ns < poses.stamps_ns[-1]]
    valid = poses.stamps_ns[poses.valid][1:-1]  # outer stamps may exceed a span
    if len(spans) == 1 and not np.any(
            (valid < spans[0].first_ns) | (valid > spans[0].last_ns)):
        return [poses]
    return [poses.between(span.first_ns, span.last_ns) for span in spans] or [poses]


def _run(cup: Cup, recording: Recording, poses: Trajectory, is_first: bool) -> FreeRun:
    """Return the free simulation of a segment."""
    payload, gravity = recording.payload, recording.settings.gravity
    tool = recording.cached(
        ('smoothed', int(poses.stamps_ns[0]), len(poses)),
        lambda: smoothed_tool(poses, half_window_of(poses)))
    model = model_tuple(cup, payload, gravity)
    state, begin, start = _start(model, tool, recording, is_first)
    tool = resample(tool, np.append(begin, tool.stamps_ns[tool.stamps_ns > begin]))
    return FreeRun(tool, simulate(cup, payload, tool, state, gravity), state, start)


def _compared(
    recording: Recording, run: FreeRun, first: int, last: int
) -> residuals.Comparison:
    """Return the comparison of a free simulation with the measured poses of the package."""
    measured = recording.tracked_package.between(
        max(run.tool.stamps_ns[0], first), min(run.tool.stamps_ns[-1], last))
    if recording.views:
        predicted = resample(run.package, measured.stamps_ns)
        measured = recording.poses_near(predicted)[0]
    return residuals.compare(
        resample(run.package, measured.stamps_ns),
        resample(recording.aligned_tool, measured.stamps_ns,
                 recording.report.tool.timing.longest_step_ns), measured)


def _joined(parts: list[Trajectory]) -> Trajectory:
    """Return the concatenation of trajectories with twists."""
    if not parts[1:]:
        return parts[0]
    stamps, position, rotation, twist, valid = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ('stamps_ns', 'position', 'rotation', 'twist', 'valid'))
    return Trajectory(stamps, position, rotation, twist, valid=valid)


def smoothed_tool(measured: Trajectory, half_window: int) -> Trajectory:
    """
    Return the tool with twists at every usable stamp, with gaps bridged (see `bridged`).

    Parameters
    ----------
    measured : Trajectory
        Poses of E at a uniform rate, not smoothed.
    half_window : int
        Half window of the filter, samples.

    Raises
    ------
    BellowsError
        If there are fewer poses than a window.

    """
    filtered = savgol(
        bridged(measured, path_half_window(measured), PATH_ORDER), half_window, LIGHT_ORDER)
    usable = np.flatnonzero(filtered.valid)
    if len(usable) < 2:
        raise BellowsError(
            f'The tool has fewer than {2 * half_window + 1} usable poses in a row, so nothing '
            'can be simulated.')
    return replace(filtered.select(slice(int(usable[0]), int(usable[-1]) + 1)), acceleration=None)


def half_window_of(tool: Trajectory) -> int:
    """Return the half window of the light smoothing, in samples."""
    rate_hz = uniform_rate_hz(tool.stamps_ns)
    return max(round(LIGHT_HALF_WINDOW * rate_hz), LIGHT_ORDER // 2 + 1)


def _start(
    model: ModelTuple, tool: Trajectory, recording: Recording, is_first: bool
) -> tuple[State, int, str]:
    """Return the package's first state, its stamp (ns), and its origin."""
    if not is_first or (
            rest_of(recording.measured_tool, recording.measured_package).seconds < REST_S):
        package = recording.package
        first_ns, last_ns = tool.stamps_ns[[0, -1]]
        usable = package.valid & (package.stamps_ns >= first_ns) & (package.stamps_ns < last_ns)
        first = int(np.argmax(usable))
        if usable[first]:
            (row,) = tool_rows(package.select(slice(first, first + 1)))
            return state_row(*np.split(row, [3, 7])), int(package.stamps_ns[first]), 'measured'
    state = rest(model, tool_rows(tool.select(slice(0, 1)))[0])
    return state, int(tool.stamps_ns[0]), 'equilibrium'


def frame_cause(found: Validation) -> Cause | None:
    """
    Return a centre of mass or a marker frame that explains most of the error beyond noise, if any.

    The error is linear in both: simulations with each of their numbers changed give its slopes.
    """
    if found.corners or not found.worse_than_noise:
        return None
    usable = np.isfinite(found.error).all(axis=1)
    error = found.error[usable] / found.noise
    beyond = float(np.sum(error**2)) - error.size
    causes = list[Cause]()
    for name in ('com', 'package_marker'):
        steps = FRAME_STEP * np.eye(KINDS[name].size)
        try:
            changed = [validate(found.cup, as_found(found.recording, {name: step[None]}, 0))
                       for step in steps]
        except BellowsError:  # the cup cannot hold a changed package
            continue
        slopes = np.stack([((each.error - found.error)[usable] / found.noise).ravel()
                           for each in changed], axis=1) / FRAME_STEP
        theta, *_ = np.linalg.lstsq(slopes, -error.ravel(), rcond=None)
        left = error.ravel() + slopes @ theta
        std = np.sqrt(np.diag(np.linalg.pinv(slopes.T @ slopes)) * max(np.mean(left**2), 1.0))
        share = (float(np.sum(error**2)) - float(np.sum(left**2))) / beyond
        if share > MAJORITY and share > sum(cause.share for cause in causes) + MIN_SHARE_GAIN:
            causes = [Cause(name, '', np.asarray(theta), np.asarray(std), share, certain=False)]
    return causes[0] if causes else None
