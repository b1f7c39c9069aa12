"""
Standstills as equations for K, to be solved together with those of a motion.

At rest the spring alone balances gravity (3.9): c(q) = L(q) k, with k the entries of K and q the
lip's pose. Near a guess k0, whose equilibrium is q0, a measured pose is

    q = q0 + G^-1 L(q0) (k - k0) + error,  G = d(c - L k0) / dq,

six equations that are linear in K. L is that of the equilibrium and not of the measured pose,
whose noise would look like strain where there is no load. The errors of the mean pose, and of the
cup's length, whiten the equations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification.equations import covariance_of, information_of
from bellows_ros.core.identification.result import definiteness_warnings, Fit, StandstillPart
from bellows_ros.core.identification.samples import lip_relative, needed_wrench
from bellows_ros.core.lie import apply, exp_so3
from bellows_ros.core.model import regressor
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.core.structure import Structure, structure_named
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

STEP = 1e-6
"""Step of numerical derivatives of the balance, m and rad."""

NEWTON_STEPS, LARGEST_MOVE = 6, 0.05
"""Newton steps to an equilibrium near a measured pose, and the longest one (m, rad)."""

NO_EFFECT = 1e-3
"""A change of an entry by its own size that moves poses by fewer standard errors has no effect."""

SMALLEST_ERROR = (1e-7, 1e-6)
"""Smallest standard error of a mean pose (m, rad): rounding, and the error of the model."""

ROUNDS = 4
"""Rounds of whitening with the latest K and reweighting by the residuals."""

LARGEST_CHI2 = 4.0
"""Chi^2 per degree of freedom above which standstills contradict each other."""


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
    k = structure.parameters(stiffness, stiffness)[:structure.size]
    poses = [_Balance(still, structure, gravity) for still in standstills]
    parts = [pose.equations(cup_length, k) for pose in poses]
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
    fit: Fit, standstills: Sequence[Standstill], length: Length, gravity: float, typical: Array
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
        Of motions; entries that these do not tell may have infinite variances.
    standstills : sequence of Standstill
        Of the same cup.
    length : Length
        Nominal length l0 of that fit, with its standard error, 0 where it is exact.
    gravity : float
        m/s^2 along -z of the world.
    typical : ndarray (6, 6)
        Stiffness that stands for entries that the motions do not tell, in weights only.

    """
    structure = structure_named(fit.structure)
    x0 = structure.parameters(fit.stiffness, fit.damping)
    moving = np.hstack([np.eye(len(x0)), -length.std * length.jacobian[:, None]])
    J = information_of(fit.covariance)
    prior = moving.T @ J @ moving
    prior[-1, -1] += 1.0
    weight, z, covariance = 1.0, np.append(x0, 0.0), fit.covariance
    for _ in range(ROUNDS):
        guess = _guess(structure, z[:-1], covariance, typical)
        of_K, b, by_length = static_equations(
            standstills, length.value, structure, gravity, guess)
        A = np.hstack([of_K, np.zeros_like(of_K), length.std * by_length[:, None]])
        whole = covariance_of(prior + weight * A.T @ A)
        z = _minimum(np.append(x0, 0.0), prior, weight, A, b, whole)
        chi2 = _chi2(A, b - A @ z, weight, whole)
        weight, covariance = 1.0 / max(chi2, 1.0), whole[:-1, :-1]
    before = fit.covariance + length.std**2 * np.outer(length.jacobian, length.jacobian)
    found = StandstillPart(
        len(standstills), chi2, _narrowed(before, covariance),
        length.value + length.std * float(z[-1]), length.std * float(np.sqrt(whole[-1, -1])),
    )
    return _with(fit, structure, z[:-1], covariance, found)


def _guess(structure: Structure, x: Array, covariance: Array, typical: Array) -> Array:
    """Return K (6, 6) for whitening, with typical values for entries that are not identifiable."""
    if structure.couples:
        return structure.matrices(x)[0]
    known = np.isfinite(np.diag(covariance)) & (x > 0.0)
    return structure.matrices(np.where(known, x, structure.parameters(typical, typical)))[0]


def _chi2(A: Array, left: Array, weight: float, covariance: Array) -> float:
    """Return the residual squares of the equations per degree of freedom."""
    known = np.isfinite(np.diag(covariance))
    finite = np.where(np.outer(known, known), covariance, 0.0)
    used = weight * float(np.trace(A @ finite @ A.T))
    return float(left @ left) / max(len(left) - used, 1.0)


