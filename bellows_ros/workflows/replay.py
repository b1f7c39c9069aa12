"""Prediction of a recording with a cup, also with measured poses, and errors of the prediction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import os
import time
from typing import Any, NamedTuple

from bellows_ros.core import no_progress, Progress
from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.validation import (
    corner_scores,
    CornerScores,
    DRAW_SEED,
    frame_cause,
    MAX_NRMSE,
    validate,
    Validation,
)
from bellows_ros.core.identification.verdict import cause_finding
from bellows_ros.core.live import Predictor, warm_up
from bellows_ros.core.live.cycle import Signal
from bellows_ros.core.live.recorded import Messages, predicted_trajectory
from bellows_ros.core.model import validity_range
from bellows_ros.core.model.grip import Margin
from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.results import Payload
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.conversion import cup_of, package_of
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.effect import smallest_margin
from bellows_ros.core.recording.alignment import in_world, pose_of, world_rotation
from bellows_ros.core.recording.recording import (
    LOW_RATE_HZ,
    Recording,
    require_one_frame,
)
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.screening import LONGEST_GAP_NS
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
from bellows_ros.errors import BellowsError, require_types
from bellows_ros.files import detections, File, results
from bellows_ros.report.findings import text, warnings
from bellows_ros.workflows import CommandResult
from bellows_ros.workflows.holds import signals_of
from bellows_ros.workflows.recordings import (
    checked,
    estimate_finding,
    load,
    sensor_findings,
    tag_sought,
)
import numpy as np


@dataclass(frozen=True, eq=False)
class Live(residuals.Comparison):
    """
    The live prediction from recorded messages, compared with the recording.

    Parameters
    ----------
    counts : mapping of str to int
        Numbers of incoming messages, predictions, omitted messages and restarts.
    real_time_factor : float
        Duration of the recording per processing time of the predictor.
    corners : CornerScores or None
        Errors in the corners of a tag; None for a body.

    """

    counts: Mapping[str, int]
    real_time_factor: float
    corners: CornerScores | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file."""
        return {
            **vars(self.scores), 'nrmse': self.scores.nrmse, 'counts': dict(self.counts),
            'real_time_factor': self.real_time_factor, 'corners': self.corners}


class Observed(NamedTuple):
    """
    The recorded package and two live predictions over a common time.

    Parameters
    ----------
    topic : str
        Topic of the measured poses.
    estimates : mapping of str to residuals.Comparison
        'prediction alone', from the tool; 'both', corrected by the measured poses before its
        stamp.
    counts : mapping of str to int
        Numbers of used measured poses, and of others by reason.
    alarms : tuple of (float, Alarm)
        Alarms with their times, s from the first pose of the tool.
    payload : Payload or None
        Estimated mass and centre of mass, if payload.estimate is set.
    corners : mapping of str to CornerScores
        Errors in the corners of a tag without and with corrections; empty for a body.

    """

    topic: str
    estimates: Mapping[str, residuals.Comparison]
    counts: Mapping[str, int]
    alarms: tuple[tuple[float, Alarm], ...]
    payload: Payload | None
    corners: Mapping[str, CornerScores | None]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the counts of the measured poses, and on the estimated payload."""
        mostly = 2 * self.counts.get('used', 0) >= sum(self.counts.values())
        counted = ', '.join(f'{what.replace("_", " ")} {n}' for what, n in self.counts.items())
        found = [Finding('measured_poses', Level.OK if mostly else Level.WARN, {
            'counted': counted}, self.topic)]
        if payload := self.payload:
            found += [estimate_finding('package.mass', payload.mass, payload.mass_std, 'kg'),
                      estimate_finding('package.com', payload.com, payload.com_std, 'm')]
        return tuple(found)

    @property
    def alarm_lines(self) -> list[str]:
        """Lines with the first alarm of each kind and a remedy, and its later alarms."""
        times: dict[str, list[float]] = {}
        for seconds, alarm in self.alarms:
            times.setdefault(alarm.kind, []).append(seconds)
        first = {alarm.kind: text(alarm.finding) for _, alarm in reversed(self.alarms)}
        return [f'{at[0]:.2f} s, {kind}: {first[kind]}' + (
            f' Found {len(at)} times until {at[-1]:.2f} s.' if at[1:] else '')
            for kind, at in times.items()]

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file: RMS errors in m and rad."""
        return {
            'topic': self.topic, 'counts': dict(self.counts),
            'alarms': [
                {'time': seconds, **results.attributes(
                    alarm, 'kind', 'shift', 'rotation', 'parameter', 'value', 'std'),
                 'message': text(alarm.finding)}
                for seconds, alarm in self.alarms],
            'payload': self.payload and results.attributes(
                self.payload, 'mass', 'mass_std', 'com', 'com_std'),
            'corners': self.corners,
            **{f'rms {name}': estimate.scores.rms for name, estimate in self.estimates.items()}}


