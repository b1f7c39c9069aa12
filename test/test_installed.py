"""The package as colcon installs it: its files, and the predictor used as a user does."""

from dataclasses import dataclass
from pathlib import Path
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


def test_every_file_is_where_python_and_ros_look(installed, root):
    """Import what colcon installed; hold manifest, launch files, configuration, executables."""
    code = 'import bellows_ros as b; print(b.__file__, b.__version__)'
    file, version = installed.run(sys.executable, '-c', code).stdout.split()
    assert Path(file).is_relative_to(installed.prefix) and version == __version__
    share = installed.prefix / 'share' / 'bellows_ros'
    sources = [root / 'package.xml', *root.glob('launch/*.launch.py'), *root.glob('config/*.yaml')]

    for source in sources:
        assert (share / source.relative_to(root)).read_bytes() == source.read_bytes()
    assert len(list((share / 'launch').iterdir())) == 2
    assert (share.parent / 'ament_index/resource_index/packages/bellows_ros').is_file()
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
        self.process = subprocess.Popen(
            [self._installed.prefix / 'lib/bellows_ros/predictor', '--ros-args', '--params-file',
             self._file, *arguments], env=self._installed.environment, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True)

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
    assert ' predictions' in user.stop()
    assert user.process.returncode == 0
