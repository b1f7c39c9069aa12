"""
Analytic derivatives of the cup's wrench and of the package's acceleration.

A small change of a state is in the axes of its own body (tool or package): shift (m), rotation
(rad), linear and angular twist (m/s, rad/s). The changed pose is (o + R shift, R exp(rotation)),
as in `displaced`. A 6x6 matrix is the tuple of its 3x3 blocks, linear first.

Derivatives are taken at S1, the package's end of the spring. A shift and rotation xi of B is
X(S1_H_B) xi there, like a twist; the twist relative to the tool changes by -ad(v_tool) xi.
"""

from typing import Any

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector, ZERO
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import (
    Blocks,
    ModelTuple,
    PackageTuple,
    State,
    Strain,
    Stretch,
    Wrench,
)

Square = tuple[Matrix, Matrix, Matrix, Matrix]
"""A 6x6 matrix as its blocks oo, oR, Ro, RR."""

BY_DAMPING = slice(21, 42)
BY_LENGTH, BY_INERTIA, BY_GRAVITY = slice(42, 43), slice(43, 49), slice(49, 52)
BY_MASS, BY_COM = slice(52, 53), slice(53, 56)
BY_STRETCH = slice(62, 64)
PARAMETER_COLUMNS = 64
"""
Number of parameters, one column each: the upper triangles of K and of P (row by row), the length
l0, the inertia (xx, yy, zz, xy, xz, yz), the gravity vector in A, the mass, the centre of mass, an
additional wrench on the package at the lip in S axes, and the two coefficients of the stretch.
"""

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
ZERO_MATRIX = (0.0,) * 9


@kernel
def add_scaled_square(A: Square, factor: float, B: Square) -> Square:
    """Return A + factor * B."""
    return (
        t3.add_scaled_matrix(A[0], factor, B[0]), t3.add_scaled_matrix(A[1], factor, B[1]),
        t3.add_scaled_matrix(A[2], factor, B[2]), t3.add_scaled_matrix(A[3], factor, B[3]))


@kernel
def scale_square(factor: float, A: Square) -> Square:
    """Return factor * A."""
    return (
        t3.scale_matrix(factor, A[0]), t3.scale_matrix(factor, A[1]),
        t3.scale_matrix(factor, A[2]), t3.scale_matrix(factor, A[3]))


@kernel
def shift_left(c: Vector, A: Square) -> Square:
    """Return X^T A with X = [[I, c^], [0, I]]."""
    return (
        A[0], A[1],
        t3.add_scaled_matrix(A[2], -1.0, t3.multiply(t3.hat(c), A[0])),
        t3.add_scaled_matrix(A[3], -1.0, t3.multiply(t3.hat(c), A[1])))


@kernel
def shift_right(A: Square, c: Vector) -> Square:
    """Return A X with X = [[I, c^], [0, I]]."""
    return (
        A[0], t3.add_scaled_matrix(A[1], 1.0, t3.multiply(A[0], t3.hat(c))),
        A[2], t3.add_scaled_matrix(A[3], 1.0, t3.multiply(A[2], t3.hat(c))))


@kernel
def rotate_right(A: Square, R: Matrix) -> Square:
    """Return A diag(R^T, R^T)."""
    T = t3.transposed(R)
    return t3.multiply(A[0], T), t3.multiply(A[1], T), t3.multiply(A[2], T), t3.multiply(A[3], T)


