"""`bellows plot` as a user runs it."""

import json

import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


def test_a_picture_is_written(quietly, workshop, tmp_path):
    """Write one file, and say so."""
    out = tmp_path / 'a.svg'
    done = quietly(
        'plot', 'prediction', 'recording', '--params', 'cup.yaml', '--out', out, cwd=workshop)
    assert done.stdout == f'Wrote {out}.\n' and out.read_bytes().startswith(b'<?xml')


@pytest.mark.parametrize('what', ['motion', 'spectra'])
def test_a_recording_is_drawn_before_its_package_is_weighed(what, quietly, workshop, tmp_path):
    """Draw what is tracked with the file that `bellows info` writes, without a cup."""
    cell, out = tmp_path / 'my_cell.yaml', tmp_path / 'a.svg'
    quietly('info', 'recording', '--write-params', cell, cwd=workshop)
    quietly('plot', what, 'recording', '--params', cell, '--out', out, cwd=workshop)


@pytest.mark.parametrize('what', ['residuals', 'animation'])
def test_a_part_of_the_time_is_drawn_and_given(what, bellows, workshop, tmp_path):
    """Leave out of picture and numbers what is not asked for."""
    out = tmp_path / ('a.gif' if what == 'animation' else 'a.png')
    done = bellows('plot', what, 'recording', '--params', 'cup.yaml', '--out', out, '--from', '3',
                   '--to', '3.3', '--json', '-', cwd=workshop)
    assert (done.returncode, done.stderr) == (0, f'Wrote {out}.\n')
    seconds = json.loads(done.stdout)['seconds']
    assert out.read_bytes().startswith(b'GIF8' if what == 'animation' else b'\x89PNG')
    assert len(seconds) == 72 + (seconds[-1] == 3.3)  # at 240 Hz
    assert 3.0 <= seconds[0] and seconds[-1] <= 3.3
