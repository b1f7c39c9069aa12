"""The scripts that draw the pictures of the pages."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[2] / 'docs' / 'figures').glob('*.py'))


@pytest.mark.parametrize('script', SCRIPTS, ids=lambda script: script.stem)
def test_script_uses_what_there_is(script):
    """Import what the script imports; each is run by hand when its picture changes."""
    pytest.importorskip('matplotlib')
    spec = spec_from_file_location(f'figure_{script.stem}', script)
    spec.loader.exec_module(module_from_spec(spec))