@kernel
def strain_jacobian(o: Vector, R: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Return the blocks oo, oR, RR of the strain's derivative J (3.23); the block Ro is zero."""
    trace = R[0] + R[4] + R[8]
    return (
        (R[0] + 1.0, R[1], R[2], R[3], R[4] + 1.0, R[5], R[6], R[7], R[8] + 1.0),
        t3.hat(t3.apply_transposed(R, o)),
        (trace - R[0], -R[3], -R[6],
         -R[1], trace - R[4], -R[7],
         -R[2], -R[5], trace - R[8]))


@kernel
def stress_jacobian(o: Vector, R: Matrix, K: Blocks) -> Square:
    """Return K J, the derivative of K h by shift and rotation of S1."""
    J_oo, q_hat, J_RR = strain_jacobian(o, R)
    K_Ro = t3.transposed(K[1])
    return (
        t3.multiply(K[0], J_oo),
        t3.add_scaled_matrix(t3.multiply(K[0], q_hat), 1.0, t3.multiply(K[1], J_RR)),
        t3.multiply(K_Ro, J_oo),
        t3.add_scaled_matrix(t3.multiply(K_Ro, q_hat), 1.0, t3.multiply(K[2], J_RR)))


@kernel
def spring_jacobian(
    o: Vector, R: Matrix, K: Blocks, branches: tuple[kernels.Branch, ...],
    strains: kernels.Strains,
) -> Square:
    """
    Return the derivative of `spring_wrench` by shift and rotation of S1.

    The derivative is the sum of -1/4 J^T dS/dh J and the change of J under the stress s = (s_o,
    s_R): -1/4 [[0, (R^T s_o)^], [s_o^, s_o^ q^ - s_R h_R^T + R s_R^]] with q = R^T o.
    """
    h_now = kernels.strain(o, R)
    h, h_R = kernels.effective_strain(h_now, branches, strains), h_now[1]
    s_o, s_R = kernels.stretched(K, h_now, kernels.multiply_blocks(K, h[0], h[1]))
    J_oo, q_hat, J_RR = strain_jacobian(o, R)
    Z = stress_jacobian(o, R, (K[0], K[1], K[2]))
    if len(strains) > 0:  # a sudden strain meets K (1 + r1 + r2)
        Z = add_scaled_square(Z, branches[0][0] + branches[1][0], Z)
    if len(K) == 4 and (K[3:][0][0] != 0.0 or K[3:][0][1] != 0.0):
        Z = add_scaled_square(Z, 1.0, stress_jacobian(o, R, stretch_tangent(K[3:][0], h_now)))
    Z_oo, Z_oR, Z_Ro, Z_RR = Z
    RR = t3.add_scaled_matrix(t3.multiply(t3.hat(s_o), q_hat), -1.0, t3.outer(s_R, h_R))
    RR = t3.add_scaled_matrix(RR, 1.0, t3.multiply(R, t3.hat(s_R)))
    RR = t3.add_scaled_matrix(RR, 1.0, t3.multiply_transposed(J_RR, Z_RR))
    Ro = t3.add_scaled_matrix(t3.multiply_transposed(J_RR, Z_Ro), 1.0, t3.hat(s_o))
    oR = t3.add_scaled_matrix(
        t3.multiply_transposed(J_oo, Z_oR), 1.0, t3.hat(t3.apply_transposed(R, s_o)))
    return scale_square(-kernels.ENERGY_FACTOR, (  # J_oR^T = -q_hat
        t3.multiply_transposed(J_oo, Z_oo), oR,
        t3.add_scaled_matrix(Ro, -1.0, t3.multiply(q_hat, Z_oo)),
        t3.add_scaled_matrix(RR, -1.0, t3.multiply(q_hat, Z_oR))))


@kernel
def stretch_tangent(stretch: Stretch, h: Strain) -> Blocks:
    """Return 4 times the second derivative of a h_z^3 + b h_z (h_rx^2 + h_ry^2) by h."""
    b = 8.0 * stretch[1]
    x, y, z = b * h[1][0], b * h[1][1], b * h[0][2]
    return (
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 24.0 * stretch[0] * h[0][2]),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, x, y, 0.0), (z, 0.0, 0.0, 0.0, z, 0.0, 0.0, 0.0, 0.0))


@kernel
def damper_jacobians(
    o: Vector, R: Matrix, v: Vector, w: Vector, P: Blocks
) -> tuple[Square, Square]:
    """
    Return the derivatives of `damper_wrench` by shift and rotation of S1, and by its twist.

    The derivative by twist is -D1 = -1/2 (P + G), G = X^T P X; by shift and rotation, with F = G
    v1, it is -1/2 ([[0, F_o^], [F_o^, F_R^]] - G ad(v1)).
    """
    full = P[0], P[1], t3.transposed(P[1]), P[2]
    back = t3.transposed(R)
    at_S2 = rotate_right(shift_left(o, shift_right(full, o)), back)
    G = (t3.multiply(back, at_S2[0]), t3.multiply(back, at_S2[1]),
         t3.multiply(back, at_S2[2]), t3.multiply(back, at_S2[3]))
    force = t3.hat(t3.add(t3.apply(G[0], v), t3.apply(G[1], w)))
    moment = t3.hat(t3.add(t3.apply(G[2], v), t3.apply(G[3], w)))
    by_pose = add_scaled_square(times_twist(G, v, w), -1.0, (ZERO_MATRIX, force, force, moment))
    return scale_square(0.5, by_pose), scale_square(-0.5, add_scaled_square(full, 1.0, G))


