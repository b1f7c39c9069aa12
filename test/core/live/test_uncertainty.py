"""The covariance against what happens when K, P and the tool's poses are drawn at random."""

import math

from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.live import Predictor
from bellows_ros.core.live.uncertainty import in_world_axes
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.parameters.checks import resolve
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ...cell.cup import PLATE
from ...cell.motion import ShakenTool
from ...cell.sensors import sent_by

START = 1_760_000_000_000_000_000
PERIOD = 2_777_778
THESIS = Cup.thesis()
COUNT = 1000
DRAWS = 25
SETTLED = 450
"""So many samples after a start it is not felt any more."""


def values(position=0.0, rotation=0.0, cup=THESIS):
    """Return parameters of the uncertainty."""
    return resolve({
        'cup.stiffness_std': np.diag(0.1 * np.diag(cup.stiffness)).ravel().tolist(),
        'cup.damping_std': np.diag(0.2 * np.diag(cup.damping)).ravel().tolist(),
        'tool_noise': (position, rotation),
        'package.mass': 2.17, 'package.mass_std': 0.04, 'package.com_std': [2e-3] * 3})


def exact(**more):
    """Return parameters of a cup and a package that are known."""
    return values(**more).replaced({
        'cup.stiffness_std': (1e-6,) * 36, 'cup.damping_std': (1e-9,) * 36,
        'package.mass_std': 1e-9, 'package.com_std': (1e-9,) * 3})


def tool_poses():
    """Return a gentle motion, slower than the package's modes: position and bending."""
    for k in range(COUNT):
        t = k * PERIOD * 1e-9
        fade = min(1.0, t)
        angle = 0.1 * fade * math.sin(5.0 * t)
        yield (
            START + k * PERIOD, (0.03 * fade * math.sin(7.0 * t), 0.02 * fade * math.sin(4.0 * t),
                                 0.0),
            (0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)))


def predictor(given, cup=THESIS, package=PLATE, **more):
    """Return a predictor with parameters of the uncertainty."""
    live = Predictor(cup, package, 9.81, **more)
    live.package.observer.use_values(given)
    live.package.set_model(cup, package)
    return live


def covariances(given):
    """Return the covariance of each prediction."""
    live = predictor(given)
    return np.array([live.covariance(p.stamp_ns) for stamp, o, q in tool_poses()
                     for p in live.on_pose(stamp, 'world', o, q)])


def stds(C):
    """Return the standard deviations (N, 12) of settled covariances."""
    return np.sqrt(np.diagonal(C[SETTLED:], axis1=1, axis2=2))


def predict(cup=THESIS, package=PLATE, rng=None, position=0.0, rotation=0.0):
    """Return predictions, with noise on the poses where a generator is given."""
    live, out = Predictor(cup, package, 9.81), []
    for stamp, o, q in tool_poses():
        if rng is not None:
            o = tuple((o + rng.normal(0.0, position, 3)).tolist())
            half = rng.normal(0.0, 0.5 * rotation, 3)
            q = np.array(q) + [*half, 0.0]
            q = tuple((q / np.linalg.norm(q)).tolist())
        out += live.on_pose(stamp, 'world', o, q)
    return out


def errors(out, base):
    """Return the differences (N, 12) in body axes: pose, then twist."""
    def arrays(predictions):
        return (np.array([p.position for p in predictions]),
                quaternion_to_rotation(np.array([p.quaternion_xyzw for p in predictions])),
                np.array([[*p.linear, *p.angular] for p in predictions]))
    (o, R, v), (o0, R0, v0) = arrays(out), arrays(base)
    shift = np.einsum('nji,nj->ni', R0, o - o0)
    return np.hstack([shift, log_so3(np.swapaxes(R0, 1, 2) @ R), v - v0])


def rms(array):
    """Return the root mean square over all but the last axis."""
    return np.sqrt(np.mean(np.square(array), axis=tuple(range(np.ndim(array) - 1))))


def test_uncertain_cup_and_package():
    """To first order, where motion couples the axes; the filter adds a model error to twists."""
    rng = np.random.default_rng(5)
    base = predict()
    drawn = []
    for _ in range(DRAWS):
        K, P = (M + np.diag(share * rng.standard_normal(6)) * M
                for M, share in ((THESIS.stiffness, 0.1), (THESIS.damping, 0.2)))
        package = Package(PLATE.mass * (1.0 + 0.02 * rng.standard_normal()), PLATE.inertia,
                          PLATE.com + 2e-3 * rng.standard_normal(3))
        drawn.append(errors(predict(Cup(K, P, 0.0481), package), base)[SETTLED:])
    ratio = np.log2(rms(stds(covariances(values()))) / rms(np.array(drawn)))
    assert_allclose(ratio[:6], 0.0, atol=0.6)
    assert np.all((ratio[6:] > -0.6) & (ratio[6:] < 2.2))


