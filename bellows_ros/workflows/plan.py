"""
Prediction of planned motions with uncertainty: as planned, in the shortest safe time, or steered.

A plan is read as a `PlannedMotion`. A `PlanReport` has the `Effect` of the requested motion and,
beside it, of the plan as it is.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.live.predictor import points_down
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning import limits as bounding
from bellows_ros.core.planning import points, steering
from bellows_ros.core.planning.effect import (
    Effect,
    effect_of,
    PlanSettings,
    STILL,
)
from bellows_ros.core.planning.limits import Fastest, Limits
from bellows_ros.core.planning.plan_prediction import (
    PlanPrediction,
    PlanSimulation,
    SETTLED_ANGLE,
)
from bellows_ros.core.planning.points import Joints, plan_of, timed
from bellows_ros.core.recording import alignment, preparation
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals import resampling, savgol, trajectory
from bellows_ros.core.signals.trajectory import (
    at_tip,
    NS_PER_S,
    PoseStream,
    Trajectory,
    TwistStream,
)
from bellows_ros.core.synthetic.recipe import read_recipe, START_NS
from bellows_ros.errors import BellowsError, require_types, UndeterminedError, UnstableError
from bellows_ros.files import bags, File, plans, results, safe_yaml
from bellows_ros.files.messages import PACKAGE_FRAME, POSE, TWIST
from bellows_ros.files.trajectory_files import read_tum
from bellows_ros.report.findings import entry, text
from bellows_ros.workflows import CommandResult, recordings
import numpy as np

YAML, TEXT = ('.yaml', '.yml', '.json'), ('.tum', '.txt')
AS_PLANNED = 'as planned'
"""Name of the unchanged motion."""

MotionSource = File | Trajectory
"""A file with a motion, or the motion of E."""


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """
    A motion of the tool as read from a file, with the parameters of cup and package.

    Parameters
    ----------
    tool : Trajectory
        Motion of E in the plan's frame with body twists.
    frame_id : str
    values : mapping
        All parameters.
    path : str
        Path of the file.
    notes : tuple of Finding
        Findings on reading the plan.
    recorded_ns : int array or None
        Stamps of the measured poses, ns; None for a planned motion.
    joints : Joints or None
        Arm of a plan of joints, otherwise None.
    start_ns : int or None
        Stamp of the plan's time 0, ns, from which all times are counted; None for its first point.

    """

    tool: Trajectory
    frame_id: str
    values: Values
    path: str = 'a motion'
    notes: tuple[Finding, ...] = ()
    recorded_ns: Stamps | None = None
    joints: Joints | None = None
    start_ns: int | None = None

    @property
    def begin(self) -> float:
        """Time of the first point, s."""
        first = int(self.tool.stamps_ns[0])
        return 0.0 if self.start_ns is None else (first - self.start_ns) / NS_PER_S

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the tool's axes at rest, which come first, and on reading the plan."""
        rows = simulation.tool_rows(self.tool)
        at = np.argmax([simulation.stands(twist) for twist in rows[:, 7:]])  # else the first
        x, y, z = self.tool.rotation[at, :, 2].tolist()
        if points_down((x, y, z), self.model[2]):
            return (Finding('tool_z'), *self.notes)
        return self.notes

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return float(self.tool.seconds[-1])

    @cached_property
    def gravity(self) -> Array:
        """Acceleration (3,) in the frame of the plan, m/s^2."""
        world = 'z_up' if self.recorded_ns is None else self.values.recording.world
        R_model_plan = alignment.world_rotation(world, self.values.gravity.direction)
        return np.asarray(R_model_plan.T @ [0.0, 0.0, -self.values.gravity.magnitude])

    @cached_property
    def model(self) -> ModelTuple:
        """Cup, package and gravity, as the kernels take them."""
        values = self.values
        return model_tuple(conversion.cup_of(values), conversion.package_of(values), self.gravity)

    @cached_property
    def grip(self) -> Grip | None:
        """Grip of the cup; None if unknown."""
        return conversion.grip_of(self.values)

    @property
    def settings(self) -> PlanSettings:
        """Cup, package and grip of the prediction."""
        values = self.values
        return PlanSettings(
            self.model, conversion.uncertain_of(values), self.grip, float(values.safety.least),
            conversion.parameter_envelope(values), values.package.mass, values.vacuum.holding)

    def effect(self, tool: Trajectory) -> Effect:
        """Return the effect of the plan, or of another motion of E from its begin."""
        return effect_of(tool, self.begin, self.settings)


