"""The command, and small recordings of a known cup for it."""

from contextlib import chdir, redirect_stderr, redirect_stdout
import io
import json
import os
import subprocess
import sys
from unittest import mock

from bellows_ros.cli import main
from bellows_ros.files.parameter_files import read_parameters
import pytest
from ruamel.yaml import YAML

from ..conftest import ROOT

KNOWN = dict(read_parameters(ROOT / 'bags' / 'package.yaml'))
TRUTH = {**KNOWN, **read_parameters(ROOT / 'bags' / 'cup.yaml')}
"""What is known of the recordings beforehand, and what they are made with."""
MOTION = {
    **YAML(typ='safe').load((ROOT / 'bags' / 'identification.yaml').read_text()),
    'duration': 8.0, 'rest_duration': 1.0,
    'tool': {'rate_hz': 300.0, 'noise': {'position': 1e-5, 'rotation': 2e-5}},
    'package': {'rate_hz': 240.0, 'noise': {'position': 2e-5, 'rotation': 1e-4},
                'dropouts': {'count': 1, 'duration': 0.05}}}
"""The motion of the shipped recording, shorter and with less noise."""

TRANSPORT = {
    'kind': 'waypoints', 'rest_duration': 0.0,
    'waypoints': {'poses': [{'position': [0.4, 0.0, 0.0], 'move': 0.5}]},
    'tool': {'rate_hz': 500.0}, 'package': {'rate_hz': 360.0},
}


def write_yaml(path, content):
    """Write a YAML file."""
    path.write_text(json.dumps(dict(content)))
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
            code = main(words)
        return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())

    return run


@pytest.fixture(scope='session')
def succeed(bellows):
    """Give a function that runs `bellows`, and has it succeed; if quiet, without a warning."""
    def run(*arguments, quiet=False, **options):
        done = bellows(*arguments, **options)
        assert done.returncode == 0 and not (quiet and done.stderr), done.stderr
        return done

    return run


@pytest.fixture(scope='session')
def workshop(tmp_path_factory, succeed):
    """
    Return a folder with the files of a user, which tests only read.

    It contains cup.yaml (the truth), package.yaml (given quantities, and the quick method),
    motion.yaml, and the recording `recording`.
    """
    folder = tmp_path_factory.mktemp('workshop')
    write_yaml(folder / 'cup.yaml', TRUTH)
    write_yaml(folder / 'package.yaml', {**KNOWN, 'fit.method': 'least_squares'})
    write_yaml(folder / 'motion.yaml', MOTION)
    succeed(
        'simulate', '--params', 'cup.yaml', '--motion', 'motion.yaml', '--out', 'recording',
        cwd=folder)
    return folder


@pytest.fixture(scope='session')
def transport(tmp_path_factory):
    """Give a plan as a motion file."""
    return write_yaml(tmp_path_factory.mktemp('plan') / 'transport.yaml', TRANSPORT)
