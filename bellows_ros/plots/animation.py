"""A moving picture of tool, cup and package: predicted, with the measured package over it."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
import io
from itertools import chain
import os
from pathlib import Path
import shutil
import subprocess
from typing import Any

from bellows_ros.core.arrays import Array, Stamps
from bellows_ros.errors import BellowsError
from bellows_ros.extras import install
from bellows_ros.files.atomic import scratch_folder, write_bytes
from bellows_ros.workflows.plot import Replayed
import numpy as np

from .shapes import bellows_rings, SIDES
from .style import drawing, Theme, THEMES

Progress = Callable[[str, float], None]

FRAMES_PER_SECOND = {'.gif': 12.0, '.mp4': 30.0}
NO_FFMPEG = (
    'An .mp4 needs ffmpeg, which is not here. Install it (apt install ffmpeg, or '
    f'{install("video")}), or write a .gif.'
)
SIZE, DPI = (8.0, 4.5), 80
ARM = 0.10  # m, of the tool that is drawn above its tip
NEAR_ZOOM, FAR_ZOOM = 1.6, 1.3  # as large as the box stays inside of, wherever it swings
VIEW = {'elev': 14.0, 'azim': -60.0}
EDGES = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6),
         (3, 7))


def write_animation(
    path: str | os.PathLike[str], replayed: Replayed, note: str, theme: str = 'light',
    progress: Progress | None = None, speed: float = 1.0,
) -> None:
    """
    Write a replay as a GIF, or as an MP4 where ffmpeg is there.

    Parameters
    ----------
    path : path
        Ends in .gif or .mp4.
    replayed : Replayed
        What is shown.
    note : str
        Which recording and cup.
    theme : {'light', 'dark'}
        For paper or for the dark.
    progress : callable, optional
        Called with what is being done and the part (0 to 1) that is done.
    speed : float
        Seconds of the recording per second of the animation.

    Raises
    ------
    BellowsError
        If the ending is another, or ffmpeg is missing.

    """
    ending = Path(path).suffix.lower()
    if ending not in FRAMES_PER_SECOND:
        raise BellowsError(f"Animation '{path}' must end in .gif or .mp4.")
    rate_hz = FRAMES_PER_SECOND[ending]
    encode = _gif if ending == '.gif' else partial(_mp4, ffmpeg=_ffmpeg())
    chosen = _frames(replayed.seconds, rate_hz / speed)
    pictures = _drawn(replayed, chosen, note, THEMES[theme], progress or (lambda what, part: None))
    write_bytes(path, encode(pictures, rate_hz))


def _ffmpeg() -> str:
    """Return the program ffmpeg, that of the system or that of the extra."""
    found = shutil.which('ffmpeg')
    if found is None:
        try:
            from imageio_ffmpeg import get_ffmpeg_exe

            found = get_ffmpeg_exe()
        except (ImportError, RuntimeError):
            raise BellowsError(NO_FFMPEG) from None
    return str(found)


def _frames(seconds: Array, rate_hz: float) -> Stamps:
    """Return the samples to show."""
    times = np.arange(seconds[0], seconds[-1], 1.0 / rate_hz)
    chosen: Stamps = np.minimum(np.searchsorted(seconds, times), len(seconds) - 1)
    return chosen


def _drawn(
    replayed: Replayed, chosen: Stamps, note: str, colours: Theme, progress: Progress
) -> Iterator[Any]:
    """Yield each picture as an array (H, W, 3) of bytes."""
    with drawing(colours) as figures:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        figure = figures.Figure(figsize=SIZE, dpi=DPI)
        canvas = FigureCanvasAgg(figure)
        spaces = _spaces(figure, replayed, note, colours)
        for number, i in enumerate(chosen):
            progress('drawing', number / len(chosen))
            drawn = [_draw(space, replayed, int(i), colours, near) for space, near in spaces]
            clock = figure.text(0.985, 0.03, f'{replayed.seconds[i]:.2f} s', ha='right',
                                fontsize=11)
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
            for artist in (clock, *drawn[0], *drawn[1]):
                artist.remove()


def _spaces(figure: Any, replayed: Replayed, note: str, colours: Theme) -> list[tuple[Any, bool]]:
    """Return the two panels: the whole way, and the cup from near, which moves with the tool."""
    figure.text(0.03, 0.935, 'Predicted, and measured as an outline', fontsize=12,
                fontweight='bold')
    figure.text(0.03, 0.885, note, color=colours.quiet)
    bodies = np.vstack([replayed.motion.tool_position, replayed.position])
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    reach = 0.5 * float(np.max(high - low)) + 0.7 * float(np.max(replayed.box))
    size = 0.8 * float(np.max(replayed.box)) + 0.2 * replayed.cup_length
    panels = []
    for left, near, centre, half, words in (
        (-0.02, False, 0.5 * (low + high), reach, 'in the world'),
        (0.48, True, np.array([0.0, 0.0, -0.15 * size]), size, 'moving with the tool tip'),
    ):
        space = figure.add_axes((left, -0.06, 0.54, 0.98), projection='3d',
                                computed_zorder=False)
        space.set_axis_off()
        space.view_init(**VIEW)
        for name, c in zip('xyz', centre, strict=True):
            getattr(space, f'set_{name}lim')(c - half, c + half)
        space.set_box_aspect((1.0, 1.0, 1.0), zoom=NEAR_ZOOM if near else FAR_ZOOM)
        figure.text(left + 0.27, 0.03, words, ha='center', color=colours.quiet)
        panels.append((space, near))
    return panels


def _draw(space: Any, replayed: Replayed, i: int, colours: Theme, near: bool) -> list[Any]:
    """Draw one moment into a panel and return what was drawn."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    tool_o, tool_R = replayed.motion.tool_position[i], replayed.motion.tool_rotation[i]
    shift = tool_o if near else np.zeros(3)
    body_o, body_R = replayed.position[i] - shift, replayed.rotation[i]
    tool_o = tool_o - shift
    lip_o = body_o - body_R @ replayed.com
    faces = [_face(body_o, body_R, replayed.box, k) for k in range(6)]
    package = Poly3DCollection(faces, facecolor=colours.predicted, alpha=0.55,
                               edgecolor=colours.text, linewidth=0.8)
    cup = Poly3DCollection(_cup(tool_o, tool_R, lip_o, body_R), facecolor=colours.measured,
                           edgecolor=colours.quiet, linewidth=0.3)
    arm = np.array([tool_o, tool_o + tool_R @ np.array([0.0, 0.0, ARM])])
    corners = _corners(replayed.motion.package_position[i] - shift,
                       replayed.motion.package_rotation[i], replayed.box)
    outline = Line3DCollection([corners[list(edge)] for edge in EDGES], colors=colours.error,
                               linewidths=1.3)
    for order, thing in enumerate((package, cup, outline), 1):
        thing.set_zorder(order)
        space.add_collection3d(thing)
    drawn = space.plot(*arm.T, color=colours.quiet, linewidth=7.0, solid_capstyle='butt',
                       zorder=2)
    return [package, cup, outline, *drawn]


