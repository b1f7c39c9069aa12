"""`bellows replay`: how well a cup predicts a recording."""

import json
from pathlib import Path
import re

from bellows_ros.core.score import AXES
import pytest

from .conftest import Run

POSITION_NOISE, ROTATION_NOISE = 2e-5, 1e-4  # m, rad; of the package's poses in the recording


@pytest.fixture(scope='module')
def replayed(
    bellows: Run, workshop: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, object]]:
    """Replay once with the true cup; give the summary and the JSON."""
    file = tmp_path_factory.mktemp('replayed') / 'replay.json'
    done = bellows('replay', 'recording', '--params', 'cup.yaml', '--json', file, cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    return done.stdout, json.loads(file.read_text())


def test_the_true_cup_predicts_to_the_noise(replayed: tuple[str, dict[str, object]]) -> None:
    """Print errors per axis, with units, that are little more than the noise."""
    rows = [line.split() for line in replayed[0].splitlines()]
    errors = {row[0]: row[1:] for row in rows if row and row[0] in AXES}
    assert len(errors) == 6
    for axis, (rms, unit, largest, unit_again, percent, sign) in errors.items():
        assert (unit, sign) == ('mrad' if axis.startswith('r') else 'mm', '%')
        assert unit_again == unit
        noise = ROTATION_NOISE if unit == 'mrad' else POSITION_NOISE
        # that of the tool's poses, to whose axes the package is taken, comes on top
        assert 0.5e3 * noise < float(rms) < 2e3 * noise
        assert float(rms) < float(largest) and float(percent) > 0.0


def test_the_summary_counts_and_times(replayed: tuple[str, dict[str, object]]) -> None:
    """Say how many messages came, were predicted, and what took how long."""
    text = replayed[0]
    words = ' '.join(text.split())
    assert re.search(
        r'Predicting took [\d.]+ s, \d+ times faster than real time; '
        r'reading and preparing took [\d.]+ s, comparing [\d.]+ s\.', words)
    assert '2401' in text  # tool poses of 8 s at 300 Hz


def test_json_to_stdout(bellows: Run, workshop: Path) -> None:
    """Print JSON and nothing else on stdout."""
    done = bellows(
        'replay', workshop / 'recording', '--params', workshop / 'cup.yaml', '--json', '-')
    assert done.returncode == 0, done.stderr
    assert isinstance(json.loads(done.stdout), dict)
    assert 'RMS error' in done.stderr


def test_the_cup_of_the_thesis_is_named(bellows: Run, workshop: Path) -> None:
    """Warn where no cup is given."""
    done = bellows('replay', workshop / 'recording', '--params', workshop / 'package.yaml')
    assert done.returncode == 0, done.stderr
    assert 'cup.stiffness is not set' in done.stdout


def test_twists_can_be_left_out(bellows: Run, workshop: Path) -> None:
    """Predict from poses alone."""
    done = bellows(
        'replay', workshop / 'recording', '--params', workshop / 'cup.yaml',
        '--set', 'topics.tool_twist=')
    assert (done.returncode, done.stderr) == (0, '')
