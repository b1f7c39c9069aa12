"""
The toss: the valve is switched, the cup lets go, the package flies and lands.

The suction force is V0 until a delay after the valve, and V0 exp(-t / tau) from then on; cup and
lip stay what they are while they hold. The package is let go at the first instant, not before the
valve, at which the safety factor against peeling (`holding`) is 1 or less: the seal opens, and
the rest of the vacuum is gone at once. A blow-off pulse pushes it along -z of S. It flies without
air, and lands when a corner of its box is at the floor's height, measured against gravity.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, kernel
from bellows_ros.core.geometry.tuples import (
    add,
    add_scaled,
    apply,
    apply_transposed,
    dot,
    exp_quaternion,
    log_quaternion,
    normalised,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    scale,
    subtract,
    unit,
    Vector,
)
from bellows_ros.core.model.equilibrium import (
    adapted,
    largest_step,
    moved,
    substeps_for,
    substeps_of,
)
from bellows_ros.core.model.grip import Grip, peel_load
from bellows_ros.core.model.kernels import (
    extrapolated,
    lip_wrench,
    ModelTuple,
    PackageTuple,
    rotation_rate,
    Segment,
    State,
    step,
    tool_at,
    tool_segment,
    weighted,
    wrench_at_com,
)
from bellows_ros.core.model.simulation import (
    body_row,
    diverged,
    require_steps,
    row_length,
    row_state,
    Rows,
    stands,
    steady_start,
    tool_rows,
    write_row,
)
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError, NoLandingError
import numpy as np

STRIDE, LONGEST_STRIDE = 0.01, 0.02
"""Rotation (rad) per integration step of the flight, and the longest step (s)."""
COARSE_STRIDE = 0.1
"""As `STRIDE`, where 0.01 mrad is accurate enough, as of a landing."""

INSTANT = 1e-10
"""Accuracy (s) of the instants of letting go and landing."""

LONGEST_WAIT, LONGEST_FLIGHT = 2.0, 10.0
"""Longest time (s) from the valve to letting go, and from there to landing."""

MOST_STEPS = 1_000_000
"""Most steps of the package held along a plan, each of which is kept."""

PUSHES = (1e-4,) * 3 + (1e-3,) * 6 + (1e-2,) * 3 + (1.0,) * 3
"""Steps of differences by shift (m), turn (rad), linear and angular twist (m/s, rad/s), and by
delay, tau and impulse (standard deviations)."""

NO_GRIP: Grip = (1.0, 0.0, 0.0)
"""Stands for an unknown radius or vacuum: the cup lets go after the delay."""

Valve = tuple[float, float]
"""Delay (s) from the valve to the fall of the suction force, and its time constant tau (s)."""
Box = tuple[Vector, Vector]
"""Half the sides (m) along x, y, z of B, and the centre in B."""


@kernel
def spare(grip: Grip, valve: Valve, late: float, load: float) -> float:
    """
    Return the lip's excess suction (N) over a load (N) a time (s) after the valve.

    It lets go at 0 and below. Where the grip is not known, the time (s) that is left.
    """
    falling = late - valve[0]
    if grip[1] <= 0.0:
        return -falling
    left = grip[0]
    if falling >= 0.0:
        left = left * math.exp(-falling / valve[1]) if valve[1] > 0.0 else 0.0
    return left - load


@kernel
def between(low: float, high: float, above: float, below: float, least: float) -> float:
    """Return where a value vanishes between two ends, by the secant, and off both by `least`."""
    s = low + (high - low) * above / (above - below)
    return min(max(s, low + least), high - least)


@kernel
def load_at(model: ModelTuple, grip: Grip, tool: State, body: State) -> float:
    """Return the suction force (N) at or below which the lip peels in a state."""
    f, m = lip_wrench(model, tool, body)
    return peel_load(grip[1], f, m) if grip[1] > 0.0 else 0.0


@kernel
def pushed_off(package: PackageTuple, body: State, impulse: float) -> State:
    """Return a state after an impulse (N s) along -z of S, at S."""
    f, m = wrench_at_com(package[1], (0.0, 0.0, -impulse), (0.0, 0.0, 0.0))
    return (
        body[0], body[1], add_scaled(body[2], 1.0 / package[0], f),
        add(body[3], apply(package[3], m)), *body[4:],
    )


@kernel
def flown(package: PackageTuple, gravity: Vector, body: State, h: float) -> State:
    """
    Return the state h later in free flight: the parabola, and a step of RKMK4 for the rotation.

    The angular momentum L in the world is constant, and w = I^-1 R^T L.
    """
    inertia, inverse = package[2], package[3]
    q = body[1]
    R = rotation_matrix(q)
    L = apply(R, apply(inertia, body[3]))
    k1 = body[3]
    s2 = scale(0.5 * h, k1)
    k2 = rotation_rate(s2, _spin(inverse, q, s2, L))
    s3 = scale(0.5 * h, k2)
    k3 = rotation_rate(s3, _spin(inverse, q, s3, L))
    s4 = scale(h, k3)
    k4 = rotation_rate(s4, _spin(inverse, q, s4, L))
    q_later = normalised(
        quaternion_product(q, exp_quaternion(scale(h, weighted(k1, k2, k3, k4)))))
    R_later = rotation_matrix(q_later)
    velocity = apply(R, body[2])
    return (
        add_scaled(add_scaled(body[0], h, velocity), 0.5 * h * h, gravity),
        q_later,
        apply_transposed(R_later, add_scaled(velocity, h, gravity)),
        apply(inverse, apply_transposed(R_later, L)),
        *body[4:],
    )


@kernel
def _spin(inverse: Any, q: Quaternion, sigma: Vector, L: Vector) -> Vector:
    """Return the body rate after a turn by sigma, with the angular momentum L in the world."""
    R = rotation_matrix(quaternion_product(q, exp_quaternion(sigma)))
    return apply(inverse, apply_transposed(R, L))


@kernel
def stride_of(body: State, stride: float) -> float:
    """Return how long (s) a step of the flight may be."""
    rate = math.sqrt(dot(body[3], body[3]))
    return min(LONGEST_STRIDE, stride / max(rate, 1e-9))


@kernel
def flight(
    package: PackageTuple, gravity: Vector, body: State, duration: float, stride: float
) -> State:
    """Return the state a time (s) later in free flight."""
    left = duration
    while left > 0.0:
        h = min(stride_of(body, stride), left)
        body = flown(package, gravity, body, h)
        left -= h
    return body


@kernel
def upward(gravity: Vector) -> Vector:
    """Return the direction against gravity; zero without gravity."""
    return scale(-1.0 / max(math.sqrt(dot(gravity, gravity)), 1e-9), gravity)


@kernel
def lowest(box: Box, up: Vector, body: State) -> float:
    """Return the height (m) of the lowest corner of the box."""
    half, centre = box
    u = apply_transposed(rotation_matrix(body[1]), up)
    below = abs(u[0]) * half[0] + abs(u[1]) * half[1] + abs(u[2]) * half[2]
    return dot(up, body[0]) + dot(u, centre) - below


@kernel
def land(
    package: PackageTuple, gravity: Vector, box: Box, height: float, body: State
) -> tuple[float, State]:
    """Return after which time (s) the first corner is at a height, and the state; -1 if never."""
    t, up, h = 0.0, upward(gravity), stride_of(body, COARSE_STRIDE)
    low, high, landed = 0.0, math.inf, body  # the step in which it lands is narrowed (Illinois)
    above, below, side = lowest(box, up, body) - height, 0.0, 0
    while t < LONGEST_FLIGHT:
        after = flown(package, gravity, body, h)
        left = lowest(box, up, after) - height
        if left <= 0.0:
            high, below, landed = h, left, after
            above, side = above * 0.5 if side < 0 else above, -1
        elif high < math.inf:
            low, above = h, left
            below, side = below * 0.5 if side > 0 else below, 1
        else:
            t, body, above = t + h, after, left
            h = stride_of(body, COARSE_STRIDE)
            continue
        if high - low <= INSTANT:
            return t + high, landed
        h = between(low, high, above, below, 0.5 * INSTANT)
    return -1.0, body


@kernel
def _hold(
    model: ModelTuple, grip: Grip, body: State, rows: Any, durations: Any, counts: Any,
    times: Array, tools: Array, states: Array, loads: Array,
) -> None:
    """Write time, tool, package and load at both ends of all integration steps along rows."""
    tool, j, start, times[0] = row_state(rows[0]), 0, 0.0, 0.0
    write_row(tools[j], tool)
    write_row(states[j], body)
    loads[j] = load_at(model, grip, tool, body)
    for k in range(len(durations)):
        segment = tool_segment(row_state(rows[k]), row_state(rows[k + 1]), durations[k])
        for i in range(counts[k]):
            j += 1
            times[j] = start + durations[k] * (i + 1.0) / counts[k]
            tool, body = _within(model, segment, body, i / counts[k], (i + 1.0) / counts[k])
            write_row(tools[j], tool)
            write_row(states[j], body)
            loads[j] = load_at(model, grip, tool, body)
        start += durations[k]


@kernel
def _within(
    model: ModelTuple, segment: Segment, body: State, low: float, high: float
) -> tuple[State, State]:
    """Return tool and package at a fraction of a segment, from the package at a lower one."""
    tool = tool_at(segment, high)
    middle = tool_at(segment, 0.5 * (low + high))
    h = (high - low) * segment[0]
    return tool, step(model, body, tool_at(segment, low), middle, tool, h)


@kernel
def let_go(
    model: ModelTuple, grip: Grip, valve: Valve, start: float, tool: State, body: State,
    rows: Any, seconds: Any, switched: float, until: float, longest: float,
) -> tuple[float, State]:
    """Return when the cup lets go (s) and the package then, or -1 and the package at the end."""
    above = -1.0  # by how much it holds, not known before the valve
    for k in range(len(seconds) + 1):
        if start >= until:
            break
        end, after = until, tool
        if k < len(seconds):
            end, after = seconds[k], row_state(rows[k])
        else:
            after = extrapolated(tool, until - start)
        duration = end - start
        segment = tool_segment(tool, after, duration)
        part = min(1.0, (until - start) / duration)
        n = substeps_for(part * duration, longest)
        for i in range(n):
            before, last, caught, below, side = part * i / n, part * (i + 1.0) / n, False, 0.0, 0
            low, high, freed = max(before, (switched - start) / duration), last, body
            s = last if above > 0.0 or low >= last else low
            while True:  # until it lets go: the step in which it does is narrowed (Illinois)
                there, carried = _within(model, segment, body, before, s)
                load, late = load_at(model, grip, there, carried), start + s * duration - switched
                left = spare(grip, valve, late, load) if s >= low else math.inf
                if left <= 0.0:
                    high, below, freed, caught = s, left, carried, True
                    above, side = above * 0.5 if side < 0 else above, -1
                elif caught:
                    low, above = s, left
                    below, side = below * 0.5 if side > 0 else below, 1
                elif s == last:
                    above = left if s >= low else -1.0
                    break
                else:
                    above, s = left, last
                    continue
                if (high - low) * duration <= INSTANT:
                    return start + high * duration, freed
                s = between(low, high, above, below, 0.5 * INSTANT / duration)
            body = carried
        tool, start = after, end
    return -1.0, body


class Release(NamedTuple):
    """Data of valve, blow-off, package and floor."""

    valve: Valve
    impulse: float
    """Of the blow-off, along -z of S at S, N s."""
    box: Box
    height: float
    """Of the floor, from the world's origin against gravity, m."""


