"""
Simulation of a recording with a given cup: a motion and its faults in, a rosbag2 recording out.

The entries of a motion file, with units, are in config/motion_example.yaml.
"""

from collections.abc import Mapping
import io
from pathlib import Path
from typing import Any, NamedTuple

from bellows_ros.core import no_progress, Progress
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import apply, transform
from bellows_ros.core.model.cup_package import Cup, model_tuple
from bellows_ros.core.model.equilibrium import largest_step
from bellows_ros.core.model.grip import Margin
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.model.validity_range import flip_finding
from bellows_ros.core.parameters import conversion
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.conversion import cup_of, package_of, tip_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.effect import bending, smallest_margin
from bellows_ros.core.recording.alignment import in_world, levelling
from bellows_ros.core.signals import screening
from bellows_ros.core.signals.trajectory import from_tip, NS_PER_S, pose_rows, Trajectory
from bellows_ros.core.synthetic import recipe as sensing
from bellows_ros.core.synthetic.motion import planned, sample_stamps
from bellows_ros.core.synthetic.recipe import generator, read_recipe, Recipe
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, bags, File, messages
from bellows_ros.report.findings import warnings
from bellows_ros.workflows.plan import read_plan
import numpy as np

MIN_RATE = 500.0
"""Smallest rate of a simulation, Hz."""
MAX_SAMPLES = 5_000_000
"""Largest number of samples of a simulation."""

POSE_TOPICS = {'tool': '/tool_arm/pose', 'package': '/package/pose'}


class SimulationReport(NamedTuple):
    """
    Summary of a simulated recording.

    Parameters
    ----------
    bag : Path
        Path of the recording.
    truth : Path or None
        File with the true motion, if requested.
    duration_s : float
    messages : mapping of topic to int
        Number of messages on each topic.
    largest_bending_rad : float
        Largest angle between the z axes of tool and lip, rad.
    largest_bending_time_s : float
        Time of the largest bending, s after the beginning.
    warnings : tuple of str
        Warnings about the use of the recording.
    margin : Margin or None
        Smallest safety factor of the grip; None if unknown.

    """

    bag: Path
    truth: Path | None
    duration_s: float
    messages: Mapping[str, int]
    largest_bending_rad: float
    largest_bending_time_s: float
    warnings: tuple[str, ...]
    margin: Margin | None


def simulate_recording(
    parameters: Mapping[str, Any], motion: Mapping[str, object], out: File,
    progress: Progress = no_progress, replace: bool = False, plan: File = ''
) -> SimulationReport:
    """
    Simulate a held package, and write the recording of a tracking system.

    Equal inputs give equal recordings.

    Parameters
    ----------
    parameters : mapping
        Values by dotted name: cup, package and gravity; others are only checked.
    motion : mapping
        Content of a motion file.
    out : path
        Folder of the recording.
    progress : callable, optional
        Callback with a sentence on the current step.
    replace : bool
        Whether an existing recording may be replaced.
    plan : path, optional
        A plan of the tool, as `workflows.plan.plan` takes it, instead of the file's motion.

    Returns
    -------
    SimulationReport

    Raises
    ------
    BellowsError
        If a parameter or setting is missing, unknown or invalid, the package cannot be held, or
        the output exists or cannot be written. Nothing is written then.

    """
    values = resolve(parameters, PACKAGE_PARAMETERS)
    R_world_level = levelling(values.gravity.direction).T
    recipe = read_recipe(motion, package_of(values).com)
    if plan:
        tool = in_world(read_plan(plan, values).tool, R_world_level.T)
        recipe = recipe._replace(motion=planned(tool))
    bag = Path(out)
    atomic.require_target(bag, is_folder=True)
    truth_file = atomic.require_target(
        bag.with_name(f'{bag.name}_truth.npz')) if recipe.truth else None
    plans = {
        name: sensing.schedule(
            sensor, recipe.motion.duration, recipe.motion.rest_duration, sensing.START_NS,
            generator(recipe.seed, f'{name} plan'))
        for name, sensor in (('tool', recipe.tool), ('package', recipe.package))}
    progress(f'simulating {recipe.motion.duration:g} s')
    model = model_tuple(cup_of(values), package_of(values), values.gravity.magnitude)
    truth = _simulate(values, model, recipe, plans)
    recorded = _record(recipe, plans, truth, sensing.WORLDS[recipe.world] @ R_world_level,
                       tip_of(values))
    progress(f'writing {sum(len(r.stamps_ns) for r in recorded)} messages to {bag}')
    bags.write_bag(bag, recorded, recipe.storage, recipe.zstd, replace)
    if truth_file:
        atomic.write_bytes(truth_file, _truth_bytes(
            cup_of(values), recipe, plans, truth, R_world_level))
    angles = bending(truth.tool.rotation, truth.package.rotation)
    worst, angle = int(np.argmax(angles)), float(angles.max())
    return SimulationReport(
        bag, truth_file, recipe.motion.duration,
        {messages.topic: len(messages.stamps_ns) for messages in recorded}, angle,
        float(truth.tool.seconds[worst]), warnings(filter(None, [flip_finding(angle)])),
        smallest_margin(conversion.grip_of(values), model, *truth, truth.tool.seconds))


