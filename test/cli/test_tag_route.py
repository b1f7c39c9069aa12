"""From a recording of a robot and a tag to a replay, by the printed commands."""

import shlex

from bellows_ros.files.parameter_files import read_parameters
import numpy as np
import pytest

TRUE_K = {0: 5200.0, 14: 10400.0, 21: 3.6, 35: 1.2}
"""Stiffness (N/m, N m/rad) of the simulated cup, by places in cup.stiffness."""


def printed(done, first):
    """Return the words behind the first ones of the printed command that begins so."""
    (line,) = (line for line in done.stdout.splitlines() if line.startswith(f'  {first} '))
    return shlex.split(line)[len(first.split()):]


@pytest.mark.stress
def test_printed_commands_lead_from_a_recording_to_a_replay(succeed, root, tmp_path):
    """Find two worlds, two clocks and a marker; use all of it in a replay."""
    bags = root / 'bags'
    done = succeed('info', bags / 'tag', '--write-params', 'my_cell.yaml', cwd=tmp_path)
    done = succeed('identify', '--params', bags / 'package.yaml', *printed(
        done, 'bellows identify'), '--set', 'measured.tag_size=0.048', '--json', 'fit.json',
        cwd=tmp_path)
    cup, cell = (read_parameters(tmp_path / name) for name in ('cup.yaml', 'cell.yaml'))
    for place, true in TRUE_K.items():
        error = cup['cup.stiffness'][place] - true
        assert abs(error) < min(3.0 * cup['cup.stiffness_std'][place], 0.2 * true)
    assert cell['measured.latency'] == pytest.approx(0.040, abs=2e-3)
    offset = np.array(cell['measured.offset'])
    np.testing.assert_allclose(offset[:3], [0.1005, 0.012, -0.004], atol=5e-3)

    done_replay = succeed(
        'replay', bags / 'tag_validation', *printed(done, 'bellows replay BAG'), cwd=tmp_path)
    assert 'No alarm.' in done_replay.stdout
