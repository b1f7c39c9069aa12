"""A real colcon build of the package, and the executables it installs."""

from pathlib import Path
import sys

from bellows_ros import __version__
import pytest

pytestmark = [pytest.mark.lane, pytest.mark.xdist_group('installed')]


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
