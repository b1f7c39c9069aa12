"""What a filter leaves of a motion, and the warning where that is too little."""

from dataclasses import replace
import re

from bellows_ros.core.identification.reduction import MAX_ATTENUATION, pass_band, transmission
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.model.structure import STRUCTURES
from bellows_ros.core.recording.preparation import AUTOMATIC_HALF_WINDOW
from bellows_ros.core.signals.savgol import savgol, weights
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import simulated

ROUND = STRUCTURES['axisymmetric']
L0 = simulated.CUP.length
RATE_HZ = 360.0
AUTOMATIC = round(AUTOMATIC_HALF_WINDOW * RATE_HZ)


@pytest.mark.parametrize('frequency', [2.0, 6.0, 9.37])
def test_what_is_left_is_what_the_filter_leaves(frequency):
    stamps_ns = np.round(np.arange(720) / RATE_HZ * NS_PER_S).astype(np.int64)
    omega, time = 2.0 * np.pi * frequency, stamps_ns / NS_PER_S
    position = np.outer(np.sin(omega * time), [0.01, 0.0, 0.0])
    filtered = savgol(Trajectory(stamps_ns, position, np.tile(np.eye(3), (720, 1, 1))), 30, 6)
    true = 0.01 * omega * np.cos(omega * filtered.stamps_ns / NS_PER_S)
    (part,) = transmission(weights(30, 6, RATE_HZ), RATE_HZ, np.array([frequency]))
    assert_allclose(filtered.twist[:, 0], part * true, atol=1e-6 * 0.01 * omega)


def test_the_automatic_filter_follows_up_to_six_hertz():
    end = pass_band(weights(AUTOMATIC, 6, RATE_HZ), RATE_HZ)
    assert_allclose(end, 6.0, atol=0.05)
    (part,) = transmission(weights(AUTOMATIC, 6, RATE_HZ), RATE_HZ, np.array([end]))
    assert_allclose(part, 1.0 - MAX_ATTENUATION, atol=1e-3)  # steps of 0.05 Hz
    assert_allclose(pass_band(weights(AUTOMATIC // 2, 6, RATE_HZ), RATE_HZ), 2 * end, rtol=0.02)
    assert pass_band(weights(3, 6, RATE_HZ), RATE_HZ) > 50.0


def recorded(frequency, half_window=0):
    """Return samples of a motion with a line of 1 mm along z (Hz), and the filters' noise."""
    slow = simulated.shake()
    motion = replace(
        slow, amplitude=np.append(slow.amplitude, 1e-3), axis=np.append(slow.axis, 2),
        frequency=np.vstack([slow.frequency, [frequency] * 2]), phase=np.append(slow.phase, 0.0))
    recording = simulated.record(
        motion, tool=(2e-5, 5e-5), package=(2e-5, 5e-5), rate_hz=RATE_HZ, half_window=half_window)
    samples = samples_of(recording)
    return samples, recording.noise


def warnings_of(samples, noise, method='least_squares'):
    """Return the warnings about what is too fast."""
    found, _ = simulated.excitation([samples], L0, ROUND, [noise], method=method)
    return [warning for warning in found.warnings if 'too fast' in warning]


def test_a_motion_beyond_the_filter_is_warned_about_and_the_remedy_helps():
    samples, noise = recorded(9.37)
    (warning,) = warnings_of(samples, noise)
    assert warning.startswith('Axial motion of up to')
    assert 'follows up to 6.0 Hz' in warning and 'fit.method: output_error' in warning
    assert not warnings_of(samples, noise, 'output_error'), 'said of a method without filter'
    found = simulated.least_squares([samples], L0, ROUND)
    off = simulated.CUP.stiffness[2, 2] - found.stiffness[2, 2]
    assert off > 5.0 * found.stiffness_std[2, 2]

    half_window = int(re.search(r'package.half_window: (\d+)', warning)[1])
    samples, noise = recorded(9.37, half_window)
    assert warnings_of(samples, noise) == []
    again = simulated.least_squares([samples], L0, ROUND)
    assert abs(again.stiffness[2, 2] - simulated.CUP.stiffness[2, 2]) < 0.2 * off


@pytest.mark.parametrize('frequency', [4.0, 6.0])
def test_a_motion_that_the_filter_follows_is_not_warned_about(frequency):
    assert warnings_of(*recorded(frequency)) == []


def test_noise_along_one_axis_is_no_motion():
    loud = np.array([2e-5, 2e-5, 6e-4])
    recording = simulated.record(
        simulated.shake(), tool=(2e-5, 5e-5), package=(loud, 5e-5), rate_hz=RATE_HZ)
    assert warnings_of(samples_of(recording), recording.noise) == []


@pytest.mark.parametrize(('motion', 'noise'), [
    (simulated.shake(axes=(0, 3)), 1e-4), (simulated.standstills([(0.0, 0.0, 0.0)], 8.0), 1e-3)])
def test_noise_that_is_correlated_is_no_motion(motion, noise):
    """Say of noise that motion capture smooths over 26 ms, in axes that rest, that it is none."""
    recording = simulated.record(
        motion, tool=(2e-5, 5e-5), package=(noise, 5.0 * noise), rate_hz=RATE_HZ,
        kept=np.exp(-1.0 / (RATE_HZ * 0.026)))
    assert warnings_of(samples_of(recording), recording.noise) == []
