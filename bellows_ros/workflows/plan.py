"""Prediction of a planned motion with its uncertainty, and the motion without swing."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
from bellows_ros.core.model.cup_package import contributions, mean_square, model_tuple
from bellows_ros.core.model.grip import factors_along, Grip, Margin, margin, safety_finding
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.validity_range import flip_finding
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning import steering
from bellows_ros.core.planning.limits import (
    demands,
    Fastest,
    fastest,
    first_allowed,
    Limits,
    read_limits,
    used_parts,
)
from bellows_ros.core.planning.plan_prediction import MAX_TAIL, PlanPrediction, PlanSimulation
from bellows_ros.core.planning.points import (
    joint_excess,
    joint_parts,
    Joints,
    plan_of,
    plan_of_joints,
    timed,
)
from bellows_ros.core.recording import alignment, preparation
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals import resampling, savgol, trajectory
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, PoseStream, Trajectory
from bellows_ros.core.synthetic.recipe import read_recipe, START_NS
from bellows_ros.errors import BellowsError, require_types, UnstableError
from bellows_ros.files import bags, File, plans, results, safe_yaml
from bellows_ros.files.messages import PACKAGE_FRAME, POSE, TWIST
from bellows_ros.files.trajectory_files import read_tum
from bellows_ros.report.findings import entry, text
from bellows_ros.workflows import CommandResult, recordings
import numpy as np

YAML, TEXT = ('.yaml', '.yml'), ('.tum', '.txt')
TAIL_SHOWN = 1.5
"""Longest time after the end in a picture, s."""
STANDSTILL_STEP = 0.005
"""Spacing of the points after the end, s."""

MAX_DRAWN_FACTOR = 1000.0
"""Largest safety factor drawn."""

STILL = (0.01, 0.04)
"""Largest speeds of a tool between two moves, m/s and rad/s: ten times the noise of recorded
twists."""

MIN_STOP = 0.3
"""Shortest standstill between two moves, s: a reversal of the motion is shorter."""

DRAWN_SECONDS = 5.0
"""Part of a motion of several moves in a picture, s: a package swings 10 to 20 times in it."""

NO_FACTOR = text(Finding('no_factor'))


MotionSource = File | Trajectory
"""A file with a motion, or the motion of E."""


@dataclass(frozen=True, eq=False)
class Source:
    """
    A plan as read from its file, with the parameters of cup and package.

    Parameters
    ----------
    tool : Trajectory
        Motion of E in the plan's frame with body twists.
    frame_id : str
    notes : tuple of Finding
        Findings on reading the plan.
    recorded_ns : int array or None
        Stamps of the measured poses, ns; None for a planned motion.
    path : str
        Path of the file.
    values : mapping
        All parameters.
    joints : Joints or None
        Arm of a plan of joints, otherwise None.

    """

    tool: Trajectory
    frame_id: str
    notes: tuple[Finding, ...] = ()
    recorded_ns: Stamps | None = None
    path: str = ''
    values: Values = field(default_factory=lambda: Values({}))
    joints: Joints | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the tool's axes at rest, which come first, and on reading the plan."""
        rows = simulation.tool_rows(self.tool)
        at = np.argmax([simulation.stands(twist) for twist in rows[:, 7:]])  # else the first
        x, y, z = self.tool.rotation[at, :, 2].tolist()
        return (*[Finding('tool_z')] * points_down((x, y, z), self.model[2]), *self.notes)

    @property
    def duration(self) -> float:
        """Duration of the plan, s."""
        return float(self.tool.seconds[-1])

    @property
    def begins_at_rest(self) -> bool:
        """Whether the tool is at rest at its first point."""
        return simulation.stands(np.asarray(self.tool.twist)[0])

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

    def bodies(self, tool: Trajectory, seconds: float) -> tuple[Trajectory, Trajectory]:
        """Return a motion of the tool with a final standstill (s), and the package along it."""
        tool = extended(tool, seconds)
        states = PlanSimulation(self.model, None, tool, tail=0.0).states()
        return tool, simulation.ToolRows(tool.stamps_ns, states).trajectory()

    def deviations(self, compute: Callable[[ModelTuple], Array]) -> Array:
        """Return the standard deviations of a function of the model; 0 for exact parameters."""
        _, parts = contributions(conversion.uncertain_of(self.values), self.model, compute)
        return np.asarray(
            np.linalg.norm(parts, axis=0) if len(parts) else 0.0 * compute(self.model))


