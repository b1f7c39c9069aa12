"""Files of a fit reproduce its free simulation, whatever is given, free and written."""

from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
from numpy.testing import assert_allclose
import pytest
from ruamel.yaml import YAML


@pytest.fixture(scope='module')
def bag(root, true_cup, tmp_path_factory):
    """Return a recording of the motion of bags/identification, shorter."""
    motion = YAML(typ='safe').load((root / 'bags/identification.yaml').read_text())
    folder = str(tmp_path_factory.mktemp('written') / 'bag')
    simulate_recording(true_cup, {**motion, 'seed': 5, 'duration': 8.0}, folder)
    return folder


@pytest.mark.parametrize(('changes', 'has_cell'), [
    ({}, True), pytest.param(
        {'package.com': [1e-3, -5e-4, -0.0315], 'cup.length': 0.0465}, True,
        marks=pytest.mark.stress),
    ({'fit.free': ['length'], 'cup.length': 0.0475}, True),
    ({'fit.free': ['time_offset', 'package_marker']}, True),
    ({'fit.method': 'least_squares'}, False)],
    ids=['as given', 'com and length off', 'length free', 'marker and clock', 'least squares'])
def test_the_files_of_a_fit_reproduce_its_free_simulation(
        known, bag, tmp_path, changes, has_cell):
    settings = {**known, 'fit.method': 'output_error', **changes, 'bags': [bag]}
    found = identify(settings)
    cell, cup = tmp_path / 'cell.yaml', tmp_path / 'cup.yaml'
    save(found, cup, None, cell_path=cell if has_cell else None)
    files = read_parameters(cell) if has_cell else settings
    again = replay(bag, {**files, **read_parameters(cup)}).validation.scores.rms
    assert_allclose(again, found.verdict.simulated[0].rms, rtol=0.01)
