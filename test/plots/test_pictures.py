"""Pictures of recordings, loads and replays: what is drawn, and that words stay on the page."""

import re
import subprocess
import sys
from types import SimpleNamespace
import xml.etree.ElementTree as ET

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.model.grip import Margin
from bellows_ros.core.signals.residuals import Comparison, score
from bellows_ros.errors import BellowsError
from bellows_ros.plots import pictures
from bellows_ros.plots.animation import _ffmpeg as ffmpeg
from bellows_ros.plots.animation import bellows_rings, FRAMES_PER_SECOND, write_animation
from bellows_ros.plots.pictures import prediction_figure, two_digits
from bellows_ros.plots.style import drawing, inline_svg, THEMES
from bellows_ros.workflows.replay import Margins
import numpy as np
import pytest

from .conftest import check_words, COUNT

pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")

SPAN = 0.5  # s, of an animation


@pytest.fixture(scope='module')
def loads():
    """Give loads of a spring with known stiffness, under a weight."""
    rng = np.random.default_rng(5)
    deflection = rng.normal(size=(COUNT, 6)) * 1e-3
    stiffness = np.array([6e3, 6e3, 1e4, 4.0, 4.0, 1.0])
    weight = np.array([0.0, 0.0, -17.6, 0.0, 0.0, 0.0])
    return SimpleNamespace(
        seconds=np.arange(COUNT) / 100.0, deflection=deflection,
        load=stiffness * deflection + weight,
        residual=0.1 * stiffness * deflection, stiffness=stiffness, valid=np.ones(COUNT, bool))


def draw_all(motion, loads, theme):
    """Return every figure."""
    frequency = np.linspace(0.0, 50.0, 40)
    spectra = SimpleNamespace(
        frequency_hz=frequency, measured=1e-5 + np.zeros((40, 6)), error=1e-6 + np.zeros((40, 6)))
    margins = Margins(
        np.linspace(0.0, 2.0, 40), np.full((40, 2), [2.2, 3.0]), np.full((40, 2), 0.1),
        Margin(0.9, 'slip', 1.234), 1.5)
    return {
        'margin': pictures.margin_figure(margins, 'note', theme),
        'motion': pictures.motion_figure(motion, 'note', theme),
        'path': pictures.path_figure(motion, 'note', theme),
        'spectra': pictures.spectra_figure(spectra, 'note', theme),
        'deflection': pictures.deflection_figure(loads, 'note', theme),
        'residual': pictures.residual_figure(loads, 'note', theme)}


@pytest.mark.parametrize('theme', THEMES)
def test_words_stay_on_the_page_in_both_themes(theme, motion, loads):
    """Let title, note, legend and labels fit."""
    from matplotlib.colors import to_hex

    for figure in draw_all(motion, loads, theme).values():
        check_words(figure)
        assert to_hex(figure.get_facecolor()) == THEMES[theme].background


def test_motion_is_drawn_from_the_start_and_interrupted(motion, loads):
    """Draw mm and degrees against the first pose, with nothing where nothing is valid."""
    figure = draw_all(motion, loads, 'light')['motion']
    panels = {panel.get_ylabel()[:2].strip(): panel for panel in figure.axes}
    tool, package, *_ = panels['x'].get_lines()
    expected = 1e3 * (motion.tool_position[:, 0] - motion.tool_position[0, 0])
    np.testing.assert_allclose(tool.get_ydata()[motion.valid], expected[motion.valid], atol=1e-9)
    assert np.isnan(package.get_ydata()).sum() == np.count_nonzero(~motion.valid)


def test_stiffness_is_the_line_through_the_loads(motion, loads):
    """Draw the cup's line with its own slope."""
    figure = draw_all(motion, loads, 'light')['deflection']
    axes = {name: i for i, name in enumerate(('x', 'y', 'z', 'rx', 'ry', 'rz'))}
    for panel in figure.axes:
        axis = axes[panel.get_ylabel().split()[1]]
        line = panel.get_lines()[1]
        (x0, x1), (y0, y1) = line.get_xdata(), line.get_ydata()
        unit = 1e-3 if axis < 3 else np.deg2rad(1.0)
        assert (y1 - y0) / (x1 - x0) == pytest.approx(unit * loads.stiffness[axis])


def test_margins_are_drawn_with_two_standard_deviations(motion, loads):
    """Draw bands to both sides of each factor, and mark the smallest with mode and instant."""
    panel, = draw_all(motion, loads, 'light')['margin'].axes
    for band, factor in zip(panel.collections, (2.2, 3.0), strict=False):
        heights = band.get_paths()[0].vertices[:, 1]
        assert heights.min() == pytest.approx(factor - 0.2)
        assert heights.max() == pytest.approx(factor + 0.2)
    assert '0.9 (slip, 1.23 s)' in [text.get_text() for text in panel.get_legend().get_texts()]


