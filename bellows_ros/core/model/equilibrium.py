"""
Static equilibrium of the package, and its small motions about a state.

Derivatives of the package's acceleration, modes, step sizes, and the static equilibrium.
"""

from collections.abc import Callable
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.lie import hat
from bellows_ros.core.geometry.tuples import Quaternion, Vector, ZERO
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import Blocks, ModelTuple, ORIGIN, State, Strain, Wrench
from bellows_ros.errors import UnstableError
import numpy as np

PHASE_PER_STEP = 0.1
"""Largest |eigenvalue| * step (rad) of one integration step with which RK4 is accurate and
stable."""


acceleration = entry(kernels.body_acceleration)
"""`kernels.body_acceleration` for calls from Python."""


def resting_on_tool(model: ModelTuple, tool: State) -> State:
    """Return the package at the cup's nominal pose, [B] = [S] = [E], at rest."""
    com = model[1][1]
    offset = t3.apply(t3.rotation_matrix(tool[1]), (com[0], com[1], com[2] - model[0][1]))
    body: State = t3.add(tool[0], offset), tool[1], ZERO, ZERO
    return kernels.relaxed(model[0], (ZERO, ZERO), body)


def adapted(model: ModelTuple, tool: State, body: State) -> State:
    """Return a state with the internal strains of a cup that relaxes, as after a long rest."""
    if len(body[4:]) == len(model[0][4:]):
        return body
    plain: State = body[0], body[1], body[2], body[3]
    return kernels.relaxed(model[0], kernels.lip_strain(model, tool, plain), plain)


@kernel
def displaced(body: State, delta: Vector, phi: Vector) -> State:
    """Return the body at rest, shifted by R delta and rotated by exp(phi) in body axes."""
    move = t3.apply(t3.rotation_matrix(body[1]), delta)
    turned = t3.quaternion_product(body[1], t3.exp_quaternion(phi))
    return t3.add(body[0], move), turned, *body[2:]


@kernel
def moved(body: State, shift: Vector, rotation: Vector, linear: Vector, angular: Vector) -> State:
    """Return a state displaced in body axes, with its twist changed."""
    perturbed = displaced(body, shift, rotation)
    perturbed = kernels.with_rotation(perturbed, t3.normalised(perturbed[1]))
    return kernels.with_twist(
        perturbed, t3.add(perturbed[2], linear), t3.add(perturbed[3], angular))


@kernel
def moved_by(body: State, e: Any) -> State:
    """Return a state changed by the first twelve numbers of an error; see `moved`."""
    return moved(
        body, (e[0], e[1], e[2]), (e[3], e[4], e[5]), (e[6], e[7], e[8]), (e[9], e[10], e[11]))


@entry
def pose_error(body: State, position: Vector, q: Quaternion) -> tuple[Vector, Vector]:
    """Return shift and rotation from a body to a pose, log(T_hat^-1 Z), the inverse of `moved`."""
    return (
        t3.apply_transposed(t3.rotation_matrix(body[1]), t3.subtract(position, body[0])),
        t3.rotation_between(body[1], q))


class Jacobian(NamedTuple):
    """
    Derivatives (6, 6) of the package's acceleration about a state.

    The derivatives are by displacements (m, rad) and twists (m/s, rad/s) of body and tool, in body
    axes.
    """

    body_pose: Array
    body_twist: Array
    tool_pose: Array
    tool_twist: Array


def linearise(model: ModelTuple, tool: State, body: State) -> Jacobian:
    """Return the derivatives of the package's acceleration about a state."""
    by_body = _slope(lambda e: acceleration(model, tool, moved_by(body, e)))
    by_tool = _slope(lambda e: acceleration(model, moved_by(tool, e), body))
    return Jacobian(by_body[:, :6], by_body[:, 6:], by_tool[:, :6], by_tool[:, 6:])


def _slope(function: Callable[[Array], Wrench | Strain], size: int = 12) -> Array:
    """Return the derivative (6, n) of a pair of vectors by n numbers, about zero."""
    rows = [np.subtract(function(step), function(-step)).ravel()
            for step in _DIFFERENCE * np.eye(size)]
    return np.reshape(rows, (size, 6)).T / (2.0 * _DIFFERENCE)


