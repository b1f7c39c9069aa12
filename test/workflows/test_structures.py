"""What recordings can tell, and the structures compared, from bags on disk."""

from bellows_ros.workflows.structures import structures
from bellows_ros.workflows.verdict import selection
import pytest

from ..core.identification.laboratory import FAULTS, Laboratory, parameters


def test_a_static_recording_is_said_to_tell_little(root, known):
    result = structures({**known, 'bags': [str(root / 'bags/static')], 'recording.end': 8.0})
    words = ' '.join(result.warnings)
    assert 'Torsion is hardly excited' in words and 'turn the tool about z at 1-3 Hz' in words


@pytest.mark.parametrize(('fault', 'word'), [
    ('soft spring', 'not linear'), ('length', 'cup.length'), ('', ''),
    pytest.param('friction', 'hysteresis', marks=pytest.mark.stress)])
def test_where_no_structure_fits_the_cause_is_named(fault, word):
    """Say so of a cup that is no linear one, and of wrong data, and not of a sound recording."""
    laboratory = Laboratory(74102 if fault else 74100, rate_hz=240.0)
    FAULTS.get(fault, [lambda own: None])[0](laboratory)
    found = selection([laboratory.recording()], parameters(laboratory))
    assert found.fits is not bool(fault)
    assert found.advice[0].startswith('No structure fits' if fault else 'Use fit.structure')
    assert word in found.advice[0]
