"""
Comparison of two fits of a cup: differences, their significance, and whether they matter.

And of several, each of another recording: whether they are of the same cup.

A difference is significant where the standard errors of both fits do not explain it; it matters
where it changes the predicted motion: rest poses, natural frequencies, damping, response to a
shake. The standard errors of these follow from those of the parameters by first derivatives.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import adjoint, log_so3, quaternion_to_rotation, transform
from bellows_ros.core.identification import result
from bellows_ros.core.identification.result import Fit, information_of, NOTES
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import linearise, static_equilibrium
from bellows_ros.core.model.kernels import ORIGIN
from bellows_ros.core.model.simulation import simulate, state_row
from bellows_ros.core.model.structure import common_structure, Structure, structure_named
from bellows_ros.core.signals.residuals import relative_coordinates
from bellows_ros.core.synthetic.motion import Oscillation, Pose
import numpy as np
import scipy  # whose parts are loaded as they are used
from scipy.linalg import block_diag
from scipy.special import chdtrc, ndtr

SIGNIFICANT_P_VALUE = 0.05
"""p-value below which a difference is significant."""

TILT = 0.35
"""Tilt of the tool for the second rest pose, rad: 20 degrees."""

SHAKE = Oscillation(
    Pose(np.zeros(3), np.eye(3)), 0.0, 0.5, 2.0, np.repeat([5e-3, 0.05 / np.sqrt(3.0)], 3),
    np.arange(6), np.full((6, 2), 3.0), np.append(np.arange(3) * 2.0 * np.pi / 3.0, np.zeros(3)))
"""A tool that swings like that of the thesis, at 3 Hz in all directions, out of step."""

SHAKE_RATE_HZ = 240.0

MATERIAL_CHANGE = {'m': 1e-4, 'rad': 1e-3, 'Hz': 0.02, '': 0.10}
"""
By units: the smallest material change of a pose, which is the resolution of motion capture, and
the smallest relative one of a natural frequency and of a damping ratio.
"""

MIN_FREQUENCY_SEPARATION = 0.02
"""Natural frequencies closer than this fraction have no unique mode shapes."""

AXES_PART = 1e-6
"""Fraction of the damping's trace added to align degenerate mode shapes with the axes."""

STEP = 1e-4
"""Relative step of the derivatives by parameters."""

ORDINALS = ('first', 'second', 'third', 'fourth', 'fifth', 'sixth')

DIRECTIONS = ('lateral', 'lateral', 'axial', 'bending', 'bending', 'torsion')
"""Of the six axes."""


class Fitted(NamedTuple):
    """
    The part of a fit that a comparison needs.

    Parameters
    ----------
    structure : Structure
        Form of K and P.
    cup : Cup
        K, P and l0.
    covariance : ndarray (2 n, 2 n)
        Of the free parameters, in the order of the structure's labels; may hold inf or NaN for
        parameters that are not determined.

    """

    structure: Structure
    cup: Cup
    covariance: Array


class Change(NamedTuple):
    """
    One number in both fits.

    Parameters
    ----------
    name, unit : str
        What it is.
    before, after : float
        Its values.
    before_std, after_std : float
        Standard errors; infinite where the data say nothing.
    matters : bool
        Whether the change is so large that it matters, be it chance or not.

    """

    name: str
    unit: str
    before: float
    after: float
    before_std: float
    after_std: float
    matters: bool = False

    @property
    def percent(self) -> float:
        """Change in percent of the value before."""
        return 100.0 * (self.after / self.before - 1.0) if self.before else float('nan')

    @property
    def standard_errors(self) -> float:
        """Change in standard errors of the difference of independent fits; NaN if unknown."""
        std = float(np.hypot(self.before_std, self.after_std))
        if std == 0.0:
            return float('nan')
        return (self.after - self.before) / std if np.isfinite(std) else 0.0

    @property
    def p_value(self) -> float:
        """Probability of so large a change by chance."""
        return float(2.0 * ndtr(-abs(self.standard_errors)))

    @property
    def significant(self) -> bool:
        """Whether chance does not explain it."""
        return self.p_value < SIGNIFICANT_P_VALUE


