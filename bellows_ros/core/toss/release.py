"""
The toss: the valve is switched, the cup opens and releases the package, which flies and lands.

The suction, relative to the holding suction, is 1 until a delay after the valve, and s(t) = (1 +
b) exp(-t / tau) - b from then on, with the blow-off b. The force F0 s of the suction closes the
bellows, whose axial force at a stretch y along the lip's z, from the cup length, is

    F = F0 s - max(0, F0 - K_z y) + F0 (max(0, y) / L)^2,

the sum of suction, folds in contact and open bellows, with its own damping. For the holding
suction (s = 1), F is K_z y. Without an opening (L = 0), F is always K_z y: the cup keeps its
length. The wrench is computed with the cup length at which the axial force is F. The package is
released at the first instant after the valve at which the load of the lip reaches V0 (s +
sticking). A blow-off pulse pushes the package along -z of S. The flight is without air resistance,
and ends when a corner of the box is at the floor's height, measured against gravity.
"""

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model import equilibrium, kernels, simulation
from bellows_ros.core.model.grip import Grip, largest_peel_load, Law, NO_LAW, Release
from bellows_ros.core.model.kernels import ModelTuple, State, ToolSegment
from bellows_ros.core.model.simulation import body_row, row_state, ToolRows, write_row
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss import free_flight
from bellows_ros.errors import NoLandingError
import numpy as np

MAX_RELEASE_WAIT = 2.0
"""Longest time from the valve to the release, s."""

LAW_STEP = 0.1
DIFFERENCE_STEPS = (1e-4,) * 3 + (1e-3,) * 6 + (1e-2,) * 3 + (LAW_STEP,) * 8
"""Steps of differences by shift (m), rotation (rad), linear and angular twist (m/s, rad/s), and by
the numbers of the law of release (standard deviations)."""

NO_GRIP: Grip = (1.0, 0.0, 0.0)
"""Grip of unknown radius or vacuum: the release is after the delay, or at the suction at which the
lip stops sticking; the load has no effect."""


@kernel
def suction(law: Law, since_valve: float) -> float:
    """Return the suction a time (s) after the valve, relative to the holding suction."""
    falling = since_valve - law[0]
    if falling < 0.0:
        return 1.0
    return (1.0 + law[3]) * (math.exp(-falling / law[1]) if law[1] > 0.0 else 0.0) - law[3]


@kernel
def length_change(
    model: ModelTuple, law: Law, since_valve: float, tool: State, body: State
) -> float:
    """Return the increase of the cup length (m) a time (s) after the valve."""
    if law[5] <= 0.0 or since_valve < law[0]:
        return 0.0
    cup, package, _ = model
    o_E_S, R_E_S, _, _ = kernels.lip_relative_to_tool(package[1], tool, body)
    stretch = -t3.apply_transposed(R_E_S, o_E_S)[2] - cup[1]
    stiffness, part = cup[2][0][8], max(0.0, stretch) / law[5]
    force = law[4] * (suction(law, since_valve) + part * part) - max(
        0.0, law[4] - stiffness * stretch)
    return stretch - force / stiffness


@kernel
def with_length(model: ModelTuple, law: Law, change: float) -> ModelTuple:
    """Return a model with a changed cup length, and with the damping of open bellows."""
    cup, package, gravity = model
    (l1, l0), P = cup[:2], cup[3]
    D = P[0][:8] + (law[6] if law[6] > 0.0 else P[0][8],)
    part = l1 / l0  # part on the side of the package
    opened = (l1 + part * change, l0 + change, cup[2], (D, P[1], P[2]), *cup[4:])
    return opened, package, gravity


@kernel
def opened_by(
    model: ModelTuple, law: Law, since_valve: float, tool: State, body: State
) -> ModelTuple:
    """Return the model in a state a time (s) after the valve."""
    if law[5] > 0.0 and since_valve >= law[0]:
        return with_length(model, law, length_change(model, law, since_valve, tool, body))
    return model


