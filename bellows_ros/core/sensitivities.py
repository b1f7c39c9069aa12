"""
Analytic derivatives of the integrator: of the package's next state by small changes.

They are those of the discrete step itself (`kernels.step`), exact up to rounding, stage by
stage. Changes of states are as in `jacobians`: shift, turn, linear and angular twist in the axes
of the body itself, the columns of arrays (12, n). What is scalar here may be an array: compiled
code goes through the columns one by one, interpreted code takes all at once.
"""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import Any

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.core.jacobians import (
    apply_square,
    body_jacobians,
    parameter_jacobian,
    tool_jacobians,
)
from bellows_ros.core.jit import as_inputs, COMPILED, kernel
from bellows_ros.core.kernels import (
    cubic,
    cubic_slope,
    hermite_cubic,
    hermite_quadratic,
    ModelTuple,
    rotation_rate,
    Segment,
    stages,
    State,
    tool_at,
    tool_segment,
    weighted,
)
from bellows_ros.core.simulation import row_state, write_row
from bellows_ros.core.tuples import (
    add,
    add_scaled,
    apply,
    apply_transposed,
    body_rate,
    cross,
    dot,
    exp_quaternion,
    Matrix,
    quaternion_product,
    rotation_matrix,
    rotation_vector_rate,
    scale,
    SMALL_ANGLE_SQUARED,
    subtract,
    Vector,
)
import numpy as np

Change = tuple[Any, Any, Any, Any]
"""Shift (m), turn (rad), linear and angular twist (m/s, rad/s), each three numbers or arrays."""

ZERO = (0.0, 0.0, 0.0)
NO_PARAMETERS = slice(0, 0)

if COMPILED:
    @kernel
    def columns(n: int) -> Iterable[Any]:
        """Return the range over n columns."""
        return range(n)
else:
    def columns(n: int) -> Iterable[Any]:
        """Return the range over n columns."""
        return (slice(None),)


@kernel
def change_at(A: Any, c: Any) -> Change:
    """Return a column of an array (12, n)."""
    return (
        (A[0, c], A[1, c], A[2, c]), (A[3, c], A[4, c], A[5, c]),
        (A[6, c], A[7, c], A[8, c]), (A[9, c], A[10, c], A[11, c]),
    )


@kernel
def write_change(A: Any, c: Any, change: Change) -> None:
    """Write a column of an array (12, n)."""
    A[0, c], A[1, c], A[2, c] = change[0]
    A[3, c], A[4, c], A[5, c] = change[1]
    A[6, c], A[7, c], A[8, c] = change[2]
    A[9, c], A[10, c], A[11, c] = change[3]


@kernel
def rotation_rate_change(sigma: Vector, w: Vector, d_sigma: Any, d_w: Any) -> Any:
    """Return the change of `rotation_rate` with its arguments."""
    turned = add_scaled(scale(0.5, cross(d_sigma, w)), 1.0 / 12.0, cross(d_sigma, cross(sigma, w)))
    turned = add_scaled(turned, 1.0 / 12.0, cross(sigma, cross(d_sigma, w)))
    return add(turned, rotation_rate(sigma, d_w))


@kernel
def rate_changes(
    model: ModelTuple, tool: State, body: State, sigma: Vector, h: float,
    S: Any, rates: Any, pushes: Any, weight: float, total: Any,
) -> None:
    """
    Turn the changes of one stage's rates into those of the next, and add them up.

    Parameters
    ----------
    model, tool, body : tuples
        Tool and body at this stage.
    sigma : Vector
        Rotation vector from the start of the step to this stage.
    h : float
        Time from the start of the step to this stage, s.
    S : ndarray (12, n)
        Changes at the start of the step.
    rates : ndarray (12, n)
        In: of the stage before, of position (in axes of the start), rotation vector and twist.
        Out: of this stage.
    pushes : ndarray (6, n)
        Accelerations that come on top.
    weight : float
        With which the rates are added to the total.
    total : ndarray (12, n)
        What they are added to.

    """
    by_pose, by_twist = body_jacobians(model, tool, body)
    E = rotation_matrix(exp_quaternion(sigma))
    for c in columns(S.shape[1]):
        slope = change_at(rates, c)
        shift, turn, v, w = followed(S, c, E, sigma, h, slope)
        a, b = apply_square(by_pose, shift, turn)
        a_twist, b_twist = apply_square(by_twist, v, w)
        write_change(rates, c, (
            apply(E, add(cross(turn, body[2]), v)),
            rotation_rate_change(sigma, body[3], scale(h, slope[1]), w),
            add(add(a, a_twist), (pushes[0, c], pushes[1, c], pushes[2, c])),
            add(add(b, b_twist), (pushes[3, c], pushes[4, c], pushes[5, c])),
        ))
        for i in range(12):
            total[i, c] += weight * rates[i, c]


