"""
Whether a recording agrees with the centre of mass and with the cup's length that were given.

A wrong centre of mass leaves a pattern in the wrenches that no stiffness and no damping of a round
cup explains. The shift that explains it is found together with the cup, by Gauss and Newton, each
step a linear problem. Noise looks like a shift along the cup's axis; by how much, is seen by
adding as much noise again. The mass cannot be checked so: K and P scaled with mass and inertia
make the same motion. A wrong length is found likewise, where the cup is moved along its axis: the
weight stretches it by something else then than its stiffness says.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from bellows_ros.core.identification.advice.added_noise import FilterNoise, SEED, with_noise
from bellows_ros.core.identification.noise import Noise
from bellows_ros.core.identification.regression.least_squares import (
    equations,
    least_squares,
    Samples,
    whitening_of,
)
from bellows_ros.core.identification.structure import Structure
from bellows_ros.core.lie import apply
from bellows_ros.core.model import Package
from bellows_ros.core.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = tuple[Array, Array, list[slice]]
"""Whitened equations A x = b, and which of them hang together."""
RowsAt = Callable[[Array], Rows]
"""The equations where something that was given is shifted (m)."""

STEP = 1e-5
"""Shift (m) for derivatives."""

ROUNDS, HALVINGS = 8, 4
LARGEST_STEP, SMALL_STEP = 0.01, 2e-5
"""Metres that one round may go, and below which it is the last."""

WORTH_A_WORD, ERRORS, NOISES = 2e-3, 6.0, 3.0
"""A shift is told that is larger than this (m), so many standard errors, and noise effects."""

LENGTH_WORTH_A_WORD = 2e-4
"""The same for the cup's length, on which K along the axis hangs."""

ENOUGH = 2500
"""Samples of a recording that are looked at, some more."""

QUIET = Noise(1.5e-4, 7e-4)
"""Noise (m, rad) of either body above which a shift along the cup's axis is not judged."""


@dataclass(frozen=True, eq=False)
class CentreOfMass:
    """
    Where the residuals want the centre of mass.

    Parameters
    ----------
    shift, shift_std : ndarray (3,)
        From where it was said to be, in axes of the lip, m, and its standard error.
    noise_shift : ndarray (3,)
        By how much as much noise again moves it, m; infinite where it cannot be judged.
    residual : float
        RMS of the whitened residuals with the shift over that without.

    """

    shift: Array
    shift_std: Array
    noise_shift: Array
    residual: float

    @property
    def off(self) -> bool:
        """Whether the recording contradicts what was given."""
        return bool(np.any(self._told))

    @property
    def _told(self) -> NDArray[np.bool_]:
        """Which coordinates of the shift are no chance and no effect of noise."""
        least = np.maximum(ERRORS * self.shift_std, NOISES * np.abs(self.noise_shift))
        return np.asarray(np.abs(self.shift) > np.maximum(WORTH_A_WORD, least))

    def warning(self, name: str) -> tuple[str, ...]:
        """Return a sentence about a recording, or nothing."""
        if not self.off:
            return ()
        there = ', '.join(
            f'{1e3 * value:+.1f} mm in {axis}'
            for axis, value, told in zip('xyz', self.shift, self._told, strict=True) if told
        )  # fmt: skip
        return (
            f'{name}: the wrenches fit better with the centre of mass {there} from package.com: '
            f'the residuals are then {100.0 * self.residual:.0f} % as large. Check package.com, '
            'cup.length, recording.package_frame, the alignment, and whether one clock stamped '
            'both streams (else set fit.time_offset).',
        )


@dataclass(frozen=True, eq=False)
class CupLength:
    """
    By how much the residuals want the cup longer than was said, its standard error, all m.

    `noise_shift` is by how much as much noise again changes it.
    """

    shift: float
    shift_std: float
    noise_shift: float

    @property
    def off(self) -> bool:
        """Whether the recording contradicts what was given."""
        return abs(self.shift) > max(
            LENGTH_WORTH_A_WORD, ERRORS * self.shift_std, NOISES * abs(self.noise_shift))

    def warning(self, name: str) -> tuple[str, ...]:
        """Return a sentence about a recording, or nothing."""
        if not self.off:
            return ()
        side = 'short' if self.shift > 0.0 else 'long'
        return (
            f'{name}: cup.length seems {1e3 * abs(self.shift):.1f} mm too {side} for how the '
            "package's weight stretches the cup, and K z hangs on it. Measure it under vacuum, or "
            "find it with 'bellows static'; a wrong package.com along z looks the same.",
        )


class Checked(NamedTuple):
    """What a recording says of values that were given; None where it cannot say."""

    length: CupLength | None
    centre: CentreOfMass | None

    def warnings(self, name: str, along: bool) -> tuple[str, ...]:
        """Return what is to be said; of the length only if motion along the cup is told."""
        found = [self.length if along else None, self.centre]
        return tuple(text for check in found if check for text in check.warning(name))


def check_length(
    samples: Samples, cup_length: float, structure: Structure, noise: FilterNoise | None = None
) -> CupLength | None:
    """
    Return by how much longer the residuals want the cup; None where they cannot say.

    Parameters are those of `check_centre_of_mass`.
    """
    samples = samples.thinned(ENOUGH)
    try:
        whitening = whitening_of(_covariance(samples, cup_length, structure))

        def found(measured: Samples, length: float) -> tuple[float, float]:
            shift, std, _ = _found(
                lambda s: whitened_rows(measured, length + float(s[0]), structure, whitening), 1)
            return float(shift[0]), float(std[0])

        shift, std = found(samples, cup_length)
        first = CupLength(shift, std, 0.0)
        if noise is None or not first.off:
            return first
        noisy = with_noise(samples, noise, np.random.default_rng(SEED))
        return replace(first, noise_shift=found(noisy, cup_length + shift)[0])
    except (BellowsError, np.linalg.LinAlgError):
        return None


