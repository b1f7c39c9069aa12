"""
The result of a fit, with its uncertainty and its warnings.

A parameter with a component in an unidentifiable direction has infinite variance, no covariances,
and zero information.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from bellows_ros.core import findings
from bellows_ros.core.geometry.arrays import Array
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


def remedy_for(label: str, structure: Structure) -> str:
    """Return the remedy for an unidentifiable number, with regard to a gripper's other cups."""
    axis = label.split()[1]
    if structure.places and axis.startswith('r'):
        return 'Identify one cup alone, as the other cups bear most of it'
    return EXCITATION.get(axis, 'Move all axes at once')


UNITS = {'K': ('N/m', 'N', 'N m/rad'), 'P': ('N s/m', 'N s', 'N m s/rad')}
"""Units of entries of K and P: translation, coupling, rotation."""

WRENCH_UNITS = ('N',) * 3 + ('N m',) * 3
POSE_UNITS = ('m',) * 3 + ('rad',) * 3


def parameter_units(structure: Structure) -> tuple[str, ...]:
    """Return the units (2 n,) of a structure's parameters, in the order of its labels."""
    return tuple(
        UNITS[matrix][(row > 2) + (column > 2)]
        for matrix in 'KP' for row, column in structure.leads)


MAX_RELATIVE_ERROR = 0.5
"""Largest relative standard error of an identifiable parameter."""


CHANCE = 3.0
"""Largest deviation by chance, standard deviations; false-alarm rate 1 in 370."""

MAX_NOISE_SHARE = 0.5
"""Largest share of noise in the information on an identifiable number, or in its error."""

MATERIAL = 0.02
"""Smallest relative change of an entry of K that makes a cup wrong."""

DISTINCT = 0.5
"""Share of the misfit, and of the likeliest cause's share, above which a cause or its rival
counts."""


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
            self.share >= DISTINCT and self.moved > MATERIAL))


class Iteration(NamedTuple):
    """One step of a minimisation: its number, chi^2 per residual, K and P."""

    number: int
    chi2: float
    stiffness: Array
    damping: Array


class Freed(NamedTuple):
    """Estimates of one name in fit.free, SI units."""

    name: str
    change: tuple[float, ...]
    std: tuple[float, ...]


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
    weight : ndarray (6, 6)
        Inverse covariance of the residuals: W of (4.66) at the lip, or of the innovations.
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
    iterations : tuple of Iteration
        Steps to the minimum; empty for least squares.
    delays, delays_std : tuple of float
        Delays (s) of each recording's tool stamps behind the package's, if requested, and their
        standard errors, inf if not identifiable.
    freed : tuple of Freed
        Other estimates: com and length as changes, m; inertia and mass as logarithms of factors;
        standard error inf if not identifiable.
    standstills : (int, float) or None
        Number of standstills in the fit, and chi^2 of their deviations per number, 1 if the errors
        of the mean poses explain them, above 1 with less weight; None without any.
    relaxation, relaxation_std : (float, float)
        Strengths r1, r2 of the cup's relaxation, and their standard errors; zeros without it.
    noise_in_motion : mapping
        Standard deviations (6,) of the package's poses by number of the recording, m and rad, if
        they were estimated and are larger than at rest.
    stretch, stretch_std : (float, float)
        Coefficients a, b of the cup's stretch (N/m^2, N), and their standard errors; zeros without
        stretch.
    causes : tuple of Cause
        Possible causes of the residual of output error, the likeliest first.
    from_given : ndarray (2 n, 2 n) or None
        Additional covariance by the given quantities' standard deviations; None for none.
    held_out : ndarray (2 n,) or None
        Parameters without the last fifth of each recording; None for least squares.
    nuisances : mapping
        Other quantities estimated jointly with K and P, by names of `KINDS`: changes, SI units, a
        row for each recording or one for all; without those in `freed`.
    nuisances_std : mapping
        Standard deviations of the nuisances, including the uncertainty of given quantities.

    """

    method: str
    structure: str
    parameters: Array
    covariance: Array
    samples_used: int
    samples_rejected: int
    condition_number: float
    weight: Array
    residual_rms: Array
    notes: tuple[findings.Finding, ...] = ()
    misfit: findings.Finding | None = None
    converged: bool = True
    chi2: float | None = None
    robust_chi2: float | None = None
    iterations: tuple[Iteration, ...] = ()
    delays: tuple[float, ...] = ()
    delays_std: tuple[float, ...] = ()
    freed: tuple[Freed, ...] = ()
    standstills: tuple[int, float] | None = None
    relaxation: tuple[float, float] = (0.0, 0.0)
    relaxation_std: tuple[float, float] = (0.0, 0.0)
    noise_in_motion: Mapping[int, Array] = field(default_factory=dict)
    stretch: tuple[float, float] = (0.0, 0.0)
    stretch_std: tuple[float, float] = (0.0, 0.0)
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

    @property
    def residual_units(self) -> tuple[str, ...]:
        """Units (6,) of the residuals."""
        return WRENCH_UNITS if self.method == 'least_squares' else POSE_UNITS

    @cached_property
    def _indefinite(self) -> tuple[findings.Finding, ...]:
        return definiteness_findings(self.stiffness, self.damping, self.structure)

    @property
    def findings(self) -> tuple[findings.Finding, ...]:
        """Findings on the estimation."""
        return (*self._indefinite, *self.notes)

    @property
    def usable(self) -> bool:
        """Whether the fit is a minimum usable for prediction: K definite, P semidefinite."""
        return self.converged and not self._indefinite


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
