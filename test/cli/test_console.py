"""Tables and numbers as the commands print them, and commands that are ended from outside."""

from contextlib import suppress
import errno
import io
import math
import os
import signal
import subprocess
import sys
import time

from bellows_ros.cli.console import aligned, Console, run_guarded, STOP_SIGNALS, TWICE
from bellows_ros.core.geometry import jit
from bellows_ros.errors import BellowsError
from bellows_ros.files.atomic import PREFIX
from bellows_ros.report.text import column, with_error
import pytest

from .conftest import contents, MOTION, write_yaml

ROWS = [['axis', *(f'column {k}' for k in range(8))]] + [
    [axis, *(f'{k * 1000.5:g}' for k in range(8))] for axis in ('x', 'y')]


@pytest.mark.parametrize('right', [False, True])
def test_a_table_fits_a_narrow_terminal_with_all_cells(right, monkeypatch):
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


@pytest.mark.parametrize('error', [ZeroDivisionError('a defect'), OSError(22, 'a defect')])
def test_a_crash_has_its_own_exit_code_and_asks_for_a_report(error, capsys):
    """Do not end with 1, which says no; keep the traceback, then one line."""
    def work(console):
        raise error

    assert run_guarded(work) == 70
    *traceback, line = capsys.readouterr().err.splitlines()
    assert 'Traceback' in traceback[0] and 'a defect' in traceback[-1]
    assert line.startswith('bellows: This is a defect') and 'please report it' in line


@pytest.mark.parametrize('is_new', [True, False])
def test_the_progress_line_says_that_nothing_is_compiled_yet(is_new, monkeypatch):
    monkeypatch.setattr(jit, 'IS_NEW', is_new)
    monkeypatch.setenv('TERM', 'xterm')
    stream = Terminal()
    with Console(io.StringIO(), stream, []).progress as progress:
        progress('fitting', 0.5)
    assert ('fitting; compiling' in stream.getvalue()) is is_new


WITHIN = 600.0  # s, for what comes at once on a machine that is not busy


def start(environment, *arguments, cwd):
    """Start `bellows` in a session of its own, with pipes that only its processes hold."""
    return subprocess.Popen(
        [sys.executable, '-m', 'bellows_ros.cli', *map(str, arguments)], cwd=cwd, text=True,
        env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True)


def wait_until_hidden(folder, process):
    """Wait until a process has begun to write in a folder."""
    deadline = time.monotonic() + WITHIN
    while time.monotonic() < deadline and process.poll() is None:
        if any(folder.glob(f'{PREFIX}*')):
            return
        time.sleep(0.002)
    pytest.fail(f'nothing was written in {folder}: {process.communicate()}')


@pytest.fixture
def handlers():
    """Restore the handlers of signals."""
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(('number', 'said'), [
    (signal.SIGHUP, 'Ended by SIGHUP'), (signal.SIGINT, 'Interrupted')])
def test_a_signal_ends_in_order(number, said, workshop, tmp_path, user_environment):
    """Say so, end with 128 and its number, and leave what was there; twice is as good as once."""
    motion = write_yaml(tmp_path / 'long.yaml', {**MOTION, 'duration': 150.0})
    before = contents(tmp_path)
    process = start(user_environment, 'simulate', '--params', workshop / 'cup.yaml',
                    '--motion', motion, '--out', tmp_path / 'long', cwd=workshop)
    wait_until_hidden(tmp_path, process)
    os.killpg(process.pid, number)
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=WITHIN)
    assert process.returncode == 128 + number
    assert out == '' and err == f'{said}; every output file is whole, the old or the new one.\n'
    assert contents(tmp_path) == before


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_whose_exception_is_lost_ends_at_the_next_output(number, capsys, handlers):
    """As where it comes in a callback that a library made."""
    def work(console):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        console.line('It goes on.')
        return 0

    assert run_guarded(work) == 128 + number
    out, err = capsys.readouterr()
    assert out == '' and 'every output file is whole' in err


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize('error', [
    SystemError('CPUDispatcher(whiten)'), BellowsError('wrong'), OSError(5, 'stream'),
    BrokenPipeError(32, 'pipe'), ValueError('a defect'), SystemExit(1), MemoryError()], ids=repr)
