"""Processor time of a camera: per pose and per correction."""

import time
from typing import Any

from bellows_ros.core.live import LivePredictor
from bellows_ros.core.model.kernels import State
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.values import Values
import numpy as np

from .paths import shaken_tool
from .step_case import CUP, PACKAGE
from .timing import figures


def run(short: bool) -> dict[str, Any]:
    """Return seconds per pose of the tool at 500 Hz, and per pose of a camera at 30 Hz."""
    rows = shaken_tool(1000 if short else 10_000, 500.0)
    stamps = ((np.arange(len(rows)) + 500) * 2_000_000).tolist()
    states = [state_row(row[:3], row[3:7], row[7:]) for row in rows]
    result = {'pose without a camera': _follow(stamps, states, None)[0]}
    for name, alarms in (('', 1.0), (', no alarms', 0.0)):
        result['pose with one' + name], result['measured pose' + name] = _follow(
            stamps, states, resolve({'alarm.false_per_hour': alarms}, ()))
    return {'seconds': {
        name: figures(times[len(times) // 4:]) for name, times in result.items()}}


def _follow(
    stamps: list[int], states: list[State], values: Values | None
) -> tuple[list[float], list[float]]:
    """Return the times (s) of each pose and of each measured pose, measured as predicted."""
    live = LivePredictor(CUP, PACKAGE, 9.81, 'tool')
    live.expect_twists(True)
    if values is not None:
        live.package.observer.use_values(values)
        live.package.set_model(CUP, PACKAGE)
    poses, measured_times = [], []
    for k, (stamp_ns, (position, q, linear, angular)) in enumerate(
            zip(stamps, states, strict=True)):
        live.on_twist(stamp_ns, linear, angular)
        start = time.perf_counter()
        (prediction,) = live.on_pose(stamp_ns, 'world', position, q)
        poses.append(time.perf_counter() - start)
        if values is not None and k % 17 == 16:
            start = time.perf_counter()
            live.on_measured(stamp_ns, 'world', prediction.position, prediction.quaternion_xyzw)
            measured_times.append(time.perf_counter() - start)
    return poses, measured_times
