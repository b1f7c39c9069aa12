"""
The cup's length from standstills (4.2), and their part of a fit.

Lengths of the cup under several loads, extrapolated, give its length without load.
"""

from collections.abc import Sequence
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.identification.result import FALSE_ALARMS
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.errors import UndeterminedError, UnexplainedError
import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.special import chdtrc

UPRIGHT_TOLERANCE = np.radians(2.0)
"""Largest angle (rad) of the cup's axis from the vertical for measuring the cup length."""

MASSES_FOR_CUBIC = 5
"""Smallest number of different masses for a cubic of length against load (4.2)."""

MAX_SCATTER = 0.25
"""Largest scatter about the line, relative to the elongation by the loads."""

MAX_LENGTH_STD = 1e-4
"""Largest acceptable standard error of the cup length, m."""


class CupLength(NamedTuple):
    """
    The cup's length without load (4.2).

    Parameters
    ----------
    length, length_std : float
        l0 and its standard error, m; infinite without degrees of freedom.
    chi2, degrees_of_freedom : float, int
        Chi^2 of the fit, and its degrees of freedom.
    stiffness : float
        Axial stiffness at no load, N/m.
    loads, lengths, errors : ndarray (N,)
        Load (N), length (m) and its standard error (m) of every used standstill.
    coefficients : ndarray
        Coefficients of the polynomial, m, m/N, m/N^2, m/N^3.
    pick_std : float
        Standard deviation of the length between picks of one mass, m; NaN with too few picks.
    com_std : float
        Standard deviation of the given centre of mass along the cup, m, if its poses are measured;
        a shift of the centre of mass shifts the lip.

    """

    length: float
    length_std: float
    chi2: float
    degrees_of_freedom: int
    stiffness: float
    loads: Array
    lengths: Array
    errors: Array
    coefficients: Array
    pick_std: float
    com_std: float = 0.0

    @property
    def total_std(self) -> float:
        """Standard error of the length with the error of the centre of mass, m."""
        return float(np.hypot(self.length_std, self.com_std))

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings on the length."""
        count = self.degrees_of_freedom
        by = f'{1e3 * self.length_std:.2f} mm' if np.isfinite(self.length_std) else (
            'an unknown amount, as only two masses were held')
        numbers = {'size': float(np.sqrt(self.chi2 / max(count, 1))), 'by': by,
                   'load': float(self.loads.min())}
        return tuple(Finding(code, Level.WARN, numbers) for code, applies in (
            ('wrong_mass', count and chdtrc(count, self.chi2) < FALSE_ALARMS),
            ('uncertain_length', not self.length_std <= MAX_LENGTH_STD)) if applies)


def cup_length_of(standstills: Sequence[Standstill], gravity: float) -> CupLength:
    """
    Return the cup's length without load from standstills of several masses (4.2).

    Length against load is a line, or a cubic if a line contradicts the errors; its value at no
    load is l0. Repeated picks of a mass determine the scatter between picks, an additional
    error of each standstill.

    Parameters
    ----------
    standstills : sequence of Standstill
        Standstills; those with a tilted cup are omitted.
    gravity : float
        Gravitational acceleration, m/s^2.

    Raises
    ------
    UndeterminedError
        If there are fewer than two different masses with the cup's axis vertical.
    UnexplainedError
        If no line fits.

    """
    measured = np.reshape([
        (still.payload.mass * gravity, -still.lip[2], max(still.error.position, 1e-9))
        for still in standstills if still.tilt <= UPRIGHT_TOLERANCE], (-1, 3))
    loads, lengths, errors = measured.T
    groups = _groups(loads)
    different = len(set(groups.tolist()))
    if different < 2:
        raise UndeterminedError(
            'The cup length needs two or more different masses, held with the tool '
            f'vertical, but there {"is" if different == 1 else "are"} {different}. Record '
            'standstills with other known masses, and give the mass of each.')
    pick = _pick_scatter(measured, groups)
    scattered = np.column_stack([loads, lengths, np.hypot(errors, np.nan_to_num(pick))])
    coefficients, std, chi2, degrees_of_freedom = _polynomial(scattered, 1)
    if different >= MASSES_FOR_CUBIC and chdtrc(degrees_of_freedom, chi2) < FALSE_ALARMS:
        coefficients, std, chi2, degrees_of_freedom = _polynomial(scattered, 3)
    fitted = polyval(loads, coefficients)
    scatter, stretch = float(np.sqrt(np.mean((lengths - fitted)**2))), float(np.ptp(fitted))
    if not coefficients[1] > 0.0 or scatter > MAX_SCATTER * stretch:
        raise UnexplainedError(
            f'No line fits length against load: it changes by {1e3 * stretch:.2g} mm from the '
            f'lightest to the heaviest mass, {"up" if coefficients[1] > 0.0 else "down"}, and '
            f'the lengths scatter by {1e3 * scatter:.2g} mm about it. Check each mass, and that '
            'the poses are those of E and S.')
    return CupLength(
        float(coefficients[0]), std, chi2, degrees_of_freedom,
        float(1.0 / coefficients[1]),
        loads, lengths, errors, coefficients, pick)


def _groups(loads: Array) -> Places:
    """Return the index (N,) of each standstill's group of equal loads, in the order of load."""
    order = np.argsort(loads)
    number = np.empty(len(loads), dtype=np.int64)
    # N: masses within 1 g are equal
    number[order] = np.cumsum(np.diff(loads[order], prepend=loads[order][:1]) > 1e-2)
    return number


def _pick_scatter(measured: Array, groups: Places) -> float:
    """Return the scatter of lengths of equal masses beyond their errors, m, or NaN."""
    _, lengths, errors = measured.T
    means = np.array([lengths[groups == group].mean() for group in groups])
    degrees_of_freedom = len(lengths) - len(set(groups.tolist()))
    if degrees_of_freedom < 3:
        return float('nan')
    variance = float(np.sum((lengths - means)**2)) / degrees_of_freedom - float(np.mean(errors**2))
    return float(np.sqrt(max(variance, 0.0)))


def _polynomial(measured: Array, degree: int) -> tuple[Array, float, float, int]:
    """
    Return a weighted polynomial's coefficients, error at no load, chi^2, and freedom.

    Measured (N, 3) are load, length and its error. Scatter about the polynomial counts if larger
    than the errors explain. Repeated loads do not test the polynomial: the error is infinite
    without other loads.
    """
    loads, lengths, errors = measured.T
    x, covariance = np.polyfit(loads, lengths, degree, w=1.0 / errors, cov='unscaled')
    is_tested = _groups(loads).max() > degree
    degrees_of_freedom = len(loads) - degree - 1 if is_tested else 0
    chi2 = float(np.sum(((lengths - np.polyval(x, loads)) / errors) ** 2))
    scatter = max(chi2 / degrees_of_freedom, 1.0) if degrees_of_freedom else np.inf
    return x[::-1], float(np.sqrt(scatter * covariance[-1, -1])), chi2, degrees_of_freedom
