"""
The cup's length from standstills (4.2), and a check of its spring.

The spring is checked pose by pose. Lengths of the cup under several loads, extrapolated, give its
length without load.

Standstills are equations for K, solved jointly with the equations of a motion. At rest the spring
alone balances gravity (3.9): the acceleration a(q, k) is zero, with the entries k of K and the
pose q of the lip. Near a guess k0, whose equilibrium is q0, a measured pose is

    q = q0 - (da/dq)^-1 da/dk (k - k0) + error,

six equations that are linear in K. Derivatives are taken at the equilibrium: at the measured pose,
noise would resemble strain without a load. The errors of mean pose and cup length whiten the
equations.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places
from bellows_ros.core.identification import result
from bellows_ros.core.identification.result import Fit, NOTES
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple
from bellows_ros.core.model.equilibrium import displaced, linearise, static_equilibrium
from bellows_ros.core.model.jacobians import parameter_jacobian
from bellows_ros.core.model.kernels import body_acceleration, State
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.recording.alignment import Remark
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import UndeterminedError, UnexplainedError, UnstableError
import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.special import chdtrc

UPRIGHT_TOLERANCE = np.radians(2.0)
"""Largest angle (rad) of the cup's axis from the vertical for measuring the cup length."""

MASSES_FOR_CUBIC = 5
"""Smallest number of different masses for a cubic of length against load (4.2)."""

MAX_SCATTER = 0.25
"""Largest scatter about the line, relative to the elongation by the loads."""

MIN_STIFFNESS, MAX_STIFFNESS = 100.0, 1e6
"""Range of the axial stiffness of cups, N/m."""

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
    linear_load : float
        Load up to which the spring is linear, N; at most the largest measured load.
    loads, lengths, errors : ndarray (N,)
        Load (N), length (m) and its standard error (m) of every used standstill.
    coefficients : ndarray
        Coefficients of the polynomial, m, m/N, m/N^2, m/N^3.
    pick_std : float
        Standard deviation of the length between picks of one mass, m; NaN with too few picks.
    com_std : float
        Standard deviation of the given centre of mass along the cup, m, if its poses are measured:
        a shift of it shifts the lip.

    """

    length: float
    length_std: float
    chi2: float
    degrees_of_freedom: int
    stiffness: float
    linear_load: float
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
    def remarks(self) -> tuple[Remark, ...]:
        """Remarks on the length, by their codes in the texts 'static'."""
        masses, count = len(set(_groups(self.loads).tolist())), self.degrees_of_freedom
        told, known = np.isfinite([self.pick_std, self.length_std])
        numbers = {
            'size': float(np.sqrt(self.chi2 / max(count, 1))), 'masses': masses,
            'enough': MASSES_FOR_CUBIC, 'std': self.length_std, 'load': float(self.loads.min())}
        return tuple(Remark(code, numbers) for code, applies in (
            ('wrong_mass' if told else 'scatter_or_wrong_mass',
             count and chdtrc(count, self.chi2) < 0.01),
            ('two_masses', not known),
            ('straight', known and masses < MASSES_FOR_CUBIC),
            ('uncertain_length', MAX_LENGTH_STD < self.length_std < np.inf)) if applies)


def cup_length_of(standstills: Sequence[Standstill], gravity: float) -> CupLength:
    """
    Return the cup's length without load from standstills of several masses (4.2).

    Length against load is a line, or a cubic if it predicts held-out masses better; its value at
    no load is l0. Repeated picks of a mass determine the scatter between picks, an additional
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
    degree = 1
    if different >= MASSES_FOR_CUBIC:
        straight, cubic = (_cross_validation_error(scattered, groups, order)
                           for order in (1, 3))
        degree = 3 if cubic < 0.8 * straight else 1
    coefficients, std, chi2, degrees_of_freedom = _polynomial(scattered, degree)
    fitted = polyval(loads, coefficients)
    scatter, stretch = float(np.sqrt(np.mean((lengths - fitted)**2))), float(np.ptp(fitted))
    if not coefficients[1] > 0.0 or scatter > MAX_SCATTER * stretch:
        raise UnexplainedError(
            f'No line fits length against load: it changes by {1e3 * stretch:.2g} mm from the '
            f'lightest to the heaviest mass, {"up" if coefficients[1] > 0.0 else "down"}, and '
            f'the lengths scatter by {1e3 * scatter:.2g} mm about it. Check each mass, and that '
            'the poses are those of E and S.')
    stiffness = float(1.0 / coefficients[1])
    if not MIN_STIFFNESS < stiffness < MAX_STIFFNESS:
        raise UndeterminedError(
            f'From {loads.min():.4g} to {loads.max():.4g} N the cup is '
            f'{1e3 * lengths.min():.2f} to {1e3 * lengths.max():.2f} mm long, a stiffness of '
            f'{stiffness:.3g} N/m; expected {MIN_STIFFNESS:g} to {MAX_STIFFNESS:g}. Check each '
            'mass (kg) and their order.')
    return CupLength(
        float(coefficients[0]), std, chi2, degrees_of_freedom, stiffness,
        _linear_range(coefficients, float(loads.max())), loads, lengths, errors,
        coefficients, pick)


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


