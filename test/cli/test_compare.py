"""`bellows compare`: what differs between two fits."""

import json

import pytest


@pytest.fixture
def fits(identified, tmp_path):
    """Give a result, and one of a cup that bends more easily."""
    before, after = identified / 'fit.json', tmp_path / 'after.json'
    content = json.loads(before.read_text())
    for i in (3, 4):
        content['stiffness'][i][i] *= 0.8
    after.write_text(json.dumps(content))
    return before, after


def test_equal_fits_exit_with_0(quietly, fits):
    """Report one cup."""
    done = quietly('compare', fits[0], fits[0])
    assert 'consistent with one cup' in done.stdout
    assert 'not independent' in done.stdout


def test_another_cup_exits_with_1(bellows, fits):
    """Name the entry and its change, once."""
    done = bellows('compare', *fits)
    assert (done.returncode, done.stderr) == (1, '')
    (line,) = [line for line in done.stdout.splitlines() if line.startswith('  K rx')]
    assert '-20.00 %' in line
    assert 'not of one cup' in done.stdout and 'K rx' in done.stdout
