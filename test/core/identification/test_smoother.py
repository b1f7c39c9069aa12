"""The filter of small motions: against simulations, and against a dense multivariate normal."""

from bellows_ros.core.geometry import lie
from bellows_ros.core.identification.segments import moved
from bellows_ros.core.identification.smoother import (
    exponentials,
    filtered,
    noise_of_means,
    Process,
    response,
    Sensor,
    small_motion,
    SmallMotion,
    smoothed,
    steps_of,
)
from bellows_ros.core.model import simulation
from bellows_ros.core.model.cup_package import Cup, model_tuple
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.linalg import expm

from ...cell.cup import GRAVITY, PLATE
from ...cell.motion import Shake

TRUTH = Cup.thesis()

STEPS = 12


def displacements(rows, others):
    """Return how far other states (N, 13) are from rows, in their axes (N, 6)."""
    R = lie.quaternion_to_rotation(rows[:, 3:7])
    turned = np.swapaxes(R, 1, 2) @ lie.quaternion_to_rotation(others[:, 3:7])
    return np.hstack([lie.apply(np.swapaxes(R, 1, 2), others[:, :3] - rows[:, :3]),
                      lie.log_so3(turned)])


@pytest.mark.parametrize('hertz', [0.5, 3.0, 8.0, 15.0])
def test_small_motions_are_differences_of_simulations(hertz):
    """Of a cup that moves much, by each axis of a change of the tool's path."""
    rows = simulation.tool_rows(Shake(5).trajectory(6.0, 100.0))
    model, period = model_tuple(TRUTH, PLATE, GRAVITY), 0.01
    seconds = period * np.arange(len(rows))
    start = simulation.rest(model, rows[0])

    def simulated(tool):
        return simulation.simulate_rows(
            model, start, tool, np.full(len(tool) - 1, period), np.full(len(tool) - 1, 10))

    body = simulated(rows)
    amid = [0.5 * (each[1:] + each[:-1]) for each in (rows, body[:, :13])]
    for each in amid:
        each[:, 3:7] /= np.linalg.norm(each[:, 3:7], axis=1)[:, None]
    motion = small_motion(model, *amid, np.full(len(rows) - 1, period))
    for axis in range(6):
        size, rate = 1e-5 * np.eye(6)[axis], 2.0 * np.pi * hertz
        begin = np.minimum(seconds, 1.0) ** 2  # from rest
        begins = np.where(seconds < 1.0, 2.0 * seconds, 0.0)
        wave, slope = np.sin(rate * seconds), rate * np.cos(rate * seconds)
        change = np.outer(begin * wave, size)
        rates = np.outer(begin * slope + begins * wave, size)
        expected = displacements(body, simulated(moved(rows, np.hstack([change, rates]))))
        off = response(motion, np.zeros(12), change)[:, :6] - expected
        error = np.sqrt(np.mean(off**2, axis=0).reshape(2, 3).sum(axis=1))
        whole = np.sqrt(np.mean(expected**2, axis=0).reshape(2, 3).sum(axis=1))
        assert np.all(error < (0.03 if hertz < 10.0 else 0.12) * whole), axis


