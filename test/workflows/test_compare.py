"""Comparison of result files."""

import json

from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.compare import compare_files, compared
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
import numpy as np
import pytest

DIAGONAL, ROUND = STRUCTURES['diagonal'], STRUCTURES['axisymmetric']
X = np.array([6417.0, 11530.0, 3.868, 1.123, 66.06, 22.35, 0.05458, 0.09736])


@pytest.fixture(scope='module')
def files(root, shipped, tmp_path_factory):
    """Give a result of the shipped recording, and one of the shipped validation recording."""
    folder = tmp_path_factory.mktemp('fits')
    files = folder / 'identification.json', folder / 'validation.json'
    other = identify({**shipped[0].values, 'bags': [str(root / 'bags/validation')]})
    for result, file in zip((shipped[0], other), files, strict=True):
        save(result, None, file)
    return files


def test_two_recordings_of_one_cup(files):
    """Find one cup, from independent recordings whose digests differ."""
    found = compare_files(*files)
    assert found.shared == ()
    stiffness = {label: after / before for label, _, before, _, after, *_ in found.rows()
                 if label.startswith('K')}
    assert all(abs(ratio - 1.0) < 0.02 for ratio in stiffness.values())
    assert not found.differs and 'consistent with one cup' in found.sentences[-1]
    assert json.loads(json.dumps(found.as_json(), default=list))['one_cup'] is True
    itself = compare_files(files[0], files[0])
    assert np.all(np.abs(itself.z) < 1e-9)
    assert len(itself.shared) == 1 and 'not independent' in itself.sentences[0]


@pytest.mark.parametrize(('change', 'named'), [
    ({'parameters': {}}, "'labels'"), ({'provenance': None}, 'NoneType'),
    ({'structure': 'round'}, "'round'"), ({'damping': 3}, r'damping .*\(6, 6\)'),
    ({'parameters': {'labels': ['K x'], 'covariance': [[1.0]]}}, "'K z'"),
    *((change, '') for change in (
        {'provenance': {'recordings': [{'path': 'a', 'files': [{}]}]}},
        {'structure': 'a' * 5000}, {'stiffness': [[None] * 6] * 6})),
    *(({'stiffness': K}, r'stiffness .*\(6, 6\)') for K in ([[1.0] * 5] * 5, [1.0] * 36))])
def test_results_with_other_content_are_refused(files, tmp_path, change, named):
    """At a length that can be read."""
    file = tmp_path / 'changed.json'
    file.write_text(json.dumps({**json.loads(files[0].read_text()), **change}))
    with pytest.raises(BellowsError, match=rf"changed\.json'.*{named}") as error:
        compare_files(file, files[0])
    assert len(str(error.value)) < 1000


def fit(x, relative=0.01, structure=ROUND):
    """Return estimates with independent standard errors, fractions of the values."""
    return structure, x, np.diag((relative * x) ** 2)


@pytest.mark.parametrize('count', [2, 5])
def test_one_cup_is_taken_for_several_in_one_of_a_hundred(count):
    rng = np.random.default_rng(count)
    alarms = [compared(['fit'] * count, [
        (ROUND, X * (1.0 + 0.01 * rng.standard_normal(8)), np.diag((0.01 * X) ** 2))
        for _ in range(count)]).differs for _ in range(2000)]
    assert 0.004 < np.mean(alarms) < 0.017  # three standard deviations about 1 %


@pytest.mark.parametrize('entry', range(8))
def test_the_differing_entry_is_named_with_its_size(entry):
    other = X * np.where(np.arange(8) == entry, 1.2, 1.0)
    found = compared(['A', 'B', 'C'], [fit(X), fit(other), fit(X)])
    z = 0.2 / np.hypot(1.2 * 0.01, 0.01 / np.sqrt(2.0))
    assert found.z[1, entry] == pytest.approx(z, rel=1e-6)
    assert f'{ROUND.labels[entry]} of B differs by +20 %, z {z:+.1f}' in found.sentences[-1]


def test_a_small_significant_difference_hardly_matters():
    found = compared(['A', 'B'], [fit(X, 1e-4), fit(1.01 * X, 1e-4)])
    assert found.differs and 'hardly matters' in found.sentences[-1]


def test_entries_that_one_structure_ties_have_equal_values():
    wide = DIAGONAL.parameters(*ROUND.matrices(X))
    found = compared(['A', 'B'], [fit(X), fit(wide, 0.01, DIAGONAL)])
    assert found.structure is DIAGONAL and np.allclose(found.z, 0.0, atol=1e-9)
    wide[1] *= 1.2
    assert compared(['A', 'B'], [fit(X), fit(wide, 0.01, DIAGONAL)]).differs


def test_unidentifiable_entries_are_not_compared():
    blind = fit(np.where(np.arange(8) == 3, 0.0, X))
    blind[2][3, 3] = blind[2][5, 5] = np.inf
    found = compared(['A', 'B'], [blind, fit(X)])
    assert not found.differs and np.isnan(found.z[:, [3, 5]]).all()
    nothing = ROUND, X, np.diag(np.full(8, np.inf))
    assert 'cannot be compared' in compared(['A', 'B'], [nothing] * 2).sentences[-1]
