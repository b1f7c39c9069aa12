"""Landing of a planned toss with its covariance; identification of the release."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
import os
from typing import Any, NamedTuple

from bellows_ros.core import no_progress, Progress
from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.grip import RELEASE_NAMES
from bellows_ros.core.model.validity_range import flip_finding, outside_loads
from bellows_ros.core.parameters import checks, conversion, table
from bellows_ros.core.parameters.conversion import cup_of, package_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.effect import bending
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.synthetic.motion import sample_stamps
from bellows_ros.core.toss import landing, release_fit
from bellows_ros.core.toss.release import HeldMotion, NO_GRIP, Toss, toss
from bellows_ros.errors import (
    BellowsError,
    NoTopicError,
    shown,
    UndeterminedError,
    UnexplainedError,
)
from bellows_ros.files import bags, File, messages, results
from bellows_ros.workflows import CommandResult, plan
from bellows_ros.workflows.recordings import load, values_of_each
import numpy as np

RATE = 500.0
"""Rate of the poses of a written toss, Hz."""

MAX_TARGET = 100.0
"""Largest coordinate of a target, m."""

TOLERANCE = 1e-3
"""Largest distance of a reached target from the ellipse of a landing, m."""

RELEASE_UNITS = {name: table.PARAMETERS[name].unit for name in RELEASE_NAMES}

GROUPS = ('cup.stiffness', 'cup.damping', 'package.mass', 'package.com', 'package.inertia')


class Share(NamedTuple):
    """The contribution of a parameter to the scatter of the landing."""

    name: str
    std: float
    """Standard deviation of the parameter, SI units; NaN for a group."""
    metres: float
    radians: float


@dataclass(frozen=True, eq=False)
class TossResult(plan.OfPlan):
    """A toss of a plan, with all requested results."""

    source: plan.PlannedMotion
    case: landing.TossProblem
    toss: Toss
    scatter: landing.Scatter
    per_millisecond: float
    """Shift of the landing per millisecond of the valve, m."""
    aim: landing.Aim | None

    @property
    def assumed(self) -> bool:
        """Whether at most a delay is given, and its standard deviation is assumed."""
        return conversion.with_assumed_release(self.source.values) is not self.source.values

    @property
    def covariance(self) -> Array:
        """Covariance of the landing (6, 6), m and rad."""
        return self.scatter.covariance

    @property
    def mode(self) -> str:
        """Kind of release: 'peel', or 'delay' if the grip is unknown."""
        return 'delay' if self.case.held.grip == NO_GRIP else 'peel'

    def scenes(self) -> dict[str, tuple[Trajectory, Trajectory]]:
        """Return tool and package by title, held, released and flying to its landing."""
        begin = self.source.begin
        stamps_ns = sample_stamps(
            RATE, self.toss.landing_time - begin, int(self.source.tool.stamps_ns[0]))
        bodies = self.case.held.along(
            self.case.release, self.case.switched, begin + (stamps_ns - stamps_ns[0]) / NS_PER_S)
        tool, package = (simulation.ToolRows(stamps_ns, rows).trajectory() for rows in bodies)
        return {self.source.path: (tool, package)}

    def groups(self) -> list[Share]:
        """Return the contributions of groups of parameters, the largest first."""
        shares = []
        for name in (*GROUPS, *dict.fromkeys(
                name for name in self.scatter.names if name.startswith('release'))):
            std, covariance = self.scatter.of(name)
            if len(std):
                sizes = np.sqrt(np.diag(covariance).reshape(2, 3).sum(axis=1)).tolist()
                shares.append(Share(name, float(std[0]) if len(std) == 1 else math.nan, *sizes))
        return sorted(shares, key=lambda share: -share.metres)

    def numbers(self) -> dict[str, Any]:
        """Return all numbers, SI units, twists and quaternions (x, y, z, w) of B in the world."""
        toss = self.toss
        content: dict[str, Any] = {
            'valve_time': self.case.switched,
            'release_time': toss.release_time,
            'release_mode': self.mode,
            'release_pose': [*toss.release[0], *toss.release[1]],
            'release_twist': [*toss.release[2], *toss.release[3]],
            'landing_time': toss.landing_time,
            'landing_position': toss.landing[0],
            'landing_rotation': toss.landing[1],
            'landing_twist': [*toss.landing[2], *toss.landing[3]],
            'landing_covariance': self.covariance,
            'tumbling': toss.tumbling,
            'drawn': len(self.scatter.errors), 'failed': self.scatter.failed,
            'budget': [{
                'name': share.name, 'std': share.std, 'contribution_mm': 1e3 * share.metres,
                'contribution_deg': math.degrees(share.radians)} for share in self.groups()]}
        if self.aim is not None:
            content['target'] = {
                'position': list(self.aim.target), 'valve_time': self.aim.switched,
                'distance': self.aim.distance}
        return content

    @property
    def succeeded(self) -> bool:
        """Whether the target, if any, is in the 95 % ellipse of the landing."""
        return self.aim is None or bool(landing.coverage(
            self.covariance + TOLERANCE**2 * np.eye(6),
            np.subtract([self.toss.landing[0][:2]], self.aim.target)))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the toss."""
        held, switched = self.case.held, self.case.switched
        found = [*self.source.findings]
        lost_at = held.lost_before(switched)
        if lost_at is not None:
            found.append(Finding(
                'lost_before', Level.WARN, {'lost': lost_at, 'switched': switched}))
        before = held.times <= self.toss.release_time
        R_tool, R_package = (
            quaternion_to_rotation(rows[before, 3:7]) for rows in (held.tools, held.states))
        if flip := flip_finding(float(bending(R_tool, R_package).max())):
            found.append(flip)
        if self.mode == 'delay' and not self.source.values.release.opening:
            found.append(Finding('no_factor'))
        if self.assumed:
            speed = float(np.linalg.norm(self.toss.release[2]))
            found.append(Finding('assumed_delay', Level.WARN, {
                'longest': conversion.MAX_DELAY, 'speed': speed,
                'shift': conversion.MAX_DELAY * speed}))
        if outside := self._outside():
            found.append(Finding('outside', Level.WARN, {'ranges': '; '.join(outside)}))
        if self.aim and not self.succeeded:
            found.append(Finding('out_of_reach', Level.WARN, {'distance': self.aim.distance}))
        return tuple(found)

    def _outside(self) -> list[str]:
        """Return a phrase for each range of the cup, or of the drops, that the load exceeds."""
        values = self.source.values
        mass = values.package.mass
        phrases = [*outside_loads(conversion.box_of(values), mass, values.vacuum.holding)]
        if conversion.beyond_masses(values):
            lightest, heaviest = values.release.mass_range
            phrases.append(
                f'the mass is {mass:.3g} kg, of drops {lightest:.3g} to {heaviest:.3g} kg')
        return phrases


