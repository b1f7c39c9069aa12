"""
The unknowns of a fit by simulation, and their effect on cup, package and poses.

All uncertain quantities are free jointly with K and P, with their priors as additional
measurements. K and P are exponentials of matrices, K = T exp(M) T, which are definite for any
numbers: the numbers of M are logarithms of entries on the diagonal, and correlations. Wide priors
on the order of magnitude of K and P are negligible for numbers that the recordings determine.

Each given quantity is a measurement with a standard deviation.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
import math
from operator import attrgetter
from pathlib import Path
import tomllib
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.identification.result import (
    Arrow,
    CHANCE,
    MAX_RELATIVE_ERROR,
    symmetric_roots,
)
from bellows_ros.core.identification.segments import (
    Held,
    here,
    Outline,
    outline_of,
    Segment,
)
from bellows_ros.core.model.cup_package import (
    Cup,
    gravity_vector,
    gripper_of,
    LAW,
    model_tuple,
    Package,
    varied,
)
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.structure import INERTIA_STD, Structure
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS
from bellows_ros.core.parameters.conversion import package_of, stated_std
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.sensors import body
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np
from numpy.typing import ArrayLike


class Kind(NamedTuple):
    """
    A kind of quantity that may be estimated jointly with K and P, see `quantities.toml`.

    Parameters
    ----------
    unit : float or sequence
        Unit of the search, SI units, of all values or of each.
    size : int
        Number of values.
    max_std : float or sequence
        Largest standard error of an identifiable quantity.
    prior_std : float or sequence
        Standard deviation of a weak prior.
    each : bool
        Whether every recording has values of its own.

    """

    unit: Any
    size: int
    max_std: Any
    prior_std: Any
    each: bool = False


KINDS: Mapping[str, Kind] = {
    name: Kind(**numbers) for name, numbers in tomllib.loads(
        Path(__file__).with_name('quantities.toml').read_text()).items()}
"""Kinds by their names in fit.free."""

Free = Mapping[str, Array]
"""Values by name, for one recording."""

NOTHING: Free = MappingProxyType({})

MARKERS = ('package_marker', 'tool_marker')
"""Two marker frames that one recording can hardly distinguish."""

CLOCK_RATE_STD = 5e-5
"""Standard deviation of the relative rate of two quartz clocks."""

MIN_STD = 1e-9
"""Smallest standard deviation, SI units."""

PACKAGE_STD: Mapping[str, float] = {'mass': 0.01, 'inertia': INERTIA_STD, 'com': 2e-3}
"""Standard deviations of a package's quantities by default: relative for mass and inertia, m."""


def weak_prior(names: Iterable[str]) -> dict[str, Array]:
    """Return the standard deviations of weak priors on quantities, by name."""
    return {name: np.resize(KINDS[name].prior_std, KINDS[name].size) for name in names}


def payload_of(payload: Package, free: Free) -> Package:
    """Return the package with the values of free quantities."""
    changes = {name: free[name] for name in ('com', 'mass', 'inertia') if name in free}
    return varied(payload, **changes) if changes else payload


def gravity_of(gravity: Array | float, free: Free) -> Array:
    """Return the vector (3,) of gravity in a tilted world."""
    return np.asarray(lie.exp_so3(-np.append(free.get('gravity', (0.0, 0.0)), 0.0))
                      @ gravity_vector(gravity))


def given_std(values: Values) -> dict[str, Array]:
    """Return the standard deviations of given quantities, by names of `KINDS`, SI units."""
    marker = np.repeat(values.recording.marker_std, 3)
    stds = {'length': np.array([values.cup.length_std]), 'package_marker': marker,
            'time_offset': np.array([values.recording.clock_std]),
            'clock_rate': np.array([CLOCK_RATE_STD if values.recording.clock_std else 0.0]),
            'exposure': np.array([float(  # a tracked body has none
                values.measured.tag_size > 0.0 and not values.measured.exposure)])}
    if values.recording.package_world:
        stds['package_world'] = marker
    if not values.topics.package_pose:
        stds = {'length': stds['length']}
    if all(name in values for name in PACKAGE_PARAMETERS):
        payload = package_of(values)
        for name, size in (('mass', np.array([payload.mass])), ('com', np.ones(3)),
                           ('inertia', np.diag(payload.inertia))):
            stds[name] = stated_std(
                values, f'package.{name}_std', PACKAGE_STD[name] * size) / size
    return {name: np.maximum(std, MIN_STD) for name, std in stds.items() if np.any(std)}


