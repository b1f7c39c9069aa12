"""The package as colcon installs it, built once."""

from dataclasses import dataclass
from pathlib import Path
import subprocess
import sys

import pytest

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


@pytest.fixture(scope='session')
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
