"""What a camera adds: errors beside other filters' on the same recording, and what it costs."""

from pathlib import Path
import tempfile
import time
from typing import Any

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import exp_so3, log_so3, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_streams
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.replay import replay
import numpy as np
from scipy.spatial.transform import Rotation

from .paths import shaken_tool
from .step_case import CUP, PACKAGE
from .timing import figures

BAGS = Path(__file__).resolve().parents[1] / 'bags'
TOPICS = {'tool': '/tool_arm/pose', 'twist': '/tool_arm/twist', 'package': '/package/pose'}
SEEN = '/camera/box'
NOISE = 2e-3, 1e-2
"""Of the camera, m and rad along each axis."""
EVERY = 12
"""The package is recorded at 360 Hz, the camera sees it at 30 Hz."""
SETTLED = 2.0
"""Errors count from then on, s."""
AS_IT_COMES = np.array([
    0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015])
"""Variances of robot_localization's process noise in a second, as it is shipped."""
LOUDER = 10.0 ** np.arange(0, 9)
"""The peers may choose by which their noise of what changes fastest is larger; the best counts."""
BESIDE = {'package.com': (0.01, 0.0, -0.03), 'payload.estimate': True}
"""The package is gripped 10 mm beside where its data have it."""


def run(short: bool) -> dict[str, Any]:
    """Return RMS errors (m, rad) by estimate, times of one update and of a pose (s)."""
    parameters = read_parameters(BAGS / 'cup.yaml') | read_parameters(BAGS / 'package.yaml')
    errors: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        poses = filmed(Path(folder) / 'bag')
        for grip, more in (('', {}), (', gripped 10 mm beside', BESIDE)):
            found = replay(Path(folder) / 'bag', parameters | more, observe=SEEN).observed
            assert found is not None
            known = np.isfinite(found.both.error).all(axis=1)
            known &= found.both.stamps_ns > found.both.stamps_ns[0] + SETTLED * 1e9
            errors |= {
                name + (grip if name != 'camera alone' else ''): _rms(own.error[known])
                for name, own in found.estimates.items()}
    truth, camera = poses['package'].trajectory(), poses['camera'].trajectory()
    true = truth.select(np.isin(truth.stamps_ns, found.both.stamps_ns[known]))
    louder = LOUDER[3:4] if short else LOUDER
    tuned = [AS_IT_COMES * np.repeat([0.01, factor], [9, 6]) for factor in louder]
    for name, noises in (('robot_localization, as shipped', [AS_IT_COMES]),
                         ('robot_localization, noise tuned', tuned)):
        rows = [_peer(noise, camera, true) for noise in noises]
        errors[name] = {what: min(row[what] for row in rows) for what in rows[0]}
    return {
        'noise': {'position': NOISE[0] * 3**0.5, 'rotation': NOISE[1] * 3**0.5},
        'errors': errors, 'seconds': costs(short),
    }


def _rms(error: Array) -> dict[str, float]:
    """Return RMS lengths of errors (N, 6) in position and rotation."""
    position, rotation = (
        float(np.sqrt(np.square(part).sum(axis=1).mean())) for part in np.hsplit(error, 2))
    return {'position': position, 'rotation': rotation}


def filmed(folder: Path) -> dict[str, PoseStream]:
    """Write the shipped validation with a camera, and return poses of package and camera."""
    streams: dict[str, Any] = dict(read_streams(BAGS / 'validation', TOPICS))
    package, twist, rng = streams['package'], streams['twist'], np.random.default_rng(1)
    which = np.arange(EVERY - 1, len(package.stamps_ns), EVERY)
    shifts, turns = (rng.normal(size=(len(which), 3)) * noise for noise in NOISE)
    streams['camera'] = PoseStream(
        SEEN, package.frame_id, package.stamps_ns[which], package.position[which] + shifts,
        package.rotation[which] @ exp_so3(turns))
    write_bag(folder, [
        *(as_messages(topic, 'geometry_msgs/msg/PoseStamped', streams[role].stamps_ns, np.hstack(
            [streams[role].position, rotation_to_quaternion(streams[role].rotation)]))
          for role, topic in (*TOPICS.items(), ('camera', SEEN)) if role != 'twist'),
        as_messages(TOPICS['twist'], 'geometry_msgs/msg/TwistStamped', twist.stamps_ns,
                    np.hstack([twist.linear, twist.angular]))])
    return streams


# ------------------------------------------------------------------- peers


def _peer(process: Array, camera: Trajectory, true: Trajectory) -> dict[str, float]:
    """Return the errors of a filter that sees the camera alone."""
    position, rotation = robot_localization(
        process, camera.stamps_ns, camera.position, camera.rotation, true.stamps_ns)
    turn = log_so3(np.swapaxes(true.rotation, 1, 2) @ rotation)
    return _rms(np.hstack([position - true.position, turn]))


