"""Pages: headings, tables and pictures as HTML, with all style inside."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from html import escape
import math
from typing import Any

from bellows_ros.plots.style import inline_svg, Theme, THEMES


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """Return a whole page of sections that are HTML already."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f'<title>{escape(title)}</title>\n<style>{_style()}</style>\n</head>\n<body>\n'
        f'<h1>{escape(title)}</h1>\n<p class="quiet">{escape(subtitle)}</p>\n'
        + '\n'.join(sections)
        + '\n</body>\n</html>\n'
    )


def section(title: str, *content: str) -> str:
    """Return a section with a heading."""
    inside = '\n'.join(filter(None, content))
    return f'<section>\n<h2>{escape(title)}</h2>\n{inside}\n</section>'


def heading(text: str) -> str:
    """Return a heading inside a section."""
    return f'<h3>{escape(text)}</h3>'


def paragraph(text: str, kind: str = '') -> str:
    """Return a paragraph, with a class if given."""
    of_kind = f' class="{kind}"' if kind else ''
    return f'<p{of_kind}>{escape(text)}</p>'


def warnings(texts: Sequence[str]) -> str:
    """Return warnings as a list, or ''."""
    return bullets(texts, 'warning')


def bullets(texts: Sequence[str], kind: str = '') -> str:
    """Return a list of sentences, or ''."""
    of_kind = f' class="{kind}"' if kind else ''
    items = ''.join(f'<li>{escape(text)}</li>' for text in texts)
    return f'<ul{of_kind}>{items}</ul>' if texts else ''


def table(head: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int] = (0,)) -> str:
    """Return a table with numbers to the right, the columns in `words` to the left."""
    kinds = ['' if i in words else ' class="number"' for i in range(len(head))]
    lines = [_row('th', head, kinds), *(_row('td', row, kinds) for row in rows)]
    return f'<div class="wide"><table>\n{"".join(lines)}</table></div>'


def figure(drawn: Any) -> str:
    """Return a figure of `plots` as a picture of the page."""
    return f'<figure>{inline_svg(drawn)}</figure>'


def percent(ratio: float) -> str:
    """Return a ratio in percent, or a dash if it is not finite."""
    return f'{100.0 * ratio:.2f} %' if math.isfinite(ratio) else '-'


def folded(title: str, content: str) -> str:
    """Return content that is shown when asked for."""
    return f'<details><summary>{escape(title)}</summary>\n{content}\n</details>'


def _row(tag: str, cells: Sequence[str], kinds: Sequence[str]) -> str:
    """Return a row of a table."""
    inside = ''.join(
        f'<{tag}{kind}>{escape(cell)}</{tag}>' for cell, kind in zip(cells, kinds, strict=True)
    )
    return f'<tr>{inside}</tr>\n'


def _variables(theme: Theme) -> str:
    """Return a theme's colours as variables."""
    return ''.join(f'--{name}:{colour};' for name, colour in asdict(theme).items())


def _style() -> str:
    """Return the style, light and dark as the reader's system has it."""
    return (
        f':root{{{_variables(THEMES["light"])}--warn:#9a6700}}\n'
        f'@media (prefers-color-scheme:dark){{:root{{{_variables(THEMES["dark"])}'
        f'--warn:#e3b341}}}}\n{STYLE}'
    )


STYLE = """
*{box-sizing:border-box}
body{margin:0 auto;padding:24px;max-width:1180px;background:var(--background);color:var(--text);
font:15px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}
h1{font-size:1.6em;margin:0}
h2{font-size:1.2em;margin:2em 0 .4em;padding-bottom:.2em;border-bottom:1px solid var(--grid)}
h3{font-size:1em;margin:1.4em 0 .3em}
p{margin:.4em 0;max-width:50em}
.quiet{color:var(--quiet)}
ul{margin:.4em 0;padding-left:1.3em;max-width:52em}
ul.warning{color:var(--warn)}
.wide{overflow-x:auto}
table{border-collapse:collapse;margin:.5em 0;font-variant-numeric:tabular-nums}
th,td{padding:3px 14px 3px 0;text-align:left;border-bottom:1px solid var(--grid);
vertical-align:top}
th{font-weight:600;color:var(--quiet)}
.number{text-align:right}
td{white-space:nowrap}
details td{white-space:normal;overflow-wrap:anywhere}
details td:first-child{white-space:nowrap}
figure{margin:1em 0;overflow-x:auto}
svg{display:block;width:100%;min-width:640px;max-width:1000px;height:auto}
details{margin:.6em 0}
summary{cursor:pointer;color:var(--quiet)}
@media print{details>*{display:block}body{max-width:none}}
"""