def write_toss(path: File, result: TossResult, replace_bag: bool = False) -> None:
    """
    Write tool and package, held, released and flying to its landing, like `write_prediction`.

    Raises
    ------
    BellowsError
        If the output exists, or cannot be written.

    """
    ((tool, package),) = result.scenes().values()
    plan.write_prediction(
        path, result.source, tool, simulation.tool_rows(package), replace_bag)


def _require_request(switched: float | None, target: tuple[float, float] | None) -> None:
    """Require a time of the valve or a target, in the ranges of `toss_plan`."""
    if target is None and switched is None:
        raise BellowsError(
            'Neither release nor target is given. Give the time of the valve, --release T (s), '
            'or a place to hit, --target X Y (m).')
    if switched is not None and not math.isfinite(switched):
        raise BellowsError(f'release is {shown(switched)}; expected a finite time, s.')
    if target is not None and not all(abs(x) <= MAX_TARGET for x in target):
        raise BellowsError(
            f'target is {shown(target)}; expected x and y of at most {MAX_TARGET:g} m (are they '
            'in mm?).')


def toss_plan(
    path: plan.MotionSource, parameters: Mapping[str, Any], switched: float | None,
    target: tuple[float, float] | None = None, progress: Progress = no_progress,
    urdf: str = '', topic: str = ''
) -> TossResult:
    """
    Predict a toss along a plan.

    Parameters
    ----------
    path : path
        A plan, as `workflows.plan.read_plan` reads it.
    parameters : mapping
        Values by dotted name.
    switched : float or None
        Time of the valve, s from the plan's time 0; None with a target.
    target : (x, y), optional
        Target of B in the world, m, for which the time of the valve is searched.
    progress : callable
        Callback with a sentence on the current step.
    urdf, topic : str
        URDF of the arm and topic of the plan, as for `workflows.plan.read_plan`.

    Raises
    ------
    BellowsError
        If the plan, the parameters or the time are unusable.

    """
    _require_request(switched, target)
    progress('reading the plan')
    source = plan.plan_with_cup(path, parameters, urdf, topic)
    values, gravity = conversion.with_assumed_release(source.values), source.gravity
    release = conversion.release_of(values)
    if target is not None and np.linalg.norm(gravity[:2]) > 1e-6 * np.linalg.norm(gravity):
        raise BellowsError(
            'A target is x and y on the floor, but gravity.direction is not along -z. Give the '
            'plan in a world with z up.')
    progress('following the plan')
    held = HeldMotion(source.model, source.grip, source.tool, begin=source.begin)
    aim = None
    if target is not None:
        aim = landing.aim(held, release, target)
        switched = aim.switched
    assert switched is not None
    nominal = toss(held, release, switched)
    case = landing.TossProblem(
        held, release, switched, conversion.uncertain_of(values),
        conversion.release_factor(values))
    progress(f'drawing {landing.DRAWS} tosses')
    later = release._replace(law=(release.law[0] + 1e-3, *release.law[1:]))
    shift = math.dist(toss(held, later, switched).landing[0], nominal.landing[0])
    return TossResult(
        source, case, nominal, landing.scatter(case, nominal), shift, aim)


