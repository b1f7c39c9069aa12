"""The commands as a user types them: help, plain errors, an orderly end, a domain of their own."""

from itertools import count
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from bellows_ros.core.parameters.table import parameters_for
from bellows_ros.nodes import domain
from bellows_ros.nodes.command import help_text, interface
from bellows_ros.nodes.command import run as run_node
import pytest

from .conftest import GIVEN, MS, Peer, pose_at, START

NODES = ('predictor', 'identifier')
WITHOUT_ROS = """
import sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in ('rclpy', 'rcl_interfaces', 'geometry_msgs', 'std_srvs'):
            raise ModuleNotFoundError('no ROS here: ' + name)

sys.meta_path.insert(0, NoRos())
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == 'rclpy' else find(name, *rest)
from bellows_ros.nodes.command import run
sys.exit(run({name!r}, {arguments!r}))
"""


def run(environment, root, *command):
    """Run Python to its end."""
    return subprocess.run(
        [sys.executable, *command], env=environment, cwd=root, capture_output=True, text=True,
        timeout=600)


@pytest.mark.parametrize('name', NODES)
def test_help_shows_everything(name):
    """Name each topic, service and parameter, with unit."""
    text = help_text(name)
    unbroken = ' '.join(text.split())

    for topic in interface(name).get('topics', ()):
        assert '{name} [{type}]'.format(**topic) in unbroken
    for parameter in parameters_for(name):
        assert f'{parameter.name} [{parameter.constraint}; ' in unbroken
        assert parameter.description in unbroken
        assert parameter.unit in unbroken
    assert max(map(len, text.splitlines())) < 100


@pytest.mark.parametrize('name', NODES)
def test_help_needs_no_ros_and_missing_ros_is_reported(name, root, user_environment):
    """Answer from the table alone, or name the package to install, without a traceback."""
    done = run(user_environment, root, '-c', WITHOUT_ROS.format(name=name, arguments=['--help']))
    assert done.returncode == 0, done.stderr
    assert done.stdout == help_text(name)
    done = run(user_environment, root, '-c', WITHOUT_ROS.format(name=name, arguments=[]))
    assert done.returncode == 2
    assert "pip install 'ros-jazzy-rclpy[fastrtps]'" in done.stderr
    assert 'Traceback' not in done.stderr


def test_numpy_waits_for_the_limit_of_its_threads(user_environment, root):
    """Import the command without NumPy, which reads the number of threads once."""
    code = "import sys, bellows_ros.nodes.command; print('numpy' in sys.modules)"
    assert run(user_environment, root, '-c', code).stdout == 'False\n'


@pytest.mark.parametrize(('arguments', 'named'), [
    (['--ros-args'], 'package.mass'), (['--ros-args'], '--params-file FILE.'),
    (['--ros-args', *GIVEN, '-p', 'cup.stifness:=1.0'], "'cup.stiffness'"),
    (['--ros-args', *GIVEN, '-p', 'cup.stiffness:=[1.0, 2.0]'], 'got 2 of them'),
    (['--ros-args', *GIVEN, '-p', 'cup.length:=long'], 'cup.length'),
    (['--ros-args', '--params-file', 'nowhere.yaml'], 'nowhere.yaml'),
    (['--ros-args', '--params-file', 'typo.yaml'], '/predicter'),
    (['--ros-args', *GIVEN, '-p', 'use_sim_time:=hello'], 'use_sim_time'),
    (['a\x1b[31mb'], r"'a\x1b[31mb'"), (['package.yaml'], "'package.yaml'"),
])
def test_what_the_user_can_put_right_ends_with_2(arguments, named, tmp_path, monkeypatch, capfd):
    """Print what is wrong and no traceback."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    monkeypatch.chdir(tmp_path)
    Path('typo.yaml').write_text('/predicter: {ros__parameters: {package.mass: 1.0}}')
    assert run_node('predictor', arguments) == 2
    printed = capfd.readouterr().err
    assert named in printed and 'Traceback' not in printed


def test_a_defect_ends_with_70_and_asks_for_a_report(capfd):
    """Print the traceback; 1 means no."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    assert run_node('predictor', ['--ros-args', *GIVEN], 'operator:index') == 70
    printed = capfd.readouterr().err
    assert 'Traceback' in printed and 'predictor: This is a defect of bellows_ros' in printed


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_process_predicts_and_ends_in_order(number, run_predictor, ros):
    """Answer a pose over DDS; on Ctrl-C or SIGTERM say what came and went and end with 0."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import qos_profile_sensor_data

    running, peer = run_predictor(), Peer(ros)
    answers = peer.hears(PoseStamped, 'package/pose', qos_profile_sensor_data)
    writer = peer.writes(PoseStamped, 'tool_arm/pose', qos_profile_sensor_data)
    peer.connect()
    stamps = count(START, 20 * MS)
    peer.node.create_timer(0.02, lambda: writer.publish(pose_at(next(stamps))))
    assert ros.spin_until(lambda: len(answers) > 3)
    running.send_signal(number)
    _, log = running.communicate(timeout=200)

    assert running.returncode == 0, log
    assert 'Traceback' not in log and 'invalid' not in log
    assert ' predictions' in log and 'stamp' not in log


def test_process_ends_at_once_while_it_compiles(run_predictor, tmp_path):
    """End before the node is made, with 0 and without a word."""
    pytest.importorskip('numba', reason='nothing is compiled without numba')
    process = run_predictor(NUMBA_CACHE_DIR=str(tmp_path))
    until = time.monotonic() + 600.0
    while not any(tmp_path.rglob('*.nbi')) and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, log = process.communicate(timeout=200)
    compiled = len(list(tmp_path.rglob('*.nbi')))
    assert (process.returncode, out) == (0, '')
    assert 'Listens to' not in log and 'Traceback' not in log
    assert 0 < compiled < 40, 'it went on compiling'


SEEKER = """
import sys
from bellows_ros.nodes.domain import unused_domain
print(unused_domain(), flush=True)
sys.stdin.read()
"""


def test_seekers_at_the_same_time_find_different_domains():
    """Give each process one of its own before ROS runs in any."""
    seekers = [
        subprocess.Popen([sys.executable, '-c', SEEKER], stdin=subprocess.PIPE,
                         stdout=subprocess.PIPE, text=True)
        for _ in range(8)]
    found = [int(seeker.stdout.readline()) for seeker in seekers if seeker.stdout]
    for seeker in seekers:
        seeker.communicate()
    assert len(set(found)) == 8
    assert all(1 <= number <= domain.DOMAINS for number in found)


def test_what_reaches_other_machines_is_dropped(monkeypatch):
    """Keep discovery here, whatever the shell says."""
    for name in ('ROS_DOMAIN_ID', 'ROS_LOG_DIR', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
        monkeypatch.setenv(name, os.environ[name])  # put back afterwards
    monkeypatch.setenv('ROS_STATIC_PEERS', '192.0.2.1')
    domain.isolate('logs')
    assert 'ROS_STATIC_PEERS' not in os.environ
    assert os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert os.environ['ROS_LOG_DIR'] == 'logs'
