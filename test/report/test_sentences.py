"""Sentences of findings with numbers and units, and foreign text shown safely."""

from dataclasses import replace
import os
import re
from string import Formatter

from bellows_ros import plots
from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.model.cup_package import Cup, TERMS
from bellows_ros.errors import shown
from bellows_ros.report.findings import (
    entry,
    facts,
    formatted,
    MAX_TEXT,
    OTHER_FINDINGS,
    prevents,
    SENTENCE_UNITS,
    text,
    warnings,
)
from bellows_ros.report.text import law_sentence
import numpy as np
import pytest

from ..cli.conftest import bellows  # noqa: F401 (a fixture)
from ..core import oracle
from ..files.recordings import EPOCH_NS, message, POSE, TYPES, write


@pytest.mark.parametrize('template, number, expected', [
    ('{x:.1f mm}', 0.0123, '12.3 mm'), ('{x:mm}', 1.23456, '1.23e+03 mm'),
    ('{x:.0f deg}', np.pi, '180 degrees'), ('{x:.0f %}', 0.256, '26 %'),
    ('{x:# pose}', 1, '1 pose'), ('{x:# measured pose}', 20, '20 measured poses'),
    ('{x:.2f} kg', 1.8, '1.80 kg'), ('{x} Hz', 30, '30 Hz'),
    ('{x:.1f mm}', None, '-'), ('{x:.1f mm}', np.inf, '-'), ('{x:.1f}', float('nan'), '-'),
    ('{x:.0f mm}', [0.001, 0.002, 0.003], '1 mm, 2 mm and 3 mm'),
    ('{x}', ('K z', 'K x'), 'K z and K x'), ('{x}', list('abcdefgh'), 'a, b, c, d, e and 3 more'),
])
def test_a_number_is_shown_in_the_unit_of_its_sentence(template, number, expected):
    """Take SI units."""
    assert formatted(template, x=number) == expected


@pytest.mark.parametrize('a, std, named', [
    (2e4, 300.0, 'compression than in tension'), (-2e4, 300.0, 'tension than in compression'),
    (2e4, 1e4, 'changes as its length does')])
def test_the_side_on_which_a_cup_is_stiffer_is_the_side_of_its_energy(a, std, named):
    """Compare the curvature of a second implementation's energy in compression and tension."""
    sentence = law_sentence(TERMS['stretch'], (a, -5.0), (std, 0.1))
    assert f'{named}: a = ' in sentence and 'N/m^2, b = -5.00 ± 0.10 N' in sentence
    cup, poses = replace(Cup.thesis(), stretch=(a, -5.0)), np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = 1e-3 * np.arange(-2.0, 3.0)  # the lip towards the arm
    energy = np.array([oracle.potential(cup, H) for H in poses])
    tension, _, compression = np.diff(energy, n=2)
    if 'than' in named:
        stiffer = 'compression' if compression > tension else 'tension'
        assert named.startswith(stiffer)


@pytest.mark.parametrize('text', [
    '\x1b]0;title\x07', 'a\nb', 'a\tb', '\x00', '\u202egnp.exe', '\ud800', '\x9b31m', '\u2028'])
def test_shown_text_is_one_printable_line(text):
    """Keep what it says recognisable."""
    safe = shown(text)
    assert safe.isprintable() and safe.encode()
    assert shown(text, allowed=text) == text
    assert shown('a' * 81) == 'a' * 77 + '...' and shown('a' * 80) == 'a' * 80
    assert formatted("'{x}' is lost.", x='\x1b[2J\n\udce9') == "'\\x1b[2J\\n\\udce9' is lost."
    assert len(formatted('{name}', name='a' * 10_000)) == MAX_TEXT


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
        numbers |= {name: (Finding('tool_z'),) for name in OTHER_FINDINGS.keys() & numbers.keys()}
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


HOSTILE = '\x1b]0;owned\x07\x1b[2J\n\u202e$\\\\frac{' + 'a' * 200_000


def test_frames_and_topics_of_a_recording(bellows, tmp_path):  # noqa: F811
    """In frame_id of messages, and in the name of a topic."""
    bad = HOSTILE[:2000]
    rows = [(int(t), bytes(TYPES.serialize_cdr(message(
        POSE, t, pose=np.array([0, 0, 1, 0, 0, 0, 1.0]), frame_id=bad), POSE)))
        for t in EPOCH_NS + np.arange(50) * 10_000_000]
    write(tmp_path / 'bag', {('/tool', POSE): rows, (f'/x{bad[:100]}', POSE): rows})
    for command in ('info', 'plan', 'identify', 'replay'):
        done = bellows(command, 'bag', cwd=tmp_path)
        for said in (done.stdout, done.stderr):
            assert all(c.isprintable() or c == '\n' for c in said), repr(said[:300])
            assert 'Traceback' not in said and len(said) < 20_000


@pytest.mark.parametrize('note', ['run_$5_and_$6', '$\\frac{', os.fsdecode(b'caf\xe9'), HOSTILE])
def test_pictures(note, tmp_path):
    """In the conditions above the panels."""
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    with plots.picture('Title', note) as figure:
        plots.write_figure(tmp_path / 'a.png', figure)
        plots.svg_of(figure)
