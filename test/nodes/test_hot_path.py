"""What a message costs once the predictor is active: no import, no compiling, no more memory."""

import json
import os
import subprocess
import sys
from typing import Any

import pytest

pytestmark = [pytest.mark.timeout(400), pytest.mark.xdist_group('hot path')]

# A process of its own: in this one other tests have imported and compiled everything already.
SCRIPT = """
import gc, json, sys, time, tracemalloc

class Absent:  # what recordings, pictures and fits need, the node does not
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in ('rosbags', 'joblib', 'matplotlib') or name in (
                'scipy.optimize', 'scipy.signal', 'scipy.stats'):
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)

sys.meta_path.insert(0, Absent())
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped, Vector3Stamped, WrenchStamped
from nav_msgs.msg import Odometry
from visualization_msgs.msg import MarkerArray
from rclpy.node import Node
from rclpy.parameter import Parameter
from bellows_ros.core.geometry import jit
from bellows_ros.nodes.outputs import Topic
from bellows_ros.nodes.predictor_node import PredictorNode
from bellows_ros.nodes.guarding import executor_for

VALUES = {
    'package.mass': 2.17, 'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03], 'cup.lip_radius': 0.02, 'vacuum.holding': 60000.0,
    'package.size': [0.1, 0.1, 0.1], 'landing.height': -1.0,
    'cup.stiffness_std': [100.0] * 36, 'cup.damping_std': [1.0] * 36, 'coast.limit': 0.2,
}
OUTPUTS = {
    'package/pose': PoseStamped, 'package/twist': TwistStamped, 'cup/wrench': WrenchStamped,
    'package/odometry': Odometry, 'cup/deflection': PoseStamped, 'package/markers': MarkerArray,
    'cup/safety_factor': Vector3Stamped,
}
STEP_NS = 2_000_000

rclpy.init()
partner = Node('partner')
heard = dict.fromkeys(OUTPUTS, 0)
def listen(topic):
    def hear(message):
        heard[topic] += 1
    return partner.create_subscription(OUTPUTS[topic], topic, hear, 1000)
readers = [listen(topic) for topic in OUTPUTS]
pose_out = partner.create_publisher(PoseStamped, 'tool_arm/pose', 1000)
twist_out = partner.create_publisher(TwistStamped, 'tool_arm/twist', 1000)
predictor = PredictorNode(
    parameter_overrides=[Parameter(name, value=value) for name, value in VALUES.items()])
executors = [executor_for(node) for node in (predictor, partner)]

def spin_until(true, what):
    end = time.monotonic() + 60.0
    while not true():
        if time.monotonic() > end:
            sys.exit('waited in vain for ' + what)
        for executor in executors:
            executor.spin_once(timeout_sec=0.001)

def wanted():
    topics = [part for name, part in vars(predictor._outputs).items()
              if isinstance(part, Topic) and name not in ('_state', '_ok')]
    return all(topic.wanted for topic in topics) and predictor._live.pairing.expect

sent = 0
def send(count):
    global sent
    for _ in range(count):
        sent += 1
        stamp = 1_700_000_000 * 10**9 + sent * STEP_NS
        for message, out in ((PoseStamped(), pose_out), (TwistStamped(), twist_out)):
            message.header.frame_id = 'world'
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            if out is pose_out:
                message.pose.position.x = 1e-3 * (sent % 7)
                message.pose.orientation.w = 1.0
            out.publish(message)
        spin_until(lambda: heard['package/pose'] >= sent, 'an answer')

def pause():
    spin_until(lambda: predictor._outputs._said == 'lost', 'the pause')

def signatures():
    kernels = {}
    for module in [m for name, m in sys.modules.items() if name.startswith('bellows_ros')]:
        for name, thing in vars(module).items():
            if isinstance(getattr(thing, 'signatures', None), list):
                kernels[getattr(module, '__name__'), name] = len(thing.signatures)
    return kernels

def held():
    spin_until(lambda: predictor._diagnostics.compute.count == 0, 'a report')
    gc.collect()
    taken = tracemalloc.take_snapshot().filter_traces(
        [tracemalloc.Filter(True, '*/bellows_ros/*')])
    return sum(trace.size for trace in taken.traces)

spin_until(wanted, 'the topics')
predictor._report_health()
modules, compiled = set(sys.modules), signatures()
send(300)
pause()
send(100)
predictor._report_health()
new_modules = sorted(set(sys.modules) - modules)
newly_compiled = sorted(key for key, n in signatures().items() if compiled.get(key) != n)

from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint
from geometry_msgs.msg import PoseWithCovarianceStamped, Transform, Twist
from std_msgs.msg import Header
plan_out = partner.create_publisher(MultiDOFJointTrajectory, 'tool_arm/plan', 10)
request_out = partner.create_publisher(Header, 'package/predict_at', 10)
measured_out = partner.create_publisher(PoseStamped, 'package/measured', 10)
answered = dict.fromkeys(('package/plan', 'package/predicted_at', 'package/landing'), 0)
def listen_too(topic, kind):
    def hear(message):
        answered[topic] += 1
    return partner.create_subscription(kind, topic, hear, 10)
asked = [listen_too('package/plan', MultiDOFJointTrajectory),
         listen_too('package/predicted_at', Odometry),
         listen_too('package/landing', PoseWithCovarianceStamped)]
spin_until(lambda: all(end.get_publisher_count() for end in asked) and all(
    out.get_subscription_count() for out in (plan_out, request_out, measured_out))
    and predictor._planning._plan_out.wanted and predictor._tossing._landing.wanted
    and len(predictor._planning._compiled) == 2, 'the other topics')
send(1)
plan = MultiDOFJointTrajectory(joint_names=['tool'])
for k in range(51):
    point = MultiDOFJointTrajectoryPoint(transforms=[Transform()], velocities=[Twist()])
    point.time_from_start.nanosec = k * 10_000_000
    point.transforms[0].translation.x = 1e-3 * (sent % 7)
    plan.points.append(point)
plan_out.publish(plan)
spin_until(lambda: answered['package/plan'], 'an answer to a plan')
send(1)
ahead_ns = 1_700_000_000 * 10**9 + sent * STEP_NS + 100_000_000
request = Header()
request.stamp.sec, request.stamp.nanosec = divmod(ahead_ns, 10**9)
request_out.publish(request)
spin_until(lambda: answered['package/predicted_at'], 'an answer to a request')
measured = PoseStamped()
measured.header.frame_id, measured.header.stamp = 'world', request.stamp
measured_out.publish(measured)
spin_until(lambda: predictor._live.package.observer, 'a measured pose')
def landing():
    send(1)
    return answered['package/landing']
spin_until(landing, 'a landing')
predictor._live.package.observer = None
tracemalloc.start()
send(200)
before = held()
send(600)
after = held()
print(json.dumps({
    'compiled': jit.COMPILED, 'kernels': sum(compiled.values()), 'modules': new_modules,
    'sent': sent, 'answered': answered, 'failures': predictor.failures,
    'newly compiled': newly_compiled, 'grown': after - before, 'heard': heard,
    'twists estimated': predictor._live.twists_estimated, 'coasted': predictor._live.coasted,
}))
"""


@pytest.fixture(scope='module')
def found(root):
    """Give what a process has found out about a predictor that it holds."""
    environment = {**os.environ, 'PYTHONPATH': str(root)}
    done = subprocess.run(
        [sys.executable, '-P', '-c', SCRIPT], env=environment, capture_output=True, text=True,
        timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def test_all_of_it_has_been_tried(found):
    """Have every topic answer, a twist for every pose, and a pause bridged."""
    assert min(found['heard'].values()) >= 20 and found['coasted'] > 0
    assert found['heard']['package/pose'] == found['sent'] > 1200


def test_nothing_is_imported(found):
    """Load every module before the first message."""
    assert found['modules'] == []


def test_a_node_without_what_recordings_need_answers_all_the_same(found):
    """Answer plan, request, measured pose and landing without rosbags, matplotlib, optimizers."""
    assert min(found['answered'].values()) > 0 and not found['failures']


def test_nothing_is_compiled(found):
    """Compile every kernel for every kind of argument before the first message."""
    assert found['newly compiled'] == []
    assert bool(found['kernels']) is found['compiled']


def test_nothing_is_kept(found):
    """Hold after 600 more messages what was held before, to within their last few."""
    assert found['grown'] < 10_000
