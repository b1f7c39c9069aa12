"""Pictures of a fit, of samples and of whiteness: what is drawn stands where the numbers say."""

from bellows_ros.plots.prediction import interval_figure
from bellows_ros.plots.recording import spans
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


def test_intervals_are_to_scale_and_unknown_ones_dashed():
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


def test_runs_of_samples_begin_and_end_where_they_should():
    """Let a run last from its first sample to a step after its last one."""
    mask = np.array([True, True, False, False, True])
    assert spans(mask, np.arange(5) * 0.5, 0.5) == [(0.0, 1.0), (2.0, 0.5)]
    assert spans(~mask, np.arange(5) * 0.5, 0.5) == [(1.0, 1.0)]
    assert spans(np.zeros(3, bool), np.arange(3.0), 1.0) == []
