"""Pictures: what they draw, that words stay on the page, and which names are refused."""

import io

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
        np.testing.assert_allclose(measured[kept], factor * comparison.measured[:, axis])
        np.testing.assert_allclose(predicted[kept], factor * comparison.predicted[:, axis])
        np.testing.assert_allclose(error, predicted - measured)
        assert [int(np.isnan(each).sum()) for each in (measured, predicted, error)] == [6, 1, 6]


def test_words_stay_on_the_page_and_cover_no_others(figure):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    width, height = figure.canvas.get_width_height()
    shown = [*figure.texts, *figure.legends, *(axes.yaxis.label for axes in figure.axes)]
    boxes = [item.get_window_extent(renderer) for item in shown]
    for number, box in enumerate(boxes):
        assert 0 <= box.x0 and box.x1 <= width and 0 <= box.y0 and box.y1 <= height
        assert not any(box.overlaps(other) for other in boxes[:number])


def test_an_animation_shows_the_whole_box_in_every_frame(root):
    """Slow half a second down to six, and keep the predicted box off all edges."""
    image = pytest.importorskip('PIL.Image', reason='Pillow comes with matplotlib')
    t = np.arange(51) / 100.0
    tool = Trajectory(np.rint(1e9 * t).astype(np.int64),
                      0.1 * np.column_stack([np.sin(t), np.cos(t), np.sin(2 * t)]),
                      exp_so3(0.2 * np.sin(3 * t)[:, None] * np.array([1.0, 0.5, 0.2])))
    package = Trajectory(tool.stamps_ns, tool.position - [0.0, 0.0, 0.08], tool.rotation)
    values = resolve(read_parameters(root / 'bags/tossing.yaml'))
    data = plots.animation([plots.Scene('scene', tool, package, None, values)])
    with image.open(io.BytesIO(data)) as picture:
        assert picture.n_frames == plots.SHORTEST * plots.FRAME_RATE
        for number in range(0, picture.n_frames, 10):
            picture.seek(number)
            pixels = np.asarray(picture.convert('RGB')).astype(int)
            red = pixels[..., 0] - pixels[..., 1] > 60
            assert red.any()
            assert not (red[0].any() or red[-1].any() or red[:, 0].any() or red[:, -1].any())


@pytest.mark.parametrize('name', ['a.jpg', 'a', 'a.mp4'])
def test_other_endings_are_refused(name):
    with pytest.raises(BellowsError, match='must end in'):
        plots.require_ending(name)
