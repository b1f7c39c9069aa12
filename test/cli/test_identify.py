"""`bellows identify`: a recording goes in, a cup comes out, also on several cores."""

import importlib.util
import json

from bellows_ros.core.identification import estimate
from bellows_ros.files.parameter_files import read_parameters
import numpy as np

from .conftest import TRUTH


def test_the_cup_file_has_what_was_found_and_nothing_else(identified):
    """Write the cup to full precision, and no package, so that it overrides no other."""
    values = read_parameters(identified / 'cup.yaml', 'predictor')
    fit = json.loads((identified / 'fit.json').read_text())
    assert values['cup.stiffness'] == tuple(np.ravel(fit['stiffness']))
    assert values['cup.damping'] == tuple(np.ravel(fit['damping']))
    assert all(name.startswith('cup.') for name in values)


def test_parameters_from_several_places(succeed, workshop, tmp_path):
    """Take later files over earlier ones, --set over files, and bags from a file."""
    more = tmp_path / 'more.yaml'
    more.write_text(
        f"identifier:\n  ros__parameters:\n    bags: ['{workshop / 'recording'}']\n"
        '    package.mass: 99.0\n    fit: {structure: axisymmetric}\n')
    done = succeed(
        'identify', '--params', workshop / 'package.yaml', '--params', more,
        '--set', 'fit.structure=full', '--set', 'package.mass=1.8', '--json', '-')
    fit = json.loads(done.stdout)
    assert fit['structure'] == 'full'
    np.testing.assert_allclose(  # 21 unknowns from 8 s
        np.diag(fit['stiffness']), TRUTH['cup.stiffness'][::7], rtol=0.2)
    assert 'K in N/m, N and N m/rad:' in done.stderr


QUICK = ('--set', 'fit.method=least_squares')


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
    monkeypatch.setattr(estimate, 'MAX_STEPS', (2, 2))
    monkeypatch.setattr(estimate, 'LOOSE_TOLERANCE', 0.0)
    cup, fit = tmp_path / 'cup.yaml', tmp_path / 'fit.json'
    done = bellows('identify', 'bags/validation', '--params', 'bags/package.yaml', '--to', '6',
                   '--out', cup, '--json', fit, cwd=root)
    content = json.loads(fit.read_text())
    assert done.returncode == 1 and 'did not converge' in ' '.join(done.stderr.split())
    assert 'No cup identified' in done.stdout
    assert not content['converged'] and not content['usable'] and not cup.exists()
    assert all(content['stiffness_std'][i][i] is None for i in range(6))
