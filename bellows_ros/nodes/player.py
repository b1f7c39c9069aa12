"""Send messages when they are due, and receive meanwhile: shared by the players."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import gc
import time

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

LAST_MOMENT = 200e-6
"""So long (s) before a message is due nothing else is done."""

LEAD_TIME = 0.2
"""Time (s) from the start to the first message."""

Send = tuple[float, Callable[[], None]]
"""When (s after the first one) something is sent, and what sends it."""


def send_all(
    executor: SingleThreadedExecutor,
    plan: Sequence[Send],
    say: Callable[[str, float], None],
) -> list[float]:
    """
    Send everything when it is due.

    Parameters
    ----------
    executor : SingleThreadedExecutor
        Spun while nothing is due.
    plan : sequence of Send
        In the order of their times.
    say : callable
        Called once a second with what is being done and the part (0 to 1) that is done.

    Returns
    -------
    list of float
        By how much each was sent later than due, s.

    """
    lateness: list[float] = []
    duration = plan[-1][0]
    start = time.monotonic() + LEAD_TIME
    shown = 0.0
    with _no_collection():
        for due, send in plan:
            if due > shown:
                say('playing the recording', due / duration)
                shown += 1.0
            _spin_until(executor, start + due)
            lateness.append(time.monotonic() - start - due)
            send()
    return lateness


@contextmanager
def ros() -> Iterator[tuple[Context, SingleThreadedExecutor]]:
    """Provide a ROS context of its own and an executor."""
    context = Context()
    rclpy.init(args=[], context=context)
    executor = SingleThreadedExecutor(context=context)
    try:
        yield context, executor
    finally:
        executor.shutdown()
        context.try_shutdown()


def _spin_until(executor: SingleThreadedExecutor, due: float) -> None:
    """Receive until a message is due (s, monotonic)."""
    while (left := due - time.monotonic()) > LAST_MOMENT:
        executor.spin_once(timeout_sec=left - LAST_MOMENT)
    while time.monotonic() < due:
        pass


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep the garbage collector from striking between two messages."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
