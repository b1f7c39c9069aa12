"""`bellows simulate`: recordings of a known cup."""

import json
from pathlib import Path

from bellows_ros.files.bags import topics
from bellows_ros.files.parameter_files import read_parameters
import numpy as np

from .conftest import contents, MOTION, Run


def test_the_recording_holds_what_was_reported(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Count the messages in the recording, in the summary and in JSON alike."""
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', '--motion', workshop / 'motion.yaml',
        '--out', tmp_path / 'new', '--json', '-',
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report['duration_s'] == MOTION['duration']
    assert report['messages'] == {t.name: t.messages for t in topics(tmp_path / 'new')}
    for topic, count in report['messages'].items():
        assert topic in done.stderr and str(count) in done.stderr
    assert '1 dropouts' not in done.stderr and '1 dropout' in done.stderr


def test_the_same_files_make_the_same_recording(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Repeat the fixture's recording, over one that is there."""
    command = ['simulate', '--params', workshop / 'cup.yaml', '--motion',
               workshop / 'motion.yaml', '--out', tmp_path / 'recording', '--force']
    for _ in range(2):
        done = bellows(*command)
        assert done.returncode == 0, done.stderr
        assert contents(tmp_path / 'recording') == contents(workshop / 'recording')


def test_set_changes_the_cup(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Take parameters from the command line too."""
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', '--set', 'package.mass=2.5',
        '--motion', workshop / 'motion.yaml', '--out', tmp_path / 'heavy',
    )
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path / 'heavy') != contents(workshop / 'recording')


def test_a_cup_that_is_not_given_is_said(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Warn that the cup of the thesis is simulated."""
    done = bellows(
        'simulate', '--params', workshop / 'package.yaml', '--motion', workshop / 'motion.yaml',
        '--out', tmp_path / 'new',
    )
    assert done.returncode == 0, done.stderr
    assert 'Warning: cup.stiffness is not set: using the cup of the thesis' in done.stderr


def test_the_margin_is_said_by_simulate_and_found_by_replay(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Smallest safety factor, mode and instant; replay sees the motion through noise."""
    grip = ('--set', 'cup.lip_radius=0.02', '--set', 'vacuum.holding=60000')
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', *grip, '--motion',
        workshop / 'motion.yaml', '--out', tmp_path / 'new', '--json', '-')
    assert done.returncode == 0, done.stderr
    truth = json.loads(done.stdout)['margin']
    assert truth['mode'] in ('peel', 'slip') and 0.0 < truth['time'] < MOTION['duration']
    assert f'safety factor of the grip is {truth["factor"]:.3g}' in ' '.join(done.stderr.split())
    page = tmp_path / 'page.html'
    again = bellows('replay', tmp_path / 'new', '--params', workshop / 'cup.yaml', *grip,
                    '--report', page, '--json', '-')
    assert again.returncode == 0, again.stderr
    found = json.loads(again.stdout)['margin']
    assert found['mode'] == truth['mode'] and abs(found['time'] - truth['time']) < 0.02
    assert abs(found['factor'] - truth['factor']) < 0.02 * truth['factor']
    assert 'smallest safety factor of the grip' in page.read_text()
    assert 'How firmly the grip holds' in page.read_text()
    drawn = bellows(
        'plot', 'margin', tmp_path / 'new', '--params', workshop / 'cup.yaml', *grip, '--set',
        'package.mass_std=0.1', '--out', tmp_path / 'margin.png', '--json', '-')
    assert drawn.returncode == 0, drawn.stderr
    curves = json.loads(drawn.stdout)
    factors, std = np.array(curves['factors']), np.array(curves['std'])
    seconds = np.array(curves['seconds'])
    row, column = np.unravel_index(factors.argmin(), factors.shape)
    assert abs(factors.min() - found['factor']) < 1e-6 * found['factor']
    assert seconds[row] == found['time'] and ('peel', 'slip')[column] == found['mode']
    mass = float(read_parameters(workshop / 'cup.yaml')['package.mass'])
    still = seconds < 0.1  # at rest the load is the weight, and so is its doubt
    np.testing.assert_allclose(
        std[still, 0] / factors[still, 0], 0.1 / mass, rtol=0.02)
    assert (tmp_path / 'margin.png').read_bytes().startswith(b'\x89PNG')
    unknown = bellows('plot', 'margin', tmp_path / 'new', '--params', workshop / 'cup.yaml',
                      '--out', tmp_path / 'no.png')
    assert unknown.returncode == 2 and 'set cup.lip_radius' in ' '.join(unknown.stderr.split())
    assert not (tmp_path / 'no.png').exists()
    assert 'safety factor' not in bellows(
        'replay', tmp_path / 'new', '--params', workshop / 'cup.yaml').stdout
