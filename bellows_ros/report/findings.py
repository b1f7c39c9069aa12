"""Renderers of findings: sentences for the terminal and pages, an entry for JSON files."""

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
import tomllib
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.report.sentences import formatted


@cache
def facts() -> Mapping[str, Mapping[str, Any]]:
    """Return the entries of `findings.toml` by code."""
    return tomllib.loads(Path(__file__).with_name('findings.toml').read_text(encoding='utf-8'))


def text(finding: Finding) -> str:
    """Return a finding as sentences: the fact, and of one that needs attention the remedy."""
    fact = facts()[finding.code]
    numbers = {'share': '', 'errors': '', 'topic': finding.topic, **finding.numbers}
    return ' '.join(
        formatted(fact[part], **numbers)
        for part in ('what', *['do'] * (finding.level > Level.OK)) if part in fact)


def warnings(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentences of findings that need attention."""
    return tuple(text(finding) for finding in findings if finding.level > Level.OK)


def prevents(finding: Finding, use: str) -> bool:
    """Return whether a finding prevents a use of a recording, 'fit' or 'replay'."""
    return finding.level == Level.ERROR and (
        facts()[finding.code].get('prevents') in ('replay', use))


def sets(finding: Finding) -> list[str]:
    """Return the parameters that correct a finding."""
    found: list[str] = facts()[finding.code].get('sets', [])
    return [name.format(topic=finding.topic) for name in found]


def entry(finding: Finding) -> dict[str, Any]:
    """Return a finding for a JSON file, with its sentences and the parameters that it sets."""
    return {'code': finding.code, 'level': finding.level.name, 'topic': finding.topic,
            'numbers': dict(finding.numbers), 'sets': sets(finding),
            'text': text(finding)}
