"""`bellows steer`: motions without swing, within limits, and bad ones refused."""

import json

from bellows_ros.files.bags import topics
import pytest

STDS = ('--set', 'package.mass_std=0.01', '--set', 'package.com_std=0.001,0.001,0.001',
        '--set', 'cup.lip_radius=0.025', '--set', 'vacuum.holding=60000')


def test_steers_says_writes_and_draws(succeed, workshop, transport, tmp_path):
    """Leave no swing; say by how much the inverse is more sensitive, and which to take."""
    done = succeed(
        'steer', transport, '--method', 'inverse', '--params', workshop / 'cup.yaml', *STDS,
        '--json', 'steer.json', '--plot', 'steer.png', '--out', 'steered', cwd=tmp_path)
    found = json.loads((tmp_path / 'steer.json').read_text())
    planned, zvd = found['beside']['as planned'], found['beside']['zvd']
    assert found['swing_left'] < 1.7e-4 < zvd['swing_left'] < 0.1 * planned['swing_left']
    assert found['added_time'] == 0.0 < zvd['added_time']
    assert found['settled_after'] == 0.0 < planned['settled_after']
    assert 'settled' in done.stdout
    assert found['path_error'] < 0.05e-3
    assert zvd['expected_swing'] < found['expected_swing']
    said = ' '.join(done.stdout.split())
    assert 'the inverse is expected to leave' in said and 'ZVD' in said and 'Use zvd' in said
    assert 'smoothed over' in said
    assert (tmp_path / 'steer.png').read_bytes().startswith(b'\x89PNG')
    assert {t.name for t in topics(tmp_path / 'steered')} >= {'/tool_arm/plan', '/package/plan'}
    for command, topic, *method in (
            ('plan', '/tool_arm/plan'), ('steer', '/package/plan', '--method', 'inverse')):
        again = succeed(command, 'steered', '--topic', topic, *method, '--params',
                        workshop / 'cup.yaml', *STDS, '--json', '-', cwd=tmp_path)
        assert json.loads(again.stdout)['swing_left'] < 1.7e-4


def test_an_animation_shows_planned_and_steered(succeed, workshop, transport, tmp_path):
    """Twelve pictures a second, four times as slow as it is, until half a second after the end."""
    image = pytest.importorskip('PIL.Image', reason='Pillow comes with matplotlib')
    done = succeed('steer', transport, '--method', 'zv', '--params', workshop / 'cup.yaml',
                   '--plot', 'steer.gif', '--json', '-', cwd=tmp_path)
    with image.open(tmp_path / 'steer.gif') as picture:
        expected = 48.0 * (json.loads(done.stdout)['duration'] + 0.5)
        assert abs(picture.n_frames - expected) <= 1.0
