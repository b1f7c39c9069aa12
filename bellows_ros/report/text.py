"""Numbers, lists, and results in the form printed by commands and pages."""

from collections.abc import Sequence
import math
import textwrap
from typing import Any, TYPE_CHECKING

from bellows_ros.core.identification.result import CHANCE, Fit, UNITS
from bellows_ros.core.model.cup_package import LAW, Term
from bellows_ros.core.model.structure import structure_named
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.errors import shown
from bellows_ros.workflows.recordings import offset_findings
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .findings import listed
from .findings import text as text_of

if TYPE_CHECKING:
    from bellows_ros.core.identification.validation import CornerScores
    from bellows_ros.core.identification.verdict import Simulated
    from bellows_ros.workflows.identification import Identification
    from bellows_ros.workflows.replay import Observed, Replay


LEGEND = (
    'RMS and peak: error of a free simulation from start to end. live: RMS error of the live '
    'predictor, from the messages as they came. noise: RMS error due to measurement noise '
    'alone. NRMSE: RMS error over motion; * moves too little for a verdict, as noise alone is '
    'more than 5 % of its motion.')
TWO_ERRORS = (
    'The first standard error is due to noise; the second includes the errors of the given '
    'quantities (package.*_std, cup.length_std, recording.*_std). K and P are wrong by the factor '
    'by which mass and inertia are.')

MAX_TEXT = 5000
"""Longest paragraph or cell, characters."""
WIDTH = 100
"""Largest width of sentences, characters."""


def with_error(value: float, error: float, unit: str = '') -> str:
    """
    Return a value to the decimal of its error's second digit, the error, and the unit.

    With an infinite error the value is meaningless, and omitted.
    """
    if math.isinf(error):
        return 'not identifiable'
    if not (error > 0.0 and math.isfinite(value)):
        return f'{value:z.5g} {unit}'.rstrip()
    value_text, error_text = column([value, error], error)
    return f'{value_text} ± {error_text} {unit}'.rstrip()


def column(values: Sequence[float], error: float | None = None) -> list[str]:
    """
    Return numbers with equal decimals: enough for two digits of an error.

    Without an error, enough for the smallest number that is at least 1 % of the largest.
    """
    sizes = [abs(value) for value in values if math.isfinite(value) and value]
    least = error or min((size for size in sizes if size >= 0.01 * max(sizes)), default=1.0)
    decimals = max(0, 1 - math.floor(math.log10(least)))
    return [f'{value:z.{decimals}f}' for value in values]


def formatted(
    value: float | None, form: str = '.3g', unit: str = '', factor: float = 1.0,
    unknown: str = '-',
) -> str:
    """Return a number times a factor with its unit, or a dash if unknown."""
    if value is None or not math.isfinite(value):
        return unknown
    return f'{factor * value:z{form}} {unit}'.rstrip()


DISPLAYED = {'kg': 'g', 'rad': 'deg', 'm': 'mm', 's': 'ms', 'N s': 'mN s'}
"""Printed units of small quantities."""
FACTORS = {**dict.fromkeys(('g', 'mm', 'ms', 'mN s', 'mrad'), 1e3),
           **dict.fromkeys(('deg', 'deg/s'), math.degrees(1.0))}
"""Numbers of printed units in an SI unit; 1 for others."""


def quantity(value: float, error: float, unit: str) -> str:
    """Return a number in SI units with its error, if any, in a printed unit."""
    factor = FACTORS.get(unit, 1.0)
    if not error > 0.0:
        return formatted(value, '.4g', unit, factor)
    return with_error(factor * value, factor * error, unit)