class OfPlan(CommandResult):
    """A result on a plan."""

    source: Source
    """The plan."""

    @property
    def inputs(self) -> tuple[File, ...]:
        """The file of the plan."""
        return (self.source.path,)

    def as_json(self) -> dict[str, Any]:
        """Return what the JSON files of plans have in common; SI units, null for unknown."""
        return results.with_units({
            **self.numbers(), 'plan': self.source.path, 'frame_id': self.source.frame_id,
            'findings': [*map(entry, self.findings)], 'warnings': self.warnings})

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of the result by name."""
        raise NotImplementedError


class Move(NamedTuple):
    """A move of the tool between two standstills, s, and the least factor until the next move."""

    begin: float
    end: float
    smallest_safety_factor: float


@dataclass(frozen=True, eq=False)
class PlanReport(OfPlan):
    """
    The effects of a plan on the package.

    Parameters
    ----------
    source : Source
        The plan.
    prediction : PlanPrediction
        Predicted motion of the package.
    std : mapping of str to float
        Standard deviation of each number of the prediction's summary.
    fastest : Fastest or None
        Shortest safe time scale, None if not searched or not found.
    sought : bool
        Whether the shortest time scale was searched.
    used : mapping of str to float
        Used part of each stated limit of the arm; above 1 the plan exceeds it.

    """

    source: Source
    prediction: PlanPrediction
    std: Mapping[str, float]
    fastest: Fastest | None
    sought: bool
    used: Mapping[str, float]

    @property
    def least(self) -> float:
        """Required safety factor."""
        return float(self.source.values.safety.least)

    @property
    def holds(self) -> bool:
        """Whether the cup holds, unless unknown, and a safe time was found if searched."""
        held = self.prediction.grip is None or self.prediction.smallest_safety[0] >= 1.0
        return held and (self.fastest is not None or not self.sought)

    @property
    def succeeded(self) -> bool:
        """Whether the cup holds."""
        return self.holds

    @cached_property
    def outside(self) -> tuple[str, ...]:
        """Phrases on exceeded validity ranges of the cup."""
        values = self.source.values
        return self.prediction.outside(
            conversion.parameter_envelope(values), values.package.mass, values.vacuum.holding)

    @cached_property
    def _fast(self) -> tuple[Trajectory, str]:
        """The plan in its shortest safe time, and the joint that needs a longer one, or ''."""
        source, joints = self.source, self.source.joints
        tool = timed(source.tool, self.fastest.scale if self.fastest else 1.0)
        if self.fastest is None or joints is None:
            return tool, ''
        factor, limit = joint_excess(joints.arm, joints.along(tool, source.tool), math.inf)
        return timed(tool, factor * 1.001 if limit else 1.0), limit  # of points 1 ms apart

    @cached_property
    def driven(self) -> tuple[Trajectory, Array]:
        """The tool and states (N, 13) of the package, in the shortest safe time if requested."""
        if self.fastest is None:
            return self.source.tool, self.prediction.states
        tool, _ = self._fast
        return tool, PlanSimulation(self.source.model, None, tool, tail=0.0).states()

    @cached_property
    def moves(self) -> tuple[Move, ...]:
        """Moves between standstills of the tool, with their least safety factors."""
        tool, prediction = self.source.tool, self.prediction
        speeds = np.linalg.norm(np.asarray(tool.twist).reshape(-1, 2, 3), axis=2)
        moving, t = np.flatnonzero((speeds > STILL).any(axis=1)), tool.seconds
        if prediction.grip is None or not len(moving):
            return ()
        stops = np.flatnonzero(np.diff(t[moving]) > MIN_STOP)
        begins, ends = moving[np.append(0, stops + 1)], moving[np.append(stops, -1)]
        factors = 1.0 / np.maximum.reduceat(prediction.loads.max(axis=1), begins)
        least, _, at = prediction.smallest_safety  # also between points, and after the end
        worst = max(int(np.searchsorted(t[begins], at, 'right')) - 1, 0)
        factors[worst] = min(factors[worst], least)
        return tuple(map(Move, t[begins].tolist(), t[ends].tolist(), factors.tolist()))

    @property
    def drawn(self) -> tuple[float, float]:
        """Begin and end of the picture, s: of many moves the part with the worst one."""
        duration, half = self.source.duration, 0.5 * DRAWN_SECONDS
        if len(self.moves) < 2 or duration <= 2.0 * DRAWN_SECONDS:
            return 0.0, duration + TAIL_SHOWN
        middle = min(max(self.prediction.smallest_safety[2], half), duration - half)
        return middle - half, middle + half

    @cached_property
    def curves(self) -> tuple[Array, Array, Array, Array]:
        """
        Curves of the picture, including the time after a plan that ends at rest.

        Times since the first point (N,), s; positions of E (N, 3), m; position of B (3, m),
        bending (rad), safety factors against peel and slip, and wrench of the cup at the lip (6,
        N and N m), (N, 12); and their standard deviations.
        """
        prediction, source = self.prediction, self.source
        after = min(TAIL_SHOWN, prediction.settled_after + 0.2) if prediction.ends_at_rest else 0.0
        tool = extended(source.tool, after)
        run = PlanSimulation(source.model, source.grip, tool, tail=0.0)

        def compute(changed: ModelTuple) -> Array:
            predicted = run.with_model(changed).predict()
            angle = bending(tool.rotation, quaternion_to_rotation(predicted.states[:, 3:7]))
            factors = 1.0 / np.maximum(predicted.loads, 1.0 / MAX_DRAWN_FACTOR)
            return np.hstack([predicted.states[:, :3], angle[:, None], factors, predicted.wrench])

        return tool.seconds, tool.position, compute(source.model), source.deviations(compute)

    def scenes(self) -> dict[str, tuple[Trajectory, Trajectory]]:
        """Return tool and package by title, including the time after a plan that ends at rest."""
        source = self.source
        return {source.path: source.bodies(
            source.tool, TAIL_SHOWN if self.prediction.ends_at_rest else 0.0)}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the motion."""
        source, prediction, (fast, limit) = self.source, self.prediction, self._fast
        safety = Finding('no_factor') if prediction.grip is None else safety_finding(
            *prediction.smallest_safety[:2], self.std['smallest_safety_factor'], self.least)
        sides = [side for side, is_still in (
            ('begins', source.begins_at_rest), ('ends', prediction.ends_at_rest)) if not is_still]
        return (*source.findings, *filter(None, (
            safety, flip_finding(prediction.bending),
            Finding('in_motion', Level.WARN, {'side': ' and '.join(sides)}) if sides else None,
            Finding('slowed', Level.OK, {
                'scale': float(fast.seconds[-1]) / source.duration, 'limit': limit})
            if limit else None,
            outside_finding(self.outside))))

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of the result by name."""
        prediction, fastest = self.prediction, self.fastest
        return {
            'duration': self.source.duration, **prediction.summary(),
            'smallest_safety_mode': prediction.smallest_safety[1] if prediction.grip else None,
            'duration_std': 0.0, **{f'{name}_std': std for name, std in self.std.items()},
            'outside_validity': self.outside,
            **({'fastest_scale': fastest and fastest.scale,
                'fastest_scale_std': fastest and fastest.scale_std} if self.sought else {}),
            'used_parts': self.used, 'moves': self.moves,
            'points': len(self.source.tool), 'least_safety_factor': self.least}


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
        If the plan cannot be read, is impossible for an arm, or the package cannot be held.

    """
    source = plan_with_cup(path, settings, urdf, topic)
    bounds = limits_in(limits, source)
    run = PlanSimulation(source.model, source.grip, source.tool)
    prediction = run.predict()

    def figures(changed: ModelTuple) -> Array:
        numbers = run.with_model(changed).predict().summary()
        numbers['settled_after'] = min(numbers['settled_after'], MAX_TAIL)  # discontinuous there
        return np.nan_to_num([*numbers.values()], nan=np.nan, posinf=0.0)  # a pressed cup

    std = {name: deviation if math.isfinite(value) else math.nan for (name, value), deviation in
           zip(prediction.summary().items(), source.deviations(figures).tolist(), strict=True)}
    shortest = _fastest(source, prediction) if seek_fastest else None
    used = dict(_used_parts(
        source, bounds, source.tool, prediction.smallest_safety[0])) if limits else {}
    return PlanReport(source, prediction, std, shortest, seek_fastest, used)


