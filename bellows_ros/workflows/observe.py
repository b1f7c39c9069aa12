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
        said = [f'Measured poses: {counted}.']
        if 2 * self.counts.get('used', 0) < sum(self.counts.values()):
            said.append(
                'Most of them are not used. Check that one clock stamps tool and camera, and that '
                f'measured.frame, measured.offset and recording.package_world fit {self.topic}.')
        if found := self.payload:
            com = ', '.join(f'{1e3 * value:.2f} ± {1e3 * std:.2g}' for value, std in zip(
                found.com, found.com_std, strict=True))
            said.append(
                f'Found: mass {found.mass:.4g} ± {found.mass_std:.2g} kg, centre of mass {com} mm '
                'from the lip (± is the bound of Cramér and Rao).')
        if off := self.calibration:
            shift, turn = (', '.join(f'{1e3 * x:.2f} ± {1e3 * std:.2g}' for x, std in zip(
                *pair, strict=True)) for pair in (off[:2], off[2:4]))
            said.append(
                f'The camera is off by {shift} mm and {turn} mrad along and about the axes of the '
                f'world, its stamps by {1e3 * off.latency:.2f} ± {1e3 * off.latency_std:.2g} ms.')
        if self.alarm_calibration:
            said.append(self.alarm_calibration.sentence)
        return ' '.join(said + ([] if self.alarms else ['No alarm.']))

    @property
    def alarm_lines(self) -> list[str]:
        """When each cause was found first, and what to do; how often and until when later."""
        times: dict[str, list[float]] = {}
        lines: dict[str, str] = {}
        for seconds, alarm in self.alarms:
            lines.setdefault(alarm.cause, f'{seconds:.2f} s, {alarm.cause}: {alarm.message}')
            times.setdefault(alarm.cause, []).append(seconds)
        return [
            line + (f' Found {len(times[cause])} times until {times[cause][-1]:.2f} s.'
                    if times[cause][1:] else '') for cause, line in lines.items()]

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
    found, pose = recording.report.package_world, ONE_WORLD
    if world := values['recording.package_world']:
        pose = found.pose if found else pose_of(world)
    else:
        require_one_frame(recording.tool_pose, stream)
    turn = world_rotation(values['recording.world'], values['gravity.direction'])
    q = rotation_to_quaternion(turn @ quaternion_to_rotation(pose[3:]))
    values = {**values, 'recording.package_world': pose_text(np.append(turn @ pose[:3], q))}
    observer = Observer(values)
    covariances = [None] * len(stream) if stream.covariance is None else stream.covariance
    seen = list(zip(
        stream.stamps_ns.tolist(), map(tuple, stream.position.tolist()),
        map(tuple, rotation_to_quaternion(stream.rotation).tolist()), covariances, strict=True))

    vacuum = _vacuum(bag, values)

    def run(by: Observer) -> Trajectory:
        live = live_predictor(values)
        live.package.observe(by)
        return predictions(live, messages, measured=seen, vacuum=vacuum)

    corrected = run(observer)
    held = _held(observer, stream, recording.measured_package, package_of(values).com)
    package = recording.measured_package
    prediction = alone.select(alone.stamps_ns >= held.stamps_ns[0])
    known = np.isin(package.stamps_ns, prediction.stamps_ns)
    tool, package = recording.measured_tool.select(known), package.select(known)
    held = held.select(np.isin(held.stamps_ns, package.stamps_ns))
    both = compare_recorded(corrected, tool, package)
    counts = {what: n for what, n in observer.counts.items() if n}
    if later := len(seen) - sum(counts.values()):
        counts['future_stamp'] = counts.get('future_stamp', 0) + later
    counts |= {reason: len(numbers) for reason, numbers in stream.refused.items()}
    calibration = calibrated_alarms(
        run, values, float(np.ptp(stream.stamps_ns)) / NS_PER_S,
        stream.covariance is not None) if calibrate_alarms else None
    alarms = tuple(
        ((alarm.stamp_ns - int(messages.stamps_ns[0])) * 1e-9, alarm) for alarm in observer.alarms)
    return Observed(
        topic, prediction, compare(held, tool, package), both, counts, alarms, observer.payload,
        observer.calibration, {
            **_calibrated(observer.calibration, pose, turn),
            **(calibration.parameters if calibration else {})}, calibration)


def _calibrated(found: Calibration | None, pose: Array, turn: Array) -> dict[str, Any]:
    """
    Return parameters with which a camera is no longer off.

    Parameters
    ----------
    found : Calibration or None
        In the world of the model.
    pose : ndarray (7,)
        Of the camera's world in that of the tool, as it was given.
    turn : ndarray (3, 3)
        From the world of the tool to that of the model.

    """
    if found is None:
        return {}
    back = turn.T @ exp_so3(-found.turn)
    q = rotation_to_quaternion(back @ turn @ quaternion_to_rotation(pose[3:]))
    return {
        'recording.package_world': pose_text(np.append(back @ (turn @ pose[:3] - found.shift), q)),
        'measured.offset_std': (float(found.shift_std.max()), float(found.turn_std.max())),
        'measured.latency_std': math.hypot(found.latency, found.latency_std)}


def _vacuum(bag: File, values: Mapping[str, Any]) -> list[tuple[int, bool, int]]:
    """
    Return when (ns) which cup holds by the recorded vacuum, in order; see `Vacuum`.

    It is on the topic that the node listens to, of vacuum.signal, in whichever namespace.
    """
    vacuum, readings = Vacuum(values), []
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
        stamp, found = message.header.stamp, vacuum.update(
            message.fluid_pressure, message.header.frame_id)
        stamp_ns = stamp.sec * NS_PER_S + stamp.nanosec or log_ns
        readings += [] if isinstance(found, str) else [(stamp_ns, *each) for each in found]
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


def _held(observer: Observer, poses: PoseStream, at: Trajectory, com: Array) -> Trajectory:
    """Return the poses of B as they were measured last before each stamp."""
    newest = np.searchsorted(poses.stamps_ns, at.stamps_ns) - 1
    inside = newest >= 0
    if inside.sum() < 2:
        raise BellowsError(
            'All measured poses are later than the recorded ones. Check that one clock stamps '
            'both.')
    found = []
    x, y, z = com.tolist()
    for position, q in zip(
            poses.position.tolist(), rotation_to_quaternion(poses.rotation).tolist(), strict=True):
        seen = observer.sensor.measurement(1, tuple(position), tuple(q))
        assert not isinstance(seen, str)
        found.append(np.concatenate(at_com(*seen[1:], observer.sensor.marker, (x, y, z))[:2]))
    rows = np.array(found)[newest[inside]]
    return Trajectory(at.stamps_ns[inside], rows[:, :3], quaternion_to_rotation(rows[:, 3:]))
