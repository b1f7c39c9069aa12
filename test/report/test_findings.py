"""The table of findings: every fact makes its sentences, whatever its numbers are."""

import re
from string import Formatter

from bellows_ros.core.findings import Finding, Level
from bellows_ros.report.findings import entry, facts, prevents, text, warnings
from bellows_ros.report.sentences import SENTENCE_UNITS
import pytest


def fields(fact):
    """Return the fields of a fact with their formats."""
    return {field.partition('[')[0]: form or '' for part in ('what', 'do')
            for _, field, form, _ in Formatter().parse(fact.get(part, '')) if field}


@pytest.mark.parametrize('code', facts())
def test_a_fact_makes_sentences(code):
    """Know its keys, parameters and units; print numbers, names, and none."""
    fact = facts()[code]
    assert fact['what'].endswith(('.', '}')) and fact.get('prevents', 'fit') in ('fit', 'replay')
    assert set(fact) <= {'what', 'do', 'prevents'}
    for value in (0.5, None):
        numbers = {}
        for name, form in fields(fact).items():
            unit = form.rpartition(' ')[2]
            is_count = form.startswith('# ')
            assert is_count or unit in SENTENCE_UNITS or not unit or unit[-1] in 'defg%', form
            numbers[name] = 1 if is_count or form.endswith('d') else value if form else 'name'
        topic = numbers.pop('topic', '')
        made = text(Finding(code, Level.WARN, numbers, topic))
        assert made and '{' not in made


def test_a_finding_is_rendered():
    """As sentences, as an entry of JSON, and by the use that it prevents."""
    finding = Finding('no_factor')
    assert text(finding).startswith('Without cup.lip_radius') and 'Set cup' in text(finding)
    assert entry(finding)['sets'] == ['cup.lip_radius', 'vacuum.holding']
    assert warnings([finding, Finding('no_factor', Level.OK)]) == (text(finding),)
    assert not prevents(finding, 'fit')


def test_every_code_has_its_sentence_and_is_used(root):
    source = ''.join(path.read_text() for path in (root / 'bellows_ros').rglob('*.py'))
    assert set(re.findall(r"(?:Finding|fact)\(\s*'(\w+)'", source)) <= set(facts())
    made = re.findall(r"f'([a-z]+_)\{", source)  # of a prefix, as in alarm_lost
    assert [code for code in facts() if f"'{code}'" not in source
            and not code.startswith(tuple(made))] == []
