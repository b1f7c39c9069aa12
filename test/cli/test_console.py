"""Tables and numbers as the commands print them."""

import io
import math
import os

from bellows_ros.cli.console import aligned, Console, run_guarded
from bellows_ros.core.geometry import jit
from bellows_ros.report.text import column, with_error
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


@pytest.mark.parametrize('value, error, shown', [
    (5405.62, 7.04, '5405.6 ± 7.0 N/m'),
    (5405.62, 0.0, '5405.6 N/m'),
    (5405.62, math.nan, '5405.6 N/m'),
    (5405.62, math.inf, 'not identifiable'),
])
def test_a_value_is_shown_as_far_as_it_is_known(value, error, shown):
    assert with_error(value, error, 'N/m') == shown


@pytest.mark.parametrize(('values', 'error', 'shown'), [
    ([0.0851, 1.234, 12.5], None, ['0.1', '1.2', '12.5']),  # what is far below the largest ...
    ([0.851, 1.234, 12.5], None, ['0.85', '1.23', '12.50']),  # ... does not count
    ([12.34, 0.56], 0.56, ['12.34', '0.56']),
    ([1234.5, 123.4], 123.4, ['1234', '123']),
    ([-0.001, 5.0], None, ['0.0', '5.0']),
    ([0.0, float('nan')], None, ['0.0', 'nan']),
])
def test_a_column_has_the_same_decimals(values, error, shown):
    assert column(values, error) == shown


class Terminal(io.StringIO):
    """Says that it is one."""

    def isatty(self):
        return True


@pytest.mark.parametrize(('stream', 'wrapped'), [(Terminal, True), (io.StringIO, False)])
def test_errors_are_wrapped_on_a_terminal_but_for_what_is_to_be_copied(
    stream, wrapped, monkeypatch
):
    monkeypatch.setenv('NO_COLOR', '1')
    monkeypatch.setenv('COLUMNS', '80')
    monkeypatch.setenv('TERM', 'xterm')
    sentence, copied = 'a word ' * 30, f'    name: {"x" * 90}'
    printed = stream()
    Console(io.StringIO(), printed).error(f'{sentence}\n\n/**:\n{copied}')
    lines = printed.getvalue().splitlines()
    assert copied in lines and '' in lines
    assert (max(len(line) for line in lines if line != copied) <= 80) == wrapped
    assert ' '.join(printed.getvalue().split()).startswith(f'bellows: {sentence}')


@pytest.mark.parametrize('error', [ZeroDivisionError('a defect'), OSError(5, 'a defect')])
def test_a_crash_has_its_own_exit_code_and_asks_for_a_report(error, capsys):
    """Do not end with 1, which says no; keep the traceback, then one line."""
    def work(console):
        raise error

    assert run_guarded(work) == 70
    *traceback, line = capsys.readouterr().err.splitlines()
    assert 'Traceback' in traceback[0] and 'a defect' in traceback[-1]
    assert line.startswith('bellows: This is a defect') and 'please report it' in line


def test_the_progress_line_says_that_a_kernel_is_compiled(monkeypatch):
    """Name it beside the stage, once, until the next stage; say nothing where nothing compiles."""
    monkeypatch.setattr(jit, 'announce', jit.announce)
    monkeypatch.setenv('TERM', 'xterm')
    stream = Terminal()
    with Console(io.StringIO(), stream, []).progress as progress:
        progress('fitting', 0.5)
        before = stream.getvalue()
        jit.announce()
        jit.announce()
        during = stream.getvalue().removeprefix(before)
        progress('validating')
    assert 'compiling' not in before and during.count('fitting; compiling') == 1
    assert 'compiling' not in stream.getvalue().removeprefix(before + during)


@pytest.mark.skipif(not jit.COMPILED, reason='nothing is compiled without numba')
def test_a_kernel_that_is_not_on_disk_is_announced(monkeypatch, tmp_path):
    """Call back before a kernel is compiled, not when it is called again, or is on disk."""
    def plus(x):
        return x + 1.5

    told: list[bool] = []
    monkeypatch.setattr(jit, 'announce', lambda: told.append(True))
    monkeypatch.setattr('numba.config.CACHE_DIR', str(tmp_path))
    for _ in range(2):
        kernel = jit.kernel(plus)
        assert kernel(1.0) == kernel(1.0) == 2.5 and len(told) == 1
