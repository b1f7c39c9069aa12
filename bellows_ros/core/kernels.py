"""
The cup-package model as scalar kernels: where the spring wrench is.

Frames: ``A`` world, ``E`` tip of the tool arm, ``S`` centre of the lip on the package, ``B``
centre of mass, with ``[S] = [B]``. Six-vectors are two 3-tuples, linear first, then angular.
Twists are body twists: ``R^T do/dt`` and the body rate. SI units throughout.

A cup is the tuple ``(l1, l0, K, P)`` and a 6x6 symmetric matrix its blocks ``(oo, oR, RR)``; a
package is ``(mass, com, inertia, inertia_inverse)``; a model is ``(cup, package, gravity)`` with
gravity the acceleration vector in ``A``. `model.Cup` and `model.Package` make these tuples.
"""

from __future__ import annotations

from bellows_ros.core.jit import kernel
from bellows_ros.core.tuples import (
    add,
    add_scaled,
    apply,
    apply_transposed,
    cross,
    dot,
    Matrix,
    multiply_transposed,
    Quaternion,
    rotation_matrix,
    scale,
    subtract,
    Vector,
)

Blocks = tuple[Matrix, Matrix, Matrix]
CupTuple = tuple[float, float, Blocks, Blocks]
PackageTuple = tuple[float, Vector, Matrix, Matrix]
ModelTuple = tuple[CupTuple, PackageTuple, Vector]
State = tuple[Vector, Quaternion, Vector, Vector]
"""Position (m), orientation, linear and angular body twist (m/s, rad/s) of a frame in A."""
Wrench = tuple[Vector, Vector]
"""Force (N) and moment (N m)."""


@kernel
def multiply_blocks(M: Blocks, a: Vector, b: Vector) -> tuple[Vector, Vector]:
    """Return M [a; b] for a symmetric 6x6 matrix given by its blocks."""
    return (
        add(apply(M[0], a), apply(M[1], b)),
        add(apply_transposed(M[1], a), apply(M[2], b)),
    )


@kernel
def strain(o: Vector, R: Matrix) -> tuple[Vector, Vector]:
    """Return h = [(I + R^T) o; (R - R^T)^vee] (3.18) of H = S2_H_S1 = (R, o)."""
    return (
        add(o, apply_transposed(R, o)),
        (R[7] - R[5], R[2] - R[6], R[3] - R[1]),
    )


@kernel
def spring_energy(o: Vector, R: Matrix, K: Blocks) -> float:
    """Return the elastic energy P0 = 1/8 h^T K h (J) (3.17)."""
    h_o, h_R = strain(o, R)
    s_o, s_R = multiply_blocks(K, h_o, h_R)
    return 0.125 * (dot(h_o, s_o) + dot(h_R, s_R))


@kernel
def spring_wrench(o: Vector, R: Matrix, K: Blocks) -> Wrench:
    """
    Return the spring wrench on the package at S1, f1 = -1/4 J^T K h (3.23, 3.27).

    J = [[R + I, (R^T o)^], [0, tr(R) I - R^T]] is the derivative of the strain h.
    """
    h_o, h_R = strain(o, R)
    s_o, s_R = multiply_blocks(K, h_o, h_R)
    trace = R[0] + R[4] + R[8]
    force = add(s_o, apply_transposed(R, s_o))
    moment = add(
        subtract(scale(trace, s_R), apply(R, s_R)),
        cross(s_o, apply_transposed(R, o)),
    )
    return scale(-0.25, force), scale(-0.25, moment)


@kernel
def damper_wrench(o: Vector, R: Matrix, v: Vector, w: Vector, P: Blocks) -> Wrench:
    """
    Return the damper wrench on the package at S1, f1 = -1/2 (P + X^T P X) v1 (3.32, 3.33).

    X = X(S2_H_S1) (2.24); (v, w) is v1 = S1_v_{S2,S1}, the twist of S1 relative to S2.
    """
    near_o, near_R = multiply_blocks(P, v, w)  # P v1, the port at S1
    R_w = apply(R, w)
    far_o, far_R = multiply_blocks(P, add(apply(R, v), cross(o, R_w)), R_w)  # P X v1, at S2
    force = add(near_o, apply_transposed(R, far_o))
    moment = add(near_R, apply_transposed(R, subtract(far_R, cross(o, far_o))))
    return scale(-0.5, force), scale(-0.5, moment)


