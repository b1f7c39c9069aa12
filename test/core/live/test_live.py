"""The live predictor without ROS: pairing, refusals, recovery, and the rig's truth."""

from dataclasses import replace
import math

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import ZERO
from bellows_ros.core.live import Predictor, tool_twist
from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.observer.states import CAMERA, STATE
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.parameters.conversion import cup_of, package_of
from bellows_ros.core.synthetic.recipe import read_recipe
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.files.safe_yaml import load
import numpy as np
import pytest

from ...cell.cup import PLATE
from ...cell.motion import ShakenTool, START, UPRIGHT
from ...cell.sensors import sent_by

PERIOD = 2_777_778


class SentMessages:
    """A tool motion as messages: stamps, poses and twists in world axes."""

    def __init__(self):
        self.tool = ShakenTool(np.random.default_rng(4)).trajectory(1.0, 360)
        self.stamps, self.positions, self.quaternions, self.linear, self.angular = sent_by(
            self.tool, START, in_world=True)

    def __len__(self):
        return len(self.stamps)

    def pose(self, predictor, k):
        """Send one pose."""
        return predictor.on_pose(
            self.stamps[k], 'base', self.positions[k], self.quaternions[k])

    def twist(self, predictor, k):
        """Send one twist."""
        return predictor.on_twist(self.stamps[k], self.linear[k], self.angular[k])


@pytest.fixture(scope='module')
def messages():
    return SentMessages()


@pytest.fixture
def predictor():
    return Predictor(Cup.thesis(), PLATE, 9.81)


def errors(predictions, truth):
    """Return the largest position error (m) and rotation error (rad)."""
    position = np.array([p.position for p in predictions])
    rotation = quaternion_to_rotation(np.array([p.quaternion_xyzw for p in predictions]))
    turn = log_so3(np.swapaxes(rotation, 1, 2) @ truth.rotation[:len(predictions)])
    return np.abs(position - truth.position[:len(predictions)]).max(), np.abs(turn).max()


def is_finite(prediction):
    """Return whether all numbers of a prediction are finite."""
    parts = (*prediction.body, prediction.force, prediction.moment, *prediction.tool)
    return all(math.isfinite(x) for part in parts for x in part)


@pytest.mark.parametrize(('order', 'burst', 'relaxation'), [
    (('pose', 'twist'), 1, (0.0, 0.0)), (('twist', 'pose'), 1, (0.0, 0.0)),
    (('pose', 'twist'), 3, (0.0, 0.0)), (('pose', 'twist'), 1, (0.2, 0.25))])
def test_equals_the_simulation_in_any_order_of_messages(messages, order, burst, relaxation):
    out, cup = [], replace(Cup.thesis(), relaxation=relaxation)
    predictor = Predictor(cup, PLATE, 9.81)
    predictor.expect_twists(True)
    for k in range(0, len(messages) - 2, burst):
        for kind in order:
            for j in range(k, k + burst):
                out += getattr(messages, kind)(predictor, j)
    body = simulate(cup, PLATE, messages.tool)
    assert {len(p.strains) for p in out} == {2 * any(relaxation)}
    assert [p.stamp_ns for p in out] == messages.stamps[:len(out)]
    assert len(out) >= len(messages) - 2
    assert predictor.motion.estimated == 0
    position, turn = errors(out, body)
    assert position < 1e-12
    assert turn < 1e-11


def test_twists_are_waited_for_once_they_come_and_no_longer_than_the_limit(messages, predictor):
    for k in range(60):
        out = messages.pose(predictor, k)
        if k < 20:
            late = messages.twist(predictor, k)
            assert k < 10 or (len(out), len(late)) == (0, 1)
            continue
        assert predictor.pairing.waiting * PERIOD <= tool_twist.MAX_WAIT_NS + PERIOD
    assert not predictor.pairing.expect
    assert predictor.pairing.waiting == 0
    assert predictor.predictions == 60


@pytest.mark.parametrize(('with_twists', 'limit'), [(True, 1e-8), (False, 1e-6)])
def test_shipped_moves_without_noise_are_predicted_within_1_um(root, with_twists, limit):
    """On the motion of bags/validation at 500 Hz, against its simulation at 8 kHz."""
    given = resolve(read_parameters(root / 'bags/cup.yaml'), ())
    cup, package = cup_of(given), package_of(given)
    motion = read_recipe(load(root / 'bags/validation.yaml'), package.com).motion
    truth = simulate(cup, package, motion.at_rate(8000.0), gravity=given.gravity.magnitude)
    live = Predictor(cup, package, given.gravity.magnitude, 'tool')
    live.expect_twists(with_twists)
    out = []
    for stamp_ns, o, q, v, w in zip(*sent_by(motion.at_rate(500.0)), strict=True):
        if with_twists:
            live.on_twist(stamp_ns, v, w)
        out += live.on_pose(stamp_ns, 'world', o, q)
    position, turn = errors(out, truth.select(slice(None, None, 16)))
    assert position < limit and turn < 10.0 * limit


@pytest.mark.parametrize(('speed', 'reason'), [
    (1e3, 'twist_too_fast'), (1e150, 'twist_too_fast'), (1e308, 'twist_too_fast'),
    (math.nan, 'twist_nan')])
def test_absurd_twists_are_refused_and_their_poses_predicted(messages, predictor, speed, reason):
    predictor.expect_twists(True)
    out = []
    for k in range(40):
        out += messages.pose(predictor, k)
        out += predictor.on_twist(messages.stamps[k], (speed, 0.0, 0.0), (0.0, speed, 0.0))
    out += predictor.flush()
    assert all(map(is_finite, out))
    assert (len(out), predictor.refused[reason]) == (40, 40)
    predictor.reset()
    assert predictor.pairing.expect  # again, as it was told


