"""
Attack a predictor for minutes over DDS, beside a twin that is left alone.

    python -m test.soak [--seconds 720] [--rate 500] [--seed 0]

Both get the same motion. One also gets invalid poses, twists, measured poses and plans, jumps of
place and clock, bursts of 5 kHz, random parameters, transitions and service calls. After each
attack its parameters are restored, both are reset, and both must predict the same, to rounding,
without a loss.

From minute 5 on, its memory must grow by less than 1 MB a minute (line through all values): one
float kept per regular message is 32 B x 2 rate = 1.9 MB a minute. A run below 7 minutes tells too
little about growth: it reports the memory only (--seconds 60: half a minute of attacks). Ends with
1 if something fails.
"""

import argparse
import math
import os
from pathlib import Path
import random
import sys
import tempfile
import time

from bellows_ros.nodes.domain import isolate
from benchmarks.live import NODES, process
from benchmarks.probe import Probe, QUEUE, used
from geometry_msgs.msg import PoseStamped, Transform, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
import rclpy
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

PLAY, ATTACKS = 2.0, 4  # s, plays of a turn under attack
BURST = 5000.0  # messages/s
WARM_UP, LEAST_TIME, LARGEST_GROWTH = 300.0, 120.0, 1e6  # s, s, B a minute
TOLERANCE = 1e-12  # m, no unit
ATTACKED = 'attacked'
NUMBERS = (math.nan, math.inf, 0.0, 1e3, 1e300, -0.4, 0.01)
STAMPS = (-10**12, -10**9, -10**6, 0, 10**6, 10**8, 10**10, 10**15)  # ns from the true one
NAMES = ('package.mass', 'package.com', 'package.inertia', 'cup.stiffness', 'cup.damping')
STEPS = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
FREQUENT = POSE, TWIST = 'tool_arm/pose', 'tool_arm/twist'
PLAN = 'tool_arm/plan'
INPUTS = {POSE: PoseStamped, TWIST: TwistStamped, 'package/measured': PoseStamped,
          PLAN: MultiDOFJointTrajectory}
WAYS = (*4 * STEPS, Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP, 0, 99)
RESET, DETACH, ATTACH = 'predictor/reset', 'package/detach', 'package/attach'


class Both:
    """A publisher on the topic of each node."""

    def __init__(self, *writers):
        self.writers = writers

    def publish(self, message):
        for writer in self.writers:
            writer.publish(message)

    def get_subscription_count(self):
        return min(writer.get_subscription_count() for writer in self.writers)


