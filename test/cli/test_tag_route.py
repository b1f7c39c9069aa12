"""From a recording of a robot and a tag to the live node, by the printed commands."""

import shlex
import subprocess
import sys

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
def test_printed_commands_lead_from_a_recording_to_the_node(
        succeed, root, ros, user_environment, tmp_path):
    """Find two worlds, two clocks and a marker; use all of it in a replay, and over DDS."""
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import qos_profile_sensor_data

    from ..nodes.conftest import Peer

    bags = root / 'bags'
    done = succeed('info', bags / 'tag', '--write-params', 'my_cell.yaml', cwd=tmp_path)
    done = succeed('identify', '--params', bags / 'package.yaml', *printed(
        done, 'bellows identify'), '--json', 'fit.json', cwd=tmp_path)
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

    node = printed(done, 'ros2 run bellows_ros')
    running = subprocess.Popen(
        [sys.executable, '-m', 'bellows_ros.nodes.command', *node], cwd=tmp_path,
        env=user_environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        peer = Peer(ros)
        predictions = peer.hears(PoseStamped, 'package/pose', qos_profile_sensor_data)
        reports = peer.hears(DiagnosticArray, '/diagnostics')
        peer.connect()
        succeed('play', bags / 'tag_validation', '--topic', '/tcp_pose_broadcaster/pose',
                '--topic', '/camera/box', cwd=tmp_path)
        assert len(predictions) > 1000
        used = [int(each.value) for report in reports for status in report.status
                for each in status.values if each.key == 'used']
        assert max(used) > 200
    finally:
        running.kill()
        running.communicate()