NO_FLIGHT = Release((0.0, 0.0), 0.0, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), math.inf)
"""Of a package whose flight does not count."""


@kernel
def toss_along(
    model: ModelTuple, grip: Grip, release: Release, start: float, tool: State, body: State,
    rows: Any, seconds: Any, switched: float, until: float, longest: float,
) -> tuple[float, State, float, State]:
    """
    Return when it is let go (s), the state after that, when it lands (s), and the state then.

    Tool and package are those at the start (s). The tool moves along rows (N, 13) at seconds (N,),
    and steadily after them; the valve is switched at a time, or was before. Times are -1 where it
    is not let go before `until`, and the first state is that of then, or where it never lands;
    below the floor it lands at once. Integration steps are at most `longest` (s).
    """
    _, package, gravity = model
    released, body = let_go(
        model, grip, release.valve, start, tool, body, rows, seconds, switched, until, longest)
    if released < 0.0:
        return released, body, -1.0, body
    body = pushed_off(package, body, release.impulse)
    if lowest(release.box, upward(gravity), body) <= release.height:
        return released, body, released, body
    later, landed = land(package, gravity, release.box, release.height, body)
    return released, body, released + later if later >= 0.0 else -1.0, landed


@kernel
def figures(landed: State, nominal: State, gravity: Vector) -> tuple[Vector, Vector]:
    """
    Return by how much a landing differs from a nominal one.

    By position in the plane of the floor (m), with no part along gravity, and by rotation vector
    in world axes (rad). Each lands at its own instant: the shift along the flight is projected
    out.
    """
    up, moved = upward(gravity), subtract(landed[0], nominal[0])
    turn = quaternion_product(landed[1], quaternion_conjugate(nominal[1]))
    return add_scaled(moved, -dot(up, moved), up), log_quaternion(turn)


