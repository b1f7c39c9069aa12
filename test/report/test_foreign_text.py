"""Hostile text of files and messages: neither commands nor pictures carry it."""

import os

from bellows_ros import plots
import numpy as np
import pytest

from ..cli.conftest import bellows  # noqa: F401 (a fixture)
from ..files.recordings import EPOCH_NS, message, POSE, TYPES, write

HOSTILE = '\x1b]0;owned\x07\x1b[2J\n\u202e$\\\\frac{' + 'a' * 200_000


def test_frames_and_topics_of_a_recording(bellows, tmp_path):  # noqa: F811
    """In frame_id of messages, and in the name of a topic."""
    bad = HOSTILE[:2000]
    rows = [(int(t), bytes(TYPES.serialize_cdr(message(
        POSE, t, pose=np.array([0, 0, 1, 0, 0, 0, 1.0]), frame_id=bad), POSE)))
        for t in EPOCH_NS + np.arange(50) * 10_000_000]
    write(tmp_path / 'bag', {('/tool', POSE): rows, (f'/x{bad[:100]}', POSE): rows})
    for command in ('info', 'plan', 'identify', 'replay'):
        done = bellows(command, 'bag', cwd=tmp_path)
        for text in (done.stdout, done.stderr):
            assert all(c.isprintable() or c == '\n' for c in text), repr(text[:300])
            assert 'Traceback' not in text and len(text) < 20_000


@pytest.mark.parametrize('note', ['run_$5_and_$6', '$\\frac{', os.fsdecode(b'caf\xe9'), HOSTILE])
def test_pictures(note, tmp_path):
    """In the conditions above the panels."""
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    with plots.picture('Title', note) as figure:
        plots.write_figure(tmp_path / 'a.png', figure)
        plots.svg_of(figure)