@kernel
def suction_margin(
    model: ModelTuple, grip: Grip, law: Law, since_valve: float, tool: State, body: State
) -> float:
    """
    Return the suction minus the load (N) of the lip that peels first, a time (s) after the valve.

    The release is at 0 or below. Without a grip model the margin is the remaining suction, or the
    remaining time (s) for a cup that does not open.
    """
    if grip[1] > 0.0:
        opened = opened_by(model, law, since_valve, tool, body)
        load = largest_peel_load(grip, opened, tool, body)
        return grip[0] * (suction(law, since_valve) + law[7]) - load
    return suction(law, since_valve) + law[7] if law[5] > 0.0 else law[0] - since_valve


@kernel
def _held_substep(
    model: ModelTuple, law: Law, since_valve: float, segment: ToolSegment, body: State, low: float,
    high: float,
) -> tuple[State, State]:
    """
    Return tool and package at a fraction of a segment, from the package at a smaller fraction.

    The segment begins a time (s) after the valve. The cup length is the mean of the lengths at
    both ends, which is accurate to second order.
    """
    before, middle = kernels.tool_at(segment, low), kernels.tool_at(segment, 0.5 * (low + high))
    tool, h = kernels.tool_at(segment, high), (high - low) * segment[0]
    since_valve += low * segment[0]
    if law[5] <= 0.0 or since_valve + h <= law[0]:
        return tool, kernels.step(model, body, before, middle, tool, h)
    start = length_change(model, law, since_valve, before, body)
    change, end = start, body
    for _ in range(3):
        end = kernels.step(with_length(model, law, change), body, before, middle, tool, h)
        change = 0.5 * (start + length_change(model, law, since_valve + h, tool, end))
    return tool, end


@entry
def _simulate_held(
    model: ModelTuple, grip: Grip, body: State, plan: tuple[Any, Any, Any],
    samples: tuple[Array, Array, Array, Array],
) -> None:
    """
    Write time, tool, package and margin at both ends of all integration steps.

    A plan is rows (N, 13), the durations (s) between them, and their numbers of steps.
    """
    (rows, durations, counts), (times, tools, states, margins) = plan, samples
    tool, j, start, times[0] = row_state(rows[0]), 0, 0.0, 0.0
    write_row(tools[j], tool)
    write_row(states[j], body)
    margins[j] = suction_margin(model, grip, NO_LAW, -1.0, tool, body)
    for k in range(len(durations)):
        segment = kernels.tool_segment(row_state(rows[k]), row_state(rows[k + 1]), durations[k])
        for i in range(counts[k]):
            j += 1
            times[j] = start + durations[k] * (i + 1.0) / counts[k]
            tool, body = _held_substep(
                model, NO_LAW, 0.0, segment, body, i / counts[k], (i + 1.0) / counts[k])
            write_row(tools[j], tool)
            write_row(states[j], body)
            margins[j] = suction_margin(model, grip, NO_LAW, -1.0, tool, body)
        start += durations[k]


Switching = tuple[ModelTuple, Grip, Release, float]
"""Model and grip of the held package, its release, and the time of the valve (s)."""

ToolContinuation = tuple[Any, Any, float, float]
"""
Continuation of the tool: rows (N, 13) at seconds (N,), then steady motion; end of the search for a
release (s), and the longest integration step (s).
"""


@kernel
def _released_within(
    switching: Switching, segment: ToolSegment, start: float, substep: tuple[float, float, float],
    above: float, body: State
) -> tuple[float, float, State]:
    """
    Return time (s) of release in a substep or -1, margin of the suction, and the package's state.

    A segment of the tool starts at a time (s). The substep has its first, first allowed and last
    part of the segment. `above` is the margin at its first part if positive.
    """
    model, grip, release, switched = switching
    first, low, last = substep
    bracket, released = (low, last, above, 0.0, 0.0), body  # without a root yet
    s = low if above <= 0.0 and low < last else last
    while True:
        since = start + s * segment[0] - switched
        tool, check = _held_substep(
            model, release.law, start - switched, segment, body, first, s)
        margin = suction_margin(model, grip, release.law, since, tool, check)
        if bracket[4] != 0.0:
            bracket = free_flight.narrowed(bracket, s, margin)
        elif margin <= 0.0 and s >= low:
            bracket = low, s, bracket[2], margin, -1.0
        elif s < last:
            bracket, s = (low, last, margin, 0.0, 0.0), last
            continue
        else:
            return -1.0, margin, check
        released = check if margin <= 0.0 else released
        if (bracket[1] - bracket[0]) * segment[0] <= free_flight.INSTANT_TOLERANCE:
            return start + bracket[1] * segment[0], margin, released
        s = free_flight.secant_root(bracket, 0.5 * free_flight.INSTANT_TOLERANCE / segment[0])