def delayed(stamps_ns: Stamps, free: Free, middle: Array) -> Stamps:
    """Return stamps (N,) of the package on the tool's clock; see `body.middle_of`."""
    offset, rate = (float(free.get(name, (0.0,))[0]) for name in body.CLOCKS)
    since = stamps_ns - round(middle[3] * NS_PER_S)
    return np.asarray(stamps_ns + np.rint(offset * NS_PER_S + rate * since).astype(np.int64))


def as_found(recording: Recording, found: Free, number: int) -> Recording:
    """
    Return a recording with the estimates of a fit for package, marker, world and clock.

    Parameters
    ----------
    recording : Recording
        Recording with the given quantities.
    found : mapping
        See `Fit.nuisances`.
    number : int
        Index of the recording in the fit.

    """
    if not found:
        return recording
    free = {name: rows[number % len(rows)] for name, rows in found.items()}
    moves, tracked = np.array(recording.settings.moves_with_com, float), recording.tracked_package
    middle, views = body.middle_of(tracked), recording.views
    camera = views.tag.T_world_camera[:3, 3] if views else 0.0

    def moved(poses: Trajectory) -> Trajectory:
        return body.poses_of(poses, free, moves, middle, camera)

    of_tool, of_package = recording.filters
    payload = payload_of(recording.payload, free)
    stamps_ns = delayed(tracked.stamps_ns, free, middle)
    return replace(
        recording, seen=views and replace(
            views.at(tracked.stamps_ns).corrected(free, moves, middle), stamps_ns=stamps_ns),
        settings=replace(recording.settings, payload=payload),
        filters=(of_tool, replace(of_package, poses=moved(of_package.poses))),
        tracked_package=replace(moved(tracked), stamps_ns=stamps_ns))


MIN_STRENGTH = 1e-6
"""Smallest strength of relaxation in a search, as a branch of none has no strain."""

RATIO_STD = 0.4
"""Standard deviation of the ratio r2 / r1 among rubbers about 1, that of a constant loss
factor."""

WIDE_LOG_STD = 2.0
"""Standard deviation of the logarithms of K about the start, of
which only the order of magnitude is known."""

DAMPING_LOG_STD = 1.0
"""Standard deviation of the logarithm of P about ordinary rubber."""

LOSS_FACTOR = 0.25
"""Loss factor of ordinary rubber, the prior of the damping; an undamped cup would fit noise."""

DIFFERENCE = 1e-5
"""Steps of unknowns for derivatives, in logarithms and standard deviations of the first state: of
the order of the root of rounding in poses."""

QUANTITY_DIFFERENCE = DIFFERENCE / KINDS['mass'].unit
"""Steps of other unknowns, in their units: with steps of mass, inertia, K and P by one factor, the
derivatives cancel to rounding."""

MAX_LOG_STEP = 1.0
"""Largest change of the logarithm of K or P in a step."""

MIN_DAMPING = math.exp(-CHANCE * DAMPING_LOG_STD)
"""Smallest damping of a first cup, relative to ordinary damping, which replaces a smaller one."""


def logarithm(M: Array, scale: Array) -> Array:
    """Return log M (6, 6) of a definite matrix in units of a diagonal scale (6,)."""
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    return np.asarray((vectors * np.log(values)) @ vectors.T)


def exponential(M: Array, scale: Array) -> Array:
    """Return exp M (6, 6), definite, in units of a diagonal scale (6,)."""
    values, vectors = np.linalg.eigh(M)
    half = scale[:, None] * vectors * np.exp(0.5 * values)
    return np.asarray(half @ half.T)


