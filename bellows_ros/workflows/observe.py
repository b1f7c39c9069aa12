"""The gain by measured poses of the package in the live prediction of a recording."""

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
from operator import itemgetter
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.identification.result import POSE_UNITS
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.live.load import ALL, Vacuum
from bellows_ros.core.live.replay import compare_recorded, Messages, predictions
from bellows_ros.core.model.cup_package import cup_of, package_of
from bellows_ros.core.observer.alarm_calibration import AlarmCalibration, calibrated_alarms
from bellows_ros.core.observer.alarms import Alarm
from bellows_ros.core.observer.measurement import at_com
from bellows_ros.core.observer.observer import Calibration, Observer, Payload
from bellows_ros.core.parameters.checks import pose_text
from bellows_ros.core.recording.alignment import pose_of, world_rotation
from bellows_ros.core.recording.recording import Recording, require_one_frame
from bellows_ros.core.signals.residuals import compare, Comparison
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.bags import decoded, messages_of, read_streams
from bellows_ros.files.messages import BOOL, decode_bool
from bellows_ros.files.results import attributes
import numpy as np

ONE_WORLD = np.array([0.0] * 6 + [1.0])
"""Pose of the package's world in that of the tool where both are one."""


@dataclass(frozen=True, eq=False)
class Observed:
    """
    The recorded package beside three estimates of it, over the same time.

    Parameters
    ----------
    topic : str
        Of the measured poses.
    prediction, camera, both : Comparison
        Predicted from the tool alone; the newest measured pose; predicted and corrected. Each
        knows at any stamp what had been measured before it, and no more.
    counts : mapping of str to int
        Measured poses that were used, and those that were not, by reason.
    alarms : tuple of (float, Alarm)
        What was found to be wrong, and when, s from the first pose of the tool.
    payload : Payload or None
        What mass and centre of mass were found to be, where payload.estimate is set.
    calibration : Calibration or None
        By how much the camera was found to be off, where measured.calibrate is set.
    parameters : mapping
        Parameters that take this into account, with what stays uncertain.
    alarm_calibration : AlarmCalibration or None
        What alarms must allow for, where it was asked.

    """

    topic: str
    prediction: Comparison
    camera: Comparison
    both: Comparison
    counts: Mapping[str, int]
    alarms: tuple[tuple[float, Alarm], ...]
    payload: Payload | None = None
    calibration: Calibration | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    alarm_calibration: AlarmCalibration | None = None

    @property
    def sentence(self) -> str:
        """Counts of the measured poses, and the estimated payload."""
        words = {'gate': 'outside the gate', 'not_held': "earlier than the tool's",
                 'future_stamp': "later than the tool's", 'recovered': 'from which it restarted',
                 'out_of_reach': 'where the cup cannot hold it'}
        counted = ', '.join(
            f'{count} {words.get(what, what.replace("_", " "))}'
            for what, count in self.counts.items())
        sentences = [f'Measured poses: {counted}.']
        if 2 * self.counts.get('used', 0) < sum(self.counts.values()):
            sentences.append(
                'Most of them are not used. Check that one clock stamps tool and camera, and that '
                f'measured.frame, measured.offset and recording.package_world fit {self.topic}.')
        if payload := self.payload:
            com = ', '.join(f'{1e3 * value:.2f} ± {1e3 * std:.2g}' for value, std in zip(
                payload.com, payload.com_std, strict=True))
            sentences.append(
                f'Found: mass {payload.mass:.4g} ± {payload.mass_std:.2g} kg, centre of mass '
                f'{com} mm from the lip (± is the bound of Cramér and Rao).')
        if offset := self.calibration:
            shift, turn = (', '.join(f'{1e3 * x:.2f} ± {1e3 * std:.2g}' for x, std in zip(
                *pair, strict=True)) for pair in (offset[:2], offset[2:4]))
            sentences.append(
                f'The camera is off by {shift} mm and {turn} mrad along and about the axes of the '
                f'world, its stamps by {1e3 * offset.latency:.2f} ± '
                f'{1e3 * offset.latency_std:.2g} ms.')
        if self.alarm_calibration:
            sentences.append(self.alarm_calibration.sentence)
        return ' '.join(sentences + ([] if self.alarms else ['No alarm.']))

    @property
    def alarm_lines(self) -> list[str]:
        """When each cause was found first, and what to do; how often and until when later."""
        times: dict[str, list[float]] = {}
        for seconds, alarm in self.alarms:
            times.setdefault(alarm.cause, []).append(seconds)
        messages = {alarm.cause: alarm.message for _, alarm in reversed(self.alarms)}
        return [
            f'{first:.2f} s, {cause}: {messages[cause]}' + (
                f' Found {1 + len(later)} times until {later[-1]:.2f} s.' if later else '')
            for cause, (first, *later) in times.items()]

    @property
    def estimates(self) -> dict[str, Comparison]:
        """Each estimate by its name."""
        return {
            'prediction alone': self.prediction, 'camera alone': self.camera, 'both': self.both}

    def as_json(self) -> dict[str, Any]:
        """Return the content for a JSON file: RMS errors in m and rad."""
        return {
            'topic': self.topic, 'counts': dict(self.counts),
            'alarms': [
                {'time': seconds, **attributes(
                    alarm, 'cause', 'size', 'size_std', 'second', 'odds', 'message'),
                 'units': {'size': 'm, m/s or 1'}}
                for seconds, alarm in self.alarms],
            'payload': self.payload and attributes(
                self.payload, 'mass', 'mass_std', 'com', 'com_std'),
            'calibration': self.calibration,
            'alarm_calibration': self.alarm_calibration,
            **{f'rms {name}': found.scores.rms for name, found in self.estimates.items()},
            'units': {f'rms {name}': POSE_UNITS for name in self.estimates}}


