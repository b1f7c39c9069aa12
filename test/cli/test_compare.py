"""`bellows compare`: what differs between two fits."""

import json

import pytest

pytestmark = pytest.mark.xdist_group('compare')  # its fits are made once


@pytest.fixture(scope='module')
def fits(bellows, workshop, tmp_path_factory):
    """Give a result, and one of a cup that bends more easily."""
    folder = tmp_path_factory.mktemp('fits')
    before, after = folder / 'before.json', folder / 'after.json'
    done = bellows(
        'identify', 'recording', '--params', 'package.yaml', '--json', before, cwd=workshop)
    assert done.returncode == 0, done.stderr
    content = json.loads(before.read_text())
    for i in (3, 4):
        content['stiffness'][i][i] *= 0.8
    after.write_text(json.dumps(content))
    return before, after


def test_equal_fits_exit_with_0(bellows, fits):
    """Say that nothing matters."""
    done = bellows('compare', fits[0], fits[0])
    assert (done.returncode, done.stderr) == (0, '')
    assert 'No significant difference' in done.stdout
    assert 'not independent' in done.stdout


def test_what_matters_exits_with_1(bellows, fits):
    """Name the parameter, the change and what it does."""
    done = bellows('compare', *fits)
    assert (done.returncode, done.stderr) == (1, '')
    (line,) = [line for line in done.stdout.splitlines() if line.startswith('  K rx')]
    assert '-20.00 %' in line and '*' in line
    assert 'The difference matters' in done.stdout
