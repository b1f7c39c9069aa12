"""The estimated tool twist: exact on quadratics, of second order on smooth motions."""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.live.tool_twist import PoseHistory
import numpy as np
from numpy.testing import assert_allclose
import pytest

from ..cases import ShakenTool


def filled(positions, rotations, stamps_ns):
    """Return a history that has seen these poses."""
    history = PoseHistory()
    for o, R, stamp in zip(positions, rotations, stamps_ns, strict=True):
        history.append(int(stamp), tuple(o), tuple(rotation_to_quaternion(R)))
    return history


@pytest.mark.parametrize('count', [3, 5, 9])
@pytest.mark.parametrize('back', [0, 1])
def test_exact_on_quadratics_even_with_uneven_stamps(count, back):
    rng = np.random.default_rng(count)
    stamps = 1_760_000_000_000_000_000 + np.cumsum(rng.integers(1_000_000, 9_000_000, count))
    t = (stamps - stamps[count - 1 - back]) * 1e-9
    a, b, c, d, e = rng.standard_normal((5, 3))
    R_now = exp_so3(a)
    positions = b + np.outer(t, c) + np.outer(t**2, d)
    rotations = R_now @ exp_so3(np.outer(t, e) + np.outer(t**2, a))
    o, _, v, w = filled(positions, rotations, stamps).state(back)
    assert_allclose(o, b, atol=1e-15)
    assert_allclose(v, R_now.T @ c, atol=1e-10)
    assert_allclose(w, e, atol=1e-10)


def test_second_order_on_a_smooth_motion():
    motion, errors = ShakenTool(np.random.default_rng(1)), []
    for h in (0.008, 0.004, 0.002):
        stamps = np.round(np.arange(-4, 1) * h * 1e9 + 1e9).astype(np.int64)
        samples = [motion.at(stamp * 1e-9) for stamp in stamps]
        history = filled([s[0] for s in samples], [s[1] for s in samples], stamps)
        _, _, v, w = history.state()
        errors.append(np.abs(np.concatenate([v, w]) - samples[-1][2]).max())
    assert np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 1.8), errors


def test_one_pose_has_no_twist_and_two_have_that_of_the_line():
    history = PoseHistory()
    history.append(10, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert history.state()[2:] == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    history.append(10 + 2_000_000, (1.002, 0.0, 0.0), (0.0, 0.0, 0.001, 1.0))
    _, _, v, w = history.state()
    assert_allclose(v, [np.cos(0.002), -np.sin(0.002), 0.0], atol=1e-8)  # in the turned axes
    assert_allclose(w, [0.0, 0.0, 1.0], atol=1e-6)


def test_bursts_give_the_slope_of_the_line_and_not_of_their_noise():
    stamps = np.array([0, 10, 100_000_000, 100_000_010]) + 1
    positions = np.outer([0.0, 1e-4, 0.1, 0.1001], [1.0, 0.0, 0.0])  # 0.1 mm off the line in 10 ns
    history = filled(positions, np.tile(np.eye(3), (4, 1, 1)), stamps)
    assert_allclose(history.state()[2], [1.0, 0.0, 0.0], atol=2e-3)
