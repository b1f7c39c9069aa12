"""
Output, exit codes and signals of the commands.

Results go to one stream, everything else to stderr. Colour is used only on terminals, unless
NO_COLOR is set or TERM is dumb. SIGINT, SIGTERM and SIGHUP end a command after the removal of its
temporary files, with a message and the exit code of the signal.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import errno
from io import TextIOWrapper
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
import time
import traceback
from types import FrameType
from typing import Any, TextIO
import warnings

from bellows_ros.errors import BellowsError, CRASHED, NotSetError, shown, UnitWarning
from bellows_ros.version import __version__

# Exit codes.
OK = 0
NOT_USABLE = 1
USER_ERROR = 2
STDOUT = '-'
"""Name of standard output, as in `files.atomic`."""

WIDTH = 79
MAX_TEXT = 100_000
"""Longest printed text, characters; every result is shorter."""
GUTTER = 2
"""Space between columns of a table, characters."""
BAR = 24  # characters
CLEAR_LINE = '\r\x1b[2K'
STYLES: Mapping[str, str] = {'bold': '1', 'dim': '2', 'red': '31', 'yellow': '33', 'green': '32'}


class Output(str):
    """Name of a text file to write, '-' for stdout. Names of input files have the type Path."""


class Binary(Output):
    """The name of a binary file to write."""


class Folder(Binary):
    """The name of a folder to write."""


class Console:
    """
    Print results, notes and errors.

    Parameters
    ----------
    out : text stream
        Stream for the requested output.
    err : text stream
        Stream for notes, warnings, errors and progress.

    Attributes
    ----------
    final_warnings : list of str
        Warnings printed after the work.
    asked : list of str
        Questions already printed about implausible values of package or cup.
    progress : Progress
        Progress of the work, on stderr.

    """

    def __init__(self, out: TextIO, err: TextIO, signals: Sequence[int] = ()) -> None:
        """Store the streams and the list of received signals."""
        self._out, self._err, self._signals = out, err, signals
        self._gap = self._begun = False
        self.final_warnings: list[str] = []
        self.asked: list[str] = []
        self.progress = Progress(self, err)

    def keep_stdout_free(self) -> None:
        """Print results on stderr from now on, as stdout takes a file's content."""
        self._out = self._err

    def require_no_signal(self) -> None:
        """Exit if a signal was received whose exception was lost."""
        if self._signals:
            raise KeyboardInterrupt

    def line(self, text: str = '', style: str = '') -> None:
        """Print a line of the result. Empty lines are never printed twice, or first."""
        if not text:
            self._gap = self._begun
            return
        self.require_no_signal()
        self._close_gap()
        self._begun = True
        print(self._styled(self._out, printable(text), style), file=self._out, flush=True)

    def _close_gap(self) -> None:
        """Print a pending empty line."""
        if self._gap:
            print(file=self._out)
        self._gap = False

    def paragraph(self, *texts: str, style: str = '') -> None:
        """Print sentences of the result, wrapped, each optionally with its indentation."""
        for text in texts:
            indent = text[:len(text) - len(text.lstrip())]
            for line in _wrapped(text.strip(), indent, 2 * indent):
                self.line(line, style)

    def table(self, rows: Sequence[Sequence[str]], right: bool = False, title: str = '') -> None:
        """Print rows in columns between empty lines, optionally right-aligned except the first."""
        self.line()
        if title:
            self.line(title, 'bold')
        for line in aligned(rows, right):
            self.line(f'  {line}'.rstrip())
        self.line()

    def warn(self, *texts: str) -> None:
        """Print warnings, except the questions in `asked`."""
        for text in texts:
            for line in () if text in self.asked else _wrapped(f'Warning: {text}', '', '  '):
                self._write_error(self._styled(self._err, printable(line), 'yellow'))

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Print each question about implausible values once, as soon as the values are read."""
        show = warnings.showwarning

        def ask(message: Any, category: type[Warning], *more: Any, **options: Any) -> None:
            if category is not UnitWarning:
                show(message, category, *more, **options)
            elif str(message) not in self.asked:
                self.progress.clear()
                self.warn(str(message))
                self.asked.append(str(message))

        with warnings.catch_warnings():
            warnings.simplefilter('always', UnitWarning)
            warnings.showwarning = ask
            yield

    def note(self, text: str) -> None:
        """Print a note that is not part of the result."""
        self._write_error(printable(text, '\n'))

    def error(self, text: str) -> None:
        """Print an error."""
        lines = f'bellows: {printable(text, chr(10))}'.splitlines()
        if _is_terminal(self._err):  # elsewhere a message is one line, for searching
            lines = [part for line in lines for part in (
                [line] if line[:1] in ('', ' ', '/') else _wrapped(line, '', ''))]
        head, _, rest = '\n'.join(lines).partition(' ')
        self._write_error(f'{self._styled(self._err, head, "red")} {rest}')

    def _write_error(self, text: str) -> None:
        """Print on stderr, in order if both streams have one target."""
        self._close_gap()
        self._out.flush()
        print(text, file=self._err)

    def _styled(self, stream: TextIO, text: str, style: str) -> str:
        """Return a string in a style, if the stream supports it."""
        shown = style and _is_terminal(stream) and not os.environ.get('NO_COLOR')
        return f'\x1b[{STYLES[style]}m{text}\x1b[0m' if shown else text


COMPILING = '; compiling, once on this machine'
"""Suffix of the stage's name on a machine without compiled code."""


