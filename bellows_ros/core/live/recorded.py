"""Live predictions for the messages of a recording, in the order of their stamps."""

from array import array
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from bellows_ros.core import no_progress, Progress
from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.live.cycle import Signal
from bellows_ros.core.live.predictor import Predictor
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.model.simulation import trajectory_of
from bellows_ros.core.signals.trajectory import frozen, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

PROGRESS = 2000
"""Number of messages between two reports of the progress."""


class Messages(NamedTuple):
    """Poses and twists of the tool in the order of their stamps."""

    stamps_ns: Stamps
    is_twist: Mask
    numbers: Array
    """Position (m) and quaternion (x, y, z, w) (N, 7); for a twist linear and angular velocity
    (m/s, rad/s), and a zero."""


def predicted_trajectory(
    live: Predictor, messages: Messages,
    progress: Progress = no_progress,
    measured: Sequence[tuple[Any, ...]] = (), signals: Sequence[Signal] = (),
) -> Trajectory:
    """
    Return the live predictions for messages in order: B in the world with body twists.

    Measured poses of the package (stamp, position, quaternion, covariance or None) and signals,
    both in order, are processed before the first message after their stamp.

    Raises
    ------
    BellowsError
        If there are fewer than two predictions.

    """
    stamps, numbers = array('q'), array('d')

    def store(predicted: list[Prediction]) -> None:
        for stamp_ns, position, quaternion_xyzw, linear, angular, *_ in predicted:
            stamps.append(stamp_ns)
            numbers.extend((*position, *quaternion_xyzw, *linear, *angular))

    live.expect_twists(bool(messages.is_twist.any()))
    poses, readings = deque(measured), deque(signals)
    for number, (stamp_ns, is_twist, row) in enumerate(zip(
            messages.stamps_ns.tolist(), messages.is_twist.tolist(), messages.numbers,
            strict=True)):
        if number % PROGRESS == 0:
            progress('predicting', number / len(messages.stamps_ns))
        while poses and poses[0][0] < stamp_ns:
            measured_ns, *pose = poses.popleft()
            live.on_measured(measured_ns, 'world', *pose)
        while readings and readings[0][0] < stamp_ns:
            read_ns, name, is_on, cup = readings.popleft()
            if name == 'valve':
                live.on_valve(is_on, read_ns)
            else:
                live.on_vacuum(is_on, read_ns, cup)
        x, y, z, *others = row.tolist()
        store(live.on_twist(stamp_ns, (x, y, z), tuple(others[:3])) if is_twist
              else live.on_pose(stamp_ns, 'world', (x, y, z), tuple(others)))
    store(live.flush())
    if len(stamps) < 2:
        raise BellowsError(
            f'The predictor made {len(stamps)} predictions, too few to compare. Check the '
            'recording, and whether the cup can hold the package.')
    return trajectory_of(np.array(stamps), frozen(np.frombuffer(numbers).reshape(-1, 13)))
