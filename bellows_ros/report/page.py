"""Pages: headings, tables and pictures as HTML, with all style inside."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from html import escape
from typing import Any

from bellows_ros.plots.style import inline_svg, Theme, THEMES


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """Return a whole page of sections that are HTML already."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f'<title>{escape(title)}</title>\n<style>{_style()}</style>\n</head>\n<body>\n'
        f'<h1>{escape(title)}</h1>\n<p class="dim">{escape(subtitle)}</p>\n'
        + '\n'.join(sections)
        + '\n</body>\n</html>\n'
    )


class Section:
    """A section of a page, written as a command writes to the console."""

    def __init__(self, title: str) -> None:
        """Begin with a heading."""
        self._parts = [f'<section>\n<h2>{escape(title)}</h2>']

    def html(self) -> str:
        """Return the section."""
        return '\n'.join([*self._parts, '</section>'])

    def line(self, text: str = '', style: str = '') -> None:
        """Write a line as a paragraph."""
        self.paragraph(*filter(None, [text]), style=style)

    def paragraph(self, *texts: str, style: str = '') -> None:
        """Write paragraphs, in a style of the console."""
        kind = f' class="{style}"' if style else ''
        self._parts += [f'<p{kind}>{escape(text)}</p>' for text in texts]

    def table(self, rows: Sequence[Sequence[str]], right: bool = False, title: str = '') -> None:
        """Write a table with a head, all but the first column to the right if wanted."""
        self.line(title, 'bold')
        self.add(table(rows, right))

    def warn(self, *texts: str) -> None:
        """Write warnings as a list."""
        items = ''.join(f'<li>{escape(text)}</li>' for text in texts)
        self.add(*([f'<ul class="warning">{items}</ul>'] if texts else []))

    def add(self, *parts: str) -> None:
        """Add what is HTML already."""
        self._parts += parts


def table(rows: Sequence[Sequence[str]], right: bool = False) -> str:
    """Return a table with a head, all but the first column to the right if wanted."""
    lines = [''.join(
        f'<{tag}{" class=number" if right and column else ""}>{escape(cell)}</{tag}>'
        for column, cell in enumerate(cells))
        for tag, cells in zip(['th', *['td'] * (len(rows) - 1)], rows, strict=True)]
    body = '\n'.join(f'<tr>{line}</tr>' for line in lines)
    return f'<div class="wide"><table>\n{body}\n</table></div>'


def figure(drawn: Any) -> str:
    """Return a figure of `plots` as a picture of the page."""
    return f'<figure>{inline_svg(drawn)}</figure>'


def folded(title: str, content: str) -> str:
    """Return content that is shown when asked for."""
    return f'<details><summary>{escape(title)}</summary>\n{content}\n</details>'


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
.dim{color:var(--quiet)}
.bold{font-weight:600}
.red{color:var(--warn)}
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
