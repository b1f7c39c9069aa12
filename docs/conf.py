"""
How Sphinx builds these pages: `make docs`.

Formulas become MathML, so that the pages need nothing from the network.
"""

import re
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
exclude_patterns = ['_build', 'static', 'tools']
smartquotes = False  # '' is an empty text, and --set an option
html_theme = 'furo'
html_title = f'bellows_ros {release}'

html_static_path = ['static']
html_css_files = ['pages.css']

html_math_renderer = 'mathml'

myst_enable_extensions = ['attrs_inline', 'dollarmath']
myst_heading_anchors = 3

# Brackets grow with a matrix only in fonts made for formulas; lines beside it do everywhere.
BRACKETS = re.compile(r'<mo>\[</mo>\s*<mtable>(.*?)</mtable>\s*<mo>\]</mo>', re.DOTALL)


def setup(app: Any) -> None:
    """Add the renderer of formulas."""
    app.add_html_math_renderer('mathml', (inline_formula, None), (formula, None))


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
