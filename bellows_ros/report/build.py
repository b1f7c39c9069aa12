"""
Pages of an identification and of a replay: tables of the terminal, pictures, provenance.

Headings, tables and pictures are HTML with inline style.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any
import zlib

from bellows_ros.core.identification import validation
from bellows_ros.core.model.modes import modes
from bellows_ros.core.parameters.conversion import package_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.errors import BellowsError, shown, UnstableError
from bellows_ros.files import atomic, File, results
from bellows_ros.plots import pictures
from bellows_ros.plots.style import inline_svg, THEMES
from bellows_ros.workflows import identification, plot, recordings, replay
import numpy as np

from .sentences import sentence
from .text import print_identification, print_replay


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """Return a page of sections in HTML, light or dark by the reader's system."""
    light, dark = (''.join(f'--{name}:{colour};' for name, colour in asdict(theme).items())
                   for theme in THEMES.values())
    style = (f':root{{{light}--warn:#9a6700}}\n'
             f'@media (prefers-color-scheme:dark){{:root{{{dark}--warn:#e3b341}}}}\n\n'
             f'{STYLE.read_text()}')
    return PAGE.read_text().format(
        title=escaped(title), style=style, subtitle=escaped(subtitle),
        sections='\n'.join(sections))


def escaped(text: str) -> str:
    """Return any text as HTML."""
    return escape(shown(text, MAX_TEXT))


MAX_TEXT = 5000
"""Longest paragraph or cell, characters."""


class Section:
    """A section of a page, with the methods of the console."""

    def __init__(self, title: str) -> None:
        """Begin with a heading."""
        self._parts = [f'<section>\n<h2>{escaped(title)}</h2>']

    def html(self) -> str:
        """Return the section."""
        return '\n'.join([*self._parts, '</section>'])

    def line(self, text: str = '', style: str = '') -> None:
        """Write a line as a paragraph."""
        self.paragraph(*filter(None, [text]), style=style)

    def paragraph(self, *texts: str, style: str = '') -> None:
        """Write paragraphs, in a style of the console."""
        kind = f' class="{style}"' if style else ''
        self._parts += [f'<p{kind}>{escaped(text)}</p>' for text in texts]

    def table(self, rows: Sequence[Sequence[str]], right: bool = False, title: str = '') -> None:
        """Write a table with a head, optionally with all but the first column right-aligned."""
        self.line(title, 'bold')
        self.add(table(rows, right))

    def warn(self, *texts: str) -> None:
        """Write warnings as a list."""
        items = ''.join(f'<li>{escaped(text)}</li>' for text in texts)
        self.add(*([f'<ul class="warning">{items}</ul>'] if texts else []))

    def add(self, *parts: str) -> None:
        """Add HTML."""
        self._parts += parts


def table(rows: Sequence[Sequence[str]], right: bool = False) -> str:
    """Return a table with a head, optionally with all but the first column right-aligned."""
    lines = [''.join(
        f'<{tag}{" class=number" if right and column else ""}>{escaped(cell)}</{tag}>'
        for column, cell in enumerate(cells))
        for tag, cells in zip(['th', *['td'] * (len(rows) - 1)], rows, strict=True)]
    body = '\n'.join(f'<tr>{line}</tr>' for line in lines)
    return f'<div class="wide"><table>\n{body}\n</table></div>'


def figure(drawn: Any, caption: str = '') -> str:
    """
    Return a figure of `plots` as a picture of the page, with a caption.

    On a narrow screen the two columns of six panels are stacked.
    """
    svg = inline_svg(drawn)
    text = f'<figcaption>{escaped(caption)}</figcaption>' if caption else ''
    if len(drawn.axes) < len(AXES):
        return f'<figure>{svg}{text}</figure>'
    name = f'picture-{zlib.crc32(svg.encode()):08x}'
    width, height = (72.0 * side for side in drawn.get_size_inches())
    halves = ''.join(
        f'<svg class="half" aria-hidden="true" viewBox="{left:g} 0 {0.5 * width:g} {height:g}">'
        f'<use xlink:href="#{name}"/></svg>' for left in (0.0, 0.5 * width))
    whole = svg.replace('<svg ', '<svg class="whole" ', 1).replace(
        '>', f'><g id="{name}">', 1).replace('</svg>', '</g></svg>')
    return f'<figure>{whole}{halves}{text}</figure>'


PAGE, STYLE = (Path(__file__).with_name(name) for name in ('page.html', 'style.css'))


def identification_report(result: identification.Identification) -> str:
    """
    Return the page of a fit with the parameter output.report.

    Raises
    ------
    BellowsError
        If a file of its provenance cannot be read.

    """
    details = Section('Fit')
    sections = [_card(result, details), details]
    for replayed in result.validations:
        sections.append(_motion(f'Not used in the fit: {replayed.bag}', replayed))
    parameters = dict(zip(
        map(str, result.values.bags), recordings.values_of_each(result.cup_values()),
        strict=True))
    for recording in result.recordings:
        sections.append(_simulated(parameters[recording.name], recording))
    origin = dict(result.as_json()['provenance'])  # including recordings outside the fit
    origin['recordings'] = [
        *origin['recordings'],
        *results.provenance([each.bag for each in result.validations])['recordings']]
    return page(
        f'Cup identified from {", ".join(result.bags)}',
        f'{result.fit.method.replace("_", " ")}, {result.fit.structure}',
        [*(section.html() for section in sections), _origin(origin, result.values)])


