"""Scores and spectra against definitions."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import welch


@pytest.mark.parametrize(('count', 'rate_hz'), [(5000, 360.0), (4999, 125.5), (150, 360.0)])
def test_spectrum_is_that_of_scipy(count, rate_hz):
    values = np.cumsum(np.random.default_rng(8).standard_normal((count, 2)), axis=0)
    found = residuals.spectrum(values, rate_hz)
    length = min(count, round(residuals.SEGMENT_S * rate_hz))
    frequency, density = welch(
        values - values.mean(axis=0), rate_hz, 'hann', length, detrend=False, axis=0)
    assert_allclose(found.frequency, frequency, rtol=1e-12)
    assert_allclose(found.density, density, rtol=1e-9, atol=1e-12 * density.max())


def test_a_motion_with_lost_samples_has_no_power_elsewhere():
    """Keep the spectrum of a slow sine beside its own band where one sample in fifty is lost."""
    t = np.arange(4000) / 200.0
    motion = np.sin(2 * np.pi * 2.0 * t)[:, None]
    lost = np.where(np.random.default_rng(9).random(4000) < 0.02, np.nan, t)
    seen = np.where(np.isfinite(lost)[:, None], motion, np.nan)
    filled = residuals.interpolated(seen)
    assert_allclose(filled, motion, atol=5e-3)  # (omega h)^2 / 2 for two lost in a row
    found = residuals.spectrum(filled, 200.0)
    assert found.density[found.frequency > 5.0].max() < 1e-5 * found.density.max()
    straight = np.column_stack([t, 1.0 - t])
    found = residuals.interpolated(np.where(np.isfinite(lost)[:, None], straight, np.nan))
    assert_allclose(found[1:-1], straight[1:-1], atol=1e-12)
    with pytest.raises(BellowsError):
        residuals.interpolated(np.full((10, 2), np.nan))


def test_band_holds_the_middle_of_the_power():
    """Cut 5 % of a flat spectrum from either end; know nothing of one without power."""
    frequency = np.arange(1.0, 101.0)
    found = residuals.Spectrum(frequency, np.column_stack([np.ones(100), np.zeros(100)]))
    low, high = found.band(0.9)
    assert (low[0], high[0]) == (5.0, 95.0)
    assert np.isnan(low[1]) and np.isnan(high[1])


def test_scores_of_a_sine_that_is_a_tenth_too_small():
    t = np.arange(1000) / 1000
    measured = np.sin(2 * np.pi * t)[:, None] * np.arange(1.0, 7.0)
    result = residuals.score(measured, 0.9 * measured)
    assert_allclose(result.rms, 0.1 * np.sqrt(0.5) * np.arange(1.0, 7.0), rtol=1e-12)
    assert_allclose(result.largest, 0.1 * np.arange(1.0, 7.0), rtol=1e-12)
    assert_allclose(result.nrmse, 0.1, rtol=1e-12)
    assert result.samples == 1000


def test_an_axis_that_does_not_move_has_no_nrmse_and_no_sample_no_score():
    measured = np.zeros((10, 6))
    assert np.all(np.isnan(residuals.score(measured, measured + 1.0).nrmse))
    with pytest.raises(BellowsError):
        residuals.score(measured[:0], measured[:0])


def test_relative_coordinates_do_not_depend_on_the_world():
    rng = np.random.default_rng(0)
    stamps = np.arange(5)
    R, o = exp_so3(rng.standard_normal((5, 3))), rng.standard_normal((5, 3))
    phi, d = 0.5 * rng.standard_normal((5, 3)), rng.standard_normal((5, 3))
    tool = Trajectory(stamps, o, R)
    package = Trajectory(stamps, o + np.einsum('nij,nj->ni', R, d), R @ exp_so3(phi))
    assert_allclose(residuals.relative_coordinates(tool, package), np.hstack([d, phi]), atol=1e-14)
