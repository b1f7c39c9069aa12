"""Rehearse a recording."""

import json

from bellows_ros.core.parameters.checks import resolve
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.rehearse import drawn, Number
import numpy as np
import pytest

from ..conftest import ROOT


def test_a_rehearsal_prints_errors_and_their_coverage(succeed, tmp_path):
    """By the sensors of the file; of a cup that was drawn, not of the given one."""
    file = tmp_path / 'rehearsal.json'
    done = succeed('rehearse', '--params', ROOT / 'bags' / 'cup.yaml', '--runs', 1, '--json', file,
                   '--set', 'fit.method=least_squares')
    found = json.loads(file.read_text())
    assert found['runs'] == 1 and not found['refused']
    given = read_parameters(ROOT / 'bags' / 'cup.yaml')
    true = np.reshape(drawn(resolve(given), 0)['cup.stiffness'], (6, 6))
    numbers = {each['name']: each for each in found['numbers']}
    assert numbers['K z']['expected'] == true[2, 2] != given['cup.stiffness'][14]
    assert 0.0 < numbers['K z']['expected_std'] < 0.1 * true[2, 2]
    assert 'of 1' in done.stdout and 'K z' in done.stdout


@pytest.mark.parametrize(('std', 'inside', 'runs', 'words'), [
    (1.0, 5, 5, ()),
    (2.0, 4, 5, ('record 4.0 times as long', '50 % of the noise', 'up and down')),
    (8.0, 4, 4, ('too large for a longer recording',)),
    (np.inf, 0, 0, ('not identifiable', 'up and down')),
    (1.0, 2, 5, ('only 2 of 5 runs', 'fit.time_offset')),
])
def test_advice_follows_from_the_error_and_from_the_intervals(std, inside, runs, words):
    """Four times the time for half the error; intervals that miss the truth by chance pass."""
    advice = ' '.join(Number('K z', 'N/m', 10.0, std, inside, runs).advice)
    assert bool(advice) == bool(words) and all(word in advice for word in words), advice
