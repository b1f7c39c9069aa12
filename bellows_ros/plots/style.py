"""
Style of the pictures: a light and a dark theme, and atomic output.

What is measured is a wide pale line and what is predicted a thin strong one on top of it, so that
they differ without colour too; the two colours can be distinguished with all common kinds of
colour vision.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from html import escape
import io
from pathlib import Path
import re
from typing import Any

from bellows_ros.errors import BellowsError, require_pictures
from bellows_ros.files import File
from bellows_ros.files.atomic import write_bytes

DPI = 150
SAME_BYTES: dict[Any, Any] = {'svg.hashsalt': 'bellows_ros'}
INLINE: dict[Any, Any] = {**SAME_BYTES, 'svg.fonttype': 'none', 'path.simplify_threshold': 0.5}
"""Text of a page stays text, and points of a line closer than half a point (1/72 in) merge."""


@dataclass(frozen=True)
class Theme:
    """Colours of a picture by purpose, as matplotlib names them."""

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


THEMES = {
    'light': Theme(
        background='#ffffff', text='#1b1f24', quiet='#57606a', grid='#e3e6ea',
        measured='#9fb4c9', predicted='#b3261e', error='#5b4a9e'),
    'dark': Theme(
        background='#0d1117', text='#e6edf3', quiet='#9198a1', grid='#262c36',
        measured='#5b7fa6', predicted='#ffb454', error='#b7a8ff')}


@contextmanager
def drawing(theme: Theme) -> Iterator[Any]:
    """
    Provide `matplotlib.figure` in a theme, for files only: no window, no global state.

    Raises
    ------
    BellowsError
        Without matplotlib.

    """
    require_pictures()
    import matplotlib
    import matplotlib.figure

    base = matplotlib.rc_params_from_file(STYLE, use_default_template=False)
    with matplotlib.rc_context({**base, **_colours(theme)}):
        yield matplotlib.figure


STYLE = Path(__file__).with_name('pictures.mplstyle')


def _colours(theme: Theme) -> dict[Any, Any]:
    """Return matplotlib's settings of a theme's colours."""
    return {name: colour for colour, names in (
        (theme.text, 'text.color axes.labelcolor xtick.labelcolor ytick.labelcolor'),
        (theme.background, 'figure.facecolor savefig.facecolor axes.facecolor '
         'axes3d.xaxis.panecolor axes3d.yaxis.panecolor axes3d.zaxis.panecolor'),
        (theme.quiet, 'axes.edgecolor xtick.color ytick.color'), (theme.grid, 'grid.color'),
    ) for name in names.split()}


PICTURES, FILMS = ('.png', '.svg', '.pdf'), ('.gif', '.mp4')


def require_picture(path: File, allowed: tuple[str, ...] = PICTURES) -> str:
    """Return the format of a picture or film by its name's ending; refuse one not allowed."""
    ending = Path(path).suffix.lower()
    if ending not in allowed:
        raise BellowsError(
            f"Picture '{path}' must end in {', '.join(allowed[:-1])} or {allowed[-1]}.")
    return ending.lstrip('.')


def write_figure(path: File, figure: Any) -> None:
    """Write a figure in the format of the name's ending, whole or not at all."""
    ending = require_picture(path)
    data = io.BytesIO()
    metadata = {'png': {'Software': None}, 'svg': {'Date': None}, 'pdf': {'CreationDate': None}}
    import matplotlib

    with matplotlib.rc_context(SAME_BYTES):
        figure.savefig(data, format=ending, dpi=DPI, metadata=metadata[ending])
    write_bytes(path, data.getvalue())


def inline_svg(figure: Any) -> str:
    """
    Return a figure of the light theme as SVG for a page, which gives its colours their values.

    The colours become CSS variables with the names of a `Theme`. The figure's label is read out.
    """
    import matplotlib

    data = io.StringIO()
    with matplotlib.rc_context(INLINE):
        figure.savefig(data, format='svg', metadata=dict.fromkeys(
            ('Creator', 'Date', 'Format', 'Type')))
    svg = re.sub(
        r'.*?<svg [^>]*?(viewBox="[^"]*")[^>]*>',
        rf'<svg \1 role="img" aria-label="{escape(figure.get_label())}">',
        data.getvalue(), count=1, flags=re.DOTALL)
    svg = re.sub(r'<g id="[^"]*"', '<g', svg)
    svg = re.sub(  # a tenth of a point and no line ends are enough of a path
        r' d="[^"]*"', lambda path: re.sub(r'(\.\d)\d+', r'\1', path[0]).replace(' \n', ''), svg)
    for name, colour in asdict(THEMES['light']).items():
        svg = svg.replace(colour, f'var(--{name})')
    return svg
