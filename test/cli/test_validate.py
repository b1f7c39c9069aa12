"""`bellows validate`, `bellows report`, and `bellows identify --report`."""

import json
from pathlib import Path

from bellows_ros.core.score import AXES
import pytest

from .conftest import contents, Run


@pytest.fixture(scope='module')
def fitted(bellows: Run, workshop: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Identify once, with a page; give the folder."""
    folder = tmp_path_factory.mktemp('fitted')
    done = bellows(
        'identify', 'recording', '--params', 'package.yaml', '--json', folder / 'fit.json',
        '--report', folder / 'report.html', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    assert f'Wrote {folder / "report.html"}.' in done.stdout
    return folder


def test_the_true_cup_is_good_and_exits_with_0(bellows: Run, workshop: Path) -> None:
    """Print a line per axis and a verdict in words."""
    done = bellows(
        'validate', 'recording', '--params', 'cup.yaml', '--limit', '5', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    first = [line.split()[0] for line in done.stdout.splitlines() if line.startswith('  ')]
    assert first[1:7] == list(AXES)
    assert 'within 5 %' in done.stdout and 'chi^2' in done.stdout


def test_a_wrong_cup_exits_with_1_where_a_limit_is_set(bellows: Run, workshop: Path) -> None:
    """Tell scripts; without a limit, only say it."""
    arguments = ('validate', 'recording', '--params', 'package.yaml')
    done = bellows(*arguments, '--limit', '5', cwd=workshop)
    assert done.returncode == 1
    assert 'Above 5 % of the motion' in done.stdout
    assert 'cup.stiffness is not set' in done.stdout
    assert bellows(*arguments, cwd=workshop).returncode == 0


def test_json_and_page_are_written(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Write both; JSON alone on stdout."""
    arguments = ('validate', 'recording', '--params', 'cup.yaml', '--report', tmp_path / 'v.html')
    done = bellows(*arguments, '--json', '-', cwd=workshop)
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert content['provenance']['parameter_files'][0]['path'] == 'cup.yaml'
    assert (tmp_path / 'v.html').read_text().startswith('<!DOCTYPE html>')


def test_the_report_can_be_made_again(bellows: Run, workshop: Path, fitted: Path) -> None:
    """Give the same bytes from the result file as when it was fitted."""
    done = bellows(
        'report', fitted / 'fit.json', '--out', fitted / 'again.html', '--json', '-', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, f'Wrote {fitted / "again.html"}.\n')
    assert json.loads(done.stdout)['changed_recordings'] == []
    assert (fitted / 'again.html').read_bytes() == (fitted / 'report.html').read_bytes()


def test_a_report_warns_of_what_the_fit_has_not_seen(
    bellows: Run, workshop: Path, fitted: Path, tmp_path: Path
) -> None:
    """Judge a validation by the envelope in the result file, in words and in JSON."""
    content = json.loads((fitted / 'fit.json').read_text())
    content['envelope']['mass'] = [1.0, 1.2]
    (tmp_path / 'light.json').write_text(json.dumps(content))
    done = bellows(
        'report', tmp_path / 'light.json', '--validation', 'recording', '--out',
        tmp_path / 'page.html', '--json', '-', cwd=workshop)
    (validation,) = json.loads(done.stdout)['validations']
    warning = validation['warnings'][-1]
    assert 'has seen: the mass is 1.8 kg, seen 1 to 1.2.' in warning
    assert 'Warning: recording: The recording goes beyond' in done.stderr


def test_a_result_without_settings_is_refused(
    bellows: Run, workshop: Path, fitted: Path, tmp_path: Path
) -> None:
    """Say what is missing; write nothing."""
    content = json.loads((fitted / 'fit.json').read_text())
    del content['settings']
    (tmp_path / 'old.json').write_text(json.dumps(content))
    before = contents(tmp_path)
    done = bellows('report', tmp_path / 'old.json', '--out', tmp_path / 'x.html', cwd=workshop)
    assert done.returncode == 2
    assert 'does not say from which recordings' in done.stderr
    assert contents(tmp_path) == before


def test_a_time_offset_is_told(bellows: Run, root: Path, tmp_path: Path) -> None:
    """Say what was taken from the tool's stamps, on the screen and on the page."""
    wanted = (
        'bags/validation', '--params', 'bags/cup.yaml', '--set', 'fit.time_offset=true')
    page = tmp_path / 'page.html'
    validated = bellows('validate', *wanted, '--report', page, cwd=root)
    replayed = bellows('replay', *wanted, cwd=root)
    for text in (validated.stdout, replayed.stdout, page.read_text()):
        assert 'bags/validation: the stamps of the tool were 0.0' in text
