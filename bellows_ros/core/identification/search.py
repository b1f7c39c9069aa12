"""
The search for K and P with which the model, moved as the tool was measured, meets all poses.

Whatever else is uncertain is free at once, each number with what was known of it before as one
more measurement. See `whitening` for what the differences are weighted by. The steps are those of
Gauss and Newton, with derivatives along the likeliest path of the tool: so their mean is zero at
the truth, which the slope of the squares along the measured path, or with their weights'
likelihood, is not. K and P move along geodesics of the definite matrices, with a wide prior on the
logarithm of their size, K about the start, P about that of ordinary rubber, which no number that
the recordings determine feels.

A start that is far off is brought near first, its damping hardly changed, and without couplings,
which noise would move anywhere: with an unknown acceleration of the package the differences forget
what lies further back than a moment.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Places, Stamps
from bellows_ros.core.geometry.lie import (
    apply,
    exp_so3,
    hat,
    log_so3,
    quaternion_to_rotation,
    rotation_to_quaternion,
)
from bellows_ros.core.identification.equations import sizes
from bellows_ros.core.identification.least_squares import DEFAULT_RATIO, RATIO_STD
from bellows_ros.core.identification.quantities import (
    BENT,
    Free,
    KINDS,
    model_columns,
    OF_CUP,
    payload_of,
    pose_changes,
    poses_of,
)
from bellows_ros.core.identification.result import LARGEST_ERROR
from bellows_ros.core.identification.whitening import (
    PARAMETER_COUNT,
    smooth,
    state_count,
    whiten,
    with_mean,
)
from bellows_ros.core.model.cup_package import Cup, gripper_of, model_tuple, Package
from bellows_ros.core.model.equilibrium import adapted, largest_step, pose_error, substeps_of
from bellows_ros.core.model.jacobians import DAMPING, WRENCH
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import (
    rest,
    row_state,
    simulate_rows,
    state_row,
    tool_rows,
)
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.recording import BodyNoise, LOW_RATE_HZ, Recording
from bellows_ros.core.signals.resampling import MAD_TO_STD, resample, subdivided
from bellows_ros.core.signals.savgol import bridged, first_order, savgol
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError, UndeterminedError, UnstableError
import numpy as np
from numpy.typing import ArrayLike

SMOOTHED_OVER, SMOOTHED_ORDER, FEWEST = (1 / 6, 1 / 8, 1 / 12), 6, 4
"""Half windows (s) and order of the polynomials of the tool's path, and their fewest samples."""

MOST_SMOOTHED = 1.5
"""Largest power that a longer window removes beyond a shorter one, over that of noise in it."""

SMALLEST = np.repeat([2e-7, 2e-6], 3)
"""Smallest noise of a pose (m, rad): interpolation and rounding."""

LONGEST_GAP, SHORTEST_SEGMENT = 0.15, 1.0
"""Longest gap (s) of the tool that is bridged, and shortest part (s) between such gaps."""

MISSING = np.repeat([5e-3, 5e-2], 3)
"""Standard deviation of a pose of the tool that is bridged (m, rad)."""

START = np.repeat([0.05, 0.3, 0.5, 3.0, 0.01, 0.1, 0.01, 0.1], 3)
"""
Standard deviation of the package's first state about its first pose, at rest, and of internal
strains; SI units.
"""

SWINGING = 3.0
"""Standard deviations of a pose beyond which a package swings at first."""

LEAST_STRENGTH, ORDINARY_STRENGTH = 1e-6, 0.05
"""Strengths of relaxation are not below the first where they are searched for; of soft rubber."""

TOGETHER = 2e-4
"""Poses of the package this close (s) to a sample of the tool count as simultaneous, so that a
small change of the clock does not change which comes first. The twist bridges the rest."""

LONGEST_STEP, LONGEST_INTEGRATION = 0.01, 0.005
"""Longest steps of the linearised model, and of the integrator (s)."""

SHORTEST_INTEGRATION = 5e-6
"""
Shortest step of the integrator (s).

A cup that needs shorter ones, for modes faster than 20,000/s, is no cup: the search turns back.
"""

COARSE = 4.0
"""Times that steps are longer while a start is brought near: fast modes need no accuracy there."""

FORGETS = 30.0
"""What the unknown acceleration forgets per second while a start is brought near; nothing then."""

LEAST_DAMPING = 1e-2
"""Of steps that bring a start near, in which noise would carry away what is hardly known."""

MOST_DAMPED = 1e-2
"""Largest damping of the last step: a damped step is short wherever the minimum is."""

WIDE = 2.0, 1.0
"""Standard deviation of the logarithm of the size of K, about the start, and of P."""

HELD = 0.3
"""That of P while the start is brought near."""

LOSS_FACTOR = 0.25
"""Of the ordinary cup that P is compared with. Without damping a fit to noise would ring."""

