"""The picture of measured against predicted poses."""

import re
import xml.etree.ElementTree as ET

from bellows_ros.core.signals.residuals import Comparison, score
from bellows_ros.plots.pictures import prediction_figure, two_digits
from bellows_ros.plots.style import drawing, inline_svg, THEMES
import numpy as np
import pytest

from .conftest import check_words

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")


SECONDS = np.arange(400) / 100.0 + 0.5 * (np.arange(400) >= 200)


@pytest.fixture(scope='module')
def comparison():
    """Give made-up coordinates with known errors: 0.5 s lost, and once the package alone."""
    amplitude = np.array([0.01, 0.008, 0.0005, 0.2, 0.1, 0.0])
    measured = amplitude * np.sin(3.0 * SECONDS[:, None])
    predicted = measured + np.array([1e-3, -1e-3, 1e-4, 2e-3, 1e-3, 0.0])
    measured[60:65] = np.nan
    stamps = np.rint(1e9 * SECONDS).astype(np.int64)
    return Comparison(stamps, measured, predicted, score(measured, predicted))


@pytest.fixture(scope='module', params=THEMES)
def figure(request, comparison):
    """Give the picture in each theme."""
    return prediction_figure(SECONDS, comparison, 'Title', 'conditions', request.param)


def lines(panel):
    """Return the curves of a panel."""
    return [line for line in panel.get_lines() if len(line.get_xdata()) > 2]


def test_each_axis_has_both_curves_and_their_difference(figure, comparison):
    """Draw in mm and degrees, the error in a strip of its own."""
    assert len(figure.axes) == 12
    for axis in range(6):
        upper, lower = figure.axes[2 * axis: 2 * axis + 2]
        measured, predicted = (line.get_ydata() for line in lines(upper))
        (error,) = (line.get_ydata() for line in lines(lower))
        factor, unit = (1e3, 'mm') if axis < 3 else (np.rad2deg(1.0), 'deg')
        kept = ~np.isnan(predicted)
        np.testing.assert_allclose(
            measured[kept], factor * comparison.measured[:, axis], atol=1e-12)
        np.testing.assert_allclose(
            predicted[kept], factor * comparison.predicted[:, axis], atol=1e-12)
        np.testing.assert_allclose(error, predicted - measured)
        assert upper.get_ylabel().endswith(f'({unit})')
        rms = two_digits(factor * comparison.scores.rms[axis])
        assert f'{rms} {unit}' in upper.get_title('right')


def test_curves_are_interrupted_where_their_own_samples_are_lost(figure):
    """Draw the prediction through what only the package has lost, and nothing without a tool."""
    for upper, lower in zip(figure.axes[::2], figure.axes[1::2], strict=True):
        (error,) = lines(lower)
        lost = [np.count_nonzero(np.isnan(line.get_ydata())) for line in (*lines(upper), error)]
        assert lost == [6, 1, 6]


def test_text_stays_inside_and_apart(figure):
    """Let no words leave the page, and no title run into another."""
    check_words(figure)


def inlined(x, y):
    """Return the points of a line in a picture of a page, a list for each of its parts."""
    with drawing(THEMES['light']) as figures:
        figure = figures.Figure(label='<a> "b"')
        figure.add_axes((0.0, 0.0, 1.0, 1.0)).plot(x, y, color=THEMES['light'].error)
    svg = ET.fromstring(inline_svg(figure).replace('xlink:href', 'href'))
    assert svg.get('aria-label') == '<a> "b"'
    line, = (path.get('d') for path in svg.iter('path')
             if 'stroke: var(--error)' in path.get('style', ''))
    return [np.array(re.findall(r'-?[\d.]+', part), float).reshape(-1, 2)
            for part in line.split('M')[1:]]


def test_pictures_of_a_page_keep_spikes_and_lose_points():
    """Keep the extremes of a hundred thousand points in a few thousand."""
    x = np.linspace(0.0, 500.0, 100_000)
    y = np.sin(x)
    y[54_321], y[77_777] = 50.0, -50.0
    (points,) = inlined(x, y)
    assert len(points) < 5000
    level = np.median(points[:, 1])
    for number, sign in ((54_321, -1.0), (77_777, 1.0)):  # up is less in an SVG
        near = np.abs(points[:, 0] - points[0, 0] - number / 1e5 * np.ptp(points[:, 0])) < 1.0
        assert np.max(sign * (points[near, 1] - level)) > 0.45 * np.ptp(points[:, 1])


def test_a_gap_interrupts_the_line_of_a_page():
    """Draw two parts around a NaN."""
    first, second = inlined(np.arange(5.0), np.array([1.0, 2, np.nan, 2, 1]))
    assert len(first) == len(second) == 2
    np.testing.assert_allclose(first[1, 1], second[0, 1])
