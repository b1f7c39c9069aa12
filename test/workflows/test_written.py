"""Files of a fit: they reproduce its free simulation, and every number has its unit."""

from dataclasses import replace
import json

from bellows_ros.core.geometry.jit import COMPILED
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


PLAIN = ('settings', 'provenance', 'numbers')
"""Blocks whose units are those of the parameters, and what has none."""


def without_unit(content, path=''):
    """Yield the paths of numbers, other than counts, whose unit is not beside them."""
    units = content.get('units', {})
    for key, value in content.items():
        here = f'{path}.{key}'
        if key in (*PLAIN, 'units') or key in units or key.endswith(('_hz', '_s', '_ns')):
            continue
        if key == 'value' and 'unit' in content or key == 'std' and 'unit' in content:
            continue
        yield from numbers(value, here)


def numbers(value, path):
    """Yield the paths of numbers in a value that has no unit of its own."""
    if isinstance(value, dict):
        yield from without_unit(value, path)
    elif isinstance(value, list):
        for item in value:
            yield from numbers(item, f'{path}[]')
    elif isinstance(value, float):
        yield path


@pytest.fixture(scope='module')
def settings(root, known):
    """Return all that can be asked of recordings."""
    bags = root / 'bags'
    return {
        **known, 'bags': [str(bags / 'identification')],
        'static.bags': [str(bags / 'static')], 'validation.bags': [str(bags / 'validation')],
        'fit.free': ['time_offset'], 'recording.end': 8.0}


@pytest.mark.parametrize(('method', 'unit'), [
    ('least_squares', ['N'] * 3 + ['N m'] * 3),
    pytest.param('output_error', ['m'] * 3 + ['rad'] * 3, marks=pytest.mark.skipif(
        not COMPILED, reason='numba is not installed: the fit takes minutes'))])
def test_every_number_has_its_unit(settings, method, unit):
    short = {'bags': settings['validation.bags'], 'validation.bags': [], 'fit.free': [],
             'recording.end': 4.0}
    asked = {**settings, 'fit.method': method, **(
        {} if method == 'least_squares' else short)}
    content = json.loads(format_json(identify(asked).as_json()))
    assert sorted(set(without_unit(content))) == []
    assert content['units']['residual_rms'] == unit
    assert content['units']['stiffness'][0] == ['N/m'] * 3 + ['N'] * 3
