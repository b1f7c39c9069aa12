"""A tool that moves with its package, and a replay of it."""

from types import SimpleNamespace

from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.signals.trajectory import Trajectory
import numpy as np
import pytest

COUNT = 300


@pytest.fixture(scope='session')
def motion():
    """Give a tool and a package that move, with ten poses missing."""
    t = np.arange(COUNT) / 100.0
    tool = 0.1 * np.column_stack([np.sin(t), np.cos(t), np.sin(2 * t)])
    rotation = exp_so3(0.2 * np.sin(3 * t)[:, None] * np.array([1.0, 0.5, 0.2]))
    return SimpleNamespace(
        seconds=t, tool_position=tool, tool_rotation=rotation,
        package_position=tool - np.array([0.0, 0.0, 0.08]), package_rotation=rotation,
        relative=np.zeros((COUNT, 6)), valid=np.abs(t - 1.0) > 0.05)


@pytest.fixture(scope='session')
def replayed(motion):
    """Give a replay of half a second whose prediction is 5 mm beside the measurement."""
    part = slice(50, 101)
    seconds, rotation = motion.seconds[part], motion.tool_rotation[part]
    measured = np.random.default_rng(3).normal(size=(len(seconds), 6))
    tool, package, outline = (
        Trajectory(np.arange(len(seconds)), position[part], rotation) for position in (
            motion.tool_position, motion.package_position + 5e-3, motion.package_position))
    return SimpleNamespace(
        seconds=seconds, tool=tool, package=package, outline=outline, deflection=2.0 * measured,
        cup_length=0.05, com=np.array([0.0, 0.0, -0.03]), box=np.array([0.2, 0.16, 0.06]),
        live=SimpleNamespace(measured=measured, predicted=measured + 5e-3))


def check_words(figure):
    """Check that words, titles and legends stay on the page, and that none covers another."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    width, height = figure.canvas.get_width_height()
    shown = [*figure.texts, *figure.legends]
    for axes in figure.axes:
        shown += [axes.title, axes._right_title, axes.yaxis.label]
    boxes = [item.get_window_extent(renderer) for item in shown]
    boxes = [box for box in boxes if box.width > 1.0]
    for number, box in enumerate(boxes):
        assert 0 <= box.x0 and box.x1 <= width and 0 <= box.y0 and box.y1 <= height
        assert not any(box.overlaps(other) for other in boxes[:number])