class OfPlan(CommandResult):
    """A result on a plan."""

    source: PlannedMotion
    """The plan."""

    @property
    def inputs(self) -> tuple[File, ...]:
        """The file of the plan."""
        return (self.source.path,)

    def as_json(self) -> dict[str, Any]:
        """Return the common entries of JSON files of plans; SI units, null for unknown."""
        return results.plain_items({
            **self.numbers(), 'plan': self.source.path, 'frame_id': self.source.frame_id,
            'findings': [*map(entry, self.findings)], 'warnings': self.warnings})

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of the result by name."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class PlanReport(OfPlan):
    """
    The effects of a plan on the package.

    Parameters
    ----------
    source : PlannedMotion
        The plan.
    motions : mapping of str to Effect
        The requested motion, by the name of its method, and the plan 'as planned' if it can be
        predicted.
    used : mapping of str to float
        Used part of each limit of the arm by the requested motion; above 1 it exceeds the limit.
    notes : tuple of Finding
        Findings on the request.
    fastest : Fastest or None
        Shortest safe time scale, None if not searched.
    steered : Steered or None
        Steered motion, None if not requested.

    """

    source: PlannedMotion
    motions: Mapping[str, Effect]
    used: Mapping[str, float]
    notes: tuple[Finding, ...] = ()
    fastest: Fastest | None = None
    steered: steering.Steered | None = None

    @property
    def result(self) -> Effect:
        """The requested motion."""
        return next(iter(self.motions.values()))

    @property
    def prediction(self) -> PlanPrediction:
        """Prediction of the requested motion."""
        return self.result.prediction

    @property
    def succeeded(self) -> bool:
        """Whether the cup holds, unless unknown."""
        return self.prediction.grip is None or self.prediction.smallest_safety[0] >= 1.0

    def scenes(self) -> dict[str, tuple[Trajectory, Trajectory]]:
        """Return tool and package by the name of the motion."""
        return {name: motion.bodies() for name, motion in self.motions.items()}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the plan and the requested motion."""
        return (*self.source.findings, *self.result.findings, *self.notes)

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of the result by name."""
        requested, *beside = self.motions
        return {
            'requested': requested, **self.result.numbers(),
            'beside': {name: self.motions[name].numbers() for name in beside},
            'fastest_scale': self.fastest and self.fastest.scale,
            'fastest_scale_std': self.fastest and self.fastest.scale_std,
            'modes': self.steered and self.steered.modes, 'used_parts': self.used,
            'least_safety_factor': float(self.source.values.safety.least)}


def plan(
    path: MotionSource, settings: Mapping[str, Any], urdf: str = '',
    topic: str = '', seek_fastest: bool = False, limits: File | Mapping[str, object] = '',
) -> PlanReport:
    """
    Predict the package along a plan.

    Parameters
    ----------
    path : path or Trajectory
        A recording with a plan, joint states, transforms or poses of the tool; a TUM file; a
        message or a motion as YAML; or a trajectory of E, from rest to rest if without twists.
    settings : mapping
        Parameters by name: cup, package, and settings for reading the plan.
    urdf : str
        File of the arm for a plan of joints; '' for the arm in the recording.
    topic : str
        Topic of the plan in a recording with several.
    seek_fastest : bool
        Whether the shortest safe time is searched.
    limits : path or mapping
        YAML file with limits of the arm, or its content, of which the used parts are computed.

    Raises
    ------
    BellowsError
        If the plan cannot be read, is impossible for an arm, the package cannot be held, or no
        time is safe.

    """
    source = plan_with_cup(path, settings, urdf, topic)
    bounds = limits_in(limits, source)
    planned = source.effect(source.tool)
    if not seek_fastest:
        return _report(source, limits and bounds, {AS_PLANNED: planned})
    scale, tool, notes = _fastest(source)
    fast = source.effect(tool)
    fast = replace(fast, std={**fast.std, 'duration': scale.scale_std * source.duration})
    return _report(
        source, limits and bounds, {'fastest': fast, AS_PLANNED: planned}, notes, scale)


