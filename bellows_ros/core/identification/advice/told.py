"""What is told about each parameter, in numbers, and in words with what to do about it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bellows_ros.core.identification.structure import AXES, Structure
import numpy as np

SHARE_UNTOLD, SHARE_WEAK = 0.5, 0.05
"""Part of noise in a parameter's equations beyond which it is not told, and is weakly told."""

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
class Told:
    """
    What is told about one parameter.

    Parameters
    ----------
    label : str
        'K x', 'P rz', ...
    value : float
        A first estimate, SI; nan where nothing is told.
    noise_share : float
        Part (0 to 1) of what is told about it by nothing but measurement noise; nan where the
        noise is not known, 1 where nothing is told.
    bias : float
        Expected error of least squares that comes from noise, as a part of the value.

    """

    label: str
    value: float
    noise_share: float
    bias: float

    @property
    def signal_to_noise(self) -> float:
        """Amplitude of what is told by motion over that of noise."""
        if not self.noise_share > 0.0:
            return np.inf if self.noise_share == 0.0 else np.nan
        return float(np.sqrt(max(1.0 / self.noise_share - 1.0, 0.0)))

    @property
    def untold(self) -> bool:
        """Whether the recordings do not tell it."""
        return bool(np.isnan(self.value) or self.noise_share > SHARE_UNTOLD)

    @property
    def weak(self) -> bool:
        """Whether it is told, but least squares will be noticeably off."""
        return not self.untold and bool(
            self.noise_share > SHARE_WEAK or abs(self.bias) > SHARE_WEAK
        )


def advice(
    parameters: Sequence[Told],
    structure: Structure,
    rank: int,
    pairs: Sequence[tuple[str, str, float]],
    source: str,
    biased: bool = True,
) -> Iterator[str]:
    """Yield what the user should know and do; of noise that biases only where it does."""
    size = structure.size
    coupled_untold = []
    for number, entries in enumerate(structure.entries):
        own = (parameters[number], parameters[size + number])
        if all(row == column for row, column in entries):
            yield from _direction_warnings(
                [AXES[row] for row, _ in entries], own, source, biased)
        else:
            coupled_untold += [told.label for told in own if told.untold]
    if coupled_untold:
        yield (
            f'{len(coupled_untold)} couplings of directions ({_some(coupled_untold)}) cannot be '
            f'told from {source}; take a simpler fit.structure, or move all axes at once, '
            'each with frequencies of its own.'
        )
    if rank < len(parameters):
        yield (
            f'Only {rank} of {len(parameters)} combinations of parameters are told at all. '
            'Excite all six directions, or take a simpler fit.structure.'
        )
    for one, other, correlation in pairs[:PAIRS_SHOWN]:
        yield (
            f'{one} and {other} can hardly be told apart (correlation {correlation:+.2f}): their '
            'directions always move together. Move them one without the other.'
        )


def _direction_warnings(
    axes: list[str], own: tuple[Told, Told], source: str, biased: bool
) -> Iterator[str]:
    """Yield what is to be said about a direction's stiffness and damping."""
    what = ('stiffness', 'damping')
    untold = [name for name, told in zip(what, own, strict=True) if told.untold]
    weak = [(name, told) for name, told in zip(what, own, strict=True) if told.weak and biased]
    title, advice = DIRECTIONS[axes[0]]
    if len(axes) > 1:
        title += f' and {axes[1][-1]}'
    if untold:
        yield (
            f'{title} is hardly excited: its {" and ".join(untold)} cannot be told from '
            f'{source}; {advice}.'
        )
    for name, told in weak:
        share = (f'noise makes up {told.noise_share:.0%} of what tells its {name}, and'
                 if told.noise_share > SHARE_WEAK else f'noise disturbs its {name}:')
        yield (
            f'{title} is weakly excited: {share} least squares will find it some '
            f'{abs(told.bias):.0%} too {"small" if told.bias < 0.0 else "large"}. Take '
            f'fit.method: prediction_error, or {advice}.'
        )


def _some(labels: list[str]) -> str:
    """Return the first few labels."""
    shown = ', '.join(labels[:PAIRS_SHOWN])
    return shown + (', ...' if len(labels) > PAIRS_SHOWN else '')
