"""
The cup-package model as scalar kernels, among them the spring wrench.

Frames: ``A`` world, ``E`` tip of the tool arm, ``S`` centre of the lip on the package, ``B``
centre of mass, with ``[S] = [B]``. Six-vectors are two 3-tuples, linear first, then angular.
Twists are body twists: ``R^T do/dt`` and the body rate. SI units throughout.

A cup is the tuple ``(l1, l0, K, P)`` and a 6x6 symmetric matrix its blocks ``(oo, oR, RR)``; a
package is ``(mass, com, inertia, inertia_inverse)``; a model is ``(cup, package, gravity)`` with
gravity the acceleration vector in ``A``. `cup_package.Cup` and `Package` make these tuples.

The fourth entry of K has the coefficients of the stretch. For a cup that relaxes, P is followed by
two branches, and the package's state by two internal strains. These tuples are longer, so each
kernel is compiled separately for cups that relax.
"""

from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import as_inputs, inlined_kernel
from bellows_ros.core.geometry.tuples import Matrix, Quaternion, Vector, ZERO
import numpy as np

Stretch = tuple[float, ...]
"""Coefficients a (N/m^2) and b (N) of the energy a h_z^3 + b h_z (h_rx^2 + h_ry^2)."""
Blocks = tuple[Matrix, Matrix, Matrix, *tuple[Stretch, ...]]
"""K or P in blocks; K is followed by the coefficients of the stretch."""
Branch = tuple[float, float]
"""Stiffness r_b as a fraction of K, and time tau_b (s) in which the branch relaxes."""
LawTuple = tuple[tuple[Stretch, ...], tuple[Branch, ...]]
"""Stretch of a cup, and its branches, empty if the cup does not relax."""
CupTuple = tuple[float, float, Blocks, Blocks, *tuple[Branch, ...]]
PackageTuple = tuple[float, Vector, Matrix, Matrix]
ModelTuple = tuple[CupTuple, PackageTuple, Vector]
Wrench = tuple[Vector, Vector]
"""Force (N) and moment (N m)."""
Strain = tuple[Vector, Vector]
"""h (3.18), m and rad, or the internal strain z_b of a branch."""
Strains = tuple[Strain, ...]
"""Internal strains of the two branches; empty for a cup that does not relax."""
State = tuple[Vector, Quaternion, Vector, Vector, *Strains]
"""Position (m), orientation, linear and angular body twist (m/s, rad/s) of a frame in A."""

ENERGY_FACTOR = 0.25
"""Factor of the energy's gradient K h / 4 by the strain h (3.17)."""

ORIGIN: tuple[Vector, Quaternion, Vector, Vector] = (ZERO, (0.0, 0.0, 0.0, 1.0), ZERO, ZERO)
"""State of a frame at rest in the origin of A."""


@inlined_kernel
def matrix_of(numbers: Any) -> Matrix:
    """Return nine numbers, row by row, as a 3x3 matrix."""
    return (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6],
            numbers[7], numbers[8])


@inlined_kernel
def blocks_of(numbers: Any) -> Blocks:
    """Return 27 numbers as the blocks of K or P."""
    # Slices, as numba compiles a kernel anew for each constant index that it receives.
    return matrix_of(numbers[:9]), matrix_of(numbers[9:18]), matrix_of(numbers[18:])


@inlined_kernel
def strains_of(numbers: Any) -> Strains:
    """Return twelve numbers as two internal strains."""
    return (
        ((numbers[0], numbers[1], numbers[2]), (numbers[3], numbers[4], numbers[5])),
        ((numbers[6], numbers[7], numbers[8]), (numbers[9], numbers[10], numbers[11])))


def model_row(model: ModelTuple) -> Any:
    """Return all numbers (81,) of a model but stretch and relaxation, for calls from Python."""
    cup, (mass, com, *inertia), gravity = model
    blocks = [number for matrix in cup[2:4] for block in matrix[:3] for number in block]
    row, = as_inputs(np.array([*cup[:2], *blocks, mass, *com, *inertia[0], *inertia[1], *gravity]))
    return row


def law_of(model: ModelTuple) -> LawTuple:
    """Return stretch and branches of the cup, which `model_row` leaves out."""
    return model[0][2][3:], model[0][4:]


