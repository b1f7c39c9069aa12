"""
Prediction of the package along a plan of the tool, in one compiled pass.

A plan is a `Trajectory` of E with body twists; the tool moves between its points along the cubic
Hermite curve, and rests after the last one. Loads are 1 / safety factor of the grip.
"""

from copy import copy
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion
from bellows_ros.core.model import kernels, simulation
from bellows_ros.core.model.equilibrium import adapted, largest_step, substeps_for
from bellows_ros.core.model.grip import Grip, least_factors, Margin, mode_name
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.validity_range import distance, Envelope, OVERTURN_ANGLE
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

SETTLED_ANGLE = math.radians(0.5)
"""Largest rotation from rest of a settled package, rad."""
SETTLING_TIME = 2.0
"""Duration of a settled state, s."""

MAX_TAIL = 30.0
"""Longest wait for a settled state after the end of a plan, s."""

COARSE_STEP_FACTOR = 3.0
"""Ratio of coarse and normal integration steps; accurate to 1e-4."""

PEAKS = ('peel', 'slip', 'bending', 'deflection', 'force', 'moment', 'swing')
"""Quantities whose peaks are stored: loads (1), angles (rad), deflection (m), force (N), moments
(N m)."""

NO_ABORT = np.zeros(1, np.bool_)
"""Flag that never stops a prediction."""

Extremes = tuple[Array, Array, Array]
"""Three arrays: peaks (7, 3) as in `PlanPrediction`; times and values of the two previous samples
(7, 4); smallest and largest deflection and largest twist of the lip (6, 3)."""
Watch = tuple[Extremes, float, Mask]
"""Stored results, the load above which a simulation ends, and the flag (1,) that ends it."""

UNKNOWN_GRIP: Grip = (1.0, 1.0, 1.0)
"""Placeholder for an unknown grip, whose loads are ignored."""


class PlanPrediction(NamedTuple):
    """
    The package along a plan.

    Parameters
    ----------
    tool : Trajectory or ToolRows
        Plan of N points.
    states : array (N, 13)
        States of B in the world: position (m), quaternion xyzw, body twist (m/s, rad/s).
    wrench : array (N, 6)
        Wrench of the cup on the package at S, in S axes, N and N m.
    loads : array (N, 2)
        1 / safety factor against peel and slip; meaningless without a grip model.
    peaks : array (7, 3)
        Largest value of each of `PEAKS` and its time, s since the plan's first point; for the
        loads also the cup, as a row of the grip.
    settled_after : float
        Time until the package has settled, s after the last point; infinite beyond `MAX_TAIL`.
    deflection : array (6, 2)
        Smallest and largest shift (m) and rotation vector (rad) of the lip in the tool.
    rates : array (6,)
        Largest absolute twist of the lip in the tool, m/s and rad/s.
    grip : tuple or None
        Grip of the package, None if unknown.
    ends_at_rest : bool

    """

    tool: Trajectory | simulation.ToolRows
    states: Array
    wrench: Array
    loads: Array
    peaks: Array
    settled_after: float
    deflection: Array
    rates: Array
    grip: Grip | None
    ends_at_rest: bool

    @property
    def smallest_safety(self) -> Margin:
        """Smallest safety factor of the grip."""
        worst = int(np.argmax(self.peaks[:2, 0]))
        load, time, row = self.peaks[worst].tolist()
        return Margin(1.0 / load if load > 0.0 else math.inf,
                      mode_name(self.grip or UNKNOWN_GRIP, worst, int(row)), time)

    @property
    def residual_swing(self) -> float:
        """Largest rotation of the package from rest after the end of the plan, rad."""
        return float(self.peaks[PEAKS.index('swing'), 0])

    @property
    def bending(self) -> float:
        """Largest bending of the cup, rad."""
        return float(self.peaks[PEAKS.index('bending'), 0])

    def summary(self) -> dict[str, float]:
        """Return the results of a summary, SI units; NaN for unknown ones."""
        peak = dict(zip(PEAKS, self.peaks[:, 0].tolist(), strict=True))
        factor, _, time = self.smallest_safety if self.grip else (math.nan, '', math.nan)
        return {
            'smallest_safety_factor': factor, 'smallest_safety_time': time,
            **{f'peak_{name}': peak[name] for name in PEAKS[2:6]},
            'swing_left': peak['swing'] if self.ends_at_rest else math.nan,
            'settled_after': self.settled_after if self.ends_at_rest else math.nan}

    def outside(self, valid: Envelope | None, mass: float, vacuum: float) -> tuple[str, ...]:
        """Return a phrase for each validity range that the plan, mass or vacuum exceeds."""
        if valid is None:
            return ()
        low, high = ([*deflection, *self.rates, mass, vacuum] for deflection in self.deflection.T)
        return distance(valid, low, high).outside