class Truth(NamedTuple):
    """True trajectories of tool E and package B at common stamps, with body twists."""

    tool: Trajectory
    package: Trajectory

    def at(self, stamps_ns: Stamps) -> 'Truth':
        """Return the samples at some of the stamps."""
        index = np.searchsorted(self.tool.stamps_ns, stamps_ns)
        return Truth(self.tool.select(index), self.package.select(index))


def _simulate(
    values: Values, model: ModelTuple, recipe: Recipe, plans: Mapping[str, sensing.Schedule]
) -> Truth:
    """Simulate at all sampling times of both streams, with a rate sufficient for the truth."""
    motion = recipe.motion
    rate = max(MIN_RATE, 100.0 * motion.highest_frequency,
               2.5 / largest_step(model))
    count = motion.duration * (rate + recipe.tool.rate_hz + recipe.package.rate_hz)
    if count > MAX_SAMPLES:
        raise BellowsError(
            f'The recording needs {count:.2g} simulated samples; the limit is '
            f'{MAX_SAMPLES:.2g}. Make it shorter, or lower the rates or the highest frequency.')
    fine = sample_stamps(rate, motion.duration, sensing.START_NS)
    stamps_ns = np.unique(np.concatenate([fine, *(p.sampled_ns for p in plans.values())]))
    tool = motion.trajectory(stamps_ns, sensing.START_NS)
    speed, rate = (float(np.max(np.linalg.norm(part, axis=1)))
                   for part in np.hsplit(np.asarray(tool.twist), 2))
    if speed > screening.MAX_TOOL_SPEED or rate > screening.MAX_TOOL_RATE:
        raise BellowsError(
            f'The tool reaches {speed:.3g} m/s and {rate:.3g} rad/s; expected at most '
            f'{screening.MAX_TOOL_SPEED:g} and {screening.MAX_TOOL_RATE:g}, as no arm is faster. '
            'Check the units of the motion: m, rad and s.')
    return Truth(tool, simulate(
        cup_of(values), package_of(values), tool, gravity=values.gravity.magnitude))


def _record(
    recipe: Recipe, plans: Mapping[str, sensing.Schedule], truth: Truth, world: Array,
    tip: Array | None,
) -> list[bags.Encoded]:
    """
    Return the messages of all topics in recorded axes, by the rotation (3, 3) to them.

    The recorded frame of the tool is the frame in which E has the pose `tip` (4, 4), else E.
    """
    seed, tool = recipe.seed, from_tip(truth.at(plans['tool'].sampled_ns).tool, tip)
    at = truth.at(plans['package'].sampled_ns)
    recorded = list[bags.Encoded]()
    for name, body, sensor, plan in (('tool', tool, recipe.tool, plans['tool']),
                                     ('package', at.package, recipe.package, plans['package'])):
        late_ns = round(sensor.latency * NS_PER_S)  # delay of the receipt
        poses = sensing.measure_poses(body, sensor, plan, world, generator(seed, name))
        recorded.append(bags.as_messages(
            POSE_TOPICS[name], messages.POSE, poses.stamps_ns,
            pose_rows(poses), recipe.frame_id,
            log_times_ns=poses.stamps_ns + late_ns))
        if name == 'tool' and recipe.tool_twist:
            twists = sensing.measure_twists(tool, recipe.tool_twist, sensor.marker, plan, world,
                                            generator(seed, 'tool twist'))
            recorded.append(bags.as_messages(
                '/tool_arm/twist', messages.TWIST, poses.stamps_ns, twists,
                recipe.frame_id, log_times_ns=poses.stamps_ns + late_ns))
    return recorded


def _truth_bytes(
    cup: Cup, recipe: Recipe, plans: Mapping[str, sensing.Schedule], truth: Truth,
    R_world_level: Array
) -> bytes:
    """
    Return an .npz file with the true motion at the sampling times of the package.

    The motion is planned in a world with z up; `R_world_level` (3, 3) rotates it to the world.
    """
    sampled_ns = plans['package'].sampled_ns
    at, arrays = truth.at(sampled_ns), dict[str, Array]()
    for name, motion in (('tool', at.tool), ('package', at.package)):
        arrays[name] = transform(
            R_world_level @ motion.rotation, apply(R_world_level, motion.position))
        arrays[f'{name}_twist'] = np.asarray(motion.twist)
    file = io.BytesIO()
    arrays |= {'t': (sampled_ns - sensing.START_NS) / NS_PER_S, 'K': cup.stiffness,
               'P': cup.damping}
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()
