"""`bellows plan`: figures, picture and recording of a plan, and bad ones refused."""

import json

from bellows_ros.files.bags import topics

from .conftest import contents

GRIP = ('--set', 'cup.lip_radius=0.025', '--set', 'vacuum.holding=60000',
        '--set', 'package.mass_std=0.01')


def test_says_writes_and_draws(bellows, succeed, workshop, transport, tmp_path):
    """Say in words what stands in the JSON; write picture and recording."""
    done = succeed(
        'plan', transport, '--params', workshop / 'cup.yaml', *GRIP, '--fastest', '--json',
        'plan.json', '--plot', 'plan.png', '--out', 'predicted', cwd=tmp_path)
    found = json.loads((tmp_path / 'plan.json').read_text())
    for name in ('smallest_safety_factor', 'peak_bending', 'peak_deflection', 'peak_force',
                 'peak_moment', 'rigid_peak_moment', 'swing_left', 'settled_after', 'duration',
                 'smallest_safety_time', 'fastest_scale'):
        assert found[name] > 0.0 and found[f'{name}_std'] >= 0.0, name
    assert found['smallest_safety_mode'] == 'peel' and found['outside_validity'] == []
    assert f'{found["smallest_safety_factor"]:.2f}' in done.stdout
    assert 'shortest safe time' in done.stdout and 'Wrote predicted.' in done.stdout
    assert (tmp_path / 'plan.png').read_bytes().startswith(b'\x89PNG')
    assert {t.name for t in topics(tmp_path / 'predicted')} >= {
        '/tool_arm/plan', '/package/plan', '/package/plan_path', '/package/pose'}
    before = contents(tmp_path)
    done = bellows('plan', transport, '--params', workshop / 'cup.yaml', '--out', 'predicted',
                   '--json', 'other.json', cwd=tmp_path)
    assert done.returncode == 2 and '--force' in done.stderr
    assert contents(tmp_path) == before


def test_a_cup_that_lets_go_is_a_no(bellows, workshop, transport):
    """End with 1; never say that the grip holds where the data are doubtful."""
    line = ('plan', transport, '--params', workshop / 'cup.yaml', '--set', 'cup.lip_radius=0.03')
    weak = bellows(*line, '--set', 'vacuum.holding=15000')
    assert weak.returncode == 1 and 'lets go' in ' '.join(weak.stderr.split())
    above = bellows(*line, '--set', 'vacuum.holding=60000', '--set', 'package.com=0,0,0.03')
    assert 'above the lip' in ' '.join(above.stderr.split())
    assert 'The grip holds' not in above.stdout
