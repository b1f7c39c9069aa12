"""
Effect of a motion of the tool on the package: summary with standard deviations, moves, curves.

Times are s from the time 0 of the plan, of which the motion may be a part.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, quaternion_to_rotation
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import contributions, mean_square, Uncertain
from bellows_ros.core.model.grip import factors_along, Grip, Margin, margin, safety_finding
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.validity_range import Envelope, flip_finding
from bellows_ros.core.planning.plan_prediction import MAX_TAIL, PlanPrediction, PlanSimulation
from bellows_ros.core.planning.points import speed_step_finding
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

TAIL_SHOWN = 1.5
"""Longest time after the end in a picture, s."""
STANDSTILL_STEP = 0.005
"""Spacing of the points after the end, s."""

MIN_DRAWN_LOAD = 1e-3
"""Smallest load, the inverse of a safety factor, drawn."""

STILL = (0.01, 0.04)
"""Largest speeds of a tool between two moves, m/s and rad/s: ten times the noise of recorded
twists."""

MIN_STOP = 0.3
"""Shortest standstill between two moves, s: a reversal of the motion is shorter."""

DRAWN_SECONDS = 5.0
"""Part of a motion of several moves in a picture, s: a package swings 10 to 20 times in it."""


class PlanSettings(NamedTuple):
    """
    Cup, package and grip of the prediction of a plan.

    Parameters
    ----------
    model : tuple
        Cup, package, and gravity in the frame of the plan, as the kernels take them.
    uncertain : Uncertain
        Parameters of the model with their standard deviations.
    grip : Grip or None
        Grip of the cup; None if unknown.
    least : float
        Required safety factor.
    envelope : Envelope or None
        Validity range of the cup; None if unknown.
    mass : float
        Mass of the package, kg.
    holding : float
        Vacuum that holds the package, Pa below ambient; 0 if unknown.

    """

    model: ModelTuple
    uncertain: Uncertain
    grip: Grip | None
    least: float
    envelope: Envelope | None
    mass: float
    holding: float

    def deviations(self, compute: Callable[[ModelTuple], Array]) -> Array:
        """Return the standard deviations of a function of the model; 0 for exact parameters."""
        _, parts = contributions(self.uncertain, self.model, compute)
        return np.asarray(
            np.linalg.norm(parts, axis=0) if len(parts) else 0.0 * compute(self.model))


class PredictedMove(NamedTuple):
    """A move of the tool between two standstills, s, and the least factor until the next move."""

    begin: float
    end: float
    smallest_safety_factor: float


class Curves(NamedTuple):
    """
    Curves of the picture of a motion, including the time after one that ends at rest.

    Parameters
    ----------
    times : ndarray (N,)
        Times of the plan, s.
    tool : ndarray (N, 3)
        Positions of E, m.
    values, std : ndarray (N, 15)
        Position of B (3, m), bending (rad), safety factors against peel and slip, wrench of the
        cup at the lip (6, N and N m), position of B in E (3, m); and their standard deviations.

    """

    times: Array
    tool: Array
    values: Array
    std: Array


@dataclass(frozen=True, eq=False)
class Effect:
    """
    A motion of the tool, and its effect on the package.

    Parameters
    ----------
    tool : Trajectory
        Motion of E with body twists.
    begin : float
        Time of its first point, s.
    settings : PlanSettings
        Cup, package and grip.
    prediction : PlanPrediction
        Predicted motion of the package.
    std : mapping of str to float
        Standard deviation of each number of `summary`.

    """

    tool: Trajectory
    begin: float
    settings: PlanSettings
    prediction: PlanPrediction
    std: Mapping[str, float]

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return float(self.tool.seconds[-1])

    def summary(self) -> dict[str, float]:
        """Return the numbers of a summary, SI units; NaN for unknown ones."""
        numbers = {'duration': self.duration, **self.prediction.summary()}
        numbers['smallest_safety_time'] += self.begin
        return numbers

    @cached_property
    def outside(self) -> tuple[str, ...]:
        """Phrases on exceeded validity ranges of the cup."""
        settings = self.settings
        return self.prediction.outside(settings.envelope, settings.mass, settings.holding)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the motion."""
        prediction = self.prediction
        safety = Finding('no_factor') if prediction.grip is None else safety_finding(
            *prediction.smallest_safety[:2], self.std['smallest_safety_factor'],
            self.settings.least)
        found = [] if safety is None else [safety]
        if steps := speed_step_finding(self.tool):
            found.append(steps)
        if flip := flip_finding(prediction.bending):
            found.append(flip)
        at_rest = {'begins': simulation.stands(np.asarray(self.tool.twist)[0]),
                   'ends': prediction.ends_at_rest}
        moving = [side for side, is_still in at_rest.items() if not is_still]
        if moving:
            found.append(Finding('in_motion', Level.WARN, {'side': ' and '.join(moving)}))
        if self.outside:
            found.append(Finding('outside', Level.WARN, {'ranges': '; '.join(self.outside)}))
        return tuple(found)

    def with_peaks(self, seconds: Array, loads: Array) -> Array:
        """Return loads (N, 2) at times (N,), s, with the peaks between and after these times."""
        (peel, slip), loads = self.prediction.peaks[:2, :2], loads.copy()
        for mode, (load, time) in enumerate((peel, slip)):
            at = min(int(np.searchsorted(seconds, time)), len(seconds) - 1)
            loads[at, mode] = max(loads[at, mode], load)
        return loads

    @cached_property
    def moves(self) -> tuple[PredictedMove, ...]:
        """Moves between standstills of the tool, with their least safety factors."""
        speeds = np.linalg.norm(np.asarray(self.tool.twist).reshape(-1, 2, 3), axis=2)
        moving, t = np.flatnonzero((speeds > STILL).any(axis=1)), self.tool.seconds
        if self.prediction.grip is None or not len(moving):
            return ()
        stops = np.flatnonzero(np.diff(t[moving]) > MIN_STOP)
        begins, ends = moving[np.append(0, stops + 1)], moving[np.append(stops, -1)]
        loads = self.with_peaks(t, self.prediction.loads).max(axis=1)
        largest, t = np.maximum.reduceat(loads, begins), t + self.begin
        factors = [1.0 / load if load > 0.0 else math.inf for load in largest.tolist()]
        return tuple(map(PredictedMove, t[begins].tolist(), t[ends].tolist(), factors))

    @property
    def drawn(self) -> tuple[float, float]:
        """Begin and end of the picture, s: of many moves the part with the worst one."""
        duration, half, first = self.duration, 0.5 * DRAWN_SECONDS, self.begin
        if len(self.moves) < 2 or duration <= 2.0 * DRAWN_SECONDS:
            return first, first + duration + TAIL_SHOWN
        middle = first + min(max(self.prediction.smallest_safety[2], half), duration - half)
        return middle - half, middle + half

    def extended(self, seconds: float) -> Trajectory:
        """Return the motion of the tool with a final standstill of a duration (s)."""
        tool, count = self.tool, round(seconds / STANDSTILL_STEP)
        later = tool.stamps_ns[-1] + np.arange(1, count + 1) * round(STANDSTILL_STEP * NS_PER_S)
        more = ((0, count), (0, 0))
        return Trajectory(
            np.append(tool.stamps_ns, later), np.pad(tool.position, more, 'edge'),
            np.pad(tool.rotation, (*more, (0, 0)), 'edge'), np.pad(np.asarray(tool.twist), more))

    @cached_property
    def curves(self) -> Curves:
        """Curves of the picture."""
        prediction, settings = self.prediction, self.settings
        tool = self.extended(min(TAIL_SHOWN, prediction.settled_after + 0.2)
                             if prediction.ends_at_rest else 0.0)
        run = PlanSimulation(settings.model, settings.grip, tool, tail=0.0)
        R_tool_world = np.swapaxes(tool.rotation, 1, 2)

        def compute(changed: ModelTuple) -> Array:
            found = run.with_model(changed).predict()
            angle = bending(tool.rotation, quaternion_to_rotation(found.states[:, 3:7]))
            loads = self.with_peaks(tool.seconds, found.loads) if (
                changed is settings.model) else found.loads
            factors = 1.0 / np.maximum(loads, MIN_DRAWN_LOAD)
            in_tool = apply(R_tool_world, found.states[:, :3] - tool.position)
            return np.hstack(
                [found.states[:, :3], angle[:, None], factors, found.wrench, in_tool])

        return Curves(self.begin + tool.seconds, tool.position, compute(settings.model),
                      settings.deviations(compute))

    def bodies(self) -> tuple[Trajectory, Trajectory]:
        """Return tool and package, including the time after a motion that ends at rest."""
        tool = self.extended(TAIL_SHOWN if self.prediction.ends_at_rest else 0.0)
        states = PlanSimulation(self.settings.model, None, tool, tail=0.0).predict().states
        return tool, simulation.ToolRows(tool.stamps_ns, states).trajectory()

    def numbers(self) -> dict[str, Any]:
        """Return all numbers of the motion by name, SI units."""
        prediction = self.prediction
        return {
            **self.summary(), **{f'{name}_std': std for name, std in self.std.items()},
            'smallest_safety_mode': prediction.smallest_safety[1] if prediction.grip else None,
            'outside_validity': self.outside, 'moves': self.moves, 'points': len(self.tool)}


