"""
One step of the cup-package model on SE(3): Runge-Kutta-Munthe-Kaas of order 4.

The tool moves between its samples along the cubic Hermite curve through both poses and twists.
"""

from __future__ import annotations

from bellows_ros.core.jit import kernel
from bellows_ros.core.kernels import body_acceleration, ModelTuple, State
from bellows_ros.core.tuples import (
    add,
    add_scaled,
    apply,
    apply_transposed,
    body_rate,
    cross,
    exp_quaternion,
    log_quaternion,
    Quaternion,
    quaternion_conjugate,
    quaternion_product,
    rotation_matrix,
    rotation_vector_rate,
    scale,
    subtract,
    Vector,
)

Segment = tuple[float, Vector, Vector, Vector, Vector, Quaternion, Vector, Vector, Vector]
"""Duration (s), position cubic (four coefficients), start orientation, rotation cubic (three)."""


@kernel
def tool_segment(start: State, end: State, duration: float) -> Segment:
    """
    Return the cubic Hermite curve between two tool samples a time apart.

    In s = t / duration from 0 to 1: o(s) = o0 + a1 s + a2 s^2 + a3 s^3 and
    R(s) = R0 exp(c1 s + c2 s^2 + c3 s^3), with both poses and both twists met.
    """
    a1 = scale(duration, apply(rotation_matrix(start[1]), start[2]))
    a1_end = scale(duration, apply(rotation_matrix(end[1]), end[2]))
    step = subtract(end[0], start[0])
    phi = log_quaternion(quaternion_product(quaternion_conjugate(start[1]), end[1]))
    c1 = scale(duration, start[3])
    c1_end = scale(duration, rotation_vector_rate(phi, end[3]))
    return (
        duration,
        start[0], a1, hermite_quadratic(step, a1, a1_end), hermite_cubic(step, a1, a1_end),
        start[1], c1, hermite_quadratic(phi, c1, c1_end), hermite_cubic(phi, c1, c1_end),
    )


@kernel
def hermite_quadratic(step: Vector, slope: Vector, slope_end: Vector) -> Vector:
    """Return the s^2 coefficient 3 step - 2 slope - slope_end of a cubic Hermite curve."""
    return add_scaled(add_scaled(scale(3.0, step), -2.0, slope), -1.0, slope_end)


@kernel
def hermite_cubic(step: Vector, slope: Vector, slope_end: Vector) -> Vector:
    """Return the s^3 coefficient slope + slope_end - 2 step of a cubic Hermite curve."""
    return add_scaled(add(slope, slope_end), -2.0, step)


@kernel
def cubic(s: float, c1: Vector, c2: Vector, c3: Vector) -> Vector:
    """Return c1 s + c2 s^2 + c3 s^3."""
    return scale(s, add_scaled(c1, s, add_scaled(c2, s, c3)))


@kernel
def cubic_slope(s: float, c1: Vector, c2: Vector, c3: Vector) -> Vector:
    """Return c1 + 2 c2 s + 3 c3 s^2."""
    return add_scaled(c1, 2.0 * s, add_scaled(c2, 1.5 * s, c3))


@kernel
def tool_at(segment: Segment, s: float) -> State:
    """Return the tool's pose and body twist at the fraction s of the segment."""
    duration, o0, a1, a2, a3, q0, c1, c2, c3 = segment
    phi = cubic(s, c1, c2, c3)
    q = quaternion_product(q0, exp_quaternion(phi))
    velocity = scale(1.0 / duration, cubic_slope(s, a1, a2, a3))
    return (
        add(o0, cubic(s, a1, a2, a3)),
        q,
        apply_transposed(rotation_matrix(q), velocity),
        scale(1.0 / duration, body_rate(phi, cubic_slope(s, c1, c2, c3))),
    )


@kernel
def stage_state(body: State, h: float, do: Vector, sigma: Vector, dv: Vector, dw: Vector) -> State:
    """Return the state moved by h along the rates of position, rotation vector and twist."""
    return (
        add_scaled(body[0], h, do),
        quaternion_product(body[1], exp_quaternion(scale(h, sigma))),
        add_scaled(body[2], h, dv),
        add_scaled(body[3], h, dw),
    )


@kernel
def rotation_rate(sigma: Vector, w: Vector) -> Vector:
    """
    Return the rate of sigma in R0 exp(sigma) for the body rate w, to the order RKMK4 needs.

    w + 1/2 sigma x w + 1/12 sigma x (sigma x w), the inverse of dexp(-sigma) cut off.
    """
    once = cross(sigma, w)
    return add_scaled(add_scaled(w, 0.5, once), 1.0 / 12.0, cross(sigma, once))


@kernel
def weighted(a: Vector, b: Vector, c: Vector, d: Vector) -> Vector:
    """Return (a + 2 b + 2 c + d) / 6, the Runge-Kutta mean of four stages."""
    return scale(1.0 / 6.0, add(add(a, d), scale(2.0, add(b, c))))


@kernel
def renormalised(q: Quaternion) -> Quaternion:
    """Return q scaled to unit length, to first order: rounding never adds up."""
    k = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (k * q[0], k * q[1], k * q[2], k * q[3])


@kernel
def stages(
    model: ModelTuple, body: State, tool: State, tool_middle: State, tool_end: State, h: float
) -> tuple[State, State, State, State]:
    """Return the package's states at the second to fourth stage of a step, and at its end."""
    half = 0.5 * h
    do1 = apply(rotation_matrix(body[1]), body[2])
    ds1 = body[3]
    dv1, dw1 = body_acceleration(model, tool, body)

    body2 = stage_state(body, half, do1, ds1, dv1, dw1)
    do2 = apply(rotation_matrix(body2[1]), body2[2])
    ds2 = rotation_rate(scale(half, ds1), body2[3])
    dv2, dw2 = body_acceleration(model, tool_middle, body2)

    body3 = stage_state(body, half, do2, ds2, dv2, dw2)
    do3 = apply(rotation_matrix(body3[1]), body3[2])
    ds3 = rotation_rate(scale(half, ds2), body3[3])
    dv3, dw3 = body_acceleration(model, tool_middle, body3)

    body4 = stage_state(body, h, do3, ds3, dv3, dw3)
    do4 = apply(rotation_matrix(body4[1]), body4[2])
    ds4 = rotation_rate(scale(h, ds3), body4[3])
    dv4, dw4 = body_acceleration(model, tool_end, body4)

    end = stage_state(
        body,
        h,
        weighted(do1, do2, do3, do4),
        weighted(ds1, ds2, ds3, ds4),
        weighted(dv1, dv2, dv3, dv4),
        weighted(dw1, dw2, dw3, dw4),
    )
    return body2, body3, body4, (end[0], renormalised(end[1]), end[2], end[3])


@kernel
def step(
    model: ModelTuple, body: State, tool: State, tool_middle: State, tool_end: State, h: float
) -> State:
    """Return the package's state h later, the tool given at start, middle and end (RKMK4)."""
    return stages(model, body, tool, tool_middle, tool_end, h)[3]


@kernel
def advance(
    model: ModelTuple, body: State, start: State, end: State, duration: float, substeps: int
) -> State:
    """Return the package's state after the tool moved from one sample to the next."""
    segment = tool_segment(start, end, duration)
    h = duration / substeps
    tool = start
    for i in range(substeps):
        middle = tool_at(segment, (i + 0.5) / substeps)
        tool_end = end if i == substeps - 1 else tool_at(segment, (i + 1.0) / substeps)
        body = step(model, body, tool, middle, tool_end, h)
        tool = tool_end
    return body