def test_an_animation_runs_at_recorded_speed(replayed, tmp_path):
    """Write as many pictures as the time has, all of one size."""
    image = pytest.importorskip('PIL.Image', reason='Pillow comes with matplotlib')
    write_animation(tmp_path / 'a.gif', replayed, 'note', 'dark')
    with image.open(tmp_path / 'a.gif') as picture:
        assert picture.n_frames == round(SPAN * FRAMES_PER_SECOND['.gif'])
        shown = picture.n_frames * picture.info['duration'] / 1e3
        assert shown == pytest.approx(SPAN, rel=0.05)  # GIF counts in hundredths of a second


@pytest.mark.extras
def test_a_film_has_every_frame(replayed, tmp_path):
    """Write an MP4 at recorded speed, and decode it again."""
    try:
        program = ffmpeg()
    except BellowsError:
        pytest.skip("no ffmpeg here (apt install ffmpeg, or pip install '.[video]')")
    write_animation(tmp_path / 'a.mp4', replayed, 'note')
    done = subprocess.run(
        [program, '-loglevel', 'error', '-i', tmp_path / 'a.mp4', '-f', 'rawvideo', '-pix_fmt',
         'gray', '-'], capture_output=True, check=True)
    assert len(done.stdout) == SPAN * FRAMES_PER_SECOND['.mp4'] * 640 * 360
    assert b'ftyp' in (tmp_path / 'a.mp4').read_bytes()[:16]


@pytest.mark.parametrize(('script', 'remedy'), [
    (None, 'pip install imageio-ffmpeg'), ('exit 3', r'\.gif')])
def test_without_a_working_ffmpeg_no_file_is_written(
    script, remedy, replayed, tmp_path, monkeypatch
):
    folder = tmp_path / 'programs'
    folder.mkdir()
    if script:
        (folder / 'ffmpeg').write_text(f'#!/bin/sh\n{script}\n')
        (folder / 'ffmpeg').chmod(0o755)
    monkeypatch.setenv('PATH', str(folder))
    monkeypatch.setitem(sys.modules, 'imageio_ffmpeg', None)
    with pytest.raises(BellowsError, match=remedy):
        write_animation(tmp_path / 'a.mp4', replayed, 'note')
    assert [path.name for path in tmp_path.iterdir()] == ['programs']


def test_the_whole_box_is_in_the_picture(replayed, tmp_path):
    """Keep the predicted box off all edges of the picture in every frame."""
    image = pytest.importorskip('PIL.Image', reason='Pillow comes with matplotlib')
    write_animation(tmp_path / 'a.gif', replayed, 'note')
    with image.open(tmp_path / 'a.gif') as picture:
        for number in range(picture.n_frames):
            picture.seek(number)
            pixels = np.asarray(picture.convert('RGB')).astype(int)
            red = pixels[..., 0] - pixels[..., 1] > 60
            assert red.any()
            assert not (red[0].any() or red[-1].any() or red[:, 0].any() or red[:, -1].any())


def test_a_bellows_begins_at_the_tool_and_ends_at_the_lip():
    """Leave along one z axis and arrive along the other."""
    R = exp_so3([0.2, 0.1, 0.0])
    lip = np.array([0.005, 0.0, -0.045])
    rings = bellows_rings(np.zeros(3), np.eye(3), lip, R)
    centres = rings[:, :-1].mean(axis=1)
    np.testing.assert_allclose(centres[[0, -1]], [np.zeros(3), lip], atol=1e-12)
    np.testing.assert_allclose((rings[-1] - lip) @ R[:, 2], 0.0, atol=1e-12)


def luminance(colour):
    """Return the relative luminance of a colour, as WCAG 2 defines it."""
    parts = np.array([int(colour[i:i + 2], 16) / 255.0 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


@pytest.mark.parametrize('theme', THEMES)
def test_every_colour_of_content_has_a_contrast_of_3_to_1(theme):
    """Meet WCAG 2 for graphics on the background of the theme, 4.5 to 1 for text."""
    colours = THEMES[theme]
    for name, least in (('measured', 3.0), ('predicted', 3.0), ('error', 3.0), ('text', 4.5),
                        ('quiet', 4.5)):
        low, high = sorted(map(luminance, (getattr(colours, name), colours.background)))
        assert (high + 0.05) / (low + 0.05) >= least, name


def test_a_steered_transport_shows_floor_trail_and_tilt(root, tmp_path):
    """Draw both motions side by side, each with its present tilt as a number."""
    from bellows_ros import read_parameters, steer
    from bellows_ros.plots import animation

    seen = []
    texts = animation._draw

    def watched(space, view, t, colours):
        drawn = texts(space, view, t, colours)
        seen.append((view.label, [each.get_text() for each in drawn if hasattr(each, 'get_text')]))
        return drawn

    report = steer(root / 'bags/transport.yaml', read_parameters(root / 'bags/tossing.yaml'),
                   method='zvd')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, '_draw', watched)
        animation.write_steering(tmp_path / 'a.gif', report, 'note', 4.0)
    tilts = {label: max(float(words.split()[1]) for name, (words,) in seen if name == label)
             for label in dict(seen)}
    assert tilts['as planned'] > 15.0 and tilts['steered (zvd)'] < 0.5


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


def test_texts_of_a_figure_do_not_overlap(figure):
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
