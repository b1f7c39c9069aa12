"""
Style of the pictures: a light and a dark theme, layouts of panels, and atomic output.

A measured quantity is a wide pale line, a predicted quantity a thin strong line on top. The lines
differ in width, and in colours that are distinct with all common kinds of colour vision.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from html import escape
import io
from pathlib import Path
import re
import tomllib
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.errors import BellowsError, require_pictures, shown
from bellows_ros.files import File
from bellows_ros.files.atomic import write_bytes
import numpy as np

DPI = 150
SAME_BYTES: dict[Any, Any] = {'svg.hashsalt': 'bellows_ros'}


@dataclass(frozen=True)
class Theme:
    """Colours of a picture by purpose, by matplotlib's names."""

    background: str
    text: str
    quiet: str
    grid: str
    measured: str
    predicted: str
    error: str

    @property
    def three(self) -> tuple[str, str, str]:
        """Colours of x, y, z."""
        return self.predicted, self.error, self.measured


PICTURE_STYLE = tomllib.loads(Path(__file__).with_name('pictures.toml').read_text())
THEMES = {name: Theme(**colours) for name, colours in PICTURE_STYLE['themes'].items()}


@contextmanager
def drawing(theme: Theme) -> Iterator[Any]:
    """
    Provide `matplotlib.figure` in a theme, for files only: no window, no global state.

    Raises
    ------
    BellowsError
        If matplotlib is not installed.

    """
    require_pictures()
    import matplotlib
    import matplotlib.figure

    colours = {name: getattr(theme, purpose)
               for purpose, names in PICTURE_STYLE['colours'].items() for name in names}
    with matplotlib.rc_context({**PICTURE_STYLE['style'], **colours}):
        yield matplotlib.figure


PICTURES, FILMS = ('.png', '.svg', '.pdf'), ('.gif', '.mp4')


def require_picture(path: File, allowed: tuple[str, ...] = PICTURES) -> str:
    """Return the format of a picture or film by file ending; raise for other endings."""
    ending = Path(path).suffix.lower()
    if ending not in allowed:
        raise BellowsError(
            f"Picture '{path}' must end in {', '.join(allowed[:-1])} or {allowed[-1]}.")
    return ending.lstrip('.')


def description(figure: Any) -> str:
    """
    Return the content of a figure as text.

    The text has a row of texts and legends, then a row per panel: title, labels, legend, and for
    each line its name, number of points, and smallest and largest value.
    """
    def words(*texts: Any) -> str:
        return ', '.join(filter(None, (text if isinstance(text, str) else text.get_text()
                                       for text in texts)))

    rows = [words(*figure.texts, *(text for legend in figure.legends
                                   for text in legend.get_texts()))]
    for panel in figure.axes:
        legend = panel.get_legend()
        lines = []
        for line in panel.lines:
            values = np.ma.masked_invalid(np.asarray(line.get_ydata(), float)).compressed()
            if values.size:
                lines.append(f'{values.size} points from {values.min():.3g} to {values.max():.3g}')
        title = words(*(panel.get_title(side) for side in ('left', 'center', 'right')))
        names = words(*panel.texts, *(legend.get_texts() if legend else ()))
        rows.append(' | '.join(filter(None, (
            title, words(panel.get_ylabel()), words(panel.get_xlabel()), names, *lines))))
    return re.sub(r'[^\S\n]+', ' ', '\n'.join(rows).replace('−', '-')).strip()


def write_figure(path: File, figure: Any) -> None:
    """Write a figure with its description, in the format of the name's ending, atomically."""
    ending = require_picture(path)
    data = io.BytesIO()
    metadata = {'png': {'Software': None, 'Description': description(figure)},
                'svg': {'Date': None, 'Description': description(figure)},
                'pdf': {'CreationDate': None, 'Subject': description(figure)}}
    import matplotlib

    with matplotlib.rc_context(SAME_BYTES):
        figure.savefig(data, format=ending, dpi=DPI, metadata=metadata[ending])
    write_bytes(path, data.getvalue())


