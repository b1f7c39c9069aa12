"""A force-torque sensor in the fit, with errors of its gains and hysteresis, and an empty run."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.identification.methods import fitted
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.recording.prepared_faults import wrong_set_up
from bellows_ros.core.sensors.weighing import without_walk
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.synthetic.motion import MoveAndHold, Pose, Waypoints
from bellows_ros.errors import BellowsError
from bellows_ros.workflows.gripper import gripper_of
import numpy as np
import pytest

from . import wrench_cell
from ..identification import felt

LARGEST = np.array([0.06, 0.03, 0.03, 0.03])  # of K x, z, rx, rz
ALONE = {'ATI': [0.06, 0.04, 0.02, 0.02, 0.01], 'UR': [0.1, 0.06, 0.02, 0.02, 0.01]}
SEEDS = 20


@pytest.mark.parametrize('sensor', felt.SENSORS)
def test_an_empty_run_gives_the_gripper(sensor):
    """Mass and first moments are within three of their standard deviations, the mass to 1.5 %."""
    values = felt.settings(sensor)
    found = gripper_of(*felt.empty_run(3, sensor, values))
    mass, com, _ = wrench_cell.numbers_of(*felt.GRIPPER)
    std = np.array(found['gripper.std'])
    assert abs(found['gripper.mass'] / mass - 1.0) < min(3.0 * np.hypot(std[0], 0.01), 0.015)
    size = np.linalg.norm(com)
    assert np.linalg.norm(found['gripper.com'] - com) / size < 3.0 * np.hypot(std[1], 0.01)
    opposite = values.replaced({'wrench.sign': 'reaction'})
    with pytest.raises(BellowsError, match='wrench.sign'):
        gripper_of(*felt.empty_run(3, sensor, opposite))


def test_a_random_walk_is_whitened_as_by_its_covariance():
    """As by the inverse of the Cholesky factor of the whole covariance."""
    rng = np.random.default_rng(0)
    seconds = np.cumsum(rng.uniform(0.01, 0.2, 40))
    values, variance, drift = rng.standard_normal((40, 6, 3)), rng.uniform(0.5, 2.0, 6), np.r_[
        0.0, rng.uniform(0.1, 3.0, 5)]
    for i, found in enumerate(np.moveaxis(without_walk(values, seconds, variance, drift), 1, 0)):
        covariance = variance[i] * np.eye(40) + drift[i]**2 * np.minimum.outer(seconds, seconds)
        np.testing.assert_allclose(
            found, np.linalg.solve(np.linalg.cholesky(covariance), values[:, i]), atol=1e-12)


def test_wrenches_give_the_mass_and_poses_the_rest():
    """With a mass 10 % off, it is found to 2 %, and K with it, within three standard errors."""
    fit, errors, std = felt.joint_fit(0, 'ATI', 6.0)
    assert fit.converged and np.all(np.abs(errors) < 3.0 * std)
    assert abs(errors[-1]) < 0.02 and std[-1] < 0.015


@pytest.mark.stress
@pytest.mark.parametrize(('name', 'value'), [
    ('wrench.sign', 'reaction'), ('wrench.frame', '0 0 0 0 0 0 1')])
def test_wrenches_that_contradict_the_poses_are_refused(name, value):
    """Of a sensor with another sign, or in another place."""
    values = felt.settings('ATI', **{name: value})
    with pytest.raises(BellowsError, match='contradict the poses'):
        fitted([felt.recorded(0, 'ATI', 4.0, values=values)], values)


@pytest.mark.stress
@pytest.mark.parametrize('sensor', felt.SENSORS)
def test_wrenches_alone_give_k_and_mass(sensor):
    """Truth is within two standard errors in 90 % of 20 recordings; RMS errors are in `ALONE`."""
    runs = [felt.joint_fit(seed, sensor, with_poses=False)[1:] for seed in range(SEEDS)]
    errors, std = np.array(runs).transpose(1, 0, 2)
    assert np.mean(np.abs(errors) < 2.0 * std) >= 0.9
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < ALONE[sensor])


@pytest.mark.stress
@pytest.mark.parametrize('sensor', felt.SENSORS)
def test_truth_is_within_two_standard_errors(sensor):
    """In 90 % of 20 recordings, of each number; the median error is below what a user needs."""
    runs = [felt.joint_fit(seed, sensor)[1:] for seed in range(SEEDS)]
    errors, std = np.array(runs).transpose(1, 0, 2)
    assert np.all(np.mean(np.abs(errors) < 2.0 * std, axis=0) >= 0.85)
    assert np.mean(np.abs(errors) < 2.0 * std) >= 0.9
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < [*LARGEST, 0.01])


def changed(felt_values, set_up, R):
    """Return wrenches (N, 6) of a wrong set-up, with axes (N, 3, 3) of the tool in the world."""
    force, moment = np.split(felt_values, 2, axis=1)
    if set_up == 'tcp':
        moment = moment + np.cross(felt.T_TOOL_SENSOR[:3, 3], force)
    if set_up == 'world_axes':
        force, moment = lie.apply(R, force), lie.apply(R, moment)
    factor = {'sign': -1.0, 'compensated': 0.0}.get(set_up, 1.0)
    shown = factor * np.hstack([force, moment])
    return shown - shown[:50].mean(axis=0) if set_up == 'zeroed_holding' else shown


@pytest.mark.stress
def test_a_wrong_set_up_is_named_at_standstills():
    """In 20 recordings with three tilts, mass 7 % off: each wrong set-up, and no sound one."""
    named = {name: [] for name in ('', 'sign', 'world_axes', 'tcp', 'zeroed_holding',
                                   'compensated')}
    for seed in range(SEEDS):
        rng = np.random.default_rng([seed, 21])
        tilts = [np.zeros(3), *np.hstack([rng.uniform(-0.5, 0.5, (3, 2)), np.zeros((3, 1))])]
        poses = [Pose(rng.uniform(-0.2, 0.2, 3), lie.exp_so3(tilt)) for tilt in tilts]
        tool = Waypoints(poses[0], 2.0, tuple(
            MoveAndHold(pose, 1.0, 2.5) for pose in poses[1:])).at_rate(felt.RATE_HZ, 10**9)
        heavier, P = 1.0 + 0.07 * rng.normal(), felt.PACKAGE
        package = Package(heavier * P.mass, heavier * P.inertia, P.com)
        values = felt.settings('UR')
        recording = felt.recording_of(
            tool, simulate(felt.CUP, package, tool, gravity=9.81), package, 'UR', seed, values)
        R = resample(
            recording.aligned_tool, recording.further[0].stamps_ns).rotation
        for name, found in named.items():
            shown = recording.further[0]
            other = replace(shown, values=changed(shown.values, name, R))
            found += [remark.code for remark in wrong_set_up(
                replace(recording, further=(other,)), felt.CUP.length)]
    assert not named.pop('')
    for name, found in named.items():
        assert {*found} <= {f'wrench.{name}', 'wrench.unknown'}
        assert found.count(f'wrench.{name}') >= 0.9 * SEEDS
