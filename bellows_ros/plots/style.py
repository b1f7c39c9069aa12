"""
Style of the pictures: a light and a dark theme, and atomic output.

What is measured is a wide pale line and what is predicted a thin strong one on top of it, so that
they differ without colour too; the two colours can be distinguished with all common kinds of
colour vision.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import io
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.extras import install
from bellows_ros.files.atomic import write_bytes

NO_MATPLOTLIB = f'matplotlib is not installed, but pictures need it: {install("plot")}'
DPI = 150


@dataclass(frozen=True)
class Theme:
    """Colours of a picture by purpose, as matplotlib names them."""

    background: str
    panel: str
    text: str
    quiet: str
    grid: str
    measured: str
    predicted: str
    error: str


THEMES: Mapping[str, Theme] = MappingProxyType(
    {
        'light': Theme(
            background='#ffffff', panel='#ffffff', text='#1b1f24', quiet='#57606a',
            grid='#e3e6ea', measured='#9fb4c9', predicted='#b3261e', error='#5b4a9e',
        ),
        'dark': Theme(
            background='#0d1117', panel='#0d1117', text='#e6edf3', quiet='#9198a1',
            grid='#262c36', measured='#5b7fa6', predicted='#ffb454', error='#b7a8ff',
        ),
    }
)


@contextmanager
def drawing(theme: Theme) -> Iterator[Any]:
    """
    Provide `matplotlib.figure` in a theme, for files only: no window, no global state.

    Raises
    ------
    BellowsError
        Without matplotlib.

    """
    try:
        import matplotlib
        import matplotlib.figure
    except ImportError:
        raise BellowsError(NO_MATPLOTLIB) from None
    with matplotlib.rc_context(_settings(theme)):
        yield matplotlib.figure


def _settings(theme: Theme) -> dict[Any, Any]:
    """Return matplotlib's settings of a theme."""
    return {
        'font.family': 'sans-serif',
        'font.sans-serif': ['DejaVu Sans'],
        'font.size': 9.0,
        'text.color': theme.text,
        'figure.facecolor': theme.background,
        'savefig.facecolor': theme.background,
        'axes.facecolor': theme.panel,
        'axes.edgecolor': theme.quiet,
        'axes.labelcolor': theme.text,
        'axes.linewidth': 0.6,
        'axes.grid': True,
        'axes.axisbelow': True,
        'axes.spines.top': False,
        'axes.spines.right': False,
        'grid.color': theme.grid,
        'grid.linewidth': 0.6,
        'xtick.color': theme.quiet,
        'ytick.color': theme.quiet,
        'xtick.labelcolor': theme.text,
        'ytick.labelcolor': theme.text,
        'legend.frameon': False,
        'lines.solid_joinstyle': 'round',
        'path.simplify_threshold': 0.2,
    }


def require_picture(path: str | os.PathLike[str], films: tuple[str, ...] = ()) -> str:
    """Return the format of a picture, or of a film, by its name's ending; refuse any other."""
    ending, allowed = Path(path).suffix.lower(), ('.png', '.svg', '.pdf', *films)
    if ending not in allowed:
        raise BellowsError(
            f"Picture '{path}' must end in {', '.join(allowed[:-1])} or {allowed[-1]}.")
    return ending.lstrip('.')


def write_figure(path: str | os.PathLike[str], figure: Any) -> None:
    """Write a figure in the format of the name's ending, whole or not at all."""
    ending = require_picture(path)
    data = io.BytesIO()
    metadata = {'png': {'Software': None}, 'svg': {'Date': None}, 'pdf': {'CreationDate': None}}
    import matplotlib

    with matplotlib.rc_context({'svg.hashsalt': 'bellows_ros'}):  # the same bytes every time
        figure.savefig(data, format=ending, dpi=DPI, metadata=metadata[ending])
    write_bytes(path, data.getvalue())