class FitComparison(NamedTuple):
    """
    The differences between two fits.

    Parameters
    ----------
    parameters : tuple of Change
        Entries of K and P of the richer structure of both.
    effects : tuple of Change
        Rest poses, natural frequencies and damping ratios with the same package.
    shake_rms : ndarray (6,)
        RMS difference of the predicted motion relative to the tool under a shake, m and rad.
    p_value : float
        Probability of so large a change of all parameters together by chance.

    """

    parameters: tuple[Change, ...]
    effects: tuple[Change, ...]
    shake_rms: Array
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether chance does not explain the changes of the parameters together."""
        return self.p_value < SIGNIFICANT_P_VALUE

    @property
    def shake_matters(self) -> bool:
        """Whether the predicted motion differs by more than motion capture sees."""
        shift, angle = self.shake_rms[:3].max(), self.shake_rms[3:].max()
        return bool(shift > MATERIAL_CHANGE['m'] or angle > MATERIAL_CHANGE['rad'])

    @property
    def matters(self) -> bool:
        """Whether predictions differ materially and significantly."""
        return self.shake_matters and self.significant or any(
            effect.matters and effect.significant for effect in self.effects)

    @property
    def open_effects(self) -> tuple[Change, ...]:
        """Effects that differ by an amount that would matter, but may do so by chance."""
        return tuple(e for e in self.effects if e.matters and not e.significant)


def compare_fits(before: Fitted, after: Fitted, package: Package, gravity: float) -> FitComparison:
    """
    Compare two fits of a cup, and their predictions for a package.

    Parameters
    ----------
    before, after : Fitted
        The two; taken as independent of each other.
    package : Package
        What the cups are to hold.
    gravity : float
        m/s^2 along -z of the world.

    Raises
    ------
    BellowsError
        If one of the cups cannot hold the package.

    """
    structure = common_structure(before.structure, after.structure)
    fits = (before, after)
    values = [structure.parameters(fit.cup.stiffness, fit.cup.damping) for fit in fits]
    covariances = [_propagated(fit.structure.within(structure), fit.covariance) for fit in fits]
    columns = (column.tolist() for column in (*values, *map(_standard_errors, covariances)))
    changes = tuple(map(Change, structure.labels, result.parameter_units(structure), *columns))
    tool = SHAKE.at_rate(SHAKE_RATE_HZ)
    moved = [relative_coordinates(tool, simulate(fit.cup, package, tool, gravity=gravity))
             for fit in fits]
    covariance, difference = covariances[0] + covariances[1], values[1] - values[0]
    information = information_of(covariance)
    degrees = round(np.trace(information @ np.where(np.isfinite(covariance), covariance, 0.0)))
    return FitComparison(
        changes, _effects(before, after, package, gravity),
        np.sqrt(np.mean((moved[1] - moved[0]) ** 2, axis=0)),
        float(chdtrc(degrees, difference @ information @ difference)) if degrees else np.nan)


class Mode(NamedTuple):
    """
    A mode of small motions about the package at rest.

    Parameters
    ----------
    direction : str
        In which most of the elastic energy is.
    frequency, damping : float
        Natural frequency (Hz) and damping ratio.
    shape : ndarray (6,)
        Displacement of B times the root of the mass matrix: shapes of one package are orthonormal.

    """

    direction: str
    frequency: float
    damping: float
    shape: Array


def modes(cup: Cup, package: Package, gravity: float, like: Sequence[Mode] = ()) -> list[Mode]:
    """
    Return the six modes, lowest first; or each in the place of the one it is most like.

    They are those of small undamped motions about where the package hangs from an upright tool at
    rest, under gravity (m/s^2): its weight pulls a bent cup straight, as it does a pendulum. With
    the modes scaled to unit modal mass, the damping ratio is phi^T C phi / (2 omega): exact where
    damping is proportional, and to first order otherwise. The name is that of the direction, at
    the middle of the cup where its spring is (3.13), in which most of the elastic energy is.
    Modes whose frequencies coincide have no unique shapes: they get those in which damping
    does not couple them.
    """
    model = model_tuple(cup, package, gravity)
    jacobian = linearise(model, ORIGIN, static_equilibrium(model, ORIGIN))
    mass = block_diag(package.mass * np.eye(3), package.inertia)
    root = np.linalg.cholesky(mass)
    inverse = np.linalg.inv(root)
    stiffness = -inverse @ (mass @ jacobian.body_pose) @ inverse.T
    damping = -inverse @ (mass @ jacobian.body_twist) @ inverse.T
    stiffness = 0.5 * (stiffness + stiffness.T)
    middle_body = adjoint(transform(np.eye(3), package.com - [0.0, 0.0, 0.5 * cup.length]))
    all_modes = []
    for shape in _shapes(stiffness, 0.5 * (damping + damping.T)).T:
        omega = float(np.sqrt(max(shape @ stiffness @ shape, 0.0)))
        ratio = float(shape @ damping @ shape) / (2.0 * omega) if omega else float('inf')
        middle = middle_body @ (inverse.T @ shape)
        energy = dict.fromkeys(DIRECTIONS, 0.0)
        for direction, part in zip(DIRECTIONS, middle * (cup.stiffness @ middle), strict=True):
            energy[direction] += abs(part)
        all_modes.append(Mode(
            max(energy, key=energy.__getitem__), omega / (2.0 * np.pi), ratio, shape))
    if not like:
        return all_modes
    return [all_modes[i] for i in scipy.optimize.linear_sum_assignment(
        [[-abs(float(a.shape @ b.shape)) for b in all_modes] for a in like])[1]]


def _shapes(stiffness: Array, damping: Array) -> Array:
    """Return orthonormal eigenvectors of the stiffness; of equal ones those of the damping."""
    squares, vectors = np.linalg.eigh(stiffness)
    apart = np.diff(squares) > 2.0 * MIN_FREQUENCY_SEPARATION * np.abs(squares[1:])
    axes = np.diag(np.arange(6.0)) * AXES_PART * float(np.trace(damping))
    for group in np.split(np.arange(6), np.flatnonzero(apart) + 1):
        inside = vectors[:, group]
        vectors[:, group] = inside @ np.linalg.eigh(inside.T @ (damping + axes) @ inside)[1]
    return np.asarray(vectors)


def _propagated(jacobian: Array, covariance: Array) -> Array:
    """Return the covariance of a quantity with Jacobian (m, n); inf stays infinite."""
    finite = np.isfinite(np.diag(covariance))
    part = jacobian[:, finite]
    unknown = np.any(jacobian[:, ~finite] != 0.0, axis=1)
    return np.asarray(part @ covariance[np.ix_(finite, finite)] @ part.T
                      + np.diag(np.where(unknown, np.inf, 0.0)))


def _standard_errors(covariance: Array) -> Array:
    """Return standard errors."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _effects(
    before: Fitted, after: Fitted, package: Package, gravity: float
) -> tuple[Change, ...]:
    """Return the changes in the cups' effects on the package."""
    like = modes(before.cup, package, gravity)
    tilted = f'tool tilted by {np.degrees(TILT):.0f} deg'
    kinds = [('shift of the lip at rest, hanging', 'm'),
             (f'shift of the lip at rest, {tilted}', 'm'),
             (f'turn of the lip at rest, {tilted}', 'rad')]
    for ordinal, mode in zip(ORDINALS, like, strict=True):
        name = f'{ordinal} mode ({mode.direction})'
        kinds += [(f'frequency of the {name}', 'Hz'), (f'damping ratio of the {name}', '')]

    def values(cup: Cup) -> Array:
        """Return the effects of a cup."""
        hanging, tilted = (_rest(cup, package, gravity, angle) for angle in (0.0, TILT))
        return np.array([hanging[0], *tilted, *(
            x for mode in modes(cup, package, gravity, like)
            for x in (mode.frequency, mode.damping))])

    sides = [numbers for fit in (before, after)
             for numbers in (values(fit.cup).tolist(), _errors_of(values, fit).tolist())]
    changes = []
    for (name, unit), old, old_std, new, new_std in zip(kinds, *sides, strict=True):
        size = abs(new - old) / (1.0 if unit in ('m', 'rad') else abs(old))
        changes.append(
            Change(name, unit, old, new, old_std, new_std, size > MATERIAL_CHANGE[unit]))
    return tuple(changes)


