"""Simulated recordings for the tests of identification, prepared by the usual workflow."""

import functools

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.least_squares import least_squares as fit_statistics
from bellows_ros.core.identification.least_squares import statistics
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.model.simulation import simulate
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.core.synthetic.motion import MoveAndHold, oscillation, Pose, Sine, waypoints
import numpy as np
from scipy.signal import lfilter

GRAVITY = 9.81
CUP = Cup.thesis()
HELD = Package(2.17, np.diag([0.0087, 0.0087, 0.0173]), (0.0, 0.0, -0.03))
NO_NOISE = (0.0, 0.0)

# Amplitude (m, rad) and frequency (Hz) of the lines of each axis.
LINES = (
    ((0.03, 0.6), (0.004, 2.3)), ((0.03, 0.7), (0.004, 2.6)), ((0.03, 0.8), (0.006, 3.7)),
    ((0.08, 0.5), (0.02, 2.1)), ((0.08, 0.9), (0.02, 2.4)), ((0.20, 0.4), (0.10, 1.9)),
)


@functools.cache
def shake(axes=(0, 1, 2, 3, 4, 5), duration=10.0, seed=1, rest=0.5, lines=LINES):
    """Return a tool motion that drives some axes."""
    sines = [Sine(axis, size, f, f) for axis in axes for size, f in lines[axis]]
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(sines))
    return oscillation(Pose(np.zeros(3), np.eye(3)), rest, 1.0, duration, sines, phase)


def standstills(rotation_vectors, hold=2.0):
    """Return a tool motion from pose to pose, each held still."""
    segments = tuple(
        MoveAndHold(Pose(np.zeros(3), exp_so3(np.array(phi, float))), 0.8, hold)
        for phi in rotation_vectors)
    return waypoints(Pose(np.zeros(3), np.eye(3)), hold, segments)


TRUTHS = {}


def truth_of(motion, cup, payload, rate_hz):
    """Return the true motions of tool and package, computed once for the same objects."""
    key = motion, id(cup), id(payload), rate_hz
    if key not in TRUTHS:
        tool = motion.at_rate(rate_hz, 0)
        TRUTHS[key] = tool, simulate(cup, payload, tool, gravity=GRAVITY), cup, payload
    return TRUTHS[key][:2]


def record(
    motion, cup=CUP, payload=HELD, tool=NO_NOISE, package=NO_NOISE, rate_hz=120.0, seed=1,
    half_window=0, later=0.0, kept=0.0,
):
    """
    Return the prepared recording of a motion, with noise (m, rad per axis), tool late.

    The noise is white, or first-order autoregressive.
    """
    truth, moved = truth_of(motion, cup, payload, rate_hz)
    draw = np.random.default_rng((seed, 2))

    def drawn():
        white = draw.standard_normal((len(truth), 3))
        return np.sqrt(1.0 - kept**2) * lfilter([1.0], [1.0, -kept], white, axis=0)

    streams = [
        PoseStream(
            name, 'world', body.stamps_ns + round(1e9 * behind),
            body.position + noise[0] * drawn(), body.rotation @ exp_so3(noise[1] * drawn()))
        for name, body, noise, behind in (
            ('tool', truth, tool, later), ('package', moved, package, 0.0))]
    return prepare(*streams, PrepareSettings(
        payload=payload, gravity=GRAVITY, tool_half_window=half_window,
        package_half_window=half_window))


def least_squares(recordings, cup_length, structure):
    """Return the fit of samples."""
    return fit_statistics([
        statistics(samples, cup_length, structure) for samples in recordings])
