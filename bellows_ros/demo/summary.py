"""The final message of the demonstration."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bellows_ros.cli.console import aligned, percent
from bellows_ros.cli.identify import cup_table
from bellows_ros.core.residuals import AXES, Scores
import numpy as np

if TYPE_CHECKING:
    from bellows_ros.core.identification.result import Fit
    from bellows_ros.nodes.demo_player import Exchange

MILLI = 1e3
MICRO = 1e6


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    All that the demonstration has found.

    Parameters
    ----------
    fit : Fit
        The identified cup.
    scores : Scores
        Of the node's predictions.
    exchange : Exchange
        What went to the node and what came back.
    duration : float
        Of the recording played, s.
    noise : mapping
        Standard deviation of the noise that the recording's measured poses were given in each
        axis, as position (m) and rotation (rad); empty where it is not known.

    """

    fit: 'Fit'
    scores: Scores
    exchange: 'Exchange'
    duration: float
    noise: Mapping[str, float]

    @property
    def answers(self) -> int:
        """Poses with a prediction."""
        return len(np.unique(self.exchange.stamps_ns))

    @property
    def lost(self) -> int:
        """Poses without a prediction."""
        return self.exchange.sent_poses - self.answers


def summary(outcome: Outcome) -> Iterator[str]:
    """Yield the lines: the cup, the errors, the latency, the messages."""
    yield 'The cup, with standard errors:'
    yield from _indented(cup_table(outcome.fit))
    yield ''
    yield 'The package relative to the tool, predicted live minus measured (RMS):'
    rows = [('axis', 'error', 'of the motion', 'axis', 'error', 'of the motion')]
    rms, nrmse = outcome.scores.rms * MILLI, outcome.scores.nrmse
    for i in range(3):
        rows.append((
            AXES[i], f'{rms[i]:.3f} mm', percent(nrmse[i]),
            f'  {AXES[i + 3]}', f'{rms[i + 3]:.3f} mrad', percent(nrmse[i + 3])))
    yield from _indented(aligned(rows, right=True))
    if outcome.noise:
        position, rotation = (
            outcome.noise.get(part, 0.0) * MILLI for part in ('position', 'rotation'))
        yield f'  (the measured poses themselves have noise: {position:g} mm, {rotation:g} mrad)'
    yield ''
    exchange = outcome.exchange
    median, high = np.percentile(exchange.latency, (50, 99)) * MICRO
    yield (f'Latency, from sending a pose to receiving its prediction: p50 {median:.0f} us, p99 '
           f'{high:.0f} us')
    lost = f'{outcome.lost} lost' if outcome.lost else 'none lost'
    yield (f'Messages in {outcome.duration:.0f} s: {exchange.sent_poses} poses and '
           f'{exchange.sent_twists} twists to the node, {outcome.answers} predictions back, '
           f'{lost}')


def _indented(lines: list[str]) -> list[str]:
    """Return lines indented by two blanks."""
    return [f'  {line}' if line else '' for line in lines]