def _rest(cup: Cup, package: Package, gravity: float, angle: float) -> tuple[float, float]:
    """Return the displacement (m) and rotation (rad) of the lip at rest from its nominal pose."""
    tool = state_row(np.zeros(3), (np.sin(0.5 * angle), 0.0, 0.0, np.cos(0.5 * angle)))
    body = static_equilibrium(model_tuple(cup, package, gravity), tool)
    R_world_tool, R = quaternion_to_rotation(np.array([tool[1], body[1]]))
    o_E_S = R_world_tool.T @ (np.array(body[0]) - R @ package.com)
    return (float(np.linalg.norm(o_E_S + [0.0, 0.0, cup.length])),
            float(np.linalg.norm(log_so3(R_world_tool.T @ R))))


def _errors_of(values: Callable[[Cup], Array], fit: Fitted) -> Array:
    """
    Return the standard errors of numbers that a cup determines, by central differences.

    Modes are those about a rest that itself moves with K: their derivatives are second ones of
    the wrench, and `jacobians` gives the first.
    """
    x = fit.structure.parameters(fit.cup.stiffness, fit.cup.damping)
    steps = np.diag(STEP * fit.structure.sizes(*fit.structure.matrices(x)))
    ends = [[values(Cup(*fit.structure.matrices(x + end), fit.cup.length)) for end in (s, -s)]
            for s in steps]
    jacobian = np.column_stack([
        (up - down) / (2.0 * step.sum()) for (up, down), step in zip(ends, steps, strict=True)])
    return _standard_errors(_propagated(jacobian, fit.covariance))