def symmetric_matrix(M: Blocks) -> Array:
    """Return K or P (6, 6) of its blocks."""
    oo, oR, RR = np.reshape(M[:3], (3, 3, 3))
    return np.block([[oo, oR], [oR.T, RR]])


def nominal_system_matrix(model: ModelTuple) -> Array:
    """
    Return the `system_matrix` of the nominal pose, at rest and without load, in closed form.

    At the nominal pose h = 0 and J = 2 I (3.18, 3.23): for small displacements d and twists v the
    wrench on the package is -X^T (K d + P v), X = X(S1_H_B). No kernel is compiled.
    """
    (l1, _, K, P, *branches), (mass, com, _, inverse), gravity = model
    X, M_inverse, by_pose = np.eye(6), np.eye(6) / mass, np.zeros((6, 6))
    X[:3, 3:] = -hat(np.array([-com[0], -com[1], l1 - com[2]]))
    M_inverse[3:, 3:] = np.reshape(inverse, (3, 3))
    by_pose[:3, 3:] = hat(gravity)
    of_K, of_P = (np.asarray(-M_inverse @ X.T @ symmetric_matrix(M)) for M in (K, P))
    by_pose += (1.0 + sum(r for r, _ in branches)) * of_K @ X
    size = 12 + 6 * len(branches)
    A = np.eye(size, k=6)
    A[6:], A[6:12, :6], A[6:12, 6:12] = 0.0, by_pose, of_P @ X
    for k, (r, tau) in zip(range(12, size, 6), branches, strict=True):
        A[6:12, k:k + 6] = -0.5 * r * of_K
        A[k:k + 6, :6], A[k:k + 6, k:k + 6] = 2.0 * X / tau, -np.eye(6) / tau
    return A


def system_matrix(model: ModelTuple, tool: State, body: State) -> Array:
    """
    Return the matrix (12, 12) of small motions about a state at rest.

    The state is displacement and twist of B in body axes; eigenvalues are the package's modes
    (rad/s). A cup that relaxes has 12 more states, its internal strains (24, 24).
    """
    by, strains = linearise(model, tool, body), np.ravel(body[4:])
    by_pose = _slope(lambda e: kernels.lip_strain(model, tool, moved_by(body, e)))[:, :6]
    size = 12 + len(strains)
    A = np.eye(size, k=6)
    A[6:], A[6:12, :6], A[6:12, 6:12] = 0.0, by.body_pose, by.body_twist
    A[6:12, 12:] = _slope(lambda e: acceleration(
        model, tool, kernels.with_strains(body, kernels.strains_of(strains + e))), len(strains))
    for k, (_, tau) in zip(range(12, size, 6), model[0][4:], strict=True):
        A[k:k + 6, :6], A[k:k + 6, k:k + 6] = by_pose / tau, -np.eye(6) / tau
    return A


def sag(model: ModelTuple) -> float:
    """Return the shift (m) of a package under its weight in the softest direction."""
    softest = float(np.linalg.eigvalsh(np.reshape(model[0][2][0], (3, 3)))[0])
    return model[1][0] * math.hypot(*model[2]) / softest


def largest_step(model: ModelTuple, A: Array | None = None) -> float:
    """
    Return the longest integration step (s) that keeps RK4 accurate for the fastest mode.

    A is the `nominal_system_matrix` of the model, if available.
    """
    A = nominal_system_matrix(model) if A is None else A
    fastest = float(np.abs(np.linalg.eigvals(A)).max())
    return PHASE_PER_STEP / fastest if fastest > 0.0 else math.inf


@kernel
def substeps_for(duration: float, longest_step: float) -> int:
    """Return the number of integration steps for a time between two tool samples."""
    return max(1, math.ceil(duration / longest_step - 1e-9))


_MAX_MOVE = 0.3  # m or rad, of one iteration
_DIFFERENCE = 1e-6  # m or rad


