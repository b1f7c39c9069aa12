"""How identifiable each parameter is, in numbers, and in words with what to do about it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bellows_ros.core.structure import AXES, Structure
import numpy as np

LARGEST_SHARE, SHARE_WEAK = 0.5, 0.05
"""Noise in a parameter's equations beyond which it is not, and weakly, identifiable."""

PAIRS_SHOWN = 3

DIRECTIONS = {
    'x': ('Sideways motion along x', 'move the tool along x, or tilt it about y, at 1-3 Hz'),
    'y': ('Sideways motion along y', 'move the tool along y, or tilt it about x, at 1-3 Hz'),
    'z': ('Axial motion', 'move the tool up and down at 4-6 Hz'),
    'rx': ('Bending about x', 'tilt the tool about x, or move it along y, at 1-3 Hz'),
    'ry': ('Bending about y', 'tilt the tool about y, or move it along x, at 1-3 Hz'),
    'rz': ('Torsion', 'turn the tool about z at 1-3 Hz'),
}
"""What moves, and what would make it move."""


@dataclass(frozen=True, eq=False)
class Axis:
    """
    How one direction is excited.

    Parameters
    ----------
    name : str
        'x' to 'rz'.
    strain, motion : float
        RMS of the lip's displacement in the tool from the nominal pose, and from its own mean; m
        or rad.
    twist : float
        RMS of its velocity, m/s or rad/s.
    band_hz : (float, float)
        Frequencies between which 90 % of the velocity's power lies; nan where nothing moves.
    strain_noise, twist_noise : float
        Standard deviation of the noise in them after filtering; nan where it is not known.

    """

    name: str
    strain: float
    motion: float
    twist: float
    band_hz: tuple[float, float]
    strain_noise: float
    twist_noise: float


@dataclass(frozen=True, eq=False)
class Identifiability:
    """
    How identifiable one parameter is.

    Parameters
    ----------
    label : str
        'K x', 'P rz', ...
    value : float
        A first estimate, SI; nan where it is not identifiable.
    noise_share : float
        Part (0 to 1) of the information on it that is nothing but measurement noise; nan where
        the noise is not known, 1 where there is no other.
    bias : float
        Expected error of least squares that comes from noise, as a part of the value.

    """

    label: str
    value: float
    noise_share: float
    bias: float

    @property
    def signal_to_noise(self) -> float:
        """Amplitude of the information from motion over that from noise."""
        if not self.noise_share > 0.0:
            return np.inf if self.noise_share == 0.0 else np.nan
        return float(np.sqrt(max(1.0 / self.noise_share - 1.0, 0.0)))

    @property
    def identifiable(self) -> bool:
        """Whether there is information on it beside that of noise."""
        return not (np.isnan(self.value) or self.noise_share > LARGEST_SHARE)

    @property
    def weak(self) -> bool:
        """Whether it is identifiable, but least squares will be noticeably off."""
        return self.identifiable and bool(
            self.noise_share > SHARE_WEAK or abs(self.bias) > SHARE_WEAK
        )


def advice(
    parameters: Sequence[Identifiability],
    structure: Structure,
    rank: int,
    pairs: Sequence[tuple[str, str, float]],
    source: str,
    biased: bool = True,
) -> Iterator[str]:
    """Yield what the user should know and do; of noise that biases only where it does."""
    size = structure.size
    coupled = []
    for number, entries in enumerate(structure.entries):
        own = (parameters[number], parameters[size + number])
        if entries[0][0] == entries[0][1]:
            yield from _direction_warnings(
                [AXES[row] for row, _, _ in entries], own, source, biased)
        else:
            coupled += [each.label for each in own if not each.identifiable]
    if coupled:
        yield (
            f'{len(coupled)} couplings of directions ({_some(coupled)}) are not identifiable from '
            f'{source}; take a simpler fit.structure, or move all axes at once, each with '
            'frequencies of its own.'
        )
    if rank < len(parameters):
        yield (
            f'Only {rank} of {len(parameters)} combinations of parameters are identifiable. '
            'Excite all six directions, or take a simpler fit.structure.'
        )
    for one, other, correlation in pairs[:PAIRS_SHOWN]:
        yield (
            f'{one} and {other} can hardly be separated (correlation {correlation:+.2f}): their '
            'directions always move together. Move them one without the other.'
        )


def _direction_warnings(
    axes: list[str], own: tuple[Identifiability, Identifiability], source: str, biased: bool
) -> Iterator[str]:
    """Yield what is to be said about a direction's stiffness and damping."""
    what = ('stiffness', 'damping')
    unknown = [name for name, each in zip(what, own, strict=True) if not each.identifiable]
    weak = [(name, each) for name, each in zip(what, own, strict=True) if each.weak and biased]
    title, advice = DIRECTIONS[axes[0]]
    if len(axes) > 1:
        title += f' and {axes[1][-1]}'
    if unknown:
        verb = 'are' if len(unknown) > 1 else 'is'
        yield (
            f'{title} is hardly excited: its {" and ".join(unknown)} {verb} not identifiable from '
            f'{source}; {advice}.'
        )
    for name, each in weak:
        share = (f'{each.noise_share:.0%} of the information on its {name} is noise, and'
                 if each.noise_share > SHARE_WEAK else f'noise disturbs its {name}:')
        yield (
            f'{title} is weakly excited: {share} least squares will find it some '
            f'{abs(each.bias):.0%} too {"small" if each.bias < 0.0 else "large"}. Take '
            f'fit.method: prediction_error, or {advice}.'
        )


def _some(labels: list[str]) -> str:
    """Return the first few labels."""
    shown = ', '.join(labels[:PAIRS_SHOWN])
    return shown + (', ...' if len(labels) > PAIRS_SHOWN else '')