@kernel
def spring_frames(cup: CupTuple, o_E_S: Vector, R_E_S: Matrix) -> Vector:
    """Return the origin of S1 in S2, o = l2 z + l1 R z + E_o_S (3.13); its rotation is R_E_S."""
    l1, l0 = cup[0], cup[1]
    l2 = l0 - l1
    return (
        o_E_S[0] + l1 * R_E_S[2],
        o_E_S[1] + l1 * R_E_S[5],
        o_E_S[2] + l1 * R_E_S[8] + l2,
    )


@kernel
def cup_wrench(cup: CupTuple, o_E_S: Vector, R_E_S: Matrix, v_ES: Vector, w_ES: Vector) -> Wrench:
    """
    Return the wrench of the cup on the package at the lip, in S axes (3.7).

    (v_ES, w_ES) is S_v_ES, the body twist of the lip relative to the tool.
    """
    l1 = cup[0]
    o = spring_frames(cup, o_E_S, R_E_S)
    v_S1 = (v_ES[0] + l1 * w_ES[1], v_ES[1] - l1 * w_ES[0], v_ES[2])  # X(S_H_S1)^-1 (3.34)
    spring_f, spring_m = spring_wrench(o, R_E_S, cup[2])
    damper_f, damper_m = damper_wrench(o, R_E_S, v_S1, w_ES, cup[3])
    f = add(spring_f, damper_f)
    m = add(spring_m, damper_m)
    return f, (m[0] - l1 * f[1], m[1] + l1 * f[0], m[2])  # X(S_H_S1)^-T (3.25)


@kernel
def wrench_at_com(com: Vector, f: Vector, m: Vector) -> Wrench:
    """Return the wrench moved from S to B: X(S_H_B)^T f_S (2.28) with S_H_B = (I, com)."""
    return f, subtract(m, cross(com, f))


@kernel
def lip_relative_to_tool(
    com: Vector,
    o_A_E: Vector, R_A_E: Matrix, v_E: Vector, w_E: Vector,
    o_A_B: Vector, R_A_B: Matrix, v_B: Vector, w_B: Vector,
) -> tuple[Vector, Matrix, Vector, Vector]:
    """
    Return E_o_S, E_R_S and the body twist S_v_ES of the lip relative to the tool.

    S_v_ES = X(S_H_B) B_v_AB - X(E_H_S)^-1 E_v_AE.
    """
    R_E_S = multiply_transposed(R_A_E, R_A_B)
    o_A_S = subtract(o_A_B, apply(R_A_B, com))
    o_E_S = apply_transposed(R_A_E, subtract(o_A_S, o_A_E))
    v_S = add(v_B, cross(com, w_B))
    v_tool = apply_transposed(R_E_S, add(v_E, cross(w_E, o_E_S)))
    w_tool = apply_transposed(R_E_S, w_E)
    return o_E_S, R_E_S, subtract(v_S, v_tool), subtract(w_B, w_tool)


@kernel
def newton_euler(
    package: PackageTuple, gravity: Vector, R_A_B: Matrix,
    v: Vector, w: Vector, f: Vector, tau: Vector,
) -> tuple[Vector, Vector]:
    """
    Return the rate of the body twist under the wrench (f, tau) at B and gravity (3.5, 3.42).

    m dv/dt = f - m w x v + m R^T g, I dw/dt = tau - w x I w.
    """
    mass, _, inertia, inertia_inverse = package
    dv = add_scaled(
        subtract(apply_transposed(R_A_B, gravity), cross(w, v)), 1.0 / mass, f
    )
    dw = apply(inertia_inverse, subtract(tau, cross(w, apply(inertia, w))))
    return dv, dw


@kernel
def lip_wrench(model: ModelTuple, tool: State, body: State) -> Wrench:
    """Return the wrench of the cup on the package at the lip, in S axes, in a given state."""
    cup, package, _ = model
    o_E_S, R_E_S, v_ES, w_ES = lip_relative_to_tool(
        package[1],
        tool[0], rotation_matrix(tool[1]), tool[2], tool[3],
        body[0], rotation_matrix(body[1]), body[2], body[3],
    )
    return cup_wrench(cup, o_E_S, R_E_S, v_ES, w_ES)


@kernel
def body_acceleration(model: ModelTuple, tool: State, body: State) -> tuple[Vector, Vector]:
    """Return the rate of the package's body twist, m/s^2 and rad/s^2 (3.42)."""
    _, package, gravity = model
    f, m = lip_wrench(model, tool, body)
    f, m = wrench_at_com(package[1], f, m)
    return newton_euler(package, gravity, rotation_matrix(body[1]), body[2], body[3], f, m)
