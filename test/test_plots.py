"""Pictures: what they draw, that words stay on the page, and which names are refused."""

import io
import sys

from bellows_ros import plots
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.signals.residuals import Comparison, score
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
import numpy as np
import pytest

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")

SECONDS = np.arange(400) / 100.0 + 0.5 * (np.arange(400) >= 200)
FACTORS = [1e3] * 3 + [np.degrees(1.0)] * 3


@pytest.fixture(scope='module')
def comparison():
    """Give made-up coordinates with known errors: 0.5 s lost, and once the package alone."""
    amplitude = np.array([0.01, 0.008, 0.0005, 0.2, 0.1, 0.0])
    measured = amplitude * np.sin(3.0 * SECONDS[:, None])
    predicted = measured + np.array([1e-3, -1e-3, 1e-4, 2e-3, 1e-3, 0.0])
    measured[60:65] = np.nan
    stamps = np.rint(1e9 * SECONDS).astype(np.int64)
    return Comparison(stamps, measured, predicted, score(measured, predicted))


@pytest.fixture(scope='module')
def figure(comparison):
    """Give the picture."""
    return plots.comparison_figure(SECONDS, comparison, 'Title', 'run_$5_and_$6')


def test_each_axis_has_both_curves_and_their_difference(figure, comparison):
    """Draw mm and degrees; interrupt each curve at its own lost samples."""
    panels = np.reshape(figure.axes, (6, 2))
    for axis, factor in enumerate(FACTORS):
        upper, lower = panels[2 * (axis % 3):2 * (axis % 3) + 2, axis // 3]
        measured, predicted, error = (
            line.get_ydata() for line in (*upper.get_lines(), *lower.get_lines()))
        kept = ~np.isnan(predicted)
        first = comparison.predicted[0, axis] * (axis < 3)
        np.testing.assert_allclose(
            measured[kept], factor * (comparison.measured[:, axis] - first))
        np.testing.assert_allclose(
            predicted[kept], factor * (comparison.predicted[:, axis] - first))
        np.testing.assert_allclose(error, predicted - measured)
        assert [int(np.isnan(each).sum()) for each in (measured, predicted, error)] == [6, 1, 6]


LONG = np.arange(2500) / 100.0


@pytest.fixture(scope='module')
def long_figure():
    """Give the picture of 25 s whose error is largest from 11 to 14 s, with a peak at 20 s."""
    rng = np.random.default_rng(3)
    measured = 0.01 * np.sin(12.0 * LONG)[:, None] * np.ones(6)
    noise = 1e-4 * rng.standard_normal((len(LONG), 6))
    noise[(LONG > 11.0) & (LONG < 14.0)] *= 8.0
    noise[2000] += 2e-3
    predicted = measured + noise
    return plots.comparison_figure(
        LONG, Comparison(np.rint(1e9 * LONG).astype(np.int64), measured, predicted,
                         score(measured, predicted)), 'Title', 'a recording')


def test_a_long_recording_is_an_envelope_beside_its_worst_five_seconds(long_figure):
    """The envelope has the peak, the part in full the time of the largest error."""
    panels = np.reshape(long_figure.axes, (6, 4))
    for whole, part, factor in ((0, 1, FACTORS[0]), (2, 3, FACTORS[3])):
        t = panels[0, part].get_lines()[0].get_xdata()
        assert t[0] <= 11.0 and t[-1] >= 14.0 and t[-1] - t[0] < plots.DRAWN_SECONDS + 1e-6
        assert len(t) == 1 + round(100.0 * (t[-1] - t[0]))
        error = panels[1, whole].collections[0].get_paths()[0].get_extents()
        assert error.x0 < 0.5 and error.x1 > 24.5 and error.y1 > 1.8e-3 * factor


@pytest.mark.parametrize('name', ['figure', 'long_figure'])
def test_words_stay_on_the_page_and_cover_no_others(name, request):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = request.getfixturevalue(name)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    width, height = figure.canvas.get_width_height()
    shown = [*figure.texts, *figure.legends, *(axes.yaxis.label for axes in figure.axes)]
    boxes = [item.get_window_extent(renderer) for item in shown]
    for number, box in enumerate(boxes):
        assert 0 <= box.x0 and box.x1 <= width and 0 <= box.y0 and box.y1 <= height
        assert not any(box.overlaps(other) for other in boxes[:number])


def test_an_animation_shows_the_whole_box_in_every_frame(root, monkeypatch):
    """Slow half a second down to six, and keep the predicted box off all edges."""
    monkeypatch.setitem(sys.modules, 'mpl_toolkits', None)  # may be of another matplotlib
    image = pytest.importorskip('PIL.Image', reason='Pillow comes with matplotlib')
    t = np.arange(51) / 100.0
    tool = Trajectory(np.rint(1e9 * t).astype(np.int64),
                      0.1 * np.column_stack([np.sin(t), np.cos(t), np.sin(2 * t)]),
                      exp_so3(0.2 * np.sin(3 * t)[:, None] * np.array([1.0, 0.5, 0.2])))
    package = Trajectory(tool.stamps_ns, tool.position - [0.0, 0.0, 0.08], tool.rotation)
    values = resolve({**read_parameters(root / 'bags/tossing.yaml'), 'package.size': [0.3] * 3})
    data = plots.animation([plots.Scene('scene', tool, package, None, values)])
    with image.open(io.BytesIO(data)) as picture:
        assert picture.n_frames == plots.SHORTEST * plots.FRAME_RATE
        for number in range(0, picture.n_frames, 10):
            picture.seek(number)
            pixels = np.asarray(picture.convert('RGB')).astype(int)
            red = pixels[..., 0] - pixels[..., 1] > 60
            assert red.any()
            assert not (red[0].any() or red[-1].any() or red[:, 0].any() or red[:, -1].any())
            if number == 0:  # the box is not turned yet
                height, width = (np.ptp(np.flatnonzero(red.any(axis=axis))) for axis in (1, 0))
                drawn = np.ptp(0.3 * plots.CORNERS @ plots.VIEW.T, axis=0)
                assert width / height == pytest.approx(drawn[0] / drawn[1], rel=0.03)


@pytest.mark.parametrize('name', ['a.jpg', 'a', 'a.mp4'])
def test_other_endings_are_refused(name):
    with pytest.raises(BellowsError, match='must end in'):
        plots.require_ending(name)