@kernel
def find_release(
    switching: Switching, start: float, tool: State, body: State, ahead: ToolContinuation
) -> tuple[float, State]:
    """Return time (s) and state of the package at release, or -1 and the state at the end."""
    _, _, release, switched = switching
    rows, seconds, until, max_step = ahead
    max_step = min(max_step, 1e-3) if release.law[5] > 0.0 else max_step  # s
    above = -1.0  # margin of the suction, not computed before the valve
    for k in range(len(seconds) + 1):
        if start >= until:
            break
        end, after = until, tool
        if k < len(seconds):
            end, after = seconds[k], row_state(rows[k])
        else:
            after = kernels.extrapolated(tool, until - start)
        duration = end - start
        segment = kernels.tool_segment(tool, after, duration)
        part = min(1.0, (until - start) / duration)
        n = equilibrium.substeps_for(part * duration, max_step)
        for i in range(n):
            first, last = part * i / n, part * (i + 1.0) / n
            low = max(first, (switched - start) / duration)
            time, above, body = _released_within(
                switching, segment, start, (first, low, last), above, body)
            if time >= 0.0:
                return time, body
            above = above if low <= last else -1.0
        tool, start = after, end
    return -1.0, body


@entry
def write_toss(
    switching: Switching, body: State, rows: Any, seconds: Any, max_step: float, out: Array
) -> float:
    """
    Write the package's states at the times (N,) of the tool's rows (N, 13).

    The first state is `body`. Return the time of release (s), -1 without a release.
    """
    (_, package, gravity), _, release, _ = switching
    released = -1.0
    write_row(out[0], body)
    for k in range(1, len(seconds)):
        start = seconds[k - 1]
        if released < 0.0:
            released, body = find_release(
                switching, start, row_state(rows[k - 1]), body,
                (rows[k:k + 1], seconds[k:k + 1], seconds[k], max_step))
            start = released
            if released >= 0.0:
                body = free_flight.pushed_off(package, body, release.law[2])
        if released >= 0.0:
            body = free_flight.flight(
                package, gravity, body, seconds[k] - start, free_flight.COARSE_ROTATION_PER_STEP)
        write_row(out[k], body)
    return released


@entry
def toss_along(
    switching: Switching, start: float, tool: State, body: State, ahead: ToolContinuation
) -> tuple[float, State, float, State]:
    """
    Return the times (s) of release and landing, each with the state of the package.

    Tool and package are given at the start (s), before or after the valve is switched. Without a
    release the first time is -1, with the last state; without a landing the second time is -1.
    Below the floor the landing is immediate.
    """
    (_, package, gravity), _, release, _ = switching
    released, body = find_release(switching, start, tool, body, ahead)
    if released < 0.0:
        return released, body, -1.0, body
    body = free_flight.pushed_off(package, body, release.law[2])
    if free_flight.lowest(release.box, free_flight.upward(gravity), body) <= release.height:
        return released, body, released, body
    later, landed = free_flight.land(package, gravity, release.box, release.height, body)
    return released, body, released + later if later >= 0.0 else -1.0, landed


@entry
def landing_error(landed: State, nominal: State, gravity: Vector) -> tuple[Vector, Vector]:
    """
    Return the deviation of a landing from a nominal one.

    The deviation is the position in the plane of the floor (m), without a component along gravity,
    and the rotation vector in world axes (rad). Each toss lands at its own instant: the shift
    along the flight is projected out.
    """
    up, moved = free_flight.upward(gravity), t3.subtract(landed[0], nominal[0])
    rotation = t3.quaternion_product(landed[1], t3.quaternion_conjugate(nominal[1]))
    return t3.add_scaled(moved, -t3.dot(up, moved), up), t3.log_quaternion(rotation)


