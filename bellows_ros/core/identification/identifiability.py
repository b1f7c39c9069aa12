"""
Identifiability of a cup's parameters from recordings, before a fit.

Information on a parameter grows with the motion's sensitivity to it. Sensor noise resembles motion
and biases least squares towards zero (errors in variables); the bias is compensated if the noise
is given.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.least_squares import LinearSolution, noise_bias, weighted
from bellows_ros.core.identification.pool import Held
from bellows_ros.core.identification.reduction import (
    Movement,
    PassBand,
    ReducedRecording,
    Statistics,
)
from bellows_ros.core.identification.result import NOTE_TEXTS, NOTES, with_unidentifiable
from bellows_ros.core.identification.samples import joined
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.signals.residuals import AXES
import numpy as np

MAX_SHARE, WEAK_SHARE = 0.5, 0.05
"""Noise share in a parameter's equations above which it is not, or only weakly, identifiable."""

MAX_LISTED = 3
"""Largest number of pairs or couplings named in a warning."""

DIRECTIONS: Mapping[str, tuple[str, str]] = NOTE_TEXTS['directions']
"""Motion in each direction, and its excitation."""


def remedy_for(axis: str, structure: Structure) -> str:
    """Return the remedy for an unidentifiable direction, with regard to a gripper's other cups."""
    if structure.places and axis.startswith('r'):
        return NOTES['of_one_cup']
    return DIRECTIONS.get(axis, ('', 'move all axes at once'))[1]


class Axis(NamedTuple):
    """
    Excitation of one direction.

    Parameters
    ----------
    name : str
        'x' to 'rz'.
    strain, motion : float
        RMS of the lip's displacement in the tool from the nominal pose, and from its mean; m or
        rad.
    twist : float
        RMS of the velocity, m/s or rad/s.
    band_hz : (float, float)
        Frequencies between which 90 % of the velocity's power lies; nan without motion.
    strain_noise, twist_noise : float
        Standard deviations of the noise in strain and twist after filtering.

    """

    name: str
    strain: float
    motion: float
    twist: float
    band_hz: tuple[float, float]
    strain_noise: float
    twist_noise: float


class Identifiability(NamedTuple):
    """
    Identifiability of one parameter.

    Parameters
    ----------
    label : str
        'K x', 'P rz', ...
    value : float
        Estimate, SI units; nan if not identifiable.
    noise_share : float
        Share (0 to 1) of measurement noise in least squares' information on the parameter; nan if
        the noise is not given, or for another method; 1 if there is only noise.
    bias : float
        Expected relative error of least squares by noise; nan if the noise share is.

    """

    label: str
    value: float
    noise_share: float
    bias: float

    @property
    def signal_to_noise(self) -> float:
        """Amplitude ratio of the information from motion and from noise."""
        if not self.noise_share > 0.0:
            return np.inf if self.noise_share == 0.0 else np.nan
        return float(np.sqrt(max(1.0 / self.noise_share - 1.0, 0.0)))

    @property
    def identifiable(self) -> bool:
        """Whether the standard error is below half the parameter's size."""
        return not np.isnan(self.value)

    @property
    def weak(self) -> bool:
        """Whether the parameter is identifiable, but depends on the noise compensation."""
        return self.identifiable and max(self.noise_share, abs(self.bias)) > WEAK_SHARE


def advice(
    parameters: Sequence[Identifiability], structure: Structure,
    pairs: Sequence[tuple[str, str, float]], source: str,
) -> Iterator[str]:
    """Yield advice to the user."""
    size = structure.size
    coupled = []
    for entries, *both in zip(
            structure.entries, parameters[:size], parameters[size:], strict=True):
        if entries[0][0] == entries[0][1]:
            yield from _direction_warnings(
                [AXES[row] for row, _, _ in entries], both, source, structure)
        else:
            coupled += [each.label for each in both if not each.identifiable]
    if coupled:
        names = ', '.join([*coupled[:MAX_LISTED], *(['...'] if coupled[MAX_LISTED:] else [])])
        yield NOTES['couplings'].format(count=len(coupled), names=names, source=source)
    for one, other, correlation in pairs[:MAX_LISTED]:
        yield NOTES['inseparable'].format(one=one, other=other, correlation=correlation)


