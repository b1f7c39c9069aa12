"""`bellows static`: standstills go in, a length and verdicts come out."""

import json

from bellows_ros.files.parameter_files import read_parameters

from .conftest import TRUTH


def test_length_and_spring_in_words_and_files(succeed, workshop, weights, tmp_path):
    """Print both, and write the length and all figures, of recordings of several masses."""
    masses = [word for mass in weights.values() for word in ('--mass', mass)]
    done = succeed(
        'static', *weights, *masses, '--params', workshop / 'cup.yaml', '--set',
        'topics.tool_twist=', '--out', tmp_path / 'l0.yaml', '--json', tmp_path / 'static.json')
    assert done.stderr.count('Warning') == 1 and '3 different masses' in done.stderr
    for words in ('Standstills', '0.6 kg', 'verdict', 'l0 ', '9 poses',
                  f'Wrote {tmp_path / "l0.yaml"}', f'Wrote {tmp_path / "static.json"}'):
        assert words in done.stdout
    assert max(map(len, done.stdout.splitlines())) < 110
    found = read_parameters(tmp_path / 'l0.yaml')['cup.length']
    assert abs(found - TRUTH['cup.length']) < 1e-4
    assert json.loads((tmp_path / 'static.json').read_text())['spring']['passed'] is True
