"""The notebooks run, and what is stored in them is what they give."""

import re

import pytest

from .conftest import load, PAGES, show_the_same

NOTEBOOKS = load('tools', 'notebooks')


@pytest.mark.extras
@pytest.mark.parametrize('path', [
    pytest.param(path, marks=[pytest.mark.stress] if path.name == 'toss.ipynb' else [])
    for path in NOTEBOOKS.notebooks()], ids=lambda path: path.name)
def test_a_notebook_gives_what_is_stored_in_it(path):
    """Run every cell; compare what they print but for the numbers, and what pictures show."""
    pytest.importorskip('nbclient', reason="no notebook runner here (pip install '.[notebook]')")
    pytest.importorskip('ipykernel', reason="no notebook kernel here (pip install '.[notebook]')")
    nbformat = pytest.importorskip('nbformat', reason='nbformat comes with nbclient')
    stored, now = nbformat.read(path, as_version=4), NOTEBOOKS.executed(path)
    for before, after in zip(NOTEBOOKS.printed(stored), NOTEBOOKS.printed(now), strict=True):
        assert PAGES.matches(before, after), f'run: make pictures\n{before}\n{after}'
    shown = list(zip(NOTEBOOKS.pictures(now), NOTEBOOKS.pictures(stored), strict=True))
    assert len(shown) >= 2
    for new, before in shown:
        assert show_the_same(new, before), f'run: make pictures\n{before}\n{new}'


@pytest.mark.extras
@pytest.mark.parametrize('path', NOTEBOOKS.notebooks(), ids=lambda path: path.name)
def test_a_notebook_was_run_from_top_to_bottom(path):
    """Count the cells without a gap, keep no errors and warnings, and link to what is there."""
    nbformat = pytest.importorskip('nbformat', reason='nbformat comes with nbclient')
    book = nbformat.read(path, as_version=4)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == 'code']
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    for output in (output for cell in code for output in cell.outputs):
        assert output.output_type != 'error' and output.get('name') != 'stderr', output
    words = ''.join(cell.source for cell in book.cells if cell.cell_type == 'markdown')
    for link in re.findall(r'\]\(([^)#\s]+)', words):
        assert (path.parent / link).exists(), link


@pytest.mark.parametrize('name', ['docs/tutorial.md', *(
    f'notebooks/{path.name}' for path in NOTEBOOKS.notebooks())])
def test_readers_meet_public_names_alone(root, name):
    """Import no module of the package but the library, and set no part of another."""
    found = re.findall(r'(?:import|from) bellows_ros\.\w+|\.pairing\.', (root / name).read_text())
    assert found == []
