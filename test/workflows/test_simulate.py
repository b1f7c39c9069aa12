"""Simulated recordings: rates, noise, faults, and what their motion file says."""

import copy
import json

from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.parameters.conversion import tip_of
from bellows_ros.core.signals.trajectory import streams_at_tip
from bellows_ros.core.synthetic.motion import MOTION_KINDS
from bellows_ros.core.synthetic.recipe import read_recipe
from bellows_ros.errors import BellowsError
from bellows_ros.files.bags import read_streams, topics
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

START_NS = 1_700_000_000_000_000_000
K = np.diag([5400.0, 6000.0, 9200.0, 4.2, 3.6, 1.35])
P = np.diag([55.0, 50.0, 24.0, 0.06, 0.07, 0.1])
K[0, 4] = K[4, 0] = 12.0
P[1, 3] = P[3, 1] = -0.2
MASS, INERTIA = 1.8, [0.005, 0.0065, 0.0098, 0.0002, -0.0001, 0.0003]
COM, LENGTH, GRAVITY = np.array([0.004, -0.002, -0.03]), 0.046, 9.79
CUP = Cup(K, P, LENGTH)
PACKAGE = Package(MASS, np.array([
    [0.005, 0.0002, -0.0001], [0.0002, 0.0065, 0.0003], [-0.0001, 0.0003, 0.0098]]), COM)
PARAMETERS = {
    'cup.stiffness': K.ravel().tolist(),
    'cup.damping': P.ravel().tolist(),
    'cup.length': LENGTH,
    'package.mass': MASS,
    'package.inertia': INERTIA,
    'package.com': COM.tolist(),
    'gravity.magnitude': GRAVITY,
    'recording.package_frame': 'com',
}
MOTION = {
    'kind': 'multi_sine',
    'duration': 2.0,
    'rest_duration': 0.3,
    'ramp_duration': 0.4,
    'start': {'position': [0.5, -0.2, 0.8], 'rpy': [0.1, -0.2, 0.7]},
    'multi_sine': {
        'position': {
            'x': {'amplitude': [0.03], 'frequency': [1.3]},
            'z': {'amplitude': [0.01], 'frequency': [3.1]},
        },
        'rotation': {
            'y': {'amplitude': [0.15], 'frequency': [1.1]},
            'z': {'amplitude': [0.3], 'frequency': [0.9]},
        },
    },
    'tool': {'rate_hz': 250.0},
    'package': {'rate_hz': 120.0},
    'truth': True,
}
ROLES = {'tool_pose': '/tool_arm/pose', 'tool_twist': '/tool_arm/twist', 'pose': '/package/pose'}


def motion(**changes):
    """Give the motion with some settings replaced; a dot stands between a block and its own."""
    content = copy.deepcopy(MOTION)
    for path, value in changes.items():
        *blocks, name = path.split('.')
        inner = content
        for block in blocks:
            inner = inner.setdefault(block, {})
        inner[name] = value
    return content


def recorded(tmp_path, content, name='bag'):
    """Simulate, and return the streams and the report."""
    report = simulate_recording(PARAMETERS, content, tmp_path / name)
    return read_streams(tmp_path / name, ROLES), report


def content_of(path):
    """Return the bytes of all files in a folder."""
    return {p.relative_to(path): p.read_bytes() for p in sorted(path.rglob('*')) if p.is_file()}


def test_streams_have_their_own_rates_and_are_the_truth_without_noise(tmp_path):
    streams, report = recorded(
        tmp_path, motion(**{'package.stamps': {'jitter': 0.0, 'latency': 0.012}}))
    with AnyReader([tmp_path / 'bag']) as reader:
        received = {topic: [log_ns for connection, log_ns, _ in reader.messages()
                            if connection.topic == topic] for topic in ROLES.values()}
    for role, late_ns in (('tool_pose', 0), ('tool_twist', 0), ('pose', 12_000_000)):
        assert_array_equal(received[ROLES[role]] - streams[role].stamps_ns, late_ns)
    counts = {name: count for name, _, count in topics(tmp_path / 'bag')}
    assert counts == dict(report.messages)
    assert counts == {'/tool_arm/pose': 501, '/tool_arm/twist': 501, '/package/pose': 241}
    with np.load(tmp_path / 'bag_truth.npz') as truth:
        assert_array_equal(streams['pose'].stamps_ns, START_NS + np.round(truth['t'] * 1e9))
        assert_allclose(streams['pose'].position, truth['package'][:, :3, 3], atol=1e-15)
        assert_allclose(streams['pose'].rotation, truth['package'][:, :3, :3], atol=1e-14)
    assert {s.frame_id for s in streams.values()} == {'world'}
    assert report.duration_s == 2.0 and report.warnings == ()


def test_the_recorded_frame_of_the_tool_is_that_of_the_driver(tmp_path):
    offset = '0.1 0 0.2 1 0 0 0'
    plain, _ = recorded(tmp_path, MOTION)
    simulate_recording({**PARAMETERS, 'tool_pose.offset': offset}, MOTION, tmp_path / 'flange')
    flange = read_streams(tmp_path / 'flange', ROLES)
    poses, twists = streams_at_tip(
        flange['tool_pose'], flange['tool_twist'], tip_of({'tool_pose.offset': offset}), True)
    assert_allclose(poses.position, plain['tool_pose'].position, atol=1e-14)
    assert_allclose(twists.linear, plain['tool_twist'].linear, atol=1e-14)
    assert np.abs(flange['tool_pose'].position - poses.position).max() > 0.1


