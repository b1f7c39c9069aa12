"""How far a minimisation is: an iteration in words, and an estimate of the time left."""

from collections.abc import Sequence

from bellows_ros.core.identification.result import Iteration
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TYPICAL_STEPS = 8
"""Steps that a prediction-error fit takes, of all its stages together."""

STEPS_OF_ERRORS = 8.0
"""The standard errors at the end take as long as so many steps."""

LAST_STAGE = 1
ENDS_AT, TYPICAL_GAIN = 1e-8, 0.02
"""The last stage ends where chi^2 falls by less than this part; it falls by so much of that."""


def seconds_left(iterations: Sequence[Iteration]) -> float:
    """
    Return the time (s) that a fit will go on, of all its iterations so far.

    Steps take as long as those before. How many are left, the fall of chi^2 tells in the last
    stage, and experience before. NaN before the second step.
    """
    if len(iterations) < 2:
        return float('nan')
    step = (iterations[-1].seconds - iterations[0].seconds) / (len(iterations) - 1)
    return step * (_steps_left(iterations) + STEPS_OF_ERRORS)


def _steps_left(iterations: Sequence[Iteration]) -> float:
    """Return how many steps are to come, the one that has begun included."""
    last, before = iterations[-1], iterations[-2]
    if last.stage >= LAST_STAGE and before.stage == last.stage and last.chi2 > 0.0:
        fall = max((before.chi2 - last.chi2) / last.chi2, ENDS_AT)
        return 1.0 + float(np.log(ENDS_AT / fall) / np.log(TYPICAL_GAIN))
    return max(float(TYPICAL_STEPS - len(iterations)), 2.0)


def in_words(iterations: Sequence[Iteration]) -> str:
    """Return the last iteration: chi^2, time left, and the diagonals of K and P."""
    last = iterations[-1]
    left = seconds_left(iterations)
    time = f', {left:.0f} s left' if np.isfinite(left) else ''
    return (
        f'step {last.number + 1}: chi^2 {last.chi2:.4g}{time}; K {_diagonal(last.stiffness, 4)}, '
        f'P {_diagonal(last.damping, 3)}'
    )


def _diagonal(matrix: Array, digits: int) -> str:
    """Return the numbers on a diagonal, of lateral directions that are tied only one."""
    numbers = np.diag(matrix)
    tied = numbers[0] == numbers[1] and numbers[3] == numbers[4]
    return ' '.join(f'{x:.{digits}g}' for x in (numbers[[0, 2, 3, 5]] if tied else numbers))
