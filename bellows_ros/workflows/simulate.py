"""
Recordings of a known cup: a motion and its faults go in, a rosbag2 recording comes out.

What a motion file may hold, with units, stands in config/motion_example.yaml.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import io
import math
import os
from pathlib import Path
from typing import Any

from bellows_ros.core.lie import Array, rotation_to_quaternion, transform
from bellows_ros.core.linearisation import largest_step
from bellows_ros.core.model import Cup, cup_of, model_tuple, Package, package_of
from bellows_ros.core.parameters import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.simulation import simulate
from bellows_ros.core.synthetic.recipe import generator, read_recipe, Recipe
from bellows_ros.core.synthetic.sensing import (
    measure_poses,
    measure_twists,
    Measured,
    sample_stamps,
    Schedule,
    schedule,
    WORLDS,
)
from bellows_ros.core.trajectory import NS_PER_S, Stamps, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic
from bellows_ros.files.bag_writer import Recorded, write_bag
import numpy as np

Progress = Callable[[str], None]

POSE = 'geometry_msgs/msg/PoseStamped'
TWIST = 'geometry_msgs/msg/TwistStamped'

BENDING_LIMIT = math.radians(45.0)
"""Beyond this bending (rad) the modelled restoring moment falls."""

SAMPLES_PER_PERIOD = 100.0
"""The tool's motion is simulated with so many samples in the shortest period of the motion ..."""
STEPS_PER_LARGEST = 2.5
"""... and so many in the longest step that is stable. Both keep the truth right to 1e-9 m."""
LEAST_RATE = 500.0
"""... and at least at this rate, Hz."""
LARGEST_COUNT = 5_000_000
"""So many samples are simulated at most."""


@dataclass(frozen=True)
class Event:
    """An outlier or a dropout that was put in: topic, kind, and when it began, s."""

    topic: str
    kind: str
    start: float


@dataclass(frozen=True)
class SimulationReport:
    """
    What was recorded.

    Parameters
    ----------
    bag : Path
        The recording.
    truth : Path or None
        File with the true motion, where asked for.
    duration : float
        s.
    messages : mapping of topic to int
        Messages on each topic.
    events : tuple of Event
        Outliers and dropouts, by topic and time.
    largest_bending : float
        Largest angle between the z axes of tool and lip, rad.
    largest_bending_time : float
        When it was reached, s after the beginning.
    warnings : tuple of str
        What the reader should know before using the recording.

    """

    bag: Path
    truth: Path | None
    duration: float
    messages: Mapping[str, int]
    events: tuple[Event, ...]
    largest_bending: float
    largest_bending_time: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Truth:
    """True trajectories of tool E and package B at common stamps, with body twists."""

    tool: Trajectory
    package: Trajectory

    def at(self, stamps_ns: Stamps) -> 'Truth':
        """Return the samples at some of the stamps."""
        index = np.searchsorted(self.tool.stamps_ns, stamps_ns)
        return Truth(self.tool.select(index), self.package.select(index))


def simulate_recording(
    parameters: Mapping[str, object],
    motion: Mapping[str, object],
    out: str | os.PathLike[str],
    progress: Progress | None = None,
    replace: bool = False,
) -> SimulationReport:
    """
    Simulate a held package and write what a tracking system would record of it.

    The same input gives the same recording.

    Parameters
    ----------
    parameters : mapping
        Dotted names to values: cup, package and gravity; others are checked but not used.
    motion : mapping
        Content of a motion file.
    out : path
        Folder of the recording, which must not exist yet unless it may be replaced.
    progress : callable, optional
        Called with a sentence as the work goes on.
    replace : bool
        Whether a recording that is there may be replaced.

    Returns
    -------
    SimulationReport

    Raises
    ------
    BellowsError
        If a parameter or setting is missing, unknown or not allowed, the package cannot be held,
        or the output is in the way or cannot be written. Nothing is written then.

    """
    say = progress or (lambda sentence: None)
    values = resolve(parameters, PACKAGE_PARAMETERS)
    cup, package, gravity = _model(values)
    recipe = read_recipe(motion, package.com)
    bag = Path(out)
    truth_file = _output_files(bag, recipe.truth, replace)
    plans = _plans(recipe)
    say(f'simulating {recipe.motion.duration:g} s')
    truth = _simulated(cup, package, gravity, recipe, plans)
    recorded = _recorded(recipe, plans, truth)
    say(f'writing {sum(len(r.stamps_ns) for r in recorded)} messages to {bag}')
    write_bag(bag, recorded, recipe.storage, recipe.compression, replace)
    if truth_file:
        atomic.write_bytes(truth_file, _truth_bytes(cup, recipe, plans, truth))
    return _report(bag, truth_file, recipe, plans, recorded, truth)


