"""
Renderers of findings: sentences for the terminal and pages, an entry for JSON files.

A sentence is a format string with numbers in SI units. A format may end with a unit of
`SENTENCE_UNITS`, which is printed after the number, or with `# noun` for a count:

    shift = "Topic '{topic}' jumps by {shift:.1f mm} and {rotation:.2g deg}, {count:# time}."

with shift in m and rotation in rad. Texts among the values are escaped by `errors.shown`; lists
become 'a, b and c'; None and numbers that are not finite become '-'.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
import math
from pathlib import Path
import re
from string import Formatter
import tomllib
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.errors import shown

OPTIONAL = ('cause', 'errors', 'given', 'share')
"""Numbers of findings that may be absent."""

SENTENCE_UNITS: Mapping[str, tuple[float, str]] = {
    'mm': (1e3, 'mm'), 'um': (1e6, 'um'), 'mm/s': (1e3, 'mm/s'), 'ms': (1e3, 'ms'),
    'us': (1e6, 'us'), '%': (1e2, '%'), 'ppm': (1e6, 'ppm'), 'mrad': (1e3, 'mrad'),
    'deg': (math.degrees(1.0), 'degrees'), 'deg/s': (math.degrees(1.0), 'degrees/s')}
"""Units in sentences: their number in one SI unit, and their printed name."""

MAX_LISTED = 5
"""Largest number of list items named in a sentence."""

MAX_TEXT = 200
"""Longest text within a sentence, characters."""


@cache
def facts() -> Mapping[str, Mapping[str, Any]]:
    """Return the entries of `findings.toml` by code."""
    return tomllib.loads(Path(__file__).with_name('findings.toml').read_text(encoding='utf-8'))


def text(finding: Finding) -> str:
    """Return a finding as sentences: the fact, and of one that needs attention the remedy."""
    fact = facts()[finding.code]
    parts = ('what', 'do') if finding.level > Level.OK else ('what',)
    return ' '.join(_sentence(finding, part) for part in parts if part in fact)


def _sentence(finding: Finding, part: str) -> str:
    """Return a part of a fact, '' for none, with the numbers of the finding; some are optional."""
    in_words = {name: words(finding.numbers[name]) for name, words in OTHER_FINDINGS.items()
                if name in finding.numbers}
    return formatted(facts()[finding.code].get(part, ''), **{
        **dict.fromkeys(OPTIONAL, ''), 'topic': finding.topic, **finding.numbers, **in_words})


def _numbered(causes: Iterable[Finding]) -> str:
    """Return the numbered sentences of other findings."""
    return ' '.join(f'{number}. {text(each)}' for number, each in enumerate(causes, 1))


def _corrected(causes: Iterable[Finding]) -> str:
    """Return the parameters that correct other findings; without any, the recording."""
    return ' or '.join(name for each in causes for name in sets(each)) or 'the recording'


OTHER_FINDINGS: Mapping[str, Callable[[Iterable[Finding]], str]] = {
    'causes': _numbered, 'corrected': _corrected}
"""Words for the numbers of findings that are other findings."""


def warnings(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentences of findings that need attention."""
    return tuple(text(finding) for finding in findings if finding.level > Level.OK)


def prevents(finding: Finding, use: str) -> bool:
    """Return whether a finding prevents a use of a recording, 'fit' or 'replay'."""
    return finding.level == Level.ERROR and (
        facts()[finding.code].get('prevents') in ('replay', use))


def sets(finding: Finding) -> list[str]:
    """Return the parameters that the remedy of a finding names."""
    named = re.findall(r'[a-z_]+(?:\.[a-z_]+)+', _sentence(finding, 'do'))
    return [name for name in dict.fromkeys(named) if name in PARAMETERS]


def entry(finding: Finding) -> dict[str, Any]:
    """Return a finding for a JSON file, with its sentences and the parameters that it sets."""
    return {'code': finding.code, 'level': finding.level.name, 'topic': finding.topic,
            'numbers': dict(finding.numbers), 'sets': sets(finding),
            'text': text(finding)}


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