@kernel
def sure_toss(
    model: ModelTuple, grip: Grip, release: Release, deviations: Vector, tool: State, body: State,
    rows: Any, seconds: Any, until: float, longest: float, first: int, last: int,
    of_state: Array, by: Array, covariance: Array,
) -> tuple[bool, tuple[float, State, float, State]]:
    """
    Write the covariance (6, 6) of a landing; return if it is known, and `toss_along` from 0.

    It is that of the `figures`: with their derivatives `by` (6, 15) from the covariance `of_state`
    (12, 12) of the package's shift, turn and twist, in its own axes, and from the deviations of
    delay (s), tau (s) and impulse (N s), by a standard deviation of each. The derivatives from
    the first to before the last are renewed.
    """
    nominal = -1.0, body, -1.0, body
    for i in range(first - 1, last):
        j = i if i >= first else -1  # the first is the toss itself
        size = PUSHES[max(j, 0)]
        delay, tau, impulse = unit(j - 12, deviations[max(j - 12, 0)])
        changed = Release(
            (release.valve[0] + delay, release.valve[1] + tau), release.impulse + impulse,
            release.box, release.height)
        found = toss_along(
            model, grip, changed, 0.0, tool,
            moved(body, unit(j, size), unit(j - 3, size), unit(j - 6, size), unit(j - 9, size)),
            rows, seconds, 0.0, until, longest)
        if found[2] <= found[0]:
            return False, found
        if j < 0:
            nominal = found
        else:
            shift, turn = figures(found[3], nominal[3], model[2])
            for k in range(3):
                by[k, j], by[k + 3, j] = shift[k] / size, turn[k] / size
    covariance[:] = 0.0
    total = 0.0
    for i in range(6):
        for k in range(15):
            part = by[i, k]
            if k < 12:
                part = 0.0
                for m in range(12):
                    part += by[i, m] * of_state[m, k]
            for j in range(6):
                covariance[i, j] += part * by[j, k]
            total += covariance[i, i]
    return total - total == 0.0, nominal


