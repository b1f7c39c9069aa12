"""What holds for all commands: help, versions, exit codes, streams, start-up."""

import argparse
from pathlib import Path
import re
import subprocess
import sys

import bellows_ros
from bellows_ros.cli import add_arguments, COMMANDS, Output
import pytest

HEAVY = ('numpy', 'scipy', 'numba', 'matplotlib', 'rosbags', 'ruamel', 'rclpy')


def test_help_names_every_command(bellows, quietly):
    """List all commands with what they do, and the exit codes."""
    done = quietly('--help')
    for name, entry in COMMANDS.items():
        assert f'{name} ' in done.stdout and entry['does'] in done.stdout
    assert 'exit codes' in done.stdout and '130' in done.stdout
    assert 'Angles are shown in degrees' in done.stdout
    assert bellows('--version').stdout == f'bellows {bellows_ros.__version__}\n'


@pytest.mark.parametrize('name', COMMANDS)
def test_every_command_has_help_with_examples(name, quietly):
    """Show arguments, examples, and in a line its exit codes."""
    done = quietly(name, '--help')
    assert done.stdout.startswith(f'usage: bellows {name}')
    assert 'examples:\n' in done.stdout and f'bellows {name}' in done.stdout.split('examples:')[1]
    assert done.stdout.count('Exit code 0 when done, ') == 1
    ends = ' '.join(done.stdout.split('Exit code 0')[1].split())
    found = name in ('identify', 'plan', 'replay', 'toss')
    assert ('1 if ' in ends) == found
    assert max(map(len, done.stdout.splitlines())) < 100
    assert '--json' in done.stdout


def test_help_loads_nothing_heavy(user_environment):
    """Answer without what takes long to load; one process is asked for all."""
    lines = [['--help'], ['--version'], *([name, '-h'] for name in COMMANDS)]
    code = f"""
import sys
from bellows_ros.cli import main
for line in {lines!r}:
    try:
        sys.exit(main(line))
    except SystemExit as end:
        print('exit', end.code, line, [name for name in {HEAVY!r} if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, '-c', code], env=user_environment, capture_output=True, text=True)
    for line in lines:
        assert f'exit 0 {line} []\n' in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(('arguments', 'named'), [
    (['indentify'], "'indentify'.*'identify'"), (['xyz'], "'xyz'.* 'identify'"),
    (['replay'], 'BAG'), (['simulate', '--out', 'x'], '--motion'),
    (['replay', 'bag', '--jsn', 'x'], "'--jsn'.*'--json'")])
def test_a_wrong_command_line_is_explained(arguments, named, bellows):
    """Say in two lines what is wrong and where help is, and end with 2."""
    done = bellows(*arguments)
    assert (done.returncode, done.stdout) == (2, '')
    assert re.search(named, done.stderr) and '--help' in done.stderr
    assert len(done.stderr.splitlines()) == 2


@pytest.mark.parametrize(('no_colour', 'coloured'), [('', True), ('1', False)])
def test_colour_on_a_terminal_honours_no_color(no_colour, coloured, user_environment):
    """Use colour on a terminal, unless NO_COLOR is set and not empty."""
    pty = pytest.importorskip('pty', reason='no pseudo-terminals here')
    code = f"""
import os, pty, sys
os.environ.update(TERM='xterm', NO_COLOR={no_colour!r})
pty.spawn([sys.executable, '-m', 'bellows_ros.cli', 'parameters', 'gravity'])
"""
    assert pty
    done = subprocess.run(
        [sys.executable, '-c', code], env=user_environment, capture_output=True,
        stdin=subprocess.DEVNULL,
    )
    assert b'gravity' in done.stdout
    assert (b'\x1b[1m' in done.stdout) == coloured


def test_a_closed_pipe_is_no_error(root, user_environment):
    """End quietly when the reader of the output has had enough, as `head` has."""
    command = f'{sys.executable} -m bellows_ros.cli parameters --yaml | head -n 1'
    done = subprocess.run(
        ['bash', '-c', command], env=user_environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout.startswith('#')


def test_plain_ascii_where_the_output_knows_no_more(quietly):
    """Do without special characters where the stream has none."""
    done = quietly('parameters', PYTHONIOENCODING='ascii')
    assert done.stdout.isascii()


def test_every_output_is_known_as_one():
    """Have all options that name what is written checked: those with FILE, and BAG and NAME."""
    outputs = {}
    for command in COMMANDS:
        parser = argparse.ArgumentParser()
        add_arguments(parser, command)
        for action in parser._actions:
            if action.metavar in ('FILE', 'NAME', 'BAG') and action.type not in (Path, None):
                assert isinstance(action.type, type) and issubclass(action.type, Output)
                outputs.setdefault(command, []).append(action.option_strings[0])
            elif action.metavar in ('FILE', 'BAG'):
                assert action.type is Path, (command, action)
    assert outputs['identify'] == ['--out', '--out-cell', '--json', '--report']
    assert outputs['info'] == ['--write-params', '--json']
    assert set(COMMANDS) == set(outputs)
