"""`bellows toss`: a plan goes in; landing, budget, picture and advice come out."""

import json
from pathlib import Path

from bellows_ros.files.bags import read_streams
import numpy as np
import pytest

BAGS = Path(__file__).parents[2] / 'bags'
PLAN, PARAMS = BAGS / 'throw.yaml', BAGS / 'tossing.yaml'


def test_toss_prints_landing_and_largest_contribution(succeed, tmp_path):
    """Give the names of the JSON, a picture, and the advice."""
    file, picture = tmp_path / 'toss.json', tmp_path / 'toss.png'
    done = succeed(
        'toss', PLAN, '--params', PARAMS, '--release', 3.0, '--json', file, '--plot', picture)
    found = json.loads(file.read_text())
    assert set(found) >= {
        'release_time', 'release_mode', 'release_pose', 'release_twist', 'landing_time',
        'landing_position', 'landing_rotation', 'landing_covariance', 'tumbling', 'budget',
        'drawn', 'failed', 'plan', 'version', 'provenance'}
    assert found['release_mode'] == 'peel'
    assert 3.012 < found['release_time'] < found['landing_time'] < 4.0
    assert set(found['budget'][0]) == {'name', 'std', 'contribution_mm', 'contribution_deg'}
    assert 'Reduce first: release,' in done.stdout
    assert picture.stat().st_size > 20_000


def test_writes_the_toss_as_a_recording(bellows, tmp_path):
    """Held, parting and flying: the package leaves the cup, and falls to where it lands."""
    bag = tmp_path / 'thrown'
    done = bellows('toss', PLAN, '--params', PARAMS, '--release', 3.0, '--out', bag, '--json', '-')
    found = json.loads(done.stdout)
    poses = read_streams(bag, {'package_pose': '/package/pose'})['package_pose']
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    assert seconds[-1] == pytest.approx(found['landing_time'], abs=2.1e-3)
    speed = np.linalg.norm(found['landing_twist'][:3])
    miss = np.linalg.norm(poses.position[-1] - found['landing_position'])
    assert miss < 2.1e-3 * speed
    at = np.searchsorted(seconds, found['release_time'])
    np.testing.assert_allclose(poses.position[at], found['release_pose'][:3], atol=6e-3)


def test_finds_the_time_for_a_target(bellows):
    """Land where a known time lands, and say what that gains over the time that is given."""
    known = json.loads(bellows(
        'toss', PLAN, '--params', PARAMS, '--release', 3.1, '--json', '-').stdout)
    x, y, _ = known['landing_position']
    done = bellows(
        'toss', PLAN, '--params', PARAMS, '--release', 3.0, '--target', x, y, '--json', '-',
        '--target-rotation', *known['landing_rotation'])
    found = json.loads(done.stdout)
    assert found['valve_time'] == pytest.approx(3.1, abs=1e-4)
    assert found['target']['distance'] < 1e-4 < found['target']['distance_as_asked']
    assert 'away, instead of' in done.stderr
    assert 'lands at the target' not in done.stderr
    far = bellows('toss', PLAN, '--params', PARAMS, '--target', 100.0, 0.0)
    assert far.returncode == 1
    assert 'No release of this plan lands at the target' in ' '.join(far.stderr.split())
