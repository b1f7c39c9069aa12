"""`bellows plot` as a user runs it."""

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")

Run = Any


@pytest.mark.parametrize(
    ('what', 'name', 'start'),
    [('motion', 'a.png', b'\x89PNG'), ('prediction', 'a.svg', b'<?xml'),
     ('animation', 'a.gif', b'GIF8')],
)  # fmt: skip
def test_pictures_are_written(
    what: str, name: str, start: bytes, bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Write one file, and say so."""
    more = ('--from', '2', '--to', '2.3') if what == 'animation' else ()
    done = bellows('plot', what, 'recording', '--params', 'cup.yaml', '--out', tmp_path / name,
                   *more, cwd=workshop)
    assert (done.returncode, done.stderr) == (0, '')
    assert done.stdout == f'Wrote {tmp_path / name}.\n'
    assert (tmp_path / name).read_bytes().startswith(start)


def test_the_numbers_of_a_picture_are_given(
    bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Write what is drawn as JSON to stdout, and words to stderr."""
    done = bellows('plot', 'deflection', 'recording', '--params', 'cup.yaml', '--json', '-',
                   '--out', tmp_path / 'a.svg', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, f'Wrote {tmp_path / "a.svg"}.\n')
    content = json.loads(done.stdout)
    assert content['what'] == 'deflection'
    assert len(content['seconds']) == len(content['deflection']) == len(content['load']) > 1000


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['motion', 'recording', '--out', 'a.gif'], 'must end in .png, .svg or .pdf'),
        (['animation', 'recording', '--out', 'a.png'], 'must end in .gif or .mp4'),
        (['motion', 'none', '--out', 'a.png'], 'does not exist'),
        (['animation', 'recording', '--out', 'a.gif', '--from', '90'], 'recording covers'),
        (['portrait', 'recording', '--out', 'a.png'], 'invalid choice'),
    ],
)
def test_bad_input_ends_with_2_and_draws_nothing(
    arguments: list[str], words: str, bellows: Run, workshop: Path, tmp_path: Path
) -> None:
    """Say what is wrong."""
    arguments = [str(tmp_path / a) if a.startswith('a.') else a for a in arguments]
    done = bellows('plot', *arguments, '--params', 'cup.yaml', cwd=workshop)
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert 'Traceback' not in done.stderr and list(tmp_path.iterdir()) == []


def test_a_missing_cup_is_said(bellows: Run, workshop: Path, tmp_path: Path) -> None:
    """Warn where a picture shows the cup of the thesis."""
    done = bellows('plot', 'deflection', 'recording', '--params', 'package.yaml', '--out',
                   tmp_path / 'a.png', cwd=workshop)
    assert done.returncode == 0 and 'cup of the thesis' in done.stdout