def _cross_validation_error(measured: Array, groups: Places, degree: int) -> float:
    """Return the summed squared errors (m^2) of predictions of each mass from the others."""
    total = 0.0
    for out in (groups == group for group in np.unique(groups)):
        loads, lengths, _ = measured[out].T
        coefficients = _polynomial(measured[~out], degree)[0]
        total += float(np.mean(lengths - polyval(loads, coefficients)) ** 2)
    return total


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


def _linear_range(coefficients: Array, largest: float) -> float:
    """Return the load (N) up to which a polynomial stays near its tangent at no load."""
    loads = np.linspace(0.0, largest, 1001)[1:]
    tangent = coefficients[0] + coefficients[1] * loads
    bent = np.abs(polyval(loads, coefficients) - tangent) > 0.05 * np.abs(
        coefficients[1] * loads)
    return float(loads[int(np.argmax(bent))]) if bent.any() else largest


class PoseCheck(NamedTuple):
    """
    Predicted and measured equilibrium in one pose of the tool.

    Parameters
    ----------
    standstill : Standstill
        The measured standstill.
    measured, predicted : ndarray (6,)
        Deflection of the lip in the tool from nominal, m and rad; predicted is nan if the cup
        cannot carry the package.
    verdict : str
        'within noise', 'good', 'off' or 'no equilibrium'.

    """

    standstill: Standstill
    measured: Array
    predicted: Array
    verdict: str


def is_off(pose: PoseCheck) -> bool:
    """Return whether the spring model contradicts a pose."""
    return pose.verdict in ('off', 'no equilibrium')


def check_pose(cup: Cup, still: Standstill, gravity: float) -> PoseCheck:
    """
    Compare the measured equilibrium of a standstill with the equilibrium of the model (3.9).

    Gravity (m/s^2) points along -z of the world; damping has no effect.
    """
    nominal = np.array([0.0, 0.0, -cup.length, 0.0, 0.0, 0.0])
    measured = still.lip - nominal
    try:
        position, q = static_equilibrium(
            model_tuple(cup, still.payload, gravity), _state(still.tool))[:2]
    except UnstableError:
        return PoseCheck(still, measured, np.full(6, np.nan), 'no equilibrium')
    predicted = replace(still, package=Trajectory(
        still.package.stamps_ns, np.array([position]),
        lie.quaternion_to_rotation(np.array([q])))).lip - nominal
    deviation, size = np.linalg.norm(
        np.reshape([predicted - measured, measured], (2, 2, 3)), axis=2)
    is_beyond = deviation > 3.0 * np.sqrt(3.0) * np.array(still.error)
    is_wrong = is_beyond & (deviation > 0.05 * size)
    return PoseCheck(still, measured, predicted, (
        'off' if is_wrong.any() else 'good' if is_beyond.any() else 'within noise'))


def _state(body: Trajectory) -> State:
    """Return the state at rest in the first pose of a body."""
    return state_row(body.position[0], lie.rotation_to_quaternion(body.rotation[0]))


MIN_STANDSTILL_STD = (1e-7, 1e-6)
"""Smallest standard error of a mean pose, by rounding and model error, m and rad."""


class Length(NamedTuple):
    """
    An uncertain cup length, and its effect on a fit of motions.

    They are its value and standard error (m), and the derivatives (2 n,) of the parameters by it.
    """

    value: float
    std: float
    jacobian: Array