@kernel
def times_twist(A: Square, v: Vector, w: Vector) -> Square:
    """Return A ad(v) with ad(v) = [[w^, v^], [0, w^]]."""
    return (
        t3.multiply(A[0], t3.hat(w)),
        t3.add_scaled_matrix(t3.multiply(A[0], t3.hat(v)), 1.0, t3.multiply(A[1], t3.hat(w))),
        t3.multiply(A[2], t3.hat(w)),
        t3.add_scaled_matrix(t3.multiply(A[2], t3.hat(v)), 1.0, t3.multiply(A[3], t3.hat(w))))


@kernel
def ends_of_spring(
    model: ModelTuple, tool: State, body: State
) -> tuple[Vector, Vector, Matrix, Vector, Vector, Vector, Vector, Vector]:
    """
    Return B in S1, S2_o_S1, E_R_S, S1_v_{S2,S1} (linear, angular), E_o_S1, and the tool's twist.

    The tool's twist is taken at S1 in S axes, X(E_H_S1)^-1 E_v_AE.
    """
    cup, package, _ = model
    o_E_S, R, v, w = kernels.lip_relative_to_tool(package[1], tool, body)
    l1 = cup[0]
    o_E_S1 = t3.add_scaled(o_E_S, l1, (R[2], R[5], R[8]))
    com = package[1]
    return (
        (com[0], com[1], com[2] - l1), kernels.spring_frames(cup, o_E_S, R), R,
        (v[0] + l1 * w[1], v[1] - l1 * w[0], v[2]), w,
        o_E_S1,
        t3.apply_transposed(R, t3.add(tool[2], t3.cross(tool[3], o_E_S1))),
        t3.apply_transposed(R, tool[3]))


@kernel
def wrench_jacobians(model: ModelTuple, tool: State, body: State) -> tuple[Square, Square]:
    """Return the derivatives of the cup's wrench at S1 by shift and rotation, and twist, of S1."""
    _, o, R, v, w, _, v_tool, w_tool = ends_of_spring(model, tool, body)
    damper, by_twist = damper_jacobians(o, R, v, w, model[0][3])
    spring = spring_jacobian(o, R, model[0][2], model[0][4:], body[4:])
    by_pose = add_scaled_square(spring, 1.0, damper)
    return add_scaled_square(by_pose, -1.0, times_twist(by_twist, v_tool, w_tool)), by_twist


@kernel
def accelerations(package: PackageTuple, A: Square) -> Square:
    """Return the accelerations under wrenches at B, one in each column (3.5)."""
    inverse = 1.0 / package[0]
    return (
        t3.scale_matrix(inverse, A[0]), t3.scale_matrix(inverse, A[1]),
        t3.multiply(package[3], A[2]), t3.multiply(package[3], A[3]))


@kernel
def cup_accelerations(model: ModelTuple, tool: State, body: State) -> tuple[Square, Square]:
    """Return the derivatives of the acceleration by the cup's wrench, by pose and by twist."""
    c = ends_of_spring(model, tool, body)[0]
    by_pose, by_twist = wrench_jacobians(model, tool, body)
    return (accelerations(model[1], shift_left(c, shift_right(by_pose, c))),
            accelerations(model[1], shift_left(c, shift_right(by_twist, c))))


@entry
def body_jacobians(model: ModelTuple, tool: State, body: State) -> tuple[Square, Square]:
    """Return the derivatives of `body_acceleration` by pose and twist of the body."""
    _, package, gravity = model
    pose, twist = cup_accelerations(model, tool, body)
    g = t3.hat(t3.apply_transposed(t3.rotation_matrix(body[1]), gravity))
    v, w, inertia = body[2], body[3], package[2]
    gyro = t3.add_scaled_matrix(
        t3.hat(t3.apply(inertia, w)), -1.0, t3.multiply(t3.hat(w), inertia))
    return (
        (pose[0], t3.add_scaled_matrix(pose[1], 1.0, g), pose[2], pose[3]),
        (
            t3.add_scaled_matrix(twist[0], -1.0, t3.hat(w)),
            t3.add_scaled_matrix(twist[1], 1.0, t3.hat(v)),
            twist[2], t3.add_scaled_matrix(twist[3], 1.0, t3.multiply(package[3], gyro))))