@inlined_kernel
def model_of(row: Any, law: LawTuple) -> ModelTuple:
    """Return the model of the numbers of `model_row`, with stretch and branches of `law_of`."""
    K = blocks_of(row[2:29])
    return (
        (row[0], row[1], (K[0], K[1], K[2], *law[0]), blocks_of(row[29:56]), *law[1]),
        (row[56], (row[57], row[58], row[59]), matrix_of(row[60:69]), matrix_of(row[69:78])),
        (row[78], row[79], row[80]))


@inlined_kernel
def multiply_blocks(M: Blocks, a: Vector, b: Vector) -> tuple[Vector, Vector]:
    """Return the product M [a; b] of a symmetric 6x6 matrix in blocks and a six-vector."""
    return (t3.add(t3.apply(M[0], a), t3.apply(M[1], b)),
            t3.add(t3.apply_transposed(M[1], a), t3.apply(M[2], b)))


@inlined_kernel
def strain(o: Vector, R: Matrix) -> tuple[Vector, Vector]:
    """Return h = [(I + R^T) o; (R - R^T)^vee] (3.18) of H = S2_H_S1 = (R, o)."""
    return t3.add(o, t3.apply_transposed(R, o)), (R[7] - R[5], R[2] - R[6], R[3] - R[1])


@inlined_kernel
def add_scaled_strain(a: Strain, factor: float, b: Strain) -> Strain:
    """Return a + factor * b."""
    return t3.add_scaled(a[0], factor, b[0]), t3.add_scaled(a[1], factor, b[1])


@inlined_kernel
def effective_strain(h: Strain, branches: tuple[Branch, ...], strains: Strains) -> Strain:
    """Return h + sum_b r_b (h - z_b), the strain that K multiplies."""
    if len(strains) == 0:
        return h
    r, s = branches[0][0], branches[1][0]
    total = t3.scale(1.0 + r + s, h[0]), t3.scale(1.0 + r + s, h[1])
    return add_scaled_strain(add_scaled_strain(total, -r, strains[0]), -s, strains[1])


@inlined_kernel
def spring_wrench(
    o: Vector, R: Matrix, K: Blocks, branches: tuple[Branch, ...] = (), strains: Strains = ()
) -> Wrench:
    """
    Return the spring wrench on the package at S1, f1 = -1/4 J^T s (3.23, 3.27).

    The wrench is minus the gradient of the energy 1/8 h^T K h (3.17), with s = K h. `stretched`
    adds the terms of stretch; for a cup that relaxes, `effective_strain` replaces h.
    """
    h = strain(o, R)
    e = effective_strain(h, branches, strains)
    return stress_wrench(o, R, stretched(K, h, multiply_blocks(K, e[0], e[1])))


@inlined_kernel
def stretched(K: Blocks, h: Strain, s: Strain) -> Strain:
    """Return the stress s plus 4 times the gradient of a h_z^3 + b h_z (h_rx^2 + h_ry^2)."""
    if len(K) == 3:
        return s
    (a, b), z, x, y = K[3:][0], h[0][2], h[1][0], h[1][1]
    bending = 8.0 * b * z
    return (
        (s[0][0], s[0][1], s[0][2] + 12.0 * a * z * z + 4.0 * b * (x * x + y * y)),
        (s[1][0] + bending * x, s[1][1] + bending * y, s[1][2]))


@inlined_kernel
def stress_wrench(o: Vector, R: Matrix, s: Strain) -> Wrench:
    """
    Return -1/4 J^T s for the pose (R, o) of S1 in S2.

    J = [[R + I, (R^T o)^], [0, tr(R) I - R^T]] is the derivative of the strain (3.23).
    """
    s_o, s_R = s
    trace = R[0] + R[4] + R[8]
    force = t3.add(s_o, t3.apply_transposed(R, s_o))
    turned = t3.subtract(t3.scale(trace, s_R), t3.apply(R, s_R))
    moment = t3.add(turned, t3.cross(s_o, t3.apply_transposed(R, o)))
    return t3.scale(-ENERGY_FACTOR, force), t3.scale(-ENERGY_FACTOR, moment)


