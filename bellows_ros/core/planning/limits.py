"""Speed, acceleration and jerk; shortest times of motions within limits and with a safe grip."""

from collections.abc import Callable, Mapping, Sequence
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.model.cup_package import PERTURBATION, perturbed, Uncertain
from bellows_ros.core.model.equilibrium import nominal_system_matrix
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.screening import MAX_TOOL_SPEED
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import UndeterminedError
import numpy as np

RATES = {
    'speed': 'm/s', 'acceleration': 'm/s^2', 'jerk': 'm/s^3',
    'angular_speed': 'rad/s', 'angular_acceleration': 'rad/s^2', 'angular_jerk': 'rad/s^3'}
"""Limited quantities and their units."""

MAX_STRETCH = 20.0
"""Largest factor on the time of a plan within limits: arms run at 5 % of their speed or more."""
STRETCH_STEP = 1.02
"""Ratio of neighbouring factors in the scan: a swing of 1 s that cancels is seen to 20 ms."""

SCAN_START = 0.02
"""Smallest time scale of a plan in the scan for a safe grip."""
SCAN_END = 10.0
"""Largest time scale of a plan in the scan for a safe grip."""
SCAN_STEP = 1.006
"""Ratio of neighbouring time scales in the scan, which changes the safety factor by about 1 %."""
TOLERANCE = 1.0001
"""Resolution of a time scale, as a ratio: the accuracy of the integration."""

NO_LIMIT = 1e12
"""Placeholder for no limit."""


class Limits(NamedTuple):
    """Limits of a motion; `NO_LIMIT`, or 0 for the safety factor, means no limit."""

    rates: Mapping[str, float]
    """Limits by the names of `RATES`, SI units."""
    low: Array
    high: Array
    """Corners (3,) of the workspace of the tool tip, m."""
    safety_factor: float
    joint_acceleration: float = NO_LIMIT
    """Largest acceleration of each joint, rad/s^2 or m/s^2; speeds are in the URDF."""


def read_limits(content: object) -> Limits:
    """
    Return the limits in the content of a YAML file, explained in config/limits_example.yaml.

    All limits are optional.

    Raises
    ------
    BellowsError
        If a name or number is invalid.

    """
    settings = Settings(content)
    linear, angular = settings.block('linear'), settings.block('angular')
    rates = {
        name: (angular if name.startswith('angular') else linear).number(
            name.removeprefix('angular_'), NO_LIMIT, unit, above=0.0)
        for name, unit in RATES.items()}
    safety = settings.number('safety_factor', 0.0, minimum=0.0)
    box = settings.block('workspace')
    lower, upper = (box.vector(name, 3, (size,) * 3, 'm')
                    for name, size in (('lower', -NO_LIMIT), ('upper', NO_LIMIT)))
    acceleration = settings.number('joint_acceleration', NO_LIMIT, 'rad/s^2 or m/s^2', above=0.0)
    settings.done()
    if (lower >= upper).any():
        raise settings.error(
            'workspace', f'workspace.lower is {lower.tolist()} and workspace.upper '
            f'{upper.tolist()}; expected each number of lower below that of upper.')
    return Limits(rates, lower, upper, safety, acceleration)


def demands(tool: Trajectory) -> dict[str, float]:
    """
    Return the largest rates of a motion from rest to rest, SI, by the names of `RATES`.

    Accelerations and jerks are differences of the velocities at points 1 ms apart.
    """
    duration_ns = int(tool.stamps_ns[-1] - tool.stamps_ns[0])
    at = np.linspace(0, duration_ns, max(3, round(duration_ns / 1e6)) + 1).astype(np.int64)
    points, step = resample(tool, tool.stamps_ns[0] + at), float(at[1]) / NS_PER_S
    rates = [np.pad(apply(points.rotation, part), ((2, 2), (0, 0)))
             for part in np.hsplit(np.asarray(points.twist), 2)]
    sizes = [np.linalg.norm(np.diff(rate, order, axis=0), axis=1) / step ** order
             for rate in rates for order in range(3)]
    return {name: float(size.max()) for name, size in zip(RATES, sizes, strict=True)}


