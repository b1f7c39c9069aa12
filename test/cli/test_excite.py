"""`bellows excite`: a motion in several forms, and what to expect of it; bad input refused."""

import json

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.plans import plans_in
import numpy as np
import pytest
from ruamel.yaml import YAML

from .conftest import write_yaml
from ..conftest import ROOT

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: a design takes minutes interpreted')

LIMITS = YAML(typ='safe').load((ROOT / 'config' / 'limits_example.yaml').read_text())


@pytest.fixture(scope='module')
def limits(tmp_path_factory):
    """Give limits under which a short motion is designed soon."""
    return write_yaml(
        tmp_path_factory.mktemp('limits') / 'arm.yaml', {**LIMITS, 'highest_frequency': 3.0})


def test_designs_and_writes(succeed, workshop, limits, tmp_path):
    """Write the same motion as plan, text and program, with what to expect of it, and a hold."""
    done = succeed(
        'excite', '--params', workshop / 'cup.yaml', '--limits', limits, '--time', '6', '--out',
        'motion', '--csv', 'm.csv', '--urscript', 'm.script', '--plot', 'm.png', '--json',
        'm.json', '--beside', ROOT / 'bags' / 'identification.yaml', cwd=tmp_path)
    found = json.loads((tmp_path / 'm.json').read_text())
    assert [e['name'] for e in found['entries']] == [
        'K x', 'K z', 'K rx', 'K rz', 'P x', 'P z', 'P rx', 'P rz']
    for entry in found['entries']:
        (other,) = entry['beside'].values()
        assert 0.0 < entry['expected_std'] < other
    assert max(found['parts_of_limits'].values()) <= 1.0
    assert 'K rz' in done.stdout and 'times' in done.stdout and 'Wrote m.script.' in done.stdout
    (_, plan), = plans_in(tmp_path / 'motion')
    rows = np.loadtxt(tmp_path / 'm.csv', delimiter=',', skiprows=1)
    assert len(plan.times_ns) == 15001 and np.abs(rows[:, 0] - 1e-9 * plan.times_ns).max() < 1e-9
    assert np.abs(rows[:, 1:8] - plan.poses).max() < 1e-8
    assert np.abs(rows[:, 8:] - plan.twists).max() < 1e-6
    program = (tmp_path / 'm.script').read_text()
    before, confirmed, moves = program.partition('blocking=True)\n')
    assert 'popup(' in before and confirmed and moves.lstrip().startswith('movej(')
    assert 'movej' not in before and '  to(p[' not in before
    lines = [x for x in moves.splitlines() if '  to(p[' in x]
    row = [float(x) for x in lines[500].split('[')[1].rstrip('])').split(',')]
    assert len(lines) == 1876 and np.abs(np.array(row[:3]) - plan.poses[4000, :3]).max() < 1e-6
    assert (tmp_path / 'm.png').read_bytes().startswith(b'\x89PNG')
    again = succeed('plan', 'motion', '--params', workshop / 'cup.yaml', cwd=tmp_path)
    assert 'residual swing' in again.stdout
