"""`bellows report`, and `bellows identify --report`."""

import json
from pathlib import Path

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
    assert 'leaves the validity range of the fit: the mass is 1.8 kg, seen 1 to 1.2.' in warning
    assert 'Warning: recording: The recording leaves the validity range' in done.stderr


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
    assert 'does not name its recordings' in done.stderr
    assert contents(tmp_path) == before
