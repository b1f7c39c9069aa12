"""
Identifiability of a cup's parameters from recordings.

Information on a parameter grows with the motion's sensitivity to it. Sensor noise resembles motion
and biases least squares towards zero (errors in variables); the bias is compensated if the noise
is given.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from bellows_ros.core.identification.reduction import Movement
from bellows_ros.core.identification.result import Fit, NOTE_TEXTS, NOTES, with_unidentifiable
from bellows_ros.core.identification.samples import joined
from bellows_ros.core.model.structure import Structure, structure_named
from bellows_ros.core.signals.residuals import AXES
import numpy as np

WEAK_SHARE = 0.05
"""Noise share in a parameter's equations above which it is only weakly identifiable."""

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


MAX_CORRELATION = 0.95
"""Correlation of two estimates above which they can hardly be separated."""


class Excitation(NamedTuple):
    """
    The identifiability of all parameters from recordings.

    Parameters
    ----------
    axes : tuple of Axis
        The six directions.
    parameters : tuple of Identifiability
        The free parameters.
    rank : int
        Number of identifiable parameters.
    pairs : tuple of (str, str, float)
        Pairs of parameters that can hardly be separated, and the correlation of their estimates.
    warnings : tuple of str
        Sentences with facts and advice for the user.

    """

    axes: tuple[Axis, ...]
    parameters: tuple[Identifiability, ...]
    rank: int
    pairs: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]


def excitation_of(movements: Sequence[Movement], fit: Fit) -> Excitation:
    """
    Return the identifiability of K and P from the motions of recordings and their fit.

    The bias by noise is of least squares alone.
    """
    structure, axes, covariance = structure_named(fit.structure), _axes(movements), fit.covariance
    identifiable = np.isfinite(np.diag(covariance))
    shares = bias = np.full(len(covariance), np.nan)
    if fit.noise_share is not None and fit.bias is not None:
        shares = fit.noise_share
        with np.errstate(divide='ignore', invalid='ignore'):
            bias = np.where(shares < 1.0, np.clip(fit.bias / fit.parameters, -1.0, 1.0), np.nan)
    parameters = tuple(map(
        Identifiability, fit.labels, np.where(identifiable, fit.parameters, np.nan).tolist(),
        shares.tolist(), bias.tolist()))
    std = np.where(identifiable, np.sqrt(np.diag(covariance)), 1.0)
    correlation = with_unidentifiable(covariance, ~identifiable) / np.outer(std, std)
    correlated = np.argwhere(np.triu(np.abs(correlation), 1) > MAX_CORRELATION).tolist()
    pairs = tuple((fit.labels[i], fit.labels[j], float(correlation[i, j]))
                  for i, j in sorted(correlated, key=lambda pair: -abs(correlation[*pair])))
    source = 'this recording' if len(movements) == 1 else 'these recordings'
    warnings = () if fit.method == 'output_error' else tuple(
        advice(parameters, structure, pairs, source))
    return Excitation(axes, parameters, int(np.count_nonzero(identifiable)), pairs, warnings)


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
