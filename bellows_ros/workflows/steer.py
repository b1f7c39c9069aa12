"""Steering of a motion for a package without swing: a plan in, the steered motion out."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.model.cup_package import mean_square
from bellows_ros.core.parameters.conversion import parameter_std, uncertain_of
from bellows_ros.core.planning import steering
from bellows_ros.core.planning.limits import (
    demands,
    exceeded,
    first_allowed,
    Limits,
)
from bellows_ros.core.planning.plan_prediction import PlanPrediction, PlanSimulation
from bellows_ros.core.planning.points import joint_excess, timed
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError, UnstableError
from bellows_ros.files import File
from bellows_ros.workflows.plan import (
    bending,
    extended,
    limits_in,
    MotionSource,
    NO_FACTOR,
    OfPlan,
    plan_with_cup,
    Source,
)

TAIL = 2.0
"""Duration of the predicted swing after the end of the motion, s."""


class SteeredMotion(NamedTuple):
    """A motion of the tool, and its effect on the package."""

    tool: Trajectory
    prediction: PlanPrediction
    added_time: float
    """Additional time beyond the plan, s."""
    along: Trajectory
    """Motion of the tool until `TAIL` after the end, N points."""
    states: Array
    """States of B in the world (N, 13): position, quaternion, body twist."""
    expected_swing: float
    """RMS of the residual swing over the uncertainty of cup and package, rad."""

    @property
    def tilt(self) -> Array:
        """Bending of the cup (N,), rad."""
        return bending(self.along.rotation, quaternion_to_rotation(self.states[:, 3:7]))

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
    uncertain : bool
        Whether any parameter has a standard deviation.

    """

    source: Source
    method: str
    motions: Mapping[str, SteeredMotion]
    steered: steering.Steered
    time_scale: float
    limit: str
    uncertain: bool

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the motion."""
        steered = self.steered
        modes = f'{len(steered.modes)} mode{"s" * (len(steered.modes) != 1)}'
        allowed = max(steering.ALLOWED_TIME, self.source.duration)
        how = f'after {steered.method} of {modes}' if steered.method in steering.METHODS else (
            f'in the unchanged motion, as no shaper leaves less within {allowed:.2g} s')
        slowed = Finding('slowed', Level.OK, {'scale': self.time_scale, 'limit': self.limit})
        return (*self.source.findings, *[slowed] * (self.time_scale > 1.0), Finding(
            'shaped', Level.OK, {'residual': steered.residual, 'how': how}))

    @property
    def driven(self) -> tuple[Trajectory, Array]:
        """The written motion of the tool, and the states (N, 13) of the package."""
        motion = self.motions[self.method]
        return motion.tool, motion.prediction.states

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
    bounds = limits_in(limits)
    source = plan_with_cup(path, settings, urdf, topic)
    bound = bool(limits) or source.joints is not None
    scale, limit = _slowdown(source, method, bounds) if bound else (1.0, '')
    steered = steering.steer(source.model, timed(source.tool, scale), method)
    motions = {method: _effect(source, steered.tool)}
    with suppress(UnstableError):  # the package falls over as planned: the steered motion alone
        motions['as planned'] = _effect(source, source.tool)
    return SteerReport(
        source, method, motions, steered, scale, limit, bool(parameter_std(source.values).any()))


def _slowdown(source: Source, method: str, limits: Limits) -> tuple[float, str]:
    """Return the factor of the duration within the limits, and the limit that requires it."""
    grip = source.grip
    if grip is None and limits.safety_factor > 0.0:
        raise BellowsError(
            f'The limit safety_factor cannot be met. {NO_FACTOR} Or leave safety_factor out.')
    low, high = source.tool.position.min(axis=0), source.tool.position.max(axis=0)
    for axis, least, most, lower, upper in zip(
            'xyz', low, high, limits.low, limits.high, strict=True):
        if least < lower or most > upper:
            raise BellowsError(
                f'The plan leaves the limit workspace at any speed: {axis} from {least:.4g} to '
                f'{most:.4g} m; expected {lower:g} to {upper:g}. Plan another motion, or correct '
                'workspace.')

    def limit_at(scale: float) -> str:
        tool = steering.steer(source.model, timed(source.tool, scale), method).tool
        factor = math.inf
        if grip is not None and limits.safety_factor > 0.0:
            factor = PlanSimulation(source.model, grip, tool, tail=TAIL).safety(1.0)
        joints, limit = source.joints, exceeded(limits, tool, factor)
        return limit or ('' if joints is None else joint_excess(
            joints.arm, joints.along(tool, source.tool), limits.joint_acceleration)[1])

    return first_allowed(limit_at)


def _effect(source: Source, tool: Trajectory) -> SteeredMotion:
    """Return the effect of a motion of the tool on the package."""
    model = source.model
    run, longer = PlanSimulation(model, source.grip, tool), extended(tool, TAIL)
    square = mean_square(
        uncertain_of(source.values), model,
        lambda changed: float(run.with_model(changed).predict().summary()['swing_left']))
    return SteeredMotion(
        tool, run.predict(), float(tool.seconds[-1]) - source.duration, longer,
        PlanSimulation(model, None, longer, tail=0.0).states(), math.sqrt(square))