def robot_localization(
    process: Array, stamps_ns: Stamps, position: Array, rotation: Array, at_ns: Stamps
) -> tuple[Array, Array]:
    """
    Return poses as the package robot_localization filters them (Moore and Stouch 2014).

    An extended Kalman filter on position, roll, pitch, yaw, and velocity, rate and acceleration
    in axes of the body, that go on as they are; `process` are variances (15,) in a second. As in
    its `ekf.cpp`: noise grows with time, angles of innovations are wrapped, P is of Joseph's form,
    and begins with that of the first pose, and with 1e-9 for all else.
    """
    x, P = np.zeros(15), np.eye(15) * 1e-9
    euler = Rotation.from_matrix(rotation).as_euler('xyz')  # roll, pitch, yaw
    x[:3], x[3:6] = position[0], euler[0]
    P[:6, :6] = R = np.diag(np.repeat(np.square(NOISE), 3))
    out, newest, k = [], int(stamps_ns[0]), 1
    for stamp in at_ns.tolist():
        while k < len(stamps_ns) and stamps_ns[k] < stamp:
            x, P = _go_on(x, P, (stamps_ns[k] - newest) * 1e-9, process)
            newest = int(stamps_ns[k])
            y = np.r_[position[k], euler[k]] - x[:6]
            y[3:] = (y[3:] + np.pi) % (2.0 * np.pi) - np.pi
            gain = P[:, :6] @ np.linalg.inv(P[:6, :6] + R)
            A = np.eye(15)
            A[:, :6] -= gain
            x, P = x + gain @ y, A @ P @ A.T + gain @ R @ gain.T
            k += 1
        out.append(_moved(x, (stamp - newest) * 1e-9)[:6])
    rows = np.array(out)
    return rows[:, :3], Rotation.from_euler('xyz', rows[:, 3:]).as_matrix()


def _go_on(x: Array, P: Array, seconds: float, process: Array) -> tuple[Array, Array]:
    """Return state and covariance a time later."""
    later, size = _moved(x, seconds), 1e-6
    F = np.column_stack([
        (_moved(x + size * unit, seconds) - later) / size for unit in np.eye(15)])
    return later, F @ P @ F.T + seconds * np.diag(process)


def _moved(x: Array, seconds: float) -> Array:
    """Return a state after a time in which its accelerations stay."""
    roll, pitch = x[3:5]
    later, turn = x.copy(), Rotation.from_euler('xyz', x[3:6]).as_matrix()
    later[:3] += turn @ (seconds * x[6:9] + 0.5 * seconds**2 * x[12:15])
    s, c, t = np.sin(roll), np.cos(roll), np.tan(pitch)
    along = 1.0 / np.cos(pitch)
    rates = np.array([[1.0, s * t, c * t], [0.0, c, -s], [0.0, s * along, c * along]])
    later[3:6] += seconds * rates @ x[9:12]
    later[6:9] += seconds * x[12:15]
    return later


# ------------------------------------------------------------------- costs


def costs(short: bool) -> dict[str, Any]:
    """Return seconds per pose of the tool at 500 Hz, and per pose of a camera at 30 Hz."""
    rows = shaken_tool(1000 if short else 10_000, 500.0)
    stamps = ((np.arange(len(rows)) + 500) * 2_000_000).tolist()
    states = [state_row(row[:3], row[3:7], row[7:]) for row in rows]
    found = {'pose without a camera': _follow(stamps, states, None)[0]}
    for name, alarms in (('', 1.0), (', no alarms', 0.0)):
        observer = Observer(resolve({'alarm.false_per_hour': alarms}, ()))
        found['pose with one' + name], found['measured pose' + name] = _follow(
            stamps, states, observer)
    return {name: figures(times[len(times) // 4:]) for name, times in found.items()}


def _follow(
    stamps: list[int], states: list[State], observer: Observer | None
) -> tuple[list[float], list[float]]:
    """Return how long each pose, and each measured pose, takes; what is seen is as predicted."""
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.pairing.expect = True
    if observer is not None:
        live.package.observe(observer)
    poses, seen = [], []
    for k, (stamp_ns, (position, q, linear, angular)) in enumerate(
            zip(stamps, states, strict=True)):
        live.on_twist(stamp_ns, linear, angular)
        start = time.perf_counter()
        (there,) = live.on_pose(stamp_ns, 'world', position, q)
        poses.append(time.perf_counter() - start)
        if observer is not None and k % 17 == 16:
            start = time.perf_counter()
            live.on_measured(stamp_ns, 'world', there.position, there.quaternion_xyzw)
            seen.append(time.perf_counter() - start)
    return poses, seen