class Soak(Probe):
    """Sends the motion to both nodes, attacks one, and compares their predictions."""

    def __init__(self, rate, seed):
        super().__init__(rate, PLAY)
        self.random, self.is_attacking, self.burst = random.Random(seed), False, 0
        self.hostile, self.wrong, self.calls, self.begin = 0, 0, {}, time.monotonic()
        self.predicted = {}, {}  # of the twin and of the other, by stamp (ns)
        self.writers = {name: self.create_publisher(kind, f'{ATTACKED}/{name}', QUEUE)
                        for name, kind in INPUTS.items()}
        # Each twist goes first: without it for 40 ms, a pose would be predicted with an estimate.
        self._messages = [(twist, pose) for pose, twist in self._messages]
        self._pose_out, self._twist_out = (
            Both(self._twist_out, self.writers[TWIST]), Both(self._pose_out, self.writers[POSE]))
        self.create_subscription(
            PoseStamped, f'{ATTACKED}/package/pose', lambda message: self._keep(1, message), QUEUE)

    def _on_answer(self, message):
        super()._on_answer(message)
        self._keep(0, message)

    def _keep(self, which, message):
        """Keep a prediction; count one that is not finite."""
        p, q, stamp = message.pose.position, message.pose.orientation, message.header.stamp
        numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        self.wrong += not all(map(math.isfinite, numbers))
        self.predicted[which][stamp.sec * 10**9 + stamp.nanosec] = numbers

    def _wait_until(self, due):
        """Attack before the next message is due."""
        if self.is_attacking:
            if self.random.random() < 0.5 * self._period:  # twice per second of bursts, 0.5 s each
                self.burst = round(0.5 / self._period)
            self.burst -= self.burst > 0
            count = BURST * self._period if self.burst else self.random.random() < 0.1
            for _ in range(round(count)):
                self._publish_hostile()
            if self.random.random() < 20.0 * self._period:
                self.random.choice((self._trigger, self._change, self._set))()
        super()._wait_until(due)

    def _publish_hostile(self):
        """Publish a message with up to two numbers, its stamp or its frame wrong."""
        choose = self.random.choice
        name = choose(tuple(self.writers) if self.random.random() < 0.05 else FREQUENT)
        message = INPUTS[name]()
        if name == PLAN:
            message.points = [MultiDOFJointTrajectoryPoint(transforms=[Transform()])
                              for _ in range(choose((1, 2, 50)))]
            for k, point in enumerate(message.points):
                point.time_from_start.nanosec = k * 10**7
            parts = [point.transforms[0].translation for point in message.points]
        elif isinstance(message, PoseStamped):
            message.pose.orientation.w = 1.0
            parts = message.pose.position, message.pose.orientation
        else:
            parts = message.twist.linear, message.twist.angular
        for _ in range(choose((0, 1, 2))):
            setattr(choose(parts), choose('xyz'), choose(NUMBERS))
        newest = max(self.sent, default=10**9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            max(0, newest + choose(STAMPS)), 10**9)
        message.header.frame_id = choose(('world', 'world', 'world', '', 'elsewhere'))
        self.writers[name].publish(message)
        self.hostile += 1

    def _call(self, kind, name, **request):
        """Call a service of the attacked node if it is there; return the future or None."""
        client = self.calls.get(name) or self.create_client(kind, f'/{name}')
        self.calls[name] = client
        return client.call_async(kind.Request(**request)) if client.service_is_ready() else None

    def _finish(self, *call, **request):
        """Call a service and return its answer."""
        futures = []

        def is_called():
            futures.extend(filter(None, [] if futures else [self._call(*call, **request)]))
            return bool(futures) and futures[0].done()

        if not self._spin_until(is_called, 30.0):
            sys.exit(f'no answer of {call[1]}')
        return futures[0].result()

    def _trigger(self):
        self._call(Trigger, f'{ATTACKED}/{self.random.choice((RESET, DETACH, *4 * (ATTACH,)))}')

    def _change(self):
        self._call(ChangeState, f'{ATTACKED}/predictor/change_state',
                   transition=Transition(id=self.random.choice(WAYS)))

    def _set(self):
        """Set a parameter to a multiple of its value, possibly impossible."""
        name = self.random.choice(NAMES)
        factor = self.random.choice((*NUMBERS, 0.5, 0.9, 1.1, 2.0))
        value = self.values[name].value
        new = [factor * x for x in value] if name != NAMES[0] else factor * value
        self._call(SetParametersAtomically, f'{ATTACKED}/predictor/set_parameters_atomically',
                   parameters=[Parameter(name, value=new).to_parameter_msg()])

    def read(self):
        """Keep the parameters to be restored after each attack."""
        answer = self._finish(
            GetParameters, f'{ATTACKED}/predictor/get_parameters', names=list(NAMES))
        self.values = {
            name: Parameter.from_parameter_msg(ParameterMessage(name=name, value=value))
            for name, value in zip(NAMES, answer.values, strict=True)}

    def restore(self):
        """Let the queues empty; restore state and parameters, and reset both nodes."""
        self._spin_until(lambda: False, 1.0)
        for step in STEPS:
            self._finish(ChangeState, f'{ATTACKED}/predictor/change_state',
                         transition=Transition(id=step))
        result = self._finish(
            SetParametersAtomically, f'{ATTACKED}/predictor/set_parameters_atomically',
            parameters=[value.to_parameter_msg() for value in self.values.values()]).result
        self._finish(Trigger, f'{ATTACKED}/{ATTACH}')
        if not (result.successful and self.connected()):
            sys.exit(f'not restored: {result.reason}')
        self._spin_until(lambda: False, 1.0)
        for name in (f'{ATTACKED}/{RESET}', RESET):
            self._finish(Trigger, name)

    def play_next(self, is_attacking):
        """Send the motion once more, and return the number of stamps without an answer of each."""
        self.is_attacking = is_attacking
        for predicted in self.predicted:
            predicted.clear()
        self.play(time.monotonic() - self.begin)
        self.is_attacking = False
        self._spin_until(lambda: is_attacking or not any(self._lost()), PLAY)
        return self._lost()

    def _lost(self):
        return [len(self.sent.keys() - predicted.keys()) for predicted in self.predicted]

    def difference(self):
        """Return the largest difference of the predictions of both nodes."""
        twin, other = self.predicted
        return max((float(np.abs(np.subtract(twin[stamp], other[stamp])).max())
                    for stamp in self.sent if stamp in twin and stamp in other), default=math.inf)


