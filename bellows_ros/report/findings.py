"""Renderers of findings: sentences for the terminal and pages, an entry for JSON files."""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
import re
import tomllib
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.report.sentences import formatted

OPTIONAL = ('cause', 'errors', 'given', 'share')
"""Numbers of findings that may be absent."""


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
