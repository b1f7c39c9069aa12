"""The shortest time in which the tool can drive a plan with a safe grip."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
import math
from typing import Any, NamedTuple

from bellows_ros.core.model.equilibrium import largest_step, nominal_system_matrix
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.perturbed import perturbed, STEP
from bellows_ros.core.planning.plan import COARSE, PlanSimulation
from bellows_ros.core.signals.screening import LARGEST_SPEED
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np

SLOWEST, QUICKEST = 10.0, 0.02
"""Range of time scales that is searched."""

SCAN_STEP = 0.006
"""Relative spacing of the time scales in the scan."""

ABORT_BELOW = 0.95
"""A run is aborted when its safety factor falls below this fraction of the required one."""

LONGEST_TAIL = 2.0
"""The load may peak up to one period of the slowest mode after the end, at most this long (s)."""

ROW_NS = 4_000_000
"""Minimum spacing (ns) of the plan's points in the scan."""

UPDATE_WITHIN = 0.03
"""Standard deviations are recomputed within this fraction of the required factor, and after this
change of scale."""

TOLERANCE = 1e-4
"""Relative accuracy of the shortest time scale."""


class Fastest(NamedTuple):
    """The shortest time scale, and the safety factor there, with their standard deviations."""

    scale: float
    factor: float
    std: float
    scale_std: float


def fastest(
    values: Mapping[str, Any], model: ModelTuple, grip: Grip, tool: Trajectory, required: float
) -> Fastest | None:
    """
    Return the shortest time scale at which safety factor minus two sigma stays at `required`.

    The safety factor is not monotone in speed, as swing builds up or cancels: all scales are
    scanned from the quickest up, and the first that holds is narrowed down.

    Parameters
    ----------
    values : mapping
        Parameters by name, with standard deviations.
    model, grip : tuple
        As the kernels take them, of the same values.
    tool : Trajectory
        The plan, which ends at rest.
    required : float
        Safety factor that is needed.

    Returns
    -------
    Fastest or None
        None where none up to `SLOWEST` holds.

    """
    longest = largest_step(model)
    _, first = np.unique(tool.stamps_ns // ROW_NS, return_index=True)
    thin = tool.select(np.unique([*first, len(tool) - 1]))  # with its ends
    slowest = float(np.abs(np.linalg.eigvals(nominal_system_matrix(model))).min())
    tail = min(LONGEST_TAIL, 2.0 * math.pi / slowest)
    quick = PlanSimulation(model, grip, thin, tail=tail, longest=COARSE * longest)
    spread = [quick.with_model(each) for _, *both in perturbed(values, model) for each in both]
    fine = PlanSimulation(model, grip, tool, tail=tail, longest=longest)

    def margin(scale: float, part: float, run: PlanSimulation) -> float:
        """Return the excess of the factor, less two sigma, over the required one."""
        needed = required / max(1.0 - 2.0 * part, 0.01)
        return _factor(run, scale, 1.0 / (ABORT_BELOW * needed)) / needed - 1.0

    def sigma(scale: float) -> float:
        """Return the standard deviation as a part of the safety factor."""
        factors = [_factor(run, scale) for run in spread]
        return math.hypot(*np.subtract(factors[::2], factors[1::2])) / (
            2.0 * STEP * _factor(quick, scale))

    speed = float(np.linalg.norm(np.asarray(tool.twist)[:, :3], axis=1).max())
    scale = max(QUICKEST, speed / LARGEST_SPEED)
    part, known_at, past = 0.0, 0.0, [-1.0, -1.0]
    while scale < SLOWEST:
        here = margin(scale, part, quick)
        if here < past[1] > max(past[0], -SCAN_STEP):  # between two scales it may just hold
            scale, here = _local_maximum(partial(margin, part=part, run=quick), scale)
        if here > -UPDATE_WITHIN and scale > (1.0 + UPDATE_WITHIN) * known_at:
            part, known_at = sigma(scale), scale
            here = margin(scale, part, quick)
        if here >= 0.0:
            part, known_at = sigma(scale), scale
            if margin(scale, part, quick) >= 0.0:
                return _narrowed(partial(margin, part=part, run=fine), scale, fine, part)
        past = [past[1], here]
        scale *= 1.0 + SCAN_STEP
    return None


def _factor(run: PlanSimulation, scale: float, ceiling: float = math.inf) -> float:
    """Return the smallest safety factor, or one that is below that of a ceiling of the load."""
    load = run.load(scale, ceiling)
    return 1.0 / load if load > 0.0 else math.inf


def _local_maximum(margin: Callable[[float], float], scale: float) -> tuple[float, float]:
    """Return where a margin is largest, of the last two steps of the scan, and how large."""
    from scipy.optimize import minimize_scalar

    lowest = scale / (1.0 + SCAN_STEP) ** 2
    top = minimize_scalar(
        lambda s: -margin(s), bounds=(lowest, scale), method='bounded',
        options={'xatol': 0.01 * SCAN_STEP * scale})
    return (float(top.x), -float(top.fun)) if top.fun <= 0.0 else (scale, margin(scale))


def _narrowed(
    margin: Callable[[float], float], scale: float, run: PlanSimulation, part: float
) -> Fastest:
    """Return the shortest safe time scale near a safe one, by bisection with fine steps."""
    low, high = scale / (1.0 + SCAN_STEP), scale
    while margin(high) < 0.0:  # with coarse steps it just held
        low, high = high, (1.0 + TOLERANCE) * high
    while high > (1.0 + TOLERANCE) * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if margin(middle) >= 0.0 else (middle, high)
    factor, ends = _factor(run, high), (0.99 * high, 1.01 * high)
    slope = (_factor(run, ends[1]) - _factor(run, ends[0])) / (ends[1] - ends[0])
    return Fastest(high, factor, part * factor, abs(part * factor / slope) if slope else 0.0)
