"""The final message of the demonstration."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from bellows_ros.cli.console import aligned, percent
from bellows_ros.cli.identify import cup_table
from bellows_ros.core.arrays import Array
from bellows_ros.core.residuals import AXES, Scores
import numpy as np

MILLI = 1e3
MICRO = 1e6


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    All that the demonstration has found.

    Parameters
    ----------
    fit : bellows_ros.core.identification.result.Fit
        The identified cup.
    scores : Scores
        Of the node's predictions.
    sent_poses, sent_twists, received : int
        Messages to and from the node.
    latency : array (received,)
        From sending a pose until its prediction was here, s.
    duration : float
        Of the recording played, s.
    noise : (float, float) or None
        Standard deviation that the recording's measured poses were given in each axis, m and rad;
        None where it is not known.

    """

    fit: Any
    scores: Scores
    sent_poses: int
    sent_twists: int
    received: int
    latency: Array
    duration: float
    noise: tuple[float, float] | None

    @property
    def lost(self) -> int:
        """Poses without a prediction."""
        return self.sent_poses - self.received


def summary(outcome: Outcome) -> Iterator[str]:
    """Yield the lines: the cup, the errors, the latency, the messages."""
    yield 'The cup, with standard errors:'
    yield from _indented(cup_table(outcome.fit))
    yield ''
    yield 'The package relative to the tool, predicted live minus measured (RMS):'
    yield from _indented(_errors(outcome.scores))
    if outcome.noise:
        position, rotation = (x * MILLI for x in outcome.noise)
        yield f'  (the measured poses themselves have noise: {position:g} mm, {rotation:g} mrad)'
    yield ''
    yield from latency_lines(outcome)


def _errors(scores: Scores) -> list[str]:
    """Return the errors, a line for position and rotation of each axis."""
    rows = [('axis', 'error', 'of the motion', 'axis', 'error', 'of the motion')]
    rms = scores.rms * MILLI
    for i in range(3):
        rows.append(
            (
                AXES[i], f'{rms[i]:.3f} mm', percent(scores.nrmse[i]),
                f'  {AXES[i + 3]}', f'{rms[i + 3]:.3f} mrad', percent(scores.nrmse[i + 3]),
            )
        )
    return aligned(rows, right=True)


def latency_lines(outcome: Outcome) -> Iterator[str]:
    """Yield latency and messages."""
    if outcome.received:
        median, high = np.percentile(outcome.latency, (50, 99)) * MICRO
        yield (
            f'Latency, from sending a pose to receiving its prediction: p50 {median:.0f} us, p99 '
            f'{high:.0f} us'
        )
    lost = f'{outcome.lost} lost' if outcome.lost else 'none lost'
    yield (
        f'Messages in {outcome.duration:.0f} s: {outcome.sent_poses} poses and '
        f'{outcome.sent_twists} twists to the node, {outcome.received} predictions back, {lost}'
    )


def _indented(lines: list[str]) -> list[str]:
    """Return lines with two blanks before them."""
    return [f'  {line}' if line else '' for line in lines]