def inline_svg(figure: Any) -> str:
    """
    Return a figure of the light theme as SVG for a page, which defines its colours.

    The colours become CSS variables with the names of a `Theme`. Screen readers read the figure's
    label.
    """
    import matplotlib

    data = io.StringIO()
    with matplotlib.rc_context({  # texts remain texts, and close points of a line are merged
            **SAME_BYTES, 'svg.fonttype': 'none', 'path.simplify_threshold': 0.5}):
        figure.savefig(data, format='svg', metadata=dict.fromkeys(
            ('Creator', 'Date', 'Format', 'Type')))
    svg = re.sub(
        r'.*?<svg [^>]*?(viewBox="[^"]*")[^>]*>',
        rf'<svg \1 role="img" aria-label="{escape(figure.get_label())}">',
        data.getvalue(), count=1, flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*"', '<g', svg)
    svg = re.sub(  # a tenth of a point, without line ends, suffices for a path
        r' d="[^"]*"', lambda path: re.sub(r'(\.\d)\d+', r'\1', path[0]).replace(' \n', ''), svg)
    for name, colour in asdict(THEMES['light']).items():
        svg = svg.replace(colour, f'var(--{name})')
    return svg


SIZE = (9.4, 6.9)  # inches
LEFT_EDGE = 0.095  # of the panels, relative to the width
BELOW_HEAD = {'left': LEFT_EDGE, 'right': 0.985, 'top': 0.87, 'bottom': 0.075}
"""Edges of the panels of a figure of `SIZE`."""

TITLE, NOTE = 0.31, 0.52  # inches from the top
MILLI, DEGREES = DISPLAY_FACTORS[[0, 3]]


@contextmanager
def picture(
    title: str, note: str, theme: str, size: tuple[float, float] = SIZE, dpi: float | None = None
) -> Iterator[tuple[Any, Theme]]:
    """
    Provide a figure with title and conditions above the panels, and the colours of its theme.

    Raises
    ------
    BellowsError
        If matplotlib is not installed.

    """
    colours = THEMES[theme]
    with drawing(colours) as figures:
        figure = figures.Figure(figsize=size, dpi=dpi, label=title)
        figure.text(LEFT_EDGE, 1.0 - TITLE / size[1], title, fontsize=13.5, fontweight='bold')
        plain = shown(note, 150).replace('$', r'\$')  # no mathematics in foreign names
        figure.text(LEFT_EDGE, 1.0 - NOTE / size[1], plain, color=colours.quiet)
        yield figure, colours


def six_panels(figure: Any, units: Sequence[str]) -> list[Any]:
    """Return six panels: x, y, z on the left, rx, ry, rz on the right, each with its unit."""
    panels = list(figure.subplots(
        3, 2, gridspec_kw={**BELOW_HEAD, 'hspace': 0.28, 'wspace': 0.26}).T.ravel())
    for axis, panel in enumerate(panels):
        panel.set_ylabel(f'{AXES[axis]}  ({units[axis]})')
        panel.yaxis.set_label_coords(-0.145, 0.5)
        panel.tick_params(length=2.5, width=0.6)
    return panels


class Line(NamedTuple):
    """Six coordinates (N, 6) over x (N,), in a colour of the theme: see `six_lines`."""

    name: str
    colour: str
    width: float
    x: Array
    values: Array


def six_lines(
    title: str, note: str, theme: str, lines: Sequence[Line], abscissa: str,
    units: Sequence[str] = DISPLAY_UNITS, log: bool = False,
) -> Any:
    """
    Draw lines into six panels, one per axis.

    Parameters
    ----------
    title, note : str
        Content of the figure, and its conditions.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.
    lines : sequence of Line
        Lines in the order of drawing, in their units. A line without a name is not in the legend.
    abscissa : str
        Label of the abscissa, with its unit.
    units : sequence of str
        Unit of each axis.
    log : bool
        Whether both scales are logarithmic.

    Returns
    -------
    matplotlib.figure.Figure

    """
    with picture(title, note, theme) as (figure, colours):
        legend_of(figure, lines, colours)
        for axis, panel in enumerate(six_panels(figure, units)):
            for _, colour, width, x, values in lines:
                panel.plot(x, values[:, axis], color=getattr(colours, colour), linewidth=width)
            if log:
                panel.set(xscale='log', yscale='log')
                panel.minorticks_off()
            else:
                panel.xaxis.get_major_locator().set_params(integer=True)
            panel.margins(x=0.0)
            label_abscissa(panel, axis, abscissa)
    return figure


def draw_series(
    panel: Any, x: Array, values: Array, colours: Sequence[str], names: Sequence[str] = '',
    std: Array | None = None, width: float = 1.2,
) -> None:
    """Draw a line for each column of values (N, M), with bands of two standard deviations."""
    for i, (value, colour) in enumerate(zip(values.T, colours, strict=False)):
        if std is not None:
            reach = 2.0 * std[:, i]
            panel.fill_between(x, value - reach, value + reach, color=colour, alpha=0.25,
                               linewidth=0.0)
        panel.plot(x, value, color=colour, linewidth=width, label=names[i] if names else None)


def name_panel(panel: Any, title: str, abscissa: str = '') -> None:
    """Write the title and the legend above a panel, and the abscissa below it."""
    panel.set_title(title, loc='left', fontsize=9.5, pad=4.0)
    panel.tick_params(length=2.5, width=0.6)
    panel.set_xlabel(abscissa)
    if panel.get_legend_handles_labels()[0]:
        panel.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8,
                     handlelength=1.4, borderaxespad=0.2, columnspacing=1.2)