def steer_plan(
    path: MotionSource, settings: Mapping[str, Any], method: str,
    limits: File | Mapping[str, object] = '', urdf: str = '', topic: str = '',
    seek_fastest: bool = False,
) -> PlanReport:
    """
    Steer a plan of the tool so that the package does not swing.

    Parameters
    ----------
    path, settings, urdf, topic
        As in `workflows.plan.plan`.
    method : str
        One of `core.planning.steering.METHODS`.
    limits : path or mapping
        YAML file with limits of the arm, or its content, to which the motion is slowed down.
    seek_fastest : bool
        Whether the shortest safe time without swing is searched, otherwise the plan's time is kept
        or extended.

    Raises
    ------
    BellowsError
        If the method is unknown, the plan cannot be read or steered, or the limits cannot be kept.

    """
    if method not in steering.METHODS:
        raise BellowsError(f"method is '{method}'; expected one of {', '.join(steering.METHODS)}.")
    source = plan_with_cup(path, settings, urdf, topic)
    bounds = limits_in(limits, source)
    if seek_fastest:
        _require_searchable(source)
    search = _SteeredSearch(source, bounds, method, seek_fastest)
    scale, limit = 1.0, ''
    if seek_fastest or limits or source.joints:
        scale, limit = bounding.first_allowed(search.limit_at, search.scales)
    steered = search.steered_at(scale)
    name = 'unchanged' if steered.method == 'none' else steered.method
    motions = {name: source.effect(steered.tool)}
    with suppress(UnstableError):  # the package falls over as planned: the steered motion alone
        motions[AS_PLANNED] = source.effect(source.tool)
    notes = _slowed(scale, limit)
    if steered.method == 'none':
        notes = (*notes, Finding('unshaped', Level.OK))
    return _report(source, limits and bounds, motions, notes, steered=steered)


class _SteeredSearch(NamedTuple):
    """The search for the time scale of a steered plan within limits."""

    source: PlannedMotion
    bounds: Limits
    method: str
    seek_fastest: bool

    @property
    def scales(self) -> tuple[float, float, float]:
        """Smallest and largest time scale, and ratio of neighbouring ones."""
        start = bounding.fastest_scale(self.source.tool) if self.seek_fastest else 1.0
        return start, bounding.MAX_STRETCH, bounding.STRETCH_STEP

    def steered_at(self, scale: float) -> steering.Steered:
        """Return the steered plan at a time scale."""
        return steering.steer(self.source.model, timed(self.source.tool, scale), self.method)

    def limit_at(self, scale: float) -> str:
        """Return the limit that the steered plan exceeds at a time scale, '' for none."""
        source, bounds = self.source, self.bounds
        try:
            steered = self.steered_at(scale)
        except UnstableError:
            if not self.seek_fastest:
                raise
            return 'swing'
        if self.seek_fastest and steered.residual > SETTLED_ANGLE:
            return 'swing'
        run, factor = PlanSimulation(
            source.model, source.grip, steered.tool, tail=steering.TAIL), math.inf
        if bounds.safety_factor > 0.0:
            factor = run.safety(1.0)
        parts = _used(source, bounds, steered.tool, factor)
        name, part = next((each for each in parts.items() if each[1] > 1.0), ('', 0.0))
        if name == 'workspace':
            raise BellowsError(
                f'The motion leaves the workspace at any speed: it uses {part:.0%} of the half '
                'width about its middle. Change the plan or the limits.')
        if name or not self.seek_fastest:
            return name
        spread = bounding.spread_of(run, conversion.uncertain_of(source.values), source.model)
        is_safe = bounding.is_safe(run, spread, float(source.values.safety.least))
        return '' if is_safe else 'safety.least'


def _report(
    source: PlannedMotion, limits: Any, motions: Mapping[str, Effect], *more: Any, **named: Any
) -> PlanReport:
    """Return the report on motions, with the used parts of limits, if any, by the first motion."""
    first = next(iter(motions.values()))
    used = _used(source, limits, first.tool, first.prediction.smallest_safety[0]) if (
        limits) else {}
    return PlanReport(source, motions, used, *more, **named)


def _slowed(scale: float, limit: str) -> tuple[Finding, ...]:
    """Return the finding on a slower motion for a limit, if any."""
    return (Finding('slowed', Level.OK, {'scale': scale, 'limit': limit}),) if limit else ()


