"""
A node and a worker thread that survive exceptions in callbacks: logged once, then counted.

Each message wakes the node; the garbage is collected between messages. The usual executor of rclpy
rebuilds its list of entities after each callback, which takes longer than the callback; an
executor that is woken by events does not.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial, wraps
import gc
from pathlib import Path
from threading import Condition, Thread, Timer
import time
import traceback
from typing import Any

import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock

from ..core.geometry.arrays import Mask
from ..errors import shown
from ..report import health

PACKAGE = Path(__file__).parents[1]

OVERRIDABLE = (
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY)
"""QoS that parameters can override; durability is among them for vacuum switches with rare
messages."""


COMPILE_TIME = 1.0
"""Shortest time of work that compiles, s."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS with which late subscribers get the newest message."""


class GuardedNode(Node):
    """
    A node whose callbacks may fail.

    Attributes
    ----------
    failures : collections.Counter
        Number of failures by place in the code.
    workers : list of Worker
        Threads of the node.

    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Create the node; rclpy creates its first subscriptions here."""
        self.failures: Counter[str] = Counter()
        self.workers: list[Worker] = []
        self._without_frame: set[str] = set()
        super().__init__(*arguments, **options)

    def note_failure(self, error: Exception, place: str = '') -> None:
        """Count an exception by its place, by default its line of code; log the first one."""
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if PACKAGE in Path(frame.filename).parents]
        innermost = (ours[1:] or frames)[-1]  # the first of ours is the guard itself
        place = place or f'{Path(innermost.filename).name}:{innermost.lineno}'
        self.failures[place] += 1
        if self.failures[place] > 1:
            return
        with suppress(Exception):  # a failure of logging must not end the node either
            self.get_logger().error(
                f'A callback failed at {place}: {type(error).__name__}: {shown(str(error))}. The '
                'node continues, and only counts further failures there. Please report it, with '
                'the traceback from --log-level debug.')
            self.get_logger().debug(''.join(traceback.format_exception(error)))

    def note_frame(self, frame_id: str, topic: str, meaning: str) -> None:
        """Warn once about messages without a frame."""
        if not frame_id and topic not in self._without_frame:
            self._without_frame.add(topic)
            self.get_logger().warning(health.say('inputs.no_frame', topic=topic, meaning=meaning))

    def guarded(
        self, callback: Callable[..., Any], otherwise: Callable[[], Any] = lambda: None
    ) -> Callable[..., Any]:
        """Return a callback that records its exceptions and then returns a substitute."""
        @wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:  # noqa: BLE001 (nothing may end the node)
                self.note_failure(error)
                return otherwise()

        return call

    @contextmanager
    def noticed(self, text: str) -> Iterator[None]:
        """Log a text if the work takes so long that something was compiled."""
        notice = Timer(COMPILE_TIME, self.get_logger().info, (text,))
        notice.start()
        try:
            yield
        finally:
            notice.cancel()

    def in_background(self, work: Callable[[], None]) -> None:
        """Run long work, such as compilation, in a thread that ends with the process."""
        Thread(target=self.guarded(work), daemon=True).start()

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *more: Any,
        on_publishers: Callable[[int], None] | None = None, **options: Any
    ) -> Any:
        """
        Subscribe with a callback that may fail, and QoS that can be overridden.

        A second callback may receive the number of matching publishers when it changes. rclpy also
        subscribes to the clock by this function.
        """
        if on_publishers:
            options['event_callbacks'] = SubscriptionEventCallbacks(
                matched=self.guarded(lambda matched: on_publishers(matched.current_count)))
        if msg_type is not Clock:
            options['qos_overriding_options'] = QoSOverridingOptions(OVERRIDABLE)
        return super().create_subscription(
            msg_type, topic, self.guarded(callback), *more, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any
    ) -> Any:
        """Serve with a callback that may fail; it then answers with an empty response."""
        callback = self.guarded(callback, srv_type.Response)
        return super().create_service(srv_type, srv_name, callback, **options)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], Any], *more: Any, **options: Any
    ) -> Any:
        """Start a timer with a callback that may fail."""
        return super().create_timer(timer_period_sec, self.guarded(callback), *more, **options)


