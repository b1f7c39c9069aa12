"""
Shared fixtures, and settings that confine the tests' ROS to this machine and to one test run.

The settings are made when this file is read, before any test can call `rclpy.init`.
The ROS wheels re-execute the interpreter at its very start, to set library paths
(`ros_wheels_bootstrapper`, from a .pth file): that is over before pytest begins, and child
processes inherit its outcome. See `missing_library_paths` for the one case where it goes wrong.
"""

from contextlib import contextmanager
from dataclasses import dataclass
import fcntl
import importlib.util
import os
from pathlib import Path
import shutil
import signal
import sys
import tempfile
import time
from typing import Any

from bellows_ros.core import configure_process
from bellows_ros.nodes.domain import isolate
import hypothesis
import pytest

configure_process()

ROOT = Path(__file__).resolve().parents[1]
BOOTSTRAPPED = '_ROS_WHEELS_BOOTSTRAP_COMPLETE'

RESTING = {
    'kind': 'static', 'rest_duration': 1.5,
    'static': {'move': 0.5, 'hold': 3.0, 'poses': [{'rpy': [0.0, 0.0, 0.0]}]},
    'tool': {'rate_hz': 100.0, 'noise': {'position': 5e-5, 'rotation': 1e-4},
             'twist': {'publish': False}},
    'package': {'rate_hz': 100.0, 'noise': {'position': 1e-4, 'rotation': 5e-4}},
}
"""A motion that holds a package upright."""

WAIT_FACTOR = 10.0
"""Ratio of the time that passes to processor time, for waiting on a busy machine."""

LONGEST_TURN = 0.1
"""Longest wait (s) that counts at once: a process that is not run for a while loses no time."""

NOT_IN_A_COPY = shutil.ignore_patterns(
    '.*_cache', '.git', '.hypothesis', '.venv*', '__pycache__', '*.egg-info', 'bags', 'build',
    'dist', 'install', 'log', 'test')


def missing_library_paths():
    """
    Return the library folders of the ROS wheels that this process was started without.

    The wheels re-execute the interpreter unless a variable in the environment says that this has
    been done. Inherited from a process of another environment, it says so wrongly.
    """
    if importlib.util.find_spec('ros_wheels_bootstrapper') is None:
        return []
    known = os.environ.get('LD_LIBRARY_PATH', '').split(os.pathsep)
    return [str(path) for path in _library_folders() if str(path) not in known]


def _library_folders():
    """Return the folders of shared libraries of this environment's ROS wheels."""
    packages = Path(sys.prefix, 'lib', f'python{sys.version_info[0]}.{sys.version_info[1]}')
    return [path.resolve() for path in (packages / 'site-packages').glob('ros_*.libs')]


# In the background and under nohup they are ignored, also by the commands of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

LOGS = tempfile.TemporaryDirectory(prefix='bellows_ros_log_')
isolate(LOGS.name)
os.environ.setdefault('MPLBACKEND', 'Agg')
hypothesis.settings.register_profile('suite', deadline=None, derandomize=True)
hypothesis.settings.load_profile('suite')


def pytest_configure(config):
    """Refuse to run if every import of rclpy would fail with a misleading error."""
    if missing_library_paths():
        raise pytest.UsageError(
            f'{BOOTSTRAPPED} is set, but not by this Python ({sys.executable}): the ROS libraries '
            f'cannot be found. Start again with: env -u {BOOTSTRAPPED} {sys.executable} -m pytest')
    is_whole = config.args_source != pytest.Config.ArgsSource.ARGS and not config.option.keyword
    is_first = 'PYTEST_XDIST_WORKER' not in os.environ
    if is_whole and is_first and config.getoption('numprocesses', None):
        from bellows_ros.core.geometry.jit import COMPILED

        from .compiling import PARTS, RELAXING, warm_up

        if COMPILED:
            print('The kernels are compiled first, once for all workers.', flush=True)
            warm_up(PARTS, ((0.0, 0.0), RELAXING))


def compiled(*arguments):
    """Compile a part outside the time limit of a test, in one worker; others then load it."""
    from .compiling import compile_part  # late, as NumPy loads slowly

    with (ROOT / 'pyproject.toml').open() as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        compile_part(*arguments)


def pytest_collection_modifyitems(items):
    """Give tests that share what is made once in their module to one worker."""
    for item in items:
        made = item._fixtureinfo.name2fixturedefs  # type: ignore[attr-defined]
        if any(of[-1].scope == 'module' for of in made.values()):
            item.add_marker(pytest.mark.xdist_group(str(item.path)))


def pytest_report_header():
    """Say which ROS the tests of the nodes use."""
    spec = importlib.util.find_spec('rclpy')
    if spec is None:
        return "ROS: no rclpy here, the tests of nodes are skipped (pip install '.[ros]')"
    domain = os.environ['ROS_DOMAIN_ID']
    return f'ROS: {Path(str(spec.origin)).parent}, domain {domain}, this machine only'