def test_after_a_signal_every_exception_is_that_interruption(number, error, capsys, handlers):
    """Compiled code turns the exception of a signal into another one."""
    def work(console):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        raise error

    assert run_guarded(work) == 128 + number
    assert 'defect' not in capsys.readouterr().err


class Unwritable(io.RawIOBase):
    """A device that takes nothing, for one reason."""

    def __init__(self, number, descriptor):
        super().__init__()
        self._number, self._descriptor = number, descriptor

    def writable(self):
        return True

    def fileno(self):
        return self._descriptor

    def write(self, data):
        raise OSError(self._number, os.strerror(self._number))


def stops(console):
    """Receive a signal and go on."""
    with suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)
    console.line('more')


def fails(console):
    """End with an error."""
    raise BellowsError('It is wrong.')


@pytest.mark.parametrize('number', [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG])
@pytest.mark.parametrize('unwritable', [('stdout',), ('stderr',), ('stdout', 'stderr')])
@pytest.mark.parametrize('work, code', [
    (lambda console: console.line('a result') or 0, 2), (fails, 2), (stops, 143)],
    ids=['result', 'error', 'signal'])
def test_a_stream_that_cannot_be_written_has_one_code(
        number, unwritable, work, code, monkeypatch, tmp_path, handlers):
    """Neither the code of a negative result nor that of a defect, and nothing fails at the end."""
    streams, raws = {}, {}
    for name in ('stdout', 'stderr'):
        file = (tmp_path / name).open('wb', 0)
        raws[name] = Unwritable(number, file.fileno()) if name in unwritable else file
        streams[name] = io.TextIOWrapper(
            io.BufferedWriter(raws[name]), line_buffering=name == 'stderr')
        monkeypatch.setattr(sys, name, streams[name])
    found = run_guarded(work)
    monkeypatch.undo()
    for name in unwritable:  # what is left in its buffer
        raws[name].write = len
    assert found == (code if work in (fails, stops) or 'stdout' in unwritable else 0)


def test_a_signal_within_an_exec_has_its_code(user_environment, tmp_path):
    """What runs as `python -m` would end with -2: CPython remembers a KeyboardInterrupt there."""
    (tmp_path / 'ended.py').write_text(
        'import signal, sys\nfrom bellows_ros.cli.console import run_guarded\n'
        'sys.exit(run_guarded(lambda _: exec("signal.raise_signal(signal.SIGHUP)")))\n')
    done = subprocess.run([sys.executable, '-m', 'ended'], env=user_environment, text=True,
                          cwd=tmp_path, stderr=subprocess.PIPE)
    assert done.returncode == 128 + signal.SIGHUP and 'Ended by SIGHUP' in done.stderr


def test_ctrl_c_again_ends_what_the_first_one_did_not(capsys, handlers):
    """Twice at once is once, also while the command cleans up."""
    cleaned = list[bool]()

    def work(console):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)
            cleaned.append(True)
            time.sleep(1.1 * TWICE)
            signal.raise_signal(signal.SIGINT)
            cleaned.append(False)

    assert run_guarded(work) == 128 + signal.SIGINT
    signal.raise_signal(signal.SIGINT)  # nothing is left to interrupt
    assert cleaned == [True] and capsys.readouterr().err.startswith('Interrupted')


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='there is no /dev/full here')
@pytest.mark.parametrize('option', ['--yaml', '--help'])
def test_a_full_device_is_one_sentence(option, user_environment):
    """Exit with 2, not with the code of a negative result."""
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'bellows_ros.cli', 'parameters', option], text=True,
            env=user_environment, stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert 'No space left on device' in done.stderr and 'Traceback' not in done.stderr
