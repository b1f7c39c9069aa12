"""`bellows completion`, as bash uses it."""

import shutil
import subprocess
from typing import Any

from bellows_ros.cli.commands import COMMANDS
from bellows_ros.cli.completion import script
import pytest

pytestmark = pytest.mark.skipif(shutil.which('bash') is None, reason='no bash here')


def complete(*words: str) -> list[str]:
    """Return what bash offers for the last of some words."""
    line = ' '.join(f"'{word}'" for word in words)
    code = (f'{script()}\nCOMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _bellows; '
            'printf "%s\\n" "${COMPREPLY[@]}"')
    done = subprocess.run(['bash', '-c', code], capture_output=True, text=True)
    assert done.stderr == ''
    return done.stdout.split()


def test_commands_are_offered() -> None:
    """List all, and those that begin so."""
    assert set(COMMANDS) <= set(complete('bellows', ''))
    assert complete('bellows', 'ide') == ['identify']


@pytest.mark.parametrize('name', COMMANDS)
def test_options_of_every_command_are_offered(name: str) -> None:
    """Know --help everywhere, and what belongs to one command only there."""
    offered = complete('bellows', name, '--')
    assert '--help' in offered
    assert ('--motion' in offered) == (name == 'simulate')


def test_parameters_are_offered_behind_set() -> None:
    """Leave the value to be typed."""
    assert complete('bellows', 'identify', '--set', 'fit.st') == ['fit.structure=']


def test_known_values_are_offered() -> None:
    """Complete the kinds of pictures, and the values of an option."""
    assert complete('bellows', 'plot', 'sp') == ['spectra']
    assert complete('bellows', 'export', 'cup.yaml', '--to', 'm') == ['mjcf']


def test_files_are_offered_elsewhere(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Complete recordings and parameter files."""
    (tmp_path / 'my_cell.yaml').touch()
    monkeypatch.chdir(tmp_path)
    assert complete('bellows', 'identify', '--params', 'my') == ['my_cell.yaml']
