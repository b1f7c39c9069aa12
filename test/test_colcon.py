"""A real colcon build of the package, and the executables it installs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import subprocess
import sys

from bellows_ros import __version__
import pytest

PYTHON = f'python{sys.version_info[0]}.{sys.version_info[1]}'


@dataclass(frozen=True)
class Installed:
    """Hold where colcon installed the package, and the variables that a shell needs to use it."""

    prefix: Path
    environment: dict[str, str]

    def run(self, *command: str) -> 'subprocess.CompletedProcess[str]':
        """Run a command as a user of the installed package would."""
        return subprocess.run(
            command, env=self.environment, cwd=self.prefix, capture_output=True, text=True,
            timeout=60)

    def executable(self, name: str) -> str:
        """Return the path at which `ros2 run bellows_ros NAME` looks for an executable."""
        return str(self.prefix / 'lib' / 'bellows_ros' / name)


@pytest.fixture(scope='module')
def installed(
        tmp_path_factory: pytest.TempPathFactory, copy_sources: Callable[[Path], Path],
        user_environment: dict[str, str]) -> Installed:
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
    environment |= {
        'AMENT_PREFIX_PATH': str(prefix),
        'PYTHONPATH': str(prefix / 'lib' / PYTHON / 'site-packages'),
    }
    return Installed(prefix, environment)


def test_python_finds_the_installed_package(installed: Installed) -> None:
    """Import what colcon installed, not the tree under test."""
    code = 'import bellows_ros as b; print(b.__file__, b.__version__)'
    file, version = installed.run(sys.executable, '-c', code).stdout.split()

    assert Path(file).is_relative_to(installed.prefix)
    assert version == __version__


def test_share_holds_manifest_launch_files_and_configuration(
        installed: Installed, root: Path) -> None:
    """Find in share what ROS tools look for there."""
    share = installed.prefix / 'share' / 'bellows_ros'
    sources = [root / 'package.xml', *root.glob('launch/*.launch.py'), *root.glob('config/*.yaml')]

    for source in sources:
        assert (share / source.relative_to(root)).read_bytes() == source.read_bytes()
    assert len(list((share / 'launch').iterdir())) == 2
    assert list((share / 'config').iterdir())


def test_ament_index_knows_the_package(installed: Installed) -> None:
    """Resolve the package as `ros2 run`, `ros2 launch` and other packages do."""
    index = installed.prefix / 'share' / 'ament_index' / 'resource_index' / 'packages'
    assert (index / 'bellows_ros').is_file()

    pytest.importorskip('ament_index_python', reason='comes with rclpy')
    code = 'from ament_index_python import packages as p; ' \
        "print(p.get_package_share_directory('bellows_ros'))"
    found = installed.run(sys.executable, '-c', code)
    assert Path(found.stdout.strip()) == installed.prefix / 'share' / 'bellows_ros', found.stderr


@pytest.mark.parametrize('name', ['predictor', 'identifier'])
def test_installed_executable_helps(installed: Installed, name: str) -> None:
    """Explain itself and end well."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    done = installed.run(installed.executable(name), '--help')

    assert done.returncode == 0, done.stderr
    assert name in done.stdout
    assert 'Traceback' not in done.stderr


def test_installed_predictor_without_a_package_says_what_to_set(installed: Installed) -> None:
    """End with the exit code of a wrong command line and the name of what is missing."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    done = installed.run(installed.executable('predictor'))

    assert done.returncode == 2, done.stdout + done.stderr
    assert 'package.mass' in done.stdout + done.stderr
    assert 'Traceback' not in done.stdout + done.stderr


def test_executables_are_where_ros_looks_and_not_on_the_path(installed: Installed) -> None:
    """Install into lib/bellows_ros, as setup.cfg says, and nothing into bin."""
    names = {path.name for path in (installed.prefix / 'lib' / 'bellows_ros').iterdir()}
    assert names == {'predictor', 'identifier', 'bellows'}
    assert not (installed.prefix / 'bin').exists()
