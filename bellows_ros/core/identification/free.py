"""Quantities estimated together with K and P: those in fit.free, and package_world."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification import variations
from bellows_ros.core.identification.objective import (
    covariance_of,
    DRAWS,
    Ensemble,
    ensemble_of,
    inverse_of,
    Objective,
    Solved,
)
from bellows_ros.core.identification.variations import Given, Variation
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.recording.alignment import Alignment, closed_form, motion_of
from bellows_ros.core.recording.recording import Recording, TimeOffset
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
import numpy as np

ROUNDS, HALVINGS = 12, 5

CONVERGED = 0.05
"""Converged when a step is shorter than this fraction of the standard error."""


class Block(NamedTuple):
    """
    Numbers that are varied together.

    Parameters
    ----------
    name : str
        As in fit.free.
    vary : Variation
        What they do to a recording.
    steps : tuple of float
        Change of each for derivatives.
    starts : callable
        Numbers that are tried first, of a recording: where the weight stretches the cup by less
        than what is off, its stiffness has the wrong sign in a false minimum.
    furthest : float
        No round goes further than so many steps.
    each : bool
        Whether each recording has its own.

    """

    name: str
    vary: Variation
    steps: tuple[float, ...]
    starts: Callable[[Given], Iterable[Array]] = lambda given: ()
    furthest: float = 200.0
    each: bool = False

    def size(self, recordings: int) -> int:
        """Return the number of unknowns for a number of recordings."""
        return len(self.steps) * (recordings if self.each else 1)


class Refined(NamedTuple):
    """Numbers (n,), their covariance (n, n), infinite where not identifiable, and what is left."""

    theta: Array
    covariance: Array
    solved: Solved

    @property
    def std(self) -> Array:
        """Standard errors (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def varied(blocks: Sequence[Block], theta: Array) -> Callable[[Sequence[Given]], list[Given]]:
    """Return recordings varied by the unknowns of blocks, one block after the other."""
    def vary(given: Sequence[Given]) -> list[Given]:
        """Return the recordings varied."""
        changed, first = list(given), 0
        for block in blocks:
            width = len(block.steps)
            for number, own in enumerate(changed):
                start = first + (number * width if block.each else 0)
                changed[number] = block.vary(own, theta[start:start + width])
            first += block.size(len(given))
        return changed
    return vary


def refine(
    objective: Objective, ensemble: Ensemble, blocks: Sequence[Block], start: Array | None = None,
    rounds: int = ROUNDS,
) -> Refined:
    """
    Return the numbers of blocks with which noise explains most.

    They are looked for from a start, or from 0 and the starts of blocks where none is given.
    """
    count = len(ensemble.given)
    steps = np.concatenate([np.tile(b.steps, b.size(count) // len(b.steps)) for b in blocks])
    far = np.concatenate([np.full(b.size(count), b.furthest) for b in blocks]) * steps

    def at(theta: Array) -> Solved:
        """Return the residuals at given unknowns."""
        return objective.solved(ensemble.varied(varied(blocks, theta)))

    theta = _first(objective, ensemble, blocks, len(steps)) if start is None else start
    here = at(theta)
    for _ in range(rounds):
        gradient, D = _derivatives(at, theta, here, steps)
        step = -inverse_of(D.T @ D)[0] @ gradient
        step *= min(1.0, float(np.min(far / np.maximum(np.abs(step), 1e-300))))
        for _ in range(HALVINGS):
            further = at(theta + step)
            if further.excess < here.excess:
                break
            step = 0.5 * step
        else:
            return Refined(theta, covariance_of(here, D), here)
        theta, here = theta + step, further
        covariance = covariance_of(here, D)
        if np.all(np.abs(step) <= CONVERGED * np.sqrt(np.diag(covariance))):
            break
    return Refined(theta, covariance, here)


def _first(
    objective: Objective, ensemble: Ensemble, blocks: Sequence[Block], size: int
) -> Array:
    """Return the numbers (size,) among the starts of blocks that explain most, 0 without any."""
    theta, first, count = np.zeros(size), 0, len(ensemble.given)
    quiet = Ensemble(ensemble.given, ())
    least = objective.solved(quiet).excess
    for block in blocks:
        width = len(block.steps)
        for number in range(block.size(count) // width):
            place = first + number * width
            for value in block.starts(ensemble.given[number]):
                there = theta.copy()
                there[place:place + width] = value
                excess = objective.solved(quiet.varied(varied(blocks, there))).excess
                if excess < least:
                    theta, least = there, excess
        first += block.size(count)
    return theta


def _derivatives(
    at: Callable[[Array], Solved], theta: Array, here: Solved, steps: Array
) -> tuple[Array, Array]:
    """Return half the gradient (n,) of the sum of squares, and the residuals' Jacobian (N, n)."""
    gradient, columns = np.zeros(len(theta)), []
    for i, step in enumerate(steps):
        change = np.zeros(len(theta))
        change[i] = step
        after, before = at(theta + change), at(theta - change)
        gradient[i] = 0.25 * here.residuals * (after.excess - before.excess) / step
        columns.append(
            ((after.rows.A - before.rows.A) @ here.x - after.rows.b + before.rows.b)
            / (2.0 * step))
    D = np.column_stack(columns)
    return gradient, D - here.basis @ (here.basis.T @ D)  # what the cup explains as well


RASTER = 0.01
"""Spacing (s) of the offsets tried first; up to 10 Hz the residuals have one minimum within it."""

LARGEST_ERROR = 3e-4
"""Largest standard error (s) of an identifiable time offset."""

WORLD_ERROR = 5e-3
"""Largest standard error (m, rad) of an identifiable transform between two worlds."""

BEYOND_RANGE = 0.9
"""If residuals at the largest offset fall below this fraction, the true offset is larger."""

FEWEST_SECONDS = 3.0
"""Shortest duration of valid samples (s) for an estimate."""

SLIPS_TRIED, LEAST_SLIP = 12, 2e-3
"""Times at which slips are tried, and their size, m."""

STARTS_ALONG_Z = np.array([-8e-3, -4e-3, -2e-3, -1e-3, 1e-3, 2e-3, 4e-3, 8e-3])
"""The same of lengths, m."""


def _worlds(given: Given) -> list[Array]:
    """Return motions (6,) of the package's world: along z, also from that of one rigid body."""
    tool, package = given.samples.tool, given.samples.package
    pose = closed_form(tool, package, given.length, -given.samples.payload.com, False)
    rigid = motion_of(pose, package.position[package.valid].mean(axis=0))
    along = np.outer([0.0, *STARTS_ALONG_Z], np.eye(6)[2])
    return [*along[1:], *(rigid + along)]


BLOCKS = {
    'time_offset': Block('time_offset', variations.time_offset, (1e-4,), lambda given:
                         RASTER * np.arange(-20, 21)[:, None], 100.0, True),
    'com': Block('com', variations.com, (1e-5,) * 3, lambda given:
                 np.outer(STARTS_ALONG_Z, np.eye(3)[2]), 1000.0),
    'length': Block('length', variations.length, (1e-5,), lambda given:
                    STARTS_ALONG_Z[:, None], 500.0),
    'inertia': Block('inertia', variations.inertia, (1e-3,) * 3, furthest=1000.0),
    'mass': Block('mass', variations.mass, (1e-3,), furthest=1000.0),
    'package_world': Block(
        'package_world', variations.package_world, (1e-5,) * 6, _worlds, 5000.0, True),
    'grip': Block('grip', variations.grip, (1e-5,) * 5, furthest=5000.0, each=True),
}
"""Blocks by their names in fit.free; package_world includes the grip and the alignment."""

TILT = Block('gravity.direction', variations.tilt, (1e-4,) * 2, furthest=1000.0)
"""Of the world's z against gravity."""

SCALE = Block('inertia', variations.inertia, (1e-3,), furthest=1000.0)
"""A common factor of all moments of inertia; with K and P free, equivalent to the mass."""


def slip(given: Given) -> Block:
    """Return a slip of the package in one recording, tried at times and to sides all over it."""
    stamps = given.samples.package.stamps_ns
    times = np.linspace(0.0, float(stamps[-1] - stamps[0]) / NS_PER_S, SLIPS_TRIED + 2)[1:-1]
    starts = [np.array([*way, when]) for when in times
              for way in LEAST_SLIP * np.concatenate([np.eye(2), -np.eye(2)])]
    return Block('slip', variations.slip(int(stamps[0])), (1e-5, 1e-5, 1e-2),
                 lambda own: starts, 200.0)


class RefinedPreparation(NamedTuple):
    """
    Estimates for one recording, None if not wanted or not identifiable.

    The motion of the package's world (6,) about a point (3,), its standard errors (6,), the
    alignment that belongs to it, and the time offset.
    """

    world: Array | None
    world_std: Array
    middle: Array
    alignment: Alignment | None
    offset: TimeOffset | None


def refined_preparation(
    recording: Recording, length: float, structure: Structure, world: bool, offset: bool,
    rough: bool = False,
) -> RefinedPreparation:
    """
    Find the package's world and the time offset of a recording, together with K and P.

    Parameters
    ----------
    recording : Recording
        Prepared with a first guess of the world.
    length : float
        Of the cup, m.
    structure : Structure
        Of K and P.
    world, offset : bool
        Which of the two is wanted. Where alignment at rest was made, the grip's offset and turn
        are found with the world.
    rough : bool
        Whether it is for a better first guess alone, without regard to noise.

    Raises
    ------
    BellowsError
        If the offset is beyond those looked for, or the world is not identifiable.

    """
    names = [*(['time_offset'] if offset else []), *(['package_world'] if world else []),
             *(['grip'] if world and recording.settings.align_at_rest else [])]
    ensemble = ensemble_of([recording], length, structure, 0 if rough else DRAWS)
    if ensemble.seconds < FEWEST_SECONDS:
        return RefinedPreparation(None, np.zeros(6), np.zeros(3), None, None)
    body = recording.package
    middle = body.position[body.valid].mean(axis=0)
    objective = Objective.of(ensemble)
    found = refine(objective, ensemble, [BLOCKS[name] for name in names])
    theta, std = found.theta, found.std
    taken = None
    if offset:
        fallen = found.solved.excess < BEYOND_RANGE * objective.solved(ensemble).excess
        taken = _offset(float(theta[0]), float(std[0]), fallen)
        theta, std = theta[1:], std[1:]
    if not world:
        return RefinedPreparation(None, np.zeros(6), middle, None, taken)
    if not (rough or np.all(std[:6] < WORLD_ERROR)):
        raise BellowsError(
            'recording.package_world is not identifiable from this recording: the standard '
            f'errors are {_listed(1e3 * std[:3])} mm and {_listed(1e3 * std[3:6])} mrad. Tilt '
            'and turn the tool more, best with three standstills tilted to different sides, or '
            'set its seven numbers.'
        )
    alignment = _gripped(recording, theta[6:11]) if 'grip' in names else recording.alignment
    return RefinedPreparation(theta[:6], std[:6], middle, alignment, taken)


def _offset(value: float, std: float, fallen: bool) -> TimeOffset | None:
    """Return a time offset, or None if it is not identifiable."""
    if abs(value) > variations.LARGEST_OFFSET - RASTER / 2.0 and fallen:
        raise BellowsError(
            f'The stamps of tool and package are {1e3 * variations.LARGEST_OFFSET:g} ms or more '
            'apart, the limit of fit.time_offset. Shift the stamps of one topic by the known '
            'delay.'
        )
    return TimeOffset(value, std) if std < LARGEST_ERROR else None


def _gripped(recording: Recording, theta: Array) -> Alignment:
    """Return the alignment of a recording with the grip moved and turned by theta (5,)."""
    known, R = recording.alignment, exp_so3(theta[2:])
    way = np.array([theta[0], theta[1], 0.0])
    # B' is at R_B way from B, and origin_to_com is in axes of the lip, which has turned by R.
    return replace(
        known, R_package_markers_lip=known.R_package_markers_lip @ R,
        origin_to_com=R.T @ (known.origin_to_com + way), lateral_offset=known.lateral_offset - way)


def _listed(values: Array) -> str:
    """Return numbers in words."""
    return ', '.join(f'{x:.2g}' for x in values)