class Writer:
    """Lines, sentences, tables and warnings on a console of rich; foreign text is escaped."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._gap = self._begun = False

    def close_gap(self) -> None:
        """Write a pending empty line."""
        if self._gap:
            self.console.print()
        self._gap, self._begun = False, True

    def line(self, text: str = '', style: str = '') -> None:
        """Write a line, whole; an empty one is never written first or twice."""
        if not text:
            self._gap = self._begun
            return
        self.close_gap()
        self.console.print(Text(shown(text, MAX_TEXT), style), soft_wrap=True)

    def paragraph(self, *texts: str, style: str = '') -> None:
        """Write sentences, wrapped, each with its indentation."""
        width = max(min(self.console.width, WIDTH), 40)
        for text in texts:
            indent = text[:len(text) - len(text.lstrip())]
            for line in textwrap.wrap(
                    shown(text.strip(), MAX_TEXT), width, initial_indent=indent,
                    subsequent_indent=2 * indent, break_long_words=False, break_on_hyphens=False):
                self.line(line, style)

    def table(self, rows: Sequence[Sequence[str]], right: bool = False, title: str = '') -> None:
        """Write rows in columns below a head; all but the first may be right-aligned."""
        self.line()
        self.line(title, 'bold')
        self.close_gap()
        table = Table(box=None, pad_edge=False, padding=(0, 0, 0, 2), header_style='')
        for number, name in enumerate(rows[0]):
            table.add_column(Text(name), justify='right' if right and number else 'left',
                             overflow='fold')
        for row in rows[1:]:
            table.add_row(*(Text(shown(cell, MAX_TEXT)) for cell in row))
        width = self.console.width - 2 if self.console.is_terminal else MAX_TEXT
        options = self.console.options.update(width=width)
        for segments in self.console.render_lines(table, options, pad=False):
            self.line(f'  {"".join(part.text for part in segments).rstrip()}')
        self.line()

    def warn(self, *texts: str) -> None:
        """Write warnings."""
        for text in texts:
            self.line(f'warning: {text}', 'yellow')


def print_identification(result: 'Identification', out: Any) -> None:
    """Print the cup, with samples and findings."""
    fit, verdict = result.fit, result.verdict
    out.paragraph(*map(text_of, verdict.cause))
    out.paragraph(*result.refusals, style='red')
    found = 'No cup' if result.refusals else 'Cup'
    out.line(f'{found} identified from {listed(result.bags)}', 'bold')
    out.line(f'({fit.method.replace("_", " ")}, {fit.structure})', 'dim')
    out.line()
    for simulated in verdict.simulated:
        _print_simulated(simulated, out)
    if fit.converged:
        if result.refusals:
            out.line('K and P of the refused fit, for diagnosis only:')
        print_cup(fit, out)
    out.paragraph(f'{fit.samples_used} samples used, {fit.samples_rejected} rejected.')
    out.paragraph(*result.notes)
    out.warn(*result.warnings)


def _print_simulated(simulated: 'Simulated', out: Any) -> None:
    """Print errors and noise of a free simulation, by axis or in the corners of a tag."""
    if np.isnan(simulated.rms).any():
        out.paragraph(f'The free simulation of {simulated.bag} with this cup diverges.')
        return
    factors, units = DISPLAY_FACTORS, list(DISPLAY_UNITS)
    if len(simulated.axes) == 1:
        factors, units = np.array([1e3]), ['mrad']
    head = [f'{axis} {unit}' for axis, unit in zip(simulated.axes, units, strict=True)]
    errors, noise = ([f'{x:.3g}' for x in factors * each]
                     for each in (simulated.rms, simulated.noise))
    out.table([('', *head), ('error', *errors), ('noise', *noise)], right=True,
              title=f'Free simulation of {simulated.bag} with this cup (RMS):')


def print_cup(fit: Fit, out: Any) -> None:
    """Print K and P with standard errors, a line per direction; with couplings all entries."""
    structure, exact = structure_named(fit.structure), fit.exactly_given
    matrices = (('stiffness K', 'K', fit.stiffness, exact.stiffness_std, fit.stiffness_std),
                ('damping P', 'P', fit.damping, exact.damping_std, fit.damping_std))
    columns = 3 if fit.from_given is not None else 2
    for title, name, *of_name in matrices:
        rows: list[tuple[str, ...]] = [('axis', title, 'incl. given quantities')]
        for axes in structure.tied_axes:
            value, error, both = (M[axes[0], axes[0]] for M in of_name)
            translation, _, rotation = UNITS[name]
            unit = rotation if axes[0] > 2 else translation
            rows.append((', '.join(AXES[axis] for axis in axes), with_error(value, error, unit),
                         _percent(both / abs(value))))
        out.table([row[:columns] for row in rows])
    if columns > 2:
        out.paragraph(TWO_ERRORS)
    out.paragraph(*(law_sentence(term, fit.law[name], fit.law_std[name])
                    for name, term in LAW.items() if any(fit.law[name])))
    if structure.couples:
        for _, name, matrix, _, std in matrices:
            numbers = np.where(np.isinf(std), np.nan, matrix)
            entries = [[formatted(x, '.4g') for x in row] for row in numbers.tolist()]
            out.table([('', *AXES), *((axis, *row) for axis, row in zip(
                AXES, entries, strict=True))], right=True,
                title='{} in {}, {} and {}:'.format(name, *UNITS[name]))


def _percent(part: float) -> str:
    """Return a relative standard error in percent to two digits, '' for an infinite one."""
    return f'± {float(f"{100.0 * part:.2g}"):g} %' if math.isfinite(part) else ''


def law_sentence(term: Term, numbers: Sequence[float], std: Sequence[float]) -> str:
    """Return the effect of a term of the law, and its numbers with standard errors."""
    effect, first = term.effect, numbers[0]
    if term.by_sign and abs(first) > CHANCE * std[0]:
        effect = term.by_sign[0 if first > 0.0 else 1]
    listed_numbers = ', '.join(
        f'{symbol} = {with_error(value, error, unit)}'
        for symbol, value, error, unit in zip(term.symbols, numbers, std, term.units, strict=True))
    return f'{effect}: {listed_numbers}.'


def print_replay(result: 'Replay', out: Any) -> None:
    """Print the errors per axis and their meaning."""
    rest = result.validation.runs[0].start == 'equilibrium'
    out.line(f'Replay of {result.bag}', 'bold')
    out.paragraph(
        '(package relative to the tool, predicted minus measured; from '
        f'{"static equilibrium" if rest else "the measured state"})', style='dim')
    out.table(_error_rows(result), right=True)
    out.paragraph(LEGEND, style='dim')
    out.line()
    validation, offset = result.validation, result.recording.report.time_offset
    sentences = [text_of(validation.verdict(result.largest_nrmse)),
                 f'{validation.scores.samples} samples compared.']
    if result.margin:
        sentences.append(text_of(result.margin.finding))
    out.paragraph(*sentences, *map(text_of, offset_findings([(result.bag, offset)])))
    if result.live:
        counts = ', '.join(f'{count} {name}' for name, count in result.live.counts.items())
        out.paragraph(
            f'Live, from the messages as they came: {counts}; '
            f'{result.live.real_time_factor:.0f} times faster than real time.')
    if result.observed:
        _print_observed(result.observed, out)
    out.warn(*result.warnings)


def _print_observed(observed: 'Observed', out: Any) -> None:
    """Print the gain by measured poses, and alarms; with a tag by its corners."""
    if corners := observed.corners.values():
        unit, factor = corner_unit(*corners)
        rms = [each and each.rms for each in corners]
        chi2 = [each and each.chi2 for each in corners]
        rows = [('axis', *observed.corners),
                (f'corners {unit}', *(formatted(each, factor=factor) for each in rms)),
                ('corners chi2', *map(formatted, chi2))]
    else:
        errors = [column((DISPLAY_FACTORS * estimate.scores.rms).tolist())
                  for estimate in observed.estimates.values()]
        rows = [('axis', *observed.estimates)]
        rows += [(f'{name:2} {unit}', *by_estimate) for name, unit, *by_estimate in zip(
            AXES, DISPLAY_UNITS, *errors, strict=True)]
    out.table(rows, right=True, title=f'With {observed.topic}, RMS error')
    out.paragraph(' '.join(map(text_of, observed.findings)))
    for line in observed.alarm_lines:
        out.warn(f'Alarm at {line}')


def corner_unit(*scores: 'CornerScores | None') -> tuple[str, float]:
    """Return unit and factor of errors of corners (rad): pixels if the focal length is known."""
    focal = max((each.focal for each in scores if each), default=0.0)
    return ('px', focal) if focal else ('mrad', 1e3)


def _error_rows(result: 'Replay') -> list[tuple[str, ...]]:
    """Return a row for each axis: errors, and the part due to noise."""
    validation, live = result.validation, result.live
    rows: list[tuple[str, ...]] = [('axis', 'RMS', 'live', 'noise', 'peak', 'NRMSE')]
    if corners := validation.corners:
        live_rms = live.corners.rms if live and live.corners else None
        unit, factor = corner_unit(corners)
        errors = [formatted(error, factor=factor) for error in (
            corners.rms, live_rms, corners.noise, corners.largest)]
        return [*rows, (f'corners {unit}', *errors, formatted(corners.nrmse, '.1f', '%', 100.0))]
    scores = validation.scores
    rms, noise, largest = (column((DISPLAY_FACTORS * error).tolist())
                           for error in (scores.rms, validation.noise, scores.largest))
    live_errors = ['-'] * 6
    if live:
        live_errors = column((DISPLAY_FACTORS * live.scores.rms).tolist())
    for i, name in enumerate(AXES):
        mark = ' ' if validation.moves[i] else '*'
        rows.append((f'{name:2} {DISPLAY_UNITS[i]}', rms[i], live_errors[i], noise[i], largest[i],
                     formatted(scores.nrmse[i], '.1f', '%', 100.0) + mark))
    return rows
