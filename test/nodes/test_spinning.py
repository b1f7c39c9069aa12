"""How a node is spun: by events and by waiting, to an orderly end, with the collector held off."""

import gc
from importlib.util import find_spec
import sys
from threading import Event, Thread
from types import FrameType

from bellows_ros.nodes.guarding import executor_for, GuardedNode, spin
from bellows_ros.nodes.predictor_node import PredictorNode
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
import pytest
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from .conftest import LATCHED, MS, overrides_of, PACKAGE, Partner, stamp_ns, START

without_events = pytest.mark.skipif(
    find_spec('rclpy.experimental') is None,
    reason='this rclpy is older than 7.1.4: it has no executor woken by events')


@pytest.fixture(params=[pytest.param('events', marks=without_events), 'waiting'])
def way(request, monkeypatch):
    """Give the name of a way to spin, and leave no other."""
    if request.param == 'waiting':
        monkeypatch.setitem(sys.modules, 'rclpy.experimental', None)
    return str(request.param)


@pytest.fixture
def spun(ros, way):
    """Give a function that spins a node as its command does, until the test is over."""
    stop, threads = Event(), []

    def start(node):
        threads.append(Thread(target=spin, args=(node, stop.is_set), daemon=True))
        threads[-1].stop = stop.set
        threads[-1].start()
        return threads[-1]

    yield start
    stop.set()
    for thread in threads:
        thread.join(20.0)
        assert not thread.is_alive()


class Cell(Partner):
    """A predictor that is spun by itself, and another node that talks with it."""

    def __init__(self, ros, spun):
        """Start both."""
        predictor = PredictorNode(context=ros.context, parameter_overrides=overrides_of(
            {**PACKAGE, 'coast.limit': 0.4}))
        self.thread = spun(predictor)
        super().__init__(ros, predictor)
        self.odometry = self.hears(Odometry, 'package/odometry', decode=stamp_ns)
        self.states = self.hears(String, 'package/state', LATCHED, lambda message: message.data)
        self.diagnostics = self.hears(DiagnosticArray, '/diagnostics')
        self.connect()
        outputs, live = self.predictor.pipeline.outputs, self.predictor.pipeline.live
        self.wait(lambda: outputs._odometry.subscribed and live.pairing.expect)
        self._last_ns = START

    def go_on(self, count):
        """Send poses with twists, and wait for the last answer."""
        before = len(self.poses)
        for _ in range(count):
            self._last_ns += 2 * MS
            self.send(self._last_ns)
        self.wait_for_poses(before + count)

    def is_ahead(self):
        """Tell whether the odometry goes on behind the last pose."""
        return max(self.odometry, default=0) > self._last_ns


@pytest.fixture
def cell(ros, spun):
    """Give a predictor and its partner."""
    return Cell(ros, spun)


def test_everything_works(cell):
    """Predict, coast, fall silent, report, change parameters, change state, and end."""
    for _ in range(50):  # until this machine has not paused for longer than is bridged
        cell.go_on(100)
        cell.wait(lambda: cell.is_ahead() or cell.is_lost())
        if cell.is_ahead():
            break
    assert cell.is_ahead()
    assert cell.predictor.pipeline.live.twists_estimated == 0
    cell.wait(lambda: cell.states[-1] == 'lost')
    cell.wait(lambda: bool(cell.diagnostics))
    mass = Parameter('package.mass', value=1.5).to_parameter_msg()
    request = SetParameters.Request(parameters=[mass])
    assert cell.call('/predictor/set_parameters', SetParameters, request).results[0].successful
    assert cell.predictor.pipeline.live.model[1][0] == 1.5
    assert cell.call('/predictor/reset', Trigger).success
    cell.go_on(10)
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert cell.call('/predictor/change_state', ChangeState, request).success
    cell.thread.stop()
    cell.wait(lambda: 'predictor' not in cell.node.get_node_names())


def test_collector_strikes_between_callbacks_only(cell, monkeypatch):
    """Let the collector be as eager as it can be: it still never runs within a callback."""
    struck: list[set[str]] = []

    def note(phase, info):
        frame: FrameType | None = sys._getframe(1)
        names = set()
        while frame is not None:
            names.add(frame.f_code.co_qualname)
            frame = frame.f_back
        struck.append(names)

    usual = gc.get_threshold()
    gc.set_threshold(1, 1, 1)
    gc.callbacks.append(note)
    try:
        cell.go_on(100)
        cell.wait(lambda: bool(struck))  # the one that is meant
        cell.go_on(100)
    finally:
        gc.callbacks.remove(note)
        gc.set_threshold(*usual)
    assert not [names for names in struck if any(
        ours in name for name in names for ours in ('PredictorNode', 'Pipeline'))]
    assert all('spin' in names for names in struck)


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