def effect_of(tool: Trajectory, begin: float, settings: PlanSettings) -> Effect:
    """Predict the package along a motion of E that begins at a time (s), with deviations."""
    run = PlanSimulation(settings.model, settings.grip, tool)
    prediction = run.predict()

    def figures(changed: ModelTuple) -> Array:
        numbers = run.with_model(changed).predict().summary()
        numbers['settled_after'] = min(numbers['settled_after'], MAX_TAIL)  # discontinuous there
        return np.nan_to_num([*numbers.values()], nan=np.nan, posinf=0.0)  # a pressed cup

    std = {name: deviation if math.isfinite(value) else math.nan for (name, value), deviation in
           zip(prediction.summary().items(), settings.deviations(figures).tolist(), strict=True)}
    rms = math.sqrt(mean_square(
        settings.uncertain, settings.model,
        lambda changed: run.with_model(changed).predict().residual_swing))
    if prediction.ends_at_rest and rms > 2.0 * prediction.residual_swing:
        std['swing_left'] = rms  # near zero, where the swing has no slope
    return Effect(tool, begin, settings, prediction, {'duration': 0.0, **std})


def bending(R_world_tool: Array, R_world_lip: Array) -> Array:
    """Return the angles (N,) in rad between the z axes of tool and lip."""
    z_tool, z_lip = R_world_tool[:, :, 2], R_world_lip[:, :, 2]
    sine = np.linalg.norm(np.cross(z_tool, z_lip), axis=1)
    return np.asarray(np.arctan2(sine, np.sum(z_tool * z_lip, axis=1)))


def smallest_margin(
    grip: Grip | None, model: ModelTuple, tool: Trajectory, package: Trajectory, seconds: Array
) -> Margin | None:
    """Return the smallest safety factor of a motion at its times (N,), s; None if unknown."""
    if grip is None:
        return None
    rows = map(simulation.tool_rows, (tool, package))
    return margin(grip, factors_along(model, grip, *rows), seconds)
