"""
Covariance of a landing, its contributions, and the time of release for a target.

A landing has six components: position in the plane of the floor (m), without a part along gravity,
and the rotation vector from a nominal landing, in world axes (rad). Tosses land at different
instants, so the shift along the flight is projected out.
"""

from contextlib import suppress
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.model import cup_package
from bellows_ros.core.model.grip import Law, Release, RELEASE_NAMES
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.toss import release as toss_release
from bellows_ros.core.toss.release import HeldMotion, Toss, toss
from bellows_ros.errors import NoLandingError, NoReleaseError, UnstableError
import numpy as np
import scipy  # whose parts are loaded as they are used

MARGIN = 0.25
"""Longest delay of the release by changed parameters after the nominal instant, s."""

TOLERANCE = 1e-6
"""Accuracy of the best release time, s."""

CANDIDATES = 8
"""Number of the best times in the scan that are refined."""

SECOND_ORDER = 'release, second order'
"""Name of the second-order contribution of the law of release."""

ELLIPSE = math.sqrt(-2.0 * math.log(0.05))
"""Radius of the ellipse that contains 95 % in a plane, standard deviations."""


class Contributions(NamedTuple):
    """Contributions of uncertain parameters to a landing."""

    names: tuple[str, ...]
    std: Array
    """Standard deviation of each parameter (M,), SI units."""
    parts: Array
    """Derivative times standard deviation (M, 6), m and rad."""
    correlation: Array
    """Correlation of the parameters (M, M)."""

    @property
    def covariance(self) -> Array:
        """Covariance of `landing_error` (6, 6)."""
        return np.asarray(self.parts.T @ self.correlation @ self.parts)

    def of(self, prefix: str) -> tuple[Array, Array]:
        """Return joint standard deviations and covariance (6, 6) by parameters with a prefix."""
        chosen = np.array([name.startswith(prefix) for name in self.names], bool)
        part = self._replace(parts=self.parts * chosen[:, None])
        return self.std[chosen], part.covariance


class TossProblem(NamedTuple):
    """A toss, and the parameters that determine it."""

    held: HeldMotion
    release: Release
    switched: float
    """Time of the valve, s since the first point of the plan."""
    uncertain: cup_package.Uncertain
    factor: Array
    """L (8, 8) with the covariance L L^T of the law of release."""

    def error(self, thrown: Toss, nominal: Toss) -> Array:
        """Return the deviation of a landing from a nominal one (6,), m and rad."""
        return np.concatenate(toss_release.landing_error(
            thrown.landing, nominal.landing, self.held.model[2]))

    def error_with(self, model: ModelTuple, release: Release, nominal: Toss) -> Array:
        """Return the landing's deviation for another model and release."""
        held = HeldMotion(model, self.held.grip, self.held.tool,
                          until=nominal.release_time + MARGIN)
        return self.error(toss(held, release, self.switched), nominal)


def release_with(release: Release, by: Array) -> Release:
    """Return a release whose law is changed by (8,); see `changed_law`."""
    return release._replace(law=toss_release.changed_law(release.law, 1.0, as_law(by)))


def as_law(numbers: Array) -> Law:
    """Return the law of release of eight numbers, in the order of `Law`."""
    law: Any = tuple(numbers.tolist())
    return law  # type: ignore[no-any-return]


def contributions_to(case: TossProblem, nominal: Toss) -> Contributions:
    """
    Return the contributions of cup, package and release, by differences as in `perturbed`.

    The law of release has second-order effects: along each axis of its covariance, with a standard
    normal z, the landing shifts by a z + b z^2, which has the mean b and the variance a^2 + 2 b^2.
    """
    held, release, switched, numbers, factor = case
    names, parts = cup_package.contributions(
        numbers, held.model, lambda model: case.error_with(model, release, nominal))
    std, count = [
        numbers.std[cup_package.PARAMETER_NAMES.index(name)] for name in names], len(names)
    of_law = np.linalg.norm(factor, axis=1)
    uncertain, rows = np.flatnonzero(of_law), [parts.reshape(-1, 6)]

    def both(by: Array) -> tuple[Array, Array]:
        """Return the landings for a change of the law of release, and for the opposite change."""
        up, down = (case.error(toss(held, release_with(release, step), switched), nominal)
                    for step in (by, -by))
        return up, down

    for k in uncertain:
        up, down = both(toss_release.LAW_STEP * of_law[k] * np.eye(8)[k])
        rows.append((up - down)[None] / (2.0 * toss_release.LAW_STEP))
    axes, sizes, _ = np.linalg.svd(factor)
    squared = np.zeros((len(uncertain), 6))
    for b, axis in zip(squared, (axes * sizes).T, strict=False):
        with suppress(NoLandingError, UnstableError):  # like some of the drawn tosses
            b[:] = sum(both(3.0**0.5 * axis)) / 6.0
    if len(uncertain):
        rows += [math.sqrt(2.0) * squared, squared.sum(axis=0, keepdims=True)]
    total = sum(map(len, rows))
    correlation = np.eye(total)
    law = slice(count, count + len(uncertain))
    correlation[law, law] = (factor @ factor.T / np.outer(
        of_law, of_law).clip(1e-300))[np.ix_(uncertain, uncertain)]
    more = total - law.stop
    return Contributions(
        (*names, *(RELEASE_NAMES[k] for k in uncertain), *[SECOND_ORDER] * more),
        np.r_[std, of_law[uncertain], [math.nan] * more], np.concatenate(rows), correlation)