def joined_with_standstills(
    fit: Fit, standstills: Sequence[Standstill], length: Length, gravity: float, given: Cup,
    places: tuple[tuple[float, ...], ...] = (),
) -> Fit:
    """
    Return a fit of motions combined with standstills, weighted by their covariances.

    With the information J of the motions about their estimate x0 + s (l - l0), the sum of |x - x0
    - s (l - l0)|^2 in J, |b - A x - g (l - l0)|^2, and (l - l0)^2 over its variance is minimised,
    as in a joint fit of all equations. Chi^2 above its expectation reduces the weight of the
    standstills.

    Parameters
    ----------
    fit : Fit
        Fit of motions; entries that motions do not identify have infinite variances.
    standstills : sequence of Standstill
        Standstills of the same cup.
    length : Length
        Cup length l0 of the fit, with its standard error, 0 if exact.
    gravity : float
        Gravitational acceleration along -z of the world, m/s^2.
    given : Cup
        One cup, whose stiffness is used in weights for unidentifiable entries.
    places : tuple of (x, y, z, index)
        Positions of the cups of a gripper (m, in E); the fit is of one cup.

    """
    structure = replace(structure_named(fit.structure), places=places)
    value, std, x0 = length.value, length.std, fit.parameters
    moving = np.hstack([np.eye(len(x0)), -std * length.jacobian[:, None]])
    prior = moving.T @ result.information_of(fit.covariance) @ moving
    prior[-1, -1] += 1.0
    start = np.append(x0, 0.0)
    weight, z, covariance = 1.0, start, fit.covariance
    for _ in range(4):
        guess = _guess(structure, z[:-1], covariance, given.stiffness)
        cup = replace(given, stiffness=guess, length=value, stretch=fit.stretch,
                      relaxation=(0.0, 0.0))
        rows = np.concatenate([
            _equations(still, cup, structure, gravity) for still in standstills])
        of_K, b = rows[:, :-2], rows[:, -2]
        large = structure.sizes(guess, guess)[:structure.size]
        # a change by its size shifts no pose by 1e-3 standard errors
        of_K[:, np.linalg.norm(of_K, axis=0) * large < 1e-3] = 0.0
        A = np.hstack([of_K, np.zeros_like(of_K), std * rows[:, -1:]])
        joint = result.covariance_of(prior + weight * A.T @ A)
        finite = np.where(np.isfinite(joint), joint, 0.0)  # other entries are unchanged
        z = start + finite @ (weight * A.T @ (b - A @ start))
        degrees = len(b) - weight * float(np.trace(A @ finite @ A.T))
        chi2 = float(np.sum((b - A @ z) ** 2)) / max(degrees, 1.0)
        weight, covariance = 1.0 / max(chi2, 1.0), joint[:-1, :-1]
    before = fit.covariance + std**2 * np.outer(length.jacobian, length.jacobian)
    with np.errstate(divide='ignore', invalid='ignore'):
        narrowed = np.sqrt(np.diag(covariance) / np.diag(before))
    return replace(
        fit, parameters=z[:-1], covariance=covariance, standstills=result.StandstillPart(
            len(standstills), chi2, np.nan_to_num(narrowed, nan=1.0, posinf=1.0),
            value + std * float(z[-1]), std * float(np.sqrt(joint[-1, -1]))),
        notes=(*fit.notes, *[NOTES['disagreement'].format(chi2=chi2)] * (chi2 > 4.0)))


def _guess(structure: Structure, x: Array, covariance: Array, typical: Array) -> Array:
    """Return K (6, 6) for whitening, with typical values for unidentifiable entries."""
    if structure.couples:
        return structure.matrices(x)[0]
    is_usable = np.isfinite(np.diag(covariance)) & (x > 0.0)
    return structure.matrices(np.where(is_usable, x, structure.parameters(typical, typical)))[0]


def _equations(
    still: Standstill, cup: Cup, structure: Structure, gravity: float
) -> Array:
    """
    Return [A, b, g] (6, n + 2) of b = A k + g dl, in standard errors of the mean pose.

    Coordinates are of the lip; k are the n free entries of K, dl is the error of the length, m. A
    cup with a guess of K converts errors of poses to errors of wrenches.
    """
    x = structure.parameters(cup.stiffness, cup.stiffness)
    cup = gripper_of(replace(cup, stiffness=structure.matrices(x)[0]), structure.places)
    model = model_tuple(cup, still.payload, gravity)
    tool, body = _state(still.tool), _state(still.package)
    for _ in range(6):
        step = -np.linalg.solve(linearise(model, tool, body).body_pose,
                                np.concatenate(body_acceleration(model, tool, body)))
        step *= min(1.0, 0.05 / max(float(np.abs(step).max()), 1e-12))
        body = displaced(body, tuple(step[:3].tolist()), tuple(step[3:].tolist()))
    changes: Array = np.empty((6, 43))  # columns of K and P, and of the length
    parameter_jacobian(model, tool, body, 0, 43, changes)
    of_body = np.linalg.solve(linearise(model, tool, body).body_pose, -changes)
    of_lip = lie.adjoint(lie.transform(np.eye(3), still.payload.com)) @ of_body
    R, R_rest = still.package.rotation[0], lie.quaternion_to_rotation(np.array(body[1]))
    rotation = lie.log_so3(R.T @ R_rest)
    shift = (body[0] - R_rest @ still.payload.com
             - still.package.position[0] + R @ still.payload.com)
    changes = np.vstack([R.T @ R_rest @ of_lip[:3], lie.dexp_inverse(-rotation) @ of_lip[3:]])
    A = changes[:, :21] @ structure.upper[:21, :structure.size]
    b = A @ x[:structure.size] - np.concatenate([R.T @ shift, rotation])
    errors = np.repeat(np.maximum(still.error, MIN_STANDSTILL_STD), 3)
    return np.asarray(np.column_stack([A, b, changes[:, 42]]) / errors[:, None])
