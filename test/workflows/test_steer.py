"""Limits of motions in a file, and joint trajectories: steered, and in the shortest safe time."""

import json
from pathlib import Path

from bellows_ros.cli import main
from bellows_ros.core.geometry.lie import log_se3, quaternion_to_rotation, transform
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.core.planning.limits import demands, read_limits
from bellows_ros.core.planning.plan_prediction import SETTLED_ANGLE
from bellows_ros.core.planning.points import quintic, timed
from bellows_ros.core.planning.steering import steer
from bellows_ros.files import safe_yaml
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.plans import JOINTS, MULTI_DOF, plans_in
from bellows_ros.workflows.plan import read_plan, steer_plan
import numpy as np
import pytest

from ..core.planning.arms import SEVEN, SEVEN_START, UR5E, UR5E_START


@pytest.mark.parametrize('plan', ['transport', 'throw'])
def test_the_sample_plans_are_steered_within_the_sample_limits(root, plan):
    """As a user tries both files first; the time is the shortest, to a percent."""
    file = root / 'config/limits_example.yaml'
    found = steer_plan(root / f'bags/{plan}.yaml', read_parameters(root / 'bags/tossing.yaml'),
                       'zvd', file)
    limits = read_limits(safe_yaml.load(file))
    slowed = next(each.numbers for each in found.notes if each.code == 'slowed')
    assert slowed['limit'] == 'speed' and max(found.used.values()) <= 1.0 + 1e-6
    quicker = steer(found.source.model, timed(found.source.tool, 0.99 * slowed['scale']), 'zvd')
    assert demands(quicker.tool)['speed'] > limits.rates['speed']


def test_the_fastest_steered_plan_is_safe_and_rests(root):
    """The factor less two deviations is as required; a faster motion would swing."""
    values = read_parameters(root / 'bags/tossing.yaml')
    report = steer_plan(root / 'bags/transport.yaml', values, 'zv', seek_fastest=True)
    found, least = report.as_json(), report.source.values.safety.least
    factor, std = found['smallest_safety_factor'], found['smallest_safety_factor_std']
    assert found['requested'] == 'zv' and found['swing_left'] < SETTLED_ANGLE
    assert least <= factor - 2.0 * std
    ((_, _, slowed, _),) = report.notes
    quicker = steer(report.source.model, timed(report.source.tool, 0.999 * slowed['scale']), 'zv')
    assert slowed['limit'] == 'swing' and quicker.residual > SETTLED_ANGLE
    assert found['duration'] < steer_plan(
        root / 'bags/transport.yaml', values, 'zv').as_json()['duration']


def write_request(start, names, path, by=0.0):
    """Write 0.8 s of a motion of all joints at 100 Hz as YAML, from rest to rest."""
    t = np.linspace(0.0, 1.0, 81)
    s, ds = t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2 / 0.8
    change = by * np.ones(len(start)) if by else 0.25 * np.cos(np.arange(len(start)))
    points = [{
        'positions': (np.array(start) + s[k] * change).tolist(),
        'velocities': (ds[k] * change).tolist(), 'accelerations': [], 'effort': [],
        'time_from_start': {'sec': 0, 'nanosec': round(8e8 * t[k])}} for k in range(len(t))]
    points[-1]['velocities'] = [0.0] * len(start)
    header = {'stamp': {'sec': 0, 'nanosec': 0}, 'frame_id': ''}
    path.write_text(json.dumps({
        'header': header, 'joint_names': list(names), 'points': points}))


ARMS = {'UR5e': (UR5E, UR5E_START), 'seven joints': (SEVEN, SEVEN_START)}


@pytest.fixture(params=ARMS)
def arm(request, tmp_path):
    """Give an arm; its URDF and its plan are files."""
    urdf, start = ARMS[request.param]
    found = read_arm(urdf, 'tool')
    (tmp_path / 'arm.urdf').write_text(urdf)
    write_request(start, found.moving, tmp_path / 'plan.yaml')
    return found


def run(root, folder, command, *more):
    """Run a command on the plan, and return its exit code."""
    return main([
        command, str(folder / 'plan.yaml'), '--params', str(root / 'bags/tossing.yaml'), '--urdf',
        str(folder / 'arm.urdf'), '--set', 'tool_link=tool', '--out', str(folder / 'out'),
        *more])


def answer(root, folder, command, *more):
    """Run a command on the plan, and return the joints and the tool that it writes."""
    assert run(root, folder, command, *more) == 0
    plans = dict(plans_in(folder / 'out'))
    joints, tool = plans['/tool_arm/plan_joints'], plans['/tool_arm/plan']
    assert (joints.kind, tool.kind) == (JOINTS, MULTI_DOF)
    values = resolve(read_parameters(root / 'bags/tossing.yaml'))
    assert not read_plan(folder / 'out', values).notes  # one plan beside its answers
    values = values.replaced({'tool_link': 'tool'})
    assert read_plan(folder / 'out', values, str(folder / 'arm.urdf')).joints is not None
    return joints, tool


def require_same_motion(arm, joints, tool):
    """Compare forward kinematics with the Cartesian answer at every point of the joints."""
    common, _, k = np.intersect1d(joints.times_ns, tool.times_ns, return_indices=True)
    assert len(common) == len(joints.times_ns) and np.diff(common).max() < 21e6
    T, _ = arm.tool(joints.points)
    wanted = transform(quaternion_to_rotation(tool.points[k, 3:]), tool.points[k, :3])
    off = np.abs(log_se3(np.linalg.inv(wanted) @ T))
    assert off[:, :3].max() < 0.05e-3 and off[:, 3:].max() < 0.1e-3


@pytest.mark.parametrize(('options', 'acceleration'), [
    ('--steer zvd', np.inf), ('--steer zvd --limits limits.yaml', 2.0), ('--fastest', np.inf)])
def test_joints_move_the_tool_as_answered_within_their_limits(
        arm, root, tmp_path, monkeypatch, options, acceleration):
    """Also between the points, where a driver interpolates by quintics."""
    monkeypatch.chdir(tmp_path)
    Path('limits.yaml').write_text('joint_acceleration: 2.0\n')
    joints, tool = answer(root, tmp_path, 'plan', *options.split())
    assert joints.names == arm.moving
    assert options == '--steer zvd' or joints.times_ns[-1] != 800_000_000
    require_same_motion(arm, joints, tool)
    t = joints.times_ns / 1e9
    curve, times = quintic(t, *joints[5:]), np.arange(0.0, t[-1], 1e-3)
    limits = [joint.speed for joint in arm.moving_joints]
    assert (np.abs(curve(times, 1)).max(axis=0) <= np.array(limits) * (1 + 1e-6)).all()
    assert np.abs(curve(times, 2)).max() <= acceleration * (1 + 1e-6)
    places = tool.times_ns[tool.times_ns <= joints.times_ns[-1]] / 1e9
    T, _ = arm.tool(curve(places))
    assert np.abs(T[:, :3, 3] - tool.points[:len(places), :3]).max() < 0.05e-3


def test_a_singular_path_is_refused_with_its_time(root, tmp_path, capsys):
    (tmp_path / 'arm.urdf').write_text(UR5E)
    names = read_arm(UR5E, 'tool').moving
    straight = (*UR5E_START[:4], 0.1, UR5E_START[5])  # wrist 2 turns through zero
    write_request(straight, names, tmp_path / 'plan.yaml', by=-0.2)
    assert run(root, tmp_path, 'plan') == 2
    assert not (tmp_path / 'out').exists()
    assert 'singular at 0.' in capsys.readouterr().err