@inlined_kernel
def damper_wrench(o: Vector, R: Matrix, v: Vector, w: Vector, P: Blocks) -> Wrench:
    """
    Return the damper wrench on the package at S1, f1 = -1/2 (P + X^T P X) v1 (3.32, 3.33).

    X = X(S2_H_S1) (2.24); (v, w) is v1 = S1_v_{S2,S1}, the twist of S1 relative to S2.
    """
    f_S1, m_S1 = multiply_blocks(P, v, w)  # P v1, the port at S1
    R_w = t3.apply(R, w)
    f_S2, m_S2 = multiply_blocks(P, t3.add(t3.apply(R, v), t3.cross(o, R_w)), R_w)  # P X v1, at S2
    force = t3.add(f_S1, t3.apply_transposed(R, f_S2))
    moment = t3.add(m_S1, t3.apply_transposed(R, t3.subtract(m_S2, t3.cross(o, f_S2))))
    return t3.scale(-0.5, force), t3.scale(-0.5, moment)


@inlined_kernel
def spring_frames(cup: CupTuple, o_E_S: Vector, R_E_S: Matrix) -> Vector:
    """Return the origin of S1 in S2, o = l2 z + l1 R z + E_o_S (3.13); its rotation is R_E_S."""
    o = t3.add_scaled(o_E_S, cup[0], (R_E_S[2], R_E_S[5], R_E_S[8]))
    return o[0], o[1], o[2] + (cup[1] - cup[0])


@inlined_kernel
def cup_wrench(
    cup: CupTuple, o_E_S: Vector, R_E_S: Matrix, v_ES: Vector, w_ES: Vector, strains: Strains = ()
) -> Wrench:
    """
    Return the wrench of the cup on the package at the lip, in S axes (3.7).

    (v_ES, w_ES) is S_v_ES, the body twist of the lip relative to the tool.
    """
    l1 = cup[0]
    o = spring_frames(cup, o_E_S, R_E_S)
    v_S1 = (v_ES[0] + l1 * w_ES[1], v_ES[1] - l1 * w_ES[0], v_ES[2])  # X(S_H_S1)^-1 (3.34)
    spring_f, spring_m = spring_wrench(o, R_E_S, cup[2], cup[4:], strains)
    damper_f, damper_m = damper_wrench(o, R_E_S, v_S1, w_ES, cup[3])
    f, m = t3.add(spring_f, damper_f), t3.add(spring_m, damper_m)
    return f, (m[0] - l1 * f[1], m[1] + l1 * f[0], m[2])  # X(S_H_S1)^-T (3.25)


@inlined_kernel
def wrench_at_com(com: Vector, f: Vector, m: Vector) -> Wrench:
    """Return the wrench moved from S to B: X(S_H_B)^T f_S (2.28) with S_H_B = (I, com)."""
    return f, t3.subtract(m, t3.cross(com, f))


@inlined_kernel
def lip_relative_to_tool(
    com: Vector, tool: State, body: State
) -> tuple[Vector, Matrix, Vector, Vector]:
    """
    Return E_o_S, E_R_S and the body twist S_v_ES of the lip relative to the tool.

    S_v_ES = X(S_H_B) B_v_AB - X(E_H_S)^-1 E_v_AE.
    """
    R_A_E, R_A_B = t3.rotation_matrix(tool[1]), t3.rotation_matrix(body[1])
    R_E_S = t3.multiply_transposed(R_A_E, R_A_B)
    o_A_S = t3.subtract(body[0], t3.apply(R_A_B, com))
    o_E_S = t3.apply_transposed(R_A_E, t3.subtract(o_A_S, tool[0]))
    v_S = t3.add(body[2], t3.cross(com, body[3]))
    v_tool = t3.apply_transposed(R_E_S, t3.add(tool[2], t3.cross(tool[3], o_E_S)))
    w_tool = t3.apply_transposed(R_E_S, tool[3])
    return o_E_S, R_E_S, t3.subtract(v_S, v_tool), t3.subtract(body[3], w_tool)


