"""`bellows completion`, as bash and zsh use it."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from bellows_ros.cli.app import COMMANDS
from bellows_ros.cli.completion import offers, SHELLS
import pytest

BASH = """{script}
COMP_WORDS=({line}); COMP_CWORD={last}; _bellows bellows; printf "%s\\n" "${{COMPREPLY[@]}}"
"""
# What zsh's own functions do with the words they get, without a terminal.
ZSH = """
compdef() {{ }}
_describe() {{ print -rl -- ${{(P)2%%:*}} }}
_files() {{ print -rl -- $words[CURRENT]*(N) }}
{script}
words=({line}); CURRENT={count}; _bellows; true
"""


def complete(shell: str, *words: str) -> list[str]:
    """Return what a shell offers for the last of some words."""
    if shutil.which(shell) is None:
        pytest.skip(f'no {shell} here')
    line = ' '.join(f"'{word}'" for word in words)
    code = {'bash': BASH, 'zsh': ZSH}[shell].format(
        script=SHELLS[shell], line=line, last=len(words) - 1, count=len(words))
    plain = {'bash': ['--norc'], 'zsh': ['-f']}[shell]
    path = f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}'
    done = subprocess.run([shell, *plain, '-c', code], capture_output=True, text=True,
                          env={**os.environ, 'PATH': path})
    assert done.stderr == ''
    return done.stdout.split()


shells = pytest.mark.parametrize('shell', ['bash', 'zsh'])


@shells
def test_commands_are_offered(shell: str) -> None:
    """List all, and those that begin so."""
    assert set(COMMANDS) <= set(complete(shell, 'bellows', ''))
    assert complete(shell, 'bellows', 'ide') == ['identify']


@shells
def test_options_are_offered(shell: str) -> None:
    """List those of the command."""
    offered = complete(shell, 'bellows', 'simulate', '--seed', '1', '--')
    assert {'--help', '--motion', '--params'} <= set(offered)


@pytest.mark.parametrize('name', COMMANDS)
def test_options_of_every_command_are_offered(name: str) -> None:
    """Know --help everywhere, and what belongs to one command only there; all with a sentence."""
    offered = offers([name, '--'])
    assert '--help' in offered and all(offered.values())
    assert ('--motion' in offered) == (name == 'simulate')


@shells
def test_parameters_are_offered_behind_set(shell: str) -> None:
    """Leave the value to be typed."""
    assert complete(shell, 'bellows', 'identify', '--set', 'fit.st') == ['fit.structure=']


@shells
def test_known_values_are_offered(shell: str) -> None:
    """Complete the kinds of pictures, and the values of an option."""
    assert complete(shell, 'bellows', 'plot', 'sp') == ['spectra']
    assert complete(shell, 'bellows', 'export', 'cup.yaml', '--to', 'm') == ['mjcf']


@shells
def test_files_are_offered_elsewhere(
    shell: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Complete recordings and parameter files."""
    for name in ('my_cell.yaml', 'my_arm.yaml'):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    offered = complete(shell, 'bellows', 'identify', '--params', 'my')
    assert set(offered) == {'my_cell.yaml', 'my_arm.yaml'}


def test_the_shell_in_use_is_the_default(bellows: Any) -> None:
    """Print what `source` takes in the user's shell; that for bash where it is another."""
    for shell, first in (('/bin/zsh', '#compdef'), ('/bin/bash', '# '), ('/bin/fish', '# ')):
        assert bellows('completion', SHELL=shell).stdout.startswith(first)
