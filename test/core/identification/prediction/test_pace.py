"""Time left of a minimisation: of made-up ones, whose end is known."""

from bellows_ros.core.identification.prediction.pace import in_words, seconds_left, STEPS_OF_ERRORS
from bellows_ros.core.identification.result import Iteration
import numpy as np
import pytest

K, P = np.diag([6417.0, 6417.0, 11530.0, 3.868, 3.868, 1.123]), np.diag([66.0] * 3 + [0.06] * 3)


def run(falls, step=0.5, stages=(0, 0, 0)):
    """Return iterations whose chi^2 falls by these parts, the first ones in an early stage."""
    chi2, found = 1.0, []
    for number, fall in enumerate([0.0, *falls]):
        chi2 *= 1.0 - fall
        stage = 0 if number < len(stages) else 1
        found.append(Iteration(stage, number, chi2, K, P, 2.0 + step * number))
    return found


def test_the_first_step_tells_nothing_yet():
    assert np.isnan(seconds_left(run([])))
    assert 'left' not in in_words(run([]))


@pytest.mark.parametrize('step', [0.1, 2.0])
def test_the_time_is_that_of_the_steps_to_come(step):
    """Fall by a factor of fifty each step down to the end: count the steps that are left."""
    falls = [0.1, 0.01, 1e-2, 1e-2, 2e-4, 4e-6, 8e-8]
    left = [seconds_left(run(falls[:n], step)) for n in range(1, len(falls) + 1)]
    assert left[3] > left[4] > left[5] > left[6] > 0.0
    for n in range(5, len(falls) + 1):
        remaining = len(falls) - n + 1.5  # half a step may be missing where it stops in between
        assert abs(left[n - 1] / step - STEPS_OF_ERRORS - remaining) <= 1.0


def test_words_have_cost_time_and_parameters():
    words = in_words(run([0.5, 0.1]))
    assert words == ('step 3: chi^2 0.45, 6 s left; K 6417 1.153e+04 3.868 1.123, '
                     'P 66 66 0.06 0.06')
    uneven = [Iteration(0, 0, 1.0, np.diag(np.arange(1.0, 7.0)), P, 0.0)]
    assert in_words(uneven) == 'step 1: chi^2 1; K 1 2 3 4 5 6, P 66 66 0.06 0.06'


def test_a_minimum_that_gets_no_better_has_an_end():
    assert np.isfinite(seconds_left(run([0.1, 0.0, 0.0, 0.0, 0.0])))
    assert seconds_left(run([0.0] * 40)) < 30.0