@inlined_kernel
def newton_euler(
    package: PackageTuple, gravity: Vector, R_A_B: Matrix, v: Vector, w: Vector, f: Vector,
    tau: Vector,
) -> tuple[Vector, Vector]:
    """
    Return the rate of the body twist under the wrench (f, tau) at B and gravity (3.5, 3.42).

    m dv/dt = f - m w x v + m R^T g, I dw/dt = tau - w x I w.
    """
    mass, _, inertia, inertia_inverse = package
    weight = t3.apply_transposed(R_A_B, gravity)
    dv = t3.add_scaled(t3.subtract(weight, t3.cross(w, v)), 1.0 / mass, f)
    dw = t3.apply(inertia_inverse, t3.subtract(tau, t3.cross(w, t3.apply(inertia, w))))
    return dv, dw


@inlined_kernel
def lip_wrench(model: ModelTuple, tool: State, body: State) -> Wrench:
    """Return the wrench of the cup on the package at the lip, in S axes, for a state."""
    cup, package, _ = model
    o_E_S, R_E_S, v_ES, w_ES = lip_relative_to_tool(package[1], tool, body)
    return cup_wrench(cup, o_E_S, R_E_S, v_ES, w_ES, body[4:])


@inlined_kernel
def lip_strain(model: ModelTuple, tool: State, body: State) -> Strain:
    """Return the strain h of the cup (3.18) for a state."""
    cup, package, _ = model
    o_E_S, R_E_S, _, _ = lip_relative_to_tool(package[1], tool, body)
    return strain(spring_frames(cup, o_E_S, R_E_S), R_E_S)


@inlined_kernel
def strain_rate(h: Strain, z: Strain, tau: float) -> Strain:
    """Return dz/dt = (h - z) / tau."""
    rate = 1.0 / tau
    return t3.scale(rate, t3.subtract(h[0], z[0])), t3.scale(rate, t3.subtract(h[1], z[1]))


@inlined_kernel
def strain_rates(model: ModelTuple, tool: State, body: State) -> Strains:
    """Return the rates of the internal strains; empty for a cup that does not relax."""
    strains, branches = body[4:], model[0][4:]
    if len(body) == 4:
        return ()
    h = lip_strain(model, tool, body)
    return strain_rate(h, strains[0], branches[0][1]), strain_rate(h, strains[1], branches[1][1])


@inlined_kernel
def with_twist(state: State, v: Vector, w: Vector) -> State:
    """Return a state with its twist replaced."""
    return (state[0], state[1], v, w, *state[4:])


@inlined_kernel
def with_rotation(state: State, q: Quaternion) -> State:
    """Return a state with its orientation replaced."""
    return (state[0], q, *state[2:])


@inlined_kernel
def with_strains(state: State, strains: Strains) -> State:
    """Return a state with its internal strains replaced."""
    return (state[0], state[1], state[2], state[3], *strains)


@inlined_kernel
def relaxed(cup: CupTuple, h: Strain, body: State) -> State:
    """Return a state with both internal strains at h, their value after a long rest."""
    if len(cup) == 4:
        return body
    return with_strains(body, (h, h))


@inlined_kernel
def body_acceleration(model: ModelTuple, tool: State, body: State) -> tuple[Vector, Vector]:
    """Return the rate of the package's body twist, m/s^2 and rad/s^2 (3.42)."""
    _, package, gravity = model
    f, m = lip_wrench(model, tool, body)
    f, m = wrench_at_com(package[1], f, m)
    return newton_euler(package, gravity, t3.rotation_matrix(body[1]), body[2], body[3], f, m)


ToolSegment = tuple[float, Vector, Vector, Vector, Vector, Quaternion, Vector, Vector, Vector]
"""Duration (s), position cubic (four coefficients), start orientation, rotation cubic (three)."""


