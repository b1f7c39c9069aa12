"""Charts: what is drawn stands where the numbers say."""

import re
import xml.etree.ElementTree as ET

from bellows_ros.report.svg import (
    Curve,
    interval_chart,
    line_chart,
    round_numbers,
    Scale,
    strip_chart,
    thinned,
)
import numpy as np
from numpy.testing import assert_allclose
import pytest


def paths(svg, kind):
    """Return the points of the paths of a class: a list of pieces for each."""
    found = [p.get('d') for p in ET.fromstring(svg).iter('path') if p.get('class') == kind]
    return [
        [np.array(re.findall(r'-?[\d.]+', piece), dtype=float).reshape(-1, 2)
         for piece in d.split('M')[1:]]
        for d in found
    ]


def test_a_line_goes_through_its_points():
    """Map corners to corners, up being more."""
    svg = line_chart([Curve(np.array([0.0, 1, 2]), np.array([0.0, 1, 0]), 'error')], 'x', 'y')
    ((points,),) = paths(svg, 'line error')
    assert points[0, 0] < points[1, 0] < points[2, 0]
    assert points[1, 1] < points[0, 1] == points[2, 1]
    assert_allclose(points[1, 0], points[[0, 2], 0].mean(), atol=0.06)


def test_a_gap_interrupts_the_line():
    """Draw two pieces around a NaN."""
    y = np.array([1.0, 2, np.nan, 2, 1])
    svg = line_chart([Curve(np.arange(5.0), y, 'error')], 'x', 'y')
    ((first, second),) = paths(svg, 'line error')
    assert len(first) == len(second) == 2


def test_thinning_keeps_spikes():
    """Keep the extremes of a hundred thousand points in a few thousand."""
    x = np.linspace(0.0, 500.0, 100_000)
    y = np.sin(x)
    y[54_321], y[77_777] = 50.0, -50.0
    points = np.array(thinned(x, y))
    assert len(points) < 2100
    assert (points[:, 1].max(), points[:, 1].min()) == (50.0, -50.0)
    assert np.all(np.diff(points[:, 0]) >= 0.0)


def test_logarithmic_axes_have_powers_of_ten():
    """Place 1, 10, 100 at equal distances, and what is not positive nowhere."""
    scale = Scale(1.0, 100.0, 0.0, 200.0, True)
    assert_allclose(scale.place(np.array([1.0, 10.0, 100.0])), [0.0, 100.0, 200.0])
    assert np.isnan(scale.place(np.array([0.0])))[0]
    assert scale.ticks(5) == [1.0, 10.0, 100.0]


@pytest.mark.parametrize(('low', 'high'), [
    (0.0, 1.0), (-3.2, 7.9), (1e-9, 3e-9), (-5e4, -1e4), (99.97, 100.02),
])
def test_round_numbers_lie_in_the_range(low, high):
    """Give between two and the wanted number of ticks, in even steps."""
    ticks = round_numbers(low, high, 6)
    assert 2 <= len(ticks) <= 7
    step = ticks[1] - ticks[0]
    assert_allclose(np.diff(ticks), step, rtol=1e-6)
    assert low - 1e-6 * step <= ticks[0] and ticks[-1] <= high + 1e-6 * step


def test_intervals_are_to_scale_and_endless_ones_dashed():
    """Draw twice the length for twice the width; mark what is not known."""
    svg = interval_chart(
        [('a', 0.0, 1.0, '1'), ('b', 0.0, 2.0, '2'), ('c', 0.0, np.nan, '-')], '%')
    ends = re.findall(r'class="interval" d="M([\d.]+) [\d.]+H([\d.]+)', svg)
    lengths = [float(high) - float(low) for low, high in ends]
    assert_allclose(lengths[1], 2 * lengths[0], atol=0.2)
    assert svg.count('class="endless"') == 1


def test_strips_begin_and_end_where_they_should():
    """Draw a span over half of the axis with half of its width."""
    svg = strip_chart([('used', 'used', [(0.0, 10.0)]), ('lost', 'lost', [(2.0, 7.0)])],
                      (0.0, 10.0), 's')
    whole, half = (float(r.get('width')) for r in ET.fromstring(svg).iter('rect'))
    assert_allclose(half, 0.5 * whole, atol=0.1)


@pytest.mark.parametrize('y', [[], [np.nan] * 3, [2.0] * 3, [0.0] * 3])
def test_nothing_to_show_is_no_error(y):
    """Draw axes where there is no line, a constant, or nothing at all."""
    curve = Curve(np.arange(float(len(y))), np.array(y, dtype=float), 'error')
    for log in ((False, False), (True, True)):
        ET.fromstring(line_chart([curve], 'x', 'y', log=log))


def test_text_is_escaped():
    """Let no label become markup."""
    svg = line_chart([Curve(np.arange(2.0), np.arange(2.0), 'error', '<b>&')], '"x"', 'y')
    assert '<b>' not in svg
    ET.fromstring(svg)