def _disagreement(chi2: float) -> tuple[str, ...]:
    """Return a sentence where standstills do not agree with the motions or among themselves."""
    if chi2 <= LARGEST_CHI2:
        return ()
    return (
        'The static recordings and the motion disagree beyond their errors (chi^2 per degree of '
        f'freedom {chi2:.3g}, expected 1), so the static recordings get less weight. Check '
        'cup.length, the masses in static.files, package.com and the alignment. The noise bias '
        'of least squares may also be the cause: use fit.method: prediction_error.',
    )


def _minimum(
    x0: Array, J: Array, weight: float, A: Array, b: Array, covariance: Array
) -> Array:
    """Return the parameters at the minimum, unchanged in directions without information."""
    index = np.flatnonzero(np.isfinite(np.diag(covariance)))
    part = (J + weight * A.T @ A)[np.ix_(index, index)]
    scale = np.sqrt(np.diag(part))
    slope = weight * A[:, index].T @ (b - A @ x0)
    step = np.linalg.solve(part / np.outer(scale, scale), slope / scale) / scale
    x = x0.copy()
    x[index] += step
    return x


def _with(
    fit: Fit, structure: Structure, x: Array, covariance: Array, found: StandstillPart
) -> Fit:
    """Return a fit with other parameters, and the contribution of the standstills."""
    stiffness, damping = structure.matrices(x)
    old = definiteness_warnings(fit.stiffness, fit.damping, fit.structure)
    new = definiteness_warnings(stiffness, damping, fit.structure)
    stiffness_std, damping_std = structure.spread(np.sqrt(np.diag(covariance)))
    return replace(
        fit, stiffness=stiffness, damping=damping, stiffness_std=stiffness_std,
        damping_std=damping_std, covariance=covariance,
        warnings=(*new, *(text for text in fit.warnings if text not in old),
                  *_disagreement(found.chi2)),
        standstills=found,
    )


def _narrowed(before: Array, after: Array) -> Array:
    """Return new standard errors over old ones."""
    old, new = (np.sqrt(np.diag(covariance)) for covariance in (before, after))
    ratio = np.ones(len(old))
    some = np.isfinite(new) & (old > 0.0)
    ratio[some] = np.where(np.isfinite(old[some]), new[some] / old[some], 0.0)
    return ratio


@dataclass(frozen=True, eq=False)
class _Balance:
    """The balance of a standstill."""

    standstill: Standstill
    structure: Structure
    gravity: float

    def equations(self, cup_length: float, k: Array) -> tuple[Array, Array, Array]:
        """Return A (6, n) and b (6,) in pose coordinates, and the effect of the length (6,)."""
        moved = self._equilibrium(cup_length, k)
        L, c, G = self._balance(cup_length, k, moved)
        jacobian = np.asarray(np.linalg.solve(G, L), dtype=np.float64)
        ends = [self._equilibrium(cup_length + side, k) for side in (STEP, -STEP)]
        by_length = np.asarray((ends[0] - ends[1]) / (2.0 * STEP), dtype=np.float64)
        return jacobian, jacobian @ k - moved, by_length

    def _equilibrium(self, cup_length: float, k: Array) -> Array:
        """Return shift and rotation (6,) from the measured lip to the equilibrium."""
        moved = np.zeros(6)
        for _ in range(NEWTON_STEPS):
            L, c, G = self._balance(cup_length, k, moved)
            step = np.linalg.solve(G, L @ k - c)
            moved = moved + step * min(1.0, LARGEST_MOVE / max(float(np.abs(step).max()), 1e-12))
        return moved

    def _balance(self, cup_length: float, k: Array, moved: Array) -> tuple[Array, Array, Array]:
        """Return L (6, n), c (6,) and the slope G (6, 6) of c - L k at a displaced lip."""
        moves = moved + STEP * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
        found, com = self.standstill, self.standstill.payload.com
        R = found.package.rotation[0]
        lip = found.package.position[0] - R @ com
        turned = R @ exp_so3(moves[:, 3:])
        position = lip + moves[:, :3] @ R.T + apply(turned, com)
        stamps, still = np.arange(len(moves)), np.zeros((len(moves), 6))
        at, turn = (np.repeat(part, len(moves), axis=0)
                    for part in (found.tool.position, found.tool.rotation))
        package = Trajectory(stamps, position, turned, still, still)
        o, R_E_S, twist = lip_relative(Trajectory(stamps, at, turn, still), package, com)
        L = regressor(cup_length, self.structure.basis, o, R_E_S, twist)
        L = L[:, :, :self.structure.size]
        c = needed_wrench(found.payload, package, self.gravity)
        residual = c - L @ k
        G = np.asarray((residual[1:7] - residual[7:]).T / (2.0 * STEP))
        return L[0], c[0], G
