"""Pages: headings, tables and figures as HTML, with all style inside."""

from collections.abc import Iterable, Sequence
from html import escape
import math

from bellows_ros.plots.style import Theme, THEMES


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


def figures(items: Sequence[tuple[str, str]]) -> str:
    """Return figures side by side: pairs of a caption and a picture."""
    inside = ''.join(
        f'<figure>{f"<figcaption>{escape(words)}</figcaption>" if words else ""}{svg}</figure>\n'
        for words, svg in items
    )
    return f'<div class="figures">\n{inside}</div>'


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
    names = ('background', 'text', 'quiet', 'grid', 'measured', 'predicted', 'error')
    return ''.join(f'--{name}:{getattr(theme, name)};' for name in names)


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
.quiet,figcaption{color:var(--quiet)}
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
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,480px),1fr));
gap:8px 20px}
figure{margin:.4em 0}
figcaption{font-size:.9em}
svg{display:block;width:100%;height:auto}
svg text{font-size:11px;fill:var(--quiet)}
svg text.label{fill:var(--text)}
svg path{fill:none}
.grid{stroke:var(--grid);stroke-width:1}
.line{stroke-width:1.2;stroke-linejoin:round}
.line.measured{stroke:var(--measured);stroke-width:3.6}
.line.predicted{stroke:var(--predicted)}
.line.error{stroke:var(--error);stroke-width:.9}
.line.other{stroke:var(--text)}
.line.quiet{stroke:var(--quiet);stroke-dasharray:4 3}
.line.dashed{stroke-dasharray:4 3}
.interval{stroke:var(--text);stroke-width:1.4}
.endless{stroke:var(--predicted);stroke-width:1.4;stroke-dasharray:2 4}
.dot{fill:var(--predicted)}
rect.used{fill:var(--measured)}
rect.lost{fill:var(--predicted)}
details{margin:.6em 0}
summary{cursor:pointer;color:var(--quiet)}
@media print{details>*{display:block}body{max-width:none}}
"""
