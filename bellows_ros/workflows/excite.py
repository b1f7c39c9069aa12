"""Design of the motion with the most information on a cup, its expected errors, and its output."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
import os
from typing import Any

from bellows_ros.core.excitation import motion_design
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.identification.result import MAX_RELATIVE_ERROR, parameter_units
from bellows_ros.core.model import cup_package
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.conversion import fitted_structure
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Noise
from bellows_ros.core.signals import resampling, trajectory
from bellows_ros.core.synthetic.recipe import sensor_from
from bellows_ros.errors import BellowsError
from bellows_ros.files import bag_writer, File, plan_messages, trajectory_files
from bellows_ros.files.plans import arm_of
from bellows_ros.files.results import with_units
from bellows_ros.report.sentences import sentence
from bellows_ros.workflows import CommandResult
from bellows_ros.workflows.plan import NO_FACTOR, read_plan
from bellows_ros.workflows.recordings import no_progress, Progress
import numpy as np

MIN_DURATION = motion_design.REST + 3.0 * motion_design.RAMP
"""Shortest motion: a rest and three ramps, s."""
MAX_DURATION = 120.0
"""Longest motion and longest hold, s."""


@dataclass(frozen=True, eq=False)
class DesignedMotion(CommandResult):
    """
    A designed motion and its expected information.

    Parameters
    ----------
    design : Design
        The motion, its ratios to the limits, its information.
    structure : Structure
        Structure of K and P, which defines their free entries.
    guess : array (2 n,)
        Values of the free entries in the guess.
    beside : mapping of str to array (2 n,)
        Standard errors by other motions of equal duration, by name.
    values : mapping
        All parameters.
    hold : float
        Requested duration of the hold, s.

    """

    design: motion_design.Design
    structure: Structure
    guess: Array
    beside: Mapping[str, Array]
    values: Values
    hold: float

    @property
    def errors(self) -> Array:
        """Expected standard error of each entry, (2 n,)."""
        return motion_design.standard_errors(self.design.information)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings before the motion: unidentifiable parameters, and remedies."""
        warnings: tuple[str, ...] = ()
        if motion_design.LOADS[-1] not in self.design.ratios:
            warnings += (NO_FACTOR,)
        if self.hold and not self.design.motion.hold:
            warnings += (sentence('planning', 'no_hold'),)
        limit = max(self.design.shares, key=lambda name: self.design.shares[name], default='')
        return warnings + tuple(
            sentence('planning', 'unidentifiable', label=label, error=100.0 * error / abs(value),
                     quieter=_rounded_up(factor), longer=_rounded_up(factor**2), limit=limit)
            for label, value, error in zip(
                self.structure.labels, self.guess.tolist(), self.errors.tolist(), strict=True)
            if value and (factor := error / (MAX_RELATIVE_ERROR * abs(value))) > 1.0)

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file, SI units."""
        units = parameter_units(self.structure)
        rows = zip(self.structure.labels, units, self.guess, self.errors, strict=True)
        return with_units({
            'duration_s': self.design.motion.duration,
            'hold_s': self.design.motion.hold,
            'hold_tilt': np.asarray(self.design.motion.tilt).tolist(),
            'structure': self.structure.name,
            'entries': [
                {'name': name, 'unit': unit, 'guess': float(value), 'expected_std': float(std),
                 'beside': {other: float(errors[i]) for other, errors in self.beside.items()}}
                for i, (name, unit, value, std) in enumerate(rows)],
            'parts_of_limits': self.design.ratios,
            'limited_by': self.design.shares,
            'warnings': self.warnings})


def _rounded_up(factor: float) -> str:
    """Return a factor rounded up to two digits."""
    digits = 10.0 ** (math.floor(math.log10(factor)) - 1)
    return f'{math.ceil(factor / digits) * digits:.2g}'


def excite(
    settings: Mapping[str, Any], limits: Mapping[str, Any], duration: float,
    urdf: str = '', beside: Sequence[File] = (), seed: int = 0,
    progress: Progress = no_progress, hold: float = motion_design.HOLD,
) -> DesignedMotion:
    """
    Design the motion with the most information on K and P.

    Parameters
    ----------
    settings : mapping
        Parameters by name: the initial guess of the cup, the package, fit.structure, safety.least.
    limits : mapping
        Content of a limits file, explained in config/limits_example.yaml.
    duration : float
        Duration of rest and motion, s.
    urdf : str
        File of the arm, whose joints are limited, too.
    beside : sequence of path
        Other plans, whose standard errors are computed for comparison.
    seed : int
        Seed of the initial shape of the search.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    hold : float
        Duration of a tilt after the motion for the relaxation of rubber, s; 0 for none.

    Raises
    ------
    BellowsError
        If a setting is missing or invalid, or no motion is within the limits.

    """
    for valid, words in (
        (MIN_DURATION <= duration <= MAX_DURATION,
         f'The motion is {duration:g} s long; expected {MIN_DURATION:g} to {MAX_DURATION:g} s, '
         f'with {motion_design.REST:g} s of rest and ramps of {motion_design.RAMP:g} s.'),
        (0.0 <= hold <= MAX_DURATION, f'The hold is {hold:g} s long; expected 0 (none) to '
         f'{MAX_DURATION:g} s, 5 to 10 s for rubber.'),
        (seed >= 0, f'The seed is {seed}; expected an integer from 0 on.'),
    ):
        if not valid:
            raise BellowsError(words)
    values = checks.resolve(settings, checks.PACKAGE_PARAMETERS)
    arm = arm_of(urdf, values.tool_link) if urdf else None
    bounds, block = motion_design.limits_from(limits, float(values.safety.least), arm)
    tracking = tracking_from(block)
    structure = fitted_structure(values)
    cup, package = conversion.one_cup_of(values), conversion.package_of(values)
    gravity = conversion.gravity_of(values)
    checked = motion_design.Checks(bounds, [
        cup_package.model_tuple(cup_package.gripper_of(each, structure.places), package, gravity)
        for each in motion_design.cups_near(cup)], conversion.grip_of(values))

    def errors_of(tool: trajectory.Trajectory) -> Array:
        return motion_design.standard_errors(motion_design.motion_information(
            cup, package, gravity, tool, tracking, structure))

    plans = {os.fspath(path): read_plan(path, values, urdf).tool for path in beside}
    design = motion_design.design(
        cup, package, gravity, structure, checked, tracking, duration, seed, progress, hold)
    period = tracking.package_period
    compared = {}
    for path, tool in plans.items():
        count = int(min(design.motion.duration, float(tool.seconds[-1])) / period)
        at = np.round(np.arange(count) * period * trajectory.NS_PER_S).astype(np.int64)
        compared[path] = errors_of(resampling.resample(tool, tool.stamps_ns[0] + at))
    guess = structure.parameters(cup.stiffness, cup.damping)
    return DesignedMotion(design, structure, guess, compared, values, hold)


def tracking_from(settings: checks.Settings) -> motion_design.Tracking:
    """
    Return the tracking of tool and package, from blocks as in a motion file.

    Raises
    ------
    BellowsError
        If rate or noise of a body is missing.

    """
    numbers: list[Any] = []
    for name in ('tool', 'package'):
        sensor = sensor_from(settings.block(name))
        if min(sensor.position_noise, sensor.rotation_noise) <= 0.0:
            raise BellowsError(
                f"Setting '{settings.name(name)}.noise' must have position (m) and rotation "
                "(rad) above 0: the expected errors depend on them. 'bellows info' reports the "
                'noise of a recording.')
        numbers += [1.0 / sensor.rate_hz, Noise(sensor.position_noise, sensor.rotation_noise)]
    settings.done()
    return motion_design.Tracking(*numbers)


def write_motion(
    path: File, result: DesignedMotion, csv: str = '', urscript: str = '', replace: bool = False
) -> None:
    """
    Write the motion as a recording with a plan, and optionally as CSV and URScript.

    Raises
    ------
    BellowsError
        If an output exists, or cannot be written.

    """
    frame = str(result.values.plan.frame) or 'world'
    motion = result.design.motion

    plan = plan_messages.plan_message(
        motion.at_rate(1000.0), 0, frame, 'tool', result.values.tool_twist.frame)  # Hz
    bag_writer.write_bag(path, [bag_writer.Encoded(
        '/tool_arm/plan', plan_messages.MULTI_DOF, np.array([trajectory.NS_PER_S]),
        [plan_messages.encode_multi_dof(plan)])], replace=replace)
    if csv:
        trajectory_files.write_csv(
            csv, plan.times_ns, np.hstack([plan.poses, np.asarray(plan.twists)]))
    if urscript:
        slow = motion.at_rate(125.0)  # Hz
        trajectory_files.write_urscript(
            urscript, slow.seconds, slow.position, log_so3(slow.rotation), frame)
