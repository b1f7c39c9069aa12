"""Files of a fit: they reproduce its free simulation, in SI units."""

from dataclasses import replace
import json

from bellows_ros.core.identification.result import with_unidentifiable
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.results import format_json
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
from bellows_ros.workflows.replay import replay
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
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
    ({'fit.free': ['time_offset'], 'recording.package_world': 'estimate'}, True),
    ({'fit.method': 'least_squares'}, False)],
    ids=['as given', 'com and length off', 'length free', 'marker and clock', 'world and clock',
         'least squares'])
def test_the_files_of_a_fit_reproduce_its_free_simulation(
        known, bag, tmp_path, changes, has_cell):
    settings = {**known, 'fit.method': 'output_error', **changes, 'bags': [bag]}
    found = identify(settings)
    cell, cup = tmp_path / 'cell.yaml', tmp_path / 'cup.yaml'
    save(found, cup, None, cell_path=cell if has_cell else None)
    files = read_parameters(cell) if has_cell else settings
    again = replay(bag, {**files, **read_parameters(cup)}).validation.scores.rms
    assert_allclose(again, found.verdict.simulated[0].rms, rtol=0.01)


def test_a_number_that_is_not_identifiable_is_the_given_one(known, bag, tmp_path):
    given = np.diag([50.0, 50.0, 25.0, 0.06, 0.06, 0.1])
    found = identify({**known, 'fit.method': 'least_squares', 'bags': [bag],
                      'cup.damping': given.ravel().tolist()})
    unknown = np.array([label == 'P rz' for label in found.fit.labels])
    found = replace(found, fit=replace(
        found.fit, covariance=with_unidentifiable(found.fit.covariance, unknown)))
    save(found, tmp_path / 'cup.yaml', None)
    cup = read_parameters(tmp_path / 'cup.yaml')
    P, std = (np.diag(np.reshape(cup[f'cup.damping{end}'], (6, 6))) for end in ('', '_std'))
    assert (std >= 1e9).tolist() == [False] * 5 + [True]
    assert P[5] == given[5, 5] != found.fit.damping[5, 5]


def test_what_cannot_be_freed_keeps_its_given_value(known, bag):
    """Only the ratio of mass and inertia is observable."""
    found = identify({**known, 'fit.method': 'output_error', 'fit.free': ['mass', 'inertia'],
                      'bags': [bag]})
    assert found.fit.usable and not {'mass', 'inertia'} & {*found.fit.named}
    assert 'mass' in next(each for each in found.fit.notes if each.code == 'not_freed').numbers[
        'names']


def keys(content):
    """Yield the keys of all mappings in JSON content."""
    if isinstance(content, dict):
        yield from content
    for item in content.values() if isinstance(content, dict) else content:
        if isinstance(item, dict | list):
            yield from keys(item)


def test_json_has_si_units_and_none_beside_its_numbers(known, root):
    """Compare with the parameters, whose units the table has."""
    bags = root / 'bags'
    content = json.loads(format_json(identify({
        **known, 'bags': [str(bags / 'identification')], 'recording.end': 8.0,
        'fit.method': 'least_squares'}).as_json()))
    assert not {'unit', 'units', 'validations'} & {*keys(content)}
    assert content['cup_length'] == content['settings']['cup.length'] == 0.046
    assert content['recordings'][0]['package']['mass'] == content['settings']['package.mass']
    assert 9000.0 < content['stiffness'][2][2] < 9400.0  # N/m
    for name in ('relaxation', 'relaxation_std', 'stretch', 'stretch_std'):
        assert content[name] == [0.0, 0.0]