def test_model_that_cannot_be_integrated_is_started_from_rest(messages, predictor):
    messages.pose(predictor, 0)
    thesis = Cup.thesis()  # whose damper now creates energy
    predictor.package.set_model(Cup(thesis.stiffness, -100.0 * thesis.damping, 0.0481), PLATE)
    (out,) = messages.pose(predictor, 1)
    assert is_finite(out)
    assert predictor.restarts['diverged'] == 1


def test_what_an_observer_has_learned_outlasts_a_divergence(messages, predictor):
    """Keep the pose of a camera that is 2 mm off."""
    observer, thesis, shifts = predictor.package.observer, Cup.thesis(), []
    for k in range(360):
        if k == 300:
            predictor.package.set_model(
                Cup(thesis.stiffness, -3.0 * thesis.damping, 0.0481), PLATE)
        (out,) = messages.pose(predictor, k)
        assert is_finite(out)
        if k % 5 == 0 and k < 300:
            predictor.on_measured(
                messages.stamps[k], 'base', tuple(np.add(out.position, 0.002)),
                out.quaternion_xyzw)
        if (estimate := observer.estimate) is not None:
            shifts.append(estimate.theta[CAMERA - STATE:][:3])
    assert predictor.restarts['diverged'] > 0
    np.testing.assert_allclose(shifts[-1], shifts[299], atol=2e-4)
    assert np.abs(shifts[-1]).max() > 2e-4


def test_pause_is_bridged_up_to_the_limit(messages):
    live = Predictor(Cup.thesis(), PLATE, 9.81, coast_limit_ns=100_000_000)
    truth = simulate(Cup.thesis(), PLATE, messages.tool)
    arrivals = [stamp - START for stamp in messages.stamps]
    for k in range(180):
        live.on_pose(
            messages.stamps[k], 'base', messages.positions[k], messages.quaternions[k],
            arrivals[k])
        live.on_twist(messages.stamps[k], messages.linear[k], messages.angular[k])
    assert live.coast(arrivals[179] + 5_000_000) == []  # nothing is missing yet
    bridged = [p for ms in range(25, 300, 5) for p in live.coast(arrivals[179] + ms * 1_000_000)]
    assert [p.stamp_ns - messages.stamps[179] for p in bridged] == [
        ms * 1_000_000 for ms in range(25, 101, 5)]
    assert all(p.coasting and is_finite(p) for p in bridged)
    phases = [live.phase(arrivals[179] + ms * 1_000_000) for ms in (0, 50, 101, 5000)]
    assert phases == [
        'settling', 'coasting', 'interrupted', 'interrupted']  # the tool moved at the start
    first = int(np.searchsorted(messages.stamps, bridged[0].stamp_ns))
    assert np.linalg.norm(bridged[0].position - truth.position[first]) < 5e-3
    # The pause has left no trace: the next pose continues from the last one.
    (back,) = live.on_pose(
        messages.stamps[216], 'base', messages.positions[216], messages.quaternions[216],
        arrivals[216]) or live.flush()
    assert not back.coasting
    assert live.restarts['gap'] == 0
    assert np.linalg.norm(back.position - truth.position[216]) < 5e-3


@pytest.mark.parametrize(('sent_in', 'said', 'verdict'), [
    ('world', 'world', 'fits'), ('tool', 'tool', 'fits'),
    ('tool', 'world', 'does_not_fit'), ('world', 'tool', 'does_not_fit'),
    ('nonsense', 'world', 'does_not_fit'),
])
def test_twists_in_other_axes_are_noticed(messages, sent_in, said, verdict):
    live = Predictor(Cup.thesis(), PLATE, 9.81, twist_frame=said)
    live.expect_twists(True)
    turn = np.diag([-1.0, -1.0, 1.0])  # a tool that points the other way
    for k in range(len(messages)):
        R = turn @ messages.tool.rotation[k]
        q = tuple(rotation_to_quaternion(R).tolist())
        o = tuple((turn @ messages.positions[k]).tolist())
        v = np.reshape(messages.tool.twist[k], (2, 3))
        v = {'world': v @ R.T, 'tool': v, 'nonsense': 3.0 * v + 0.5}[sent_in]
        live.on_pose(messages.stamps[k], 'base', o, q)
        live.on_twist(messages.stamps[k], tuple(v[0].tolist()), tuple(v[1].tolist()))
    assert live.motion.verdict == verdict


@pytest.mark.parametrize(('tool', 'package', 'refused'), [
    ('base', '', 0), ('', 'base', 0), ('', '', 0), ('base', 'base', 0), ('base', 'camera', 1)])
def test_a_message_without_a_frame_is_in_the_expected_one(tool, package, refused):
    live = Predictor.from_parameters({
        'package.mass': 1.0, 'package.com': [0.0, 0.0, -0.05],
        'package.inertia': [0.01, 0.01, 0.01, 0.0, 0.0, 0.0]})
    live.on_pose(START, tool, (0.0, 0.0, 1.0), UPRIGHT)
    live.on_measured(START, package, (0.0, 0.0, 0.9), UPRIGHT)
    assert live.package.observer.counts['frame_id'] == refused


def test_package_is_above_the_tool_only_if_it_was_so_at_rest(predictor):
    """Ignore a tool that turns over in motion."""
    found = []
    for k, angle in enumerate([*np.zeros(60), *np.linspace(0.0, np.pi, 60), *[np.pi] * 60]):
        q = (math.sin(0.5 * angle), 0.0, 0.0, math.cos(0.5 * angle))
        predictor.on_pose(START + k * PERIOD, 'base', ZERO, q)
        found.append(predictor.is_above)
    assert (any(found[:115]), all(found[140:])) == (False, True)
