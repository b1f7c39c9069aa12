"""Report what differs between two fits, and whether it matters."""

import argparse
from collections.abc import Iterator
import math

from bellows_ros.core.identification.comparison import Change
from bellows_ros.errors import shown
from bellows_ros.report.sentences import listed
from bellows_ros.report.text import display_unit, formatted, with_error
from bellows_ros.workflows.compare import compare_files, ResultComparison

from .console import Console
from .options import Outcome

SETTING_WIDTH = 60  # characters of a setting


def run(arguments: argparse.Namespace, console: Console) -> Outcome:
    """Compare."""
    result = compare_files(arguments.before, arguments.after)
    return Outcome(result, not result.fits.matters)


def print_result(result: ResultComparison, console: Console) -> None:
    """Print the tables and the verdict."""
    console.line(f'{result.paths[0]} (A) and {result.paths[1]} (B)', 'bold')
    console.table(_change_rows(result.fits.parameters), title='Parameters')
    console.table(_change_rows(result.fits.effects),
                  title='Motion of the package of A on each cup')
    console.paragraph(*verdict(result))
    if result.settings:
        console.line()
        console.line('Made differently:')
        for difference in result.settings:
            values = ('-' if value is None else shown(value, SETTING_WIDTH)
                      for value in (difference.before, difference.after))
            console.paragraph(f'  {difference.name}: {" -> ".join(values)}')


def _change_rows(changes: tuple[Change, ...]) -> list[tuple[str, ...]]:
    """Return a row for each change: both values, the change, and it in standard errors."""
    rows: list[tuple[str, ...]] = [('', 'A', 'B', 'unit', 'change', 'std. errors')]
    for change in changes:
        scale, unit = display_unit(change.unit)
        rows.append((
            change.name,
            with_error(scale * change.before, scale * change.before_std),
            with_error(scale * change.after, scale * change.after_std), unit,
            formatted(change.percent, '+.2f', '%'),
            formatted(change.standard_errors, '+.1f') + ('*' if change.significant else ' ')))
    return rows


def verdict(result: ResultComparison) -> Iterator[str]:
    """Yield the changes and whether they matter, as sentences."""
    fits = result.fits
    if result.shared:
        yield (f'Both fits used {listed(list(result.shared))}: they are not independent, and the '
               'standard errors and probabilities do not apply.')
    chance = f'{fits.p_value:.2g}' if fits.p_value >= 1e-4 else 'below 1e-4'
    yield (f'The standard errors {"do not " if fits.significant else ""}explain the difference of '
           f'the parameters together (probability of chance {chance}).')
    if marked := [f'{change.name} ({change.percent:+.2g} %)'
                  for change in fits.parameters if change.significant]:
        yield f'* Significant difference: {listed(marked)}.'
    shift, angle = 1e3 * fits.shake_rms[:3].max(), math.degrees(fits.shake_rms[3:].max())
    yield (f'In a shake of 3 Hz (5 mm, 2.9 degrees) the predicted motions differ by {shift:.2g} '
           f'mm and {angle:.2g} degrees RMS.')
    if large := [e.name for e in fits.effects if e.matters and e.significant]:
        yield f'Large enough to matter: {listed(large)}.'
    if unsure := [e.name for e in fits.open_effects]:
        yield (f'Large enough to matter, but within the standard errors: {listed(unsure)}. Record '
               'a motion that excites these more.')
    if not fits.matters:
        yield ('No significant difference: the changes are within the standard errors, or too '
               'small to matter.')
    elif fits.shake_matters:
        yield 'The difference matters: do not exchange the two cups.'
    else:
        yield ('The difference matters for motions that excite the modes named above; the shake '
               'of 3 Hz would not show it.')
