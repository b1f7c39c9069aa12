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

    def start(module, *words):
        return subprocess.Popen(
            [sys.executable, '-m', module, *words], cwd=tmp_path, env=user_environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    peer = Peer(ros)
    predictions = peer.hears(PoseStamped, 'package/pose', qos_profile_sensor_data)
    reports = peer.hears(DiagnosticArray, '/diagnostics')
    running = [start('bellows_ros.nodes.command', *printed(done, 'ros2 run bellows_ros'))]
    try:
        peer.connect()
        running.append(start(
            'bellows_ros.cli', 'play', str(bags / 'tag_validation'), '--topic',
            '/tcp_pose_broadcaster/pose', '--topic', '/camera/box'))
        peer.wait(lambda: len(predictions) > 300 and any(
            each.key == 'used' and int(each.value) > 50 for report in reports
            for status in report.status for each in status.values))
    finally:
        for process in running:
            process.kill()
            process.wait()
