"""Predict the landing of a planned toss, its covariance, and the largest contribution."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.model.simulation import ToolRows
from bellows_ros.core.parameters.checks import implausible
from bellows_ros.core.planning.plan import flip_sentence, PEAK_MOMENT_BENDING
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.core.synthetic.motion import sample_stamps
from bellows_ros.core.toss import landing
from bellows_ros.core.toss.release import HeldMotion, RELEASE_NAMES, release_of, Toss, toss
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.results import UNIT_OF, with_units
from bellows_ros.workflows import CommandResult, plan
from bellows_ros.workflows.recordings import Progress, silent
import numpy as np

RATE = 500.0
"""Of the poses of a toss that is written, Hz."""

TOLERANCE = 1e-3
"""A target so far (m) outside the ellipse of a landing still counts as reached."""

GROUPS = ('cup.stiffness', 'cup.damping', 'package.mass', 'package.com', 'package.inertia')


class Share(NamedTuple):
    """The contribution of a parameter to the scatter of the landing."""

    name: str
    std: float
    """Of the parameter, SI units; of a group NaN."""
    metres: float
    radians: float


@dataclass(frozen=True, eq=False)
class TossResult(CommandResult):
    """A toss of a plan, with all that was asked of it."""

    source: plan.Source
    case: landing.TossProblem
    toss: Toss
    parts: landing.Contributions
    aim: landing.Aim | None
    asked: Toss | None
    """With a target, the toss at the given time."""
    target: tuple[float, float] | None
    drawn: landing.MonteCarlo | None

    @property
    def covariance(self) -> Array:
        """Of the landing (6, 6), m and rad."""
        return self.parts.covariance

    def shares(self) -> list[Share]:
        """Return the contribution of each uncertain number, the largest first."""
        return sorted((
            Share(name, float(std), *map(float, np.linalg.norm(part.reshape(2, 3), axis=1)))
            for name, std, part, _ in zip(*self.parts, strict=True)),
            key=lambda share: -share.metres)

    def groups(self) -> list[Share]:
        """
        Return the contributions of whole parameters, the largest first.

        Numbers of the law of release that are correlated are one, 'release'.
        """
        shares = []
        independent = np.array_equal(self.parts.correlation, np.eye(len(self.parts.std)))
        for group in (*GROUPS, *(RELEASE_NAMES if independent else ['release'])):
            std, covariance = self.parts.of(group)
            if len(std):
                sizes = np.sqrt(np.diag(covariance).reshape(2, 3).sum(axis=1)).tolist()
                shares.append(Share(group, float(std[0]) if len(std) == 1 else math.nan, *sizes))
        return sorted(shares, key=lambda share: -share.metres)

    @property
    def per_millisecond(self) -> float:
        """By how much (m) each millisecond of the valve moves the landing; 0 if not known."""
        return next((1e-3 * share.metres / share.std for share in self.shares()
                     if share.name == 'release.delay'), 0.0)

    def as_json(self) -> dict[str, Any]:
        """Return all numbers, SI units, twists and quaternions (x, y, z, w) of B in the world."""
        toss = self.toss
        content: dict[str, Any] = {
            'valve_time': self.case.switched,
            'release_time': toss.release_time,
            'release_mode': self.case.held.mode,
            'release_pose': [*toss.release[0], *toss.release[1]],
            'release_twist': [*toss.release[2], *toss.release[3]],
            'landing_time': toss.landing_time,
            'landing_position': toss.landing[0],
            'landing_rotation': toss.landing[1],
            'landing_twist': [*toss.landing[2], *toss.landing[3]],
            'landing_covariance': self.covariance,
            'tumbling': toss.tumbling,
            'budget': _budget(self.shares()),
            'budget_of_groups': _budget(self.groups()),
            'warnings': self.warnings, 'plan': self.source.path}
        if self.aim is not None and self.target is not None:
            content['target'] = {
                'position': list(self.target), 'valve_time': self.aim.switched,
                'distance': self.aim.distance, 'angle': self.aim.angle,
                'distance_as_asked': self.distance_as_asked,
                'units': {'distance': 'm', 'angle': 'rad', 'distance_as_asked': 'm'}}
        if self.drawn is not None:
            content['monte_carlo'] = {
                'count': len(self.drawn.errors), 'failed': self.drawn.failed,
                'covariance': self.drawn.covariance,
                'units': {'covariance': UNIT_OF['landing_covariance']},
                'part_in_ellipse': landing.coverage(self.covariance, self.drawn.errors)}
        return with_units(content)

    @property
    def distance_as_asked(self) -> float | None:
        """Distance from the target at the given release time, m."""
        if self.asked is None or self.target is None:
            return None
        return float(np.linalg.norm(np.subtract(self.asked.landing[0][:2], self.target)))

    @property
    def reached(self) -> bool:
        """Whether the target, if there is one, is in the 95 % ellipse of the landing."""
        return self.aim is None or self.target is None or bool(landing.coverage(
            self.covariance + TOLERANCE**2 * np.eye(6),
            np.subtract([self.toss.landing[0][:2]], self.target)))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        warnings = [*self.source.notes, *implausible(self.source.values)]
        held, values = self.case.held, self.source.values
        lost_at = held.lost_before(self.case.switched)
        if lost_at is not None:
            warnings.append(
                f'The grip is lost {lost_at:.3f} s after the beginning, before the valve is '
                f'switched at {self.case.switched:.3f} s. Move slower, or raise the vacuum.')
        before = held.times <= self.toss.release_time
        angle = float(np.max(plan.bending(*(
            quaternion_to_rotation(rows[before, 3:7]) for rows in (held.tools, held.states)))))
        if angle > PEAK_MOMENT_BENDING:
            warnings.append(flip_sentence(angle, ' before it lets go'))
        if held.mode == 'delay' and not self.case.release.law[5]:
            warnings.append(
                'Without cup.lip_radius and vacuum.holding, the cup lets go release.delay after '
                'the valve, whatever the load; release.tau has no effect.')
        if landing.beyond_masses(values):
            lightest, heaviest = values['release.mass_range']
            warnings.append(
                f'package.mass is {values["package.mass"]:.3g} kg, but release.* was '
                f'identified with packages of {lightest:.3g} to {heaviest:.3g} kg: the release is '
                'extrapolated, and its uncertainty enlarged. Identify it with drops of this mass.')
        if self.aim is not None and not self.reached:
            turned = ' in this orientation' if self.aim.angle else ''
            warnings.append(
                f'No release of this plan lands at the target{turned}: the best one is '
                f'{self.aim.distance:.3g} m away, and the target is outside its 95 % ellipse. '
                'Change the plan or the target.')
        return tuple(warnings)


def _budget(shares: list[Share]) -> list[dict[str, Any]]:
    """Return contributions as JSON; those of groups are independent, so that squares add up."""
    return [{'name': share.name, 'std': share.std, 'contribution_mm': 1e3 * share.metres,
             'contribution_deg': math.degrees(share.radians)} for share in shares]


def write_toss(path: File, result: TossResult, replace_bag: bool = False) -> None:
    """
    Write tool and package, held, parting and flying to its landing, as `write_prediction` does.

    Raises
    ------
    BellowsError
        If something is in the way, or it cannot be written.

    """
    stamps_ns = sample_stamps(RATE, result.toss.landing_time, int(result.source.tool.stamps_ns[0]))
    rows, states = result.case.held.along(
        result.case.release, result.case.switched, (stamps_ns - stamps_ns[0]) / NS_PER_S)
    plan.write_prediction(
        path, result.source, ToolRows(stamps_ns, rows).trajectory(), states, replace_bag)


def toss_plan(
    path: plan.MotionSource, parameters: Mapping[str, object], switched: float | None,
    target: tuple[float, float] | None = None, target_rotation: Array | None = None,
    monte_carlo: int = 0, progress: Progress = silent, urdf: str = '',
    topic: str = ''
) -> TossResult:
    """
    Predict a toss along a plan.

    Parameters
    ----------
    path : path
        A plan, as `workflows.plan.read_plan` reads it.
    parameters : mapping
        Dotted names to values.
    switched : float or None
        When the valve is switched, s since the first point of the plan; None with a target.
    target : (x, y), optional
        Where B should land, in the world, m; the time of the valve is then sought.
    target_rotation : array (4,), optional
        Quaternion (x, y, z, w) wanted at landing.
    monte_carlo : int
        So many tosses are drawn as well.
    progress : callable
        Called with a sentence as the work goes on.
    urdf, topic : str
        Of the arm and of the plan, as `workflows.plan.read_plan` takes them.

    Raises
    ------
    BellowsError
        If the plan, the parameters or the time are not usable.

    """
    if target is None and (target_rotation is not None or switched is None):
        raise BellowsError(
            'Neither a time nor a target is given. Give --release T or --target.'
            if target_rotation is None else
            'An orientation is wanted, but no target. Give --target X Y beside '
            '--target-rotation, or leave it out.')
    progress('reading the plan')
    source = plan.plan_with_cup(path, parameters, urdf, topic)
    release, gravity = release_of(source.values), source.gravity
    if target is not None and np.linalg.norm(gravity[:2]) > 1e-6 * np.linalg.norm(gravity):
        raise BellowsError(
            'A target is x and y on the floor, but gravity.direction is not along -z. Give the '
            'plan in a world with z up.')
    progress('following the plan')
    held = HeldMotion(source.model, source.grip, source.tool)
    asked = aim = None
    if target is not None:
        asked = None if switched is None else toss(held, release, switched)
        wanted = None if target_rotation is None else quaternion_to_rotation(target_rotation)
        aim = landing.aim(held, release, target, wanted)
        switched = aim.switched
    assert switched is not None
    nominal = toss(held, release, switched)
    case = landing.TossProblem(source.values, held, release, switched)
    progress('working out how sure the landing is')
    parts = landing.contributions_to(case, nominal)
    if monte_carlo:
        progress(f'drawing {monte_carlo} tosses')
    drawn = landing.draw(case, nominal, monte_carlo) if monte_carlo else None
    return TossResult(source, case, nominal, parts, aim, asked, target, drawn)