def _model(values: Mapping[str, Any]) -> tuple[Cup, Package, float]:
    """Return cup, package and gravity (m/s^2) of complete parameters."""
    return cup_of(values), package_of(values), values['gravity']


def _output_files(bag: Path, truth: bool, replace: bool) -> Path | None:
    """Refuse a recording that is in the way, before the work; return where the truth goes."""
    if os.path.lexists(bag) and not replace:
        raise BellowsError(f"Output '{bag}' exists. Give another name, or remove it first.")
    if not os.path.lexists(bag):
        atomic.require_file_target(bag)  # the folder around it is there
    return atomic.require_file_target(bag.with_name(f'{bag.name}_truth.npz')) if truth else None


def _plans(recipe: Recipe) -> dict[str, Schedule]:
    """Return when 'tool' and 'package' are sampled."""
    motion = recipe.motion
    return {
        name: schedule(
            sensor,
            motion.duration,
            motion.rest_duration,
            recipe.start_ns,
            generator(recipe.seed, f'{name} plan'),
        )
        for name, sensor in (('tool', recipe.tool), ('package', recipe.package))
    }


def _simulated(
    cup: Cup, package: Package, gravity: float, recipe: Recipe, plans: Mapping[str, Schedule]
) -> Truth:
    """Simulate at all sampling times of both streams, and as finely in between as truth needs."""
    motion = recipe.motion
    rate = max(
        LEAST_RATE,
        SAMPLES_PER_PERIOD * motion.highest_frequency,
        STEPS_PER_LARGEST / largest_step(model_tuple(cup, package, gravity)),
    )
    count = motion.duration * (rate + recipe.tool.rate_hz + recipe.package.rate_hz)
    if count > LARGEST_COUNT:
        raise BellowsError(
            f'The recording needs {count:.2g} simulated samples, and {LARGEST_COUNT:.2g} can be. '
            'Make it shorter, or lower the rates or the highest frequency.'
        )
    fine = sample_stamps(rate, motion.duration, recipe.start_ns)
    stamps_ns = np.unique(np.concatenate([fine, *(p.sampled_ns for p in plans.values())]))
    tool = motion.trajectory(stamps_ns, recipe.start_ns)
    return Truth(tool, simulate(cup, package, tool, gravity=gravity))


def _recorded(
    recipe: Recipe, plans: Mapping[str, Schedule], truth: Truth
) -> list[Recorded]:
    """Return the messages of all topics."""
    world, seed = WORLDS[recipe.world], recipe.seed
    tool = truth.at(plans['tool'].sampled_ns).tool
    package = truth.at(plans['package'].sampled_ns).package
    poses = {
        'tool': measure_poses(tool, recipe.tool, plans['tool'], world, generator(seed, 'tool')),
        'package': measure_poses(
            package, recipe.package, plans['package'], world, generator(seed, 'package')
        ),
    }
    recorded = [
        _messages(recipe, 'tool_pose', poses['tool'].stamps_ns, _pose_values(poses['tool']))
    ]
    if recipe.tool_twist:
        draw = generator(seed, 'tool twist')
        twists = measure_twists(
            tool, recipe.tool_twist, recipe.tool.marker, plans['tool'], world, draw
        )
        values = np.hstack([twists.linear, twists.angular])
        recorded.append(_messages(recipe, 'tool_twist', twists.stamps_ns, values))
    values = _pose_values(poses['package'])
    recorded.append(_messages(recipe, 'package_pose', poses['package'].stamps_ns, values))
    return recorded