def _corners(o: Array, R: Array, box: Array) -> Array:
    """Return the corners (8, 3) of a box."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners: Array = o + (0.5 * signs * box) @ R.T
    return corners


def _face(o: Array, R: Array, box: Array, number: int) -> Array:
    """Return the corners (4, 3) of one face of a box."""
    axis, side = number // 2, number % 2
    corners = _corners(o, R, box).reshape(2, 2, 2, 3)
    square = np.take(corners, side, axis=axis).reshape(4, 3)
    face: Array = square[[0, 1, 3, 2]]
    return face


def _cup(top_o: Array, top_R: Array, lip_o: Array, lip_R: Array) -> list[Array]:
    """Return the faces of a bellows."""
    rings = bellows_rings(top_o, top_R, lip_o, lip_R)
    return [np.array([a[k], a[k + 1], b[k + 1], b[k]])
            for a, b in zip(rings, rings[1:], strict=False) for k in range(SIDES - 1)]


def _gif(pictures: Iterator[Any], rate_hz: float) -> bytes:
    """Return a GIF that runs for ever."""
    from PIL import Image

    images = [Image.fromarray(p).quantize(64, dither=Image.Dither.NONE) for p in pictures]
    data = io.BytesIO()
    images[0].save(
        data, 'gif', save_all=True, append_images=images[1:], loop=0,
        duration=round(1000.0 / rate_hz), optimize=False,
    )
    return data.getvalue()


def _mp4(pictures: Iterator[Any], rate_hz: float, ffmpeg: str) -> bytes:
    """Return an MP4, made by ffmpeg, that plays everywhere and before it is loaded to its end."""
    first = next(pictures)
    height, width = first.shape[:2]
    with scratch_folder() as folder:
        target = folder / 'animation.mp4'
        command = [ffmpeg, '-loglevel', 'error', '-f', 'rawvideo', '-pix_fmt', 'rgb24', '-s',
                   f'{width}x{height}', '-r', f'{rate_hz:g}', '-i', '-', '-pix_fmt', 'yuv420p',
                   '-movflags', '+faststart', str(target)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process, \
                suppress(BrokenPipeError):  # it has ended early: its code tells
            for picture in chain((first,), pictures):
                process.stdin.write(picture.tobytes())  # type: ignore[union-attr]
        if process.returncode != 0:
            raise BellowsError(
                'ffmpeg could not make the animation; it says why above. Write a .gif instead.')
        return target.read_bytes()
