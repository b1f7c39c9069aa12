"""Speed, acceleration and jerk; shortest times of motions within limits and with a safe grip."""

from collections.abc import Callable, Mapping
from functools import partial
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.model.cup_package import PERTURBATION, perturbed, Uncertain
from bellows_ros.core.model.equilibrium import largest_step, nominal_system_matrix
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.planning.plan_prediction import COARSE_STEP_FACTOR, PlanSimulation
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.screening import MAX_TOOL_SPEED
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
import scipy  # whose parts are loaded as they are used

RATES = {
    'speed': 'm/s', 'acceleration': 'm/s^2', 'jerk': 'm/s^3',
    'angular_speed': 'rad/s', 'angular_acceleration': 'rad/s^2', 'angular_jerk': 'rad/s^3'}
"""Limited quantities and their units."""

MAX_STRETCH = 20.0
"""Largest factor on the time of a plan."""

MIN_STRETCH = 1.02
"""Smallest relative step of the search for the factor on the time."""

STRETCH_RESOLUTION = 1.001
"""Resolution of the factor on the time, as a ratio."""
STEEPNESS = 4
"""Exponent by which the demands on a steered tool fall with the time more steeply than for a rigid
package, at most: the inverse takes two more derivatives of the package's motion."""

NO_LIMIT = 1e12
"""Placeholder for no limit."""


def read_rates(settings: Settings, default: float | None = None) -> dict[str, float]:
    """Return the limits by the names of `RATES`, from the blocks `linear` and `angular`."""
    linear, angular = settings.block('linear'), settings.block('angular')
    return {
        name: (angular if name.startswith('angular') else linear).number(
            name.removeprefix('angular_'), default, unit, above=0.0)
        for name, unit in RATES.items()}


class TooFastError(BellowsError):
    """Error for a motion that would bend the cup too far; a slower motion may exist."""


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


NO_LIMITS = Limits(
    dict.fromkeys(RATES, NO_LIMIT), np.full(3, -NO_LIMIT), np.full(3, NO_LIMIT), 0.0)


def largest_rates(rotation: Array, twist: Array, step: float) -> dict[str, float]:
    """
    Return the largest speed, acceleration and jerk, and the angular ones, SI, as in `RATES`.

    The rates are computed by differences from rotations (N, 3, 3) and body twists (N, 6) with a
    time step (s).
    """
    rates = [apply(rotation, part) for part in (twist[:, :3], twist[:, 3:])]
    sizes = [np.linalg.norm(np.diff(rate, order, axis=0), axis=1) / step ** order
             for rate in rates for order in range(3)]
    return {name: float(size.max()) for name, size in zip(RATES, sizes, strict=True)}


def demands(tool: Trajectory) -> dict[str, float]:
    """Return the `largest_rates` of a motion from rest to rest, at points 1 ms apart."""
    duration_ns = int(tool.stamps_ns[-1] - tool.stamps_ns[0])
    at = np.linspace(0, duration_ns, max(3, round(duration_ns / 1e6)) + 1).astype(np.int64)
    points = resample(tool, tool.stamps_ns[0] + at)
    ends = ((2, 2), (0, 0))
    return largest_rates(
        np.pad(points.rotation, (*ends, (0, 0)), 'edge'), np.pad(np.asarray(points.twist), ends),
        float(at[1]) / NS_PER_S)


def stretched(
    limits: Limits, motion: Callable[[float], tuple[Trajectory, float, tuple[float, str]]]
) -> tuple[float, str]:
    """
    Return the smallest factor on time with which a motion keeps limits, and the last exceeded.

    Parameters
    ----------
    limits : Limits
        Limits of the motion.
    motion : callable
        Function of a factor on time that returns the motion, its smallest safety factor, and the
        factor on time required by the joints of the arm with their limit, (1, '') if none; it
        raises `TooFastError` if no motion is that fast.

    Raises
    ------
    BellowsError
        If no factor suffices.

    """
    def needed(scale: float) -> tuple[float, str]:
        """Return the smallest required factor on time, 1 if none is required, and the limit."""
        try:
            tool, safety_factor, *joints = motion(scale)
        except TooFastError:
            if scale >= MAX_STRETCH:
                raise
            return MIN_STRETCH, 'bending'
        rates = demands(tool)
        inside = (tool.position >= limits.low - 1e-9) & (tool.position <= limits.high + 1e-9)
        factors = [
            *(((rates[name] / limits.rates[name]) ** (1.0 / (1 + i % 3 + STEEPNESS)), name)
              for i, name in enumerate(RATES)),
            (1.0 if inside.all() else MIN_STRETCH, 'workspace'),
            (1.0 if safety_factor >= limits.safety_factor else MIN_STRETCH, 'safety_factor'),
            *joints]
        return max([(1.0, ''), *(each for each in factors if each[0] > 1.0)])

    below, scale, reason = 1.0, 1.0, ''
    while True:
        factor, limit = needed(scale)
        if not limit:
            break
        if scale >= MAX_STRETCH:
            raise BellowsError(
                f'The motion exceeds the limit {limit} even at {MAX_STRETCH:g} times its '
                'duration. Check the limits.')
        below, reason = scale, limit
        scale = min(scale * max(factor, MIN_STRETCH), MAX_STRETCH)
    while scale > STRETCH_RESOLUTION * below:
        middle = math.sqrt(scale * below)
        _, limit = needed(middle)
        below, scale, reason = (middle, scale, limit) if limit else (below, middle, reason)
    return scale, reason


