"""`bellows structures`: what recordings can tell, and which structure to take."""

import json


def test_summary_and_json(quietly, workshop, tmp_path):
    """Print tables and advice, and write all figures."""
    done = quietly(
        'structures', 'recording', '--params', 'package.yaml',
        '--json', tmp_path / 'structures.json',
        cwd=workshop)
    for words in ('Excitation of the lip', 'Identifiability', 'P rz', 'Hz',
                  'Structures', 'axisymmetric', 'diagonal', 'full', 'held-out error',
                  'Use fit.structure: axisymmetric.', 'Rank 8 of 8',
                  f'Wrote {tmp_path / "structures.json"}'):
        assert words in done.stdout
    assert 'nan' not in done.stdout and '\x1b' not in done.stdout
    content = json.loads((tmp_path / 'structures.json').read_text())
    assert content['structures']['advised'] == 'axisymmetric'