def observed(
    bag: File, recording: Recording, messages: Messages, alone: Comparison,
    values: Mapping[str, Any], topic: str, calibrate_alarms: bool = False,
) -> Observed:
    """
    Predict a recording live with the poses of the package on a topic, and compare.

    Parameters
    ----------
    bag : path
        Of the recording.
    recording : Recording
        As it was prepared.
    messages : Messages
        Of the tool.
    alone : Comparison
        The live prediction from these alone.
    values : mapping
        Parameters by name, measured.* among them.
    topic : str
        With poses of the package in the world of the recording.
    calibrate_alarms : bool
        Whether to find what alarms must allow for, see `calibrated_alarms`.

    Raises
    ------
    BellowsError
        If the recording lacks the topic, or too little of it is predicted.

    """
    stream = read_streams(bag, {'measured': topic})['measured']
    assert isinstance(stream, PoseStream)
    estimated, pose = recording.report.package_world, ONE_WORLD
    if world := values['recording.package_world']:
        pose = estimated.pose if estimated else pose_of(world)
    else:
        require_one_frame(recording.tool_pose, stream)
    R_model_tool = world_rotation(values['recording.world'], values['gravity.direction'])
    pose = _moved(pose, R_model_tool)
    values = {**values, 'recording.package_world': pose_text(pose)}
    observer = Observer(values)
    covariances = [None] * len(stream) if stream.covariance is None else stream.covariance
    measured = list(zip(
        stream.stamps_ns.tolist(), map(tuple, stream.position.tolist()),
        map(tuple, rotation_to_quaternion(stream.rotation).tolist()), covariances, strict=True))
    vacuum = _vacuum(bag, values)

    def run(by: Observer) -> Trajectory:
        live = live_predictor(values)
        live.package.observe(by)
        return predictions(live, messages, measured=measured, vacuum=vacuum)

    corrected = run(observer)
    package = recording.measured_package
    camera = _last_measured(observer, stream, package, package_of(values).com)
    prediction = alone.select(alone.stamps_ns >= camera.stamps_ns[0])
    compared = np.isin(package.stamps_ns, prediction.stamps_ns)
    tool, package = recording.measured_tool.select(compared), package.select(compared)
    camera = camera.select(np.isin(camera.stamps_ns, package.stamps_ns))
    counts = {what: n for what, n in observer.counts.items() if n}
    if later := len(measured) - sum(counts.values()):
        counts['future_stamp'] = counts.get('future_stamp', 0) + later
    counts |= {reason: len(numbers) for reason, numbers in stream.refused.items()}
    allowed = calibrated_alarms(
        run, values, float(np.ptp(stream.stamps_ns)) / NS_PER_S,
        stream.covariance is not None) if calibrate_alarms else None
    return Observed(
        topic, prediction, compare(camera, tool, package),
        compare_recorded(corrected, tool, package), counts,
        tuple(((alarm.stamp_ns - int(messages.stamps_ns[0])) * 1e-9, alarm)
              for alarm in observer.alarms),
        observer.payload, observer.calibration, {
            **_calibrated(observer.calibration, pose, R_model_tool),
            **(allowed.parameters if allowed else {})}, allowed)


