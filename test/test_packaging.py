"""What pip and ROS learn about the package, and what they install and run."""

import ast
from importlib.metadata import PathDistribution
import json
from pathlib import Path
import re
import runpy
import shlex
import signal
import subprocess
import sys
from xml.etree import ElementTree
import zipfile

import bellows_ros
from bellows_ros.errors import install, PACKAGES
import pytest
from ruamel.yaml import YAML

from .nodes.conftest import MS, Peer, pose_at, START

COMMANDS = {
    'predictor': 'bellows_ros.nodes.command:predictor',
    'identifier': 'bellows_ros.nodes.command:identifier',
    'bellows': 'bellows_ros.cli:main',
}


def setup_extras(root):
    """Return the extras that setup.py writes down, before 'dev' is put together."""
    tree = ast.parse((root / 'setup.py').read_text())
    return next(
        ast.literal_eval(node.value) for node in tree.body
        if isinstance(node, ast.Assign) and getattr(node.targets[0], 'id', '') == 'EXTRAS')


def build(kind, source, target):
    """Build a 'wheel' or an 'sdist' with the standard interface of build tools (PEP 517)."""
    target.mkdir()
    code = f'from setuptools import build_meta as b; b.build_{kind}({str(target)!r})'
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(target.iterdir())


@pytest.fixture
def wheel(copy_sources, tmp_path):
    """Give the wheel that is built from the unpacked source distribution, as pip would."""
    sdist = build('sdist', copy_sources(tmp_path / 'source'), tmp_path / 'sdist')
    subprocess.run(['tar', '-xf', str(sdist)], cwd=sdist.parent, check=True)
    unpacked = next(path for path in sdist.parent.iterdir() if path.is_dir())
    return zipfile.ZipFile(build('wheel', unpacked, tmp_path / 'wheel'))


@pytest.mark.lane
def test_wheel_holds_the_package_and_its_share_and_no_tests(wheel, root, tmp_path):
    """Install every module, the launch files and the configuration; leave the tests at home."""
    names = set(wheel.namelist())
    data = f'bellows_ros-{bellows_ros.__version__}.data/data/share/'

    modules = {str(path.relative_to(root)) for path in (root / 'bellows_ros').rglob('*.py')}
    assert modules <= names
    assert f'{data}ament_index/resource_index/packages/bellows_ros' in names
    assert f'{data}bellows_ros/package.xml' in names
    for file in [*root.glob('launch/*.launch.py'), *root.glob('config/*.yaml')]:
        assert f'{data}bellows_ros/{file.relative_to(root)}' in names
    assert {name.split('/')[0].partition('-')[0] for name in names} == {'bellows_ros'}

    wheel.extractall(tmp_path / 'wheel_contents')
    metadata = PathDistribution(next((tmp_path / 'wheel_contents').glob('*.dist-info')))
    scripts = metadata.entry_points.select(group='console_scripts')
    assert {script.name: script.value for script in scripts} == COMMANDS
    assert str(metadata.metadata.get_payload()).startswith('# bellows_ros')
    hard = {need for need in metadata.requires or () if 'extra' not in need}
    assert {need.split('>')[0] for need in hard} == {
        'numpy', 'scipy', 'rosbags', 'ruamel.yaml', 'ruamel.yaml.clib', 'click', 'rich'}