@kernel
def changed_law(law: Law, k: float, by: Law) -> Law:
    """Return a law of release plus k times another; only the impulse may be negative."""
    return (
        max(law[0] + k * by[0], 0.0), max(law[1] + k * by[1], 0.0), law[2] + k * by[2],
        max(law[3] + k * by[3], 0.0), max(law[4] + k * by[4], 0.0),
        max(law[5] + k * by[5], 0.0), max(law[6] + k * by[6], 0.0),
        max(law[7] + k * by[7], 0.0))


class Toss(NamedTuple):
    """A toss; times are in s since the first point of the plan, states are of B in the world."""

    release_time: float
    release: State
    landing_time: float
    landing: State

    @property
    def tumbling(self) -> float:
        """Angular speed at landing, rad/s."""
        return math.hypot(*self.landing[3])


class HeldMotion:
    """
    The package held along a plan, before all its tosses.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    grip : tuple, optional
        Grip as returned by `grip_of`.
    tool : Trajectory or ToolRows
        The plan: poses and body twists of E; without a final twist E rests after the last pose.
    start : State, optional
        State of B in the world at the first point; default: in steady motion.
    until : float
        End of the search for a release, s since the first point.

    Attributes
    ----------
    mode : str
        Kind of release: 'peel', or 'delay' if the grip is unknown.
    duration : float
        Duration of the plan, s.
    times, tools, states, margins : ndarray (M,), (M, 13), (M, 13), (M,)
        Values at each integration step: time (s), states of E and B, and the `suction_margin` (N).

    Raises
    ------
    BellowsError
        If the package cannot rest under the tool, or the prediction diverges.

    """

    def __init__(
        self, model: ModelTuple, grip: Grip | None, tool: Trajectory | ToolRows,
        start: State | None = None, until: float = math.inf,
    ) -> None:
        self.model, self.grip, self.tool = model, grip or NO_GRIP, tool
        self.mode = 'delay' if self.grip == NO_GRIP else 'peel'
        rows, starts = simulation.tool_rows(tool), tool.seconds
        self.duration = float(starts[-1])
        self.ends_at_rest = simulation.stands(rows[-1, 7:])
        if self.ends_at_rest:
            still = np.concatenate([rows[-1, :7], np.zeros(6)])
            rows = np.vstack([rows[:-1], still, still])
            starts = np.append(starts, self.duration + MAX_RELEASE_WAIT)
        count = min(max(2, int(np.searchsorted(starts, until)) + 1), len(starts))
        self._longest = equilibrium.largest_step(model)
        durations = np.diff(starts[:count])
        counts = equilibrium.substeps_of(durations, self._longest)
        simulation.require_steps(float(counts.sum()), 1_000_000)  # each is stored
        start = start or simulation.steady_start(model, tool)
        self.start = start = equilibrium.adapted(model, row_state(rows[0]), start)
        size = int(counts.sum()) + 1
        self.times, self.margins = np.empty((2, size))
        tools, states = np.empty((size, 13)), np.empty((size, simulation.row_length(start)))
        self.tools, self.states = tools, states[:, :13]
        try:
            _simulate_held(model, self.grip, start, as_inputs(rows[:count], durations, counts),
                           (self.times, tools, states, self.margins))
        except (ArithmeticError, ValueError):  # interpreted kernels raise instead of nan
            states[-1] = math.nan
        if not np.isfinite(states[-1]).all():
            raise simulation.diverged()
        self._inputs = as_inputs(self.times, tools, states)

    def find_release(self, release: Release, switched: float) -> tuple[float, State, float, State]:
        """Return the result of `toss_along` for a valve switched at a time (s)."""
        times, tools, states = self._inputs
        i = self._step_at(switched)
        return toss_along(
            (self.model, self.grip, release, switched), times[i], row_state(tools[i]),
            body_row(states[i], self.start),
            (tools[i + 1:], times[i + 1:], times[-1], self._longest))

    def _step_at(self, time: float) -> int:
        """Return the index of the last integration step that begins at or before a time (s)."""
        return max(0, int(np.searchsorted(self.times, time, 'right')) - 1)

    def along(self, release: Release, switched: float, seconds: Array) -> tuple[Array, Array]:
        """
        Return tool and package (N, 13) at increasing times (s) from 0 on, held, released, flying.

        After the plan the tool continues straight.
        """
        times, tools, _ = self._inputs
        rows, out = np.empty((2, len(seconds), 13))
        for k, time in enumerate(seconds.tolist()):
            j = self._step_at(time)
            tool, since = row_state(tools[j]), time - float(times[j])
            if since > 0.0 and j + 1 < len(times):
                duration = float(times[j + 1] - times[j])
                segment = kernels.tool_segment(tool, row_state(tools[j + 1]), duration)
                tool = kernels.tool_at(segment, since / duration)
            elif since > 0.0:
                tool = kernels.extrapolated(tool, since)
            write_row(rows[k], tool)
        write_toss((self.model, self.grip, release, switched), self.start, rows, seconds,
                   self._longest, out)
        return rows, out

    def lost_before(self, switched: float) -> float | None:
        """Return the first time (s) before the valve at which the grip is already lost."""
        early = np.flatnonzero((self.margins <= 0.0) & (self.times < switched))
        return float(self.times[early[0]]) if len(early) else None