def check_centre_of_mass(
    samples: Samples, cup_length: float, structure: Structure, lip_recorded: bool,
    noise: FilterNoise | None = None,
) -> CentreOfMass | None:
    """
    Return where the residuals want the centre of mass; None where they cannot say.

    Parameters
    ----------
    samples : Samples
        A prepared recording.
    cup_length : float
        Nominal length l0, m.
    structure : Structure
        Of K and P, axisymmetric or diagonal: couplings of a full one explain a shift as well.
    lip_recorded : bool
        Whether the recorded poses are of the lip, so that a shift moves B, and not S.
    noise : FilterNoise, optional
        Of the recording.

    """
    if structure.name == 'full':
        return None
    samples = samples.thinned(ENOUGH)  # neighbours in a filter window tell the same
    try:
        whitening = whitening_of(_covariance(samples, cup_length, structure))

        def shifts(measured: Samples) -> tuple[Array, Array, float]:
            return _found(
                lambda s: whitened_rows(
                    shifted(measured, s, lip_recorded), cup_length, structure, whitening),
                3,
            )

        shift, std, residual = shifts(samples)
        found = CentreOfMass(shift, std, np.zeros(3), residual)
        if noise is None or not found.off:
            return found
        noisy = with_noise(samples, noise, np.random.default_rng(SEED))
        moved = shifts(shifted(noisy, shift, lip_recorded))[0].copy()
        loudest = np.maximum(noise.tool, noise.package)
        if np.any(loudest > QUIET):
            moved[2] = np.inf
        return replace(found, noise_shift=moved)
    except (BellowsError, np.linalg.LinAlgError):
        return None


def _covariance(samples: Samples, cup_length: float, structure: Structure) -> Array:
    """Return the inverse of the weight that least squares gives the wrenches."""
    return np.asarray(np.linalg.inv(least_squares([samples], cup_length, structure).weight))


def _found(rows_at: RowsAt, size: int) -> tuple[Array, Array, float]:
    """
    Return the shift (m) with the smallest residuals, its standard error, and what is left of them.

    It is found in steps that make the residuals smaller.
    """
    shift, std = np.zeros(size), np.full(size, np.inf)
    first = best = smallest_residuals(rows_at(shift))[1]
    for _ in range(ROUNDS):
        step, std = _step(rows_at, shift)
        step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), SMALL_STEP))
        for _ in range(HALVINGS):
            left = smallest_residuals(rows_at(shift + step))[1]
            if left < best:
                break
            step = 0.5 * step
        else:
            break
        shift, best = shift + step, left
        if np.abs(step).max() < SMALL_STEP:
            break
    return shift, std, float(np.sqrt(best / first)) if first > 0.0 else 1.0


def shifted(samples: Samples, shift: Array, lip_recorded: bool) -> Samples:
    """Return samples with the centre of mass (m, lip axes) elsewhere."""
    held = Package(samples.held.mass, samples.held.inertia, samples.held.com + shift)
    body = samples.package
    if not lip_recorded or body.twist is None or body.acceleration is None:
        return replace(samples, held=held)
    (v, w), (dv, dw) = (np.split(part, 2, axis=1) for part in (body.twist, body.acceleration))
    moved = Trajectory(
        body.stamps_ns, body.position + apply(body.rotation, shift), body.rotation,
        np.hstack([v + np.cross(w, shift), w]), np.hstack([dv + np.cross(dw, shift), dw]),
        body.valid,
    )  # fmt: skip
    return replace(samples, package=moved, held=held)


def whitened_rows(samples: Samples, cup_length: float, structure: Structure, W: Array) -> Rows:
    """Return the whitened A (6 N, p) and b (6 N,) of a recording, and its clusters of rows."""
    A, b, clusters, count = [], [], [], 0
    for block in samples.blocks():
        L, c, parts = equations(block, cup_length, structure)
        A.append((W @ L).reshape(-1, L.shape[2]))
        b.append((c @ W.T).ravel())
        clusters += [slice(6 * (count + p.start), 6 * (count + p.stop)) for p in parts]
        count += len(c)
    return np.concatenate(A), np.concatenate(b), clusters


def smallest_residuals(rows: Rows) -> tuple[Array, float]:
    """Return the parameters with the smallest residuals, and the sum of their squares."""
    A, b, _ = rows
    scale = np.linalg.norm(A, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    x = np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale
    return x, float(np.sum((b - A @ x) ** 2))


def _step(rows_at: RowsAt, shift: Array) -> tuple[Array, Array]:
    """Return the further shift that makes residuals smallest, to first order, and its error."""
    A, b, clusters = rows_at(shift)
    x, _ = smallest_residuals((A, b, clusters))
    slopes = []
    for direction in STEP * np.eye(len(shift)):
        ends = [rows_at(shift + side * direction) for side in (1.0, -1.0)]
        slopes.append(((ends[0][0] - ends[1][0]) @ x - ends[0][1] + ends[1][1]) / (2.0 * STEP))
    Q, _ = np.linalg.qr(A)
    D = np.array(slopes).T
    D -= Q @ (Q.T @ D)  # what the cup explains as well
    inverse = np.linalg.inv(D.T @ D)
    step = inverse @ (D.T @ (b - A @ x))
    left = b - A @ x - D @ step
    scores = np.array([D[part].T @ left[part] for part in clusters])
    return step, np.sqrt(np.diag(inverse @ scores.T @ scores @ inverse))