def _card(result: identification.Identification, details: Section) -> Section:
    """Return verdict, cup, modes, validity range and limits of accuracy, with a sketch."""
    card = Section('Summary')
    fit, values = result.fit, result.cup_values()
    if not result.refusals:
        card.line(sentence('report', 'card.usable'), 'bold')
    print_identification(result, card, details)
    if not fit.converged:
        return card
    try:
        found = modes(result.cup, package_of(values), values.gravity.magnitude)
    except BellowsError:
        found = []
    if found:
        card.table([('mode', 'frequency', 'damping ratio'), *(
            (mode.direction, f'{mode.frequency:.2f} Hz', f'{mode.damping:.3f}')
            for mode in found)], right=True)
    low, high = result.envelope.deflection_low, result.envelope.deflection_high
    card.paragraph(sentence(
        'report', 'card.range', masses=[f'{mass:.3g} kg' for mass in dict.fromkeys(
            result.envelope.mass.tolist())],
        shifts=[f'{AXES[i]} {1e3 * low[i]:.1f} to {1e3 * high[i]:.1f} mm' for i in range(3)],
        bending=float(np.abs([low[3:5], high[3:5]]).max()),
        torsion=float(np.abs([low[5], high[5]]).max())))
    labels, errors = fit.labels, np.sqrt(np.diag(fit.covariance))
    relative = errors / np.abs(fit.parameters)
    if np.isfinite(relative).any():
        worst = int(np.nanargmax(np.where(np.isfinite(relative), relative, np.nan)))
        card.paragraph(sentence('report', 'card.limit', label=labels[worst],
                                error=float(relative[worst])))
    card.add(figure(pictures.sketch_figure(values), sentence('report', 'card.sketch')))
    return card


def replay_report(result: replay.Replay, parameter_files: Sequence[File] = ()) -> str:
    """Return the page of a replay."""
    section = _motion('Free simulation', result)
    if result.observed:
        section.add(figure(pictures.errors_figure(
            result.observed.estimates, f'relative to the tool, with {result.observed.topic}')))
    origin = results.provenance([result.bag], parameter_files)
    return page(f'Replay of {result.bag}', 'free simulation from start to end',
                [section.html(), _origin(origin, result.values)])


def write_page(result: identification.Identification, path: File) -> None:
    """
    Write the page of an identification with the parameter output.report.

    Raises
    ------
    BellowsError
        If the file cannot be written.

    """
    atomic.write_text(path, identification_report(result))


def _simulated(values: Values, recording: Recording) -> Section:
    """Return the simulation of a recording of the fit, or the reason for its absence."""
    title = f'Used in the fit: {recording.name}'
    try:
        return _motion(title, replay.validated(values, recording), with_loads=True)
    except UnstableError as error:
        section = Section(title)
        section.paragraph(f'This cup cannot be simulated: {error}', style='dim')
        return section


def _motion(title: str, replayed: replay.Replay, with_loads: bool = False) -> Section:
    """Return text and figures of a freely simulated recording."""
    section = Section(title)
    print_replay(replayed, section)
    if with_loads:
        drawn = pictures.deflection_figure(
            plot.loads(replayed.values, replayed.recording), replayed.bag)
        section.add(figure(drawn, sentence('report', 'caption.deflection')))
    section.add(*(figure(drawn, sentence('report', f'caption.{code}', **numbers))
                  for drawn, code, numbers in _figures(replayed)))
    return section


def _figures(replayed: replay.Replay) -> Iterator[tuple[Any, str, dict[str, Any]]]:
    """Yield figures of a freely simulated recording, with codes of their captions."""
    validation, bag = replayed.validation, replayed.bag
    yield pictures.replay_figure(replayed), 'replay', {'samples': validation.scores.samples}
    if replayed.margin:
        yield pictures.margin_figure(replayed.margins, bag), 'margin', {}
    yield pictures.spectra_figure(
        plot.Spectra(validation.motion.frequency, np.sqrt(validation.motion.density),
                     np.sqrt(validation.spectrum.density)), bag), 'spectra', {}


def _origin(provenance: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Return a section with digests, versions and settings."""
    section = Section('Provenance')
    section.table([('', 'path', 'file', 'bytes', 'SHA-256'), *(
        (kind, entry['path'], file['name'], str(file['bytes']), file['sha256'])
        for kind, key in (('recording', 'recordings'), ('parameters', 'parameter_files'))
        for entry in provenance.get(key, ()) for file in entry['files'])])
    section.table([
        ('', 'version or seed'),
        *((name, version or 'not there') for name, version in provenance['versions'].items()),
        ('random seed', f'{validation.DRAW_SEED} (validation)')])
    content = table([
        ('parameter', 'value'), *((name, _setting(value)) for name, value in settings.items())])
    section.add(f'<details><summary>All settings</summary>\n{content}\n</details>')
    return section.html()


def _setting(value: Any) -> str:
    """Return a setting; for a matrix its rows."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(_setting(item) for item in value) + ']'
    if isinstance(value, float):
        return f'{value:.8g}'
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"