def static_equilibrium(model: ModelTuple, tool: State, guess: State | None = None) -> State:
    """
    Return the state in which the package hangs at rest from a tool at rest (3.9).

    From the nominal pose the load grows in steps, each solved by Newton's method, which leads to
    the equilibrium of a real cup among several equilibria. With a guess of the package at rest,
    the full load is applied at once. The search is in tool axes, so the position of the tool has
    no effect.

    Raises
    ------
    UnstableError
        If no equilibrium exists: the cup is too soft for the package in this tool pose.

    """
    start, loads = resting_on_tool(model, ORIGIN), 8
    if guess is not None:
        shift = t3.apply_transposed(t3.rotation_matrix(tool[1]), t3.subtract(guess[0], tool[0]))
        rotation = t3.quaternion_product(t3.quaternion_conjugate(tool[1]), guess[1])
        start, loads = (shift, rotation, ZERO, ZERO), 1
    at_rest = (model[0][:4], *model[1:])  # without internal strains
    body, is_stable = _loaded(at_rest, tool, start[:4], loads, np.zeros((6, 6)), np.zeros(6))
    if not is_stable:
        raise UnstableError(
            f'No static equilibrium: the cup cannot hold {model[1][0]:g} kg in this tool pose '
            'without tipping over. Check package.mass, package.com, cup.stiffness and their '
            'units.')
    return adapted(model, (tool[0], tool[1], *ORIGIN[2:]), body)


@entry
def _loaded(
    model: ModelTuple, tool: State, body: State, loads: int, A: Any, x: Any
) -> tuple[State, bool]:
    """Apply the load in steps to a body in tool axes; return its rest and its stability."""
    stable, R_world_tool = False, t3.rotation_matrix(tool[1])
    gravity = t3.apply_transposed(R_world_tool, model[2])
    for load in range(1, loads + 1):
        now = (model[0], model[1], t3.scale(load / loads, gravity))
        size = math.inf
        for _ in range(50):  # Newton's method
            for j in range(6):
                rotation, back = t3.unit(j - 3, _DIFFERENCE), t3.unit(j - 3, -_DIFFERENCE)
                up = _unbalance(now, displaced(body, t3.unit(j, _DIFFERENCE), rotation))
                down = _unbalance(now, displaced(body, t3.unit(j, -_DIFFERENCE), back))
                for i in range(6):
                    A[i, j] = (down[i] - up[i]) / (2.0 * _DIFFERENCE)
            force = _unbalance(now, body)
            for i in range(6):
                x[i] = force[i]
            before = size
            size, stable = _solve(A, x)
            if not size < math.inf:
                return body, False
            part = _MAX_MOVE / size if size > _MAX_MOVE else 1.0
            body = displaced(
                body, (part * x[0], part * x[1], part * x[2]),
                (part * x[3], part * x[4], part * x[5]))
            if (size < 1e-9 and size > 0.1 * before) or size < 1e-13:  # rounding errors
                break
        if size >= 1e-9:
            return body, False
    position = t3.add(tool[0], t3.apply(R_world_tool, body[0]))
    return (position, t3.quaternion_product(tool[1], body[1]), body[2], body[3]), stable


@kernel
def _solve(A: Any, x: Any) -> tuple[float, bool]:
    """
    Write A^-1 x into x by Gauss elimination; return its norm, and whether all pivots are positive.

    At rest A is the Hessian of the energy, so positive pivots mean a minimum.
    """
    stable, square = True, 0.0
    for k in range(6):
        if A[k, k] == 0.0:
            return math.inf, False
        stable = stable and A[k, k] > 0.0
        for i in range(k + 1, 6):
            c = A[i, k] / A[k, k]
            for j in range(k, 6):
                A[i, j] -= c * A[k, j]
            x[i] -= c * x[k]
    for k in range(5, -1, -1):
        for j in range(k + 1, 6):
            x[k] -= A[k, j] * x[j]
        x[k] /= A[k, k]
        square += x[k] * x[k]
    return math.sqrt(square), stable


@kernel
def _unbalance(model: ModelTuple, body: State) -> tuple[float, float, float, float, float, float]:
    """Return residual force and moment on a package at rest under a tool at rest."""
    package = model[1]
    dv, dw = kernels.body_acceleration(model, ORIGIN, body)
    f, m = t3.scale(package[0], dv), t3.apply(package[2], dw)
    return f[0], f[1], f[2], m[0], m[1], m[2]