def command(namespace=''):
    """Return the command of a predictor with reliable inputs."""
    words = [word for topic in ('/tool_arm/pose', '/tool_arm/twist') for word in (
        '-p', f'qos_overrides.{namespace}{topic}.subscription.reliability:=reliable',
        '-p', f'qos_overrides.{namespace}{topic}.subscription.depth:=1000')]
    return (*NODES['predictor'], *words, *(('-r', f'__ns:={namespace}') if namespace else ()))


def soak(given, logs):
    """Run, report, and return whether all is well."""
    rclpy.init(args=[])
    memories, lost, largest, sent, missed = [], 0, 0.0, 0, 0
    with (process(command(f'/{ATTACKED}'), os.environ, logs / 'attacked.log') as pid,
          process(command(), os.environ, logs / 'twin.log') as twin_pid):
        probe = Soak(given.rate, given.seed)
        if not probe.connected():
            sys.exit(f'no answer: {(logs / "attacked.log").read_text(errors="replace")[-400:]}')
        probe.read()
        while (now := time.monotonic() - probe.begin) < given.seconds or not memories:
            for _ in range(ATTACKS):
                missed += probe.play_next(True)[1]
            probe.restore()
            lost, sent = lost + sum(probe.play_next(False)), sent + len(probe.sent)
            largest = max(largest, probe.difference())
            memories.append((now / 60.0, used(pid)['memory']))
            print(f'{now / 60.0:5.1f} min  hostile {probe.hostile}  lost {lost}  difference '
                  f'{largest:.1e}  memory {memories[-1][1] / 1e6:.2f} MB, of the twin '
                  f'{used(twin_pid)["memory"] / 1e6:.2f} MB', flush=True)
    rclpy.try_shutdown()
    is_steady = growth_is_small(np.array([m for m in memories if m[0] >= WARM_UP / 60.0]))
    print(f'compared {sent}, unanswered under attack {missed / ATTACKS / sent:.0%}, lost {lost}, '
          f'not finite {probe.wrong}, difference {largest:.1e}')
    log = (logs / 'attacked.log').read_text(errors='replace')
    is_well = lost == probe.wrong == 0 and largest <= TOLERANCE and 'Traceback' not in log
    print('' if is_well else log[-2000:])
    return is_well and is_steady


def growth_is_small(memories):
    """Print the growth (bytes) over time (minutes), and whether it is below the limit."""
    if len(memories) < 3 or np.ptp(memories[:, 0]) < LEAST_TIME / 60.0:
        print('growth of the memory: not judged, the run is too short')
        return True
    slope = float(np.polyfit(*memories.T, 1)[0])
    print(f'growth of the memory: {slope / 1e6:.3f} MB a minute from minute 5 on')
    return slope < LARGEST_GROWTH


def main():
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=720.0)
    parser.add_argument('--rate', type=float, default=500.0)
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as logs:
        isolate(logs)
        return 0 if soak(given, Path(logs)) else 1


if __name__ == '__main__':
    sys.exit(main())
