"""
The notebooks: run from their first cell to their last, as a reader would, with what they print.

`python docs/tools/notebooks.py` runs all and writes their outputs into them. What is stored is so
what the code gives; test/docs/test_notebooks.py runs them again and compares.
"""

from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / 'notebooks'
TIMEOUT = 100  # s, for one cell
DESCRIBED = """
from bellows_ros.plots.style import description
from matplotlib.figure import Figure
get_ipython().display_formatter.formatters['text/plain'].for_type(
    Figure, lambda figure, printer, _: printer.text(description(figure)))
"""
"""A first cell, not stored, with which figures have their description as their text."""


def notebooks() -> list[Path]:
    """Return all notebooks."""
    return sorted(FOLDER.glob('*.ipynb'))


def executed(path: Path) -> Any:
    """Return a notebook with the outputs of this run; raises where a cell fails."""
    from nbclient import NotebookClient
    import nbformat

    book = nbformat.read(path, as_version=4)
    book.cells.insert(0, nbformat.v4.new_code_cell(DESCRIBED))
    where = {'metadata': {'path': str(path.parent)}}
    NotebookClient(book, timeout=TIMEOUT, resources=where, record_timing=False).execute()
    del book.cells[0]
    for cell in (cell for cell in book.cells if cell.cell_type == 'code'):
        cell.execution_count -= 1
        for output in cell.outputs:
            if 'execution_count' in output:
                output.execution_count -= 1
    return book


def printed(book: Any) -> list[str]:
    """Return what each code cell prints."""
    return [
        ''.join(o.get('text', '') for o in cell.outputs if o.output_type == 'stream')
        for cell in book.cells if cell.cell_type == 'code'
    ]


def pictures(book: Any) -> list[str]:
    """Return the descriptions of all pictures."""
    return [
        o.data['text/plain'] for cell in book.cells if cell.cell_type == 'code'
        for o in cell.outputs if 'image/png' in o.get('data', {})
    ]


def main() -> None:
    """Run all, and store their outputs."""
    import nbformat

    for path in notebooks():
        book = executed(path)
        book.metadata = {'kernelspec': book.metadata.kernelspec,
                         'language_info': {'name': 'python'}}
        nbformat.write(book, path)
        print(f'ran {path.name}')


if __name__ == '__main__':
    main()
