"""
Spin a node: woken by each message, with garbage collection between messages.

An executor of rclpy that waits builds the list of everything it waits for anew after each
callback, which takes more time than the callback itself; one that is woken by events does not.
`docs/performance.md` has the numbers of both.
"""

from collections.abc import Callable
from contextlib import suppress
import gc
import time
from typing import Any

from rclpy.executors import SingleThreadedExecutor

LONGEST_WAIT = 0.1
"""A request to end is noticed within this time (s)."""

COLLECT_EVERY = 1.0
"""Time (s) between two runs of the garbage collector."""


def executor_for(node: Any) -> Any:
    """
    Return an executor for a node, woken by events if possible.

    It came with rclpy 7.1.4. It takes no guard conditions, and not every middleware can call back;
    it says so with a RuntimeError as soon as it is spun.
    """
    with suppress(ImportError):
        from rclpy.experimental.events_executor import EventsExecutor

        woken = EventsExecutor(context=node.context)
        woken.add_node(node)
        try:
            woken.spin_once(timeout_sec=0.0)
            return woken
        except RuntimeError:
            woken.shutdown()
    waiting = SingleThreadedExecutor(context=node.context)
    waiting.add_node(node)
    return waiting


def spin(node: Any, is_asked_to_stop: Callable[[], bool]) -> None:
    """
    Let a node work until it has finished or is asked to stop, and close it.

    What exists at the beginning is never looked at by the collector again, and it runs only here,
    between two callbacks, never within one. `EventsExecutor.spin` is not used: it would not let
    Python see a signal, and never calls back where the C++ library overflows on an endless wait.

    Parameters
    ----------
    node : rclpy.node.Node
        With a future `finished`, whose exception is raised here, and methods `close` and
        `note_failure`.
    is_asked_to_stop : callable
        Looked at after each callback, and every `LONGEST_WAIT`.

    """
    executor = executor_for(node)
    gc.collect()
    gc.freeze()
    gc.disable()
    due = time.monotonic() + COLLECT_EVERY
    try:
        while not (is_asked_to_stop() or node.finished.done()):
            try:
                executor.spin_once(timeout_sec=LONGEST_WAIT)
            except Exception as error:  # noqa: BLE001 (of rclpy's own callbacks: the node goes on)
                if not node.context.ok():
                    raise
                node.note_failure(error)
            if time.monotonic() > due:
                gc.collect()
                due = time.monotonic() + COLLECT_EVERY
        if node.finished.done():
            node.finished.result()
    finally:
        gc.enable()
        gc.unfreeze()
        executor.shutdown()
        node.close()
