"""
Sentences from format strings and numbers in SI units.

A format may end with a unit of `SENTENCE_UNITS`, which is printed after the number, or with
`# noun` for a count:

    shift = "Topic '{topic}' jumps by {shift:.1f mm} and {rotation:.2g deg}, {count:# time}."

with shift in m and rotation in rad. Texts among the values are escaped by `errors.shown`; lists
become 'a, b and c'; None and numbers that are not finite become '-'.
"""

from collections.abc import Mapping, Sequence
import math
from string import Formatter
from typing import Any

from bellows_ros.errors import shown

SENTENCE_UNITS: Mapping[str, tuple[float, str]] = {
    'mm': (1e3, 'mm'), 'um': (1e6, 'um'), 'mm/s': (1e3, 'mm/s'), 'ms': (1e3, 'ms'),
    'us': (1e6, 'us'), '%': (1e2, '%'), 'ppm': (1e6, 'ppm'), 'mrad': (1e3, 'mrad'),
    'deg': (math.degrees(1.0), 'degrees'), 'deg/s': (math.degrees(1.0), 'degrees/s')}
"""Units in sentences: their number in one SI unit, and their printed name."""

MAX_LISTED = 5
"""Largest number of list items named in a sentence."""

MAX_TEXT = 200
"""Longest text within a sentence, characters."""


def formatted(text: str, /, **numbers: Any) -> str:
    """Return a text with its fields, values in SI units, filled in."""
    return _Sentence().vformat(text, (), numbers)


def listed(items: Sequence[str]) -> str:
    """Return a list in words: of a long list the first items, and the number of further items."""
    if len(items) > MAX_LISTED:
        return f'{", ".join(items[:MAX_LISTED])} and {len(items) - MAX_LISTED} more'
    return ' and '.join(filter(None, [', '.join(items[:-1]), items[-1]]))


def many(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f'{count} {noun}{"" if count == 1 else "s"}'


class _Sentence(Formatter):
    """Formatter of numbers with units, counts with nouns, lists, and foreign text."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a number with its unit, a count with its noun, or a list, as the format asks."""
        if format_spec.startswith('# '):
            return many(value, format_spec[2:])
        form, _, unit = format_spec.rpartition(' ')
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