def test_noise_of_the_tool_pose():
    """Yaw is excited by the product of two errors, too, which the filter leaves out."""
    base = predict()
    drawn = [errors(predict(rng=np.random.default_rng(k), position=1e-3, rotation=5e-3), base)
             for k in range(10)]
    said = stds(covariances(exact(position=1e-3, rotation=5e-3)))
    ratio = rms(said) / rms(np.array(drawn)[:, SETTLED:])
    assert_allclose(np.delete(ratio, 5), 1.0, atol=0.2)


def test_covariance_grows_while_coasting():
    live, sizes = predictor(values(position=1e-4)), []
    for stamp, o, q in tool_poses():
        (last,) = live.on_pose(stamp, 'world', o, q, stamp)
    for ms in (0, 25, 50, 100):
        (last,) = live.coast(stamp + ms * 1_000_000) if ms else [last]
        sizes.append(np.trace(live.covariance(last.stamp_ns)[:6, :6]))
    assert sizes == sorted(sizes) and sizes[-1] > 10 * sizes[0]


def test_pose_covariance_is_turned_into_fixed_axes():
    quarter = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # about z: body x is world y
    turned = in_world_axes(np.diag(np.square([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])), quarter)
    assert_allclose(np.diag(turned), [4.0, 1.0, 9.0, 25.0, 16.0, 36.0], atol=1e-12)


@pytest.mark.parametrize(('damping', 'down'), [
    (np.full((6, 6), 10.0), (0.0, 0.0, 0.0, 1.0)),
    (np.diag([66.0, 66.0, 22.0, 0.0, 0.0, 0.0]), (0.0, math.sin(0.6), 0.0, math.cos(0.6)))])
def test_a_covariance_is_positive_semidefinite_for_any_damping(damping, down):
    """In body and in world axes, in every sample, with a diagonal that is not negative."""
    soft = Cup(np.diag([900.0, 900.0, 900.0, 3.0, 3.0, 0.5]), damping, 0.05)
    live = predictor(values(position=1e-3, rotation=1e-2, cup=soft), soft)
    for k in range(300):
        x = 0.02 * math.sin(0.02 * k)
        for p in live.on_pose(START + k * PERIOD, 'world', (x, 0.0, 0.0), down):
            P = live.covariance(p.stamp_ns)
            for C in (P, in_world_axes(P[:6, :6], p.quaternion_xyzw)):
                assert np.array_equal(C, C.T) and np.all(np.diag(C) >= 0.0)
                assert np.linalg.eigvalsh(C)[0] >= -1e-14 * np.abs(C).max()
    assert live.package.has_covariance


@pytest.mark.parametrize(('start', 'twists'), [(200, False), (500, True)])
def test_a_start_under_a_moving_tool_is_covered_until_it_has_settled(start, twists):
    """Against the motion from the beginning: the error lies within what is said, and goes."""
    tool = ShakenTool(np.random.default_rng(twists)).trajectory(6.0, 360)
    truth = simulate(THESIS, PLATE, tool)
    driven = list(zip(*sent_by(tool, START), strict=True))
    live = predictor(exact(position=1e-6, rotation=1e-6), twist_frame='tool')
    live.expect_twists(twists)
    parts, phases, off = [], [], []
    for k in range(start, len(tool)):
        stamp, o, q, v, w = driven[k]
        out = live.on_pose(stamp, 'world', o, q, stamp)
        if twists:
            out += live.on_twist(stamp, v, w)
        (prediction,) = out
        R = truth.rotation[k].T
        error = np.concatenate([
            R @ (prediction.position - truth.position[k]),
            log_so3(R @ quaternion_to_rotation(np.array(prediction.quaternion_xyzw)))])
        std = np.sqrt(np.diag(live.covariance(prediction.stamp_ns))[:6])
        off.append(norms(error))
        parts.append(np.divide(off[-1], norms(std)))
        phases.append(live.phase(stamp))
    count = phases.count('settling')
    assert 700 < count < 1300 and set(phases[count:]) == {'predicting'}
    assert np.max(parts[:count]) < 4.0 and 0.5 < np.median(parts[:count]) < 2.0
    assert np.max(off[:count], axis=0)[0] > 0.015  # m: it is worth being said
    assert np.all(np.max(off[count:], axis=0) < (1e-3, 5e-3))


def norms(six):
    """Return the lengths of the two parts of a six-vector."""
    return np.linalg.norm(six[:3]), np.linalg.norm(six[3:])
