"""Free flight: the impulse of a blow-off, the parabola with a tumbling package, the landing."""

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.model import kernels
from bellows_ros.core.model.grip import Box
from bellows_ros.core.model.kernels import PackageTuple, State

ROTATION_PER_STEP = 0.01
"""Rotation per integration step of the flight, rad."""

MAX_FLIGHT_STEP = 0.02
"""Longest integration step of the flight, s."""
COARSE_ROTATION_PER_STEP = 0.1
"""Rotation per step of a flight accurate to 0.01 mrad, as for a landing, rad."""

INSTANT_TOLERANCE = 1e-10
"""Accuracy of the instants of release and landing, s."""

MAX_FLIGHT_TIME = 10.0
"""Longest time from the release to the landing, s."""


Bracket = tuple[float, float, float, float, float]
"""Bracket of a root: two ends, their values (positive at the first end), and the last replaced
end: 1 for the first, -1 for the second, 0 without a root."""


@kernel
def secant_root(bracket: Bracket, margin: float) -> float:
    """Return the zero of the secant between two ends, moved inside by a margin."""
    low, high, above, below, _ = bracket
    s = low + (high - low) * above / (above - below)
    return min(max(s, low + margin), high - margin)


@kernel
def narrowed(bracket: Bracket, s: float, value: float) -> Bracket:
    """Return a bracket with an end replaced by an inner value at s (Illinois method)."""
    low, high, above, below, side = bracket
    if value <= 0.0:
        return low, s, above * 0.5 if side < 0.0 else above, value, -1.0
    return s, high, value, below * 0.5 if side > 0.0 else below, 1.0


@kernel
def pushed_off(package: PackageTuple, body: State, impulse: float) -> State:
    """Return a state after an impulse (N s) along -z of S, at S."""
    f, m = kernels.wrench_at_com(package[1], (0.0, 0.0, -impulse), (0.0, 0.0, 0.0))
    return (
        body[0], body[1], t3.add_scaled(body[2], 1.0 / package[0], f),
        t3.add(body[3], t3.apply(package[3], m)), *body[4:])


@kernel
def free_flight_step(package: PackageTuple, gravity: Vector, body: State, h: float) -> State:
    """
    Return the state h later in free flight: a parabola, and a step of RKMK4 for the rotation.

    The angular momentum L in the world is constant, and w = I^-1 R^T L.
    """
    inertia, inverse = package[2], package[3]
    q = body[1]
    R = t3.rotation_matrix(q)
    L = t3.apply(R, t3.apply(inertia, body[3]))
    k1 = body[3]
    s2 = t3.scale(0.5 * h, k1)
    k2 = kernels.rotation_rate(s2, _body_rate_after(inverse, q, s2, L))
    s3 = t3.scale(0.5 * h, k2)
    k3 = kernels.rotation_rate(s3, _body_rate_after(inverse, q, s3, L))
    s4 = t3.scale(h, k3)
    k4 = kernels.rotation_rate(s4, _body_rate_after(inverse, q, s4, L))
    q_later = t3.normalised(
        t3.quaternion_product(q, t3.exp_quaternion(t3.scale(h, kernels.weighted(k1, k2, k3, k4)))))
    R_later = t3.rotation_matrix(q_later)
    velocity = t3.apply(R, body[2])
    return (
        t3.add_scaled(t3.add_scaled(body[0], h, velocity), 0.5 * h * h, gravity),
        q_later,
        t3.apply_transposed(R_later, t3.add_scaled(velocity, h, gravity)),
        t3.apply(inverse, t3.apply_transposed(R_later, L)),
        *body[4:])


@kernel
def _body_rate_after(inverse: Any, q: Quaternion, sigma: Vector, L: Vector) -> Vector:
    """Return the body rate after a rotation sigma with angular momentum L in the world."""
    R = t3.rotation_matrix(t3.quaternion_product(q, t3.exp_quaternion(sigma)))
    return t3.apply(inverse, t3.apply_transposed(R, L))


@kernel
def flight_step(body: State, rotation_per_step: float) -> float:
    """Return the longest step (s) of the flight."""
    rate = math.sqrt(t3.dot(body[3], body[3]))
    # no package rotates faster
    return max(1e-5, min(MAX_FLIGHT_STEP, rotation_per_step / max(rate, 1e-9)))


@entry
def flight(
    package: PackageTuple, gravity: Vector, body: State, duration: float, rotation_per_step: float
) -> State:
    """Return the state a time (s) later in free flight."""
    remaining = duration
    while remaining > 0.0:
        h = min(flight_step(body, rotation_per_step), remaining)
        body = free_flight_step(package, gravity, body, h)
        remaining -= h
    return body


@kernel
def upward(gravity: Vector) -> Vector:
    """Return the direction against gravity; zero without gravity."""
    return t3.scale(-1.0 / max(math.sqrt(t3.dot(gravity, gravity)), 1e-9), gravity)


@entry
def lowest(box: Box, up: Vector, body: State) -> float:
    """Return the height (m) of the lowest corner of the box."""
    half, centre = box
    u = t3.apply_transposed(t3.rotation_matrix(body[1]), up)
    below = abs(u[0]) * half[0] + abs(u[1]) * half[1] + abs(u[2]) * half[2]
    return t3.dot(up, body[0]) + t3.dot(u, centre) - below


@kernel
def land(
    package: PackageTuple, gravity: Vector, box: Box, height: float, body: State
) -> tuple[float, State]:
    """Return the time (s) until the first corner is at a height, and the state; -1 if never."""
    t, up = 0.0, upward(gravity)
    above = lowest(box, up, body) - height
    while t < MAX_FLIGHT_TIME:
        h = flight_step(body, COARSE_ROTATION_PER_STEP)
        after = free_flight_step(package, gravity, body, h)
        clearance = lowest(box, up, after) - height
        if clearance <= 0.0:
            bracket, landed = (0.0, h, above, clearance, -1.0), after
            while bracket[1] - bracket[0] > INSTANT_TOLERANCE:
                s = secant_root(bracket, 0.5 * INSTANT_TOLERANCE)
                after = free_flight_step(package, gravity, body, s)
                clearance = lowest(box, up, after) - height
                bracket = narrowed(bracket, s, clearance)
                landed = after if clearance <= 0.0 else landed
            return t + bracket[1], landed
        t, body, above = t + h, after, clearance
    return -1.0, body