class Progress:
    """One line with the current stage, a bar, and the remaining time."""

    def __init__(self, console: Console, stream: TextIO) -> None:
        self._console, self._stream, self._shown = console, stream, _is_terminal(stream)
        self._start, self._next, self._stage = 0.0, 0.0, ''

    def __enter__(self) -> 'Progress':
        """Start the clock."""
        self._start = time.monotonic()
        return self

    def __call__(self, stage: str, fraction: float | None = None) -> None:
        """Show a stage and, if known, the completed fraction of the whole work."""
        self._console.require_no_signal()
        now = time.monotonic()
        if not self._shown or (now < self._next and stage == self._stage):
            return
        self._next, self._stage = now + 0.1, stage  # s
        jit: Any = sys.modules.get('bellows_ros.core.geometry.jit')  # of commands that compute
        stage += COMPILING if jit and jit.IS_NEW else ''
        width = shutil.get_terminal_size().columns - 1
        line = progress_line(stage, fraction, now - self._start)
        shown = line if len(line) <= width else stage  # the stage matters more than the bar
        self._stream.write(CLEAR_LINE + printable(shown)[:width])
        self._stream.flush()

    def clear(self) -> None:
        """Clear the line on the terminal."""
        if self._shown and self._stage:
            self._stream.write(CLEAR_LINE)
            self._stream.flush()
        self._stage = ''

    def __exit__(self, *_: object) -> None:
        """End the work."""
        self.clear()


def progress_line(stage: str, fraction: float | None, elapsed: float) -> str:
    """Return a line with a bar, and the remaining time (s) unless included in the stage."""
    if fraction is None:
        return f'{stage} ...'
    done = min(max(fraction, 0.0), 1.0)
    full = round(done * BAR)
    is_known = done > 0.05 and elapsed > 1.0 and ' left' not in stage
    remaining = f', {elapsed * (1.0 - done) / done:.0f} s left' if is_known else ''
    return f'[{"#" * full}{"-" * (BAR - full)}] {done:4.0%}  {stage}{remaining}'


def printable(text: str, allowed: str = '') -> str:
    """Escape the control characters of a string, as names may be hostile; write -0.0 as 0.0."""
    text = re.sub(r'(?<![\w.+-])-(?=0(?:\.0+)?(?![\d.eE]))', '', text)
    return shown(text, MAX_TEXT, allowed)


def _is_terminal(stream: TextIO) -> bool:
    """Return whether a stream is a terminal that can move its cursor."""
    return stream.isatty() and os.environ.get('TERM') != 'dumb'


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    """Return indented lines with the width of the terminal, up to a readable maximum."""
    width = max(min(WIDTH, shutil.get_terminal_size((WIDTH, 0)).columns), 40)
    return textwrap.wrap(text, width, initial_indent=first, subsequent_indent=rest,
                         break_long_words=False, break_on_hyphens=False)


def aligned(rows: Sequence[Sequence[str]], right: bool = False) -> list[str]:
    """
    Return rows as lines with aligned columns, all but the first right-aligned.

    On a narrow terminal the columns are split into blocks; each block begins with the first
    column.
    """
    room = shutil.get_terminal_size((0, 0)).columns - 2  # indented
    columns = [
        [f'{cell:{">" if right and number else "<"}{max(map(len, cells))}}' for cell in cells]
        for number, cells in enumerate(zip(*rows, strict=True))]
    blocks = [columns[:1]]
    for column in columns[1:]:
        used = sum(len(each[0]) + GUTTER for each in blocks[-1])
        if len(blocks[-1]) > 1 and 0 < room < used + len(column[0]):
            blocks.append(columns[:1])
        blocks[-1].append(column)
    return [(GUTTER * ' ').join(cells).rstrip()
            for block in blocks for cells in zip(*block, strict=True)]


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TWICE = 0.5  # s, within which two signals count as one


