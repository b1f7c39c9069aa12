"""Recorded messages through the live predictor at full speed, and the error of its predictions."""

from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.live.predictor import LivePredictor
from bellows_ros.core.live.uncertainty import Prediction
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.residuals import compare, Comparison
from bellows_ros.core.signals.trajectory import frozen, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

BLOCK = 2000
"""Messages held as Python objects at a time, to spare the garbage collector."""


@dataclass(frozen=True, eq=False)
class Messages:
    """
    Poses and twists of the tool in the order of their stamps.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
    is_twist : bool ndarray (N,)
    numbers : ndarray (N, 7)
        Position (m) and quaternion (x, y, z, w); of a twist the linear and the angular velocity
        (m/s, rad/s), and a zero.

    """

    stamps_ns: Stamps
    is_twist: Mask
    numbers: Array

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamps_ns)

    def __iter__(self) -> Iterator[tuple[int, bool, Vector, Any]]:
        """Yield stamp (ns), whether it is a twist, and its two parts as tuples."""
        for start in range(0, len(self), BLOCK):
            part = slice(start, start + BLOCK)
            for stamp_ns, is_twist, (a, b, c, d, e, f, g) in zip(
                self.stamps_ns[part].tolist(), self.is_twist[part].tolist(),
                self.numbers[part].tolist(), strict=True,
            ):
                yield stamp_ns, is_twist, (a, b, c), (d, e, f) if is_twist else (d, e, f, g)


def predictions(
    live: LivePredictor, messages: Messages,
    progress: Callable[[str, float], None] = lambda what, part: None,
    measured: Sequence[tuple[Any, ...]] = (), vacuum: Sequence[tuple[int, bool, int]] = (),
) -> Trajectory:
    """
    Return the live predictions for messages in order: B in the world with body twists.

    Measured poses of the package (stamp, position, quaternion, covariance or None), in order, are
    given to it before the first message after their stamp, as are readings of the vacuum (stamp,
    whether it holds, of which cup).

    Raises
    ------
    BellowsError
        If it predicts fewer than two poses.

    """
    stamps, numbers = array('q'), array('d')

    def store(predicted: list[Prediction]) -> None:
        for stamp_ns, position, quaternion_xyzw, linear, angular, *_ in predicted:
            stamps.append(stamp_ns)
            numbers.extend((*position, *quaternion_xyzw, *linear, *angular))

    live.pairing.expect = bool(messages.is_twist.any())
    poses, readings = deque(measured), deque(vacuum)
    for number, (stamp_ns, is_twist, first, second) in enumerate(messages):
        if number % BLOCK == 0:
            progress('predicting', number / len(messages))
        while poses and poses[0][0] < stamp_ns:
            measured_ns, *pose = poses.popleft()
            live.on_measured(measured_ns, 'world', *pose)
        while readings and readings[0][0] < stamp_ns:
            live.on_vacuum(*readings.popleft()[1:])
        store(live.on_twist(stamp_ns, first, second) if is_twist
              else live.on_pose(stamp_ns, 'world', first, second))
    store(live.flush())
    if len(stamps) < 2:
        raise BellowsError(
            f'The predictor made {len(stamps)} predictions, too few to compare. Check the '
            'recording, and whether the cup can hold the package.')
    rows = frozen(np.frombuffer(numbers).reshape(-1, 13))
    rotation = frozen(quaternion_to_rotation(rows[:, 3:7]))
    return Trajectory(np.array(stamps), rows[:, :3], rotation, rows[:, 7:])


def compare_recorded(predicted: Trajectory, tool: Trajectory, package: Trajectory) -> Comparison:
    """
    Compare a prediction with a recording, at the recording's own stamps.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world with body twists, at any stamps.
    tool, package : Trajectory
        Measured poses of E and B at common stamps, aligned but not filtered.

    """
    stamps = package.stamps_ns
    inside = slice(*np.searchsorted(stamps, predicted.stamps_ns[[0, -1]] + [0, 1]).tolist())
    at_stamps = resample(predicted, stamps[inside])
    return compare(at_stamps, tool.select(inside), package.select(inside))