def used_parts(limits: Limits, tool: Trajectory, safety_factor: float) -> dict[str, float]:
    """Return the used part of each stated limit by a motion; a part above 1 exceeds its limit."""
    rates, half = demands(tool), 0.5 * (limits.high - limits.low)
    parts = {name: rates[name] / limit for name, limit in limits.rates.items() if limit < NO_LIMIT}
    if (half < NO_LIMIT).any():
        away = np.abs(tool.position - 0.5 * (limits.high + limits.low)) - 1e-9  # m, rounding
        parts['workspace'] = float((away / half).max())
    if limits.safety_factor > 0.0:
        parts['safety_factor'] = limits.safety_factor / safety_factor
    return parts


def first_allowed(
    limit_at: Callable[[float], str],
    scales: tuple[float, float, float] = (1.0, MAX_STRETCH, STRETCH_STEP),
) -> tuple[float, str]:
    """
    Return the first time scale within limits, and the limit of faster motions.

    All scales are scanned from the fastest up, because limits need not be monotone in speed: swing
    builds up or cancels. The interval before the first allowed scale is bisected.

    Parameters
    ----------
    limit_at : callable
        Function of a time scale that returns the exceeded limit, '' if none.
    scales : (float, float, float)
        Smallest and largest time scale, and ratio of neighbouring ones.

    Raises
    ------
    UndeterminedError
        If no scale is allowed.

    """
    scale, end, step = scales
    below, limit = scale, ''
    while found := limit_at(scale):
        if scale >= end:
            raise UndeterminedError(
                f'The motion exceeds the limit {found} even at {end:g} times its duration. Check '
                'the limits.')
        below, limit, scale = scale, found, min(scale * step, end)
    while scale > TOLERANCE * below:
        middle = math.sqrt(scale * below)
        found = limit_at(middle)
        below, scale, limit = (middle, scale, found) if found else (below, middle, limit)
    return scale, limit


class Fastest(NamedTuple):
    """The shortest time scale, and its safety factor, with their standard deviations."""

    scale: float
    factor: float
    std: float
    scale_std: float


def fastest(
    uncertain: Uncertain, model: ModelTuple, grip: Grip, tool: Trajectory, required: float
) -> Fastest | None:
    """
    Return the shortest time scale at which safety factor minus two sigma stays at `required`.

    Parameters
    ----------
    uncertain : Uncertain
        Parameters of the model, with standard deviations.
    model, grip : tuple
        Model and grip for the kernels.
    tool : Trajectory
        Plan, which ends at rest.
    required : float
        Required safety factor.

    Returns
    -------
    Fastest or None
        None if no time scale up to `SCAN_END` keeps the limits.

    """
    slowest = float(np.abs(np.linalg.eigvals(nominal_system_matrix(model))).min())
    run = PlanSimulation(model, grip, tool, tail=min(2.0, 2.0 * math.pi / slowest))  # a period
    spread = spread_of(run, uncertain, model)

    def limit_at(scale: float) -> str:
        return '' if is_safe(run, spread, required, scale) else 'safety_factor'

    try:
        scale, _ = first_allowed(limit_at, (fastest_scale(tool), SCAN_END, SCAN_STEP))
    except UndeterminedError:
        return None
    factor, slower, faster = (run.safety(scale * ratio) for ratio in (1.0, 1.01, 0.99))
    slope = (slower - faster) / (0.02 * scale)
    std = factor_std(spread, scale)
    return Fastest(scale, factor, std, abs(std / slope) if slope else 0.0)


def fastest_scale(tool: Trajectory) -> float:
    """Return the smallest time scale of a scan, at which the tool is as fast as an arm can be."""
    speed = float(np.linalg.norm(np.asarray(tool.twist)[:, :3], axis=1).max())
    return max(SCAN_START, speed / MAX_TOOL_SPEED)


def spread_of(
    run: PlanSimulation, uncertain: Uncertain, model: ModelTuple
) -> list[PlanSimulation]:
    """Return a simulation with each uncertain parameter above and below its value, in pairs."""
    return [run.with_model(each) for _, *both in perturbed(uncertain, model) for each in both]


def factor_std(spread: Sequence[PlanSimulation], scale: float) -> float:
    """Return the standard deviation of the safety factor at a time scale; see `spread_of`."""
    factors = [each.safety(scale) for each in spread]
    return math.hypot(*np.subtract(factors[::2], factors[1::2])) / (2.0 * PERTURBATION)


def is_safe(
    run: PlanSimulation, spread: Sequence[PlanSimulation], required: float, scale: float = 1.0
) -> bool:
    """Return whether the safety factor less two standard deviations is as high as required."""
    factor = run.safety(scale, required)
    return factor >= required and factor - 2.0 * factor_std(spread, scale) >= required