def _fastest(source: Source, prediction: PlanPrediction) -> Fastest | None:
    """Return the shortest safe time of a plan, None if there is none."""
    why = NO_FACTOR if source.grip is None else '' if (
        source.begins_at_rest and prediction.ends_at_rest) else (
        'The plan begins or ends in motion. Give a plan from rest to rest.')
    if source.grip is None or why:
        raise BellowsError(f'The shortest safe time cannot be found. {why}')
    return fastest(conversion.uncertain_of(source.values), source.model, source.grip, source.tool,
                   float(source.values.safety.least))


def limits_in(limits: File | Mapping[str, object], source: Source) -> Limits:
    """Return the limits in a YAML file, or in its content; '' for none."""
    bounds = read_limits(
        limits if isinstance(limits, Mapping) else safe_yaml.load(Path(limits)) if limits else {})
    if source.grip is None and bounds.safety_factor > 0.0:
        raise BellowsError(
            f'The limit safety_factor cannot be compared. {NO_FACTOR} Or leave safety_factor out.')
    return bounds


def _used_parts(
    source: Source, limits: Limits, tool: Trajectory, factor: float
) -> Iterator[tuple[str, float]]:
    """Yield the used part of each limit by a motion with a smallest safety factor."""
    yield from used_parts(limits, tool, factor).items()
    if joints := source.joints:
        yield from joint_parts(
            joints.arm, joints.along(tool, source.tool), limits.joint_acceleration).items()


