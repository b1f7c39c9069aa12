"""What a message costs once the predictor is active: no import, no compiling, no more memory."""

import json
import os
import subprocess
import sys

import pytest

pytestmark = [
    pytest.mark.xdist_group('hot path'), pytest.mark.usefixtures('observer_kernels')]

# A process of its own: in this one other tests have imported and compiled everything already.
SCRIPT = """
import gc, json, os, sys, threading, time, tracemalloc

class Absent:  # what recordings, pictures and fits need, the node does not
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] == 'matplotlib' or name in (
                'rosbags.rosbag2', 'scipy.optimize', 'scipy.signal', 'scipy.stats'):
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)

sys.meta_path.insert(0, Absent())
import bellows_ros
import rclpy
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from sensor_msgs.msg import FluidPressure
from nav_msgs.msg import Odometry
from visualization_msgs.msg import MarkerArray
from rclpy.executors import SingleThreadedExecutor
from bellows_ros.core.geometry import jit
from bellows_ros.nodes.predictor_node import PredictorNode
from bellows_ros.nodes.guarding import executor_for
from test.nodes.conftest import (
    overrides_of, PACKAGE, Partner, pose_at, set_on, stamped, START, topics_of)

VALUES = {
    **PACKAGE, 'cup.lip_radius': 0.02, 'vacuum.holding': 60000.0,
    'package.size': [0.1, 0.1, 0.1], 'landing.height': -1.0,
    'payload.estimate': True, 'vacuum.signal': 'pressure', 'tool_link': 'tool',
    'cup.stiffness_std': [100.0] * 36, 'cup.damping_std': [1.0] * 36,
}
STEP_NS = 2_000_000

needed = []  # kernels that the thread of the executor asks to be compiled, or loaded
if jit.COMPILED:
    from numba.core.dispatcher import Dispatcher
    usual = Dispatcher.compile

    def compile(self, signature):
        if threading.current_thread() is threading.main_thread():
            needed.append(self.py_func.__qualname__)
        return usual(self, signature)

    Dispatcher.compile = compile

class Ros:
    context = None

    def spin_until(self, true):
        end = time.monotonic() + 600.0
        while not true():
            if time.monotonic() > end:
                return False
            for executor in (own, self.executor):
                executor.spin_once(timeout_sec=0.001)
        return True

rclpy.init()
ros = Ros()
ros.executor = SingleThreadedExecutor()
predictor = PredictorNode(parameter_overrides=overrides_of(VALUES))
of_start = len(needed)
needed.clear()
own = executor_for(predictor)
partner = Partner(ros, predictor)
heard = [partner.poses, partner.twists, partner.wrenches, *(
    partner.hears(kind, topic) for kind, topic in (
        (Odometry, 'package/odometry'), (PoseStamped, 'cup/deflection'),
        (MarkerArray, 'package/markers'), (Vector3Stamped, 'cup/safety_factor')))]
pressure_out = partner.writes(FluidPressure, 'vacuum/pressure')
partner.connect(predictor)

sent = 0
def send(count):
    global sent
    for _ in range(count):
        sent += 1
        partner.send(START + sent * STEP_NS, (1e-3 * (sent % 7), 0.0, 0.0))
        partner.wait_for_poses(sent)

def pause():
    partner.wait(lambda: predictor.pipeline.outputs._last_state == 'interrupted')

def signatures():
    kernels = {}
    for module in [m for name, m in sys.modules.items() if name.startswith('bellows_ros')]:
        for name, thing in vars(module).items():
            if isinstance(getattr(thing, 'signatures', None), list):
                kernels[getattr(module, '__name__'), name] = len(thing.signatures)
    return kernels

def held():
    partner.wait(lambda: not predictor.pipeline.compute)
    for got in (*heard, *answered):  # no message that came counts
        got[:] = [None] * len(got)
    gc.collect()
    taken = tracemalloc.take_snapshot().filter_traces(
        [tracemalloc.Filter(True, os.path.dirname(bellows_ros.__file__) + '/*')])
    return sum(trace.size for trace in taken.traces)

partner.wait(lambda: all(
    topic.subscribed for topic in topics_of(predictor)))
predictor.diagnostics.report()
modules, compiled = set(sys.modules), signatures()
pressure_out.publish(stamped(FluidPressure(fluid_pressure=30000.0), START))
partner.wait(lambda: predictor.pipeline.live.attached)
send(300)
pause()
send(100)
predictor.diagnostics.report()
new_modules = sorted(set(sys.modules) - modules)
newly_compiled = sorted(key for key, n in signatures().items() if compiled.get(key) != n)

from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint
from geometry_msgs.msg import (
    InertiaStamped, PoseWithCovarianceStamped, Transform, Twist, Vector3)
from nav_msgs.msg import Path
from std_msgs.msg import Bool
plan_out = partner.writes(MultiDOFJointTrajectory, 'tool_arm/plan')
measured_out = partner.writes(PoseStamped, 'package/measured')
sys.meta_path.pop(0)  # steering needs scipy.optimize, in its thread
valve_out = partner.writes(Bool, 'vacuum/valve')
plans, landings, steered, paths, payloads, stds = answered = [
    partner.hears(kind, topic) for kind, topic in (
        (MultiDOFJointTrajectory, 'package/plan'),
        (PoseWithCovarianceStamped, 'package/landing'),
        (MultiDOFJointTrajectory, 'tool_arm/steered'), (Path, 'package/plan_path'),
        (InertiaStamped, 'package/estimated'), (InertiaStamped, 'package/estimated_std'))]
partner.connect(predictor)
pipeline = predictor.pipeline
planning = pipeline.planning
partner.wait(lambda: planning._plan_out.subscribed)
send(1)
plan = MultiDOFJointTrajectory(joint_names=['tool'], points=[
    MultiDOFJointTrajectoryPoint(
        transforms=[Transform(translation=Vector3(x=1e-3 * (sent % 7)))], velocities=[Twist()],
        time_from_start=Duration(nanosec=k * 10_000_000)) for k in range(51)])
plan_out.publish(plan)
partner.wait(lambda: plans and paths and steered)
send(1)
measured = pose_at(START + sent * STEP_NS + 100_000_000)
measured_out.publish(measured)
partner.wait(lambda: predictor.pipeline.live.package.observer.has_sensor)
def measured_again():
    send(1)
    measured_out.publish(pose_at(START + sent * STEP_NS, (1e-3 * (sent % 7), 0.0, -0.08)))
    return payloads
partner.wait(measured_again)
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from test.nodes.conftest import LATCHED
from test.nodes.test_planning import ARM, joint_plan, UR5E
joints_out = partner.writes(JointTrajectory, 'tool_arm/plan_joints')
joints = partner.hears(JointTrajectory, 'tool_arm/steered_joints')
partner.writes(String, 'robot_description', LATCHED).publish(
    String(data=UR5E.replace(f'"{ARM.root}"', '"world"')))
partner.connect(predictor)
partner.wait(lambda: planning._urdf)
joints_out.publish(joint_plan())
del plans[:]
def answered_all():
    send(1)
    return plans and joints
partner.wait(answered_all)
answered.append(joints)
pipeline.live.package.observer.has_sensor = False
set_on(predictor, 'package.size', [0.2, 0.1, 0.1])
send(2)
needed_later = sorted(set(needed))
tracemalloc.start()
send(400)  # longer than the filter's history
before = held()
send(600)
after = held()
found = {
    'compiled': jit.COMPILED, 'kernels': sum(compiled.values()), 'modules': new_modules,
    'sent': sent, 'answered': [], 'failures': predictor.failures,
    'newly compiled': newly_compiled, 'needed': needed_later, 'of start': of_start,
    'grown': after - before, 'heard': list(map(len, heard)),
    'twists estimated': pipeline.live.motion.estimated, 'coasted': pipeline.live.coasted,
}
needed.clear()
valve_out.publish(Bool(data=True))
valve_out.publish(Bool(data=False))
def landed():
    global sent
    sent += 1
    partner.send(START + sent * STEP_NS)
    return landings and pipeline.live.state == 'released'
partner.wait(landed)
found['answered'] = list(map(len, answered))
print(json.dumps({**found, 'needed': needed_later + needed}))
"""


@pytest.mark.parametrize('cache', [
    'shared', pytest.param('empty', marks=pytest.mark.stress)])
def test_messages_are_answered_and_import_compile_and_keep_nothing(cache, root, tmp_path):
    """
    Answer each topic, and bridge a pause, without a reader of recordings.

    Load modules and compile kernels before the topics exist, or in other threads; keep only the
    last few messages. The thread of the executor asks for no kernel afterwards, not even for one
    that is on disk, as it would compile it where nothing is.
    """
    variables = {'PYTHONPATH': str(root)}
    if cache == 'empty':
        variables['NUMBA_CACHE_DIR'] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, '-P', '-c', SCRIPT], env={**os.environ, **variables},
        capture_output=True, text=True, timeout=1100, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert min(found['heard']) >= 20 and found['coasted'] > 0
    assert found['heard'][0] == found['sent'] > 1200
    assert min(found['answered']) > 0 and not found['failures'], found
    assert found['modules'] == [] and found['newly compiled'] == []
    assert found['needed'] == [] and bool(found['of start']) is found['compiled']
    assert bool(found['kernels']) is found['compiled']
    assert found['grown'] < 10_000