MAX_TIME_SCALE = 10.0
"""Largest time scale of the search."""

MIN_TIME_SCALE = 0.02
"""Smallest time scale of the search."""

SCAN_STEP = 0.006
"""Relative spacing of the time scales in the scan."""

UPDATE_WITHIN = 0.03
"""Relative distance from the required factor, and relative change of scale, within which standard
deviations are not recomputed."""

TOLERANCE = 1e-4
"""Relative accuracy of the shortest time scale."""


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

    The safety factor is not monotone in speed, as swing builds up or cancels: all scales are
    scanned from the fastest up, and the first safe one is refined.

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
        None if no time scale up to `MAX_TIME_SCALE` keeps the limits.

    """
    longest = largest_step(model)
    _, first = np.unique(tool.stamps_ns // 4_000_000, return_index=True)  # points 4 ms apart
    thin = tool.select(np.unique([*first, len(tool) - 1]))  # with its ends
    slowest = float(np.abs(np.linalg.eigvals(nominal_system_matrix(model))).min())
    tail = min(2.0, 2.0 * math.pi / slowest)  # a period of the slowest mode, s
    quick = PlanSimulation(model, grip, thin, tail=tail, longest=COARSE_STEP_FACTOR * longest)
    spread = [quick.with_model(each) for _, *both in perturbed(uncertain, model) for each in both]
    fine = PlanSimulation(model, grip, tool, tail=tail, longest=longest)

    def margin(scale: float, part: float, run: PlanSimulation) -> float:
        """Return the safety factor minus two sigma, minus the required safety factor."""
        needed = required / max(1.0 - 2.0 * part, 0.01)
        # a run far below the required factor is aborted
        return run.safety(scale, 0.95 * needed) / needed - 1.0

    def sigma(scale: float) -> float:
        """Return the standard deviation relative to the safety factor."""
        factors = [run.safety(scale) for run in spread]
        return math.hypot(*np.subtract(factors[::2], factors[1::2])) / (
            2.0 * PERTURBATION * quick.safety(scale))

    speed = float(np.linalg.norm(np.asarray(tool.twist)[:, :3], axis=1).max())
    scale = max(MIN_TIME_SCALE, speed / MAX_TOOL_SPEED)
    part, updated_at, past = 0.0, 0.0, [-1.0, -1.0]
    while scale < MAX_TIME_SCALE:
        excess = margin(scale, part, quick)
        if excess < past[1] > max(past[0], -SCAN_STEP):  # a scale in between may be safe
            scale, excess = _local_maximum(partial(margin, part=part, run=quick), scale)
        if excess > -UPDATE_WITHIN and scale > (1.0 + UPDATE_WITHIN) * updated_at:
            part, updated_at = sigma(scale), scale
            excess = margin(scale, part, quick)
        if excess >= 0.0:
            part, updated_at = sigma(scale), scale
            if margin(scale, part, quick) >= 0.0:
                return _narrowed(partial(margin, part=part, run=fine), scale, fine, part)
        past = [past[1], excess]
        scale *= 1.0 + SCAN_STEP
    return None


def _local_maximum(margin: Callable[[float], float], scale: float) -> tuple[float, float]:
    """Return the time scale and size of the largest margin in the last two steps of the scan."""
    lowest = scale / (1.0 + SCAN_STEP) ** 2
    top = scipy.optimize.minimize_scalar(
        lambda s: -margin(s), bounds=(lowest, scale), method='bounded',
        options={'xatol': 0.01 * SCAN_STEP * scale})
    return (float(top.x), -float(top.fun)) if top.fun <= 0.0 else (scale, margin(scale))


def _narrowed(
    margin: Callable[[float], float], scale: float, run: PlanSimulation, part: float
) -> Fastest:
    """Return the shortest safe time scale near a safe one, by bisection with fine steps."""
    low, high = scale / (1.0 + SCAN_STEP), scale
    while margin(high) < 0.0:  # safe with coarse steps only
        low, high = high, (1.0 + TOLERANCE) * high
    while high > (1.0 + TOLERANCE) * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if margin(middle) >= 0.0 else (middle, high)
    factor, slower, faster = (run.safety(part * high) for part in (1.0, 1.01, 0.99))
    slope = (slower - faster) / (0.02 * high)
    return Fastest(high, factor, part * factor, abs(part * factor / slope) if slope else 0.0)
