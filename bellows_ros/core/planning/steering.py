"""
Tool motions that leave the package without swing, by input shaping (Singer and Seering).

A shaped motion is the sum of delayed copies of a motion, whose swings cancel.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model import simulation
from bellows_ros.core.model.equilibrium import system_matrix
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.planning.plan_prediction import PlanPrediction, PlanSimulation, SETTLED_ANGLE
from bellows_ros.core.planning.points import body_twists, curve_of
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

METHODS = ('zv', 'zvd')

GRID = 0.001
"""Spacing of the resulting motion, s."""
MAX_COPIED_POINTS = 1_500_000
"""Largest number of points of all copies of a motion, 200 MB."""

ALLOWED_TIME = 1.0
"""Longest duration of a shaper, s, or the plan's duration if longer."""
TAIL = 2.0
"""Duration after a shaped motion in which its residual swing is evaluated, s."""
SIMILAR_FREQUENCIES = 1.05
"""Largest ratio of frequencies that are shaped as one; ZVD tolerates 5 %."""


class SwingMode(NamedTuple):
    """A mode of the hanging package."""

    frequency: float
    """Undamped frequency, Hz."""
    damping_ratio: float
    """Damping ratio."""
    swing: float
    """Rotation of the package by this mode after a plan, rad."""


class Steered(NamedTuple):
    """A motion of the tool that leaves the package without swing."""

    tool: Trajectory
    modes: list[SwingMode]
    """Shaped modes of the package."""
    residual: float
    """Swing of the package after the motion according to the model, rad."""
    method: str
    """'zv', 'zvd', or 'none' for an unchanged motion."""


def steer(model: ModelTuple, plan: Trajectory, method: str) -> Steered:
    """
    Return a motion of the tool that leaves the package without swing.

    Shapers of one mode and several modes are simulated, from short to long, up to `ALLOWED_TIME`
    and to the time in which the package settles after the plan: ZVD shapers, then ZV shapers. The
    first motion with a residual swing below `SETTLED_ANGLE` is selected, otherwise the motion with
    the least swing, which may be the plan.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    plan : Trajectory
        Poses and body twists of the tool, from rest to rest.
    method : {'zv', 'zvd'}
        Shaper of the modes of the model at rest.

    Raises
    ------
    BellowsError
        If the plan does not begin and end at rest, or the package cannot rest under the tool.

    """
    twist = np.abs(np.asarray(plan.twist)[[0, -1]])
    if (twist > np.repeat(simulation.MAX_REST_RATES, 3)).any():
        raise BellowsError(
            f'The plan begins or ends in motion, at up to {twist[:, :3].max():.3g} m/s and '
            f'{twist[:, 3:].max():.3g} rad/s; expected rest. Give a plan from rest to rest.')
    planned = PlanSimulation(model, None, plan, tail=TAIL).predict()
    swinging = to_shape(residual_modes(model, planned))
    allowed = min(max(ALLOWED_TIME, float(plan.seconds[-1])), planned.settled_after)
    best = Steered(plan, [], planned.residual_swing, 'none')
    for kind in ('zvd', 'zv') if method == 'zvd' else ('zv',):
        for count in range(1, len(swinging) + 1):
            delays, sizes = impulses(swinging[:count], kind)
            if best.residual <= SETTLED_ANGLE or delays.max() > allowed:
                break
            motion = shaped(plan, delays, sizes)
            swing = PlanSimulation(model, None, motion, tail=TAIL).predict().residual_swing
            if swing < best.residual:
                best = Steered(motion, swinging[:count], swing, kind)
    return best


def residual_modes(model: ModelTuple, prediction: PlanPrediction) -> list[SwingMode]:
    """
    Return the modes of the hanging package, with the swing of each after a plan.

    The model is linearised at rest after the plan. The slowest mode is first; overdamped modes are
    left out.
    """
    last = simulation.tool_rows(prediction.tool)[-1]
    tool = simulation.state_row(last[:3], last[3:7])
    hanging = simulation.rest(model, last)
    values, vectors = np.linalg.eig(system_matrix(model, tool, hanging))
    R = lie.quaternion_to_rotation(np.array(hanging[1]))
    end = prediction.states[-1]
    shift = R.T @ (end[:3] - hanging[0])
    rotation = lie.log_so3(R.T @ lie.quaternion_to_rotation(end[3:7]))
    state = np.concatenate([shift, rotation, end[7:], np.zeros(len(values) - 12)])  # relaxed
    sizes = np.linalg.solve(vectors, state)
    tilts = 2.0 * np.abs(sizes) * np.linalg.norm(vectors[3:6], axis=0)
    return sorted(SwingMode(abs(s) / (2.0 * math.pi), -s.real / abs(s), float(tilt))
                  for s, tilt in zip(values, tilts, strict=True) if s.imag > 1e-9 * abs(s))


def to_shape(modes: Sequence[SwingMode]) -> list[SwingMode]:
    """
    Return the modes that swing, the largest swing first.

    Similar modes are merged, weighted by their swing.
    """
    groups: list[list[SwingMode]] = []
    for mode in modes:
        if mode.swing <= SETTLED_ANGLE:
            continue
        if groups and mode.frequency < SIMILAR_FREQUENCIES * groups[-1][-1].frequency:
            groups[-1].append(mode)
        else:
            groups.append([mode])
    merged = (SwingMode(*np.average(group, axis=0, weights=[
        mode.swing for mode in group]).tolist()) for group in groups)
    return sorted(merged, key=lambda mode: -mode.swing)


def impulses(modes: Sequence[SwingMode], method: str) -> tuple[Array, Array]:
    """
    Return delays (s) and sizes, with sum 1, of the ZV or ZVD shaper of some modes (M,).

    k = exp(-zeta pi / sqrt(1 - zeta^2)) is the amplitude ratio of a swing over half a period.
    """
    delays, sizes = np.zeros(1), np.ones(1)
    for mode in modes:
        root = math.sqrt(1.0 - mode.damping_ratio ** 2)
        k = math.exp(-mode.damping_ratio * math.pi / root)
        powers = np.array([1.0, k] if method == 'zv' else [1.0, 2.0 * k, k * k])
        half = 0.5 / (mode.frequency * root)
        delays = np.add.outer(delays, half * np.arange(len(powers))).ravel()
        sizes = np.outer(sizes, powers / powers.sum()).ravel()
    return delays, sizes


def shaped(tool: Trajectory, delays: Array, sizes: Array) -> Trajectory:
    """Return the sum of delayed copies of a motion, with quaternions summed and normalised."""
    duration, curve = float(tool.seconds[-1]), curve_of(tool)
    simulation.require_steps(len(delays) * (duration + delays.max()) / GRID, MAX_COPIED_POINTS)
    seconds = np.arange(math.ceil((duration + delays.max()) / GRID - 1e-9) + 1) * GRID
    at = np.clip(seconds - delays[:, None], 0.0, duration)
    rows, rates = (np.tensordot(sizes, of(at), 1) for of in (curve, curve.derivative()))
    stamps = tool.stamps_ns[0] + np.round(seconds * NS_PER_S).astype(np.int64)
    rotation, twist = body_twists(rows[:, 3:], rates)
    return Trajectory(stamps, rows[:, :3], rotation, twist)
