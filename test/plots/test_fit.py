"""Pictures of a fit, of samples and of whiteness: what is drawn stands where the numbers say."""

from bellows_ros.core.signals.residuals import portmanteau, Spectrum
from bellows_ros.plots.fit import excitation_figure, interval_figure, iteration_figure
from bellows_ros.plots.prediction import whiteness_figure
from bellows_ros.plots.recording import spans
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


def test_intervals_are_to_scale_and_unknown_ones_dashed() -> None:
    """Draw the ends of a known interval, and a line across the panel for another."""
    figure = interval_figure(
        [('K x', 0.0, 1.0), ('K x-ry', 5.0, 2.0), ('P x', 0.0, np.nan)], 'note')
    stiffness, damping = figure.axes
    for (bar,), (low, high) in zip(
            (container[2] for container in stiffness.containers), ((-1, 1), (3, 7)), strict=True):
        np.testing.assert_allclose(bar.get_segments()[0][:, 0], (low, high))
    assert [label.get_text() for label in stiffness.get_yticklabels()] == [
        'K x, ±1 %', 'K x-ry, ±2 %']
    line, = damping.get_lines()
    assert line.get_linestyle() == '--'
    assert [label.get_text() for label in damping.get_yticklabels()] == ['P x, not identifiable']


def test_runs_of_samples_begin_and_end_where_they_should() -> None:
    """Let a run last from its first sample to a step after its last one."""
    mask = np.array([True, True, False, False, True])
    assert spans(mask, np.arange(5) * 0.5, 0.5) == [(0.0, 1.0), (2.0, 0.5)]
    assert spans(~mask, np.arange(5) * 0.5, 0.5) == [(1.0, 1.0)]
    assert spans(np.zeros(3, bool), np.arange(3.0), 1.0) == []


@pytest.mark.parametrize(('last', 'scale'), [(0.1, 'log'), (9.0, 'linear')])
def test_the_iteration_is_drawn(last: float, scale: str) -> None:
    """Draw the cost over the steps, and each diagonal over its last value."""
    steps = [{'chi2': chi2, 'stiffness': np.diag([chi2, 2, 3, 4, 5, 0]), 'damping': np.eye(6)}
             for chi2 in (10.0, last)]
    cost, stiffness, _ = iteration_figure(steps, '2 steps').axes
    assert cost.get_yscale() == scale
    np.testing.assert_array_equal(cost.get_lines()[0].get_ydata(), [10.0, last])
    np.testing.assert_allclose(stiffness.get_lines()[0].get_ydata(), [10.0 / last, 1.0])
    np.testing.assert_array_equal(stiffness.get_lines()[5].get_ydata(), [0.0, 0.0])


def test_excitation_is_drawn_per_axis() -> None:
    """Draw shift and rotation apart, without the mean."""
    hertz = np.arange(5.0)
    density = np.arange(1.0, 31.0).reshape(5, 6)
    shift, rotation = excitation_figure(Spectrum(hertz, density), 'note').axes
    for panel, first in ((shift, 0), (rotation, 3)):
        for axis, line in enumerate(panel.get_lines(), first):
            np.testing.assert_array_equal(line.get_xdata(), hertz[1:])
            np.testing.assert_array_equal(line.get_ydata(), density[1:, axis])


def test_whiteness_is_drawn_within_its_band() -> None:
    """Let white noise of any lag stay in the band 19 times of 20."""
    noise = np.random.default_rng(3).normal(size=(4000, 6))
    inside = []
    for panel in whiteness_figure(portmanteau(noise), 'note').axes:
        high, low, found = (line.get_ydata() for line in panel.get_lines())
        inside += list((low < found) & (found < high))
    assert 0.9 < np.mean(inside) < 0.99
