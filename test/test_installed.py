"""The package as colcon installs it: its files, and the predictor used as a user does."""

from dataclasses import dataclass
import importlib.util
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys

from bellows_ros import __version__
import pytest

from .nodes.conftest import MS, Peer, pose_at, START

pytestmark = [pytest.mark.lane, pytest.mark.xdist_group('installed')]

PYTHON = f'python{sys.version_info[0]}.{sys.version_info[1]}'


@dataclass(frozen=True)
class Installed:
    """The folder of an installation by colcon, and the environment variables of a shell for it."""

    prefix: Path
    environment: dict[str, str]

    def run(self, *command):
        """Run a command as a user of the installed package would."""
        return subprocess.run(
            command, env=self.environment, cwd=self.prefix, capture_output=True, text=True,
            timeout=600)


@pytest.fixture(scope='module')
def installed(tmp_path_factory, copy_sources, user_environment):
    """Build a copy of the package once, with the colcon of this environment."""
    pytest.importorskip('colcon_ros', reason="no colcon-ros here (pip install '.[test]')")
    workspace = tmp_path_factory.mktemp('workspace')
    copy_sources(workspace / 'src' / 'bellows_ros')
    environment = {**user_environment, 'COLCON_HOME': str(workspace / 'colcon_home')}
    done = subprocess.run(
        [str(Path(sys.executable).with_name('colcon')), 'build'],
        cwd=workspace, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'Finished <<< bellows_ros' in done.stdout
    prefix = workspace / 'install' / 'bellows_ros'
    site_packages = prefix / 'lib' / PYTHON / 'site-packages'
    environment |= {
        'AMENT_PREFIX_PATH': str(prefix),
        'PYTHONPATH': str(site_packages),
    }
    return Installed(prefix, environment)


def test_python_finds_the_installed_package(installed):
    """Import what colcon installed, not the tree under test."""
    code = 'import bellows_ros as b; print(b.__file__, b.__version__)'
    file, version = installed.run(sys.executable, '-c', code).stdout.split()

    assert Path(file).is_relative_to(installed.prefix)
    assert version == __version__


def test_share_holds_manifest_launch_files_and_configuration(installed, root):
    """Find in share what ROS tools look for there."""
    share = installed.prefix / 'share' / 'bellows_ros'
    sources = [root / 'package.xml', *root.glob('launch/*.launch.py'), *root.glob('config/*.yaml')]

    for source in sources:
        assert (share / source.relative_to(root)).read_bytes() == source.read_bytes()
    assert len(list((share / 'launch').iterdir())) == 2
    assert list((share / 'config').iterdir())


def test_ament_index_knows_the_package(installed):
    """Resolve the package as `ros2 run`, `ros2 launch` and other packages do."""
    index = installed.prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    assert (index / 'bellows_ros').is_file()

    pytest.importorskip('ament_index_python', reason='comes with rclpy')
    code = 'from ament_index_python import packages as p; ' \
        "print(p.get_package_share_directory('bellows_ros'))"
    found = installed.run(sys.executable, '-c', code)
    assert Path(found.stdout.strip()) == installed.prefix / 'share' / 'bellows_ros', found.stderr


def test_executables_are_where_ros_looks_and_not_on_the_path(installed):
    """Install into lib/bellows_ros, as setup.cfg says, and nothing into bin."""
    names = {path.name for path in (installed.prefix / 'lib' / 'bellows_ros').iterdir()}
    assert names == {'predictor', 'identifier', 'bellows'}
    assert not (installed.prefix / 'bin').exists()


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