class Toss(NamedTuple):
    """A toss; times are s since the first point of the plan, states are of B in the world."""

    release_time: float
    release: State
    landing_time: float
    landing: State
    release_mode: str = ''
    """'peel', or 'delay' if the grip is unknown."""

    @property
    def tumbling(self) -> float:
        """Angular speed at landing, rad/s."""
        return math.hypot(*self.landing[3])


class Held:
    """
    The package held along a plan, the start of all its tosses.

    Parameters
    ----------
    model : tuple
        As the kernels take it.
    grip : tuple, optional
        As `grip_of` returns it.
    tool : Trajectory or Rows
        The plan: poses and body twists of E; it stands still after the last one, if it does there.
    start : State, optional
        Of B in the world at the first point; in steady motion there when left out.
    until : float
        Time (s since the first point) up to which it is looked at.

    Attributes
    ----------
    duration : float
        Of the plan, s.
    times, states, loads : ndarray (M,), (M, 13), (M,)
        At each integration step: time (s), state of B, and the suction force (N) at which it
        would peel.

    Raises
    ------
    BellowsError
        If the package cannot rest under the tool, or the prediction does not stay finite.

    """

    def __init__(
        self, model: ModelTuple, grip: Grip | None, tool: Trajectory | Rows,
        start: State | None = None, until: float = math.inf,
    ) -> None:
        """Follow the plan."""
        self.model, self.grip, self.mode = model, grip or NO_GRIP, 'peel' if grip else 'delay'
        rows, starts = tool_rows(tool), tool.seconds
        self.duration = float(starts[-1])
        self.ends_at_rest = stands(rows[-1])
        if self.ends_at_rest:
            still = np.concatenate([rows[-1, :7], np.zeros(6)])
            rows = np.vstack([rows[:-1], still, still])
            starts = np.append(starts, self.duration + LONGEST_WAIT)
        count = min(max(2, int(np.searchsorted(starts, until)) + 1), len(starts))
        self._longest = largest_step(model)
        durations = np.diff(starts[:count])
        counts = substeps_of(durations, self._longest)
        require_steps(float(counts.sum()), MOST_STEPS)
        self._steps = int(counts.sum())
        self._plan = as_inputs(rows[:count], durations, counts)
        self._follow(adapted(model, row_state(rows[0]), start or steady_start(model, tool)))

    def _follow(self, start: State) -> None:
        """Fill in states and loads."""
        self.start = start
        self.times, self.loads = np.empty((2, self._steps + 1))
        tools = np.empty((self._steps + 1, 13))
        states = np.empty((self._steps + 1, row_length(start)))
        self.states = states[:, :13]
        try:
            _hold(self.model, self.grip, start, *self._plan, self.times, tools, states,
                  self.loads)
        except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled give nan
            states[-1] = math.nan
        if not np.isfinite(states[-1]).all():
            raise diverged()
        self._inputs = as_inputs(self.times, tools, states)

    def again(self, start: State) -> Held:
        """Return the same from another initial state."""
        other = copy(self)
        other._follow(start)
        return other

    def let_go(self, release: Release, switched: float) -> tuple[float, State, float, State]:
        """Return what `toss_along` does, the valve being switched at a time (s)."""
        times, tools, states = self._inputs
        i = max(0, int(np.searchsorted(self.times, switched, 'right')) - 1)
        return toss_along(
            self.model, self.grip, release, times[i], row_state(tools[i]),
            body_row(states[i], self.start), tools[i + 1:], times[i + 1:], switched, times[-1],
            self._longest)

    def lost_before(self, switched: float) -> float | None:
        """Return the first time (s) before the valve at which the grip is lost already."""
        if self.mode == 'delay':
            return None
        early = np.flatnonzero((self.loads >= self.grip[0]) & (self.times < switched))
        return float(self.times[early[0]]) if len(early) else None


