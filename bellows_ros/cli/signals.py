"""Signals: those that end a command end it in order, and none divides finished work."""

from collections.abc import Iterator
from contextlib import contextmanager
import signal
import threading
from types import FrameType
from typing import NoReturn

ENDING = (signal.SIGTERM, signal.SIGHUP)


class Ended(BaseException):
    """A signal has asked this process to end; raised wherever the work is, as Ctrl-C is."""

    def __init__(self, number: int) -> None:
        """Remember which one."""
        super().__init__(number)
        self.name = signal.Signals(number).name
        self.exit_code = 128 + number


@contextmanager
def ended_in_order() -> Iterator[None]:
    """
    Let the signals that would end this process at once raise `Ended`, so that all is removed.

    Once, as they often come twice, to a process and to its group: the second must not stop that.
    """
    def end(number: int, frame: FrameType | None) -> NoReturn:
        for each in taken:
            signal.signal(each, signal.SIG_IGN)
        raise Ended(number)

    in_main = threading.current_thread() is threading.main_thread()
    taken = [n for n in ENDING if in_main and signal.getsignal(n) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, end)
    try:
        yield
    except Ended:
        taken.clear()  # they stay ignored: what is left is to clean up
        raise
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Put these signals and Ctrl-C off while finished work is written: all of it or nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {n: signal.signal(n, lambda *_: None) for n in (signal.SIGINT, *ENDING)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
