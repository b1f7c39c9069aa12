"""
The toss: the valve is switched, the cup opens and releases the package, which flies and lands.

The suction, relative to the holding suction, is 1 until a delay after the valve, and falls
linearly from then on: s(t) = 1 - t / T, below 0 by a blow-off. The force F0 s of the suction
closes the bellows, whose axial force at a stretch y along the lip's z, from the cup length, is

    F = F0 s - max(0, F0 - K_z y) + F0 (max(0, y) / L)^2,

the sum of suction, folds in contact and open bellows, with its own damping. For the holding
suction (s = 1), F is K_z y. Without an opening (L = 0), F is always K_z y: the cup keeps its
length. The wrench is computed with the cup length at which the axial force is F. The package is
released at the first instant after the valve at which the load of the lip reaches V0 (s +
sticking). The flight is without air resistance, and ends when a corner of the box is at the
floor's height, measured against gravity.
"""

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model import equilibrium, kernels, simulation
from bellows_ros.core.model.grip import Grip, largest_peel_load, Law, Release
from bellows_ros.core.model.kernels import ModelTuple, State, ToolSegment
from bellows_ros.core.model.simulation import body_row, row_state, ToolRows, write_row
from bellows_ros.core.planning.plan_prediction import PlanSimulation
from bellows_ros.core.planning.points import body_twists, curve_of
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.toss import free_flight
from bellows_ros.errors import NoLandingError
import numpy as np

MAX_RELEASE_WAIT = 2.0
"""Longest time from the valve to the release, s."""

RELEASE_STEP = 1e-3
"""Longest step in which the margin of the suction is linear, s: instants to some 1 us."""

INSTANT_FALL = 1e-9
"""Time in which the suction falls for a fall of 0, s."""

DIFFERENCE_STEPS = (1e-4,) * 3 + (1e-3,) * 6 + (1e-2,) * 3 + (0.1,) * 6
"""Steps of differences by shift (m), rotation (rad), linear and angular twist (m/s, rad/s), and by
the numbers of the law of release (standard deviations)."""

HELD, DELAYED, FALLING = 0, 1, 2
"""Phases of a toss: before the valve, during its delay, and from the fall of the suction on."""

NO_GRIP: Grip = (1.0, 0.0, 0.0)
"""Grip of unknown radius or vacuum, whose release does not depend on the load."""


@kernel
def suction(law: Law, since_fall: float) -> float:
    """Return the suction a time (s) after it begins to fall, relative to the holding suction."""
    return 1.0 - max(0.0, since_fall) / max(law[1], INSTANT_FALL)


@kernel
def length_change(
    model: ModelTuple, law: Law, since_fall: float, tool: State, body: State
) -> float:
    """Return the increase of the length (m) of an opening cup while the suction falls."""
    _, _, closing, opening, _, _ = law
    cup, package, _ = model
    o_E_S, R_E_S, _, _ = kernels.lip_relative_to_tool(package[1], tool, body)
    stretch = -t3.apply_transposed(R_E_S, o_E_S)[2] - cup[1]
    stiffness, part = cup[2][0][8], max(0.0, stretch) / opening
    force = closing * (suction(law, since_fall) + part * part) - max(
        0.0, closing - stiffness * stretch)
    return stretch - force / stiffness


@kernel
def with_length(model: ModelTuple, law: Law, change: float) -> ModelTuple:
    """Return a model with a changed cup length, and with the damping of open bellows."""
    cup, package, gravity = model
    (l1, l0), P = cup[:2], cup[3]
    D = P[0][:8] + (law[4] if law[4] > 0.0 else P[0][8],)
    part = l1 / l0  # part on the side of the package
    opened = (l1 + part * change, l0 + change, cup[2], (D, P[1], P[2]), *cup[4:])
    return opened, package, gravity


@kernel
def suction_margin(
    model: ModelTuple, grip: Grip, law: Law, since_fall: float, opens: bool, tool: State,
    body: State,
) -> float:
    """
    Return the suction minus the load (N) of the lip that peels first.

    The release is at 0 or below. Without a grip model the margin is the remaining suction.
    """
    left = suction(law, since_fall) + law[5]
    if grip[1] <= 0.0:
        return left
    opened = model
    if opens:
        opened = with_length(model, law, length_change(model, law, since_fall, tool, body))
    return grip[0] * left - largest_peel_load(grip, opened, tool, body)


