"""Unlikely numbers of package and cup: one question, by every command, once."""

import json
import re

from bellows_ros.core.parameters.checks import implausible, resolve
import pytest

from .conftest import ROOT, TRUTH, write_yaml

DOUBTFUL = {
    'package.com': ([0.0, 0.0, 0.03], 'Is it -0.03?'),
    'package.mass': (18.0, 'a ball of lead'),
    'package.inertia': ([438.0, 654.0, 984.0, 0.0, 0.0, 0.0], 'instead of kg m^2'),
    'cup.stiffness': ([(5.4, 5.4, 9.2, 4.2, 4.2, 1.35)[k // 7] if k % 7 == 0 else 0.0
                       for k in range(36)], 'Is it in N/mm?'),
    'cup.length': (0.46, 'cup.length is 0.46 m')}

COMMANDS = {
    'plan': ('plan', '{plan}'),
    'toss': ('toss', '{plan}', '--release', '0.2', '--set', 'package.size=[0.2,0.16,0.06]'),
    'steer': ('plan', '{plan}', '--steer', 'zvd'),
    'simulate': ('simulate', '--motion', '{plan}', '--out', '{out}'),
    'static': ('static', ROOT / 'bags' / 'static', '--mass', '1.8'),
    'replay': ('replay', '{recording}'),
    'identify': ('identify', '{recording}', '--from', '100')}

REFUSING = 'identify', 'replay'
"""Commands that refuse such a package before they make a cup."""


@pytest.mark.parametrize('name', DOUBTFUL)
def test_each_is_asked_about_by_its_name(name):
    value, asked = DOUBTFUL[name]
    assert not implausible(resolve(TRUTH))
    (doubt,) = implausible(resolve({**TRUTH, name: value}))
    assert name.split('.')[0] in doubt and asked in doubt


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_prints_a_question_once(command, bellows, workshop, transport, tmp_path):
    """Ask about a package and a cup at once, of sizes that still can be computed with."""
    odd = {name: DOUBTFUL[name][0] for name in ('package.com', 'cup.length')}
    cup = write_yaml(tmp_path / 'cup.yaml', {**TRUTH, **odd})
    words = [str(word).format(
        plan=transport, cup=cup, out=tmp_path / 'out', recording=workshop / 'recording')
        for word in COMMANDS[command]]
    words += ['--params', cup]
    if command == 'plan':
        words += ['--json', tmp_path / 'it.json']
    done = bellows(*words)
    said = re.sub(r'\s+', ' ', done.stderr)
    for name, value in list(odd.items())[:1 if command in REFUSING else 2]:
        (asked,) = implausible(resolve({**TRUTH, name: value}))
        assert said.count(f'Warning: {asked}') == 1
    if command == 'plan':
        warnings = json.loads((tmp_path / 'it.json').read_text())['warnings']
        assert sum(DOUBTFUL['package.com'][1] in text for text in warnings) == 1
