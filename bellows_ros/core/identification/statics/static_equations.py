"""
Standstills as equations for K, to be solved together with those of a motion.

At rest the spring alone balances gravity (3.9): the acceleration a(q, k) is zero, with k the
entries of K and q the lip's pose. Near a guess k0, whose equilibrium is q0, a measured pose is

    q = q0 - (da/dq)^-1 da/dk (k - k0) + error,

six equations that are linear in K. The derivatives are those at the equilibrium and not at the
measured pose, whose noise would look like strain where there is no load. The errors of the mean
pose, and of the cup's length, whiten the equations.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import (
    adjoint,
    dexp_inverse,
    log_so3,
    quaternion_to_rotation,
    rotation_to_quaternion,
    transform,
)
from bellows_ros.core.identification.equations import covariance_of, information_of
from bellows_ros.core.identification.result import Fit, StandstillPart
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple
from bellows_ros.core.model.equilibrium import displaced, linearise
from bellows_ros.core.model.jacobians import parameter_jacobian
from bellows_ros.core.model.kernels import body_acceleration
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.errors import BellowsError
import numpy as np

NEWTON_STEPS, LARGEST_MOVE = 6, 0.05
"""Newton steps to an equilibrium near a measured pose, and the longest one (m, rad)."""

NO_EFFECT = 1e-3
"""A change of an entry by its own size that moves poses by fewer standard errors has no effect."""

SMALLEST_ERROR = (1e-7, 1e-6)
"""Smallest standard error of a mean pose (m, rad): rounding, and the error of the model."""

ROUNDS = 4
"""Rounds of whitening with the latest K and reweighting by the residuals."""

LARGEST_CHI2 = 4.0
"""Chi^2 per degree of freedom above which standstills contradict the motions or each other."""

DISAGREEMENT = (
    'The static recordings and the motion disagree beyond their errors (chi^2 per degree of '
    'freedom {:.3g}, expected 1), so the static recordings get less weight. Check cup.length, the '
    'masses in static.files, package.com and the alignment. The noise bias of least squares may '
    'also be the cause: use fit.method: output_error.')


def static_equations(
    standstills: Sequence[Standstill], cup_length: float, structure: Structure, gravity: float,
    stiffness: Array,
) -> tuple[Array, Array, Array]:
    """
    Return A (6 H, n), b (6 H,) and g (6 H,) of b = A k + g dl, in errors of the mean poses.

    But for errors of unit variance; dl is by how much the nominal length is off, m.

    Parameters
    ----------
    standstills : sequence of Standstill
        H of them.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Of K; k are its n free entries.
    gravity : float
        m/s^2 along -z of the world.
    stiffness : ndarray (6, 6)
        A guess of K, by which errors of poses become errors of wrenches.

    Raises
    ------
    BellowsError
        If there is no standstill.

    """
    if not standstills:
        raise BellowsError('Static equations need at least one standstill.')
    parts = [_equations(still, cup_length, structure, gravity, stiffness) for still in standstills]
    A, b, by_length = (np.concatenate(part) for part in zip(*parts, strict=True))
    errors = np.array([still.error for still in standstills])
    error = np.repeat(np.maximum(errors, SMALLEST_ERROR), 3, axis=1).ravel()
    A, b, by_length = A / error[:, None], b / error, by_length / error
    large = structure.sizes(stiffness, stiffness)[:structure.size]
    A[:, np.linalg.norm(A, axis=0) * large < NO_EFFECT] = 0.0
    return A, b, by_length


class Length(NamedTuple):
    """
    An uncertain nominal length, and its effect on a fit of motions.

    Its value and standard error (m), and the derivatives (2 n,) of the parameters by it.
    """

    value: float
    std: float
    jacobian: Array


def joined_with_standstills(
    fit: Fit, standstills: Sequence[Standstill], length: Length, gravity: float, typical: Array,
    places: tuple[tuple[float, ...], ...] = (),
) -> Fit:
    """
    Return a fit of motions combined with standstills, each by its own covariance.

    With the information J of the motions about their estimate x0 + s (l - l0), it minimises
    |x - x0 - s (l - l0)|^2 in J, |b - A x - g (l - l0)|^2 and (l - l0)^2 over its variance
    together: what fitting all equations at once would give. Standstills that fit worse than their
    errors explain are trusted by as much less.

    Parameters
    ----------
    fit : Fit
        Of motions; entries that are not identifiable from these have infinite variances.
    standstills : sequence of Standstill
        Of the same cup.
    length : Length
        Nominal length l0 of that fit, with its standard error, 0 where it is exact.
    gravity : float
        m/s^2 along -z of the world.
    typical : ndarray (6, 6)
        Stiffness that stands for entries that are not identifiable, in weights only.
    places : tuple of (x, y, z, index)
        Of the cups of a gripper (m, in E), of which the fit is of one.

    """
    structure = replace(structure_named(fit.structure), places=places)
    x0 = fit.parameters
    moving = np.hstack([np.eye(len(x0)), -length.std * length.jacobian[:, None]])
    J = information_of(fit.covariance)
    prior = moving.T @ J @ moving
    prior[-1, -1] += 1.0
    start = np.append(x0, 0.0)
    weight, z, covariance = 1.0, start, fit.covariance
    for _ in range(ROUNDS):
        guess = _guess(structure, z[:-1], covariance, typical)
        of_K, b, by_length = static_equations(
            standstills, length.value, structure, gravity, guess)
        A = np.hstack([of_K, np.zeros_like(of_K), length.std * by_length[:, None]])
        whole = covariance_of(prior + weight * A.T @ A)
        known = np.where(np.isfinite(whole), whole, 0.0)  # what is not stays as it is
        z = start + known @ (weight * A.T @ (b - A @ start))
        degrees = len(b) - weight * float(np.trace(A @ known @ A.T))
        chi2 = float(np.sum((b - A @ z) ** 2)) / max(degrees, 1.0)
        weight, covariance = 1.0 / max(chi2, 1.0), whole[:-1, :-1]
    before = fit.covariance + length.std**2 * np.outer(length.jacobian, length.jacobian)
    with np.errstate(divide='ignore', invalid='ignore'):
        narrowed = np.sqrt(np.diag(covariance) / np.diag(before))
    found = StandstillPart(
        len(standstills), chi2, np.nan_to_num(narrowed, nan=1.0, posinf=1.0),
        length.value + length.std * float(z[-1]), length.std * float(np.sqrt(whole[-1, -1])),
    )
    return replace(
        fit, parameters=z[:-1], covariance=covariance, standstills=found,
        notes=(*fit.notes, *([DISAGREEMENT.format(chi2)] if chi2 > LARGEST_CHI2 else [])))


def _guess(structure: Structure, x: Array, covariance: Array, typical: Array) -> Array:
    """Return K (6, 6) for whitening, with typical values for entries that are not identifiable."""
    if structure.couples:
        return structure.matrices(x)[0]
    known = np.isfinite(np.diag(covariance)) & (x > 0.0)
    return structure.matrices(np.where(known, x, structure.parameters(typical, typical)))[0]


def _equations(
    still: Standstill, cup_length: float, structure: Structure, gravity: float, stiffness: Array
) -> tuple[Array, Array, Array]:
    """Return A (6, n) and b (6,) in coordinates of the lip, and the effect of the length (6,)."""
    x = structure.parameters(stiffness, stiffness)
    cup = gripper_of(
        Cup(structure.matrices(x)[0], np.zeros((6, 6)), cup_length), structure.places)
    model = model_tuple(cup, still.payload, gravity)
    tool, body = (
        state_row(own.position[0], rotation_to_quaternion(own.rotation[0]))
        for own in (still.tool, still.package))
    for _ in range(NEWTON_STEPS):
        step = -np.linalg.solve(linearise(model, tool, body).body_pose,
                                np.concatenate(body_acceleration(model, tool, body)))
        step *= min(1.0, LARGEST_MOVE / max(float(np.abs(step).max()), 1e-12))
        body = displaced(body, tuple(step[:3].tolist()), tuple(step[3:].tolist()))
    changes: Array = np.empty((6, 43))  # by the entries of K and P, and by the length
    parameter_jacobian(model, tool, body, 0, 43, changes, 0)
    of_body = np.linalg.solve(linearise(model, tool, body).body_pose, -changes)
    of_lip = adjoint(transform(np.eye(3), still.payload.com)) @ of_body
    R, R_there = still.package.rotation[0], quaternion_to_rotation(np.array(body[1]))
    turn = log_so3(R.T @ R_there)
    way = (body[0] - R_there @ still.payload.com
           - still.package.position[0] + R @ still.payload.com)
    changes = np.vstack([R.T @ R_there @ of_lip[:3], dexp_inverse(-turn) @ of_lip[3:]])
    A = changes[:, :21] @ structure.upper[:21, :structure.size]
    return A, A @ x[:structure.size] - np.concatenate([R.T @ way, turn]), changes[:, 42]
