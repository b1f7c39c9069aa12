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
    """Find the same cup, from independent recordings whose digests differ."""
    found = compare_files(*files)
    assert found.shared == ()
    assert not found.fits.shake_matters
    stiffness = [c for c in found.fits.parameters if c.name.startswith('K')]
    assert all(abs(change.percent) < 2.0 for change in stiffness)
    names = {difference.name for difference in found.settings}
    assert 'bags' in names and any(name.startswith('content of') for name in names)
    json.dumps(found.as_json()['parameters'])
    assert compare_files(files[0], files[0]).fits.p_value == pytest.approx(1.0)


@pytest.mark.parametrize(('change', 'named'), [
    ({'parameters': {}}, "'labels'"), ({'settings': None}, 'NoneType'),
    ({'structure': 'round'}, "'round'"), ({'damping': 3}, r'damping .*\(6, 6\)'),
    ({'parameters': {'labels': ['K x'], 'covariance': [[1.0]]}}, "'K z'"),
    *((change, '') for change in (
        {'provenance': {'recordings': [{'path': 'a', 'files': [{}]}]}}, {'cup_length': None},
        {'structure': 'a' * 5000}, {'stiffness': [[None] * 6] * 6})),
    *(({'stiffness': K}, r'stiffness .*\(6, 6\)') for K in ([[1.0] * 5] * 5, [1.0] * 36))])
def test_results_with_other_content_are_refused(files, tmp_path, change, named):
    """At a length that can be read."""
    file = tmp_path / 'changed.json'
    file.write_text(json.dumps({**json.loads(files[0].read_text()), **change}))
    with pytest.raises(BellowsError, match=rf"changed\.json'.*{named}") as error:
        compare_files(file, files[0])
    assert len(str(error.value)) < 1000