NOISY = {
    'tool.noise': {'position': 1e-5, 'rotation': 1e-5},
    'package.noise': {'position': 1e-4, 'rotation': 5e-4},
    'package.outliers': {'count': 2, 'position': 0.05, 'rotation': 0.4, 'duration': 0.02},
    'package.dropouts': {'count': 1, 'duration': 0.1},
    'package.stamps': {'jitter': 1e-4, 'latency': 0.0},
}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    for name in ('first', 'second'):
        (tmp_path / name).mkdir()
        simulate_recording(PARAMETERS, motion(**NOISY, seed=5), tmp_path / name / 'bag')
    assert content_of(tmp_path / 'first') == content_of(tmp_path / 'second')
    other, _ = recorded(tmp_path, motion(**NOISY, seed=6), 'other')
    first = read_streams(tmp_path / 'first' / 'bag', ROLES)
    assert np.abs(other['tool_pose'].position - first['tool_pose'].position).max() > 1e-3


# ---- What is refused. ----

MASSLESS = {name: value for name, value in PARAMETERS.items() if name != 'package.mass'}


@pytest.mark.parametrize(('parameters', 'content', 'named'), [
    (MASSLESS, MOTION, r'package\.mass'), ({**PARAMETERS, 'package.mass': 1e3}, MOTION, '1000 kg'),
    (PARAMETERS, None, "'kind'"), (PARAMETERS, motion(sed=1), "'sed'.*'seed'"),
    (PARAMETERS, motion(storage='bag'), "'storage' .* mcap, sqlite3.*'bag'"),
    (PARAMETERS, motion(tool={}), "'tool.rate_hz'"),
    *((PARAMETERS, motion(**changes), named) for changes, named in (
        ({'package.twist': {}}, "'package.twist'"),
        ({'tool.dropouts': {'count': 9, 'duration': 1}}, r"'tool'.*\b2260 samples"),
        ({'tool.outliers': {'count': 2}}, "'tool.outliers.position'"),
        ({'duration': 3600.0}, r'8\.9e\+06 .*5e\+06'),
        ({'multi_sine.position.x.amplitude': [30.0]}, '245 m/s')))])
@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_errors_leave_no_files(tmp_path, parameters, content, named):
    with pytest.raises(BellowsError, match=named):
        simulate_recording(parameters, content, tmp_path / 'bag')
    assert list(tmp_path.iterdir()) == []


# ---- The example that documents every setting. ----


def example(root, kind):
    """Return the example's settings, with the block of another kind in place of the first."""
    text = (root / 'config' / 'motion_example.yaml').read_text()
    content = YAML(typ='safe').load(text)
    others = YAML(typ='safe').load(
        '\n'.join(line[3:] for line in text.splitlines() if line.startswith('#| '))
    )
    assert set(others) | {'multi_sine'} == set(MOTION_KINDS)
    if kind != 'multi_sine':
        del content['multi_sine']
        content.update({'kind': kind, kind: others[kind]})
    if kind in ('waypoints', 'static'):
        del content['duration'], content['ramp_duration'], content['hold']
    return content


@pytest.mark.parametrize('kind', MOTION_KINDS)
def test_the_example_is_valid_for_every_kind(root, kind):
    recipe = read_recipe(example(root, kind), COM)
    assert recipe.motion.duration > recipe.motion.rest_duration == 2.0
    assert recipe.package.jumps.count == 3


def test_the_example_names_every_setting(root, monkeypatch):
    """Ask for nothing that the example does not have."""
    missing, done = set(), Settings.done

    def noticing(self):
        done(self)
        missing.update(self.name(name) for name in self._asked if name not in self)

    monkeypatch.setattr(Settings, 'done', noticing)
    read_recipe(example(root, 'multi_sine'), COM)
    assert not missing


@pytest.mark.parametrize('down', [[0.0, 0.0, -1.0], [2.0, 0.0, 0.0]])
def test_a_plan_takes_the_place_of_the_motion(tmp_path, down):
    """
    The tool is recorded where the plan has it in the world; the tracking is the file's.

    A motion file as a plan moves as it does on its own, also where the world is tilted.
    """
    (tmp_path / 'plan.yaml').write_text(json.dumps(motion()))
    other = motion(duration=1.0, multi_sine={'position': {'y': {
        'amplitude': [0.01], 'frequency': [2.0]}}})
    report = simulate_recording(
        {**PARAMETERS, 'gravity.direction': down}, other, tmp_path / 'planned',
        plan=tmp_path / 'plan.yaml')
    assert report.duration_s == 2.0
    planned = read_streams(tmp_path / 'planned', ROLES)
    simulate_recording(
        {**PARAMETERS, 'gravity.direction': down}, motion(), tmp_path / 'direct')
    direct = read_streams(tmp_path / 'direct', ROLES)
    for body in ('tool_pose', 'pose'):
        assert_allclose(planned[body].position, direct[body].position, atol=1e-6)
        assert_allclose(planned[body].rotation, direct[body].rotation, atol=1e-5)