@kernel
def followed(S: Any, c: Any, E: Matrix, sigma: Vector, h: float, slope: Change) -> Change:
    """Return the change of a state, in its own axes, after it moved from where S applies."""
    start = change_at(S, c)
    return (
        apply_transposed(E, add_scaled(start[0], h, slope[0])),
        add(apply_transposed(E, start[1]), body_rate(sigma, scale(h, slope[1]))),
        add_scaled(start[2], h, slope[2]),
        add_scaled(start[3], h, slope[3]),
    )


@kernel
def step_changes(
    model: ModelTuple, body: State, tool: State, tool_middle: State, tool_end: State, h: float,
    S: Any, parameters: tuple[int, int], tool_changes: Any, work: Any,
) -> State:
    """
    Carry changes through one step, and return the package's state at its end.

    Parameters
    ----------
    model, body, tool, tool_middle, tool_end, h
        As `kernels.step` takes them.
    S : ndarray (12, n)
        Changes of the package, before and then after the step. The last columns are also driven
        by changes of the tool, those before them by changes of parameters.
    parameters : (int, int)
        Those from the first to before the second, of `jacobians.PARAMETERS`.
    tool_changes : ndarray (3, 12, m)
        Of the tool at start, middle and end.
    work : ndarray (3, 12, n)
        Room to work in.

    """
    rates, total, pushes = work[0], work[1], work[2]
    first, last = parameters
    of_tool = S.shape[1] - tool_changes.shape[2]
    rates[:], total[:], pushes[:] = 0.0, 0.0, 0.0
    half = 0.5 * h
    body2, body3, body4, end = stages(model, body, tool, tool_middle, tool_end, h)
    rate2 = rotation_rate(scale(half, body[3]), body2[3])
    rate3 = rotation_rate(scale(half, rate2), body3[3])
    rate4 = rotation_rate(scale(h, rate3), body4[3])
    tools, bodies = (tool, tool_middle, tool_middle, tool_end), (body, body2, body3, body4)
    sigmas = (ZERO, scale(half, body[3]), scale(half, rate2), scale(h, rate3))
    times, weights = (0.0, half, half, h), (1.0, 2.0, 2.0, 1.0)
    for i in range(4):
        if last > first:
            parameter_jacobian(
                model, tools[i], bodies[i], first, last, pushes, of_tool - (last - first))
        if tool_changes.shape[2]:
            _push(model, tools[i], bodies[i], tool_changes[(i + 1) // 2], pushes, of_tool)
        rate_changes(
            model, tools[i], bodies[i], sigmas[i], times[i], S, rates, pushes, weights[i], total)
    sigma = scale(h, weighted(body[3], rate2, rate3, rate4))
    E = rotation_matrix(exp_quaternion(sigma))
    for c in columns(S.shape[1]):
        write_change(S, c, followed(S, c, E, sigma, h / 6.0, change_at(total, c)))
    return end


@kernel
def _push(
    model: ModelTuple, tool: State, body: State, changes: Any, pushes: Any, column: int
) -> None:
    """Write the accelerations of the package due to changes of the tool (12, m)."""
    by_pose, by_twist = tool_jacobians(model, tool, body)
    driven = pushes[:, column:]
    for c in columns(changes.shape[1]):
        change = change_at(changes, c)
        a, b = apply_square(by_pose, change[0], change[1])
        a_twist, b_twist = apply_square(by_twist, change[2], change[3])
        driven[0, c], driven[1, c], driven[2, c] = add(a, a_twist)
        driven[3, c], driven[4, c], driven[5, c] = add(b, b_twist)


@kernel
def advance_changes(
    model: ModelTuple, body: State, start: State, end: State, duration: float, substeps: int,
    S: Any, parameters: tuple[int, int], at_start: Any, at_end: Any, tool_changes: Any, work: Any,
) -> State:
    """
    Carry changes through `kernels.advance`, and return the package's state after it.

    Parameters
    ----------
    model, body, start, end, duration, substeps
        As `kernels.advance` takes them.
    S, parameters, work
        As `step_changes` takes them.
    at_start, at_end : ndarray (12, m)
        Changes of the tool's two samples.
    tool_changes : ndarray (3, 12, m)
        Room for those between.

    """
    segment = tool_segment(start, end, duration)
    h = duration / substeps
    tool = start
    tool_changes[2] = at_start
    for i in range(substeps):
        middle = tool_at(segment, (i + 0.5) / substeps)
        tool_end = end if i == substeps - 1 else tool_at(segment, (i + 1.0) / substeps)
        tool_changes[0] = tool_changes[2]
        if at_start.shape[1]:
            for part in range(1, 3):
                _between(
                    segment, end, (i + 0.5 * part) / substeps, at_start, at_end,
                    tool_changes[part])
        body = step_changes(
            model, body, tool, middle, tool_end, h, S, parameters, tool_changes, work)
        tool = tool_end
    return body


@kernel
def _between(
    segment: Segment, end: State, s: float, at_start: Any, at_end: Any, out: Any
) -> None:
    """Write the changes (12, m) of `kernels.tool_at`, the tool's samples being changed."""
    duration, _, a1, a2, a3, q0, c1, c2, c3 = segment
    R0, R1 = rotation_matrix(q0), rotation_matrix(end[1])
    v0 = scale(1.0 / duration, apply_transposed(R0, a1))
    phi_end, phi, rate = add(c1, add(c2, c3)), cubic(s, c1, c2, c3), cubic_slope(s, c1, c2, c3)
    E = rotation_matrix(exp_quaternion(phi))
    R = rotation_matrix(quaternion_product(q0, exp_quaternion(phi)))
    v = scale(1.0 / duration, apply_transposed(R, cubic_slope(s, a1, a2, a3)))
    for c in columns(at_start.shape[1]):
        first, last = change_at(at_start, c), change_at(at_end, c)
        # positions and velocities in the world, then rotation vectors and their rates
        shift = apply(R0, first[0])
        step = subtract(apply(R1, last[0]), shift)
        slope = scale(duration, apply(R0, add(cross(first[1], v0), first[2])))
        slope_end = scale(duration, apply(R1, add(cross(last[1], end[2]), last[2])))
        quadratic = hermite_quadratic(step, slope, slope_end)
        third = hermite_cubic(step, slope, slope_end)
        shift = apply_transposed(R, add(shift, cubic(s, slope, quadratic, third)))
        velocity = scale(
            1.0 / duration, apply_transposed(R, cubic_slope(s, slope, quadratic, third)))
        d_phi = subtract(
            rotation_vector_rate(phi_end, last[1]),
            rotation_vector_rate(scale(-1.0, phi_end), first[1]))
        slope = scale(duration, first[3])
        slope_end = scale(duration, add(
            rotation_vector_rate(phi_end, last[3]),
            rotation_vector_rate_change(phi_end, end[3], d_phi)))
        quadratic = hermite_quadratic(d_phi, slope, slope_end)
        third = hermite_cubic(d_phi, slope, slope_end)
        d_phi = cubic(s, slope, quadratic, third)
        turn = add(apply_transposed(E, first[1]), body_rate(phi, d_phi))
        spin = add(
            body_rate(phi, cubic_slope(s, slope, quadratic, third)),
            body_rate_change(phi, rate, d_phi))
        write_change(
            out, c, (shift, turn, add(velocity, cross(v, turn)), scale(1.0 / duration, spin)))


@kernel
def body_rate_change(phi: Vector, phi_dot: Vector, d_phi: Any) -> Any:
    """Return the change of `tuples.body_rate` with its first argument."""
    x = dot(phi, phi)
    if x < SMALL_ANGLE_SQUARED:
        first = 1 / 2 - x * (1 / 24 - x * (1 / 720 - x * (
            1 / 40320 - x * (1 / 3628800 - x / 479001600))))
        d_first = -1 / 24 + x * (2 / 720 - x * (3 / 40320 - x * (
            4 / 3628800 - x * (5 / 479001600 - x * 6 / 87178291200))))
        second = 1 / 6 - x * (1 / 120 - x * (1 / 5040 - x * (
            1 / 362880 - x * (1 / 39916800 - x / 6227020800))))
        d_second = -1 / 120 + x * (2 / 5040 - x * (3 / 362880 - x * (
            4 / 39916800 - x * (5 / 6227020800 - x * 6 / 1307674368000))))
    else:
        angle = math.sqrt(x)
        sine, cosine = math.sin(angle), math.cos(angle)
        first, second = (1.0 - cosine) / x, (angle - sine) / (x * angle)
        d_first = (0.5 * angle * sine - (1.0 - cosine)) / (x * x)
        d_second = (0.5 * angle * (1.0 - cosine) - 1.5 * (angle - sine)) / (x * x * angle)
    return twice_turned(phi, phi_dot, d_phi, -first, -d_first, second, d_second)


@kernel
def rotation_vector_rate_change(phi: Vector, omega: Vector, d_phi: Any) -> Any:
    """Return the change of `tuples.rotation_vector_rate` with its first argument."""
    x = dot(phi, phi)
    if x < SMALL_ANGLE_SQUARED:
        factor = 1 / 12 + x * (1 / 720 + x * (1 / 30240 + x * (1 / 1209600 + x * (
            1 / 47900160 + x * (691 / 1307674368000 + x / 74724249600)))))
        d_factor = 1 / 720 + x * (2 / 30240 + x * (3 / 1209600 + x * (
            4 / 47900160 + x * (5 * 691 / 1307674368000 + x * (6 / 74724249600)))))
    else:
        angle = math.sqrt(x)
        cotangent = 1.0 / math.tan(0.5 * angle)
        factor = (1.0 - 0.5 * angle * cotangent) / x
        d_factor = (0.25 * (angle * cotangent + 0.5 * x * (1.0 + cotangent**2)) - 1.0) / (x * x)
    return twice_turned(phi, omega, d_phi, 0.5, 0.0, factor, d_factor)


@kernel
def twice_turned(
    phi: Vector, a: Vector, d_phi: Any,
    once: float, d_once: float, twice: float, d_twice: float,
) -> Any:
    """
    Return the change of once phi x a + twice phi x (phi x a) with phi.

    The factors are functions of |phi|^2, d_once and d_twice their derivatives by it.
    """
    phi_a, d_a = cross(phi, a), cross(d_phi, a)
    along = 2.0 * (phi[0] * d_phi[0] + phi[1] * d_phi[1] + phi[2] * d_phi[2])
    change = scale(once, d_a)
    change = add(change, scale(twice, add(cross(d_phi, phi_a), cross(phi, d_a))))
    fixed = add(scale(d_once, phi_a), scale(d_twice, cross(phi, phi_a)))
    return (
        change[0] + along * fixed[0], change[1] + along * fixed[1], change[2] + along * fixed[2])


def sensitivities(
    model: ModelTuple, start: State, tool: Array, durations: Array, substeps: Stamps,
    parameters: slice = NO_PARAMETERS, changes: Array | None = None,
) -> tuple[Array, Array]:
    """
    Return the states of a motion, and their derivatives.

    Parameters
    ----------
    model : ModelTuple
        Cup, package and gravity.
    start : State
        Of the package at the first sample.
    tool : ndarray (N, 13)
        The tool's rows: position, quaternion xyzw, body twist.
    durations, substeps : ndarray (N - 1,)
        Times (s) between samples, and integration steps in each.
    parameters : slice
        Those by which is derived, of `jacobians.PARAMETERS`; none when left out.
    changes : ndarray (N, 12, m), optional
        Changes of the tool's samples, as of errors that follow it.

    Returns
    -------
    states : ndarray (N, 13)
        Rows as of the tool.
    derivatives : ndarray (N, 12, 12 + p + m)
        By the first state, by the parameters, and along the changes of the tool.

    """
    first, last = parameters.start, parameters.stop
    if changes is None:
        changes = np.zeros((len(tool), 12, 0))
    m = changes.shape[2]
    n = 12 + last - first + m
    states, out = np.empty((len(tool), 13)), np.zeros((len(tool), 12, n))
    out[0, :, :12] = np.eye(12)
    _sensitivities(model, start, *as_inputs(tool, durations, substeps), (first, last), changes,
                   states, out, np.zeros((3, 12, m)), np.zeros((3, 12, n)))
    return states, out


@kernel
def _sensitivities(
    model: ModelTuple, start: State, tool: Any, durations: Any, substeps: Any,
    parameters: tuple[int, int], changes: Any, states: Any, out: Any, tool_changes: Any, work: Any,
) -> None:
    """Carry state and changes from row to row."""
    body = start
    write_row(states[0], body)
    before = row_state(tool[0])
    for k in range(len(durations)):
        after = row_state(tool[k + 1])
        out[k + 1] = out[k]
        body = advance_changes(
            model, body, before, after, durations[k], substeps[k], out[k + 1], parameters,
            changes[k], changes[k + 1], tool_changes, work)
        write_row(states[k + 1], body)
        before = after
