"""Send a recording through the live predictor's code at full speed, and score it."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import gc
import os
import time
from typing import Any

from bellows_ros import __version__
from bellows_ros.core.lie import apply, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live import LivePredictor, Prediction, warm_up
from bellows_ros.core.model import cup_of, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.recording.alignment import in_world, R_WORLD_MOTIVE
from bellows_ros.core.recording.preparation import Recording
from bellows_ros.core.resampling import resample
from bellows_ros.core.score import AXES, relative_coordinates, score, Scores
from bellows_ros.core.trajectory import NS_PER_S, Trajectory, TwistStream
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.recordings import load, Loaded
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
Message = tuple[int, bool, Any]
"""Stamp (ns), whether it is a twist, and its two parts as tuples."""

REPORT_EVERY = 2000


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
        Seconds of recording per second of prediction.
    bag : str
        The recording.

    """

    counts: Mapping[str, int]
    real_time_factor: float
    bag: str

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
            'real_time_factor': self.real_time_factor,
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
    tell(f'reading {os.fspath(bag)}', 0.0)
    loaded = load(bag, values)
    model = (cup_of(values), package_of(values), values['gravity'], values['tool_twist.frame'])
    warm_up(*model)
    live = LivePredictor(*model)
    live.expect_twists = loaded.tool_twist is not None
    messages = list(tool_messages(loaded, values))
    began = time.perf_counter()
    predictions = _run(live, messages, tell)
    elapsed = time.perf_counter() - began
    comparison = compare(predicted_trajectory(predictions), loaded.recording)
    span = (messages[-1][0] - messages[0][0]) / NS_PER_S if messages else 0.0
    return Replay(
        **vars(comparison),
        counts=_counts(live, loaded),
        real_time_factor=span / elapsed,
        bag=os.fspath(bag),
    )


def tool_messages(loaded: Loaded, values: Mapping[str, Any]) -> Iterator[Message]:
    """Yield the tool's poses and twists in the order of their stamps, in frames of the model."""
    recorded = in_world(loaded.tool_pose.trajectory(), values['recording.world'])
    poses = loaded.recording.alignment.tool(recorded)
    q = rotation_to_quaternion(poses.rotation)
    kept = np.flatnonzero(loaded.recording.report.tool.outliers.good)
    items: list[Message] = [
        (stamp, False, (tuple(o), tuple(quaternion)))
        for stamp, o, quaternion in zip(
            poses.stamps_ns[kept].tolist(), poses.position[kept].tolist(), q[kept].tolist(),
            strict=True,
        )
    ]  # fmt: skip
    if loaded.tool_twist is not None:
        items += _twist_messages(loaded.tool_twist, loaded.recording, values)
        items.sort(key=lambda item: item[0])
    yield from items


def _twist_messages(
    twists: TwistStream, recording: Recording, values: Mapping[str, Any]
) -> list[Message]:
    """Return the recorded twists, in the axes that tool_twist.frame names."""
    turn = np.eye(3)
    if values['tool_twist.frame'] == 'tool':
        turn = recording.alignment.R_tool_markers_tool.T
    elif values['recording.world'] == 'motive_y_up':
        turn = R_WORLD_MOTIVE
    linear, angular = (apply(turn, part) for part in (twists.linear, twists.angular))
    return [
        (stamp, True, (tuple(v), tuple(w)))
        for stamp, v, w in zip(
            twists.stamps_ns.tolist(), linear.tolist(), angular.tolist(), strict=True
        )
    ]


def _run(live: LivePredictor, messages: list[Message], tell: Progress) -> list[Prediction]:
    """Return the predictions for messages in order."""
    predictions: list[Prediction] = []
    with _without_collector():
        for number, (stamp, is_twist, (first, second)) in enumerate(messages):
            if number % REPORT_EVERY == 0:
                tell('predicting', number / len(messages))
            if is_twist:
                predictions += live.on_twist(stamp, first, second)
            else:
                predictions += live.on_pose(stamp, 'world', first, second)
    predictions += live.flush()
    tell('done', 1.0)
    return predictions


@contextmanager
def _without_collector() -> Iterator[None]:
    """
    Keep the garbage collector from looking through all predictions again and again.

    None of them is garbage, and it took a fifth of the time of a long replay.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def predicted_trajectory(predictions: list[Prediction]) -> Trajectory:
    """Return predictions as a trajectory of B in the world with body twists."""
    if len(predictions) < 2:
        raise BellowsError(
            f'The predictor made {len(predictions)} predictions, which is too few to compare. '
            'Check the recording, and whether the cup can carry the package.'
        )
    return Trajectory(
        np.array([p.stamp_ns for p in predictions]),
        np.array([p.position for p in predictions]),
        quaternion_to_rotation(np.array([p.quaternion_xyzw for p in predictions])),
        np.array([[*p.linear, *p.angular] for p in predictions]),
    )


def compare(predicted: Trajectory, recording: Recording) -> Comparison:
    """
    Compare a prediction with what a recording has measured, at the recording's own stamps.

    Parameters
    ----------
    predicted : Trajectory
        Poses of B in the world with body twists.
    recording : Recording
        With the poses of tool and package, aligned but not filtered.

    """
    stamps = recording.measured_package.stamps_ns
    inside = (stamps >= predicted.stamps_ns[0]) & (stamps <= predicted.stamps_ns[-1])
    usable = inside & recording.measured_package.valid & recording.measured_tool.valid
    tool = recording.measured_tool.select(usable)
    at_stamps = resample(predicted, stamps[usable])
    measured = relative_coordinates(tool, recording.measured_package.select(usable))
    coordinates = relative_coordinates(tool, at_stamps)
    return Comparison(stamps[usable], measured, coordinates, score(measured, coordinates))


def _counts(live: LivePredictor, loaded: Loaded) -> dict[str, int]:
    """Return messages in, predictions out, and what was left out on the way, where any was."""
    counts = {
        'poses': live.poses_in, 'twists': live.twists_in, 'predictions': live.predictions,
        'twists estimated': live.twists_estimated,
    }  # fmt: skip
    left_out = {
        'tool poses left out as outliers': loaded.recording.report.tool.marked,
        **{f'tool poses refused: {r}': len(w) for r, w in loaded.tool_pose.refused.items()},
        **{f'predictor refused: {reason}': n for reason, n in live.refused.items()},
        **{f'predictor restarted: {reason}': n for reason, n in live.restarts.items()},
    }
    return counts | {name: count for name, count in left_out.items() if count}