def toss(held: Held, release: Release, switched: float) -> Toss:
    """
    Return the toss when the valve is switched at a time of the plan.

    Parameters
    ----------
    held : Held
        The package along the plan.
    release : Release
        Valve, package and floor.
    switched : float
        s since the first point of the plan.

    Raises
    ------
    NoLandingError
        If the valve is not switched during the plan, the cup does not let go, or the package is
        below the floor then or does not come down.

    """
    if not 0.0 <= switched <= held.duration:
        raise NoLandingError(
            f'The valve is switched at {switched:g} s, outside the plan; expected 0 to '
            f'{held.duration:g} s. Release earlier, or make the plan longer.')
    released, body, landing, landed = held.let_go(release, switched)
    if released < 0.0:
        raise NoLandingError(
            f'The cup does not let go within {held.times[-1] - switched:.3g} s after the valve is '
            f'switched at {switched:g} s. ' + (
                'Check release.delay, release.tau and whether the package hangs from the cup.'
                if held.ends_at_rest else
                'The plan ends earlier, in motion. Make it longer, or release earlier.'))
    if landing == released:
        height = lowest(release.box, upward(held.model[2]), body)
        raise NoLandingError(
            f'The lowest corner of the package is at {height:.4g} m at its release at '
            f'{released:.4g} s, but landing.height is {release.height:g} m: the floor is above '
            'it. Check landing.height, package.size, package.size_center and the frame of the '
            'plan.')
    if landing < 0.0:
        raise NoLandingError(
            f'The package does not land within {LONGEST_FLIGHT:g} s. Check gravity, '
            'landing.height and release.impulse.')
    return Toss(released, body, landing, landed, held.mode)


def release_of(values: Mapping[str, Any]) -> Release:
    """
    Return release and landing as the parameter values describe them.

    Raises
    ------
    BellowsError
        If the size of the package is not known.

    """
    size = values['package.size']
    if not min(size) > 0.0:
        raise BellowsError(
            f'package.size is {list(size)}; expected three sides above 0 m, since the landing '
            'depends on the corners. Set it in the parameter file, or --set '
            'package.size=0.3,0.2,0.15.')
    x, y, z = (0.5 * float(side) for side in size)
    a, b, c = (float(value) for value in values['package.size_center'])
    return Release(
        (float(values['release.delay']), float(values['release.tau'])),
        float(values['release.impulse']), ((x, y, z), (a, b, c)), float(values['landing.height']))


def flight_path(model: ModelTuple, toss: Toss, count: int) -> Array:
    """Return states (N, 13), evenly spaced from letting go to landing."""
    _, package, gravity = model
    out = np.empty((count, 13))
    body, h = toss.release, (toss.landing_time - toss.release_time) / (count - 1)
    for k in range(count):
        write_row(out[k], body)
        body = flight(package, gravity, body, h, STRIDE)
    return out