@dataclass(frozen=True, eq=False)
class Replay(CommandResult):
    """
    A recording predicted with a cup.

    Parameters
    ----------
    bag : str
        Path of the recording.
    values : mapping
        All parameters of the run.
    recording : Recording
        Prepared recording.
    validation : Validation
        Result of the free simulation.
    findings : tuple of Finding
        Findings on the simulation and the validity range.
    live : Live or None
        Result of the live predictor, None if not requested.
    observed : Observed or None
        Result with measured poses of the package, None if not requested.
    limit : float or None
        Largest accepted NRMSE; None for `MAX_NRMSE` of errors that noise does not explain.

    """

    bag: str
    values: Values
    recording: Recording
    validation: Validation
    findings: tuple[Finding, ...] = ()
    live: Live | None = None
    observed: Observed | None = None
    limit: float | None = None

    @property
    def largest_nrmse(self) -> float:
        """Largest accepted NRMSE."""
        return MAX_NRMSE if self.limit is None else self.limit

    @property
    def succeeded(self) -> bool:
        """Whether the errors are within the limit, or explained by noise."""
        return not (self.validation.worse_than_noise if self.limit is None else
                    self.validation.failing(self.limit))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on the findings and on the recording."""
        return (*warnings(self.findings), *map(text, self.recording.report.remarks))

    @cached_property
    def margin(self) -> Margin | None:
        """Smallest safety factor of the grip in the free simulation; None if unknown."""
        free = self.validation
        return smallest_margin(conversion.grip_of(self.values), free.model, free.tool,
                               free.package, self.recording.since_start(free.tool.stamps_ns))

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        validation = self.validation
        return results.plain_items({
            'bag': self.bag,
            'axes': residuals.AXES,
            **vars(validation.scores),
            'nrmse': validation.scores.nrmse,
            'noise_rms': validation.noise,
            'model_error': validation.model_error,
            'moves': validation.moves,
            'corners': validation.corners,
            'limit': self.largest_nrmse,
            'above_limit': validation.failing(self.largest_nrmse),
            'start': validation.runs[0].start,
            'margin': self.margin,
            'time_offset': self.recording.report.time_offset,
            'seed': DRAW_SEED,
            'live': self.live,
            'observed': self.observed,
            'warnings': self.warnings,
            'settings': dict(self.values),
            'provenance': results.provenance([self.bag])})


def replay(
    bag: File, settings: Mapping[str, Any], progress: Progress = no_progress, observe: str = '',
) -> Replay:
    """
    Predict a recording with a cup, freely from start to end, and compare both.

    There are two predictions: a simulation with the smoothed tool, for the accuracy of the cup,
    and the live predictor with the recorded messages, for the output of the node.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    settings : mapping
        Parameters by name: cup, package, topics and settings of the recording.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    observe : str
        Topic with measured poses of the package, which correct a second live prediction; default:
        none.

    Raises
    ------
    BellowsError
        If a parameter or the recording is unusable, or the cup cannot hold the package.

    """
    require_types(recording=(bag, str, os.PathLike))
    values = checks.resolve(settings, checks.RECORDING_PARAMETERS)
    progress(f'reading {os.fspath(bag)}', 0.0)
    is_other = observe not in ('', values.topics.package_pose)  # measured.* is of observe
    own = values.replaced({name: PARAMETERS[name].default for name in (
        'measured.offset', 'measured.latency', 'measured.scale')}) if is_other else values
    recording, signals = load(bag, own), signals_of(bag, values)
    rated = load(bag, own, held=True) if signals else recording
    if is_other:
        recording, rated = (replace(each, settings=replace(each.settings, tag=None))
                            for each in (recording, rated))
    rated = checked(rated)
    progress('simulating', 0.3)
    free = validated(values, rated)
    cause = frame_cause(free.validation)
    sent = _tool_messages(recording, values)
    live = _predicted_live(
        recording, values, lambda what, part: progress(what, 0.4 + 0.6 * part), sent, signals)
    findings, observed = [*free.findings], None
    if cause:
        findings.append(cause_finding(cause, values))
    if observe:
        observed, of_sensor = _observed(bag, recording, sent, live, values, observe, signals)
        findings += of_sensor
    progress('done', 1.0)
    return replace(free, live=live, observed=observed, findings=tuple(findings))


def validated(values: Values, recording: Recording) -> Replay:
    """Simulate a prepared recording with the cup of the parameters, and compare both."""
    validation = validate(cup_of(values), recording)
    found = [*validation.findings]
    valid = conversion.parameter_envelope(values)
    if valid and (outside := validity_range.beyond(valid, validation.envelope)):
        found.append(Finding('outside', Level.WARN, {'ranges': outside}))
    return Replay(recording.name, values, recording, validation, tuple(found))


def _predicted_live(
    recording: Recording, values: Values, progress: Progress, messages: Messages,
    signals: Sequence[Signal],
) -> Live:
    """
    Predict a recording live from its tool messages, and compare it with the package's poses.

    Outliers of the tool's poses are omitted, and counted. With signals the package is predicted
    while it is held.
    """
    warm_up(cup_of(values), package_of(values), values.gravity.magnitude,
            values.tool_twist.frame)
    live = live_predictor(values, signals)
    start = time.perf_counter()
    predicted = predicted_trajectory(live, messages, progress, signals=signals)
    took = time.perf_counter() - start
    recorded = float(np.ptp(messages.stamps_ns)) / NS_PER_S
    compared = _compared(predicted, *compared_poses(recording))
    return Live(
        **vars(compared), counts=_counts(live, recording),
        real_time_factor=recorded / took,
        corners=corner_scores(recording, predicted))


def _tool_messages(recording: Recording, values: Values) -> Messages:
    """Return the tool's poses and twists in the order of their stamps, in frames of the model."""
    R_model_tool = world_rotation(values.recording.world, values.gravity.direction)
    poses = recording.alignment.tool(in_world(recording.tool_pose.trajectory(), R_model_tool))
    poses = poses.select(recording.report.tool.outliers.good)
    twists, stamps_ns = recording.tool_twist, poses.stamps_ns
    if twists is not None:
        stamps_ns = np.concatenate([stamps_ns, twists.stamps_ns])
    order = np.argsort(stamps_ns, kind='stable')  # poses come before twists of equal stamps
    is_twist, numbers = order >= len(poses.stamps_ns), np.zeros((len(order), 7))
    numbers[~is_twist, :3] = poses.position
    numbers[~is_twist, 3:] = lie.rotation_to_quaternion(poses.rotation)
    if twists is not None:
        axes = R_model_tool  # from recorded axes to the axes of tool_twist.frame
        if values.tool_twist.frame == 'tool':
            axes = recording.alignment.R_tool_markers_tool.T
        numbers[is_twist, :3] = lie.apply(axes, twists.linear)
        numbers[is_twist, 3:6] = lie.apply(axes, twists.angular)
    return Messages(stamps_ns[order], is_twist, numbers)