@entry
def strain_jacobians(model: ModelTuple, tool: State, body: State) -> tuple[Square, Square]:
    """
    Return the derivatives of the acceleration by r_b z_b, and of h by the body's pose.

    The wrench of an internal strain is 1/4 J^T K r_b z_b at S1; h changes by J times shift and
    rotation of S1.
    """
    c, o, R, _, _, _, _, _ = ends_of_spring(model, tool, body)
    J_oo, J_oR, J_RR = strain_jacobian(o, R)
    K = model[0][2]
    Z_oo, Z_oR, Z_Ro, Z_RR = stress_jacobian(o, R, (K[0], K[1], K[2]))
    quarter = scale_square(kernels.ENERGY_FACTOR, (
        t3.transposed(Z_oo), t3.transposed(Z_Ro), t3.transposed(Z_oR), t3.transposed(Z_RR)))
    return accelerations(model[1], shift_left(c, quarter)), shift_right(
        (J_oo, J_oR, ZERO_MATRIX, J_RR), c)


@kernel
def relaxation_jacobian(
    model: ModelTuple, tool: State, body: State, out: Any, column: int
) -> None:
    """
    Write the derivatives of `body_acceleration` by r1 and r2 into two columns (6,).

    Nothing is written for a cup that does not relax.
    """
    if len(body) == 4:
        return
    c, o, R, _, _, _, _, _ = ends_of_spring(model, tool, body)
    h, strains = kernels.strain(o, R), body[4:]
    for b in range(2):
        d = kernels.add_scaled_strain(h, -1.0, strains[b])
        f, m = kernels.stress_wrench(o, R, kernels.multiply_blocks(model[0][2], d[0], d[1]))
        dv, dw = acceleration_at(model[1], c, f, m)
        write_column(out, column + b, dv, dw)


@entry
def tool_jacobians(model: ModelTuple, tool: State, body: State) -> tuple[Square, Square]:
    """Return the derivatives of `body_acceleration` by pose and twist of the tool."""
    c, _, R, _, _, o_E_S1, _, _ = ends_of_spring(model, tool, body)
    by_pose, by_twist = wrench_jacobians(model, tool, body)
    arm = t3.scale(-1.0, o_E_S1)
    pose = accelerations(model[1], shift_left(c, shift_right(rotate_right(by_pose, R), arm)))
    twist = accelerations(model[1], shift_left(c, shift_right(rotate_right(by_twist, R), arm)))
    return scale_square(-1.0, pose), scale_square(-1.0, twist)


@kernel
def acceleration_at(package: PackageTuple, c: Vector, f: Vector, m: Vector) -> Wrench:
    """Return the accelerations due to a wrench, with B at c from its point of action (3.5)."""
    return t3.scale(1.0 / package[0], f), t3.apply(package[3], t3.subtract(m, t3.cross(c, f)))


@kernel
def accelerations_at(
    package: PackageTuple, c: Vector, forces: Matrix, moments: Matrix, couples: Matrix
) -> tuple[Wrench, Wrench, Wrench, Wrench, Wrench, Wrench]:
    """Return the accelerations by rows of forces with moments, then by rows of couples."""
    return (
        acceleration_at(package, c, row(forces, 0), row(moments, 0)),
        acceleration_at(package, c, row(forces, 1), row(moments, 1)),
        acceleration_at(package, c, row(forces, 2), row(moments, 2)),
        acceleration_at(package, c, ZERO, row(couples, 0)),
        acceleration_at(package, c, ZERO, row(couples, 1)),
        acceleration_at(package, c, ZERO, row(couples, 2)))


@kernel
def write_block(out: Any, i: int, j: int, block: Matrix) -> None:
    """Write a 3x3 matrix into an array."""
    for k in range(3):
        out[i + k, j], out[i + k, j + 1], out[i + k, j + 2] = row(block, k)


@kernel
def write_square(out: Any, i: int, j: int, square: Square) -> None:
    """Write a 6x6 matrix into an array."""
    write_block(out, i, j, square[0])
    write_block(out, i, j + 3, square[1])
    write_block(out, i + 3, j, square[2])
    write_block(out, i + 3, j + 3, square[3])


