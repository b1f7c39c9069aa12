"""One short round of each; `make stress` goes on for as long as asked."""

import time

import pytest

from .frame import CLEAN, Failed, Round, Tally, turn
from .rounds import ROUNDS

SEED = (1, 0)


@pytest.mark.parametrize('name', [name for name, round_ in ROUNDS.items() if round_.short])
def test_a_short_round_finds_nothing(name):
    tally = Tally()
    turn(name, ROUNDS[name], SEED, tally, time.monotonic() + 120.0, ROUNDS[name].short)
    assert not tally.failures, '\n'.join(tally.failures)
    assert tally.tried


def failing(rng, folder):
    """Yield an outcome, then fail."""
    yield CLEAN
    raise Failed('of this kind')


def hanging(rng, folder):
    """Do not end."""
    yield CLEAN
    time.sleep(60.0)


@pytest.mark.parametrize('run, reason', [(failing, 'of this kind'), (hanging, 'TookTooLong')])
def test_a_failure_names_what_makes_it_again(run, reason):
    tally = Tally()
    turn('bad', Round(run, patience=0.2), (7, 3), tally, time.monotonic() + 60.0)
    assert tally.tried == 2 and tally.outcomes == {CLEAN: 1}
    (text,) = tally.failures
    assert text.startswith('--only bad --seed 7 --turn 3, attempt 1:') and reason in text
