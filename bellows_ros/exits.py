"""Exit codes of the command line: errors and signals end with a message and a code."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
import errno
from io import TextIOWrapper
import os
import signal
import sys
import time
import traceback
from typing import Any, TYPE_CHECKING

from bellows_ros.errors import BellowsError, CRASHED, NotSetError, shown
from bellows_ros.version import __version__
import click

if TYPE_CHECKING:
    from types import FrameType

OK, NOT_USABLE, USER_ERROR = 0, 1, 2
EXIT_CODES: Mapping[int, str] = {
    OK: 'done', NOT_USABLE: 'done, with a negative result; see the command',
    USER_ERROR: 'error: the message says what to correct; every output file is whole',
    CRASHED: 'crash: a defect of this package; please report it',
    130: 'interrupted with Ctrl-C, 143 ended by SIGTERM; every output file is whole'}

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TWICE = 0.5
"""Time within which two signals count as one, s: both often come, and one cleanup is enough."""

UNWRITABLE = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EPIPE))
"""Errors of a stream that cannot be written; errors of files are a BellowsError."""


class Stopped(KeyboardInterrupt):
    """
    Exception for a received signal.

    It is a subclass, since CPython ends a process with -SIGINT, regardless of its exit code, if
    KeyboardInterrupt itself passes through an exec(), as in the definition of a dataclass.
    """


@contextmanager
def stopped_by_signals() -> Iterator[list[int]]:
    """
    Raise `Stopped` at a signal, so that temporary files are removed; give the signals.

    What it interrupts in callbacks, for example while numba loads stored code, is not printed.
    """
    received, last = list[int](), -TWICE

    def stop(number: int, frame: 'FrameType | None') -> None:
        nonlocal last
        received.append(number)
        before, last = last, time.monotonic()
        if last - before > TWICE:
            raise Stopped

    show = sys.unraisablehook

    def show_unless_stopped(lost: 'sys.UnraisableHookArgs') -> None:
        if not received:
            show(lost)

    previous = {number: signal.signal(number, stop) for number in STOP_SIGNALS
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)}
    sys.unraisablehook = show_unless_stopped
    try:
        yield received
    finally:
        sys.unraisablehook = show
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_IGN if received else handler)


def guarded(work: Callable[[], int]) -> int:
    """
    Do some work; return the exit code, with a message for an error or a signal.

    After a signal every exception counts as this interruption, because compiled code converts it
    to other exceptions, and an exception in a callback of a library is lost.
    """
    if isinstance(sys.stdout, TextIOWrapper):  # for characters outside the encoding, as stderr
        sys.stdout.reconfigure(errors='backslashreplace')
    received = list[int]()
    try:
        with stopped_by_signals() as received:
            try:
                code = work()
                sys.stdout.flush()  # now, as an error at the very end could not be reported
            except BaseException as error:  # noqa: B902, BLE001 (of compiled code too)
                if not (received or isinstance(error, KeyboardInterrupt)):
                    return _code_of(error)
                received.append(signal.SIGINT)
    except KeyboardInterrupt:  # while an error is reported, or the handlers are restored
        received.append(signal.SIGINT)
    if not received:
        return code
    how = 'Interrupted' if received[0] == signal.SIGINT else (
        f'Ended by {signal.Signals(received[0]).name}')
    _say(f'{how}; every output file is whole, the old or the new one.')
    return 128 + received[0]


def _code_of(error: BaseException) -> int:
    """Print an error; return its exit code."""
    if isinstance(error, click.exceptions.Exit):
        return error.exit_code
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else 'bellows'
        _say(f'{path}: {error.format_message()}\nSee {path} --help.')
        return USER_ERROR
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # also at the very end
        if isinstance(error, BrokenPipeError):  # the reader of the output has closed it
            return 141  # exit code of SIGPIPE in a shell
        _say(f'bellows: The output cannot be written: {error.strerror}. Write elsewhere.')
        return USER_ERROR
    if not isinstance(error, Exception):
        raise error
    jit: Any = sys.modules.get('bellows_ros.core.geometry.jit')
    damaged = jit and jit.damage(error)
    if damaged or isinstance(error, BellowsError):
        from bellows_ros.report.console import Console

        Console().error(damaged or str(error))
        if isinstance(error, NotSetError):
            _say('Give the file with --params FILE, or a value with --set NAME=VALUE.')
        return getattr(error, 'exit_code', USER_ERROR)
    traceback.print_exception(error)
    _say(f'bellows: This is a defect of bellows_ros {__version__}: please report it, with the '
         'command and the lines above.')
    return CRASHED


def _say(text: str) -> None:
    """Print a message with words of the command line on stderr, if it can be written."""
    with suppress(OSError):
        click.echo(shown(text, 2500, '\n'), err=True)