@kernel
def write_column(out: Any, column: int, a: Vector, b: Vector) -> None:
    """Write two vectors into a column (6,)."""
    out[0, column], out[1, column], out[2, column] = a
    out[3, column], out[4, column], out[5, column] = b


@kernel
def write_slope(model: ModelTuple, tool: State, body: State, A: Any) -> None:
    """Write the derivative (12, 12) of the rate of a small change by that change, in body axes."""
    by_pose, by_twist = body_jacobians(model, tool, body)
    v_hat, w_hat = t3.hat(body[2]), t3.hat(body[3])
    write_square(A, 0, 0, scale_square(-1.0, (w_hat, v_hat, ZERO_MATRIX, w_hat)))
    write_square(A, 6, 0, by_pose)
    write_square(A, 6, 6, by_twist)
    for i in range(6):
        A[i, 6 + i] = 1.0


@entry
def parameter_jacobian(
    model: ModelTuple, tool: State, body: State, first: int, last: int, out: Any
) -> None:
    """
    Write the derivatives of `body_acceleration` by some of the parameters.

    Parameters
    ----------
    model, tool, body : tuples
        As `body_acceleration` takes them.
    first, last : int
        Range of the parameters among `PARAMETER_COLUMNS`; the last one is excluded.
    out : ndarray (6, n)
        Derivatives, from the first column on: m/s^2 and rad/s^2 per SI unit of the parameter.

    """
    if first < 42:
        _entries(model, tool, body, first, last, out)
    if last > 42:
        _others(model, tool, body, first, last, out)


@kernel
def _entries(
    model: ModelTuple, tool: State, body: State, first: int, last: int, out: Any
) -> None:
    """
    Write the columns of K and P: the wrench is linear in their entries (4.67).

    With r_j the row j of J, entry jk of K contributes -1/4 (r_j h_k + r_k h_j). With X of the
    damper, x_j the row j of X and u = X v1, entry jk of P contributes -1/2 (e_j v_k + e_k v_j +
    x_j u_k + x_k u_j).
    """
    c, o, R, v, w, _, _, _ = ends_of_spring(model, tool, body)
    package = model[1]
    J_oo, J_oR, J_RR = strain_jacobian(o, R)
    o_R = t3.multiply(t3.hat(o), R)
    u_R = t3.apply(R, w)
    h = _six(*kernels.effective_strain(kernels.strain(o, R), model[0][4:], body[4:]))
    at_S1, at_S2 = _six(v, w), _six(t3.add(t3.apply(R, v), t3.cross(o, u_R)), u_R)
    s = accelerations_at(package, c, J_oo, J_oR, J_RR)
    e = accelerations_at(package, c, IDENTITY, ZERO_MATRIX, IDENTITY)
    x = accelerations_at(package, c, R, o_R, R)
    number = 0
    for j in range(6):
        for k in range(j, 6):
            half = 0.5 if j == k else 1.0
            if first <= number < last:
                a, b = _pair(-kernels.ENERGY_FACTOR * half, s[j], h[k], s[k], h[j])
                write_column(out, number - first, a, b)
            if first <= number + 21 < last:
                a, b = _pair(-0.5 * half, e[j], at_S1[k], e[k], at_S1[j])
                c_a, c_b = _pair(-0.5 * half, x[j], at_S2[k], x[k], at_S2[j])
                write_column(out, number + 21 - first, t3.add(a, c_a), t3.add(b, c_b))
            number += 1


@kernel
def row(A: Matrix, i: int) -> Vector:
    """Return a row of a matrix."""
    return A[3 * i], A[3 * i + 1], A[3 * i + 2]


@kernel
def _six(a: Vector, b: Vector) -> tuple[float, float, float, float, float, float]:
    return a[0], a[1], a[2], b[0], b[1], b[2]


@kernel
def _pair(factor: float, A: Wrench, a: float, B: Wrench, b: float) -> Wrench:
    return (
        t3.add(t3.scale(factor * a, A[0]), t3.scale(factor * b, B[0])),
        t3.add(t3.scale(factor * a, A[1]), t3.scale(factor * b, B[1])))


