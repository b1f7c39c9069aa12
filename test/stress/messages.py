"""Hostile messages to the real node over DDS: finite answers, every pose counted, recovery."""

from contextlib import contextmanager
import time

from bellows_ros.nodes.predictor_node import PredictorNode
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from .frame import CLEAN, COUNTED, Failed
from .readers import ATTEMPTS
from ..conftest import Ros
from ..nodes.conftest import MS, PACKAGE, Partner
from ..nodes.test_hostile import Attacker, listen, numbers, RELIABLE, stamps_from

BURST = 100  # messages of an attempt


@contextmanager
def connected(given):
    """Give a predictor of its own, and what sends messages to it."""
    context = rclpy.context.Context()
    rclpy.init(args=['--ros-args', '--log-level', 'fatal'], context=context)
    ros = Ros(context, SingleThreadedExecutor(context=context))
    try:
        predictor = PredictorNode(context=context, parameter_overrides=[
            Parameter(name, value=value) for name, value in {**given, **RELIABLE}.items()])
        ros.executor.add_node(predictor)
        yield Partner(ros, predictor)
    finally:
        for node in ros.executor.get_nodes():
            node.destroy_node()
        ros.executor.shutdown()
        context.try_shutdown()


def messages(rng, folder):
    """Send bursts of what nobody should send, and then good poses, which must be answered."""
    with connected(PACKAGE) as partner:
        heard, attacker = listen(partner), Attacker(partner, int(rng.integers(2**31)))
        for number in range(ATTEMPTS):
            yield burst(partner, attacker, heard, number)


def burst(partner, attacker, heard, number):
    """Send hostile messages, then good ones, and return what became of the hostile ones."""
    live = partner.predictor._live
    before, sent = sum(live.refused.values()), attacker.poses
    for _ in range(BURST):
        attacker.send()
    good = time.time_ns()
    if not partner.ros.spin_until(lambda: live.poses_in >= attacker.poses, 10.0):
        raise Failed(f'{live.poses_in} of {attacker.poses} poses were taken')
    attacker.poses = live.poses_in  # bytes that could be read as a pose are poses
    for k in range(200):
        partner.send_pose(good + k * 2 * MS, frame_id='base')
        attacker.poses += 1
        partner.ros.spin_until(lambda: False, 0.002)
        if stamps_from(good, partner.poses):
            break
    if not partner.ros.spin_until(lambda: stamps_from(good, partner.poses), 5.0):
        raise Failed('good poses were not answered')
    if partner.predictor.failures:
        raise Failed(f'callbacks failed: {dict(partner.predictor.failures)}')
    answers = [*partner.poses, *partner.twists, *partner.wrenches, *heard]
    if not all(np.isfinite(x) for message in answers for x in numbers(message)):
        raise Failed('a number that is not finite was published')
    for kept in (partner.poses, partner.twists, partner.wrenches, heard):
        kept.clear()
    return COUNTED if sum(live.refused.values()) > before or sent == attacker.poses else CLEAN