def toss(held: HeldMotion, release: Release, switched: float) -> Toss:
    """
    Return the toss for a valve switched at a time of the plan.

    Parameters
    ----------
    held : HeldMotion
        Package along the plan.
    release : Release
        Valve, package and floor.
    switched : float
        Time of the valve, s since the first point of the plan.

    Raises
    ------
    NoLandingError
        If the valve is not switched during the plan, there is no release, or the package is
        released below the floor or never lands.

    """
    if not 0.0 <= switched <= held.duration:
        raise NoLandingError(
            f'The valve is switched at {switched:g} s, outside the plan; expected 0 to '
            f'{held.duration:g} s. Release earlier, or make the plan longer.')
    released, body, landing, landed = held.find_release(release, switched)
    if released < 0.0:
        raise NoLandingError(
            f'The cup does not let go within {held.times[-1] - switched:.3g} s after the valve is '
            f'switched at {switched:g} s. ' + (
                'Check release.delay, release.tau, release.sticking and whether the package hangs '
                'from the cup.'
                if held.ends_at_rest else
                'The plan ends earlier, in motion. Make it longer, or release earlier.'))
    if landing == released:
        height = free_flight.lowest(release.box, free_flight.upward(held.model[2]), body)
        raise NoLandingError(
            f'The lowest corner of the package is at {height:.4g} m at its release at '
            f'{released:.4g} s, but landing.height is {release.height:g} m: the floor is above '
            'it. Check landing.height, package.size, package.size_center and the frame of the '
            'plan.')
    if landing < 0.0:
        raise NoLandingError(
            f'The package does not land within {free_flight.MAX_FLIGHT_TIME:g} s. Check gravity, '
            'landing.height and release.impulse.')
    return Toss(released, body, landing, landed)


def latest_release(law: Law) -> float:
    """Return the longest time (s) from valve to release; an opening cup is taken without load."""
    delay, tau, _, blow_off, _, opening, _, sticking = law
    if opening > 0.0 and blow_off > sticking:
        return delay + tau * math.log((1.0 + blow_off) / (blow_off - sticking))
    return delay + 6.0 * tau  # suction of 0.2 %


def flight_path(model: ModelTuple, toss: Toss, count: int) -> Array:
    """Return states (N, 13), evenly spaced from release to landing."""
    _, package, gravity = model
    out = np.empty((count, 13))
    body, h = toss.release, (toss.landing_time - toss.release_time) / (count - 1)
    for k in range(count):
        write_row(out[k], body)
        body = free_flight.flight(package, gravity, body, h, free_flight.ROTATION_PER_STEP)
    return out
