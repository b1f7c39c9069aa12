"""Send a recording through the live predictor's code at full speed, and score it."""

from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
import os
import time
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.lie import apply, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor, Prediction, warm_up
from bellows_ros.core.model import cup_of, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.alignment import in_world, R_WORLD_MOTIVE
from bellows_ros.core.recording.preparation import Recording, TimeOffset
from bellows_ros.core.resampling import resample
from bellows_ros.core.score import AXES, relative_coordinates, score, Scores
from bellows_ros.core.trajectory import Mask, NS_PER_S, Stamps, Trajectory, TwistStream
from bellows_ros.core.tuples import Vector
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.recordings import load, Loaded
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

REPORT_EVERY = 2000
AT_ONCE = 2000
"""So many messages are Python objects at a time: the garbage collector looks through them."""


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
        for start in range(0, len(self), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            for stamp_ns, is_twist, (a, b, c, d, e, f, g) in zip(
                self.stamps_ns[part].tolist(), self.is_twist[part].tolist(),
                self.numbers[part].tolist(), strict=True,
            ):  # fmt: skip
                yield stamp_ns, is_twist, (a, b, c), (d, e, f) if is_twist else (d, e, f, g)


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    Predicted and measured package as seen from the tool.

    Parameters
    ----------
    stamps_ns : ndarray (N,)
        Of the measured package poses that were compared.
    measured, predicted : ndarray (N, 6)
        Tool-relative coordinates: position of B (m) and rotation vector (rad) in E axes.
    scores : Scores
        Errors per axis.

    """

    stamps_ns: NDArray[np.int64]
    measured: Array
    predicted: Array
    scores: Scores


@dataclass(frozen=True, eq=False)
class Replay(Comparison):
    """
    A replayed recording.

    Parameters
    ----------
    counts : mapping of str to int
        Messages in, predictions out, and all that was left out or restarted.
    real_time_factor : float
        Seconds of recording per second of predicting, which is all that a live node does.
    took : mapping of str to float
        Wall time (s) of 'preparing' (reading, cleaning, compiled code), 'predicting', 'comparing'.
    bag : str
        The recording.
    time_offset : TimeOffset or None
        What was taken from the tool's stamps, where that was wanted and could be found.

    """

    counts: Mapping[str, int]
    real_time_factor: float
    took: Mapping[str, float]
    bag: str
    time_offset: TimeOffset | None

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file; m for x, y, z and rad for rx, ry, rz."""
        scores = self.scores
        return {
            'bag': self.bag,
            'axes': AXES,
            'units': ['m'] * 3 + ['rad'] * 3,
            'rms': scores.rms,
            'largest': scores.largest,
            'motion': scores.motion,
            'nrmse': scores.nrmse,
            'samples': scores.samples,
            'counts': dict(self.counts),
            'time_offset': self.time_offset and self.time_offset._asdict(),
            'real_time_factor': self.real_time_factor,
            'seconds': dict(self.took),
            'version': __version__,
        }


def replay(
    bag: str | os.PathLike[str],
    settings: Mapping[str, object],
    progress: Progress | None = None,
) -> Replay:
    """
    Send a recording's tool messages through the predictor and compare with its package poses.

    Tool poses that are marked as tracking outliers are left out, and counted.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    settings : mapping
        Parameters by name: cup, package, topics and how it was recorded.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.

    Raises
    ------
    BellowsError
        If a parameter or the recording is not usable, or nothing can be compared.

    """
    values: dict[str, Any] = resolve(settings, PACKAGE_PARAMETERS)
    tell = progress or (lambda what, part: None)
    times = [time.perf_counter()]
    tell(f'reading {os.fspath(bag)}', 0.0)
    loaded = load(bag, values)
    messages, left_out = tool_messages(loaded, values), _left_out(loaded)
    measured = loaded.recording.measured_tool, loaded.recording.measured_package
    offset = loaded.recording.report.time_offset
    del loaded  # with all that was filtered: a seventh of the peak of memory
    model = (cup_of(values), package_of(values), values['gravity'], values['tool_twist.frame'])
    warm_up(*model)
    live = LivePredictor(*model)
    live.expect_twists = bool(messages.is_twist.any())
    times.append(time.perf_counter())
    predicted = _run(live, messages, tell)
    times.append(time.perf_counter())
    comparison = compare(predicted, *measured)
    times.append(time.perf_counter())
    preparing, predicting, comparing = np.diff(times).tolist()
    return Replay(
        **vars(comparison),
        counts=_counts(live, left_out),
        real_time_factor=float(np.ptp(messages.stamps_ns)) / NS_PER_S / predicting,
        took={'preparing': preparing, 'predicting': predicting, 'comparing': comparing},
        bag=os.fspath(bag),
        time_offset=offset,
    )


def tool_messages(loaded: Loaded, values: Mapping[str, Any]) -> Messages:
    """Return the tool's poses and twists in the order of their stamps, in frames of the model."""
    recorded = in_world(loaded.tool_pose.trajectory(), values['recording.world'])
    poses = loaded.recording.alignment.tool(recorded)
    good = loaded.recording.report.tool.outliers.good
    stamps = [poses.stamps_ns[good]]
    numbers = [np.hstack([poses.position, rotation_to_quaternion(poses.rotation)])[good]]
    if loaded.tool_twist is not None:
        stamps.append(loaded.tool_twist.stamps_ns)
        numbers.append(_twist_numbers(loaded.tool_twist, loaded.recording, values))
    joined = np.concatenate(stamps)
    order = np.argsort(joined, kind='stable')  # a pose comes before the twist of its stamp
    return Messages(joined[order], order >= len(stamps[0]), np.concatenate(numbers)[order])


def _twist_numbers(
    twists: TwistStream, recording: Recording, values: Mapping[str, Any]
) -> Array:
    """Return the recorded twists, in the axes that tool_twist.frame names, as in `Messages`."""
    turn = np.eye(3)
    if values['tool_twist.frame'] == 'tool':
        turn = recording.alignment.R_tool_markers_tool.T
    elif values['recording.world'] == 'motive_y_up':
        turn = R_WORLD_MOTIVE
    linear, angular = (apply(turn, part) for part in (twists.linear, twists.angular))
    return np.hstack([linear, angular, np.zeros((len(linear), 1))])


def _run(live: LivePredictor, messages: Messages, tell: Progress) -> Trajectory:
    """Return the predictions for messages in order: B in the world with body twists."""
    stamps, numbers = array('q'), array('d')

    def keep(predictions: list[Prediction]) -> None:
        for stamp_ns, position, quaternion_xyzw, linear, angular, *_ in predictions:
            stamps.append(stamp_ns)
            numbers.extend((*position, *quaternion_xyzw, *linear, *angular))

    for number, (stamp_ns, is_twist, first, second) in enumerate(messages):
        if number % REPORT_EVERY == 0:
            tell('predicting', number / len(messages))
        if is_twist:
            keep(live.on_twist(stamp_ns, first, second))
        else:
            keep(live.on_pose(stamp_ns, 'world', first, second))
    keep(live.flush())
    tell('done', 1.0)
    return predicted_trajectory(np.array(stamps), np.array(numbers).reshape(-1, 13))


def predicted_trajectory(stamps_ns: Stamps, rows: Array) -> Trajectory:
    """Return predictions, rows (N, 13), as a trajectory of B in the world with body twists."""
    if len(rows) < 2:
        raise BellowsError(
            f'The predictor made {len(rows)} predictions, which is too few to compare. '
            'Check the recording, and whether the cup can carry the package.'
        )
    rotation = quaternion_to_rotation(rows[:, 3:7])
    return Trajectory(stamps_ns, rows[:, :3], rotation, rows[:, 7:])


def compare(predicted: Trajectory, tool: Trajectory, package: Trajectory) -> Comparison:
    """
    Compare a prediction with what a recording has measured, at the recording's own stamps.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world with body twists.
    tool, package : Trajectory
        Measured poses of E and B at common stamps, aligned but not filtered.

    """
    stamps = package.stamps_ns
    inside = (stamps >= predicted.stamps_ns[0]) & (stamps <= predicted.stamps_ns[-1])
    usable = inside & package.valid & tool.valid
    tool_there = tool.select(usable)
    at_stamps = resample(predicted, stamps[usable])
    measured = relative_coordinates(tool_there, package.select(usable))
    coordinates = relative_coordinates(tool_there, at_stamps)
    return Comparison(stamps[usable], measured, coordinates, score(measured, coordinates))


def _left_out(loaded: Loaded) -> dict[str, int]:
    """Return the tool poses that the predictor does not get, by reason."""
    return {
        'tool poses left out as outliers': loaded.recording.report.tool.marked,
        **{f'tool poses refused: {r}': len(w) for r, w in loaded.tool_pose.refused.items()},
    }


def _counts(live: LivePredictor, left_out: Mapping[str, int]) -> dict[str, int]:
    """Return messages in, predictions out, and what was left out on the way, where any was."""
    counts = {
        'poses': live.poses_in, 'twists': live.twists_in, 'predictions': live.predictions,
        'twists estimated': live.twists_estimated,
    }  # fmt: skip
    on_the_way = {
        **left_out,
        **{f'predictor refused: {reason}': n for reason, n in live.refused.items()},
        **{f'predictor restarted: {reason}': n for reason, n in live.restarts.items()},
    }
    return counts | {name: count for name, count in on_the_way.items() if count}