class Worker:
    """
    A thread that processes requests one after the other, during the live prediction.

    Parameters
    ----------
    node : GuardedNode
        Node that records failures, and closes its workers.
    name : str
        Name of the thread.

    Attributes
    ----------
    stop : array (1,) of bool
        Flag for the running work, true once its result is obsolete.

    """

    def __init__(self, node: GuardedNode, name: str) -> None:
        """Start the thread, which does not prevent the process from ending."""
        self._guarded = node.guarded
        self._pending: dict[object, Callable[[], None]] = {}
        self._running: object = None
        self._is_closed = False
        self._changed = Condition()
        self.stop: Mask = np.zeros(1, np.bool_)
        node.workers.append(self)
        Thread(target=self._work, name=name, daemon=True).start()

    @property
    def is_busy(self) -> bool:
        """Whether a request is in progress or waiting."""
        return bool(self._pending) or self._running is not None

    def pending(self, kind: type) -> int:
        """Return the number of waiting requests of a kind."""
        return sum(isinstance(each, kind) for each in list(self._pending))

    def submit(self, kind: object, work: Callable[..., None], *arguments: Any) -> None:
        """Process a request, which replaces a waiting or running request of its kind."""
        with self._changed:
            if self._running == kind:
                self.stop[0] = True
            self._pending[kind] = self._guarded(partial(work, *arguments))
            self._changed.notify_all()

    def cancel(self) -> None:
        """Drop the waiting requests, and stop the current one."""
        with self._changed:
            self._pending.clear()
            self.stop[0] = True
            self._changed.notify_all()
            # a compiler cannot be stopped
            self._changed.wait_for(lambda: self._running is None, timeout=0.25)

    def close(self) -> None:
        """End the thread."""
        self._is_closed = True
        self.cancel()

    def _work(self) -> None:
        """Process requests in the order of their kinds' first requests."""
        while True:
            with self._changed:
                self._running = None
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._pending or self._is_closed)
                if self._is_closed:
                    return
                self._running = next(iter(self._pending))
                work = self._pending.pop(self._running)
                self.stop = np.zeros(1, np.bool_)
            work()


MAX_SPIN_WAIT = 0.1
"""Longest call of the executor, and longest delay of a request to end, s."""

COLLECTION_PERIOD = 1.0
"""Period of the garbage collector, s."""


def executor_for(node: Any) -> Any:
    """
    Return an executor for a node, woken by events if possible.

    The event executor is available since rclpy 7.1.4. This executor supports no guard conditions,
    and raises RuntimeError at its first spin if the middleware has no callbacks.
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
        except Exception as error:  # noqa: BLE001 (of a callback that is due: the node goes on)
            node.note_failure(error)
            return woken
    waiting = SingleThreadedExecutor(context=node.context)
    waiting.add_node(node)
    return waiting


def spin(node: Any, is_asked_to_stop: Callable[[], bool]) -> None:
    """
    Let a node work until it has finished or is asked to stop, and close it.

    The garbage collector ignores objects made before the call, and runs between two callbacks.
    Each call of the executor ends after `MAX_SPIN_WAIT`, because Python cannot process a signal
    during an endless call.

    Parameters
    ----------
    node : rclpy.node.Node
        Node with a future `finished`, whose exception is raised here, and methods `close` and
        `note_failure`.
    is_asked_to_stop : callable
        Function that is called every `MAX_SPIN_WAIT`.

    """
    executor = executor_for(node)
    gc.collect()
    gc.freeze()
    gc.disable()
    due = time.monotonic() + COLLECTION_PERIOD
    try:
        while not (is_asked_to_stop() or node.finished.done()):
            try:
                executor.spin_until_future_complete(node.finished, MAX_SPIN_WAIT)
            except Exception as error:  # noqa: BLE001 (of rclpy's own callbacks: the node goes on)
                if not node.context.ok():
                    raise
                node.note_failure(error)
            if time.monotonic() > due:
                gc.collect()
                due = time.monotonic() + COLLECTION_PERIOD
        if node.finished.done():
            node.finished.result()
    finally:
        gc.enable()
        gc.unfreeze()
        executor.shutdown()
        node.close()
