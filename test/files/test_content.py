"""Results whose content is not what a fit writes: refused with their names, whatever it is."""

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.structure import structure_named
from bellows_ros.errors import BellowsError
from bellows_ros.files.results import format_json
from bellows_ros.workflows.compare import compare_files
import numpy as np
import pytest

PACKAGE = {
    'package.mass': 2.0, 'package.com': [0.0, 0.0, -0.03],
    'package.inertia': [0.01, 0.01, 0.01, 0.0, 0.0, 0.0],
}


def fit():
    """Give a result with all that a comparison reads."""
    cup = Cup.thesis()
    error = 0.01 * np.abs(cup.stiffness)
    return {
        'method': 'least_squares', 'structure': 'diagonal', 'stiffness': cup.stiffness.tolist(),
        'damping': cup.damping.tolist(), 'stiffness_std': error.tolist(),
        'damping_std': error.tolist(), 'samples_used': 100, 'samples_rejected': 0,
        'condition_number': 3.0, 'settings': {'bags': ['a'], 'cup.length': 0.05, **PACKAGE},
        'parameters': {
            'labels': list(structure_named('diagonal').labels),
            'covariance': (1e-4 * np.eye(12)).tolist()},
        'cup_length': 0.05,
        'provenance': {
            'recordings': [{'path': 'a', 'files': [{'name': 'a', 'sha256': '0' * 64}]}],
            'versions': {'bellows_ros': '1'}},
    }


@pytest.mark.parametrize('key, value', [
    ('provenance', 'x'), ('provenance', {'recordings': [3]}), ('provenance', {'versions': 'x'}),
    ('provenance', {'recordings': [{'path': 'a', 'files': [{}]}]}), ('structure', 'a' * 5000),
    ('parameters', []), ('stiffness', [[None] * 6] * 6), ('cup_length', {}),
])
def test_results_with_other_content_are_refused(tmp_path, key, value):
    good, bad = tmp_path / 'good.json', tmp_path / 'bad.json'
    good.write_text(format_json(fit()))
    assert compare_files(good, good).fits.p_value == pytest.approx(1.0)
    bad.write_text(format_json({**fit(), key: value}))
    with pytest.raises(BellowsError) as error:
        compare_files(bad, good)
    assert len(str(error.value)) < 1000
