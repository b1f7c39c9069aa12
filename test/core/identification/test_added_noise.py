"""Noise after the filters, against filtered recordings of nothing but noise."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.core.synthetic.motion import sample_stamps
import numpy as np
from numpy.testing import assert_allclose
import pytest

POSITION, ROTATION = 1e-4, 5e-4
DURATION = 40.0


def still(name, rate_hz, draw):
    """Return noisy poses of a body that does not move."""
    stamps = sample_stamps(rate_hz, DURATION, 0)
    return PoseStream(
        name, 'world', stamps, POSITION * draw.standard_normal((len(stamps), 3)),
        exp_so3(ROTATION * draw.standard_normal((len(stamps), 3))))


@pytest.mark.parametrize('tool_rate_hz', [120.0, 125.0, 300.0])
def test_noise_of_a_tool_at_the_stamps_of_the_package(tool_rate_hz):
    draw = np.random.default_rng(3)
    recording = prepare(
        still('tool', tool_rate_hz, draw), still('package', 120.0, draw), PrepareSettings())
    noise = recording.noise
    for found, weights, body in (
            (noise.tool, noise.tool_weights, recording.tool),
            (noise.package, noise.package_weights, recording.package)):
        assert_allclose(found, (POSITION, ROTATION), rtol=0.05)
        value, slope = np.linalg.norm(weights[:2], axis=1)
        # a few hundred independent windows, of three axes
        assert_allclose(np.std(body.position), POSITION * value, rtol=0.06)
        assert_allclose(np.std(body.twist[:, :3]), POSITION * slope, rtol=0.06)
        assert_allclose(np.std(body.twist[:, 3:]), ROTATION * slope, rtol=0.06)
