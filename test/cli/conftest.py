"""The command, and small recordings of a known cup for it."""

from contextlib import chdir, redirect_stderr, redirect_stdout
import io
import os
import subprocess
import sys
from unittest import mock

from bellows_ros.cli import main
import pytest
import yaml

# The cup and the package that the recordings are made with.
STIFFNESS = (5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35)
DAMPING = (55.0, 55.0, 24.0, 0.06, 0.06, 0.10)
PACKAGE = {
    'package.mass': 1.8,
    'package.inertia': [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03],
    'cup.length': 0.046,
}
TOPICS = {
    'topics.tool_pose': '/tool_arm/pose',
    'topics.tool_twist': '/tool_arm/twist',
    'topics.package_pose': '/package/pose',
    'recording.package_frame': 'com',
}
MOTION = {
    'kind': 'multi_sine',
    'duration': 8.0,
    'rest_duration': 1.0,
    'seed': 4,
    'multi_sine': {
        'position': {
            'x': {'amplitude': [0.03, 0.003], 'frequency': [0.6, 2.6]},
            'y': {'amplitude': [0.03, 0.003], 'frequency': [0.7, 2.9]},
            'z': {'amplitude': [0.03, 0.004], 'frequency': [0.8, 4.9]},
        },
        'rotation': {
            'x': {'amplitude': [0.10, 0.02], 'frequency': [0.5, 3.3]},
            'y': {'amplitude': [0.10, 0.02], 'frequency': [0.9, 3.5]},
            'z': {'amplitude': [0.20, 0.10], 'frequency': [0.6, 3.2]},
        },
    },
    'tool': {'rate_hz': 300.0, 'noise': {'position': 1e-5, 'rotation': 2e-5}},
    'package': {
        'rate_hz': 240.0,
        'noise': {'position': 2e-5, 'rotation': 1e-4},
        'dropouts': {'count': 1, 'duration': 0.05},
    },
}

TRANSPORT = {
    'kind': 'waypoints', 'rest_duration': 0.0,
    'waypoints': {'poses': [{'position': [0.4, 0.0, 0.0], 'move': 0.5}]},
    'tool': {'rate_hz': 500.0}, 'package': {'rate_hz': 360.0},
}


def diagonal(values):
    """Return a diagonal matrix as 36 numbers."""
    return [values[i] if i == j else 0.0 for i in range(6) for j in range(6)]


def write_yaml(path, content):
    """Write a YAML file."""
    path.write_text(yaml.safe_dump(dict(content)))
    return path


def contents(folder):
    """Return every file below a folder with its content."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*')) if path.is_file()
    }


@pytest.fixture(scope='session')
def bellows(user_environment):
    """Give a function that runs `bellows` with arguments, in a folder."""
    def run(*arguments, cwd='.', **environment):
        words = list(map(str, arguments))
        if environment:  # only a process of its own reads them
            return subprocess.run(
                [sys.executable, '-m', 'bellows_ros.cli', *words], cwd=cwd,
                env={**user_environment, **environment}, capture_output=True, text=True,
                stdin=subprocess.DEVNULL, timeout=100)
        out, err = io.StringIO(), io.StringIO()
        with (chdir(cwd), redirect_stdout(out), redirect_stderr(err),
              mock.patch.dict(os.environ)):
            os.environ.pop('COLUMNS', None)  # of whoever started the tests
            try:
                code = main(words)
            except SystemExit as end:
                code = end.code
        return subprocess.CompletedProcess(words, code or 0, out.getvalue(), err.getvalue())

    return run


@pytest.fixture(scope='session')
def workshop(tmp_path_factory, bellows):
    """
    Give a folder with what a user has, which tests only read.

    It holds cup.yaml (the truth), package.yaml (what is known beforehand, and the quick fit),
    motion.yaml, and the recording `recording`.
    """
    folder = tmp_path_factory.mktemp('workshop')
    truth = {'cup.stiffness': diagonal(STIFFNESS), 'cup.damping': diagonal(DAMPING)}
    write_yaml(folder / 'cup.yaml', {**PACKAGE, **TOPICS, **truth})
    write_yaml(folder / 'package.yaml', {**PACKAGE, **TOPICS, 'fit.method': 'least_squares'})
    write_yaml(folder / 'motion.yaml', MOTION)
    done = bellows(
        'simulate', '--params', 'cup.yaml', '--motion', 'motion.yaml', '--out', 'recording',
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope='session')
def transport(tmp_path_factory):
    """Give a plan as a motion file."""
    return write_yaml(tmp_path_factory.mktemp('plan') / 'transport.yaml', TRANSPORT)


@pytest.fixture(scope='session')
def identified(bellows, workshop, tmp_path_factory):
    """Identify once; give a folder with cup.yaml and fit.json, which tests only read."""
    folder = tmp_path_factory.mktemp('identified')
    done = bellows(
        'identify', 'recording', '--params', 'package.yaml', '--out', folder / 'cup.yaml',
        '--json', folder / 'fit.json', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    return folder