LONGEST_WAY = 1.0
"""Largest change of the logarithm of K or P in a step."""

MIXED, MOST_MIXED, SMALLEST_TURN = 3, 0.9, 0.1
"""
How many earlier steps a step is mixed with, the largest weight of one of them (a step 10 times
too long has 0.9), and the smallest singular value, in the largest, that counts.
"""

SETTLED = 0.03
"""Part by which the noise of slow poses may change in the last step."""

MOST_NEAR_STEPS, MOST_STEPS, MOST_OF_MISFIT = 10, 60, 30
"""
Largest numbers of steps: to bring a start near, after that, and after that with a misfit.

So a search simulates a wrong recording 53 times at most (with clocks or frames free, 64). A whole
fit is several: with relaxation, the likeliest causes and what was given free in turn.
"""

MOST_CHI2, MISFIT = 1.2, 1.5
"""Chi^2 per difference that is put down to noise, and above which surely more is left."""

NEAR, ENOUGH = 3.0, 3e-3
"""Squared length of a step, in standard deviations, at which a start is near, and the end."""

STILL_ENOUGH = 0.1
"""The same for the last step allowed: numbers that are barely identifiable keep oscillating."""

RISES = 1.2
"""Factor by which the sum of squares may rise in a step: their weights change, too."""

LONGEST_PART = 60.0
"""Longer parts (s) of recordings are split, so that memory is bounded."""


@dataclass(frozen=True, eq=False)
class Measured:
    """
    A part of a recording in which the tool is known.

    Parameters
    ----------
    tool : Trajectory
        Poses of E in the world at a uniform rate; what is missing or wrong is not valid.
    package : Trajectory
        Poses of B, at any stamps.
    payload : Package
        Mass, inertia and centre of mass of the package in this recording.
    gravity : float or array (3,)
        m/s^2 along -z of the world, or as a vector there.
    tool_noise, package_noise : BodyNoise
        Of the measured poses.
    recording : int
        Number of the recording it is of.
    moves_with_com : tuple of 3 bool
        Components of the centre of mass with which the poses of B move, as those of the lip are
        known.
    middle : ndarray (3,), optional
        Point about which the package's world may be turned; that of its poses where left out.

    """

    tool: Trajectory
    package: Trajectory
    payload: Package
    gravity: Array | float
    tool_noise: BodyNoise
    package_noise: BodyNoise
    recording: int = 0
    moves_with_com: tuple[bool, bool, bool] = (False, False, False)
    middle: Array | None = None


def measured_of(recording: Recording, number: int = 0) -> list[Measured]:
    """
    Return the parts of a recording between gaps of the tool that cannot be bridged.

    Raises
    ------
    UndeterminedError
        If there is none that is long enough.

    """
    tool, package = recording.aligned_tool, recording.tracked_package
    tool_noise, package_noise = (
        own._replace(std=np.maximum(own.std, SMALLEST)) for own in recording.body_noise)
    middle = package.position[package.valid].mean(axis=0)
    known = tool.stamps_ns[tool.valid]
    cuts = np.flatnonzero(np.diff(known) > LONGEST_GAP * NS_PER_S)
    ends = zip(known[np.append(0, cuts + 1)], known[np.append(cuts, -1)], strict=True)
    parts = []
    for first, last in ends:
        count = int((last - first) / NS_PER_S / LONGEST_PART) + 1
        for edges in pairwise(np.linspace(0, last - first, count + 1).astype(np.int64)):
            of_tool, of_package = (
                poses.select((poses.stamps_ns >= first + edges[0])
                             & (poses.stamps_ns <= first + edges[1])) for poses in (tool, package))
            if edges[1] - edges[0] > SHORTEST_SEGMENT * NS_PER_S and of_package.valid.any():
                parts.append(Measured(
                    of_tool, of_package, recording.payload, recording.settings.gravity, tool_noise,
                    package_noise, number, recording.settings.moves_with_com, middle))
    if not parts:
        raise UndeterminedError(
            f'No segment of {SHORTEST_SEGMENT:g} s in which both bodies are tracked. Record '
            'longer, or check the gaps and outliers in the report.')
    return parts


class Nodes(NamedTuple):
    """
    The stamps at which something happens.

    Parameters
    ----------
    stamps : int ndarray (M,)
        ns, by the tool's clock.
    samples : int ndarray (S,)
        The nodes at the tool's samples.
    place : int ndarray (M,)
        Number of the package's pose at each node, -1 for none.
    sampled, seen : bool ndarray
        The tool's samples and the package's poses that are used.
    late : ndarray (N,)
        Time (s) from the nodes to the poses seen, of those at a sample of the tool.

    """

    stamps: Stamps
    samples: Places
    place: Places
    sampled: Mask
    seen: Mask
    late: Array


