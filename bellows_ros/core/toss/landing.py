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
from bellows_ros.core.model import cup_package
from bellows_ros.core.model.grip import Law, Release, RELEASE_NAMES
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.toss import release as toss_release
from bellows_ros.core.toss.release import HeldMotion, Toss, toss
from bellows_ros.errors import NoLandingError, NoReleaseError, UnstableError
import numpy as np
import scipy  # whose parts are loaded as they are used

DRAWS = 200
"""Number of drawn tosses: standard deviations to 5 %, an ellipse of 95 % that holds 94 to 95 %."""

MARGIN = 0.25
"""Longest delay of the release by changed parameters after the nominal instant, s."""

TOLERANCE = 1e-6
"""Accuracy of the best release time, s."""

SCAN = 4e-3
"""Step of the scan for the best release time, s."""

REFINED = 3
"""Number of refined minima of the scan."""

NO_LANDING = 1e6
"""Distance from the target that stands for a toss without a landing, m."""

ELLIPSE = math.sqrt(-2.0 * math.log(0.05))
"""Radius of the ellipse that contains 95 % in a plane, standard deviations."""


class TossProblem(NamedTuple):
    """A toss, and the parameters that determine it."""

    held: HeldMotion
    release: Release
    switched: float
    """Time of the valve, s of the plan."""
    uncertain: cup_package.Uncertain
    factor: Array
    """L (6, 6) with the covariance L L^T of the law of release."""


class Scatter(NamedTuple):
    """Drawn landings, and the contributions of uncertain parameters to their scatter."""

    errors: Array
    """Deviations (N, 6) of the tosses with a landing from the nominal landing, m and rad."""
    failed: int
    """Number of tosses in which the cup loses the package, or does not release it."""
    names: tuple[str, ...]
    """Names of the uncertain parameters; correlated numbers of the law are 'release'."""
    std: Array
    """Standard deviations (M,), SI units; NaN for 'release'."""
    parts: Array
    """Deviations (M, 6) of the landing by one standard deviation."""

    @property
    def covariance(self) -> Array:
        """Mean square (6, 6) of the drawn landings about the nominal one."""
        return np.asarray(self.errors.T @ self.errors / len(self.errors))

    def of(self, prefix: str) -> tuple[Array, Array]:
        """Return standard deviations and joint covariance (6, 6) by parameters with a prefix."""
        chosen = np.array([name.startswith(prefix) for name in self.names], bool)
        return self.std[chosen], self.parts[chosen].T @ self.parts[chosen]


def release_with(release: Release, by: Array) -> Release:
    """Return a release whose law is changed by (6,), without negative numbers."""
    return release._replace(law=as_law(np.maximum(np.add(release.law, by), 0.0)))


def as_law(numbers: Array) -> Law:
    """Return the law of release of six numbers, in the order of `Law`."""
    law: Any = tuple(numbers.tolist())
    return law  # type: ignore[no-any-return]


def scatter(case: TossProblem, nominal: Toss, count: int = DRAWS, seed: int = 0) -> Scatter:
    """
    Return landings of tosses with parameters drawn from their normal distributions.

    Raises
    ------
    NoLandingError
        If fewer than half of the tosses land.

    """
    held, (values, std, places), rng = case.held, case.uncertain, np.random.default_rng(seed)

    def miss(model: ModelTuple, of_law: Array) -> Array:
        """Return the deviation (6,) of a toss, NaN without a landing."""
        with suppress(NoLandingError, UnstableError):
            drawn = held if model is held.model else HeldMotion(
                model, held.grip, held.tool, nominal.release_time + MARGIN, held.begin)
            landed = toss(drawn, release_with(case.release, case.factor @ of_law), case.switched)
            return np.concatenate(toss_release.landing_error(
                landed.landing, nominal.landing, held.model[2]))
        return np.full(6, np.nan)

    draws = np.split(rng.standard_normal((count, len(std) + 6)), [len(std)], axis=1)
    errors = np.array([
        miss(cup_package.model_with(held.model, values + std * of_model, places), of_law)
        for of_model, of_law in zip(*draws, strict=True)])
    errors = errors[np.isfinite(errors[:, 0])]
    if len(errors) < count // 2:
        raise NoLandingError(
            f'Of {count} tosses with drawn parameters only {len(errors)} land; expected half or '
            'more. Lower the standard deviations of package, cup and release.*, or drive slower.')
    names, parts, unchanged = list[str](), list[Array](), np.zeros(6)
    for name, up, down in cup_package.perturbed(case.uncertain, held.model):
        names.append(name)
        parts.append(_half_difference(miss(up, unchanged), miss(down, unchanged))
                     / cup_package.PERTURBATION)
    used = np.flatnonzero(case.factor.any(axis=0))  # numbers of the law with a std
    is_diagonal = np.array_equal(case.factor, np.diag(np.diag(case.factor)))
    for k, one in zip(used, np.eye(6)[used], strict=True):
        names.append(RELEASE_NAMES[k] if is_diagonal else 'release')
        parts.append(_half_difference(miss(held.model, one), miss(held.model, -one)))
    law_std = np.diag(case.factor) if is_diagonal else np.full(6, np.nan)
    return Scatter(
        errors, count - len(errors), tuple(names),
        np.append(std[std != 0.0], law_std[used]), np.reshape(parts, (-1, 6)))


def _half_difference(above: Array, below: Array) -> Array:
    """Return half the difference of two deviations (6,); of one alone if the other is NaN."""
    return np.asarray(np.nanmean([above, -below], axis=0))


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
    target: tuple[float, float]
    """Target x and y in the world, m."""


def aim(held: HeldMotion, release: Release, target: tuple[float, float]) -> Aim:
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

    Raises
    ------
    NoLandingError
        If no release during the plan leads to a landing.

    """
    def distance(switched: float) -> float:
        try:
            landed = toss(held, release, switched).landing[0]
        except (NoLandingError, UnstableError):
            return NO_LANDING
        away = math.dist(landed[:2], target)
        return away if away < NO_LANDING else NO_LANDING  # of NaN, too

    lost_time = held.lost_before(held.end)
    last = held.end if lost_time is None else lost_time
    times = np.linspace(held.begin, last, max(2, math.ceil((last - held.begin) / SCAN) + 1))
    distances = [distance(t) for t in times]
    minima = [k for k in range(len(times)) if distances[k] <= min(distances[max(k - 1, 0):k + 2])]
    tried = []
    for k in sorted(minima, key=distances.__getitem__)[:REFINED]:
        ends = times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)]
        best = float(scipy.optimize.minimize_scalar(
            distance, bounds=ends, method='bounded', options={'xatol': TOLERANCE}).x)
        tried += [(distance(best), best), (distances[k], float(times[k]))]
    nearest, switched = min(tried)
    if nearest >= NO_LANDING:
        raise NoReleaseError(
            'No release during the plan leads to a landing. Check landing.height, release.*, and '
            'whether the plan throws the package.')
    return Aim(switched, nearest, target)