def legend_of(figure: Any, lines: Sequence[Line], theme: Theme) -> None:
    """Write a legend of the named lines at the top right."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=getattr(theme, line.colour), linewidth=line.width,
                      label=line.name) for line in lines if line.name]
    figure.legend(
        handles=handles, loc='upper right', bbox_to_anchor=(0.992, 0.985), ncols=len(handles),
        fontsize=9.5, handlelength=1.8, columnspacing=1.6)


def label_abscissa(panel: Any, axis: int, label: str) -> None:
    """Label the abscissa of one of six panels: only the lowest of a column has a label."""
    if axis % 3 == 2:
        panel.set_xlabel(label)
    else:
        panel.tick_params(labelbottom=False)


LARGE = (11.0, 8.4)  # inches


def six_pairs(
    title: str, note: str, theme: str, lines: Sequence[Line], error: Line, titles: Sequence[str],
    units: Sequence[str] = DISPLAY_UNITS,
) -> Any:
    """
    Draw six coordinates over time, each with its error below in another scale.

    Parameters
    ----------
    title, note : str
        Content of the figure, and its conditions.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.
    lines : sequence of Line
        Lines over common times (s), in their units.
    error : Line
        Error, drawn about zero.
    titles : sequence of str
        Title of each coordinate.
    units : sequence of str
        Unit of each coordinate.

    Returns
    -------
    matplotlib.figure.Figure
        Its axes are each coordinate, followed by its error.

    """
    with picture(title, note, theme, LARGE) as (figure, colours):
        from matplotlib.ticker import MaxNLocator

        legend_of(figure, [*lines, error], colours)
        outer = figure.add_gridspec(3, 2, **BELOW_HEAD, hspace=0.2, wspace=0.19)
        for axis in range(6):
            inner = outer[axis % 3, axis // 3].subgridspec(
                2, 1, height_ratios=(3.2, 1.0), hspace=0.1)
            upper, lower = pair = [figure.add_subplot(part) for part in inner]
            for panel, curves in ((upper, lines), (lower, (error,))):
                for _, colour, width, seconds, values in curves:
                    panel.plot(seconds, values[:, axis], color=getattr(colours, colour),
                               linewidth=width)
            upper.set_title(titles[axis], loc='right', fontsize=8.5, color=colours.quiet, pad=4.0)
            upper.set_ylabel(f'{AXES[axis]}  ({units[axis]})')
            upper.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
            upper.tick_params(labelbottom=False)
            lower.axhline(0.0, color=colours.quiet, linewidth=0.6)
            reach = 1.15 * max(float(np.nanmax(np.abs(error.values[:, axis]))), 1e-3)
            lower.set_ylim(-reach, reach)
            lower.set_ylabel(f'error\n({units[axis]})', color=colours.error, fontsize=7.5)
            lower.yaxis.set_major_locator(
                MaxNLocator(nbins=2, symmetric=True, steps=[1, 2, 3, 5, 10]))
            for panel in pair:
                panel.margins(x=0.0)
                panel.tick_params(length=2.5, width=0.6)
                panel.xaxis.set_major_locator(
                    MaxNLocator(nbins=12, steps=[1, 2, 5, 10], integer=True))
                panel.yaxis.set_label_coords(-0.125, 0.5)
            lower.tick_params(axis='y', labelsize=7.5)
            label_abscissa(lower, axis, 'time (s)')
    return figure


def masked(values: Array, valid: Mask) -> Array:
    """Return values with NaN where invalid, so that lines are interrupted."""
    shape = (len(values),) + (1,) * (values.ndim - 1)
    return np.asarray(np.where(valid.reshape(shape), values, np.nan))