def outside_finding(ranges: Sequence[str]) -> Finding | None:
    """Return the finding on exceeded validity ranges, None without any."""
    return Finding('outside', Level.WARN, {'ranges': '; '.join(ranges)}) if ranges else None


def bending(R_world_tool: Array, R_world_lip: Array) -> Array:
    """Return the angles (N,) in rad between the z axes of tool and lip."""
    z_tool, z_lip = R_world_tool[:, :, 2], R_world_lip[:, :, 2]
    sine = np.linalg.norm(np.cross(z_tool, z_lip), axis=1)
    return np.asarray(np.arctan2(sine, np.sum(z_tool * z_lip, axis=1)))


def smallest_margin(
    values: Values, model: ModelTuple, tool: Trajectory, package: Trajectory, seconds: Array
) -> Margin | None:
    """Return the smallest safety factor of a motion at its times (N,), s; None if unknown."""
    if (grip := conversion.grip_of(values)) is None:
        return None
    rows = map(simulation.tool_rows, (tool, package))
    return margin(grip, factors_along(model, grip, *rows), seconds)


def extended(tool: Trajectory, seconds: float) -> Trajectory:
    """Return a plan with a final standstill of a duration (s)."""
    count = round(seconds / STANDSTILL_STEP)
    if count == 0:
        return tool
    later = tool.stamps_ns[-1] + np.arange(1, count + 1) * round(STANDSTILL_STEP * NS_PER_S)
    more = ((0, count), (0, 0))
    return Trajectory(
        np.append(tool.stamps_ns, later), np.pad(tool.position, more, 'edge'),
        np.pad(tool.rotation, (*more, (0, 0)), 'edge'), np.pad(np.asarray(tool.twist), more))


# ------------------------------------------------------------------------------------- steering


class SteeredMotion(NamedTuple):
    """A motion of the tool, and its effect on the package."""

    tool: Trajectory
    prediction: PlanPrediction
    added_time: float
    """Additional time beyond the plan, s."""
    expected_swing: float
    """RMS of the residual swing over the uncertainty of cup and package, rad."""

    def summary(self) -> dict[str, float]:
        """Return the numbers of a summary, SI units."""
        return {
            'duration': float(self.tool.seconds[-1]), 'added_time': self.added_time,
            'expected_swing': self.expected_swing,
            **{name: size for name, size in self.prediction.summary().items()
               if name in ('peak_bending', 'swing_left', 'settled_after',
                           'smallest_safety_factor')},
            **demands(self.tool)}


