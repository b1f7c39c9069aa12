"""Scores against hand calculation."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.residuals import relative_coordinates, score
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest


def test_scores_of_a_sine_that_is_a_tenth_too_small():
    t = np.arange(1000) / 1000
    measured = np.sin(2 * np.pi * t)[:, None] * np.arange(1.0, 7.0)
    result = score(measured, 0.9 * measured)
    assert_allclose(result.rms, 0.1 * np.sqrt(0.5) * np.arange(1.0, 7.0), rtol=1e-12)
    assert_allclose(result.largest, 0.1 * np.arange(1.0, 7.0), rtol=1e-12)
    assert_allclose(result.nrmse, 0.1, rtol=1e-12)
    assert result.samples == 1000


def test_an_axis_that_does_not_move_has_no_nrmse():
    measured = np.zeros((10, 6))
    assert np.all(np.isnan(score(measured, measured + 1.0).nrmse))


def test_nothing_to_compare_is_an_error():
    with pytest.raises(BellowsError):
        score(np.zeros((0, 6)), np.zeros((0, 6)))


def test_relative_coordinates_do_not_depend_on_the_world():
    rng = np.random.default_rng(0)
    stamps = np.arange(5)
    R, o = exp_so3(rng.standard_normal((5, 3))), rng.standard_normal((5, 3))
    phi, d = 0.5 * rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    tool = Trajectory(stamps, o, R)
    package = Trajectory(stamps, o + np.einsum('nij,nj->ni', R, d), R @ exp_so3(phi))
    assert_allclose(relative_coordinates(tool, package), np.hstack([d, phi]), atol=1e-14)


def test_different_stamps_are_refused():
    R, o = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    with pytest.raises(BellowsError):
        relative_coordinates(Trajectory([0, 1], o, R), Trajectory([0, 2], o, R))
