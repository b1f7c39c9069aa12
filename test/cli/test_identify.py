"""`bellows identify`: a recording goes in, a cup comes out."""

import json
from pathlib import Path
import shutil

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import KEYS
import numpy as np
import pytest

from .conftest import (
    contents,
    DAMPING,
    diagonal,
    MOTION,
    PACKAGE,
    Run,
    STIFFNESS,
    TOPICS,
    write_yaml,
)

# Of this short recording with noise; how exact a fit can be is tested with the fit itself.
STIFFNESS_WITHIN, DAMPING_WITHIN = 0.05, 0.3


@pytest.fixture(scope='module')
def identified(
    bellows: Run, workshop: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """Identify once with all outputs; give the summary and their folder."""
    folder = tmp_path_factory.mktemp('identified')
    done = bellows(
        'identify', 'recording', '--params', 'package.yaml', '--out', folder / 'cup.yaml',
        '--json', folder / 'fit.json', cwd=workshop,
    )
    assert (done.returncode, done.stderr) == (0, '')
    return done.stdout, folder


def test_json_has_the_cup_and_what_it_rests_on(identified: tuple[str, Path]) -> None:
    """Write all keys, and K and P near the truth."""
    fit = json.loads((identified[1] / 'fit.json').read_text())
    assert set(KEYS) <= set(fit)
    assert (fit['method'], fit['structure']) == ('least_squares', 'axisymmetric')
    np.testing.assert_allclose(
        fit['stiffness'], np.diag(STIFFNESS), rtol=STIFFNESS_WITHIN, atol=1e-9)
    np.testing.assert_allclose(fit['damping'], np.diag(DAMPING), rtol=DAMPING_WITHIN, atol=1e-9)
    assert np.all(np.diag(fit['stiffness_std']) > 0.0)
    assert fit['samples_used'] > 1000 and fit['samples_rejected'] > 0


def test_the_cup_file_is_complete_for_predictor_and_replay(
    identified: tuple[str, Path]
) -> None:
    """Write the cup and the package it was identified with, to full precision."""
    values = read_parameters(identified[1] / 'cup.yaml', 'predictor')
    fit = json.loads((identified[1] / 'fit.json').read_text())
    assert values['cup.stiffness'] == tuple(np.ravel(fit['stiffness']))
    assert values['cup.damping'] == tuple(np.ravel(fit['damping']))
    for name, value in PACKAGE.items():
        np.testing.assert_array_equal(values[name], value)


def test_the_summary_can_be_read(identified: tuple[str, Path]) -> None:
    """Print K and P with errors and units, what was used and why not all, and what comes next."""
    text, folder = identified
    for words in ('x, y ', 'rx, ry ', '±', 'N/m', 'N m/rad', 'N s/m', 'N m s/rad',
                  'samples used', 'rejected', '1 gap', '/package/pose', 'Condition number',
                  f'Wrote {folder / "cup.yaml"}', f'Wrote {folder / "fit.json"}',
                  f'bellows replay BAG --params {folder / "cup.yaml"}'):
        assert words in text
    assert '\x1b' not in text and '\r' not in text
    assert 'nan' not in text


def test_a_length_that_is_not_given_is_said(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Warn that the length of the thesis is taken."""
    lines = (workshop / 'package.yaml').read_text().splitlines(keepends=True)
    short = tmp_path / 'short.yaml'
    short.write_text(''.join(line for line in lines if not line.startswith('cup.length')))
    done = bellows('identify', workshop / 'recording', '--params', short)
    assert "Warning: cup.length is not set: using the thesis's 0.0481 m" in ' '.join(
        (done.stdout + done.stderr).split())


def test_json_to_stdout_leaves_the_summary_to_stderr(
    bellows: Run, workshop: Path, identified: tuple[str, Path]
) -> None:
    """Print JSON and nothing else; write no file."""
    before = contents(workshop)
    done = bellows(
        'identify', workshop / 'recording', '--params', workshop / 'package.yaml', '--json', '-')
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['stiffness'] == json.loads(
        (identified[1] / 'fit.json').read_text())['stiffness']
    assert 'samples used' in done.stderr and 'give --out cup.yaml' in done.stderr
    assert contents(workshop) == before


def test_parameters_from_several_places(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Take later files over earlier ones, --set over files, and bags from a file."""
    more = tmp_path / 'more.yaml'
    more.write_text(
        f"identifier:\n  ros__parameters:\n    bags: ['{workshop / 'recording'}']\n"
        '    package.mass: 99.0\n    fit: {structure: axisymmetric}\n')
    done = bellows(
        'identify', '--params', workshop / 'package.yaml', '--params', more,
        '--set', 'fit.structure=full', '--set', 'package.mass=1.8', '--json', '-')
    assert done.returncode == 0, done.stderr
    fit = json.loads(done.stdout)
    assert fit['structure'] == 'full'
    diagonal = np.diag(fit['stiffness'])
    np.testing.assert_allclose(diagonal, STIFFNESS, rtol=0.2)  # 21 unknowns from 8 s
    assert 'K in N/m, N and N m/rad:' in done.stderr


@pytest.fixture(scope='module')
def second(bellows: Run, workshop: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give another recording of the same motion, with other noise."""
    folder = tmp_path_factory.mktemp('second')
    write_yaml(folder / 'motion.yaml', {**MOTION, 'seed': 77})
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', '--motion', folder / 'motion.yaml',
        '--out', folder / 'second')
    assert done.returncode == 0, done.stderr
    return folder / 'second'


def test_two_recordings_count_both(bellows: Run, workshop: Path, second: Path) -> None:
    """Use all recordings that are given."""
    used = []
    for bags in (['recording'], ['recording', second]):
        done = bellows('identify', *bags, '--params', 'package.yaml', '--json', '-', cwd=workshop)
        assert done.returncode == 0, done.stderr
        used.append(json.loads(done.stdout)['samples_used'])
    assert used[1] > 1.8 * used[0]


def test_a_cup_that_cannot_be_is_not_written(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """End with 1: JSON is written, the cup is not, and the summary says so."""
    cup, fit = tmp_path / 'cup.yaml', tmp_path / 'fit.json'
    cup.write_text('what was there before')
    done = bellows(
        'identify', workshop / 'recording', '--params', workshop / 'package.yaml',
        '--set', 'cup.length=0.46', '--out', cup, '--json', fit)  # a slip by ten
    assert done.returncode == 1, done.stderr
    assert cup.read_text() == 'what was there before'
    stiffness = np.array(json.loads(fit.read_text())['stiffness'])
    assert np.linalg.eigvalsh(stiffness)[0] <= 0.0
    text = ' '.join(done.stdout.split())
    warnings = ' '.join(done.stderr.split())
    assert 'Warning: The stiffness K is not positive definite' in warnings
    assert 'was not written' in text and f'Wrote {fit}' in text
    assert 'Traceback' not in warnings


def test_packages_of_files_need_no_other(
    bellows: Run, workshop: Path, second: Path, tmp_path: Path
) -> None:
    """Give package.files, and no package.* beside them; write a page of both recordings."""
    known = tmp_path / 'known.yaml'
    known.write_text('cup: {length: 0.046}\ntopics: {tool_pose: /tool_arm/pose, '
                     'tool_twist: /tool_arm/twist, package_pose: /package/pose}\n')
    done = bellows(
        'identify', 'recording', second, '--params', known, '--set',
        'package.files=package.yaml,package.yaml', '--set', 'fit.compare_recordings=true',
        '--report', tmp_path / 'page.html', '--json', tmp_path / 'fit.json', cwd=workshop)
    assert done.returncode == 0, done.stderr
    text = ' '.join(done.stdout.split())
    assert 'K and P are the same for recording and ' in text
    assert (tmp_path / 'page.html').read_text().count('The model ran freely') == 2


def test_structures_validation_and_page_by_parameters_alone(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Ask for everything in a parameter file, as for the node."""
    other = shutil.copytree(workshop / 'recording', tmp_path / 'other')
    more = tmp_path / 'more.yaml'
    more.write_text(
        f"identifier:\n  ros__parameters:\n    bags: ['{workshop / 'recording'}']\n"
        '    fit: {compare_structures: true}\n'
        f"    validation: {{bags: ['{other}']}}\n"
        f"    output: {{report: '{tmp_path / 'page.html'}'}}\n")
    done = bellows('identify', '--params', workshop / 'package.yaml', '--params', more)
    assert (done.returncode, done.stderr) == (0, '')
    text = ' '.join(done.stdout.split())
    for words in ('Use fit.structure: axisymmetric', 'error over motion: x ',
                  'predicted within 5 %', f'Wrote {tmp_path / "page.html"}.'):
        assert words in text
    page = (tmp_path / 'page.html').read_text()
    assert 'Structures</h2>' in page and 'Not used in the fit' in page


def test_a_page_of_many_recordings_is_refused_at_once(bellows: Run, workshop: Path) -> None:
    """Say how many it can show, before any work."""
    bags = ['recording'] * 21
    done = bellows('identify', *bags, '--params', 'package.yaml', '--jobs', '1', '--report',
                   'page.html', cwd=workshop)
    assert (done.returncode, done.stdout) == (2, '')
    assert 'at most 20 recordings, got 21' in ' '.join(done.stderr.split())


def test_a_page_of_recordings_read_apart(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Read them again for the page."""
    done = bellows('identify', 'recording', '--params', 'package.yaml', '--jobs', '1',
                   '--report', tmp_path / 'page.html', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    assert 'The model ran freely' in (tmp_path / 'page.html').read_text()


@pytest.mark.parametrize('method', ['least_squares', 'prediction_error'])
def test_a_centre_of_stiffness_off_the_middle(
    bellows: Run, workshop: Path, tmp_path: Path, method: str
) -> None:
    """Find K[x,ry] = -K[y,rx] with both methods, and show it in tables, page and exports."""
    X = np.eye(6)
    X[0, 4], X[1, 3] = -0.004, 0.004  # the centre of stiffness, 4 mm above the middle
    K = X.T @ np.diag(STIFFNESS) @ X
    write_yaml(tmp_path / 'cup.yaml', {
        **PACKAGE, **TOPICS, 'cup.stiffness': K.ravel().tolist(),
        'cup.damping': diagonal(DAMPING)})
    bag, fit = tmp_path / 'recording', tmp_path / 'fit.json'
    done = bellows('simulate', '--params', tmp_path / 'cup.yaml', '--motion',
                   workshop / 'motion.yaml', '--out', bag)
    assert done.returncode == 0, done.stderr
    done = bellows(
        'identify', bag, '--params', workshop / 'package.yaml', '--json', fit,
        '--out', tmp_path / 'found.yaml', '--report', tmp_path / 'page.html',
        '--set', 'fit.structure=axisymmetric_coupled', '--set', f'fit.method={method}',
        COLUMNS='60')
    assert done.returncode == 0, done.stderr
    tables = [line for line in done.stdout.splitlines()
              if line.startswith('  ') and str(tmp_path) not in line]
    assert len(tables) > 18 and max(map(len, tables)) <= 60
    assert 'x, y' in done.stdout and 'K in N/m, N and N m/rad:' in done.stdout
    content = json.loads(fit.read_text())
    found = np.array(content['stiffness'])
    assert found[0, 4] == -found[1, 3] and found[0, 0] == found[1, 1]
    std = np.array(content['stiffness_std'])[0, 4]
    assert abs(found[0, 4] - K[0, 4]) < max(3.0 * std, 0.02 * abs(K[0, 4]))
    assert 'K x-ry' in (tmp_path / 'page.html').read_text()
    done = bellows('export', tmp_path / 'found.yaml', '--to', 'mjcf', '--out',
                   tmp_path / 'cup.xml')
    assert done.returncode == 0, done.stderr
    assert 'off-diagonal entries of K are left out' in ' '.join(
        (done.stdout + done.stderr).split())


def test_finds_a_valve_in_tosses(bellows: Run, root: Path, tmp_path: Path) -> None:
    """Write release.* with units beside every number, and refuse what does not go with it."""
    if not COMPILED:
        pytest.skip('twenty interpreted fits take too long; see numba')
    cup, bag, out, fit = (
        root / 'bags' / 'tossing.yaml', tmp_path / 'bag', tmp_path / 'release.yaml',
        tmp_path / 'fit.json')
    done = bellows(
        'simulate', '--params', cup, '--motion', root / 'bags' / 'tosses.yaml', '--out', bag)
    assert '20 tosses, released' in done.stdout
    done = bellows('identify', bag, '--release', '--params', cup, '--out', out, '--json', fit)
    assert done.returncode == 0, done.stderr
    written, found = read_parameters(out), json.loads(fit.read_text())
    assert set(written) == {
        f'release.{name}{std}' for name in ('delay', 'tau', 'impulse') for std in ('', '_std')}
    assert found['delay'] == written['release.delay'] and found['units']['delay'] == 's'
    assert len(found['tosses']) == 20 and 'From toss to toss' in done.stdout
    done = bellows('identify', bag, '--release', '--params', cup, '--jobs', 2, '--out', out)
    assert done.returncode == 2 and '--release cannot be combined with --jobs' in done.stderr
