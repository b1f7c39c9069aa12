"""
Sentences of findings, warnings, verdicts and alarms: made of a code and of numbers in SI units.

`texts/ROOM.toml` holds the sentences of a room by code. A sentence is a format string; a format
may end with a unit of `SENTENCE_UNITS`, which follows the number, or with `# noun` for a count:

    shift = "Topic '{topic}' jumps by {shift:.1f mm} and {rotation:.2g deg}, {count:# time}."

with shift in m and rotation in rad. Values that are text pass `errors.shown`; lists become
'a, b and c'; None and numbers that are not finite become '-'.
"""

from collections.abc import Mapping, Sequence
from functools import cache
import math
from pathlib import Path
from string import Formatter
import tomllib
from typing import Any, TYPE_CHECKING

from bellows_ros.core.model.validity_range import PEAK_MOMENT_BENDING, TYPICAL_BENDING
from bellows_ros.errors import shown

if TYPE_CHECKING:
    from bellows_ros.core.observer.alarms import Alarm, Sizes

TEXTS = Path(__file__).with_name('texts')

SENTENCE_UNITS: Mapping[str, tuple[float, str]] = {
    'mm': (1e3, 'mm'), 'um': (1e6, 'um'), 'mm/s': (1e3, 'mm/s'), 'ms': (1e3, 'ms'),
    'us': (1e6, 'us'), 'g': (1e3, 'g'), '%': (1e2, '%'),
    'deg': (math.degrees(1.0), 'degrees'), 'deg/s': (math.degrees(1.0), 'degrees/s')}
"""Units of sentences: their number in one SI unit, and their name in a sentence."""

MAX_LISTED = 5
"""Number of items of a list that a sentence names."""

MAX_TEXT = 200
"""Length of a text within a sentence, characters."""


def sentence(room: str, code: str, **numbers: Any) -> str:
    """
    Return the sentence of a code.

    Parameters
    ----------
    room : str
        Name of a file in `texts/`.
    code : str
        Key in the file; of a table in it `table.key`.
    **numbers : float, str, sequence or None
        Values of the sentence's fields, in SI units.

    Raises
    ------
    KeyError
        If the code or a field is unknown.

    """
    return _Sentence().vformat(texts(room)[code], (), numbers)


def flip_warning(angle: float, code: str = 'flips', begin: float = 0.0) -> str:
    """Return the warning on a cup that bends by an angle (rad), '' where that is allowed."""
    return '' if angle <= PEAK_MOMENT_BENDING else sentence(
        'planning', code, angle=angle, limit=PEAK_MOMENT_BENDING, typical=TYPICAL_BENDING,
        begin=begin)


def listed(items: Sequence[str]) -> str:
    """Return items as in a sentence; of many the first ones and the number of the others."""
    if len(items) > MAX_LISTED:
        return f'{", ".join(items[:MAX_LISTED])} and {len(items) - MAX_LISTED} more'
    return ' and '.join(filter(None, [', '.join(items[:-1]), items[-1]]))


def many(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f'{count} {noun}{"" if count == 1 else "s"}'


@cache
def texts(room: str) -> Mapping[str, str]:
    """Return the sentences of a room by code."""
    return dict(_flat('', tomllib.loads((TEXTS / f'{room}.toml').read_text(encoding='utf-8'))))


def _flat(inside: str, table: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [entry for key, value in table.items() for entry in (
        _flat(f'{inside}{key}.', value) if isinstance(value, dict)
        else [(f'{inside}{key}', value)])]


class _Sentence(Formatter):
    """Formats numbers with units, counts with nouns, lists, and foreign text."""

    def format_field(self, value: Any, format_spec: str) -> str:
        form, _, unit = format_spec.rpartition(' ')
        if form.endswith('#'):
            return many(value, unit)
        if format_spec in SENTENCE_UNITS:
            form, unit = '.3g', format_spec
        elif unit not in SENTENCE_UNITS:
            form, unit = format_spec, ''
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return '-'
        if isinstance(value, str):
            return f'{shown(value, MAX_TEXT):{form}}'
        if isinstance(value, list | tuple):
            return listed([self.format_field(item, format_spec) for item in value])
        factor, name = SENTENCE_UNITS.get(unit, (1, ''))
        return f'{factor * value:{form}} {name}'.rstrip()


def alarm_sentence(alarm: 'Alarm') -> str:
    """Return the finding of an alarm, its second cause, and the way to decide between them."""
    parts = [_finding(alarm.cause, alarm.parts, alarm), sentence(
        'alarms', 'second', second=alarm.second, odds=max(alarm.odds, 1.0))]
    if alarm.second_parts:
        parts += [
            texts('alarms')['then'].format(
                finding=_finding(alarm.second, alarm.second_parts, alarm)),
            texts('alarms').get('_'.join(sorted((alarm.cause, alarm.second))), '')]
    return ' '.join(filter(None, parts))


def _finding(cause: str, parts: 'Sizes', alarm: 'Alarm') -> str:
    sizes = dict(zip(('a', 'a_std', 'b', 'b_std'), (x for part in parts for x in part),
                     strict=False)) or {'a': alarm.size, 'a_std': alarm.std}
    code = cause.split()[0] + ('_both' if len(parts) > 1 else '') + (
        '_by_vacuum' if alarm.shown_by == 'vacuum' else '')
    x, y = alarm.place
    return sentence('alarms', code, cup=alarm.cup, x=x, y=y, **sizes)