# ----------------------------------------------------------------------- release from drops


@dataclass(frozen=True, eq=False)
class ReleaseResult(CommandResult):
    """
    The law of release from recordings of drops.

    Parameters
    ----------
    fit : ReleaseFit
        The law, and the residuals of each drop.
    bags : tuple of str
        Names of all recordings.
    used : tuple of str
        The recording of each drop.
    left_out : tuple of str
        Unused switchings of the valve, with the reasons.
    values : mapping
        All parameters.

    """

    fit: release_fit.ReleaseFit
    bags: tuple[str, ...]
    used: tuple[str, ...]
    left_out: tuple[str, ...]
    values: Values

    @property
    def inputs(self) -> tuple[str, ...]:
        """All recordings."""
        return self.bags

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the drops."""
        fit, count = self.fit, len(self.left_out)
        found = list[Finding]()
        if fit.not_identifiable:
            found.append(Finding('not_identifiable', Level.WARN, {
                'label': ', '.join(self._number(k) for k in fit.not_identifiable),
                'why': 'the given or default value is used',
                'how': 'Add drops of a package of half or twice the mass'}))
        if count:
            found.append(Finding('left_out', Level.WARN, {
                'part': f'{count} of {count + len(self.used)} valve-offs',
                'reason': '; '.join(self.left_out)}))
        return tuple(found)

    def _number(self, k: int) -> str:
        """Return a number of the law with its name, standard error and unit."""
        name = RELEASE_NAMES[k]
        value = f'{self.fit.law[k]:.3g} ± {self.fit.std[k]:.2g} {RELEASE_UNITS[name]}'
        return f'{name} ({value.rstrip()})'

    def masses(self) -> list[tuple[float, int, float, float, float]]:
        """Return mass (kg), drops, release (s; NaN if later), and rms (m, m/s)."""
        rows = []
        for mass in sorted({drop.mass for drop in self.fit.drops}):
            released, position, velocity = np.array([
                (drop.released, drop.position, drop.velocity)
                for drop in self.fit.drops if drop.mass == mass]).T
            observed = released[np.isfinite(released)]
            rows.append((
                mass, len(released), float(observed.mean()) if len(observed) else math.nan,
                *np.sqrt([np.mean(position**2), np.mean(velocity**2)]).tolist()))
        return rows

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        fit = self.fit
        return results.plain_items({
            'law': dict(zip(RELEASE_NAMES, fit.law, strict=True)),
            'standard_errors': dict(zip(RELEASE_NAMES, fit.std, strict=True)),
            'not_identifiable': [RELEASE_NAMES[k] for k in fit.not_identifiable],
            'scatter': fit.scatter,
            'chi2': fit.chi2,
            'drops': [{'bag': bag, **drop._asdict()}
                      for bag, drop in zip(self.used, fit.drops, strict=True)],
            'left_out': self.left_out,
            'warnings': self.warnings,
            'settings': self.values})


def identify_release(
    settings: Mapping[str, Any], progress: Progress = no_progress
) -> ReleaseResult:
    """
    Identify the law of release from the drops in the recordings of `bags`.

    Parameters
    ----------
    settings : mapping
        Parameters by name, with the cup, and the package of each recording.
    progress : callable
        Callback with the current step and its completed fraction (0 to 1).

    Raises
    ------
    BellowsError
        If a parameter or a recording is unusable, the drops are too few, or no law explains them.

    """
    from bellows_ros.workflows.identify import resolved

    values = resolved(settings)
    names = tuple(os.fspath(bag) for bag in values.bags)
    drops, used, left_out = list[release_fit.Drop](), list[str](), list[str]()
    for number, (bag, parameters) in enumerate(zip(names, values_of_each(values), strict=True)):
        progress(f'looking for drops in {bag}', 0.5 * number / len(names))
        model = model_tuple(
            cup_of(parameters), package_of(parameters), parameters.gravity.magnitude)
        valve = _valve_times(bag, parameters)
        usable, not_used = release_fit.drops_of(
            load(bag, parameters, accepted='frozen_orientation'), model,
            conversion.grip_of(parameters), valve)
        drops += usable
        used += [bag] * len(usable)
        left_out += [f'{bag}, {text}' for text in not_used]
    progress(f'fitting the law of release to {len(drops)} drops', 0.5)
    try:
        fit = release_fit.fit_release(drops, conversion.release_law_of(values))
    except UndeterminedError as error:
        raise type(error)(' '.join([str(error), *(f'Not used: {t}.' for t in left_out)])) from None
    progress('done', 1.0)
    result = ReleaseResult(fit, names, tuple(used), tuple(left_out), values)
    try:
        checks.resolve(values.replaced(fit.parameters()))
    except BellowsError as error:
        raise UnexplainedError(f'The best law of release is not allowed: {error}') from None
    return result


def _valve_times(bag: str, values: Values) -> list[int]:
    """Return the times of switching the valve off, ns as received."""
    topic = values.topics.valve
    switched = sorted(
        (log_ns, bool(message.data)) for _, log_ns, message
        in bags.messages_of(bag, (messages.BOOL,), topic)) if topic else []
    if not switched:
        raise NoTopicError(
            f"'{bag}' has no std_msgs/Bool on '{topic}', so the times of the "
            'valve are unknown. Record it (false for off), or name its topic with topics.valve.')
    return [log_ns for k, (log_ns, on) in enumerate(switched)
            if not on and (not k or switched[k - 1][1])]
