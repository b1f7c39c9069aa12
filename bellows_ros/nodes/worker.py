"""A thread beside the live prediction, which works on the newest request of each kind."""

from collections.abc import Callable
from functools import partial
from threading import Condition, Thread
from typing import Any

import numpy as np

from .guarding import GuardedNode
from ..core.geometry.arrays import Mask

PATIENCE = 0.25
"""How long (s) to wait for the end of work that was stopped; a compiler does not hear of it."""


class Worker:
    """
    Work on requests one after the other, beside the live prediction.

    Parameters
    ----------
    node : GuardedNode
        Notes what fails.
    name : str
        Of the thread.

    Attributes
    ----------
    stop : array (1,) of bool
        For the running work: true once its result is not wanted any more.

    """

    def __init__(self, node: GuardedNode, name: str) -> None:
        """Start the thread, which does not keep the process from ending."""
        self._guarded = node.guarded
        self._waiting: dict[object, Callable[[], None]] = {}
        self._running: object = None
        self._is_closed = False
        self._changed = Condition()
        self.stop: Mask = np.zeros(1, np.bool_)
        Thread(target=self._work, name=name, daemon=True).start()

    @property
    def is_busy(self) -> bool:
        """Whether something is being worked on, or waits."""
        return bool(self._waiting) or self._running is not None

    def waiting(self, kind: type) -> int:
        """Return how many requests wait whose kind is of a type."""
        return sum(isinstance(each, kind) for each in list(self._waiting))

    def submit(self, kind: object, work: Callable[..., None], *arguments: Any) -> None:
        """Work on a request; it replaces one of its kind, whether that waits or is worked on."""
        with self._changed:
            if self._running == kind:
                self.stop[0] = True
            self._waiting[kind] = self._guarded(partial(work, *arguments))
            self._changed.notify_all()

    def forget(self) -> None:
        """Drop what waits, and stop what is worked on."""
        with self._changed:
            self._waiting.clear()
            self.stop[0] = True
            self._changed.wait_for(lambda: self._running is None, PATIENCE)

    def close(self) -> None:
        """End the thread."""
        self._is_closed = True
        self.forget()
        with self._changed:
            self._changed.notify_all()

    def _work(self) -> None:
        """Do what is asked for, in the order of first requests."""
        while True:
            with self._changed:
                self._running = None
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._is_closed)
                if self._is_closed:
                    return
                self._running = next(iter(self._waiting))
                work = self._waiting.pop(self._running)
                self.stop = np.zeros(1, np.bool_)
            work()
