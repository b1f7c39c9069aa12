"""The scripts that draw the pictures of the pages."""

import pytest

from .conftest import DOCS, load


@pytest.mark.parametrize('name', sorted(path.stem for path in DOCS.glob('figures/*.py')))
def test_script_uses_what_there_is(name):
    """Import what the script imports; each is run by hand when its picture changes."""
    pytest.importorskip('matplotlib')
    load('figures', name)