def _fastest(source: PlannedMotion) -> tuple[Fastest, Trajectory, tuple[Finding, ...]]:
    """Return the shortest safe time, its motion, and the limit of a joint that needs longer."""
    _require_searchable(source)
    assert source.grip is not None
    required = float(source.values.safety.least)
    found = bounding.fastest(
        conversion.uncertain_of(source.values), source.model, source.grip, source.tool, required)
    if found is None:
        raise UndeterminedError(
            'No duration of the plan is safe: the safety factor, less two standard deviations, is '
            f'never above safety.least, {required:g}. Raise the vacuum, or use a larger cup.')
    tool, limit = timed(source.tool, found.scale), ''
    if joints := source.joints:
        factor, limit = points.joint_excess(joints.arm, joints.along(tool, source.tool), math.inf)
        tool = timed(tool, factor * 1.001 if limit else 1.0)  # of points 1 ms apart
    return found, tool, _slowed(float(tool.seconds[-1]) / source.duration, limit)


def _require_searchable(source: PlannedMotion) -> None:
    """Raise for a plan whose shortest safe time is unknown."""
    why = ''
    if source.grip is None:
        why = text(Finding('no_factor'))
    elif not all(map(simulation.stands, np.asarray(source.tool.twist)[[0, -1]])):
        why = 'The plan begins or ends in motion. Give a plan from rest to rest.'
    if why:
        raise BellowsError(f'The shortest safe time cannot be found. {why}')


def limits_in(limits: File | Mapping[str, object], source: PlannedMotion) -> Limits:
    """Return the limits in a YAML file, or in its content; '' for none."""
    if not isinstance(limits, Mapping):
        limits = safe_yaml.load_names(Path(limits)) if limits else {}
    bounds = bounding.read_limits(limits)
    if source.grip is None and bounds.safety_factor > 0.0:
        raise BellowsError(
            f"The limit safety_factor cannot be compared. {text(Finding('no_factor'))} Or leave "
            'safety_factor out.')
    if source.joints is None and bounds.joint_acceleration < bounding.NO_LIMIT:
        raise BellowsError(
            'The limit joint_acceleration cannot be checked: the plan has no joints; expected a '
            "plan of the arm's joints, and its urdf. Give both, or leave joint_acceleration out.")
    return bounds


def _used(
    source: PlannedMotion, limits: Limits, tool: Trajectory, factor: float
) -> dict[str, float]:
    """Return the used part of each limit by a motion with a smallest safety factor."""
    parts = bounding.used_parts(limits, tool, factor)
    if joints := source.joints:
        parts |= points.joint_parts(
            joints.arm, joints.along(tool, source.tool), limits.joint_acceleration)
    return parts


# -------------------------------------------------------------------------------------- reading


def plan_with_cup(
    path: MotionSource, settings: Mapping[str, Any], urdf: str = '', topic: str = ''
) -> PlannedMotion:
    """Return a plan, with a package in the parameters; see `plan`."""
    values = checks.resolve(settings, checks.PACKAGE_PARAMETERS)
    conversion.box_of(values)  # refused before the work
    require_types(motion=(path, str, os.PathLike, Trajectory))
    if isinstance(path, Trajectory):
        return PlannedMotion(_checked_motion(path, path.twist), '', values)
    return read_plan(path, values, urdf, topic)


def read_plan(path: File, values: Values, urdf: str = '', topic: str = '') -> PlannedMotion:
    """
    Return the plan in a file, from recording.start to recording.end; see `plan`.

    Raises
    ------
    BellowsError
        If there is no plan, or it is impossible for an arm.

    """
    source = _read_plan(Path(path), values, urdf, topic)
    plans.require_frame(source.frame_id, values)
    if urdf and source.joints is None and source.recorded_ns is None:
        raise BellowsError(
            f"The urdf '{urdf}' is given, but '{path}' has no plan of joints; expected a "
            'JointTrajectory. Give one, or leave the urdf out.')
    stamps = source.tool.stamps_ns
    chosen, _ = recordings.interval_masks(
        [stamps, stamps if source.recorded_ns is None else source.recorded_ns], values)
    if (count := np.count_nonzero(chosen)) < 2:
        raise BellowsError(
            f'The plan has {count} points from recording.start to recording.end; expected 2 or '
            'more. Select a longer part.')
    tool = source.tool.select(chosen)
    twist = np.array(tool.twist)
    if source.recorded_ns is not None and (
            np.linalg.norm(twist[0].reshape(2, 3), axis=1) <= STILL).all():
        twist[0] = 0.0  # from rest
        tool = replace(tool, twist=twist)
    return replace(source, tool=tool, path=os.fspath(path))