@dataclass(frozen=True, eq=False)
class SteerReport(OfPlan):
    """
    A plan, and its steered motion.

    Parameters
    ----------
    source : Source
        The plan.
    method : str
        One of `core.planning.steering.METHODS`.
    motions : mapping
        The motion by the method, and 'as planned' if it can be predicted.
    steered : Steered
        Motion steered by the method.
    time_scale : float
        Factor by which the motion was slowed down for the limits.
    limit : str
        Limit that required the slowdown.

    """

    source: Source
    method: str
    motions: Mapping[str, SteeredMotion]
    steered: steering.Steered
    time_scale: float
    limit: str

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the motion."""
        steered = self.steered
        how = f'after {steered.method}' if steered.modes else (
            'in the unchanged motion, as no shaper leaves less')
        slowed = Finding('slowed', Level.OK, {'scale': self.time_scale, 'limit': self.limit})
        return (*self.source.findings, *[slowed] * (self.time_scale > 1.0), Finding(
            'shaped', Level.OK, {'residual': steered.residual, 'how': how}))

    @property
    def driven(self) -> tuple[Trajectory, Array]:
        """The written motion of the tool, and the states (N, 13) of the package."""
        motion = self.motions[self.method]
        return motion.tool, motion.prediction.states

    def scenes(self) -> dict[str, tuple[Trajectory, Trajectory]]:
        """Return tool and package by the name of the motion, until some time after its end."""
        return {name: self.source.bodies(motion.tool, TAIL_SHOWN)
                for name, motion in self.motions.items()}

    def numbers(self) -> dict[str, Any]:
        """Return the numbers of the result by name."""
        return {
            'method': self.method, 'used': self.steered.method,
            **self.motions[self.method].summary(),
            'beside': {name: motion.summary() for name, motion in self.motions.items()
                       if name != self.method},
            'time_scale': self.time_scale, 'limit': self.limit,
            'modes': self.steered.modes,
            'residual_swing': self.steered.residual}


def steer_plan(
    path: MotionSource, settings: Mapping[str, Any], method: str,
    limits: File | Mapping[str, object] = '', urdf: str = '', topic: str = '',
) -> SteerReport:
    """
    Steer a plan of the tool so that the package does not swing.

    Parameters
    ----------
    path, settings, urdf, topic
        As in `workflows.plan.plan`.
    method : str
        One of `core.planning.steering.METHODS`.
    limits : path or mapping
        YAML file with limits, or its content; '' for none.

    Raises
    ------
    BellowsError
        If the method is unknown, the plan cannot be read or steered, or the limits cannot be kept.

    """
    if method not in steering.METHODS:
        raise BellowsError(f"method is '{method}'; expected one of {', '.join(steering.METHODS)}.")
    source = plan_with_cup(path, settings, urdf, topic)
    bounds = limits_in(limits, source)

    def steered_at(scale: float) -> steering.Steered:
        return steering.steer(source.model, timed(source.tool, scale), method)

    def limit_at(scale: float) -> str:
        tool, factor = steered_at(scale).tool, math.inf
        if bounds.safety_factor > 0.0:
            factor = PlanSimulation(
                source.model, source.grip, tool, tail=steering.TAIL).safety(1.0)
        return next((name for name, part in _used_parts(source, bounds, tool, factor)
                     if part > 1.0), '')

    is_bound = bool(limits) or source.joints is not None
    scale, limit = first_allowed(limit_at) if is_bound else (1.0, '')
    steered = steered_at(scale)
    motions = {method: _effect(source, steered.tool)}
    with suppress(UnstableError):  # the package falls over as planned: the steered motion alone
        motions['as planned'] = _effect(source, source.tool)
    return SteerReport(source, method, motions, steered, scale, limit)


def _effect(source: Source, tool: Trajectory) -> SteeredMotion:
    """Return the effect of a motion of the tool on the package."""
    run = PlanSimulation(source.model, source.grip, tool)
    square = mean_square(
        conversion.uncertain_of(source.values), source.model,
        lambda changed: float(run.with_model(changed).predict().summary()['swing_left']))
    return SteeredMotion(
        tool, run.predict(), float(tool.seconds[-1]) - source.duration, math.sqrt(square))


# -------------------------------------------------------------------------------------- reading


def plan_with_cup(
    path: MotionSource, settings: Mapping[str, Any], urdf: str = '', topic: str = ''
) -> Source:
    """Return a plan, with a package in the parameters; see `plan`."""
    values = checks.resolve(settings, checks.PACKAGE_PARAMETERS)
    require_types(motion=(path, str, os.PathLike, Trajectory))
    if isinstance(path, Trajectory):
        return Source(_checked_motion(path, path.twist), '', path='a motion', values=values)
    if not os.path.exists(path):
        raise BellowsError(
            f"Plan '{path}' does not exist. Give a recording, or a YAML or TUM file.")
    return read_plan(path, values, urdf, topic)


def read_plan(path: File, values: Values, urdf: str = '', topic: str = '') -> Source:
    """
    Return the plan in a file, from recording.start to recording.end; see `plan`.

    Raises
    ------
    BellowsError
        If there is no plan, or it is impossible for an arm.

    """
    source = _read_plan(Path(path), values, urdf, topic)
    plans.require_frame(source.frame_id, values)
    stamps = source.tool.stamps_ns
    chosen, _ = recordings.interval_masks(
        [stamps, stamps if source.recorded_ns is None else source.recorded_ns], values)
    if (points := np.count_nonzero(chosen)) < 2:
        raise BellowsError(
            f'The plan has {points} points from recording.start to recording.end; expected 2 or '
            'more. Select a longer part.')
    tool = source.tool.select(chosen)
    if source.recorded_ns is not None:
        tool = _from_rest(tool)
    return replace(source, tool=tool, path=os.fspath(path), values=values)


def _from_rest(tool: Trajectory) -> Trajectory:
    """Return a recorded motion with a zero first twist, if the tool stands there."""
    twist = np.array(tool.twist)
    if (np.linalg.norm(twist[0].reshape(2, 3), axis=1) <= STILL).all():
        twist[0] = 0.0
    return replace(tool, twist=twist)


def _read_plan(file: Path, values: Values, urdf: str, topic: str) -> Source:
    """Return the whole plan in a file, the first of several with a note."""
    kind = file.suffix.lower()
    if topic and kind in (*YAML, *TEXT):
        raise BellowsError(
            f"The topic is '{topic}', but '{file}' is no recording and has none. Leave it out.")
    if kind in TEXT:
        tool = plan_of(*read_tum(file), name=f"'{file}'").trajectory()
        return Source(at_tip(tool, conversion.tip_of(values)), '')
    if kind in YAML:
        content = safe_yaml.load(file)
        if isinstance(content, Mapping) and 'kind' in content:
            return _source_of_motion(content, values)
        read = [('', each) for each in plans.plans_in_yaml(content, os.fspath(file))]
    else:
        read = plans.plans_in(file, topic)
        if not read:
            return _source_of_recording(file, values, urdf, topic)
    (name, first), *more = read
    notes = [Finding('first_of_plans', Level.WARN, {
        'count': len(read), 'name': name}, os.fspath(file))] if more else []
    recording = '' if kind in YAML else file
    return replace(_source_of_plan(first, values, urdf, recording), notes=tuple(notes))


def _source_of_plan(
    read: plans.Plan, values: Values, urdf: str, recording: Any,
) -> Source:
    """Return a plan of points of the tool or of an arm's joints."""
    stamps = read.times_ns + (read.stamp_ns or START_NS)
    if read.kind == plans.JOINTS:
        arm = plans.arm_of(urdf, values.tool_link, recording).with_tip(conversion.tip_of(values))
        tool, joints = plan_of_joints(arm, read.names, stamps, *read[5:])
        return Source(tool, arm.root, joints=joints)
    tool = plan_of(stamps, read.points, read.rates, values.tool_twist.frame).trajectory()
    return Source(at_tip(tool, conversion.tip_of(values)), read.frame_id)