def _counts(live: Predictor, recording: Recording) -> dict[str, int]:
    """Return the numbers of incoming messages, predictions and omitted messages."""
    lost = {
        'tool poses left out as outliers': recording.report.tool.marked,
        **{f'tool poses refused: {r}': len(w) for r, w in recording.tool_pose.refused.items()},
        **{f'predictor refused: {reason}': n for reason, n in live.refused.items()},
        **{f'predictor restarted: {reason}': n for reason, n in live.restarts.items()}}
    return {
        'poses': live.screen.poses, 'twists': live.pairing.twists, 'predictions': live.predictions,
        'twists estimated': live.motion.estimated,
        **{name: count for name, count in lost.items() if count}}


# ------------------------------------------------------------------ measured poses of the package


def _measured_stream(
    bag: File, recording: Recording, values: Values, topic: str
) -> tuple[PoseStream, Array]:
    """Return measured poses of a package, and the pose (7,) of their world in the model's."""
    contents = detections.read_contents(bag, {'measured': topic}, tag_sought(values))
    for problem in contents.problems.values():
        raise problem
    stream = contents.streams['measured']
    assert isinstance(stream, PoseStream)
    estimated, pose = recording.report.package_world, np.eye(7)[6]
    if world := values.recording.package_world:
        pose = estimated.pose if estimated else pose_of(world)
    else:
        require_one_frame(recording.tool_pose, stream)
    R_model_tool = world_rotation(values.recording.world, values.gravity.direction)
    return stream, np.append(R_model_tool @ pose[:3], lie.rotation_to_quaternion(
        R_model_tool @ lie.quaternion_to_rotation(pose[3:])))


