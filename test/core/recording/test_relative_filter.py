"""Relative filtering: the formulas of appendix J against differences, and both ways compared."""

from dataclasses import replace

from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.lie import log_so3
from bellows_ros.core.recording.relative_filter import composed, filtered_with_lip
from bellows_ros.core.resampling import savgol
from bellows_ros.core.structure import STRUCTURES
from bellows_ros.core.trajectory import Trajectory
import numpy as np
from numpy.testing import assert_allclose

from ..cases import ShakenTool
from ..identification import simulated

COM = np.array([0.01, -0.02, -0.05])


def derivatives(poses, k, step_s):
    """Return body twist and its derivative at sample k, by differences of fourth order."""
    def twist(i):
        weights = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * step_s)
        window = slice(i - 2, i + 3)
        R = poses.rotation[i]
        return np.concatenate([
            R.T @ (weights @ poses.position[window]),
            weights @ log_so3(R.T @ poses.rotation[window])])

    near = np.array([twist(k + j) for j in (-2, -1, 1, 2)])
    return twist(k), np.array([1.0, -8.0, 8.0, -1.0]) @ near / (12.0 * step_s)


def both(recording):
    """Return the samples of absolute and of relative filtering."""
    settings = replace(recording.settings, relative=True)
    return samples_of(recording), samples_of(replace(recording, settings=settings))


def test_formulas_of_the_appendix_are_right():
    """Compose two moving frames and differentiate the poses of their product."""
    rng = np.random.default_rng(5)
    rate = 2000.0
    tool, lip = (
        savgol(ShakenTool(rng, f, 0.05, 0.4).trajectory(0.2, rate), 8, 6) for f in (1.3, 2.1))
    package = composed(tool, lip, COM)
    for k in (100, 200, 300):
        twist, acceleration = derivatives(package, k, 1.0 / rate)
        assert_allclose(package.twist[k], twist, rtol=0, atol=1e-6)
        # Second differences of poses lose digits: 1e-16 * rate^2 and more.
        assert_allclose(package.acceleration[k], acceleration, rtol=0, atol=1e-4)


def test_lip_poses_are_undone_by_composing():
    recording = simulated.record(simulated.shake(duration=3.0))
    tool, package = recording.measured_tool, recording.measured_package
    com = simulated.HELD.com
    _, again = filtered_with_lip(tool, package, com, (2, 4), (2, 4))
    # Through five exact samples a quartic goes exactly.
    assert_allclose(again.position, package.position[2:-2], atol=1e-12)
    assert_allclose(again.rotation, package.rotation[2:-2], atol=1e-12)


def test_windows_may_differ_and_invalid_samples_spread():
    recording = simulated.record(simulated.shake(duration=3.0))
    tool, package = recording.measured_tool, recording.measured_package
    valid = np.ones(len(package), dtype=bool)
    valid[150] = False
    marked = Trajectory(package.stamps_ns, package.position, package.rotation, valid=valid)
    for windows in ((5, 9), (9, 5)):
        pair = filtered_with_lip(
            tool, marked, simulated.HELD.com, (windows[0], 4), (windows[1], 4))
        assert [len(t) for t in pair] == [len(tool) - 18] * 2
        assert np.array_equal(pair[0].stamps_ns, package.stamps_ns[9:-9])
        lost = np.flatnonzero(~pair[1].valid) + 9
        assert_allclose(lost, np.arange(150 - windows[1], 150 + windows[1] + 1))


def test_without_noise_both_ways_find_the_cup():
    recording = simulated.record(simulated.shake(), rate_hz=240.0)
    for samples in both(recording):
        fit = simulated.least_squares([samples], simulated.CUP.length, STRUCTURES['axisymmetric'])
        assert_allclose(np.diag(fit.stiffness), np.diag(simulated.CUP.stiffness), rtol=2e-3)
        assert_allclose(np.diag(fit.damping), np.diag(simulated.CUP.damping), rtol=2e-2)


def test_with_equal_windows_noise_does_the_same_to_both():
    """Find what the bench's table says: the ways differ by far less than noise moves either."""
    recording = simulated.record(
        simulated.shake(), tool=(1e-4, 5e-4), package=(1e-4, 5e-4), rate_hz=240.0)
    absolute, relative = (
        simulated.least_squares([samples], simulated.CUP.length, STRUCTURES['axisymmetric'])
        for samples in both(recording))
    for name in ('stiffness', 'damping'):
        one, other = (np.diag(getattr(fit, name)) for fit in (absolute, relative))
        std = np.diag(getattr(absolute, f'{name}_std'))
        assert np.all(np.abs(one - other) < 0.5 * std)
