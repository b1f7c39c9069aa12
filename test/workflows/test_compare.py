"""Comparison of result files."""

import json

from bellows_ros.errors import BellowsError
from bellows_ros.workflows.compare import compare_files
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify
import pytest


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
    assert itself.consistency.probability == pytest.approx(1.0)
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
