"""
How Sphinx builds these pages: `make docs`.

Formulas become MathML, so that the pages need nothing from the network.
"""

import base64
from collections.abc import Iterator
import json
from pathlib import Path
import re
import shutil
from typing import Any

from bellows_ros import __version__
from docutils.nodes import SkipNode
from docutils.utils.math import latex2mathml

project = 'bellows_ros'
author = 'bellows_ros maintainers'
copyright = author  # noqa: A001 (the name Sphinx reads)
release = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
autodoc_typehints = 'none'  # the docstrings say more: shapes, units, frames
autodoc_member_order = 'bysource'
exclude_patterns = ['_build', 'figures', 'static', 'tools']
smartquotes = False  # '' is an empty text, and --set an option
html_theme = 'furo'
html_title = f'bellows_ros {release}'

html_static_path = ['static']
html_css_files = ['pages.css']

html_math_renderer = 'mathml'

myst_enable_extensions = ['attrs_inline', 'dollarmath']
myst_heading_anchors = 3

HERE = Path(__file__).parent
NOTEBOOKS = HERE / 'notebooks'
"""Pages that are made of the notebooks while the site is built."""

# Brackets grow with a matrix only in fonts made for formulas; lines beside it do everywhere.
BRACKETS = re.compile(r'<mo>\[</mo>\s*<mtable>(.*?)</mtable>\s*<mo>\]</mo>', re.DOTALL)


def setup(app: Any) -> None:
    """Add the renderer of formulas, and the pages of the notebooks."""
    app.add_html_math_renderer('mathml', (inline_formula, None), (formula, None))
    shutil.rmtree(NOTEBOOKS, ignore_errors=True)
    NOTEBOOKS.mkdir()
    for book in sorted((HERE.parent / 'notebooks').glob('*.ipynb')):
        (NOTEBOOKS / f'{book.stem}.md').write_text('\n\n'.join(notebook_parts(book)) + '\n')
    app.connect('source-read', lead_to_notebooks)
    app.connect('source-read', pair_pictures)


def notebook_parts(book: Path) -> Iterator[str]:
    """Yield the cells of a notebook, and their outputs, as Markdown; write its pictures."""
    for cell in json.loads(book.read_text())['cells']:
        source = ''.join(cell['source'])
        yield source if cell['cell_type'] == 'markdown' else f'```python\n{source}\n```'
        for number, output in enumerate(cell.get('outputs', ())):
            data = output.get('data', {})
            if 'image/png' in data:
                name = f'{book.stem}_{cell["id"]}_{number}.png'
                (NOTEBOOKS / name).write_bytes(base64.b64decode(data['image/png']))
                yield f'![Output of the cell above]({name})'
            elif text := ''.join(output.get('text', data.get('text/plain', ()))):
                yield f'```text\n{text.rstrip()}\n```'


def lead_to_notebooks(app: Any, name: str, source: list[str]) -> None:
    """Let links to notebooks lead to their pages, and links of these to the other pages."""
    inside = name.startswith('notebooks/')
    pairs = ('](../docs/', '](../') if inside else ('](../notebooks/', '](notebooks/')
    source[0] = re.sub(r'(\]\(notebooks/\w+)\.ipynb\)', r'\1.md)', source[0].replace(*pairs))


def pair_pictures(app: Any, name: str, source: list[str]) -> None:
    """Show a picture that has a dark one beside it in the theme of the site."""
    def pair(picture: re.Match[str]) -> str:
        alt, stem, ending = picture.groups()
        dark = f'{stem}_dark.{ending}'
        if not (HERE / dark).exists():
            return picture[0]
        return f'![{alt}]({stem}.{ending}){{.only-light}} ![{alt}]({dark}){{.only-dark}}'

    source[0] = re.sub(r'!\[([^\]]*)\]\((images/\w+)\.(\w+)\)', pair, source[0])


def inline_formula(translator: Any, node: Any) -> None:
    """Write a formula in a line of text."""
    translator.body.append(str(latex2mathml.tex2mathml(node.astext())))
    raise SkipNode


def formula(translator: Any, node: Any) -> None:
    """Write a formula in a line of its own."""
    mathml = latex2mathml.tex2mathml(node.astext(), as_block=True)
    mathml = BRACKETS.sub(r'<mtable class="matrix">\1</mtable>', mathml)
    translator.body.append(f'<div class="formula">{mathml}</div>')
    raise SkipNode