def _direction_warnings(
    axes: list[str], both: Sequence[Identifiability], source: str, structure: Structure,
) -> Iterator[str]:
    """Yield warnings about stiffness and damping of a direction."""
    named = dict(zip(('stiffness', 'damping'), both, strict=True))
    unknown = [name for name, each in named.items() if not each.identifiable]
    title = ' and '.join([DIRECTIONS[axes[0]][0], *(axis[-1] for axis in axes[1:2])])
    remedy = remedy_for(axes[0], structure)
    if unknown:
        yield NOTES['hardly_excited'].format(
            title=title, unknown=' and '.join(unknown), are='are' if unknown[1:] else 'is',
            source=source, remedy=remedy)
    for name, each in named.items():
        if each.weak:
            share = (f'{each.noise_share:.0%} of the information on its {name} is noise:'
                     if each.noise_share > WEAK_SHARE else f'noise disturbs its {name}:')
            yield NOTES['weakly_excited'].format(
                title=title, share=share, bias=abs(each.bias), remedy=remedy)


MIN_HALF_WINDOW = 4
"""Shortest half window (samples) for polynomials of order 6."""


def too_fast(axes: Sequence[Axis], passed: Sequence[PassBand]) -> Iterator[str]:
    """
    Yield a warning for each direction with motion beyond the filter's pass band.

    Parameters
    ----------
    axes : sequence of Axis
        The six directions.
    passed : sequence of PassBand
        Pass band of each recording.

    """
    too_much = (np.sum([band.removed for band in passed], axis=0)
                > np.sum([band.limit for band in passed], axis=0))
    first = min(passed, key=lambda band: band.end_hz)
    for axis, is_removed in zip(axes, too_much, strict=True):
        if not is_removed:
            continue
        end, fastest = first.end_hz, axis.band_hz[1]
        tool, package = (max(int(n * end / fastest), MIN_HALF_WINDOW) for n in first.half_windows)
        yield NOTES['too_fast'].format(
            title=DIRECTIONS[axis.name][0], fastest=fastest, end=end, shorter=NOTES[
                'shorter'].format(tool=tool, package=package) if fastest > end else '')


MAX_CORRELATION = 0.95
"""Correlation of two estimates above which they can hardly be separated."""


class Excitation(NamedTuple):
    """
    The identifiability of all parameters from recordings.

    Parameters
    ----------
    structure : str
        Requested structure of K and P.
    axes : tuple of Axis
        The six directions.
    parameters : tuple of Identifiability
        The free parameters.
    rank, size : int
        Number of identifiable combinations of parameters, and number of parameters.
    condition_number : float
        Condition number of the whitened equations with columns of unit length.
    pairs : tuple of (str, str, float)
        Pairs of parameters that can hardly be separated, and the correlation of their estimates.
    warnings : tuple of str
        Sentences with facts and advice for the user.

    """

    structure: str
    axes: tuple[Axis, ...]
    parameters: tuple[Identifiability, ...]
    rank: int
    size: int
    condition_number: float
    pairs: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]