def _source_of_motion(content: Mapping[str, Any], values: Values) -> Source:
    """Return the tool's motion in a motion file."""
    recipe = read_recipe(content, np.array(values.package.com))
    R_world_level = alignment.levelling(values.gravity.direction).T  # z of a motion file is up
    motion = recipe.motion
    count = max(2, math.ceil(motion.duration * 500.0))  # Hz
    stamps = recipe.start_ns + np.round(
        np.linspace(0.0, motion.duration, count + 1) * NS_PER_S).astype(np.int64)
    tool = alignment.in_world(motion.trajectory(stamps, recipe.start_ns), R_world_level)
    return Source(_checked_motion(tool, tool.twist), recipe.frame_id)


def _checked_motion(
    tool: Trajectory, twist: Array | None, axes: str = 'tool', name: str = 'The motion',
    given: bool = True,
) -> Trajectory:
    """Return a motion of E with twists (N, 6) in axes of the tool or the world, as a plan."""
    return plan_of(tool.stamps_ns, trajectory.pose_rows(tool), twist, twist_frame=axes,
                   name=name, given=given).trajectory()


def _source_of_recording(path: Path, values: Values, urdf: str, topic: str) -> Source:
    """Return the tool's motion in a recording of poses or joints."""
    wanted = {'tool_pose': topic or values.topics.tool_pose,
              'tool_twist': values.topics.tool_twist}
    contents = bags.read_contents(path, wanted)
    poses, twists = (contents.streams.get(role) for role in ('tool_pose', 'tool_twist'))
    name, rates, axes = 'The motion', None, 'tool'
    if not isinstance(poses, PoseStream):
        if not values.tool_link:
            problem = contents.problems['tool_pose']
            raise type(problem)(
                f'{problem} A plan is a message of type {", ".join(plans.PLAN_TYPES)}; or poses '
                'of the tool are recorded, or joint states with tool_link.')
        read = plans.recorded_joints(path, plans.arm_of(urdf, values.tool_link, path))
        rates, twists = read.rates, None
        poses = PoseStream(
            'the tool', read.frame_id, read.stamp_ns + read.times_ns, read.points[:, :3],
            quaternion_to_rotation(read.points[:, 3:]))
    motion, given = poses.trajectory(), rates is not None or twists is not None
    if rates is None:
        name = f"Poses '{poses.name}'"
        motion, rates, axes = _with_rates(
            motion, twists if isinstance(twists, trajectory.TwistStream) else None, values)
    tool = at_tip(_checked_motion(motion, rates, axes, name, given), conversion.tip_of(values))
    return Source(tool, poses.frame_id, recorded_ns=poses.stamps_ns)


