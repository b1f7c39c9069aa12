"""Draw what the filter's window does: to a motion, to noise, and to an identified cup."""

from functools import cache
from pathlib import Path
from typing import Any

from bellows_ros.core.signals.savgol import weights
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.plots.style import drawing, Theme
from bellows_ros.workflows.identify import identify
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RATE_HZ = 360.0
ORDERS = (2, 4, 6)
WINDOWS = (8, 12, 20, 30, 45, 65)  # samples, half


def response(theme: Theme) -> Any:
    """Return the figure with what is left of an acceleration, against its frequency."""
    frequency = np.linspace(0.1, 30.0, 400)
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 3.0), layout='constrained')
        for panel, n in zip(figure.subplots(1, 2, sharey=True), (15, 30), strict=True):
            time = np.arange(-n, n + 1) / RATE_HZ
            for order, colour in zip(ORDERS, _colours(theme), strict=True):
                omega = 2.0 * np.pi * frequency[:, None]
                got = np.cos(omega * time) @ weights(n, order, RATE_HZ)[2]
                panel.plot(frequency, -100.0 * got / omega[:, 0] ** 2, color=colour,
                           label=f'order {order}')
            panel.axhline(100.0, color=theme.quiet, linewidth=0.6)
            panel.set_title(f'half window {n} samples, {1e3 * n / RATE_HZ:.0f} ms', fontsize=10)
            panel.set_xlabel('frequency (Hz)')
            panel.set_xlim(0.0, 30.0)
            panel.set_ylim(0.0, 110.0)
        figure.axes[1].legend(loc='upper right', bbox_to_anchor=(1.0, 0.93))
        figure.axes[0].set_ylabel('acceleration left (%)')
    return figure


def found(theme: Theme) -> Any:
    """Return the figure with K and P, identified with several windows, over the truth."""
    names = ('x, y', 'z', 'rx, ry', 'rz')
    picks = (0, 2, 3, 5)
    with drawing(theme) as figures:
        figure = figures.Figure(figsize=(7.6, 5.4), layout='constrained')
        panels = figure.subplots(2, 4, sharex=True)
        for order, colour, line in zip(
                ORDERS[1:], _colours(theme)[1:], ('o-', 's--'), strict=True):
            ratios = np.array([_ratios(n, order) for n in WINDOWS])
            for row in range(2):
                for column, axis in enumerate(picks):
                    panels[row, column].plot(
                        1e3 * np.array(WINDOWS) / RATE_HZ, ratios[:, row, axis], line,
                        color=colour, markersize=3.5, markerfacecolor='none',
                        label=f'order {order}')
        for row, (quantity, span) in enumerate((('stiffness', 0.03), ('damping', 0.25))):
            for column, name in enumerate(names):
                panel = panels[row, column]
                panel.axhline(1.0, color=theme.quiet, linewidth=0.8)
                panel.set_ylim(1.0 - span, 1.0 + span)
                panel.set_title(f'{quantity} {name}', fontsize=9.5)
                panel.tick_params(labelleft=column == 0)
            panels[row, 0].set_ylabel('found / true')
        for panel in panels[1]:
            panel.set_xlabel('half window (ms)')
        panels[0, 1].legend(loc='lower left', fontsize=8)
    return figure


@cache
def _ratios(half_window: int, order: int) -> Any:
    """Return the diagonals of K and P (2, 6) found with a filter, over the true ones."""
    truth = read_parameters(ROOT / 'bags' / 'cup.yaml')
    settings = {**read_parameters(ROOT / 'bags' / 'package.yaml'),
                'fit.method': 'least_squares',
                'bags': [str(ROOT / 'bags' / 'identification')],
                'filter.tool.half_window': round(half_window * 500.0 / RATE_HZ),
                'filter.package.half_window': half_window,
                'filter.tool.order': order, 'filter.package.order': order}
    fit = identify(settings).fit
    ratios = []
    for name, got in (('stiffness', fit.stiffness), ('damping', fit.damping)):
        expected = np.reshape(truth[f'cup.{name}'], (6, 6))
        ratios.append(np.diag(got) / np.diag(expected))
    return ratios


def _colours(theme: Theme) -> tuple[str, str, str]:
    """Return three colours that differ in print too."""
    return theme.measured, theme.error, theme.predicted


FIGURES = {'filter_response.svg': response, 'filter_found.svg': found}