def excitation_of(
    parts: Sequence[ReducedRecording], method: str = 'least_squares',
    fit: tuple[Array, Array] | None = None, rows: Held | None = None,
) -> Excitation:
    """
    Return the identifiability of K and P from recordings.

    With a fit, its standard errors decide; without, the shares of noise in the information.

    Parameters
    ----------
    parts : sequence of ReducedRecording
        Recordings, reduced.
    method : str
        Method of the fit: the bias of least squares by noise and fast motion is not judged for
        another method.
    fit : (ndarray (2 n,), ndarray (2 n, 2 n)), optional
        Parameters and their covariance, if estimated already.
    rows : Held, optional
        Statistics of the recordings, if they are elsewhere.

    Raises
    ------
    BellowsError
        If there is no valid sample.

    """
    statistics, movements = [part.statistics for part in parts], [part.movement for part in parts]
    structure = statistics[0].structure
    whitening, solved, noise = weighted(statistics if rows is None else rows.pool.begun(
        _in_structure, structure, rows))
    axes, is_filtered = _axes(movements), method == 'least_squares'
    shares = bias = np.full(len(solved.x), np.nan)
    if is_filtered and noise is not None:
        shares, bias = _noise_effects(noise, whitening, solved)
    values, covariance = fit or (solved.x, solved.inverse @ solved.inverse.T)
    identifiable = (np.isfinite(np.diag(covariance)) if fit else
                    solved.identifiable & ~(shares > MAX_SHARE))
    std = np.where(identifiable, np.sqrt(np.diag(covariance)), 1.0)
    parameters = tuple(map(
        Identifiability, structure.labels, np.where(identifiable, values, np.nan).tolist(),
        (np.where(solved.identifiable, shares, 1.0) if is_filtered else shares).tolist(),
        bias.tolist()))
    correlation = with_unidentifiable(covariance, ~identifiable) / np.outer(std, std)
    correlated = np.argwhere(np.triu(np.abs(correlation), 1) > MAX_CORRELATION).tolist()
    pairs = tuple((structure.labels[i], structure.labels[j], float(correlation[i, j]))
                  for i, j in sorted(correlated, key=lambda pair: -abs(correlation[*pair])))
    source = 'this recording' if len(parts) == 1 else 'these recordings'
    fast = too_fast(axes, [movement.passed for movement in movements]) if is_filtered else ()
    rank = int(np.count_nonzero(identifiable)) if fit else solved.rank
    return Excitation(
        structure.name, axes, parameters, rank, len(values), solved.condition_number, pairs,
        (*(advice(parameters, structure, pairs, source) if method != 'output_error' else ()),
         *fast))


def _in_structure(structure: Structure, part: Statistics) -> tuple[Statistics, None]:
    """Return the statistics of a recording in a structure, to be kept."""
    return part.of(structure), None


def _noise_effects(
    noise: Array, whitening: Array, solution: LinearSolution
) -> tuple[Array, Array]:
    """
    Return the share of noise (6, q, 6, q) in the information on each parameter, and its bias.

    The share is the noise's energy in a parameter's column, over the energy of the part of this
    column that is orthogonal to all others. The bias is at most the parameter's size.
    """
    energy = np.einsum('ij,ipjp->p', whitening.T @ whitening, noise)[:-1]
    bias, *_ = noise_bias(noise, whitening, solution.x, solution.inverse)
    with np.errstate(divide='ignore', invalid='ignore'):
        relative = np.clip(bias / (solution.x - bias), -1.0, 1.0)
    return (np.minimum(energy * np.sum(solution.inverse**2, axis=1), 1.0),
            np.where(solution.identifiable, relative, np.nan))


def _axes(parts: Sequence[Movement]) -> tuple[Axis, ...]:
    """Return the excitation of the six directions."""
    strain, twist, strain_noise, twist_noise = (
        joined(getattr(part, kind) for part in parts)
        for kind in ('strain', 'twist', 'strain_noise', 'twist_noise'))
    low, high = np.array([part.bands_hz for part in parts]).swapaxes(0, 1)
    columns = np.array([
        np.hypot(strain.mean, strain.std), strain.std, np.hypot(twist.mean, twist.std),
        np.fmin.reduce(low), np.fmax.reduce(high), strain_noise.std, twist_noise.std])
    return tuple(
        Axis(name, lip, motion, rate, (lowest, highest), lip_noise, rate_noise)
        for name, (lip, motion, rate, lowest, highest, lip_noise, rate_noise)
        in zip(AXES, columns.T.tolist(), strict=True))