def _messages_of(stream: PoseStream) -> list[tuple[int, Any, Any, Any]]:
    """Return stamp (ns), position, quaternion and covariance of each measured pose."""
    covariances = [None] * len(stream) if stream.covariance is None else stream.covariance
    position, q = stream.position.tolist(), lie.rotation_to_quaternion(stream.rotation).tolist()
    return list(zip(stream.stamps_ns.tolist(), map(tuple, position), map(tuple, q), covariances,
                    strict=True))


def _observed(
    bag: File, recording: Recording, messages: Messages, uncorrected: Live,
    values: Values, topic: str, signals: Sequence[Signal],
) -> tuple[Observed, tuple[Finding, ...]]:
    """Predict live with measured poses; return the comparison, and findings on the sensor."""
    stream, pose = _measured_stream(bag, recording, values, topic)
    values = values.replaced({'recording.package_world': checks.pose_text(pose)})
    measured = _messages_of(stream)
    live = live_predictor(values, signals)
    observer = live.package.observer
    corrected = predicted_trajectory(live, messages, measured=measured, signals=signals)
    is_later = uncorrected.stamps_ns > stream.stamps_ns[0]
    if is_later.sum() < 2:
        raise BellowsError(
            'All measured poses are later than the recorded ones. Check that one clock stamps '
            'both.')
    prediction = uncorrected.select(is_later)
    tool, package = (body.select(np.isin(body.stamps_ns, prediction.stamps_ns))
                     for body in compared_poses(recording))
    counts = {what: n for what, n in observer.counts.items() if n}
    if later := len(measured) - sum(counts.values()):
        counts['future_stamp'] = counts.get('future_stamp', 0) + later
    counts |= {reason: len(numbers) for reason, numbers in stream.refused.items()}
    return Observed(
        topic,
        {'prediction alone': prediction, 'both': _compared(corrected, tool, package)}, counts,
        tuple(((alarm.stamp_ns - int(messages.stamps_ns[0])) / NS_PER_S, alarm)
              for alarm in observer.alarms),
        observer.payload,
        {'prediction alone': uncorrected.corners,
         'both': corner_scores(recording, corrected)} if recording.views else {},
    ), sensor_findings(stream, values.measured.tag_size > 0.0)


def live_predictor(values: Values, signals: Sequence[Signal]) -> Predictor:
    """Return a predictor in the world of the model; without signals its package is held."""
    in_model: dict[str, Any] = {
        'tool_pose.offset': '', 'gravity.direction': (0.0, 0.0, -1.0)}
    if not signals:
        in_model['vacuum.signal'] = 'none'
    return Predictor.from_parameters(values.replaced(in_model))


def compared_poses(recording: Recording) -> tuple[Trajectory, Trajectory]:
    """Return measured tool and package at stamps of both, or of the package if that is slow."""
    timing, tool = recording.report.tool.timing, recording.aligned_tool
    if recording.report.package.timing.rate_hz >= LOW_RATE_HZ:
        return recording.measured_tool, recording.measured_package
    package = recording.tracked_package.between(*tool.stamps_ns[[0, -1]])
    return resample(tool, package.stamps_ns, timing.longest_step_ns), package


def _compared(
    predicted: Trajectory, tool: Trajectory, package: Trajectory
) -> residuals.Comparison:
    """Compare a prediction with a recording as `compare_recorded`, within the predicted time."""
    after = np.searchsorted(predicted.stamps_ns, package.stamps_ns)
    after = after.clip(1, len(predicted) - 1)
    gaps_ns = predicted.stamps_ns[after] - predicted.stamps_ns[after - 1]
    inside = gaps_ns <= LONGEST_GAP_NS
    return residuals.compare_recorded(predicted, tool.select(inside), package.select(inside))