def _read_plan(file: Path, values: Values, urdf: str, topic: str) -> PlannedMotion:
    """Return the whole plan in a file, the first of several with a note."""
    kind = file.suffix.lower()
    if topic and kind in (*YAML, *TEXT):
        raise BellowsError(
            f"The topic is '{topic}', but '{file}' is no recording and has none. Leave it out.")
    if kind in TEXT:
        tool = plan_of(*read_tum(file), name=f"'{file}'").trajectory()
        return PlannedMotion(at_tip(tool, conversion.tip_of(values)), '', values)
    if kind in YAML:
        content = safe_yaml.load(file)
        if isinstance(content, Mapping) and 'kind' in content:
            return _source_of_motion(content, values)
        read = [('', each) for each in plans.plans_in_yaml(content, os.fspath(file))]
    else:
        read = plans.plans_in(file, topic)
        if not read:
            return _source_of_recording(file, values, urdf, topic)
    name, first = next((each for each in read if urdf and each[1].kind == plans.JOINTS), read[0])
    count = sum(each.kind == first.kind for _, each in read)  # joints beside the tool are the same
    notes = list[Finding]()
    if count > 1:
        notes.append(Finding(
            'first_of_plans', Level.WARN, {'count': count, 'name': name}, os.fspath(file)))
    recording = '' if kind in YAML else file
    return replace(_source_of_plan(first, values, urdf, recording),
                   notes=(*first.findings, *notes))


def _source_of_plan(
    read: plans.Plan, values: Values, urdf: str, recording: Any,
) -> PlannedMotion:
    """Return a plan of points of the tool or of an arm's joints."""
    arm = plans.arm_of(urdf, values.tool_link, recording) if read.kind == plans.JOINTS else None
    start_ns = read.stamp_ns or START_NS
    tool, joints = plans.motion_of(read, values, arm, start_ns)
    return PlannedMotion(
        tool, arm.root if arm else read.frame_id, values, joints=joints, start_ns=start_ns)


def _source_of_motion(content: Mapping[str, Any], values: Values) -> PlannedMotion:
    """Return the tool's motion in a motion file."""
    recipe = read_recipe(content, np.array(values.package.com))
    R_world_level = alignment.levelling(values.gravity.direction).T  # z of a motion file is up
    motion = recipe.motion
    count = max(2, math.ceil(motion.duration * 500.0))  # Hz
    stamps = START_NS + np.round(
        np.linspace(0.0, motion.duration, count + 1) * NS_PER_S).astype(np.int64)
    tool = alignment.in_world(motion.trajectory(stamps, START_NS), R_world_level)
    return PlannedMotion(_checked_motion(tool, tool.twist), recipe.frame_id, values)


def _checked_motion(
    tool: Trajectory, twist: Array | None, axes: str = 'tool', name: str = 'The motion',
    given: bool = True,
) -> Trajectory:
    """Return a motion of E with twists (N, 6) in axes of the tool or the world, as a plan."""
    return plan_of(tool.stamps_ns, trajectory.pose_rows(tool), twist, twist_frame=axes,
                   name=name, given=given).trajectory()