@pytest.fixture
def installed(tmp_path, copy_sources, user_environment):
    """Build a copy with the colcon of this environment; give its prefix and a shell for it."""
    pytest.importorskip('colcon_ros', reason="no colcon-ros here (pip install '.[test]')")
    copy_sources(tmp_path / 'src' / 'bellows_ros')
    environment = {**user_environment, 'COLCON_HOME': str(tmp_path / 'colcon_home')}
    done = subprocess.run(
        [str(Path(sys.executable).with_name('colcon')), 'build'],
        cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'Finished <<< bellows_ros' in done.stdout
    prefix = tmp_path / 'install' / 'bellows_ros'
    modules = prefix / f'lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages'
    return prefix, environment | {
        'AMENT_PREFIX_PATH': str(prefix), 'PYTHONPATH': str(modules)}


@pytest.mark.lane
def test_colcon_installs_every_file_and_a_node_that_predicts(installed, root, ros):
    """Files where Python and ROS look; the node in a cell's namespace, with a driver's topic."""
    from geometry_msgs.msg import PoseStamped

    prefix, environment = installed
    code = 'import bellows_ros as b; print(b.__file__, b.__version__)'
    file, version = subprocess.run(
        [sys.executable, '-c', code], env=environment, cwd=prefix, capture_output=True,
        text=True).stdout.split()
    assert Path(file).is_relative_to(prefix) and version == bellows_ros.__version__
    share = prefix / 'share' / 'bellows_ros'
    for source in [root / 'package.xml', *root.glob('launch/*.py'), *root.glob('config/*.yaml')]:
        assert (share / source.relative_to(root)).read_bytes() == source.read_bytes()
    assert len(list((share / 'launch').iterdir())) == 2
    assert (share.parent / 'ament_index/resource_index/packages/bellows_ros').is_file()
    assert {path.name for path in (prefix / 'lib/bellows_ros').iterdir()} == {*COMMANDS}
    assert not (prefix / 'bin').exists()

    user = Peer(ros, 'user')
    answers, writer = user.hears(PoseStamped, '/cell/package/pose'), user.writes(
        PoseStamped, '/driver/pose')
    process = subprocess.Popen(
        [prefix / 'lib/bellows_ros/predictor', '--ros-args', '--params-file',
         root / 'bags/package.yaml', '-r', '__ns:=/cell', '-r', 'tool_arm/pose:=/driver/pose',
         '-r', '__node:=left'], env=environment, stderr=subprocess.STDOUT, stdout=-1, text=True)
    try:
        user.connect()
        for k in range(100):
            if len(answers) < 5:  # the first may meet nobody yet
                writer.publish(pose_at(START + k * 2 * MS, frame_id='base'))
                before = len(answers)
                ros.spin_until(lambda before=before: len(answers) > before, 1.0)
        process.send_signal(signal.SIGINT)
        log = process.communicate(timeout=300)[0]
    finally:
        process.kill()
    assert len(answers) == 5 and process.returncode == 0
    assert ' predictions' in log and 'Traceback' not in log


def test_version_and_licence_agree_everywhere(root):
    """Take the version of package.xml into the package, and describe it in the changelog."""
    manifest = ElementTree.parse(root / 'package.xml').getroot()
    version = bellows_ros.__version__

    assert manifest.findtext('version') == version
    assert manifest.findtext('license') == 'Apache-2.0'
    assert "license='Apache-2.0'" in (root / 'setup.py').read_text()
    assert 'Apache License' in (root / 'LICENSE').read_text()
    assert re.search(rf'^{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)$',
                     (root / 'CHANGELOG.rst').read_text(), re.MULTILINE)


def test_package_xml_is_valid_and_asks_rosdep_for_nothing_it_lacks(root):
    """Hold the schema of format 3, and name no dependency that Ubuntu 24.04 does not have."""
    package = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg comes with colcon-ros')
    notes = []
    text = (root / 'package.xml').read_text()
    manifest = package.parse_package_string(text, warnings=notes)

    assert notes == []
    assert manifest.package_format == 3
    assert manifest.get_build_type() == 'ament_python'
    needs = {need.name for need in manifest.exec_depends}
    assert {'rclpy', 'geometry_msgs', 'std_srvs', 'python3-numpy', 'python3-scipy'} <= needs
    assert not {'python3-numba', 'numba', 'rosbags'} & needs


def test_what_messages_tell_to_install_is_what_the_extras_need(root, tmp_path, monkeypatch):
    """Name the packages of setup.py, quoted for a shell, as this package is on no index yet."""
    extras = setup_extras(root)
    for extra, packages in PACKAGES.items():
        needs = [need.partition('>')[0] for need in extras[extra]]
        assert packages == shlex.join(needs)
        assert install(extra) == f'pip install {packages}'
    monkeypatch.setattr('sysconfig.get_path', lambda name: str(tmp_path))
    monkeypatch.setattr('sys.base_prefix', sys.prefix)
    (tmp_path / 'EXTERNALLY-MANAGED').touch()  # as of Ubuntu, outside an environment
    assert shlex.split(install('fast'))[-4:] == [
        '--user', '--break-system-packages', 'numba', 'numpy<2']
    command = install('fast').rpartition('numba')[0]
    assert command in (root / 'docs' / 'first_prediction.md').read_text()
    sources = [*root.glob('bellows_ros/**/*.py'), *root.glob('docs/*.md'), root / 'README.md']
    assert not [str(file) for file in sources if "'bellows_ros[" in file.read_text()]


@pytest.mark.parametrize('name', ['identifier', 'predictor'])
def test_launch_file_describes_its_node(name, root):
    """Say in the first line what will run; declare every argument, the parameter file required."""
    file = root / 'launch' / f'{name}.launch.py'
    assert str(ast.get_docstring(ast.parse(file.read_text()))).startswith(f'Start one {name}: ')
    pytest.importorskip('launch_ros', reason='ROS 2 launch is not among the wheels')
    contents = runpy.run_path(str(file))
    arguments = contents['generate_launch_description']().get_launch_arguments()

    assert {argument.name for argument in arguments} == set(contents['ARGUMENTS'])
    required = {argument.name for argument in arguments if not argument.default_value}
    assert required == {'params_file'}


def topics_of(content):
    """Return all topics in a layout."""
    return set(re.findall(r'/(?:tool_arm|package|cup)/\w+', json.dumps(content)))


@pytest.mark.parametrize('name', ['predictor.rviz', 'predictor.foxglove.json'])
def test_layouts_show_topics_of_the_predictor(name, root):
    """Name no topic that no node has."""
    text = (root / 'config' / name).read_text()
    content = YAML(typ='safe').load(text) if name.endswith('.rviz') else json.loads(text)
    shown = topics_of(content)
    nodes = ''.join(path.read_text() for path in (root / 'bellows_ros' / 'nodes').glob('*.py'))
    assert {'/tool_arm/pose', '/package/pose', '/package/measured', '/package/plan_path',
            '/package/odometry'} <= shown
    assert name.endswith('.rviz') or '/package/ok' in shown  # RViz shows no Bool
    assert 'base' in text or '"followTf"' not in text  # no frame that a robot may lack
    assert [topic for topic in shown if f"'{topic[1:]}'" not in nodes] == []