@inlined_kernel
def tool_segment(start: State, end: State, duration: float) -> ToolSegment:
    """
    Return the cubic Hermite curve between two tool samples.

    In s = t / duration from 0 to 1: o(s) = o0 + a1 s + a2 s^2 + a3 s^3 and R(s) = R0 exp(c1 s + c2
    s^2 + c3 s^3); poses and twists of both samples are met.
    """
    a1 = t3.scale(duration, t3.apply(t3.rotation_matrix(start[1]), start[2]))
    a1_end = t3.scale(duration, t3.apply(t3.rotation_matrix(end[1]), end[2]))
    step = t3.subtract(end[0], start[0])
    phi = t3.rotation_between(start[1], end[1])
    c1 = t3.scale(duration, start[3])
    c1_end = t3.scale(duration, t3.rotation_vector_rate(phi, end[3]))
    return duration, start[0], *hermite(step, a1, a1_end), start[1], *hermite(phi, c1, c1_end)


@inlined_kernel
def hermite(step: Vector, slope: Vector, slope_end: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the coefficients of s, s^2 and s^3 of a cubic Hermite curve that starts at zero."""
    quadratic = t3.add_scaled(t3.add_scaled(t3.scale(3.0, step), -2.0, slope), -1.0, slope_end)
    return slope, quadratic, t3.add_scaled(t3.add(slope, slope_end), -2.0, step)


@inlined_kernel
def cubic(s: float, c1: Vector, c2: Vector, c3: Vector) -> Vector:
    """Return c1 s + c2 s^2 + c3 s^3."""
    return t3.scale(s, t3.add_scaled(c1, s, t3.add_scaled(c2, s, c3)))


@inlined_kernel
def cubic_slope(s: float, c1: Vector, c2: Vector, c3: Vector) -> Vector:
    """Return c1 + 2 c2 s + 3 c3 s^2."""
    return t3.add_scaled(c1, 2.0 * s, t3.add_scaled(c2, 1.5 * s, c3))


@inlined_kernel
def tool_at(segment: ToolSegment, s: float) -> State:
    """Return the tool's pose and body twist at the fraction s of the segment."""
    duration, o0, a1, a2, a3, q0, c1, c2, c3 = segment
    phi = cubic(s, c1, c2, c3)
    q = t3.quaternion_product(q0, t3.exp_quaternion(phi))
    velocity = t3.scale(1.0 / duration, cubic_slope(s, a1, a2, a3))
    return (
        t3.add(o0, cubic(s, a1, a2, a3)), q,
        t3.apply_transposed(t3.rotation_matrix(q), velocity),
        t3.scale(1.0 / duration, t3.body_rate(phi, cubic_slope(s, c1, c2, c3))))


@inlined_kernel
def extrapolated(tool: State, duration: float) -> State:
    """Return the tool after a duration (s) of constant linear and angular velocity in A."""
    o, q, v, w = tool[:4]
    velocity = t3.apply(t3.rotation_matrix(q), v)
    q_later = t3.quaternion_product(q, t3.exp_quaternion(t3.scale(duration, w)))
    return (t3.add_scaled(o, duration, velocity), q_later,
            t3.apply_transposed(t3.rotation_matrix(q_later), velocity), w)


@inlined_kernel
def stage_state(
    body: State, h: float, do: Vector, sigma: Vector, dv: Vector, dw: Vector, dz: Strains = ()
) -> State:
    """Return the state after h at constant rates of position, rotation, twist and strains."""
    return (
        t3.add_scaled(body[0], h, do),
        t3.quaternion_product(body[1], t3.exp_quaternion(t3.scale(h, sigma))),
        t3.add_scaled(body[2], h, dv),
        t3.add_scaled(body[3], h, dw), *moved_strains(body[4:], h, dz))


@inlined_kernel
def moved_strains(strains: Strains, h: float, rates: Strains) -> Strains:
    """Return internal strains plus h times their rates."""
    if len(strains) == 0:
        return ()
    return (
        add_scaled_strain(strains[0], h, rates[0]), add_scaled_strain(strains[1], h, rates[1]))


@inlined_kernel
def rotation_rate(sigma: Vector, w: Vector) -> Vector:
    """
    Return the rate of sigma in R0 exp(sigma) for the body rate w, to the order of RKMK4.

    The rate is w + 1/2 sigma x w + 1/12 sigma x (sigma x w), the truncated inverse of
    dexp(-sigma).
    """
    once = t3.cross(sigma, w)
    return t3.add_scaled(t3.add_scaled(w, 0.5, once), 1.0 / 12.0, t3.cross(sigma, once))


@inlined_kernel
def weighted(a: Vector, b: Vector, c: Vector, d: Vector) -> Vector:
    """Return (a + 2 b + 2 c + d) / 6, the Runge-Kutta mean of four stages."""
    return t3.scale(1.0 / 6.0, t3.add(t3.add(a, d), t3.scale(2.0, t3.add(b, c))))


@inlined_kernel
def weighted_pair(a: Strain, b: Strain, c: Strain, d: Strain) -> Strain:
    """Return the `weighted` mean of four pairs of vectors."""
    return weighted(a[0], b[0], c[0], d[0]), weighted(a[1], b[1], c[1], d[1])


@inlined_kernel
def weighted_strains(a: Strains, b: Strains, c: Strains, d: Strains) -> Strains:
    """Return the `weighted` mean of four rates of internal strains."""
    if len(a) == 0:
        return ()
    return weighted_pair(a[0], b[0], c[0], d[0]), weighted_pair(a[1], b[1], c[1], d[1])


@inlined_kernel
def rates(
    model: ModelTuple, tool: State, body: State, w: Vector
) -> tuple[Vector, Vector, Vector, Vector, Strains]:
    """Return the rates of a package's state for `stage_state`; w is its body rate."""
    dv, dw = body_acceleration(model, tool, body)
    do = t3.apply(t3.rotation_matrix(body[1]), body[2])
    return do, w, dv, dw, strain_rates(model, tool, body)


@inlined_kernel
def step(
    model: ModelTuple, body: State, tool: State, tool_middle: State, tool_end: State, h: float
) -> State:
    """Return the package's state after h, by tool states at start, middle and end (RKMK4)."""
    half = 0.5 * h
    a = rates(model, tool, body, body[3])
    body2 = stage_state(body, half, *a)
    b = rates(model, tool_middle, body2, rotation_rate(t3.scale(half, a[1]), body2[3]))
    body3 = stage_state(body, half, *b)
    c = rates(model, tool_middle, body3, rotation_rate(t3.scale(half, b[1]), body3[3]))
    body4 = stage_state(body, h, *c)
    d = rates(model, tool_end, body4, rotation_rate(t3.scale(h, c[1]), body4[3]))
    end = stage_state(
        body, h, weighted(a[0], b[0], c[0], d[0]), weighted(a[1], b[1], c[1], d[1]),
        weighted(a[2], b[2], c[2], d[2]), weighted(a[3], b[3], c[3], d[3]),
        weighted_strains(a[4], b[4], c[4], d[4]))
    q = end[1]  # normalised to first order, so that rounding errors do not accumulate
    k = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return with_rotation(end, (k * q[0], k * q[1], k * q[2], k * q[3]))


@inlined_kernel
def advance(
    model: ModelTuple, body: State, start: State, end: State, duration: float, substeps: int
) -> State:
    """Return the package's state after the tool's motion from one sample to the next."""
    segment = tool_segment(start, end, duration)
    h = duration / substeps
    tool = start
    for i in range(substeps):
        middle = tool_at(segment, (i + 0.5) / substeps)
        tool_end = end if i == substeps - 1 else tool_at(segment, (i + 1.0) / substeps)
        body = step(model, body, tool, middle, tool_end, h)
        tool = tool_end
    return body


@inlined_kernel
def checked_wrench(
    model: ModelTuple, tool: State, body: State, reach: float
) -> tuple[Wrench, bool]:
    """
    Return the cup's wrench on the package, and whether wrench and state are plausible.

    Plausible numbers are finite, with the lip within reach (m) of its nominal position.
    """
    cup, package, _ = model
    o_lip, R_lip, v_lip, w_lip = lip_relative_to_tool(package[1], tool, body)
    f, m = wrench = cup_wrench(cup, o_lip, R_lip, v_lip, w_lip, body[4:])
    v, w = body[2], body[3]
    total = t3.dot(v, v) + t3.dot(w, w) + t3.dot(f, f) + t3.dot(m, m) + body[1][0] + body[1][3]
    shift = (o_lip[0], o_lip[1], o_lip[2] + cup[1])
    return wrench, total - total == 0.0 and t3.dot(shift, shift) <= reach * reach