class PlanSimulation:
    """
    A plan prepared for predictions at several speeds and with several models.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    grip : tuple, optional
        Grip as returned by `grip_of`; without it the safety factor is unknown.
    tool : Trajectory or ToolRows
        Plan, as returned by `points.plan_of`.
    start : State, optional
        State of B in the world at the first point; default: in steady motion.
    tail : float
        Longest time (s) simulated after the end.
    longest : float
        Longest integration step (s); default: by the initial model.
    stop : bool array (1,)
        Flag that another thread sets to end the work with a BellowsError.

    Raises
    ------
    BellowsError
        If the package cannot rest under the tool; later, if the prediction diverges.

    """

    def __init__(
        self, model: ModelTuple, grip: Grip | None, tool: Trajectory | simulation.ToolRows,
        start: State | None = None, tail: float = MAX_TAIL, longest: float = 0.0,
        stop: Mask = NO_ABORT,
    ) -> None:
        """Find the rest of the package under a plan."""
        self.tool, self._model, self._grip = tool, model, grip
        self._rows = rows = simulation.tool_rows(tool)
        self._steady, self._tail = start is None, tail if simulation.stands(rows[-1, 7:]) else 0.0
        self.start = self._end = adapted(
            model, simulation.row_state(rows[0]), start or simulation.steady_start(model, tool))
        if self._tail:
            self._end = simulation.rest(model, rows[-1])
        self.longest, self._stop = longest or largest_step(model), stop
        simulation.require_steps(float(tool.seconds[-1]) / self.longest)
        self._inputs = as_inputs(rows, np.diff(tool.stamps_ns) / NS_PER_S)

    def with_model(self, model: ModelTuple) -> 'PlanSimulation':
        """Return the simulation with a slightly different model."""
        other = copy(self)
        other._model = model
        if self._steady:
            other.start = simulation.steady_start(model, self.tool, self.start)
        if self._tail:
            other._end = simulation.rest(model, self._rows[-1], self._end)
        return other

    def safety(self, duration_scale: float, least: float = 0.0) -> float:
        """Return the smallest safety factor, or the first safety factor below `least`."""
        _, (peaks, _, _), _ = self.simulated(duration_scale, 1.0 / least if least else math.inf)
        load = float(peaks[:2, 0].max())
        return 1.0 / load if load > 0.0 else math.inf

    def predict(self) -> PlanPrediction:
        """Return the prediction of the plan, and of the package swinging after its end."""
        (states, wrench, loads), (peaks, _, lip), settled = self.simulated()
        if not np.isfinite(states).all():
            raise simulation.diverged()
        return PlanPrediction(
            self.tool, states[:, :13].copy(), wrench, loads, peaks, settled, lip[:, :2],
            lip[:, 2], self._grip, self._tail > 0.0)

    def simulated(
        self, duration_scale: float = 1.0, ceiling: float = math.inf
    ) -> tuple[tuple[Array, Array, Array], Extremes, float]:
        """
        Return the samples at the points, the extremes, and the time (s) until settled.

        Samples are states with internal strains, wrenches and loads; the simulation ends at a load
        above the ceiling.
        """
        n, grip, h = len(self._rows), self._grip or UNKNOWN_GRIP, self.longest
        samples = (np.empty((n, simulation.row_length(self.start))), np.empty((n, 6)),
                   np.empty((n, 2)))
        extremes = (np.zeros((len(PEAKS), 3)), np.full((len(PEAKS), 4), math.inf),
                    np.tile([math.inf, -math.inf, 0.0], (6, 1)))
        watch, settled = (extremes, ceiling, self._stop), math.inf
        try:
            body, seconds, below = _simulate_plan(
                self._model, grip, self.start, (*self._inputs, duration_scale), h, samples, watch)
            if below:
                h = max(h, min(4e-3, COARSE_STEP_FACTOR * h))  # only the swing matters
                settled = float(_simulate_decay(
                    self._model, grip, self._end[1], simulation.row_state(self._inputs[0][-1]),
                    body, seconds, (h, math.ceil(self._tail / h)), watch))
        except (ArithmeticError, ValueError):  # interpreted kernels raise instead of nan
            raise simulation.diverged() from None
        if self._stop[0]:
            raise BellowsError('The prediction was stopped before its end.')
        return samples, extremes, settled


@kernel
def slowed(state: State, factor: float) -> State:
    """Return a state with its twist divided by a factor."""
    return state[0], state[1], t3.scale(1.0 / factor, state[2]), t3.scale(1.0 / factor, state[3])


@kernel
def update_peak(extremes: Extremes, i: int, t: float, value: float) -> bool:
    """
    Store the largest value of a quantity, and return whether it increased.

    The value is the vertex of the parabola through three samples, except where they are unevenly
    spaced, at an instantaneous change of the tool's speed.
    """
    peaks, past, _ = extremes
    before = peaks[i, 0]
    if value > before:
        peaks[i, 0], peaks[i, 1] = value, t
    t0, u0, t1, u1 = past[i, 0], past[i, 1], past[i, 2], past[i, 3]
    if u1 > u0 and u1 > value and min(t1 - t0, t - t1) > 0.1 * (t - t0):
        slope0, slope1 = (u1 - u0) / (t1 - t0), (value - u1) / (t - t1)
        curve = (slope1 - slope0) / (t - t0)  # half the second derivative
        slope = slope0 + curve * (t1 - t0)
        top = u1 - 0.25 * slope * slope / curve
        if top > peaks[i, 0]:
            peaks[i, 0], peaks[i, 1] = top, t1 - 0.5 * slope / curve
    past[i, 0], past[i, 1], past[i, 2], past[i, 3] = t1, u1, t, value
    return bool(peaks[i, 0] > before)


