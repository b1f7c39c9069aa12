"""Completion in the shell, by argcomplete."""

import os
import subprocess
import sys

from bellows_ros.cli import COMMANDS
import pytest

pytest.importorskip('argcomplete', reason="no argcomplete here (pip install '.[complete]')")


def complete(line, folder):
    """Return what can stand for the last word of a line."""
    offered = folder / 'offered'
    done = subprocess.run(
        [sys.executable, '-m', 'bellows_ros.cli'], cwd=folder, capture_output=True, text=True,
        env={**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': line, 'COMP_POINT': str(len(line)),
             '_ARGCOMPLETE_SUPPRESS_SPACE': '1', '_ARGCOMPLETE_IFS': '\n',
             '_ARGCOMPLETE_STDOUT_FILENAME': str(offered)})
    assert done.returncode == 0, done.stderr
    return [word.strip() for word in offered.read_text().split('\n')]


@pytest.mark.parametrize(('line', 'expected'), [
    ('bellows ', {*COMMANDS}),
    ('bellows simulate --seed 1 --', {'--motion', '--params', '--help'}),
    ('bellows identify --set fit.st', {'fit.structure='}),
    ('bellows identify --params my', {'my_arm.yaml', 'my_cell.yaml'}),
])
def test_what_can_follow_is_offered(line, expected, tmp_path):
    """Offer commands, their options and values, parameters, and files elsewhere."""
    for name in ('my_cell.yaml', 'my_arm.yaml'):
        (tmp_path / name).touch()
    assert expected <= set(complete(line, tmp_path))
