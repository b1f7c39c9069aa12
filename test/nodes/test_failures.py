"""What must not end the node: exceptions in its callbacks, negative times, odd parameters."""

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.parameter import Parameter

from .conftest import PACKAGE
from .test_health import ERROR, Listener

MS = 1_000_000
START = 1_700_000_000_000_000_000


@pytest.fixture
def listener(ros: Any) -> Listener:
    """Give a monitor."""
    return Listener(ros)


def break_once(thing: Any, name: str) -> None:
    """Let a method raise when it is called the next time, and work again then."""
    sound = getattr(thing, name)

    def fail(*arguments: Any) -> Any:
        setattr(thing, name, sound)
        raise ZeroDivisionError('\x1b[31mbroken' + 'x' * 1000)

    setattr(thing, name, fail)


def test_a_callback_that_fails_is_logged_counted_and_started_from_afresh(
        make_partner: Callable[..., Any], listener: Listener,
        capfd: pytest.CaptureFixture[str]) -> None:
    """Lose the message in which it failed, and nothing else."""
    partner = make_partner(with_twists=False)
    live = partner.predictor._live
    for k in range(30):
        if k in (10, 20):
            break_once(live, 'on_pose')
        partner.send_pose(START + k * MS)
        partner.wait_for_poses(k + 1 - (k >= 10) - (k >= 20))
    assert live.restarts['failure'] == 2
    assert listener.sees('prediction', ERROR, '2 callbacks failed')
    assert listener.value('prediction', 'fresh starts: failure') == '2'
    log = capfd.readouterr().err
    assert log.count('A callback failed at predictor_node.py:') == 1
    assert 'ZeroDivisionError: ?[31mbroken' in log and 'x' * 100 not in log


@pytest.mark.parametrize('name', ['coast', 'phase', 'flush'])
def test_a_timer_or_service_that_fails_goes_on(
        name: str, make_partner: Callable[..., Any]) -> None:
    """Tick, report and answer again the next time."""
    from std_srvs.srv import Trigger

    partner = make_partner(with_twists=False)
    predictor, ros = partner.predictor, partner.ros
    partner.send_pose(START)
    partner.wait_for_poses(1)
    break_once(predictor._live, name)
    client = partner.node.create_client(Trigger, 'predictor/reset')
    assert ros.spin_until(client.service_is_ready)
    for answered in (name != 'flush', True):
        future = client.call_async(Trigger.Request())
        assert ros.spin_until(future.done)
        assert future.result().success is answered
    assert ros.spin_until(lambda: sum(predictor.failures.values()) == 1)
    partner.send_pose(START + MS)
    partner.wait_for_poses(2)


def test_a_negative_time_is_left_out(
        make_predictor: Callable[..., Any], ros: Any, capfd: pytest.CaptureFixture[str]) -> None:
    """Keep the time as it was, count what was left out, and say it once."""
    from rclpy.node import Node
    from rosgraph_msgs.msg import Clock

    predictor = make_predictor({**PACKAGE, 'use_sim_time': True})
    node = Node('simulation', context=ros.context)
    ros.executor.add_node(node)
    writer = node.create_publisher(Clock, '/clock', 10)
    assert ros.spin_until(writer.get_subscription_count)

    def tell(seconds: int) -> None:
        message = Clock()
        message.clock.sec = seconds
        writer.publish(message)

    tell(100)
    assert ros.spin_until(lambda: predictor.get_clock().now().nanoseconds == 100 * 10**9)
    for count in (1, 2):
        tell(-count)
        assert ros.spin_until(
            lambda count=count: predictor.failures['negative time on /clock'] == count)
    assert predictor.get_clock().now().nanoseconds == 100 * 10**9
    assert predictor._live.restarts['failure'] == 0
    assert capfd.readouterr().err.count('A negative time on /clock was ignored: -1 s') == 1
    tell(101)
    assert ros.spin_until(lambda: predictor.get_clock().now().nanoseconds == 101 * 10**9)


ENVELOPE = {
    'envelope.rates': [0.1] * 6, 'envelope.frequencies': [1.0, 2.0, 1.0, 2.0],
    'envelope.deflection_low': [-0.01] * 6, 'envelope.deflection_high': [0.01] * 6,
}


@pytest.mark.parametrize('live', [False, True], ids=['at start', 'live'])
@pytest.mark.parametrize('name', ENVELOPE)
def test_an_envelope_without_a_mass_is_watched(
        name: str, live: bool, make_partner: Callable[..., Any]) -> None:
    """Judge what is known, and not the mass, of which nothing is."""
    given = {name: ENVELOPE[name]}
    partner = make_partner({**PACKAGE, **({} if live else given)}, with_twists=False)
    predictor = partner.predictor
    partner.send_pose(START)
    partner.wait_for_poses(1)
    if live:
        (result,) = predictor.set_parameters([Parameter(name, value=given[name])])
        assert result.successful
    load = predictor._diagnostics.load
    assert partner.ros.spin_until(lambda: load.envelope_known and load._distance is not None)
    assert not predictor.failures