class Segment:
    """A part of a recording with the likeliest path of the tool and the package's first state."""

    def __init__(self, measured: Measured, half_window: int = 0) -> None:
        self.measured = measured
        self.tool = bridged(measured.tool)
        self.half_window = half_window or _half_window_of(
            self.tool, measured.tool_noise.correlation)
        self.inner = slice(self.half_window, len(self.tool) - self.half_window)
        self.period = float(np.median(np.diff(measured.package.stamps_ns))) / NS_PER_S
        self.held = np.gradient((self.tool.stamps_ns - self.tool.stamps_ns[0]) / NS_PER_S)
        known = measured.tool.valid[:, None]
        self.variance = np.where(known, measured.tool_noise.std, MISSING)[self.inner] ** 2
        self.package = measured.package.select(measured.package.valid)
        self.moves = np.array(measured.moves_with_com, dtype=float)
        self.expected = state_row(
            self.package.position[0], rotation_to_quaternion(self.package.rotation[:1])[0])
        self.begin()

    def begin(self) -> None:
        """Take the tool's path, the package's first state and its noise as they were measured."""
        self.std, self.first = self.measured.package_noise.std, self.expected
        self.go(np.zeros((len(self.variance), 6)))

    def go(self, change: Array) -> None:
        """Take the smoothed path through the tool's samples after changes (S, 6) in own axes."""
        tool, shift = self.tool, np.zeros((len(self.tool), 6))
        shift[self.inner] = change
        self.path = savgol(Trajectory(
            tool.stamps_ns, tool.position + apply(tool.rotation, shift[:, :3]),
            tool.rotation @ exp_so3(shift[:, 3:])), self.half_window, SMOOTHED_ORDER)
        self.deviation = _between(self.path, tool.select(self.inner))

    def nodes(self, delay: float) -> Nodes:
        """Return the nodes, with the tool's stamps late by so many seconds."""
        own, taken = self.path.stamps_ns, self.package.stamps_ns + round(delay * NS_PER_S)
        after = np.clip(np.searchsorted(own, taken), 1, len(own) - 1)
        nearest = np.where(2 * taken < own[after - 1] + own[after], own[after - 1], own[after])
        together = np.min(np.diff(taken) // 4, initial=round(TOGETHER * NS_PER_S))
        stamps = np.where(np.abs(taken - nearest) <= together, nearest, taken)
        seen = (stamps >= own[0]) & (stamps <= own[-1])
        if not seen.any():
            raise BellowsError('No package pose lies within the motion of the tool.')
        both = np.union1d(own, stamps[seen])
        both = both[both >= stamps[seen][0]]
        parts = np.ceil(np.diff(both) / (LONGEST_STEP * NS_PER_S)).astype(np.int64)
        nodes = subdivided(both, parts)
        sampled = own >= nodes[0]
        place = np.full(len(nodes), -1)
        place[np.searchsorted(nodes, stamps[seen])] = np.arange(np.count_nonzero(seen))
        return Nodes(nodes, np.searchsorted(nodes, own[sampled]), place, sampled, seen,
                     (taken - stamps)[seen] / NS_PER_S)

    def tool_noise(self, nodes: Nodes) -> tuple[Array, Array, Array, Array]:
        """
        Return what `whiten` takes of the tool's samples at the nodes.

        The time that each stands for (M,), the innovations (M, 6) of its noise, their variances
        (M, 6), and its correlation (M,) with the node before.
        """
        correlation, count = self.measured.tool_noise.correlation, len(nodes.stamps)
        held, correlations = np.zeros(count), np.ones(count)
        held[nodes.samples] = self.held[self.inner][nodes.sampled]
        correlations[nodes.samples] = correlation
        innovations, variances = np.zeros((count, 6)), np.zeros((count, 6))
        innovations[nodes.samples] = _innovations(self.deviation[nodes.sampled], correlation)
        variances[nodes.samples] = self.variance[nodes.sampled] * (1.0 - correlation**2)
        variances[nodes.samples[0]] /= 1.0 - correlation**2
        return held, innovations, variances, correlations


class Part(NamedTuple):
    """
    The whitened differences of a segment.

    Innovations (6 N,), their derivatives (6 N, m) by the unknowns, the variance (N, 6) of each
    difference and of the part of it that is the pose's own noise, what is found on the way back:
    the tool's changes and the package's first state. And the largest displacements (6,) of the
    lip, in `BENT`, where K may change with them.
    """

    innovations: Array
    jacobian: Array
    spread: Array
    own: Array
    change: Array
    first: State
    reach: Array


System = tuple[list[Part], Array, Array]
"""The whitened segments, and information (m, m) and slope (m,) of the whole."""


class Minimum(NamedTuple):
    """Where the search ended: unknowns, segments, information, and whether it is a minimum."""

    theta: Array
    parts: list[Part]
    information: Array
    converged: bool


class Search:
    """
    Gauss-Newton steps.

    The unknowns theta are those of the structure in units of their size, then the quantities of
    `KINDS` that are free, one after the other, in theirs.

    Parameters
    ----------
    segments : list of Segment
        Of one cup's recordings.
    structure : Structure
        Of K and P.
    start : Cup
        First guess, with the length.
    free : mapping
        Standard deviation, SI units, of what else is free, by names of `KINDS`.

    """

    def __init__(
        self, segments: list[Segment], structure: Structure, start: Cup, free: Free
    ) -> None:
        if 'relaxation' in free:
            start = replace(start, relaxation=_not_below(start.relaxation))
        if min(np.linalg.eigvalsh(M)[0] for M in (start.stiffness, start.damping)) <= 0.0:
            start = replace(start, stiffness=np.diag(np.diag(start.stiffness)),
                            damping=np.diag(np.diag(start.damping)))
        self.segments, self.structure, self.given = segments, structure, start
        units = structure.sizes(start.stiffness, start.damping)
        recordings = 1 + max(segment.measured.recording for segment in segments)
        self.count, self.places = len(units), dict[str, Places]()
        wanted, stds, known = [units], [np.full(len(units), np.inf)], [0.0 * units + LARGEST_ERROR]
        for name, std in free.items():
            kind = KINDS[name]
            shape = (recordings if kind.each else 1, kind.size)
            first = sum(map(len, wanted))
            self.places[name] = first + np.arange(shape[0] * shape[1]).reshape(shape)
            wanted.append(np.full(shape[0] * shape[1], kind.unit))
            known.append(np.full(shape[0] * shape[1], kind.known / kind.unit))
            stds.append(np.broadcast_to(np.asarray(std) / kind.unit, shape).ravel())
        self.units, self.weights = np.concatenate(wanted), np.concatenate(stds) ** -2
        self.held = np.zeros((len(self.units),) * 2)  # more information on the start
        self.largest = np.concatenate(known)
        self.start = np.zeros(len(self.units))
        self.start[:self.count] = structure.parameters(start.stiffness, start.damping) / units
        self.near = np.eye(len(self.start))  # directions in which a start is brought near
        if self.count > 2 * STRUCTURES['diagonal'].size:
            others = np.zeros(len(self.start) - self.count)
            own = [np.append(structure.parameters(*pair), others)
                   for unit in STRUCTURES['diagonal'].basis
                   for pair in ((unit, 0.0 * unit), (0.0 * unit, unit))]
            self.near = np.vstack([own / self.units, self.near[self.count:]]).T

    def cup(self, theta: Array) -> Cup:
        """Return the cup of the unknowns, one of those of a gripper."""
        K, P = self._matrices(theta)
        return replace(self.given, stiffness=K, damping=P)

    def own_places(self, segment: Segment) -> dict[str, Places]:
        """Return where a segment's free quantities are, by name."""
        return {name: rows[segment.measured.recording if KINDS[name].each else 0]
                for name, rows in self.places.items()}

    def at(self, other: 'Search', theta: Array) -> Array:
        """Return the unknowns at those of another search with the same cup."""
        there = self.start.copy()
        for name in self.places.keys() & other.places:
            there[self.places[name]] = theta[other.places[name]]
        return there

    def beside(self, found: 'Minimum', more: Free, relaxes: bool = True) -> 'Search':
        """Return a search about a minimum in which more is free, or no relaxation."""
        known = {name: self.units[rows[0]] * self.weights[rows[0]] ** -0.5
                 for name, rows in self.places.items() if relaxes or name != 'relaxation'}
        cup = self.cup(found.theta)
        return Search(self.segments, self.structure, cup if relaxes else replace(
            cup, relaxation=(0.0, 0.0)), {**known, **more})

    def found(
        self, note: Callable[[Cup, float], None], near: Array | None = None,
        begun: System | None = None,
    ) -> Minimum:
        """
        Go to the root, from unknowns near to it, and the system there, where they are given.

        A start is brought near without couplings, which noise would disturb, or with them where a
        misfit remains without. Clocks and frames of each recording are brought near first: as long
        as they are far off, a cup that does not swing explains most.
        """
        everything, start = np.eye(len(self.start)), self.start
        if near is not None:
            return self._stage(near, 0.0, everything, note, begun)
        own = [rows.ravel() for name, rows in self.places.items() if KINDS[name].each]
        if own:
            start = self._stage(start, FORGETS, everything[:, np.concatenate(own)], note).theta
        found = self._stage(start, FORGETS, self.near, note)
        if self.near.shape != everything.shape and not (
                squares(found.parts) < MISFIT * sum(len(own.innovations) for own in found.parts)):
            for segment in self.segments:
                segment.begin()
            found = self._stage(start, FORGETS, everything, note)
        return self._stage(found.theta, 0.0, everything, note)

    def _stage(
        self, theta: Array, forgets: float, directions: Array,
        note: Callable[[Cup, float], None], begun: System | None = None,
    ) -> Minimum:
        """Return the root in some directions, of what the unknown acceleration forgets (1/s)."""
        parts, H, g = begun or self.system(theta, forgets)
        if not np.all(np.isfinite(g)):
            nothing = [own._replace(**{name: np.nan_to_num(getattr(own, name), posinf=0.0)
                                       for name in ('innovations', 'jacobian', 'spread')})
                       for own in parts]
            return Minimum(theta, nothing, np.eye(len(theta)), False)
        least = LEAST_DAMPING if forgets else 0.0
        damping, settled = least, True
        history: list[tuple[Array, Array]] = []  # steps, and how far the search went after each
        end = NEAR if forgets else ENOUGH
        expected = sum(len(own.innovations) for own in parts)  # with noise as it was taken
        for number in range(MOST_NEAR_STEPS if forgets else MOST_STEPS):
            if number >= MOST_OF_MISFIT and squares(parts) > MISFIT * expected:
                break
            step = g
            for _ in range(3):  # as each strength of relaxation may be held by the step, too
                D = directions[:, ~np.any(directions[~self.unbounded(theta, step)], axis=0)]
                step = D @ np.linalg.solve(
                    D.T @ (H + damping * np.diag(np.diag(H))) @ D, D.T @ g)
            way = _mixed(step, H, history)
            there, length = self.moved(theta, way), self.length_of(step, H)
            try:
                new = self.system(there, forgets)
                is_worse = not squares(new[0]) < RISES * max(squares(parts), expected)  # or nan
            except BellowsError:  # no cup is that short or fast, no clock that far off
                is_worse = True
            if is_worse:
                damping = max(10.0 * damping, 1e-2)
                history = []
                continue
            history = [*history, (step, there - theta)][-MIXED:]
            theta, (parts, H, g) = there, new
            self.take(parts)
            settled = forgets > 0.0 or self.take_noise(parts)
            settled &= damping <= MOST_DAMPED
            damping = max(0.1 * damping, least) if damping > 1e-5 else 0.0
            note(self.cup(theta), squares(parts) / expected)
            if length < end and settled:
                break
        self.take_noise(parts)
        return Minimum(theta, parts, H, length < STILL_ENOUGH and settled)

    def unbounded(self, theta: Array, step: Array) -> Mask:
        """Return which unknowns may take a step: no strength of relaxation from zero to below."""
        free = np.ones(len(theta), dtype=bool)
        if 'relaxation' in self.places:
            (own,) = self.places['relaxation']
            r = np.array(self.given.relaxation) + (self.units * theta)[own]
            free[own] = (r > LEAST_STRENGTH) | (step[own] > 0.0)
        return free

    def length_of(self, step: Array, H: Array) -> float:
        """
        Return the squared length of a step in standard errors, at some information.

        What is not identifiable may go on wandering: it does not decide over the others.
        """
        covariance = np.linalg.inv(H)
        known = np.sqrt(np.diag(covariance)) < self.largest
        if not known.any():
            return float(step @ H @ step)
        return float(step[known] @ np.linalg.solve(covariance[np.ix_(known, known)], step[known]))

    def moved(self, theta: Array, step: Array) -> Array:
        """Return unknowns after a step, K and P along a geodesic."""
        there, size = theta + step, self.count // 2
        moved = []
        for M, change in zip(self._matrices(theta), self._matrices(step), strict=True):
            root, inverse = _roots(M)
            values, vectors = np.linalg.eigh(inverse @ change @ inverse)
            half = root @ vectors * np.exp(0.5 * np.clip(values, -LONGEST_WAY, LONGEST_WAY))
            moved.append(half @ half.T)
        there[:2 * size] = self.structure.parameters(*moved) / self.units[:2 * size]
        if 'relaxation' in self.places:
            (own,) = self.places['relaxation']
            there[own] = np.maximum(there[own], -np.array(self.given.relaxation) / self.units[own])
        return there

    def _matrices(self, theta: Array) -> tuple[Array, Array]:
        """Return K and P of unknowns, SI units."""
        return self.structure.matrices((self.units * theta)[:self.count])

    def ordinary_damping(self, stiffness: Array) -> Array:
        """Return the damping (6, 6) with which each mode of the package has one loss factor."""
        held = self.segments[0].measured.payload
        of_lip = np.eye(6)
        of_lip[:3, 3:] = -hat(held.com)
        inertia = np.zeros((6, 6))
        inertia[:3, :3], inertia[3:, 3:] = held.mass * np.eye(3), held.inertia
        root, inverse = _roots(of_lip.T @ inertia @ of_lip)
        P = LOSS_FACTOR * root @ _roots(inverse @ stiffness @ inverse)[0] @ root
        return self.structure.matrices(self.structure.parameters(stiffness, P))[1]

    def _prior(self, theta: Array, forgets: float) -> tuple[Array, Array]:
        """Return information (m, m) and slope (m,) of what was known before."""
        H = np.diag(self.weights) + self.held
        g = H @ (self.start - theta)
        size = self.count // 2
        K, P = self._matrices(theta)
        ends = (K, self._matrices(self.start)[0]), (P, self.ordinary_damping(K))
        for half, (M, first) in enumerate(ends):
            wide = HELD if forgets and half else WIDE[half]
            index = slice(half * size, (half + 1) * size)
            unit = np.array(self.structure.basis) * self.units[index, None, None]
            root, inverse = _roots(M)
            turned = inverse @ unit @ inverse
            values, vectors = np.linalg.eigh(inverse @ first @ inverse)
            back = (vectors * np.log(values)) @ vectors.T
            H[index, index] += np.einsum('aij,bji->ab', turned, turned) / wide**2
            g[index] = np.einsum('aij,ji->a', turned, back) / wide**2
        if 'relaxation' in self.places:  # rubbers differ in the ratio of r2 to r1
            (own,) = self.places['relaxation']
            r = np.array(self.given.relaxation) + (self.units * theta)[own]
            std = RATIO_STD * max(r[0], ORDINARY_STRENGTH)
            by = np.array([-DEFAULT_RATIO, 1.0]) * self.units[own] / std
            H[np.ix_(own, own)] += np.outer(by, by)
            g[own] -= by * (r[1] - DEFAULT_RATIO * r[0]) / std
        return H, g

    def system(self, theta: Array, forgets: float) -> System:
        """Return the whitened segments, and information and slope of the whole."""
        parts = [self.part(theta, segment, forgets) for segment in self.segments]
        H, g = self._prior(theta, forgets)
        for own in parts:
            H = H + own.jacobian.T @ own.jacobian
            g = g + own.jacobian.T @ own.innovations
        return parts, H, g

    def take(self, parts: list[Part]) -> None:
        """Take the likeliest paths and first states; none from a simulation that diverges."""
        for segment, own in zip(self.segments, parts, strict=True):
            if np.isfinite(own.change).all() and all(
                    np.isfinite(part).all() for part in own.first):
                segment.first = own.first
                segment.go(own.change)

    def take_noise(self, parts: list[Part]) -> bool:
        """Take the noise of poses that come slowly; return whether it is as it was."""
        settled = True
        for segment, own in zip(self.segments, parts, strict=True):
            if segment.period * LOW_RATE_HZ > 1.0:
                differences = own.innovations.reshape(-1, 6) * np.sqrt(own.spread)
                seen = (MAD_TO_STD * np.median(np.abs(differences), axis=0)) ** 2
                known = np.median(own.spread, axis=0) - own.own
                before = segment.std
                segment.std = np.sqrt(np.maximum(seen - known, 0.1 * seen))
                settled &= bool(np.all(np.abs(segment.std - before) < SETTLED * before))
        return settled

    def model(self, theta: Array, segment: Segment) -> tuple[ModelTuple, Free]:
        """Return the model of a segment, and what is free in it, SI units."""
        values = self.units * theta
        free = {name: values[places] for name, places in self.own_places(segment).items()}
        cup, measured = self._gripper(theta), segment.measured
        if 'length' in free:
            cup = replace(cup, length=cup.length + float(free['length'][0]))
        if 'relaxation' in free:
            cup = replace(cup, relaxation=_not_below(np.add(cup.relaxation, free['relaxation'])))
        return model_tuple(cup, payload_of(measured.payload, free), measured.gravity), free

    def _gripper(self, theta: Array) -> Cup:
        """Return what is simulated."""
        return gripper_of(self.cup(theta), self.structure.places)

    def _since(self, segment: Segment, stamps: Stamps) -> Array:
        """Return the part of a segment's recording that is over at some stamps (M, 1)."""
        first, *_, last = np.concatenate([
            own.path.stamps_ns[[0, -1]] for own in self.segments
            if own.measured.recording == segment.measured.recording])
        return np.asarray((stamps - first) / (last - first))[:, None]

    def part(self, theta: Array, segment: Segment, forgets: float) -> Part:
        """Return a segment's whitened differences."""
        model, free = self.model(theta, segment)
        nodes = segment.nodes(float(free['time_offset'][0]) if 'time_offset' in free else 0.0)
        raw, noise = segment.package.select(nodes.seen), segment.measured.package_noise
        package = poses_of(raw, free, segment.moves, segment.measured.middle)
        tool = tool_rows(resample(segment.path, nodes.stamps))
        expected, first = (
            adapted(model, row_state(tool[0]), body) for body in (segment.expected, segment.first))
        first = _shrunk(model, tool[0], first, segment.std)
        numbers, moves, delay = self._columns(segment, free, raw)
        count, size, inner = len(nodes.stamps), len(raw), state_count(first)
        is_correlated = noise.correlation > 0.0
        states = inner + (12 if is_correlated else 6)
        lengths = np.diff(nodes.stamps) / NS_PER_S
        noise_correlations = (
            noise.correlation ** (lengths / segment.period) if is_correlated else lengths)
        held, innovations, tool_variances, correlations = segment.tool_noise(nodes)
        own = (SMALLEST if is_correlated else segment.std) ** 2
        S, P = np.zeros((states, len(theta) + 1)), np.zeros((states, states))
        known = np.concatenate([START[:inner], np.zeros(6), segment.std])[:states]
        P[range(states), range(states)] = known**2
        S[:inner, -1] = ahead = _away(first, expected)
        last = WRENCH.start if np.any(numbers[DAMPING.stop:]) else DAMPING.stop
        out, slopes = np.empty((size, 6)), np.empty((size, 6, len(theta)))
        T, B = np.zeros((count, states, states)), np.zeros((count, states, 6))
        B[:, :inner], B[:, inner:inner + 6] = 0.5 * held[:, None, None], np.eye(6)
        gains = np.zeros((size, 6, states + 1))
        steps = substeps_of(lengths, _longest_integration(model, COARSE if forgets else 1.0))
        scales, beyond, reach = np.empty((count, 0)), np.empty(0), np.ones(6)
        if not self.places.keys().isdisjoint(OF_CUP):
            bent = _bent(model, tool, simulate_rows(model, first, tool, lengths, steps))
            reach = bent.max(axis=0)
            scales, beyond = self._of_cup(theta, segment, nodes.stamps, bent)
        whiten(
            model, first, S, P, tool, lengths, steps, innovations, tool_variances, correlations,
            forgets**4 * segment.period * segment.std**2, forgets > 0.0, nodes.place,
            np.column_stack([
                package.position, rotation_to_quaternion(package.rotation), nodes.late]), own,
            segment.std**2, noise_correlations, last, numbers, scales, beyond, delay, moves, out,
            slopes, T, B, gains)
        found, slope = np.zeros((count, 6)), np.zeros(states)
        smooth(out, nodes.place, tool_variances, inner + 6, T, B, gains, found, slope)
        change = np.zeros_like(segment.deviation)
        change[nodes.sampled] = found[nodes.samples]
        nearer = ahead - START[:inner] ** 2 * slope[:inner]
        with np.errstate(divide='ignore'):  # a simulation that diverges has no weights
            variances = gains[:, :, -1] ** -2
        return Part(
            out.ravel(), slopes.reshape(6 * size, -1), variances, own,
            first_order(change, segment.measured.tool_noise.correlation),
            with_mean(first, nearer[:, None]), reach)

    def _of_cup(
        self, theta: Array, segment: Segment, stamps: Stamps, bent: Array
    ) -> tuple[Array, Array]:
        """Return factors (M, m) of columns from node to node, and unknowns (m,) of `OF_CUP`."""
        scales, beyond = np.ones((len(stamps), len(theta))), np.zeros(len(theta))
        K = np.diag(self._gripper(theta).stiffness)
        courses = {'drift': self._since(segment, stamps) - 0.5, 'cubic': bent**2}
        for name in self.places.keys() & courses:
            (places,) = self.places[name]
            scales[:, places], beyond[places] = K * courses[name], theta[places]
        return scales, beyond

    def _columns(self, segment: Segment, free: Free, raw: Trajectory) -> tuple[Array, Array, int]:
        """Return the model's numbers, the package's poses and the delay, by the unknowns."""
        numbers = np.zeros((PARAMETER_COUNT, len(self.units)))
        moves = np.zeros((len(raw), 6, len(self.units)))
        numbers[:DAMPING.stop, :self.count] = self.structure.upper
        places = self.own_places(segment)
        payload = payload_of(segment.measured.payload, free)
        for name, own in places.items():
            numbers[:, own] = model_columns(name, payload, np.eye(PARAMETER_COUNT))
            change = pose_changes(name, raw, segment.moves, segment.measured.middle)
            if change is not None:
                moves[:, :, own] = -change
        delay = int(places['time_offset'][0]) if 'time_offset' in places else -1
        if delay >= 0:
            moves[:, :, delay] = 1.0
        return np.pad(numbers * self.units, ((0, 0), (0, 1))), moves * self.units, delay


def _not_below(strengths: ArrayLike) -> tuple[float, float]:
    """Return strengths of relaxation with which internal strains are followed."""
    r = np.maximum(strengths, LEAST_STRENGTH)
    return float(r[0]), float(r[1])


def squares(parts: Sequence[Part]) -> float:
    """Return the sum of squares."""
    return float(sum(own.innovations @ own.innovations for own in parts))


def _longest_integration(model: ModelTuple, coarse: float) -> float:
    """Return the longest step (s) of the integrator, or refuse a cup that needs too short ones."""
    longest = min(coarse * largest_step(model), LONGEST_INTEGRATION)
    if longest < SHORTEST_INTEGRATION:
        raise BellowsError(
            f'With this cup the simulation needs integration steps of {longest:.2g} s; at least '
            f'{SHORTEST_INTEGRATION:g} s is expected. Check the units of package.mass, '
            'package.inertia, cup.stiffness and cup.damping.')
    return longest


def _mixed(step: Array, H: Array, history: Sequence[tuple[Array, Array]]) -> Array:
    """
    Return the way to go after steps before this one, and how far the search went after each.

    Mixed by Anderson's method (1965). Where K and P are known badly, derivatives have noise and
    change from step to step: a step is too short, or so long that the next turns back.
    """
    if not history:
        return step
    root = np.linalg.cholesky(H).T
    steps, gone = (np.array(own) for own in zip(*history, strict=True))
    turned = np.diff(np.vstack([steps, step]), axis=0)
    part = np.linalg.lstsq(root @ turned.T, root @ step, rcond=SMALLEST_TURN)[0]
    part *= min(1.0, MOST_MIXED / max(np.abs(part).max(), 1e-99))
    return np.asarray(step - part @ (gone + turned))


def _roots(M: Array) -> tuple[Array, Array]:
    """Return the symmetric root of a definite matrix, and its inverse."""
    values, vectors = np.linalg.eigh(M)
    root = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T


def _shrunk(model: ModelTuple, tool: Array, first: State, std: Array) -> State:
    """
    Return a first state that hangs at rest where its pose is within the noise of the poses.

    Noise in it would ring, and that the derivatives would take for motion. Its twist tells nothing
    of that: of a slow camera's poses it is known worse than ordinary swings are large.
    """
    try:
        hanging = rest(model, tool)
    except UnstableError:
        return first
    away = _away(hanging, first)
    size = np.max(np.abs(away[:6]) / std) / SWINGING
    return with_mean(hanging, (1.0 - max(size, 1.0) ** -2) * away[:, None])


def _bent(model: ModelTuple, tool: Array, body: Array) -> Array:
    """Return the displacements (M, 6) of the lip in `BENT`, nan of a simulation that diverges."""
    if not np.isfinite(body).all():
        return np.full((len(body), 6), np.nan)
    back, R = (quaternion_to_rotation(own[:, 3:7]) for own in (tool, body))
    back = np.swapaxes(back, 1, 2)
    o = apply(back, body[:, :3] - apply(R, np.array(model[1][1])) - tool[:, :3])
    way = np.hstack([o + [0.0, 0.0, model[0][1]], log_so3(back @ R)])
    return np.asarray(sizes(way) / BENT)


def _away(body: State, other: State) -> Array:
    """Return what separates a state from another (12,), with internal strains (24,)."""
    shift, turn = pose_error(body, other[0], other[1])
    rest = [np.ravel(np.array(there) - np.array(here))
            for here, there in zip(body[2:], other[2:], strict=True)]
    return np.concatenate([shift, turn, *rest])


def _half_window_of(tool: Trajectory, correlation: float) -> int:
    """
    Return the half window (samples) of the tool's path: the longest that spares the motion.

    Noise in the path is noise in the derivatives, so slow noise needs a long window. Of noise with
    a memory below one sample the shortest leaves little.
    """
    rate = uniform_rate_hz(tool.stamps_ns)
    *longer, short = (max(round(over * rate), FEWEST) for over in SMOOTHED_OVER)
    if correlation < math.exp(-1.0):
        return short
    near, part_near = _taken(tool, short, correlation)
    noise = np.mean(near**2, axis=0) / (1.0 - part_near)
    for half_window in longer:
        far, part = _taken(tool, half_window, correlation)
        more = np.mean((far - near[half_window - short:][:len(far)]) ** 2, axis=0)
        if np.all(more <= MOST_SMOOTHED * (part_near - part) * noise):
            return half_window
    return short


def _taken(tool: Trajectory, half_window: int, correlation: float) -> tuple[Array, float]:
    """Return the innovations (N, 6) of what a window removes, and the part of noise it leaves."""
    path = savgol(tool, half_window, SMOOTHED_ORDER)
    taken = _between(path, tool.select(slice(half_window, len(tool) - half_window)))
    return _innovations(taken, correlation)[1:], float(path.weights[0, half_window])


def _between(path: Trajectory, poses: Trajectory) -> Array:
    """Return shifts and turns (N, 6) from a path to poses, in axes of the path."""
    back = np.swapaxes(path.rotation, 1, 2)
    return np.hstack([
        apply(back, poses.position - path.position), log_so3(back @ poses.rotation)])


def _innovations(noise: Array, correlation: float) -> Array:
    """Return the innovations of noise (S, 6) that is correlated from sample to sample."""
    return np.vstack([noise[:1], noise[1:] - correlation * noise[:-1]])
