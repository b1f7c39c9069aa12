"""What a camera adds: errors with and without it on the same recording, and what it costs."""

from pathlib import Path
import tempfile
import time
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_streams
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.replay import replay
import numpy as np

from .paths import shaken_tool
from .step_case import CUP, PACKAGE
from .timing import figures

BAGS = Path(__file__).resolve().parents[1] / 'bags'
TOPICS = {'tool': '/tool_arm/pose', 'twist': '/tool_arm/twist', 'package': '/package/pose'}
CAMERA_TOPIC = '/camera/box'
NOISE = 2e-3, 1e-2
"""Of the camera, m and rad along each axis."""
IMAGE_STEP = 12
"""The package is recorded at 360 Hz, the camera sees it at 30 Hz."""
SETTLING_TIME = 2.0
"""Errors count from then on, s."""
OFFSET_GRIP = {'package.com': (0.01, 0.0, -0.03), 'payload.estimate': True}
"""The package is gripped 10 mm beside where its data have it."""


def run(short: bool) -> dict[str, Any]:
    """Return RMS errors (m, rad) by estimate, times of one update and of a pose (s)."""
    parameters = read_parameters(BAGS / 'cup.yaml') | read_parameters(BAGS / 'package.yaml')
    errors: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        add_camera(Path(folder) / 'bag')
        for grip, more in (('', {}), (', gripped 10 mm beside', OFFSET_GRIP)):
            result = replay(Path(folder) / 'bag', parameters | more, observe=CAMERA_TOPIC).observed
            assert result is not None
            both = result.estimates['both']
            counted = np.isfinite(both.error).all(axis=1)
            counted &= both.stamps_ns > both.stamps_ns[0] + SETTLING_TIME * 1e9
            errors |= {
                name + (grip if name != 'camera alone' else ''): _rms(estimate.error[counted])
                for name, estimate in result.estimates.items()}
    return {
        'noise': {'position': NOISE[0] * 3**0.5, 'rotation': NOISE[1] * 3**0.5},
        'errors': errors, 'seconds': costs(short)}


def _rms(error: Array) -> dict[str, float]:
    """Return RMS lengths of errors (N, 6) in position and rotation."""
    position, rotation = (
        float(np.sqrt(np.square(part).sum(axis=1).mean())) for part in np.hsplit(error, 2))
    return {'position': position, 'rotation': rotation}


def add_camera(folder: Path) -> None:
    """Write the shipped validation with a camera."""
    streams: dict[str, Any] = dict(read_streams(BAGS / 'validation', TOPICS))
    package, twist, rng = streams['package'], streams['twist'], np.random.default_rng(1)
    which = np.arange(IMAGE_STEP - 1, len(package.stamps_ns), IMAGE_STEP)
    shifts, turns = (rng.normal(size=(len(which), 3)) * noise for noise in NOISE)
    streams['camera'] = PoseStream(
        CAMERA_TOPIC, package.frame_id, package.stamps_ns[which], package.position[which] + shifts,
        package.rotation[which] @ exp_so3(turns))
    write_bag(folder, [
        *(as_messages(topic, 'geometry_msgs/msg/PoseStamped', streams[role].stamps_ns, np.hstack(
            [streams[role].position, rotation_to_quaternion(streams[role].rotation)]))
          for role, topic in (*TOPICS.items(), ('camera', CAMERA_TOPIC)) if role != 'twist'),
        as_messages(TOPICS['twist'], 'geometry_msgs/msg/TwistStamped', twist.stamps_ns,
                    np.hstack([twist.linear, twist.angular]))])


def costs(short: bool) -> dict[str, Any]:
    """Return seconds per pose of the tool at 500 Hz, and per pose of a camera at 30 Hz."""
    rows = shaken_tool(1000 if short else 10_000, 500.0)
    stamps = ((np.arange(len(rows)) + 500) * 2_000_000).tolist()
    states = [state_row(row[:3], row[3:7], row[7:]) for row in rows]
    result = {'pose without a camera': _follow(stamps, states, None)[0]}
    for name, alarms in (('', 1.0), (', no alarms', 0.0)):
        observer = Observer(resolve({'alarm.false_per_hour': alarms}, ()))
        result['pose with one' + name], result['measured pose' + name] = _follow(
            stamps, states, observer)
    return {name: figures(times[len(times) // 4:]) for name, times in result.items()}


def _follow(
    stamps: list[int], states: list[State], observer: Observer | None
) -> tuple[list[float], list[float]]:
    """Return how long each pose, and each measured pose, takes; what is seen is as predicted."""
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.expect_twists(True)
    if observer is not None:
        live.package.observe(observer)
    poses, measured_times = [], []
    for k, (stamp_ns, (position, q, linear, angular)) in enumerate(
            zip(stamps, states, strict=True)):
        live.on_twist(stamp_ns, linear, angular)
        start = time.perf_counter()
        (prediction,) = live.on_pose(stamp_ns, 'world', position, q)
        poses.append(time.perf_counter() - start)
        if observer is not None and k % 17 == 16:
            start = time.perf_counter()
            live.on_measured(stamp_ns, 'world', prediction.position, prediction.quaternion_xyzw)
            measured_times.append(time.perf_counter() - start)
    return poses, measured_times