def _source_of_recording(path: Path, values: Values, urdf: str, topic: str) -> PlannedMotion:
    """Return the tool's motion in a recording of poses or joints."""
    wanted = {'tool_pose': topic or values.topics.tool_pose,
              'tool_twist': values.topics.tool_twist}
    contents = bags.read_contents(path, wanted)
    poses, twists = (contents.streams.get(role) for role in ('tool_pose', 'tool_twist'))
    axes, notes = values.tool_twist.frame, tuple[Finding, ...]()
    if urdf or not isinstance(poses, PoseStream):
        if not (urdf or values.tool_link):
            problem = contents.problems['tool_pose']
            raise type(problem)(
                f'{problem} A plan is a message of type {", ".join(plans.PLAN_TYPES)}; or poses '
                'of the tool are recorded, or joint states with tool_link.')
        read, notes = plans.recorded_joints(path, plans.arm_of(urdf, values.tool_link, path))
        frame, stamps, axes = read.frame_id, read.stamp_ns + read.times_ns, 'tool'
        poses = PoseStream('the tool', frame, stamps, read.points[:, :3],
                           quaternion_to_rotation(read.points[:, 3:]))
        twists = None if read.rates is None else TwistStream(
            'the tool', frame, stamps, read.rates[:, :3], read.rates[:, 3:])
    motion, rates, axes = _with_rates(poses.trajectory(), twists, axes)
    tool = at_tip(_checked_motion(motion, rates, axes, f"Poses '{poses.name}'", bool(twists)),
                  conversion.tip_of(values))
    return PlannedMotion(tool, poses.frame_id, values, notes=notes, recorded_ns=poses.stamps_ns)


def _with_rates(
    poses: Trajectory, twists: bags.Stream | None, axes: str
) -> tuple[Trajectory, Array, str]:
    """Return measured poses with recorded or filtered twists, and the axes of the twists."""
    if isinstance(twists, TwistStream):
        first, last = twists.stamps_ns[[0, -1]]
        poses = poses.select((poses.stamps_ns >= first) & (poses.stamps_ns <= last))
        six = np.stack([
            np.interp(poses.stamps_ns - first, twists.stamps_ns - first, column)
            for column in np.hstack([twists.linear, twists.angular]).T], axis=1)
        return poses, six, axes
    rate = resampling.timing(poses.stamps_ns)
    half_window = max(4, round(preparation.AUTOMATIC_HALF_WINDOW * rate.rate_hz))
    grid = resampling.on_grid(poses, rate)
    smooth = savgol.savgol(grid, half_window, PrepareSettings.tool_order)
    return smooth, smooth.twist, 'tool'


# -------------------------------------------------------------------------------------- writing


def write_prediction(
    path: File, source: PlannedMotion, tool: Trajectory, states: Array, replace_bag: bool = False
) -> None:
    """
    Write a motion of the tool, and of the package, as a recording.

    The topics of the recording are tool_arm/plan and package/plan (MultiDOFJointTrajectory),
    package/plan_path (Path), tool_arm/pose, tool_arm/twist and package/pose, stamped from the
    plan's start; and tool_arm/plan_joints (JointTrajectory) for a plan of joints.

    Parameters
    ----------
    path : path
        Folder to make.
    source : PlannedMotion
        Plan with the frame and parameters of the motion.
    tool : Trajectory
        Motion of E, with body twists.
    states : array (N, 13)
        States of B in the tool's frame: position, quaternion, body twist.
    replace_bag : bool
        Whether an existing recording may be replaced.

    Raises
    ------
    BellowsError
        If the output exists, or cannot be written.

    """
    frame, axes = source.frame_id or 'world', source.values.tool_twist.frame
    stamps = tool.stamps_ns
    start = int(stamps[0]) if source.start_ns is None else source.start_ns
    tip = trajectory.from_tip(tool, conversion.tip_of(source.values))
    plan = plans.plan_of_motion(tip, 0, frame, 'tool', axes, start)
    package = plans.plan_of_motion(
        simulation.ToolRows(stamps, states).trajectory(), start, frame, PACKAGE_FRAME, axes,
        start)
    written = {'tool_arm/plan': plan, 'package/plan': package,
               'package/plan_path': package._replace(kind=plans.PATH)}
    if source.joints is not None:
        written['tool_arm/plan_joints'] = plans.plan_of_path(
            0, frame, source.joints.arm.moving, source.joints.along(tool, source.tool),
            int(stamps[0]) - start)
    bags.write_bag(path, [
        *(bags.Encoded(f'/{topic}', each.kind, stamps[:1], [plans.encode(each)])
          for topic, each in written.items()),
        bags.as_messages('/tool_arm/pose', POSE, stamps, plan.points, frame),
        bags.as_messages('/tool_arm/twist', TWIST, stamps, np.asarray(plan.rates), frame),
        bags.as_messages('/package/pose', POSE, stamps, package.points, frame),
    ], replace=replace_bag)