@kernel
def _others(
    model: ModelTuple, tool: State, body: State, first: int, last: int, out: Any
) -> None:
    """
    Write the columns of all parameters but K and P.

    With the accelerations dv, dw and the cup's force f, the column of the mass is -f / m^2, and
    the column of an entry of the inertia -I^-1 (dI dw + w x dI w). Length and centre of mass shift
    S1, and B in S1.
    """
    package = model[1]
    w, R = body[3], t3.rotation_matrix(body[1])
    _, dw = kernels.body_acceleration(model, tool, body)
    f, _ = kernels.lip_wrench(model, tool, body)
    by_pose, by_twist = wrench_jacobians(model, tool, body)
    c, o, R_E_S, _, _, _, _, _ = ends_of_spring(model, tool, body)
    h = kernels.strain(o, R_E_S)
    for i in range(max(first, 42), last):
        a, b = ZERO, ZERO
        if i == 42:
            a, b = by_length(model, tool, body, f)
        elif i < 49:
            b = by_inertia(package[3], w, dw, i - 43)
        elif i < 52:
            a = row(R, i - 49)
        elif i == 52:
            a = t3.scale(-1.0 / package[0] ** 2, f)
        elif i < 56:
            a, b = by_com(package, c, by_pose, by_twist, w, f, t3.unit(i - 53, 1.0))
        elif i < 62:
            a, b = acceleration_at(package, package[1], t3.unit(i - 56, 1.0), t3.unit(i - 59, 1.0))
        else:
            a, b = by_stretch(package, c, o, R_E_S, h, (63.0 - i, i - 62.0))
        write_column(out, i - first, a, b)


@kernel
def by_stretch(
    package: PackageTuple, c: Vector, o: Vector, R: Matrix, h: Strain, unit: Stretch
) -> Wrench:
    """Return the accelerations per unit of a or b of the stretch."""
    zero = (ZERO_MATRIX, ZERO_MATRIX, ZERO_MATRIX, unit)
    f, m = kernels.stress_wrench(o, R, kernels.stretched(zero, h, (ZERO, ZERO)))
    return acceleration_at(package, c, f, m)


@kernel
def by_length(model: ModelTuple, tool: State, body: State, f: Vector) -> Wrench:
    """Return the accelerations per metre of l0; each end of the spring moves by half."""
    cup, package, _ = model
    c, o, R, v, w, _, _, _ = ends_of_spring(model, tool, body)
    damper, by_twist = damper_jacobians(o, R, v, w, cup[3])
    spring = spring_jacobian(o, R, cup[2], cup[4:], body[4:])
    by_pose = add_scaled_square(spring, 1.0, damper)
    shift = (0.5 * R[6], 0.5 * R[7], 0.5 * R[8] + 0.5)
    speed = (0.5 * w[1], -0.5 * w[0], 0.0)
    df, dm = t3.add(t3.apply(by_pose[0], shift), t3.apply(by_twist[0], speed)), t3.add(
        t3.apply(by_pose[2], shift), t3.apply(by_twist[2], speed))
    dv, dw = acceleration_at(package, c, df, dm)
    return dv, t3.add(dw, t3.apply(package[3], (-0.5 * f[1], 0.5 * f[0], 0.0)))


@kernel
def by_inertia(inverse: Matrix, w: Vector, dw: Vector, entry: int) -> Vector:
    """Return the accelerations per metre of l0; each end of the spring shifts by half."""
    j, k = (entry, entry) if entry < 3 else (entry // 5, min(entry - 2, 2))
    twice = 1.0 if j != k else 0.0
    dI_dw = t3.add(t3.unit(j, dw[k]), t3.unit(k, twice * dw[j]))
    dI_w = t3.add(t3.unit(j, w[k]), t3.unit(k, twice * w[j]))
    return t3.scale(-1.0, t3.apply(inverse, t3.add(dI_dw, t3.cross(w, dI_w))))


@kernel
def by_com(
    package: PackageTuple, c: Vector, by_pose: Square, by_twist: Square,
    w: Vector, f: Vector, along: Vector,
) -> Wrench:
    """Return the accelerations per metre of B along a direction; S1 moves the opposite way."""
    speed = t3.cross(along, w)
    df = t3.subtract(t3.apply(by_twist[0], speed), t3.apply(by_pose[0], along))
    dm = t3.subtract(t3.apply(by_twist[2], speed), t3.apply(by_pose[2], along))
    return acceleration_at(package, c, df, t3.subtract(dm, t3.cross(along, f)))
