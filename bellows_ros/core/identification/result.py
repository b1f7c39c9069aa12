"""
The result of a fit, and the information matrices from which its uncertainty follows.

A parameter with a component in an unidentifiable direction has infinite variance, no covariances,
and zero information.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any, NamedTuple

from bellows_ros.core import findings
from bellows_ros.core.geometry.arrays import Array, Mask, Places
from bellows_ros.core.model.cup_package import LAW, TERMS
from bellows_ros.core.model.structure import ROUNDING, Structure, structure_named, STRUCTURES
import numpy as np

EXCITATION: Mapping[str, str] = {
    'x': 'Move the tool along x, or tilt it about y, at 1 to 3 Hz',
    'y': 'Move the tool along y, or tilt it about x, at 1 to 3 Hz',
    'z': 'Move the tool up and down at 4 to 6 Hz',
    'rx': 'Tilt the tool about x, or move it along y, at 1 to 3 Hz',
    'ry': 'Tilt the tool about y, or move it along x, at 1 to 3 Hz',
    'rz': 'Turn the tool about z at 1 to 3 Hz'}
"""Motion that makes the numbers of a direction identifiable."""


def not_identifiable(
    label: str, structure: Structure, why: str, given: str = ''
) -> findings.Finding:
    """Return the finding on an unidentifiable number, with regard to a gripper's other cups."""
    axis = label.split()[1]
    how = EXCITATION.get(axis, 'Move all axes at once')
    if structure.places and axis.startswith('r'):
        how = 'Identify one cup alone, as the other cups bear most of it'
    return findings.Finding('not_identifiable', findings.Level.WARN, {
        'label': label, 'why': why, 'how': how, 'given': given})


UNITS = {'K': TERMS['stiffness'].units, 'P': TERMS['damping'].units}
"""Units of entries of K and P: translation, coupling, rotation."""

MAX_RELATIVE_ERROR = 0.5
"""Largest relative standard error of an identifiable parameter."""


CHANCE = 3.0
"""Largest deviation by chance, standard deviations; false-alarm rate 1 in 370."""

FALSE_ALARMS = 1e-3
"""False-alarm rate of a test for an effect that changes the result: one sound fit in a
thousand."""

MATERIAL = 0.02
"""Smallest relative change of an entry of K that makes a cup wrong."""

MAJORITY = 0.5
"""Share above which one part decides: noise in information or in an error, a cause or an extension
in a misfit, a rival in the likeliest cause."""


class Cause(NamedTuple):
    """
    A confirmed or possible deviation from a given quantity or setting.

    Parameters
    ----------
    name, value : str
        Name of the cause: a name of fit.free, a parameter, or a property of the cup; and its
        correct setting, or the body of a marker, '' for freed quantities.
    theta, std : ndarray (n,)
        Estimates of the freed quantities, and their standard errors.
    share : float
        Share of the chi² beyond noise that the cause explains.
    moved : float
        Largest relative change of an identifiable diagonal entry of K.
    datum, certain : bool
        Whether the cause is a given quantity, and whether no other cause explains the recordings
        as well.
    instead : str
        Name or value of another given quantity that cannot be distinguished from the cause; '' for
        none.

    """

    name: str
    value: str
    theta: Array = np.empty(0)
    std: Array = np.empty(0)
    share: float = 1.0
    moved: float = 0.0
    datum: bool = True
    certain: bool = True
    instead: str = ''

    @property
    def material(self) -> bool:
        """
        Whether the cup is wrong without the cause.

        A certain error of a given quantity makes K uncertain by more than its standard errors; a
        slip is harmless where K is equal without it.
        """
        return self.datum and (self.certain and self.name != 'slip' or (
            self.share >= MAJORITY and self.moved > MATERIAL))


NO_LAW = {name: (0.0,) * len(term.symbols) for name, term in LAW.items()}
"""Numbers of the terms of the law by name, of a cup without them."""


