"""The predictor that colcon installed, used as a user does: run, remap, stop."""

import importlib.util
import os
import shutil
import signal
import subprocess

import pytest

from ..nodes.conftest import MS, Peer, pose_at, START

pytestmark = [pytest.mark.lane, pytest.mark.xdist_group('installed')]


class User(Peer):
    """Starts the installed predictor and talks to it over DDS."""

    def __init__(self, ros, installed, file):
        """Join the graph."""
        super().__init__(ros, 'user')
        self._installed, self._file = installed, file
        self.process: subprocess.Popen[str] | None = None

    def start(self, *arguments):
        """Run the executable with the parameter file and more ROS arguments."""
        self._popen(
            self._installed.environment, self._installed.prefix / 'lib/bellows_ros/predictor',
            '--ros-args', '--params-file', self._file, *arguments)

    def _popen(self, environment, *command):
        """Start a process."""
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def launch(self, *arguments):
        """Start it as `ros2 launch` does, where that is installed."""
        if shutil.which('ros2') is None or importlib.util.find_spec('launch_ros') is None:
            pytest.skip('ROS 2 launch is not here: neither it nor ros2cli is among the wheels')
        environment = dict(self._installed.environment)
        for name in ('AMENT_PREFIX_PATH', 'PYTHONPATH'):  # ours before those of ROS
            environment[name] = os.pathsep.join(
                [environment[name], *filter(None, [os.environ.get(name)])])
        self._popen(environment, 'ros2', 'launch', 'bellows_ros', 'predictor.launch.py',
                    f'params_file:={self._file}', *arguments)

    def stop(self):
        """End it as Ctrl-C does, and return its log, which must be in order."""
        assert self.process is not None
        self.process.send_signal(signal.SIGINT)
        out, log = self.process.communicate(timeout=300)
        assert 'Traceback' not in out + log
        return out + log

    def predictions(self, tool, package, count=5):
        """Send poses until so many answers have come; the first may meet nobody yet."""
        from geometry_msgs.msg import PoseStamped

        answers, writer = self.hears(PoseStamped, package), self.writes(PoseStamped, tool)
        self.connect()
        for k in range(20 * count):
            if len(answers) >= count:
                break
            writer.publish(pose_at(START + k * 2 * MS, frame_id='base'))
            before = len(answers)
            self.ros.spin_until(lambda before=before: len(answers) > before, 1.0)
        return len(answers)


@pytest.fixture
def user(ros, installed, root):
    """Give a user, and end the process that is left."""
    user = User(ros, installed, root / 'bags' / 'package.yaml')
    yield user
    if user.process is not None:
        user.process.kill()
        user.process.communicate()


def test_run_with_namespace_and_remaps(user):
    """Predict in a cell's namespace from the driver's topic, and end with 0."""
    user.start('-r', '__ns:=/cell', '-r', 'tool_arm/pose:=/driver/pose', '-r', '__node:=left')
    assert user.predictions('/driver/pose', '/cell/package/pose') == 5
    assert ' predictions out, 0 refused' in user.stop()
    assert user.process.returncode == 0


def test_launch_file_starts_it(user):
    """Predict in a cell's namespace from the driver's topic, started by the launch file."""
    user.launch('namespace:=cell', 'tool_pose:=/driver/pose')
    assert user.predictions('/driver/pose', '/cell/package/pose') == 5
    user.stop()