@kernel
def _held_substep(
    model: ModelTuple, law: Law, since_fall: float, opens: bool, segment: ToolSegment, body: State,
    low: float, high: float,
) -> tuple[State, State]:
    """
    Return tool and package at a fraction of a segment, from the package at a smaller fraction.

    The segment begins a time (s) after the suction falls, negative before. The length of a cup
    that opens is the mean of the lengths at both ends, which is accurate to second order.
    """
    before, middle = kernels.tool_at(segment, low), kernels.tool_at(segment, 0.5 * (low + high))
    tool, h = kernels.tool_at(segment, high), (high - low) * segment[0]
    if not opens:
        return tool, kernels.step(model, body, before, middle, tool, h)
    since_fall += low * segment[0]
    start = length_change(model, law, since_fall, before, body)
    change, end = start, body
    for _ in range(3):
        end = kernels.step(with_length(model, law, change), body, before, middle, tool, h)
        change = 0.5 * (start + length_change(model, law, since_fall + h, tool, end))
    return tool, end


Switching = tuple[ModelTuple, Grip, Release, float]
"""Model and grip of the held package, its release, and the time of the valve (s)."""

ToolContinuation = tuple[Any, Any, float, float]
"""
Continuation of the tool: rows (N, 13) at seconds (N,), then steady motion; end of the search for a
release (s), and the longest integration step (s).
"""


@kernel
def _release_within(
    switching: Switching, start: float, segment: ToolSegment, part: tuple[int, float, float],
    body: State, max_step: float
) -> tuple[float, State]:
    """
    Return time (s) and state of the release in a part of a segment, or -1 and the end.

    The segment starts at a time (s). The part is a phase of the toss, and the fractions of the
    segment at its ends: within a phase the margin is smooth. Before the valve nothing is released.
    """
    model, grip, release, switched = switching
    (phase, low, high), law = part, release.law
    since, opens, above = start - switched - law[0], phase == FALLING and law[3] > 0.0, 1.0
    if phase != HELD:
        above = suction_margin(
            model, grip, law, since + low * segment[0], opens, kernels.tool_at(segment, low), body)
        if above <= 0.0:
            return start + low * segment[0], body
    n = equilibrium.substeps_for((high - low) * segment[0], max_step)
    for i in range(n):
        a, b = low + (high - low) * i / n, low + (high - low) * (i + 1.0) / n
        tool, after = _held_substep(model, law, since, opens, segment, body, a, b)
        if phase != HELD:
            margin = suction_margin(
                model, grip, law, since + b * segment[0], opens, tool, after)
            if margin <= 0.0:
                b = a + (b - a) * above / (above - margin)
                _, body = _held_substep(model, law, since, opens, segment, body, a, b)
                return start + b * segment[0], body
            above = margin
        body = after
    return -1.0, body


@kernel
def find_release(
    switching: Switching, start: float, tool: State, body: State, ahead: ToolContinuation
) -> tuple[float, State]:
    """Return time (s) and state of the package at release, or -1 and the state at the end."""
    _, _, release, switched = switching
    rows, seconds, until, max_step = ahead
    max_step = min(max_step, RELEASE_STEP)
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
        high = min(1.0, (until - start) / duration)
        valve = min(max((switched - start) / duration, 0.0), high)
        fall = min(max((switched + release.law[0] - start) / duration, valve), high)
        for part in ((HELD, 0.0, valve), (DELAYED, valve, fall), (FALLING, fall, high)):
            if part[2] > part[1]:
                time, body = _release_within(switching, start, segment, part, body, max_step)
                if time >= 0.0:
                    return time, body
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
    (_, package, gravity), released = switching[0], -1.0
    write_row(out[0], body)
    for k in range(1, len(seconds)):
        start = seconds[k - 1]
        if released < 0.0:
            released, body = find_release(
                switching, start, row_state(rows[k - 1]), body,
                (rows[k:k + 1], seconds[k:k + 1], seconds[k], max_step))
            start = released
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
    if free_flight.lowest(release.half, free_flight.upward(gravity), body) <= release.height:
        return released, body, released, body
    later, landed = free_flight.land(package, gravity, release.half, release.height, body)
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


