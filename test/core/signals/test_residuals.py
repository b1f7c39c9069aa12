"""Scores and spectra against definitions."""

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.screening import unusable_stamps
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal import welch

from ...cell.motion import START


@pytest.mark.parametrize(('count', 'rate_hz'), [(5000, 360.0), (4999, 125.5), (150, 360.0)])
def test_spectrum_is_that_of_scipy(count, rate_hz):
    values = np.cumsum(np.random.default_rng(8).standard_normal((count, 2)), axis=0)
    found = residuals.spectrum(values, rate_hz)
    length = min(count, round(residuals.SEGMENT_S * rate_hz))
    frequency, density = welch(
        values - values.mean(axis=0), rate_hz, 'hann', length, detrend=False, axis=0)
    assert_allclose(found.frequency, frequency, rtol=1e-12)
    assert_allclose(found.density, density, rtol=1e-9, atol=1e-12 * density.max())


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


MS = 1_000_000
S = 1000 * MS
PERIOD = 2 * MS
COUNT = 5696


def sent(count=COUNT):
    """Give stamps at 500 Hz, and arrivals some milliseconds later."""
    stamps = START + PERIOD * np.arange(count)
    late = np.random.default_rng(1).integers(MS, 3 * MS, size=count)
    return stamps, np.maximum.accumulate(stamps + late)


def left_out(stamps, arrivals):
    """Give the indices left out by reason; what remains must increase."""
    found = unusable_stamps(stamps, arrivals)
    bad = np.logical_or.reduce(list(found.values()))
    assert sum(np.count_nonzero(mask) for mask in found.values()) == np.count_nonzero(bad)
    assert np.all(np.diff(stamps[~bad]) > 0)
    return {reason: np.flatnonzero(mask).tolist() for reason, mask in found.items() if mask.any()}


@pytest.mark.parametrize('ahead', [25 * MS, 100 * MS, 5 * S, 3600 * S])
@pytest.mark.parametrize('at', [100, 1000, COUNT - 1])
def test_one_future_stamp_is_the_only_omitted_one(at, ahead):
    stamps, arrivals = sent()
    stamps[at] += ahead
    assert left_out(stamps, arrivals) == {'future_stamp': [at]}


@pytest.mark.parametrize('set_back', [30 * MS, S, 3600 * S])
@pytest.mark.parametrize('at', [500, 4000])
def test_a_clock_that_is_set_back_costs_the_shorter_part_of_what_overlaps(at, set_back):
    stamps, arrivals = sent()
    stamps[at:] -= set_back
    overlap = min(set_back // PERIOD, at, COUNT - at)
    lost = sum(map(len, left_out(stamps, arrivals).values()))
    assert overlap <= lost <= overlap + 1


def test_a_clock_that_is_set_forward_costs_no_pose():
    stamps, arrivals = sent()
    stamps[2000:] += 3600 * S
    assert left_out(stamps, arrivals) == {}


def test_pauses_and_late_arrivals_are_no_faults():
    stamps, arrivals = sent()
    stamps[3000:] += 20 * S
    arrivals[3000:] += 20 * S
    arrivals[1000:] += 40 * MS
    assert left_out(stamps, arrivals) == {}
    assert left_out(stamps[:0], arrivals[:0]) == {}
    assert left_out(stamps[:1], arrivals[:1]) == {}


def test_no_more_are_lost_than_are_wrong():
    rng = np.random.default_rng(2)
    for _ in range(60):
        stamps, arrivals = sent(600)
        right = stamps.copy()
        for at in rng.integers(20, 600, size=rng.integers(1, 6)):
            stamps[at:at + rng.integers(1, 4)] += rng.choice([-S, -5 * MS, 30 * MS, S, 3600 * S])
        wrong = np.count_nonzero(stamps != right)
        lost = sum(map(len, left_out(stamps, arrivals).values()))
        assert lost <= wrong
