"""Damaged and hostile results of a fit: refused, or as if sound."""

import functools
import json
from pathlib import Path
import tempfile

from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.compare import compare_files
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify

from .frame import CLEAN, judged, replaced, scrambled, SILENT
from .readers import ATTEMPTS, ROOT


@functools.cache
def sound():
    """Return the result of a fit to a recording."""
    settings = {
        **read_parameters(ROOT / 'bags/package.yaml'), 'fit.method': 'least_squares',
        'bags': [str(ROOT / 'bags/validation')]}
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / 'fit.json'
        save(identify(settings), None, result)
        return result.read_text()


def fits(rng, folder):
    """Damage results, and compare them."""
    text = sound()
    whole, other = folder / 'whole.json', folder / 'other.json'
    whole.write_text(text)

    def compare(*pair):
        json.dumps(compare_files(*pair).as_json(), default=list)
        return CLEAN if json.loads(other.read_text()) == json.loads(text) else SILENT

    for _ in range(ATTEMPTS // 3):
        other.write_text(scrambled(rng, text) if rng.random() < 0.3
                         else json.dumps(replaced(rng, json.loads(text))), errors='replace')
        pair = (whole, other) if rng.random() < 0.5 else (other, whole)
        yield judged(str(folder), compare, *pair)