def pytest_unconfigure():
    """Remove the logs."""
    LOGS.cleanup()


@pytest.fixture(scope='session')
def predictor_kernels():
    """Compile predictions."""
    compiled('prediction')


@pytest.fixture(scope='session')
def observer_kernels():
    """Compile the observer."""
    compiled('observer')


@pytest.fixture(scope='session')
def plan_kernels():
    """Compile answers to plans, and landings."""
    compiled('plans')


@pytest.fixture(scope='session')
def root():
    """Give the top of the repository."""
    return ROOT


@pytest.fixture(scope='session')
def rig():
    """Give the recordings with known truth, which lie beside the repository."""
    path = ROOT.parent / 'shared' / 'rig'
    if not path.is_dir():
        pytest.skip('the recordings with known truth are not here (../shared/rig)')
    return path


@pytest.fixture(scope='session')
def true_cup(root):
    """Return the cup with which the shipped recordings were simulated."""
    from bellows_ros.files.parameter_files import read_parameters

    return read_parameters(root / 'bags/cup.yaml')


@pytest.fixture(scope='session')
def known(root):
    """Return the given quantities of the shipped recordings."""
    from bellows_ros.files.parameter_files import read_parameters

    return read_parameters(root / 'bags/package.yaml')


@pytest.fixture(scope='session')
def shipped(root, known, true_cup):
    """Return the identification of the shipped recording, and the true cup."""
    from bellows_ros.workflows.identify import identify

    return identify({**known, 'bags': [str(root / 'bags/identification')],
                     'fit.method': 'least_squares'}), true_cup


@pytest.fixture(scope='session')
def weights(tmp_path_factory, true_cup):
    """Return recordings of packages at rest, with their masses."""
    from bellows_ros.workflows.simulate import simulate_recording

    folder, found = tmp_path_factory.mktemp('weights'), {}
    for number, mass in enumerate((0.6, 1.2, 2.0)):
        found[str(folder / f'm{number}')] = mass
        simulate_recording({**true_cup, 'package.mass': mass}, {**RESTING, 'seed': number},
                           folder / f'm{number}')
    return found


@pytest.fixture(scope='session')
def copy_sources():
    """Give a function that copies the package's sources, to build there without leaving traces."""
    def copy(target):
        return Path(shutil.copytree(ROOT, target, ignore=NOT_IN_A_COPY))

    return copy


@pytest.fixture(scope='session')
def user_environment():
    """
    Give environment variables like those of a user's shell, for child processes.

    Without what the ROS wheels set at the start of this process, a child starts like a command
    typed by a user, and an interpreter of another environment finds its own libraries. The
    settings that keep ROS on this machine stay.
    """
    environment = {**os.environ}
    environment.pop(BOOTSTRAPPED, None)
    environment.pop('COLUMNS', None)  # of whoever started the tests
    ours = {str(path) for path in _library_folders()} | {str(Path(sys.prefix, 'lib'))}
    paths = environment.pop('LD_LIBRARY_PATH', '').split(os.pathsep)
    kept = [path for path in paths if path and path not in ours]
    if kept:
        environment['LD_LIBRARY_PATH'] = os.pathsep.join(kept)
    return environment


@pytest.fixture
def handlers():
    """Restore the handlers of signals."""
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@dataclass(frozen=True)
class Ros:
    """
    Hold a context and an executor of one test.

    Attributes
    ----------
    context : rclpy.context.Context
        Private to the test; give it to every node: `Node('name', context=ros.context)`.
    executor : rclpy.executors.SingleThreadedExecutor
        Spins only while the test asks for it; nodes added to it are destroyed after the test.

    """

    context: Any
    executor: Any

    def spin_until(self, condition, timeout=60.0):
        """
        Spin until a condition holds; return whether it held before the timeout (s).

        Waits for events, not for time: it returns as soon as the condition holds, and the timeout
        is long, as it costs only where something fails. It counts processor time, and time that
        passes by a `WAIT_FACTOR` less.
        """
        left = timeout
        while not condition():
            if left <= 0.0:
                return False
            before, used = time.monotonic(), time.process_time()
            self.executor.spin_once(timeout_sec=LONGEST_TURN)
            passed = min(time.monotonic() - before, LONGEST_TURN) / WAIT_FACTOR
            left -= max(time.process_time() - used, passed)
        return True


@contextmanager
def private_ros(*args):
    """Give a private ROS context with a single-threaded executor, and close both cleanly."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.context.Context()
    rclpy.init(args=[*args], context=context)
    executor = SingleThreadedExecutor(context=context)
    try:
        yield Ros(context, executor)
    finally:
        for node in executor.get_nodes():
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()


@pytest.fixture
def ros():
    """Give a private ROS context with a single-threaded executor."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    with private_ros() as own:
        yield own
