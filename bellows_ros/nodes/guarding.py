"""
A node whose callbacks and work aside may fail: logged once, then counted; it lives on.

Each message wakes the node; the garbage is collected between messages. The usual executor of rclpy
rebuilds its list of entities after each callback, which takes longer than the callback; an
executor that is woken by events does not.
"""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import wraps
import gc
from pathlib import Path
import time
import traceback
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock

from ..errors import shown
from ..report import findings, health

PACKAGE = Path(__file__).parents[1]

OVERRIDABLE = (
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY)
"""QoS that parameters can override; durability is among them for vacuum switches with rare
messages."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS with which late subscribers get the newest message."""

THREADS = 2
"""Threads of work aside: one may compile for a minute while the other answers."""


class Once:
    """
    Work of a node, done aside at the first peer of a topic.

    Parameters
    ----------
    node : GuardedNode
    work : callable, optional
        Function without arguments; default: none.

    """

    def __init__(self, node: 'GuardedNode', work: Callable[[], None] | None = None) -> None:
        self._node, self._work, self._done = node, work, Future[None]()
        if work is None:
            self._done.set_result(None)

    @property
    def is_done(self) -> bool:
        """Whether the work is done."""
        return self._done.done()

    def on_peers(self, count: int) -> None:
        """Begin with the work, if there are peers for the first time."""
        if count and self._work and not self.is_done:
            self._done, self._work = self._node.aside(self._work), None


class GuardedNode(Node):
    """
    A node whose callbacks may fail.

    Attributes
    ----------
    failures : collections.Counter
        Number of failures by place in the code.

    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Create the node; rclpy creates its first subscriptions here."""
        self.failures: Counter[str] = Counter()
        self._without_frame: set[str] = set()
        self._aside = ThreadPoolExecutor(THREADS, 'aside')
        super().__init__(*arguments, **options)

    def note_failure(self, error: Exception, place: str = '') -> None:
        """Count an exception by its place, by default its line of code; log the first one."""
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames[1:] if PACKAGE in Path(frame.filename).parents]
        innermost = (ours or frames)[-1]  # the first frame is the guard itself
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
            self.get_logger().warning(findings.text(
                health.fact('no_frame', topic=topic, meaning=meaning)))

    def guarded(
        self, callback: Callable[..., Any],
        otherwise: Callable[[Exception], Any] = lambda error: None,
    ) -> Callable[..., Any]:
        """Return a callback that records its exceptions and then returns a substitute."""
        @wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:  # noqa: BLE001 (nothing may end the node)
                self.note_failure(error)
                return otherwise(error)

        return call

    def aside(self, work: Callable[..., None], *arguments: Any) -> Future[None]:
        """Do some work in a thread, during the live prediction."""
        return self._aside.submit(self.guarded(work), *arguments)

    def forget_work(self) -> None:
        """Drop the work aside that has not begun."""
        self._aside.shutdown(wait=False, cancel_futures=True)
        self._aside = ThreadPoolExecutor(THREADS, 'aside')

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
        """Serve with a callback that may fail; the answer then has the error, if it has texts."""
        def failed(error: Exception) -> Any:
            response = srv_type.Response()
            if hasattr(response, 'message'):
                response.message = shown(str(error))
            return response

        return super().create_service(
            srv_type, srv_name, self.guarded(callback, failed), **options)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], Any], *more: Any, **options: Any
    ) -> Any:
        """Start a timer with a callback that may fail."""
        return super().create_timer(timer_period_sec, self.guarded(callback), *more, **options)


MAX_SPIN_WAIT = 0.1
"""Longest call of the executor, and longest delay of a request to end, s."""

COLLECTION_PERIOD = 1.0
"""Period of the garbage collector, s."""


def executor_for(node: GuardedNode) -> Any:
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
    node : GuardedNode
        Node with a future `finished`, whose exception is raised here, and a method `close`.
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
