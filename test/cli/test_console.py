"""Tables as the commands print them."""

import os

from bellows_ros.cli.console import aligned
import pytest

ROWS = [['axis', *(f'column {k}' for k in range(8))]] + [
    [axis, *(f'{k * 1000.5:g}' for k in range(8))] for axis in ('x', 'y')]


@pytest.mark.parametrize('right', [False, True])
def test_a_table_fits_a_narrow_terminal_and_loses_nothing(right, monkeypatch):
    monkeypatch.setenv('COLUMNS', '60')
    lines = aligned(ROWS, right)
    assert max(map(len, lines)) <= 58
    assert len(lines) == 2 * len(ROWS) and [line[:4] for line in lines[::3]] == ['axis'] * 2
    for row in ROWS:
        shown = ' '.join(lines[ROWS.index(row)::3])
        assert all(cell in shown for cell in row)


def test_a_table_for_no_terminal_is_whole(monkeypatch):
    monkeypatch.delenv('COLUMNS', raising=False)
    monkeypatch.setattr('shutil.get_terminal_size', os.terminal_size)
    assert len(aligned(ROWS)) == len(ROWS)
