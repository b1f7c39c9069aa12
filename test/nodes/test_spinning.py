"""How a node is spun: by events and by waiting, to an orderly end."""

import gc
from importlib.util import find_spec
import sys

from bellows_ros.nodes.guarding import executor_for, GuardedNode, spin
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future

without_events = pytest.mark.skipif(
    find_spec('rclpy.experimental') is None,
    reason='this rclpy is older than 7.1.4: it has no executor woken by events')


@pytest.fixture(params=[pytest.param('events', marks=without_events), 'waiting'])
def way(request, monkeypatch):
    """Give the name of a way to spin, and leave no other."""
    if request.param == 'waiting':
        monkeypatch.setitem(sys.modules, 'rclpy.experimental', None)
    return str(request.param)


class Closing(GuardedNode):
    """A node that says that it has been closed."""

    closed = False

    def close(self):
        """End it."""
        self.closed = True
        self.destroy_node()


def test_collector_is_given_back(ros, way):
    """Collect as before when the node has ended, however it ends."""
    node = Closing('short', context=ros.context)
    node.finished = Future()
    node.finished.set_exception(ValueError('boom'))
    with pytest.raises(ValueError, match='boom'):
        spin(node, lambda: False)
    assert node.closed and gc.isenabled() and gc.get_freeze_count() == 0


@pytest.mark.parametrize('of', ['the node', 'rclpy'])
def test_an_error_in_a_callback_does_not_end_the_node(of, ros, way):
    """Note an unforeseen error, also where the callback is none that the node has made."""
    def fail():
        if len(calls := [*node.failures.elements(), None]) > 3:
            node.finished.set_result(None)
        raise ZeroDivisionError(str(len(calls)))

    node = Closing('broken', context=ros.context)
    node.finished = Future()
    (Node if of == 'rclpy' else GuardedNode).create_timer(node, 1e-4, fail)
    spin(node, lambda: False)
    assert sum(node.failures.values()) == 4 and len(node.failures) == 1


@without_events
def test_what_events_cannot_serve_is_waited_for(ros):
    """Fall back where the executor woken by events refuses a node."""
    node, called = Node('guarded', context=ros.context), []
    guard = node.create_guard_condition(lambda: called.append(True))
    executor = executor_for(node)
    assert isinstance(executor, SingleThreadedExecutor) and node.executor is executor
    guard.trigger()
    executor.spin_once(timeout_sec=5.0)
    assert called
    executor.shutdown()
    node.destroy_node()