class Stopped(KeyboardInterrupt):
    """
    Exception for a received signal.

    It is a subclass, since CPython ends a process with -SIGINT, regardless of its exit code, if
    KeyboardInterrupt itself passes through an exec(), as in the definition of a dataclass.
    """


def run_guarded(work: Callable[[Console], int]) -> int:
    """
    Do some work with the streams of this process; return the exit code.

    An error ends the work with a message. A signal raises the exception of Ctrl-C, so that
    temporary files are removed. After a signal, every exception counts as this interruption,
    because compiled code converts it to other exceptions. Only the first signal raises: signals
    often come twice, and the second must not stop the cleanup. Signals are also recorded, because
    an exception in a callback of a library is lost; the command then ends at its next output.
    """
    ended = list[int]()
    first = 0.0
    if isinstance(sys.stdout, TextIOWrapper):  # as stderr does with what its encoding lacks
        sys.stdout.reconfigure(errors='backslashreplace')
    console = Console(sys.stdout, sys.stderr, ended)

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal first
        now = time.monotonic()
        first = first if ended else now
        # for characters outside the encoding, as stderr
        if not ended or number == signal.SIGINT and now - first > TWICE:
            ended.append(number)
            raise Stopped

    def report_unraisable(what: Any) -> None:
        if not (ended and issubclass(what.exc_type, KeyboardInterrupt)):
            sys.__unraisablehook__(what)

    in_main = threading.current_thread() is threading.main_thread()
    handled = [number for number in STOP_SIGNALS if in_main and signal.getsignal(number) in (
        signal.SIG_DFL, signal.default_int_handler)]
    before = {number: signal.signal(number, end) for number in handled}
    unraisable, sys.unraisablehook = sys.unraisablehook, report_unraisable
    try:
        return _run_guarded(work, console, ended)
    except OSError as error:
        return _unwritable(error, console, ended)
    finally:
        sys.unraisablehook = unraisable
        for number in handled if not ended else ():  # ignored during the cleanup
            signal.signal(number, before[number])


def _run_guarded(work: Callable[[Console], int], console: Console, ended: Sequence[int]) -> int:
    """Do some work, and print the reason of its end; return the exit code."""
    try:
        code = work(console)
        sys.stdout.flush()  # now, as an error at the very end could not be reported
        console.require_no_signal()
        return code
    except BaseException as error:  # noqa: B902 (of compiled code too, once a signal has come)
        if ended or isinstance(error, KeyboardInterrupt):
            return _interrupted(console, ended)
        if isinstance(error, BellowsError):
            console.error(str(error))
            if isinstance(error, NotSetError):
                console.note('Give the file with --params FILE, or a value with --set NAME=VALUE.')
            return error.exit_code
        if not isinstance(error, Exception) or _of_stream(error):
            raise
        jit: Any = sys.modules.get('bellows_ros.core.geometry.jit')
        if damaged := jit and jit.damage(error):
            console.error(damaged)
            return USER_ERROR
        console.note(traceback.format_exc().rstrip())
        console.error(
            f'This is a defect of bellows_ros {__version__}: please report it, with the command '
            'and the lines above.')
        return CRASHED


def _unwritable(error: OSError, console: Console, ended: Sequence[int]) -> int:
    """Print that a stream cannot be written, if the error says so; return the exit code."""
    if not _of_stream(error):
        raise error
    _discard(sys.stdout)
    if ended:
        return _interrupted(console, ended)
    if isinstance(error, BrokenPipeError):  # the reader of the output has closed it
        return 141  # exit code of SIGPIPE in a shell
    with _lost_if_unwritable():
        console.error(f'The output cannot be written: {error.strerror}. Write elsewhere.')
    return USER_ERROR


def _interrupted(console: Console, ended: Sequence[int]) -> int:
    """Print that a signal has ended the work, and return the exit code of the signal."""
    for each in STOP_SIGNALS if ended else ():  # only the message remains
        signal.signal(each, signal.SIG_IGN)
    number = (*ended, signal.SIGINT)[0]
    how = 'Interrupted' if number == signal.SIGINT else (
        f'Ended by {signal.Signals(number).name}')
    with _lost_if_unwritable():
        console.note(f'{how}; every output file is whole, the old or the new one.')
    return 128 + number


UNWRITABLE = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EPIPE))
"""Errors of a stream that cannot be written; errors of files are a BellowsError."""


def _of_stream(error: BaseException) -> bool:
    """Return whether an output stream cannot be written."""
    return isinstance(error, OSError) and error.errno in UNWRITABLE


@contextmanager
def _lost_if_unwritable() -> Iterator[None]:
    """Omit the last message if stderr cannot be written either."""
    try:
        yield
        sys.stderr.flush()
    except OSError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    """Discard further output, also at the end of the process."""
    with suppress(OSError):
        stream.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
