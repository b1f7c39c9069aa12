"""Exceptions in callbacks, which must not end the node."""

from importlib.util import find_spec
from operator import attrgetter
import sys

from bellows_ros.core.live import Predictor
from bellows_ros.core.parameters.conversion import cup_of, package_of
from bellows_ros.nodes.guarding import GuardedNode, spin
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.task import Future
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from .conftest import (
    break_always,
    break_once,
    ERROR,
    Listener,
    MS,
    START,
)


@pytest.fixture
def listener(ros):
    """Give a monitor of a node that reports once a second: both failures are in one report."""
    return Listener(ros)


def test_a_callback_that_fails_is_logged_counted_and_started_from_afresh(
        partner, listener, capfd):
    """Lose the message in which it failed, and nothing else."""
    live = partner.predictor.pipeline.live
    for k in range(30):
        if k in (10, 20):
            break_once(live, 'on_pose')
        partner.send_pose(START + k * MS)
        partner.wait_for_poses(k + 1 - (k >= 10) - (k >= 20))
    assert live.restarts['failure'] == 2
    assert listener.sees('prediction', ERROR, '2 callbacks failed')
    assert listener.value('prediction', 'fresh starts: failure') == '2'
    log = capfd.readouterr().err
    assert log.count('A callback failed at pipeline.py:') == 1
    assert r'ZeroDivisionError: \x1b[31mbroken' in log and 'x' * 100 not in log


@pytest.mark.parametrize('name', ['coast', 'phase', 'flush'])
def test_a_timer_or_service_continues_after_a_failure(name, partner):
    """Tick, report and answer again the next time."""
    predictor = partner.predictor
    partner.predict(START)
    break_once(predictor.pipeline.live, name)
    for answered in (name != 'flush', True):
        assert partner.call('predictor/reset', Trigger).success is answered
    partner.wait(lambda: sum(predictor.failures.values()) == 1)
    partner.predict(START + MS)


def test_an_answer_after_the_end_of_the_topics_is_no_failure(node):
    """Of a thread that still answers a plan."""
    steered = node.pipeline.planning._steered
    node.release_resources()
    steered.publish(MultiDOFJointTrajectory())
    assert not node.failures


@pytest.mark.parametrize(('part', 'name'), [
    ('diagnostics', 'report'), ('pipeline.load', 'watch_force'),
    ('pipeline.outputs', 'publish_more'), ('pipeline.outputs', 'publish_state')])
def test_what_fails_beside_the_pose_does_not_touch_the_prediction(
        part, name, make_partner, listener):
    """Publish the pose of each sample, in the motion that it has."""
    partner = make_partner(with_twists=False)
    predictor = partner.predictor
    break_always(attrgetter(part)(predictor), name)
    alone = Predictor(cup_of(predictor.values), package_of(predictor.values), 9.81)
    expected = []
    for k in range(60):
        position = (0.2e-4 * k * k, 0.0, 0.0)
        partner.predict(START + 2 * k * MS, position)
        expected += alone.on_pose(START + 2 * k * MS, 'world', position, (0.0, 0.0, 0.0, 1.0))
    partner.wait(lambda: predictor.failures)
    found = [(p.pose.position.x, p.pose.position.z) for p in partner.poses]
    assert found == [(p.position[0], p.position[2]) for p in expected]
    assert not predictor.pipeline.live.restarts['failure']


@pytest.mark.parametrize('broken', ['_twist', '_state'])
def test_a_topic_that_fails_keeps_no_other_from_being_sent(broken, partner, capfd):
    """Send the wrench beside the twist, name the topic, and let the node be deactivated."""
    predictor = partner.predictor
    topic = getattr(predictor.pipeline.outputs, broken)
    break_always(topic._publisher, 'publish')
    partner.send_pose(START)
    partner.wait(lambda: partner.wrenches)
    assert predictor.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert set(predictor.failures) == {topic.name}
    assert f'A callback failed at {topic.name}' in capfd.readouterr().err


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
    """A node that can be closed."""

    def close(self):
        """End it."""
        self.destroy_node()


def test_the_result_of_a_node_ends_its_spin(ros, way):
    """Raise the error with which it has finished."""
    node = Closing('short', context=ros.context)
    node.finished = Future()
    node.finished.set_exception(ValueError('boom'))
    with pytest.raises(ValueError, match='boom'):
        spin(node, lambda: False)


def test_an_error_in_a_callback_does_not_end_the_node(ros, way):
    """Note an unforeseen error, also where the callback is none that the node has made."""
    def fail():
        if len(calls := [*node.failures.elements(), None]) > 3:
            node.finished.set_result(None)
        raise ZeroDivisionError(str(len(calls)))

    node = Closing('broken', context=ros.context)
    node.finished = Future()
    node.create_timer(1e-4, fail)
    spin(node, lambda: False)
    assert sum(node.failures.values()) == 4 and len(node.failures) == 1