@dataclass(frozen=True, eq=False)
class Fit:
    """
    K and P estimated from recordings.

    Parameters
    ----------
    method : str
        Method of fit.method.
    structure : str
        Name of the structure of K and P.
    parameters : ndarray (2 n,)
        Free parameters, first of K, then of P, SI units.
    covariance : ndarray (2 n, 2 n)
        Covariance of the parameters by the recordings alone; unidentifiable ones have inf on the
        diagonal and 0 elsewhere.
    samples_used, samples_rejected : int
        Numbers of used and of omitted samples.
    condition_number : float
        Condition number of the whitened regressor with columns of unit length.
    residual_rms : ndarray (6,)
        RMS of the residual wrench (N, N m) or pose (m, rad).
    notes : tuple of str
        Findings on the estimation.
    misfit : Finding or None
        Misfit of model and white noise.
    converged : bool
        Whether the search converged; if not, all standard errors are infinite.
    chi2, robust_chi2 : float or None
        Chi^2 per degree of freedom of the whitened differences; and chi^2 from their median,
        insensitive to outliers and heavy tails, relative to the noise of slow poses at rest if
        larger; None for least squares.
    named : tuple of str
        Names of the nuisances that the user requested.
    law, law_std : mapping
        Numbers of the terms of `LAW`, and their standard errors, by name; zeros without a term.
    noise_in_motion : mapping
        Standard deviations (6,) of the package's poses by number of the recording, m and rad, if
        they were estimated and are larger than at rest.
    causes : tuple of Cause
        Possible causes of the residual of output error, the likeliest first.
    from_given : ndarray (2 n, 2 n) or None
        Additional covariance by the given quantities' standard deviations; None for none.
    held_out : ndarray (2 n,) or None
        Parameters without the last fifth of each recording; None for least squares.
    nuisances : mapping
        Other quantities estimated jointly with K and P, by names of `KINDS`: changes, SI units, a
        row for each recording or one for all; mass and inertia as logarithms of factors.
    nuisances_std : mapping
        Standard deviations of the nuisances, including the uncertainty of given quantities; inf
        for requested ones that are not identifiable.

    """

    method: str
    structure: str
    parameters: Array
    covariance: Array
    samples_used: int
    samples_rejected: int
    condition_number: float
    residual_rms: Array
    notes: tuple[findings.Finding, ...] = ()
    misfit: findings.Finding | None = None
    converged: bool = True
    chi2: float | None = None
    robust_chi2: float | None = None
    named: tuple[str, ...] = ()
    law: Mapping[str, tuple[float, ...]] = field(default_factory=NO_LAW.copy)
    law_std: Mapping[str, tuple[float, ...]] = field(default_factory=NO_LAW.copy)
    noise_in_motion: Mapping[int, Array] = field(default_factory=dict)
    causes: tuple[Cause, ...] = ()
    from_given: Array | None = None
    held_out: Array | None = None
    nuisances: Mapping[str, Array] = field(default_factory=dict)
    nuisances_std: Mapping[str, Array] = field(default_factory=dict)

    @cached_property
    def _errors(self) -> tuple[Array, Array]:
        more = 0.0 if self.from_given is None else np.diag(self.from_given)
        return structure_named(self.structure).spread(np.sqrt(np.diag(self.covariance) + more))

    @cached_property
    def stiffness(self) -> Array:
        """K (6, 6) of (3.17) in SI units, linear first."""
        return structure_named(self.structure).matrices(self.parameters)[0]

    @cached_property
    def damping(self) -> Array:
        """P (6, 6) of (3.33) in SI units, linear first."""
        return structure_named(self.structure).matrices(self.parameters)[1]

    @property
    def terms(self) -> dict[str, Any]:
        """Fitted terms of one cup, by attribute of `Cup`."""
        return {'stiffness': self.stiffness, 'damping': self.damping, **self.law}

    @property
    def stiffness_std(self) -> Array:
        """Standard errors (6, 6) of K with given quantities: 0 if fixed, inf if unidentifiable."""
        return self._errors[0]

    @property
    def damping_std(self) -> Array:
        """Standard errors (6, 6) of P with given quantities: 0 if fixed, inf if unidentifiable."""
        return self._errors[1]

    @property
    def exactly_given(self) -> 'Fit':
        """The fit with the standard errors from the recordings alone."""
        return replace(self, from_given=None)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names (2 n,) of the parameters."""
        return structure_named(self.structure).labels

    @cached_property
    def indefinite(self) -> tuple[findings.Finding, ...]:
        """Findings on indefinite matrices."""
        return definiteness_findings(self.stiffness, self.damping, self.structure)

    @property
    def findings(self) -> tuple[findings.Finding, ...]:
        """Findings on the estimation."""
        return (*self.indefinite, *self.notes)

    @property
    def usable(self) -> bool:
        """Whether the fit is a minimum usable for prediction: K definite, P semidefinite."""
        return self.converged and not self.indefinite


def definiteness_findings(
    stiffness: Array, damping: Array, structure: str
) -> tuple[findings.Finding, ...]:
    """Return a finding for each indefinite matrix."""
    simplest = next(iter(STRUCTURES.values()))
    simpler = (f', or set fit.structure: {simplest.name}'
               if structure_named(structure).size > simplest.size else '')
    smallest = [float(np.linalg.eigvalsh(matrix)[0]) for matrix in (stiffness, damping)]
    refused = (smallest[0] <= 0.0, smallest[1] < -ROUNDING * float(np.abs(damping).max()))
    return tuple(
        findings.Finding('indefinite', findings.Level.WARN, {
            'name': name, 'value': value, 'simpler': simpler})
        for name, value, is_refused in zip(
            ('stiffness K is not positive definite', 'damping P is not positive semidefinite'),
            smallest, refused, strict=True) if is_refused)


MAX_CONDITION = 1e6
"""Largest ratio of singular values of identifiable combinations of parameters."""

IN_NULL_SPACE = 0.05
"""Largest component of an identifiable parameter in the null space."""


def inverted(information: Array, unit: Array) -> tuple[Array, Mask, float]:
    """
    Return the inverse of an information matrix (p, p) up to its rank (4.74).

    Further results are the mask (p,) of the identifiable parameters, and the condition number of
    the regressor with columns in units of their sizes (p,), infinite without effect.
    """
    scale = np.outer(unit, unit)
    values, V = np.linalg.eigh(information / scale)
    used = values > values[-1] / MAX_CONDITION**2
    condition = float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else np.inf
    return ((V[:, used] / values[used]) @ V[:, used].T / scale,
            ~np.any(np.abs(V[:, ~used]) > IN_NULL_SPACE, axis=1), condition)


def with_unidentifiable(covariance: Array, unidentifiable: Mask) -> Array:
    """Return a covariance with some parameters (n,) unidentifiable."""
    identifiable = ~unidentifiable
    result = np.where(np.outer(identifiable, identifiable), covariance, 0.0)
    result[np.diag_indices_from(result)] = np.where(identifiable, np.diag(covariance), np.inf)
    return result


@dataclass(frozen=True, eq=False)
class Arrow:
    """
    A symmetric matrix (m, m) without coupling between own unknowns of two recordings.

    The own unknowns of each recording are eliminated separately (Schur complement): work and
    memory grow linearly with the number of recordings.

    Parameters
    ----------
    shared : ndarray (s, s)
        Information on the shared unknowns.
    coupling : ndarray (R, o, s)
        Information between own unknowns of each of R recordings and the shared ones.
    own : ndarray (R, o, o)
        Information on the own unknowns of each recording.
    places : int ndarray (R, o)
        Indices of the own unknowns among all.

    """

    shared: Array
    coupling: Array
    own: Array
    places: Places

    def add(self, number: int, information: Array) -> None:
        """Add information (s + o, s + o) of a recording in place."""
        size = len(self.shared)
        self.shared[:] += information[:size, :size]
        self.coupling[number] += information[size:, :size]
        self.own[number] += information[size:, size:]

    def damped(self, damping: float) -> 'Arrow':
        """Return the matrix with its diagonal increased by a fraction."""
        return replace(self, shared=self.shared * (1.0 + damping * np.eye(len(self.shared))),
                       own=self.own * (1.0 + damping * np.eye(self.own.shape[1])))

    def raised(self, diagonal: Array) -> 'Arrow':
        """Return the matrix with its diagonal increased by numbers (m,)."""
        return replace(self, shared=self.shared + np.diag(diagonal[:len(self.shared)]), own=(
            self.own + diagonal[self.places][:, :, None] * np.eye(self.own.shape[1])))

    def times(self, x: Array) -> Array:
        """Return the product with a vector (m,)."""
        y, own, size = np.empty_like(x), x[self.places], len(self.shared)
        y[:size] = self.shared @ x[:size] + np.einsum('ros,ro->s', self.coupling, own)
        y[self.places] = self.coupling @ x[:size] + np.einsum('rop,rp->ro', self.own, own)
        return y

    @cached_property
    def carried(self) -> Array:
        """Negative change (R, o, s) of own unknowns per unit of shared ones, at the minimum."""
        return np.asarray(np.linalg.solve(self.own, self.coupling))

    @cached_property
    def reduced(self) -> Array:
        """Information (s, s) on the shared unknowns, with the own ones eliminated."""
        return np.asarray(self.shared - np.einsum('ros,rot->st', self.coupling, self.carried))

    def followed(self, g: Array) -> Array:
        """Return the slope (s,) along shared unknowns, with own ones following."""
        return np.asarray(g[:len(self.shared)] - np.einsum(
            'ros,ro->s', self.carried, g[self.places]))

    def solve(self, g: Array) -> Array:
        """Return the solution (m,) with a right-hand side (m,)."""
        x, size = np.empty_like(g), len(self.shared)
        x[:size] = np.linalg.solve(self.reduced, self.followed(g))
        x[self.places] = np.linalg.solve(
            self.own, g[self.places][..., None])[..., 0] - self.carried @ x[:size]
        return x

    @cached_property
    def covariance(self) -> Array:
        """Covariance (s, s) of the shared unknowns."""
        return np.asarray(np.linalg.inv(self.reduced))

    def block(self, number: int) -> Array:
        """Return the covariance (q, q) of the shared unknowns and the own ones of a recording."""
        crossed = -self.carried[number] @ self.covariance
        own = np.linalg.inv(self.own[number]) - crossed @ self.carried[number].T
        return np.block([[self.covariance, crossed.T], [crossed, own]])

    def variances_with(self, shared: Array, factor: float = 1.0) -> Array:
        """Return variances (m,) of all unknowns, with a covariance (s, s) of the shared ones."""
        variances = np.empty(len(shared) + self.places.size)
        variances[:len(shared)] = np.diag(shared)
        variances[self.places] = np.einsum(
            'roo->ro', factor * np.linalg.inv(self.own)) + np.einsum(
            'ros,st,rot->ro', self.carried, shared, self.carried, optimize=True)
        return variances

    @cached_property
    def variances(self) -> Array:
        """Variances (m,) of the unknowns."""
        return self.variances_with(self.covariance)

    def within(self, used: Mask) -> 'Arrow':
        """Return the matrix with the identity for unused unknowns (m,)."""
        a, b = used[:len(self.shared)], used[self.places]
        return replace(
            self, shared=np.where(np.outer(a, a), self.shared, np.eye(len(a))),
            coupling=np.where(b[:, :, None] & a, self.coupling, 0.0),
            own=np.where(b[:, :, None] & b[:, None], self.own, np.eye(b.shape[1])))

    def fall(self, g: Array, used: Mask) -> float:
        """Return the fall of chi² if the used unknowns (m,) follow a slope (m,)."""
        slope = np.where(used, g, 0.0)
        try:
            return float(slope @ self.within(used).solve(slope))
        except np.linalg.LinAlgError:  # diverging simulation
            return math.nan


def symmetric_roots(M: Array) -> tuple[Array, Array]:
    """Return the symmetric root of a definite matrix, and its inverse."""
    values, vectors = np.linalg.eigh(M)
    root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