@kernel
def record_sample(
    model: ModelTuple, grip: Grip, tool: State, body: State, t: float, wrench: Array,
    loads: Array, extremes: Extremes,
) -> float:
    """Write wrench and loads of a state, update the peaks, and return the larger load."""
    cup, package, _ = model
    peaks, _, lip = extremes
    o, R, v, w = kernels.lip_relative_to_tool(package[1], tool, body)
    f, m = kernels.cup_wrench(cup, o, R, v, w, body[4:])
    peel, slip, peeling, slipping = least_factors(grip, cup, o, R, v, w, body[4:], f, m)
    loads[0] = 1.0 / peel if peel > 0.0 else math.inf
    loads[1] = 1.0 / slip if slip > 0.0 else math.inf
    wrench[0], wrench[1], wrench[2] = f
    wrench[3], wrench[4], wrench[5] = m
    shift = (o[0], o[1], o[2] + cup[1])
    phi = t3.rotation_between(tool[1], body[1])
    values = (loads[0], loads[1], math.atan2(math.sqrt(R[2] * R[2] + R[5] * R[5]), R[8]),
              t3.norm(shift), t3.norm(f), t3.norm(m))
    for i in range(6):
        if update_peak(extremes, i, t, values[i]) and i < 2:
            peaks[i, 2] = (peeling, slipping)[i]
    for i in range(3):
        lip[i, 0], lip[i, 1] = min(lip[i, 0], shift[i]), max(lip[i, 1], shift[i])
        lip[i + 3, 0], lip[i + 3, 1] = min(lip[i + 3, 0], phi[i]), max(lip[i + 3, 1], phi[i])
        lip[i, 2], lip[i + 3, 2] = max(lip[i, 2], abs(v[i])), max(lip[i + 3, 2], abs(w[i]))
    return float(max(loads[0], loads[1]))


@entry
def _simulate_plan(
    model: ModelTuple, grip: Grip, start: State, plan: tuple[Any, Any, float], longest: float,
    samples: tuple[Array, Array, Array], watch: Watch,
) -> tuple[State, float, bool]:
    """
    Advance along a plan with scaled durations, until a load exceeds the ceiling.

    Return the final state and its time (s), and whether all loads are below the ceiling.
    """
    (rows, durations, duration_scale), (extremes, ceiling, stop) = plan, watch
    states, wrench, loads = samples
    body, tool, t = start, slowed(simulation.row_state(rows[0]), duration_scale), 0.0
    simulation.write_row(states[0], body)
    if record_sample(model, grip, tool, body, t, wrench[0], loads[0], extremes) > ceiling:
        return body, t, False
    for k in range(len(durations)):
        if stop[0]:
            break
        duration = durations[k] * duration_scale
        after = slowed(simulation.row_state(rows[k + 1]), duration_scale)
        segment = kernels.tool_segment(tool, after, duration)
        n = substeps_for(duration, longest)
        h = duration / n
        for i in range(n):
            middle = kernels.tool_at(segment, (i + 0.5) / n)
            end = after if i == n - 1 else kernels.tool_at(segment, (i + 1.0) / n)
            body = kernels.step(model, body, tool, middle, end, h)
            tool = end
            now = t + (i + 1.0) * h
            load = record_sample(
                model, grip, tool, body, now, wrench[k + 1], loads[k + 1], extremes)
            if load > ceiling:
                return body, now, False
        t += duration
        simulation.write_row(states[k + 1], body)
    return body, t, True


@entry
def _simulate_decay(
    model: ModelTuple, grip: Grip, hanging: Quaternion, tool: State, body: State, t: float,
    steps: tuple[float, int], watch: Watch,
) -> float:
    """
    Let the package swing under a tool at rest, until a load exceeds the ceiling.

    Return the time (s) after which the rotation from rest stays below `SETTLED_ANGLE`.
    """
    (h, count), (extremes, ceiling, stop) = steps, watch
    wrench, loads = np.empty(6), np.empty(2)
    tool = slowed(tool, math.inf)
    settled, angle = 0.0, t3.norm(t3.rotation_between(hanging, body[1]))
    update_peak(extremes, 6, t, angle)
    for i in range(count):
        before, since = angle, (i + 1.0) * h
        body = kernels.step(model, body, tool, tool, tool, h)
        load = record_sample(model, grip, tool, body, t + since, wrench, loads, extremes)
        angle = t3.norm(t3.rotation_between(hanging, body[1]))
        update_peak(extremes, 6, t + since, angle)
        if load > ceiling or angle > OVERTURN_ANGLE or stop[0]:
            return math.inf
        if angle > SETTLED_ANGLE:
            settled = math.inf
        elif before > SETTLED_ANGLE:
            settled = since - h * (SETTLED_ANGLE - angle) / (before - angle)
        elif since > settled + SETTLING_TIME:
            break
    return settled if angle <= SETTLED_ANGLE else math.inf