def test_exponentials_are_those_of_scipy():
    Z = np.random.default_rng(0).normal(size=(3, 6, 6)) * np.array([0.1, 1.0, 8.0])[:, None, None]
    whole, mean, ramp = exponentials(Z)
    exact = expm(Z)
    assert_allclose(whole, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())
    assert_allclose(Z @ mean, exact - np.eye(6), atol=1e-9 * np.abs(exact).max())
    assert_allclose(Z @ Z @ ramp, exact - np.eye(6) - Z, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(('poses', 'kept'), [(1, 0.0), (1, 0.7), (3, 0.0), (3, 0.9)])
def test_noise_of_means_has_their_covariances(poses, kept):
    noise = noise_of_means(np.full(6, 2.0), kept, poses, poses)
    of_poses = 4.0 * kept ** np.abs(np.subtract.outer(np.arange(2 * poses), np.arange(2 * poses)))
    first, second = np.kron(np.eye(2), np.full(poses, 1.0 / poses))
    assert_allclose(noise.covariance[:, 0, 0], first @ of_poses @ first)
    assert_allclose(noise.covariance[:, 0, 1], first @ of_poses @ second, atol=1e-12)


def covariance_of(noise, count):
    """Return the covariance (6 N, 6 N) of a process, from its weights and innovations."""
    order = len(noise.weights)
    size, out = 6 * order, np.zeros((count, 6, count, 6))
    state = noise.stationary
    states = [state]
    for _ in range(count - 1):
        state = noise.transition @ state @ noise.transition.T
        state[:6, :6] += np.diag(noise.variance)
        states.append(state)
    for k, state in enumerate(states):
        ahead = np.eye(size)
        for later in range(k, count):
            block = (ahead @ state)[:6, :6]
            out[later, :, k], out[k, :, later] = block, block.T
            ahead = noise.transition @ ahead
    return out.reshape(6 * count, 6 * count)


def test_the_filter_is_a_dense_normal_distribution():
    """Likelihood, whitened numbers and likeliest path, with missing numbers."""
    rng = np.random.default_rng(1)
    rows = STEPS - 1, 12
    motion = SmallMotion(
        np.eye(12) + 0.2 * rng.normal(size=(*rows, 12)), *0.3 * rng.normal(size=(2, *rows, 6)))
    noise = Process.of(np.outer(0.8 ** np.arange(5) * np.cos(0.7 * np.arange(5)),
                                rng.uniform(0.5, 2.0, 6)))
    places = np.array([0, 1, 2, 5, 6, 9, 11])
    sensor = Sensor(places, 0.1 * rng.normal(size=len(places)),
                    rng.normal(size=(len(places), 6, 6)),
                    noise_of_means(rng.uniform(0.5, 1.5, 6), 0.6, 2, 2.0),
                    rng.uniform(0.0, 1.0, (len(places), 6)))
    root = rng.normal(size=(12, 12))
    first = root @ root.T + np.eye(12)

    def numbers_of(x, change):
        d = response(motion, x, change)
        return np.concatenate([sensor.by_motion(number) @ d[place]
                               for number, place in enumerate(places)])

    by_first = np.column_stack([numbers_of(x, np.zeros((STEPS, 6))) for x in np.eye(12)])
    by_change = np.column_stack([
        numbers_of(np.zeros(12), w.reshape(STEPS, 6)) for w in np.eye(6 * STEPS)])
    of_path = covariance_of(noise, STEPS)
    seen = (6 * places[:, None] + np.arange(6)).ravel()
    C = (by_first @ first @ by_first.T + by_change @ of_path @ by_change.T
         + covariance_of(sensor.noise, STEPS)[np.ix_(seen, seen)] + np.diag(sensor.more.ravel()))
    y = rng.multivariate_normal(np.zeros(len(C)), C)
    found = filtered(motion, noise, sensor, first, np.stack([y, 2.0 * y], -1).reshape(-1, 6, 2))
    assert_allclose(np.sum(found.white[..., 0] ** 2), y @ np.linalg.solve(C, y), rtol=1e-8)
    assert_allclose(found.white[..., 1], 2.0 * found.white[..., 0])
    assert_allclose(found.logs, np.linalg.slogdet(C)[1], rtol=1e-8)
    assert_allclose(np.abs(found.white[..., 0].ravel()),
                    np.abs(np.linalg.solve(np.linalg.cholesky(C), y)), rtol=1e-6)
    x, change = smoothed(motion, noise, sensor, first, found, found.white[..., 0])
    likely = np.linalg.solve(C, y)
    assert_allclose(x, first @ by_first.T @ likely, atol=1e-8)
    assert_allclose(change.ravel(), of_path @ by_change.T @ likely, atol=1e-8)


@pytest.mark.parametrize('begin', [0, 3, 4, 12, 17, 40])
@pytest.mark.parametrize('bin_ns', [10, 12_500_001, 33_000_000])
def test_steps_meet_the_bins(begin, bin_ns):
    bins, first = np.array([2, 3, 5, 9]), 2_000_000_000
    begin_ns = first + 2 * bin_ns - int(begin * bin_ns / 12)
    steps = steps_of(begin_ns, first, bin_ns, bins)
    assert steps.stamps_ns[0] == begin_ns
    assert np.all(np.diff(steps.stamps_ns) > 0)
    off = np.abs(steps.stamps_ns[steps.places] - (first + bins * bin_ns))
    assert np.all(off <= max(0.1 * 1e9 * steps.period, 1.0))
    assert np.max(np.diff(steps.stamps_ns)) <= 1.2e9 * steps.period + 1.0
