"""Every measurement runs in its short form, and the judge of stated errors counts them right."""

import importlib
from pathlib import Path
import sys

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.parameter_files import write_parameters
from benchmarks import __main__ as command
from benchmarks.calibration import kept, Outcome, row
import numpy as np
import pytest

pytestmark = pytest.mark.lane

POPULATION = Path(__file__).parents[2] / 'shared/population'
"""Folder of an independent generator of set-ups."""


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: this takes minutes')
@pytest.mark.parametrize('section', [
    pytest.param('node', marks=pytest.mark.stress),
    pytest.param('start', marks=pytest.mark.stress), 'camera'])
def test_short_form_measures(section):
    if section != 'camera':
        pytest.importorskip('rclpy')
    assert all(min(times) > 0.0 for times in command.SECTIONS[section](True).values())


def test_table_counts_accepted_values_by_stated_errors(tmp_path):
    """Of a refused set-up, an unclaimed value and one without truth nothing counts."""
    of_all = {'axes': [0, 2, 3, 5], 'chi2': 1.0, 'K_true': (1.0, 2.0, 3.0, np.nan)}
    accepted = Outcome(7, 'robot', 2.0, '', K=(1.5, 0.0, 9.0, 9.0),
                       K_std=(1.0, 0.8, np.inf, 1.0), **of_all)
    refused = Outcome(8, 'robot', 4.0, 'no', K=(9.0,) * 4, K_std=(1.0,) * 4, **of_all)
    (tmp_path / 'bounds').mkdir()
    (tmp_path / 'bounds/7.json').write_text('{"K": [0.5, 0.4, 1.0, 0.8]}')
    cells = [cell.strip() for cell in row(tmp_path, 'robot', 'K', [accepted, refused]).split('|')]
    assert cells[1:-1] == [
        'robot', 'K', '2', '1', '0.50, 0.50, 1.00 of 2', '-2.5 (7 z)', 'x +0.5, z -2.5', '1',
        '2.00', '1.00, 1.00', '3.0, 4.0']


@pytest.mark.skipif(not COMPILED, reason='numba is not installed: this takes minutes')
def test_short_recording_of_an_independent_generator_is_judged(tmp_path, monkeypatch):
    if not POPULATION.is_dir():
        pytest.skip(f'the generator of set-ups {POPULATION} is not there')
    monkeypatch.setattr(sys, 'path', [str(POPULATION), *sys.path])
    population = importlib.import_module('population')
    kind, spec, given = population.draw(7)
    cup, *_ = population.rig.write(
        tmp_path / '7', {**spec, 'duration': 8.0, 'rtol': 1e-6, 'dropouts': 0})
    np.savez(tmp_path / '7_truth.npz', kind=kind, K=cup.K, P=cup.P)
    write_parameters(tmp_path / '7.yaml', given)
    outcome = kept(tmp_path, tmp_path, 7)
    assert not outcome.refusal and outcome == kept(tmp_path, tmp_path, 7)
    assert np.nanmax(np.abs(outcome.deviations('K'))) < 4.0
