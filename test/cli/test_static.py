"""`bellows static`: standstills go in, a length and verdicts come out."""

import json

from bellows_ros.files.parameter_files import read_parameters

from .conftest import TRUTH, write_yaml

STATIC = {
    'kind': 'static', 'rest_duration': 1.5,
    'static': {'move': 0.5, 'hold': 3.0, 'poses': [{'rpy': [0.3, 0.0, 0.0]}]},
    'tool': {'rate_hz': 100.0, 'noise': {'position': 2e-5, 'rotation': 5e-5}},
    'package': {'rate_hz': 100.0, 'noise': {'position': 5e-5, 'rotation': 2e-4}},
}


def test_length_and_spring_in_words_and_files(bellows, workshop, tmp_path):
    """Print both, and write the length and all figures, of recordings of several masses."""
    bags, masses = [], []
    for number, mass in enumerate((0.6, 1.2, 1.8, 2.4)):
        motion = write_yaml(tmp_path / 'motion.yaml', {**STATIC, 'seed': number})
        bags.append(tmp_path / f'm{number}')
        masses += ['--mass', mass]
        done = bellows(
            'simulate', '--params', workshop / 'cup.yaml', '--set', f'package.mass={mass}',
            '--motion', motion, '--out', bags[-1])
        assert done.returncode == 0, done.stderr
    done = bellows(
        'static', *bags, *masses, '--params', workshop / 'cup.yaml',
        '--out', tmp_path / 'l0.yaml', '--json', tmp_path / 'static.json')
    assert done.returncode == 0, done.stderr
    assert 'With 4 different masses' in done.stderr  # and nothing else
    assert done.stderr.count('Warning') == 1
    for words in ('Standstills', '0.6 kg', 'verdict', 'Nominal length', 'l0 ',
                  'Axial stiffness', 'The spring holds in all 8 poses.',
                  f'Wrote {tmp_path / "l0.yaml"}', f'Wrote {tmp_path / "static.json"}'):
        assert words in done.stdout
    assert max(map(len, done.stdout.splitlines())) < 110
    found = read_parameters(tmp_path / 'l0.yaml')['cup.length']
    assert abs(found - TRUTH['cup.length']) < 1e-4
    assert json.loads((tmp_path / 'static.json').read_text())['spring']['passed'] is True