class Toss(NamedTuple):
    """A toss; times are in s of the plan, states are of B in the world."""

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
    until : float
        End of the search for a release, s.
    begin : float
        Time of the first point, s, to which all times refer.

    Attributes
    ----------
    end : float
        Time of the last point, s.
    times, tools, states : ndarray (M,), (M, 13), (M, 13 or more)
        Times of the plan's points (s), and states of E and B with its internal strains.

    Raises
    ------
    BellowsError
        If the package cannot rest under the tool, or the prediction diverges.

    """

    def __init__(
        self, model: ModelTuple, grip: Grip | None, tool: Trajectory | ToolRows,
        until: float = math.inf, begin: float = 0.0,
    ) -> None:
        self.model, self.grip, self.tool, self.begin = model, grip or NO_GRIP, tool, begin
        rows, stamps_ns = simulation.tool_rows(tool), tool.stamps_ns
        self.end = begin + float(tool.seconds[-1])
        self.ends_at_rest = simulation.stands(rows[-1, 7:])
        if self.ends_at_rest:
            still = np.concatenate([rows[-1, :7], np.zeros(6)])
            rows = np.vstack([rows[:-1], still, still])
            stamps_ns = np.append(
                stamps_ns, stamps_ns[-1] + round(MAX_RELEASE_WAIT * NS_PER_S))
        times = begin + (stamps_ns - stamps_ns[0]) / NS_PER_S
        count = min(max(2, int(np.searchsorted(times, until)) + 1), len(times))
        self._plan = ToolRows(stamps_ns[:count], rows[:count])
        run = PlanSimulation(model, grip, self._plan, tail=0.0)
        (self.states, _, loads), _, _ = run.simulated()
        if not np.isfinite(self.states).all():
            raise simulation.diverged()
        self.times, self.tools, self.start = times[:count], rows[:count], run.start
        self._longest, self._is_lost = run.longest, loads[:, 0] >= 1.0
        self._inputs = as_inputs(self.times, self.tools, self.states)

    def find_release(self, release: Release, switched: float) -> tuple[float, State, float, State]:
        """Return the result of `toss_along` for a valve switched at a time (s)."""
        times, tools, states = self._inputs
        i = max(0, int(np.searchsorted(times, switched, 'right')) - 1)
        return toss_along(
            (self.model, self.grip, release, switched), times[i], row_state(tools[i]),
            body_row(states[i], self.start),
            (tools[i + 1:], times[i + 1:], times[-1], self._longest))

    def along(self, release: Release, switched: float, seconds: Array) -> tuple[Array, Array]:
        """
        Return tool and package (N, 13) at increasing times (s), held, released, flying.

        After the plan the tool keeps its last pose.
        """
        curve = curve_of(self._plan.trajectory())
        at = np.clip(seconds, self.begin, self.times[-1]) - self.begin
        values, out = curve(at), np.empty((len(seconds), 13))
        rows = np.hstack([values, body_twists(values[:, 3:], curve(at, 1))[1]])
        rows[:, 3:7] /= np.linalg.norm(rows[:, 3:7], axis=1)[:, None]
        write_toss((self.model, self.grip, release, switched), self.start, rows, seconds,
                   self._longest, out)
        return rows, out

    def lost_before(self, switched: float) -> float | None:
        """Return the time (s) of the first point before the valve without a grip."""
        early = np.flatnonzero(self._is_lost & (self.times < switched))
        return float(self.times[early[0]]) if len(early) and self.grip != NO_GRIP else None


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
        Time of the valve, s.

    Raises
    ------
    NoLandingError
        If the valve is not switched during the plan, there is no release, or the package is
        released below the floor or never lands.

    """
    if not held.begin <= switched <= held.end:
        raise NoLandingError(
            f'The valve is switched at {switched:g} s, outside the plan; expected {held.begin:g} '
            f'to {held.end:g} s. Release earlier, or make the plan longer.')
    released, body, landing, landed = held.find_release(release, switched)
    if released < 0.0:
        raise NoLandingError(
            f'The cup does not let go within {held.times[-1] - switched:.3g} s after the valve '
            f'is switched at {switched:g} s. ' + (
                'Check release.delay, release.fall, release.sticking and whether the package '
                'hangs from the cup.'
                if held.ends_at_rest else
                'The plan ends earlier, in motion. Make it longer, or release earlier.'))
    if landing == released:
        height = free_flight.lowest(release.half, free_flight.upward(held.model[2]), body)
        raise NoLandingError(
            f'The lowest corner of the package is at {height:.4g} m at its release at '
            f'{released:.4g} s, but landing.height is {release.height:g} m: the floor is above '
            'it. Check landing.height, package.size and the frame of the plan.')
    if landing < 0.0:
        raise NoLandingError(
            f'The package does not land within {free_flight.MAX_FLIGHT_TIME:g} s. Check gravity '
            'and landing.height.')
    return Toss(released, body, landing, landed)


def latest_release(law: Law) -> float:
    """Return the longest time (s) from valve to release of a cup without load."""
    return law[0] + law[1] * (1.0 + law[5])