class MonteCarlo(NamedTuple):
    """Landings with all uncertain parameters drawn."""

    errors: Array
    """Errors (N, 6) of the tosses with a landing."""
    failed: int
    """Number of tosses in which the cup loses the package, or does not release it."""

    @property
    def covariance(self) -> Array:
        """Covariance of `landing_error` (6, 6)."""
        return np.cov(self.errors.T)


def draw(case: TossProblem, nominal: Toss, count: int, seed: int = 0) -> MonteCarlo:
    """Return random tosses with parameters drawn from their normal distributions."""
    rng = np.random.default_rng(seed)
    numbers, std, places = case.uncertain
    rows = []
    for _ in range(count):
        model = cup_package.model_with(
            case.held.model, numbers + std * rng.standard_normal(len(std)), places)
        release = release_with(case.release, case.factor @ rng.standard_normal(8))
        with suppress(NoLandingError, UnstableError):
            rows.append(case.error_with(model, release, nominal))
    return MonteCarlo(np.array(rows).reshape(-1, 6), count - len(rows))


def ellipse(covariance: Array, count: int) -> Array:
    """Return points (N, 2) of the 95 % ellipse of x and y, about the origin, closed."""
    angle = np.linspace(0.0, 2.0 * math.pi, count)
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    circle = np.array([np.cos(angle), np.sin(angle)])
    return np.asarray(((vectors * (ELLIPSE * np.sqrt(np.maximum(values, 0.0)))) @ circle).T)


def coverage(covariance: Array, landings: Array) -> float:
    """Return the fraction of landings (N, 6) in the 95 % ellipse of x and y about the nominal."""
    xy = landings[:, :2]
    squared = np.einsum('ni,ni->n', xy, np.linalg.solve(covariance[:2, :2], xy.T).T)
    return float(np.mean(squared <= ELLIPSE ** 2))


class Aim(NamedTuple):
    """Time of the valve for a target, and error of the landing."""

    switched: float
    distance: float
    """Distance from the target in the plane, m."""
    angle: float
    """Angle from the wanted rotation, rad; 0 without a wanted rotation."""
    target: tuple[float, float]
    """Target x and y in the world, m."""


def aim(
    held: HeldMotion, release: Release, target: tuple[float, float], rotation: Array | None = None,
    until: float = math.inf, scan: float = 4e-3, candidates: int = CANDIDATES,
) -> Aim:
    """
    Return the time of the valve with which the package lands nearest to a target.

    Parameters
    ----------
    held : HeldMotion
        Package along the plan.
    release : Release
        Valve, package and floor.
    target : (x, y)
        Position of B at landing, in the world, m.
    rotation : array (3, 3), optional
        Wanted R_world_package at landing; its error counts as the shift of the farthest corner.
    until : float
        Latest time, s; default: the plan's end.
    scan, candidates : float, int
        Step (s) of the scan, and number of the best times that are refined.

    Raises
    ------
    NoLandingError
        If no release during the plan leads to a landing.

    """
    reach = float(np.linalg.norm(np.abs(release.box[1]) + np.array(release.box[0])))

    def miss(switched: float) -> Array:
        try:
            thrown = toss(held, release, switched)
        except (NoLandingError, UnstableError):
            return np.full(5, np.nan)
        error = np.zeros(3)
        if rotation is not None:
            error = log_so3(rotation.T @ quaternion_to_rotation(np.array(thrown.landing[1])))
        return np.concatenate([np.subtract(thrown.landing[0][:2], target), reach * error])

    def cost(switched: float) -> float:
        return float(np.nan_to_num(np.linalg.norm(miss(switched)), nan=1e6, posinf=1e6))

    lost_time = held.lost_before(held.duration)
    last = min(held.duration if lost_time is None else lost_time, until)
    times = np.linspace(0.0, last, max(2, math.ceil(last / scan) + 1))
    ends = np.array([miss(t) for t in times])
    step = np.diff(ends, axis=0)
    squared = np.maximum(np.einsum('ni,ni->n', step, step), 1e-30)
    along = np.clip(-np.einsum('ni,ni->n', ends[:-1], step) / squared, 0.0, 1.0)
    distances = np.nan_to_num(
        np.linalg.norm(ends[:-1] + along[:, None] * step, axis=1), nan=np.inf)
    tried = []
    for k in np.argsort(distances)[:candidates]:
        if distances[k] <= 1.5 * distances.min() + 1e-3:
            best = scipy.optimize.minimize_scalar(
                cost, bounds=(times[k], times[k + 1]), method='bounded',
                options={'xatol': TOLERANCE})
            tried += [(cost(t), float(t)) for t in (best.x, times[k], times[k + 1])]
    size, switched = min(tried, default=(1e6, 0.0))
    if size >= 1e6:
        raise NoReleaseError(
            'No release during the plan leads to a landing. Check landing.height, release.*, and '
            'whether the plan throws the package.')
    shift, angle = (float(np.linalg.norm(part)) for part in np.split(miss(switched), [2]))
    return Aim(switched, shift, angle / reach, target)