def _moved(pose: Array, R: Array, shift: Array | float = 0.0) -> Array:
    """Return a pose, position and quaternion (7,), shifted and then rotated by R."""
    return np.append(R @ (pose[:3] + shift),
                     rotation_to_quaternion(R @ quaternion_to_rotation(pose[3:])))


def _calibrated(
    calibration: Calibration | None, pose: Array, R_model_tool: Array
) -> dict[str, Any]:
    """
    Return parameters with which a camera is no longer off.

    Parameters
    ----------
    calibration : Calibration or None
        In the world of the model.
    pose : ndarray (7,)
        Of the camera's world in that of the model, as it was given.
    R_model_tool : ndarray (3, 3)
        From the world of the tool to that of the model.

    """
    if calibration is None:
        return {}
    shift, shift_std, turn, turn_std, latency, latency_std = calibration
    return {
        'recording.package_world': pose_text(
            _moved(pose, R_model_tool.T @ exp_so3(-turn), -shift)),
        'measured.offset_std': (float(shift_std.max()), float(turn_std.max())),
        'measured.latency_std': math.hypot(latency, latency_std)}


def _vacuum(bag: File, values: Mapping[str, Any]) -> list[tuple[int, bool, int]]:
    """
    Return when (ns) which cup holds by the recorded vacuum, in order; see `Vacuum`.

    It is on the topic that the node listens to, of vacuum.signal, in whichever namespace.
    """
    vacuum, readings = Vacuum(values), list[tuple[int, bool, int]]()
    if (signal := values['vacuum.signal']) == 'none':
        return []
    kind, topic = {'bool': (BOOL, 'vacuum/held'),
                   'pressure': ('sensor_msgs/msg/FluidPressure', 'vacuum/pressure')}[signal]
    for name, _, log_ns, data in messages_of(bag, (kind,)):
        if not name.endswith('/' + topic):
            continue
        if signal == 'bool':
            held = decode_bool(data)
            readings += [] if held is None else [(log_ns, held, ALL)]
            continue
        message = decoded(data, kind)
        stamp = message.header.stamp
        states = vacuum.update(message.fluid_pressure, message.header.frame_id)
        readings += [] if isinstance(states, str) else [
            (stamp.sec * NS_PER_S + stamp.nanosec or log_ns, *state) for state in states]
    if not readings:
        raise BellowsError(
            f"vacuum.signal is '{signal}', but the recording has no usable {kind} on {topic}. "
            'Record it, or add --set vacuum.signal=none.')
    return sorted(readings, key=itemgetter(0))


def live_predictor(values: Mapping[str, Any]) -> LivePredictor:
    """Return a predictor of the cup and the package."""
    return LivePredictor(
        cup_of(values), package_of(values), values['gravity.magnitude'],
        values['tool_twist.frame'])


def _last_measured(
    observer: Observer, poses: PoseStream, at: Trajectory, com: Array
) -> Trajectory:
    """Return the poses of B as they were measured last before each stamp."""
    newest = np.searchsorted(poses.stamps_ns, at.stamps_ns) - 1
    inside = newest >= 0
    if inside.sum() < 2:
        raise BellowsError(
            'All measured poses are later than the recorded ones. Check that one clock stamps '
            'both.')
    rows = []
    for position, q in zip(
            poses.position.tolist(), rotation_to_quaternion(poses.rotation).tolist(), strict=True):
        measured = observer.sensor.measurement(1, tuple(position), tuple(q))
        assert not isinstance(measured, str)
        rows.append(np.concatenate(at_com(
            *measured[1:], observer.sensor.marker, tuple(com.tolist()))[:2]))
    chosen = np.array(rows)[newest[inside]]
    return Trajectory(
        at.stamps_ns[inside], chosen[:, :3], quaternion_to_rotation(chosen[:, 3:]))
