"""`bellows identify` on several cores and with a page, as a user calls it."""

import importlib.util
import json

from bellows_ros.core.identification import search
import pytest

QUICK = ('--set', 'fit.method=least_squares')


def test_identify_on_two_cores_leaves_out_what_is_bad(succeed, root, tmp_path):
    """Say so, and show on the page what was read."""
    pytest.importorskip('joblib', reason='extra parallel')
    cup, fit, page = tmp_path / 'cup.yaml', tmp_path / 'fit.json', tmp_path / 'page.html'
    done = succeed(
        'identify', 'bags/identification', 'bags/none', '--params', 'bags/package.yaml', *QUICK,
        '--jobs', 2, '--out', cup, '--json', fit, '--report', page, cwd=root)
    assert "'bags/none'" in done.stderr
    assert json.loads(fit.read_text())['failed'][0]['bag'] == 'bags/none'
    assert cup.exists() and page.read_text().count('<figure') == 5


def test_a_page_without_matplotlib_is_refused_before_any_work(bellows, root, monkeypatch):
    """Say how to install it, before the recording is found to be missing."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec',
                        lambda name, *rest: None if name == 'matplotlib' else find(name, *rest))
    for command, params in (('identify', 'package.yaml'), ('replay', 'cup.yaml')):
        done = bellows(command, 'none', '--params', f'bags/{params}', '--report', 'x.html',
                       cwd=root)
        assert done.returncode == 2 and 'pip install matplotlib' in ' '.join(done.stderr.split())


def test_a_search_that_does_not_end_gives_no_cup(bellows, root, tmp_path, monkeypatch):
    """End with 1, without standard errors and without a cup file."""
    monkeypatch.setattr(search, 'MAX_STEPS', 1)
    monkeypatch.setattr(search, 'LOOSE_TOLERANCE', 0.0)
    cup, fit = tmp_path / 'cup.yaml', tmp_path / 'fit.json'
    done = bellows('identify', 'bags/validation', '--params', 'bags/package.yaml', '--to', '6',
                   '--out', cup, '--json', fit, cwd=root)
    content = json.loads(fit.read_text())
    assert done.returncode == 1 and 'did not converge' in ' '.join(done.stderr.split())
    assert 'No cup identified' in done.stdout and 'Condition number' not in done.stdout
    assert not content['converged'] and not content['usable'] and not cup.exists()
    assert all(content['stiffness_std'][i][i] is None for i in range(6))