@dataclass(frozen=True, eq=False)
class Problem:
    """
    Recordings of one cup, and the unknowns of their fit.

    The m unknowns theta are logarithms of K and P by the structure, then the free quantities of
    `KINDS` in their units: first the s that all recordings share, including those of the cup, then
    the own ones of each recording.

    Parameters
    ----------
    held : Held
        Segments of each recording; none for one recording whose segments are given to a function.
    outlines : tuple of Outline
        Facts on each recording.
    structure : Structure
        Structure of K and P.
    guess : Cup
        Initial guess, with the length.
    free : mapping
        Standard deviations, SI units, of other free quantities, by names of `KINDS`.
    slip_ns : int
        Stamp of a slip of the package, if free.
    common : tuple of str
        Names of quantities that all recordings share instead of having their own.
    is_rough : bool
        Whether tags count as poses, and exposures as given, for a remote start.

    """

    held: Held
    outlines: tuple[Outline, ...]
    structure: Structure
    guess: Cup
    free: Free
    slip_ns: int = 0
    common: tuple[str, ...] = ()
    is_rough: bool = False

    @classmethod
    def of(
        cls, segments: Held | Sequence[Segment], structure: Structure, guess: Cup, free: Free,
        **more: Any,
    ) -> 'Problem':
        """Return the problem of held recordings, or of segments that are in this process."""
        if not isinstance(segments, Held):
            segments = here([tuple(own) for _, own in groupby(segments, attrgetter('recording'))])
        return cls(segments, tuple(segments.pool.results(outline_of, segments)), structure, guess,
                   free, **more)

    @cached_property
    def local(self) -> 'Problem':
        """The problem of each recording alone: its unknowns are the shared ones, then its own."""
        return replace(self, held=here([]), outlines=self.outlines[:1])

    def index(self, number: int) -> Places:
        """Return the places (q,) of a recording's unknowns among all."""
        return np.concatenate([np.arange(self.shared), self.own[number]])

    @property
    def is_slow(self) -> bool:
        """Whether the noise of some poses is estimated together with K and P."""
        return any(outline.is_slow for outline in self.outlines)

    def has_views(self, segment: Segment) -> bool:
        """Return whether a segment's sensor is a tag's corners, which count as poses at first."""
        return segment.views is not None and not self.is_rough

    def freed(self, theta: Array, more: Free, structure: Structure | None = None) -> 'Problem':
        """Return the problem from the cup of unknowns, with more free quantities."""
        return replace(self, structure=structure or self.structure, guess=self.cup(theta),
                       free={**self.free, **more})

    def is_own(self, name: str) -> bool:
        """Return whether each recording has its own value of a quantity."""
        return KINDS[name].each and name not in self.common

    @cached_property
    def first_cup(self) -> Cup:
        """Initial cup with definite matrices, and with internal strains if relaxation is free."""
        cup, ordinary = self.guess, np.diag(self.ordinary_damping(self.guess.stiffness))
        if 'relaxation' in self.free:
            cup = replace(cup, relaxation=tuple(
                np.maximum(cup.relaxation, MIN_STRENGTH).tolist()))
        if np.linalg.eigvalsh(cup.stiffness)[0] <= 0.0:
            cup = replace(cup, stiffness=np.diag(np.diag(cup.stiffness)))
        if np.linalg.eigvalsh(cup.damping - np.diag(MIN_DAMPING * ordinary))[0] <= 0.0:
            own = np.diag(cup.damping)
            cup = replace(cup, damping=np.diag(np.where(
                own < MIN_DAMPING * ordinary, ordinary, own)))
        return cup

    @property
    def count(self) -> int:
        """Number of unknowns of the cup."""
        return 2 * self.structure.size

    @cached_property
    def places(self) -> Mapping[str, Places]:
        """Indices of free quantities among the unknowns: a row per recording, or one for all."""
        shapes = {name: (len(self.outlines) if self.is_own(name) else 1, KINDS[name].size)
                  for name in sorted(self.free, key=self.is_own)}
        ends = np.cumsum([self.count, *map(math.prod, shapes.values())])
        return {name: first + np.arange(math.prod(shape)).reshape(shape)
                for first, (name, shape) in zip(ends, shapes.items(), strict=False)}

    @cached_property
    def rows(self) -> Mapping[str, Places]:
        """Indices of free quantities among the unknowns of the first recording."""
        return {name: row for name, (row, *_) in self.places.items()}

    @cached_property
    def own(self) -> Places:
        """Indices (R, o) of the own unknowns of each recording."""
        return np.hstack([np.empty((len(self.outlines), 0), dtype=np.int64), *(
            place for name, place in self.places.items() if self.is_own(name))])

    @property
    def shared(self) -> int:
        """Number s of shared unknowns."""
        return len(self.units) - self.own.size

    def _of_all(self, of_cup: Array, of_free: Callable[[str], ArrayLike]) -> Array:
        """Return numbers (m,) from the numbers of the cup, and a function by free quantity."""
        numbers = np.pad(of_cup, (0, sum(place.size for place in self.places.values())))
        for name, place in self.places.items():
            numbers[place] = of_free(name)
        return numbers

    @cached_property
    def units(self) -> Array:
        """Units (m,) of the unknowns."""
        return self._of_all(np.ones(self.count), lambda name: KINDS[name].unit)

    @cached_property
    def weights(self) -> Array:
        """Information (m,) of the priors of free quantities."""
        return self._of_all(np.zeros(self.count), lambda name: (
            np.divide(self.free[name], KINDS[name].unit) ** -2))

    @cached_property
    def max_std(self) -> Array:
        """Largest standard errors (m,) of identifiable unknowns."""
        return self._of_all(np.full(self.count, MAX_RELATIVE_ERROR), lambda name: (
            np.divide(KINDS[name].max_std, KINDS[name].unit)))

    @cached_property
    def max_step(self) -> Array:
        """Largest steps (m,): of logarithms, and three deviations of given quantities."""
        return self._of_all(np.full(self.count, MAX_LOG_STEP), lambda name: (
            CHANCE * np.divide(self.free[name], KINDS[name].unit)))

    @cached_property
    def scales(self) -> tuple[Array, Array]:
        """Units of K and P in their logarithms: roots (6,) of the initial diagonals."""
        cup = self.first_cup
        return np.sqrt(np.diag(cup.stiffness)), np.sqrt(np.diag(cup.damping))

    @cached_property
    def start(self) -> Array:
        """Unknowns (m,) of the initial guess."""
        cup, (k, p) = self.first_cup, self.scales
        return self._of_all(self.structure.parameters(
            logarithm(cup.stiffness, k), logarithm(cup.damping, p)), lambda name: 0.0)

    def _matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P of unknowns, SI units."""
        K, P = (exponential(M, scale) for M, scale in zip(
            self.structure.matrices(theta[:self.count]), self.scales, strict=True))
        return K, P

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the unknowns, a single one of a gripper."""
        K, P = self._matrices(theta)
        return replace(self.first_cup, stiffness=K, damping=P)

    def reported(self, theta: Array) -> Array:
        """Return parameters of K and P and quantities (m,) of the unknowns, SI units."""
        x = self.units * theta
        x[:self.count] = self.structure.parameters(*self._matrices(theta))
        return x

    def slopes(self, theta: Array) -> Array:
        """Return the derivatives (s, s) of the reported shared numbers by the unknowns."""
        slopes, step = np.diag(self.units[:self.shared]), DIFFERENCE
        for j in range(self.count):
            ends = (self.reported(theta + side * step * np.eye(1, len(theta), j)[0])
                    for side in (1.0, -1.0))
            slopes[:, j] = np.subtract(*ends)[:self.shared] / (2.0 * step)
        return slopes

    def extended(self, name: str, theta: Array) -> Array:
        """Return the numbers (n,) of a term of the law, SI units."""
        return np.array(getattr(self.first_cup, name)) + self.values(theta).get(name, 0.0)

    def transferred(self, other: 'Problem', theta: Array) -> Array:
        """Return the unknowns equal to the unknowns of another problem with the same cup."""
        moved = self.start.copy()
        for name in self.places.keys() & other.places:
            moved[self.places[name]] = theta[other.places[name]]
        return moved

    def values(self, theta: Array) -> Free:
        """Return the free quantities of a recording, SI units; theta is local."""
        values = self.reported(theta)
        return {name: values[row] for name, row in self.rows.items()}

    def model(self, theta: Array, segment: Segment, part: float = 0.0) -> ModelTuple:
        """
        Return the model of a segment; theta is local.

        The part is that of the recording so far, less one half; before a slip it is -1.
        """
        free = dict(self.values(theta))
        if 'slip' in free and part > -1.0:
            free['com'] = free.get('com', np.zeros(3)) + np.append(free['slip'], 0.0)
        if 'length_drift' in free:
            free['length'] = free.get('length', np.zeros(1)) + part * free['length_drift']
        return model_tuple(
            self.gripper(theta, free), _scaled(segment.payload, free),
            gravity_of(segment.gravity, free))

    def gripper(self, theta: Array, free: Free) -> Cup:
        """Return the cup or cups with their free quantities."""
        cup = gripper_of(self.cup(theta), self.structure.places)
        if 'length' in free:
            cup = replace(cup, length=cup.length + float(free['length'][0]))
        terms = {name: getattr(self.first_cup, name) + free[name] for name in LAW if name in free}
        if 'relaxation' in terms:
            terms['relaxation'] = np.maximum(terms['relaxation'], MIN_STRENGTH)
        return cup.with_terms({name: tuple(term.tolist()) for name, term in terms.items()})

    def moved(self, theta: Array, step: Array) -> Array:
        """Return unknowns after a step that is limited for logarithms."""
        moved = theta + step
        moved[:self.count] = theta[:self.count] + np.clip(
            step[:self.count], -MAX_LOG_STEP, MAX_LOG_STEP)
        for place in self.places.get('relaxation', ()):
            moved[place] = np.maximum(
                moved[place], -np.array(self.first_cup.relaxation) / self.units[place])
        return moved

    def ordinary_damping(self, stiffness: Array) -> Array:
        """Return the damping (6, 6) with one loss factor for each mode of the package."""
        payload = self.outlines[0].payload
        to_com, inertia = np.eye(6), np.zeros((6, 6))
        to_com[:3, 3:] = -lie.hat(payload.com)
        inertia[:3, :3], inertia[3:, 3:] = payload.mass * np.eye(3), payload.inertia
        root, inverse = symmetric_roots(to_com.T @ inertia @ to_com)
        P = LOSS_FACTOR * root @ symmetric_roots(inverse @ stiffness @ inverse)[0] @ root
        return self.structure.matrices(self.structure.parameters(stiffness, P))[1]

    def prior(self, theta: Array) -> tuple[Arrow, Array]:
        """Return information (m, m) and slope (m,) of the prior."""
        own = self.weights[self.own]
        H, (recordings, count) = np.diag(self.weights[:self.shared]), self.own.shape
        g = self.weights * (self.start - theta)
        g[:self.count] = 0.0
        for J, deviation in self.wide_priors(theta):
            H += J.T @ J
            g[:self.shared] -= J.T @ deviation
        return Arrow(H, np.zeros((recordings, count, len(H))), own[:, :, None] * np.eye(count),
                     self.own), g

    def wide_priors(self, theta: Array) -> Iterator[tuple[Array, Array]]:
        """
        Yield derivatives (n, s) and sizes (n,) of deviations in standard deviations.

        They are of K, P and relaxation. Sizes are relative to the mass: K, P, inertia and
        mass scaled by one factor give equal motion, and only the given mass determines the factor.
        """
        half, eye = self.count // 2, np.eye(self.shared)
        is_axis = np.array([row == column for row, column in self.structure.leads], float)
        heavier = np.zeros(self.shared)
        for place in self.places.get('mass', ()):
            heavier[place] = self.units[place]
        now = theta[:self.shared]
        K = eye[:half] - np.outer(is_axis, heavier)
        yield K / WIDE_LOG_STD, (K @ now) / WIDE_LOG_STD
        _, scale = self.scales
        usual = self.structure.parameters(np.eye(6), logarithm(
            self.ordinary_damping(self.first_cup.stiffness), scale))[half:]
        P = eye[half:self.count] - np.outer(is_axis, 0.5 * heavier) - 0.5 * eye[:half]
        yield P / DAMPING_LOG_STD, (P @ now - usual) / DAMPING_LOG_STD
        for place in self.places.get('relaxation', ()):  # the ratio of r2 and r1
            r = self.extended('relaxation', theta)
            std = RATIO_STD * max(r[0], KINDS['relaxation'].max_std)
            yield (np.diff(eye[place], axis=0) * self.units[place[0]] / std, np.diff(r) / std)


def _scaled(payload: Package, free: Free) -> Package:
    """
    Return the package of free quantities, with moments of inertia that no body may have.

    The motion does not depend on their possibility, and a search would stop at its limit.
    """
    factors = np.exp(0.5 * np.asarray(free.get('inertia', np.zeros(3))))
    return Package(
        payload.mass * float(np.exp(np.sum(free.get('mass', 0.0)))),
        payload.inertia * np.outer(factors, factors),
        payload.com + free.get('com', np.zeros(3)), is_checked=False)
