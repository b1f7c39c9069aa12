"""Free flight: the parabola with a tumbling package, and its landing."""

import math
from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import PackageTuple, State

MAX_FLIGHT_STEP = 0.02
"""Longest integration step of the flight, s."""
COARSE_ROTATION_PER_STEP = 0.1
"""Rotation per step of a flight accurate to 0.01 mrad, as for a landing, rad."""

LANDING_SECANTS = 4
"""Secants to the instant of the landing in a step: each leaves 3 % of the error, 1 ns in all."""

MAX_FLIGHT_TIME = 10.0
"""Longest time from the release to the landing, s."""


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
def lowest(half: Vector, up: Vector, body: State) -> float:
    """Return the height (m) of the lowest corner of a box with half the sides (m) about B."""
    u = t3.apply_transposed(t3.rotation_matrix(body[1]), up)
    return t3.dot(up, body[0]) - (
        abs(u[0]) * half[0] + abs(u[1]) * half[1] + abs(u[2]) * half[2])


@kernel
def land(
    package: PackageTuple, gravity: Vector, half: Vector, height: float, body: State
) -> tuple[float, State]:
    """Return the time (s) until the first corner is at a height, and the state; -1 if never."""
    t, up = 0.0, upward(gravity)
    above = lowest(half, up, body) - height
    while t < MAX_FLIGHT_TIME:
        h = flight_step(body, COARSE_ROTATION_PER_STEP)
        after = free_flight_step(package, gravity, body, h)
        clearance = lowest(half, up, after) - height
        if clearance <= 0.0:
            s = h
            for _ in range(LANDING_SECANTS):
                s *= above / (above - clearance)
                after = free_flight_step(package, gravity, body, s)
                clearance = lowest(half, up, after) - height
            return t + s, after
        t, body, above = t + h, after, clearance
    return -1.0, body