def _with_rates(
    poses: Trajectory, twists: trajectory.TwistStream | None, values: Values
) -> tuple[Trajectory, Array, str]:
    """Return measured poses with recorded or filtered twists, and the axes of the twists."""
    if twists is not None:
        first, last = twists.stamps_ns[[0, -1]]
        poses = poses.select((poses.stamps_ns >= first) & (poses.stamps_ns <= last))
        six = np.stack([
            np.interp(poses.stamps_ns - first, twists.stamps_ns - first, column)
            for column in np.hstack([twists.linear, twists.angular]).T], axis=1)
        return poses, six, values.tool_twist.frame
    rate = resampling.timing(poses.stamps_ns)
    half_window = max(4, round(preparation.AUTOMATIC_HALF_WINDOW * rate.rate_hz))
    grid = resampling.on_grid(poses, rate)
    smooth = savgol.savgol(grid, half_window, PrepareSettings.tool_order)
    return smooth, smooth.twist, 'tool'


# -------------------------------------------------------------------------------------- writing


def write_prediction(
    path: File, source: Source, tool: Trajectory, states: Array, replace_bag: bool = False
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
    source : Source
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
    stamps, start = tool.stamps_ns, int(tool.stamps_ns[0])
    tip = trajectory.from_tip(tool, conversion.tip_of(source.values))
    plan = plans.plan_of_motion(tip, 0, frame, 'tool', axes)
    package = plans.plan_of_motion(
        simulation.ToolRows(stamps, states).trajectory(), start, frame,
        PACKAGE_FRAME, axes)
    written = {'tool_arm/plan': plan, 'package/plan': package,
               'package/plan_path': package._replace(kind=plans.PATH)}
    if source.joints is not None:
        written['tool_arm/plan_joints'] = plans.plan_of_path(
            0, frame, source.joints.arm.moving, source.joints.along(tool, source.tool))
    bags.write_bag(path, [
        *(bags.Encoded(f'/{topic}', each.kind, stamps[:1], [plans.encode(each)])
          for topic, each in written.items()),
        bags.as_messages('/tool_arm/pose', POSE, stamps, plan.points, frame),
        bags.as_messages('/tool_arm/twist', TWIST, stamps, np.asarray(plan.rates), frame),
        bags.as_messages('/package/pose', POSE, stamps, package.points, frame),
    ], replace=replace_bag)
