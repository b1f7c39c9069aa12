"""`bellows view` as a user runs it."""

import json
import os

import pytest


@pytest.mark.extras
def test_a_file_is_written_for_the_viewer(bellows, workshop, tmp_path):
    """Write it, say how it is opened, and give the scores."""
    pytest.importorskip('rerun', reason="no Rerun here (pip install '.[view]')")
    done = bellows('view', 'recording', '--params', 'cup.yaml', '--out', tmp_path / 'a.rrd',
                   '--json', '-', cwd=workshop)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)['samples'] > 1000
    assert f'rerun {tmp_path / "a.rrd"}' in done.stderr
    assert (tmp_path / 'a.rrd').read_bytes().startswith(b'RRF')


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['recording', '--out', 'a.png'], 'must end in .rrd'),
        (['recording', '--out', 'a.rrd'], 'pip install rerun-sdk'),
    ],
)
def test_what_is_missing_is_said_before_any_work(arguments, words, bellows, workshop, tmp_path):
    """Name the extra where there is no Rerun, and write nothing."""
    (tmp_path / 'rerun.py').write_text("raise ImportError('not here')\n")
    (tmp_path / 'out').mkdir()
    arguments = [str(tmp_path / 'out' / a) if a.startswith('a.') else a for a in arguments]
    paths = filter(None, [str(tmp_path), os.environ.get('PYTHONPATH')])
    done = bellows('view', *arguments, '--params', 'cup.yaml', cwd=workshop,
                   PYTHONPATH=os.pathsep.join(paths))
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert 'Traceback' not in done.stderr and list((tmp_path / 'out').iterdir()) == []


@pytest.mark.extras
def test_without_a_display_it_says_what_to_do(bellows, workshop):
    """Let Rerun say why, and name the way to see it elsewhere."""
    pytest.importorskip('rerun', reason="no Rerun here (pip install '.[view]')")
    done = bellows('view', 'recording', '--params', 'cup.yaml', cwd=workshop, DISPLAY='',
                   WAYLAND_DISPLAY='', WAYLAND_SOCKET='')
    assert done.returncode == 2 and '--out view.rrd' in done.stderr, done.stderr
    assert 'Traceback' not in done.stderr