def _pose_values(poses: Measured) -> Array:
    """Return poses as messages have them (N, 7)."""
    return np.hstack([poses.position, rotation_to_quaternion(poses.rotation)])


def _messages(recipe: Recipe, role: str, stamps_ns: Stamps, values: Array) -> Recorded:
    """Return the messages of one topic, received a latency after their stamps."""
    sensor = recipe.package if role == 'package_pose' else recipe.tool
    return Recorded(
        recipe.topics[role],
        TWIST if role == 'tool_twist' else POSE,
        stamps_ns,
        values,
        recipe.frame_id,
        log_times_ns=stamps_ns + round(sensor.latency * NS_PER_S),
    )


def _truth_bytes(
    cup: Cup, recipe: Recipe, plans: Mapping[str, Schedule], truth: Truth
) -> bytes:
    """Return an .npz file with the true motion at the times at which the package was sampled."""
    sampled_ns = plans['package'].sampled_ns
    at = truth.at(sampled_ns)
    arrays = {
        't': (sampled_ns - recipe.start_ns) / NS_PER_S,
        'tool': transform(at.tool.rotation, at.tool.position),
        'tool_twist': np.asarray(at.tool.twist),
        'package': transform(at.package.rotation, at.package.position),
        'package_twist': np.asarray(at.package.twist),
        'K': cup.stiffness,
        'P': cup.damping,
    }
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def _report(
    bag: Path,
    truth_file: Path | None,
    recipe: Recipe,
    plans: Mapping[str, Schedule],
    recorded: list[Recorded],
    truth: Truth,
) -> SimulationReport:
    """Return what was recorded."""
    seconds = truth.tool.seconds
    angle = bending(truth.tool, truth.package)
    worst = int(np.argmax(angle))
    return SimulationReport(
        bag=bag,
        truth=truth_file,
        duration=recipe.motion.duration,
        messages={r.topic: len(r.stamps_ns) for r in recorded},
        events=_events(recipe, plans),
        largest_bending=float(angle[worst]),
        largest_bending_time=float(seconds[worst]),
        warnings=_bending_warning(angle, seconds),
    )


def bending(tool: Trajectory, package: Trajectory) -> Array:
    """Return the angles (N,) in rad between the z axes of tool and lip."""
    z_tool, z_lip = tool.rotation[:, :, 2], package.rotation[:, :, 2]
    sine = np.linalg.norm(np.cross(z_tool, z_lip), axis=1)
    angle: Array = np.arctan2(sine, np.sum(z_tool * z_lip, axis=1))
    return angle


def _bending_warning(angle: Array, seconds: Array) -> tuple[str, ...]:
    """Return the warning about bending that no cup survives, or nothing."""
    beyond = np.flatnonzero(angle > BENDING_LIMIT)
    if not len(beyond):
        return ()
    return (
        f'The cup bends by up to {math.degrees(angle.max()):.0f} degrees, and passes '
        f'{math.degrees(BENDING_LIMIT):.0f} for the first time {seconds[beyond[0]]:.3f} s after '
        'the beginning: from there the modelled restoring moment falls, and the package may flip. '
        'Real cups bend some 20 degrees; use smaller or slower motions.',
    )


def _events(recipe: Recipe, plans: Mapping[str, Schedule]) -> tuple[Event, ...]:
    """Return the outliers and dropouts of both bodies."""
    events = []
    for name, plan in plans.items():
        topic = recipe.topics[f'{name}_pose']
        for kind, starts in (('outlier', plan.jumps), ('dropout', plan.dropouts)):
            times = (plan.sampled_ns[list(starts)] - recipe.start_ns) / NS_PER_S
            events += [Event(topic, kind, float(time)) for time in times]
    return tuple(sorted(events, key=lambda event: (event.topic, event.start)))