DIFFERENCE_P_VALUE = 0.01
"""p-value below which the cups differ."""

SIGNIFICANT_ERRORS = 3.0
"""Standard errors above which the difference of a single parameter is significant."""

MATERIAL_DIFFERENCE = 0.05
"""Smallest material relative difference of a parameter from the mean."""


class Consistency(NamedTuple):
    """
    Outcome of the test.

    Parameters
    ----------
    probability : float
        Of a larger Wald's chi^2 if all cups are the same.
    deviations : ndarray (n, p)
        Of each fit from the weighted mean, in its standard errors; 0 where not identifiable.
    probability_stiffness, probability_damping : float
        The same probability for K alone, and for P alone; NaN where nothing can be compared.
    verdict : str
        In words.

    """

    probability: float
    deviations: Array
    probability_stiffness: float
    probability_damping: float
    verdict: str

    @property
    def differs(self) -> bool:
        """Whether the cups differ significantly and materially."""
        return self.probability < DIFFERENCE_P_VALUE


def same_cup(fits: Sequence[Fit], names: Sequence[str]) -> Consistency:
    """
    Test whether independent fits of one structure have the same K and P.

    Parameters
    ----------
    fits : sequence of Fit
        At least two of one structure, of different recordings.
    names : sequence of str
        Their names, such as the packages' masses.

    """
    structure = structure_named(fits[0].structure)
    sizes = structure.sizes(fits[0].stiffness, fits[0].damping)
    sizes[sizes == 0.0] = 1.0
    relative = np.array([fit.parameters for fit in fits]) / sizes
    covariances = np.array([fit.covariance for fit in fits]) / np.outer(sizes, sizes)
    mean, probability = _weighted_mean(relative, covariances)
    parts = [_weighted_mean(relative[:, part], covariances[:, part, part])[1]
             for part in (slice(0, structure.size), slice(structure.size, None))]
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    away = np.where(np.isfinite(std), relative - mean, 0.0)
    deviations = away / np.where(std > 0.0, std, np.inf)
    part_of_mean = np.divide(away, mean, out=np.zeros_like(away), where=mean != 0.0)
    verdict = _verdict(fits[0].labels, names, part_of_mean, deviations, probability, parts)
    return Consistency(probability, deviations, parts[0], parts[1], verdict)


def _weighted_mean(x: Array, covariances: Array) -> tuple[Array, float]:
    """Return the weighted mean (p,), and the chance of more scatter, NaN without a comparison."""
    weights = np.array([information_of(covariance) for covariance in covariances])
    covariance = result.covariance_of(weights.sum(axis=0))
    finite = np.isfinite(np.diag(covariance))
    mean = np.where(np.outer(finite, finite), covariance, 0.0) @ np.einsum('nij,nj', weights, x)
    statistic = np.einsum('ni,nij,nj', x - mean, weights, x - mean)
    compared = np.isfinite(np.diagonal(covariances, axis1=1, axis2=2))
    degrees = np.count_nonzero(compared) - np.count_nonzero(finite)
    return mean, float(chdtrc(degrees, statistic)) if degrees else np.nan


def _verdict(
    labels: Sequence[str], names: Sequence[str], relative: Array, deviations: Array, p: float,
    parts: Sequence[float],
) -> str:
    """Return the outcome in words."""
    both = ' and '.join(names)
    if np.isnan(p):
        return NOTES['not_comparable']
    if p >= DIFFERENCE_P_VALUE:
        return NOTES['one_cup'].format(names=both, chance=p)
    row, column = divmod(int(np.argmax(np.abs(deviations))), deviations.shape[1])
    size = float(relative[row, column])
    differ = [name for name, p_value in zip('KP', parts, strict=True)
              if p_value < DIFFERENCE_P_VALUE]
    significant = relative[np.abs(deviations) > SIGNIFICANT_ERRORS]
    is_material = np.any(np.abs(significant) > MATERIAL_DIFFERENCE)
    return NOTES['other_cups'].format(
        chance=p, which=f'{differ[0]} is' if len(differ) == 1 else 'K and P are', names=both,
        label=labels[column], name=names[row], part=abs(size) * 100,
        side='above' if size > 0 else 'below', errors=abs(deviations[row, column]),
        meaning=NOTES['material' if is_material else 'immaterial'].format(
            part=MATERIAL_DIFFERENCE * 100))
