"""Animations of tool, cup and package: a replay, and a motion as planned and steered."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
import io
from pathlib import Path
import shutil
import subprocess
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.live.load import equivalent_box
from bellows_ros.core.model.simulation import ToolRows
from bellows_ros.errors import BellowsError, install
from bellows_ros.files import File
from bellows_ros.files.atomic import write_bytes
from bellows_ros.workflows import plot, recordings, steer
import numpy as np

from .style import FILMS, picture, require_picture, Theme

FRAMES_PER_SECOND = {'.gif': 12.0, '.mp4': 30.0}
SIZE, DPI = (8.0, 4.5), 80
TAIL_SHOWN = 0.5
"""Time shown after the end of a steered motion, s."""

FLOOR_LINES = 0.1
"""Spacing of the lines on the floor, m."""

RINGS, SIDES = 25, 13  # of the drawn cup; the last point of a ring repeats the first
CONVOLUTIONS = 2.5
RADIUS = 0.020  # m

BOX_EDGES = [[i, i | bit] for i in range(8) for bit in (1, 2, 4) if not i & bit]
BOX_FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
"""Edges and faces of a box, as indices of `box_corners`."""


def write_animation(
    path: File, replayed: plot.Replayed, note: str, theme: str = 'light',
    progress: recordings.Progress = recordings.no_progress, speed: float = 1.0,
) -> None:
    """
    Write a replay as a GIF, or, with ffmpeg, as an MP4.

    Parameters
    ----------
    path : path
        Path that ends in .gif or .mp4.
    replayed : Replayed
        Poses of the animation.
    note : str
        Name of recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.
    progress : callable, optional
        Callback with the current step and its completed fraction (0 to 1).
    speed : float
        Seconds of the recording per second of the animation.

    Raises
    ------
    BellowsError
        If the ending is another one, or ffmpeg is missing.

    """
    views = (View('in the world', replayed, 1.3),
             View('moving with the tool tip', replayed, 1.6, at_tool=True))
    _write(path, views, 'Predicted, and measured as an outline', note, theme, progress, speed)


def write_steering(
    path: File, report: steer.SteerReport, note: str, speed: float, theme: str = 'light'
) -> None:
    """
    Write an animation of a planned motion beside the motion without swing (steered).

    Path, note, theme, speed and errors are as in `write_animation`.
    """
    values, views = report.source.values, []
    last = TAIL_SHOWN + max(float(motion.tool.seconds[-1]) for motion in report.motions.values())
    for name in ('as planned', report.method):
        if motion := report.motions.get(name):
            seconds = motion.along.seconds
            package = ToolRows(motion.along.stamps_ns, motion.states).trajectory()
            tool, package = (
                body.select(seconds <= last) for body in (motion.along, package))
            label = name if name == 'as planned' else f'steered ({name})'
            views.append(View(label, plot.Scene(
                seconds[seconds <= last], tool, package, package, values.cup.length,
                np.array(values.package.com), np.array(equivalent_box(values))), 1.22,
                shows_tilt=True))
    _write(path, views, 'The same transport, as planned and steered', note, theme,
           recordings.no_progress, speed)


class View(NamedTuple):
    """
    A scene in the world, or close-up and moving with the tool tip.

    With `shows_tilt` it has a floor, the trail of the package, and its current tilt.
    """

    label: str
    scene: plot.Scene
    zoom: float
    at_tool: bool = False
    shows_tilt: bool = False


def _write(
    path: File, views: Sequence[View], title: str, note: str, theme: str,
    progress: recordings.Progress, speed: float,
) -> None:
    """Write views side by side, from the first to the last time of all views."""
    ending = f'.{require_picture(path, FILMS)}'
    rate_hz = FRAMES_PER_SECOND[ending]
    encode = _gif if ending == '.gif' else _mp4
    times = np.arange(min(view.scene.seconds[0] for view in views),
                      max(view.scene.seconds[-1] for view in views), speed / rate_hz)
    pictures = _drawn(views, times, title, note, theme, progress)
    write_bytes(path, encode(pictures, rate_hz))


def _ffmpeg() -> str:
    """Return the path of ffmpeg from the system, or from the extra `video`."""
    if program := shutil.which('ffmpeg'):
        return program
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        raise BellowsError(
            'An .mp4 needs ffmpeg, which is not installed. Install it (apt install ffmpeg, or '
            f'{install("video")}), or write a .gif.') from None


def _drawn(
    views: Sequence[View], times: Array, title: str, note: str, theme: str,
    progress: recordings.Progress
) -> Iterator[Any]:
    """Yield each picture as an array (H, W, 3) of bytes."""
    with picture(title, note, theme, SIZE, DPI) as (figure, colours):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        canvas = FigureCanvasAgg(figure)
        spaces = [_space(figure, left, view, colours)
                  for left, view in zip((-0.02, 0.48), views, strict=False)]
        for number, t in enumerate(times):
            progress('drawing', number / len(times))
            drawn = [artist for space, view in zip(spaces, views, strict=True)
                     for artist in _draw(space, view, t, colours)]
            drawn.append(figure.text(0.985, 0.03, f'{t:.2f} s', ha='right', fontsize=11))
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
            for artist in drawn:
                artist.remove()


def _space(figure: Any, left: float, view: View, colours: Theme) -> Any:
    """Return a panel that shows the whole path, or a close-up of the cup."""
    scene = view.scene
    bodies = np.vstack([scene.tool.position, scene.package.position])
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * np.max(high - low) + 0.7 * np.max(scene.box)
    if view.at_tool:
        half = 0.8 * np.max(scene.box) + 0.2 * scene.cup_length
        centre = np.array([0.0, 0.0, -0.15 * half])
    space = figure.add_axes((left, -0.06, 0.54, 0.98), projection='3d', computed_zorder=False)
    space.set_axis_off()
    space.view_init(*((13.0, -42.0) if view.shows_tilt else (14.0, -60.0)))
    reach = np.full(3, half)
    if view.shows_tilt:
        margin = np.max(scene.box) * np.array([0.75, 0.75, 0.6])
        reach, centre = 0.5 * (high - low) + margin, 0.5 * (low + high)
        _draw_floor(space, centre, reach, colours)
    for name, c, r in zip('xyz', centre, reach, strict=True):
        getattr(space, f'set_{name}lim')(c - r, c + r)
    space.set_box_aspect(reach, zoom=view.zoom)
    figure.text(left + 0.27, 0.03, view.label, ha='center', color=colours.quiet,
                fontsize=11 if view.shows_tilt else None)
    return space


def _draw_floor(space: Any, centre: Array, reach: Array, colours: Theme) -> None:
    """Draw a floor with a grid below a scene."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    z = centre[2] - reach[2]
    (x0, x1), (y0, y1) = ((c - r, c + r) for c, r in zip(centre[:2], reach[:2], strict=True))
    lines = [[(x, y0, z), (x, y1, z)] for x in np.arange(x0, x1 + 1e-9, FLOOR_LINES)]
    lines += [[(x0, y, z), (x1, y, z)] for y in np.arange(y0, y1 + 1e-9, FLOOR_LINES)]
    space.add_collection3d(Line3DCollection(
        lines, colors=colours.quiet, linewidths=0.7, alpha=0.45, zorder=0))


def _draw(space: Any, view: View, t: float, colours: Theme) -> list[Any]:
    """Draw one instant into a panel and return its artists."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    scene = view.scene
    i = min(int(np.searchsorted(scene.seconds, t)), len(scene.seconds) - 1)
    shift = scene.tool.position[i] if view.at_tool else np.zeros(3)
    (tool_o, tool_R), (body_o, body_R), outline = (
        (body.position[i] - shift, body.rotation[i])
        for body in (scene.tool, scene.package, scene.outline))
    lip_o = body_o - body_R @ scene.com
    package = Poly3DCollection(
        list(box_corners(body_o, body_R, scene.box)[BOX_FACES]), facecolor=colours.predicted,
        alpha=0.55, edgecolor=colours.text, linewidth=0.8)
    rings = bellows_rings(tool_o, tool_R, lip_o, body_R)
    cup = Poly3DCollection(
        [np.array([a[k], a[k + 1], b[k + 1], b[k]])
         for a, b in zip(rings, rings[1:], strict=False) for k in range(SIDES - 1)],
        facecolor=colours.measured, edgecolor=colours.quiet, linewidth=0.3)
    arm = np.array([tool_o, tool_o + tool_R @ np.array([0.0, 0.0, 0.1])])  # m
    edges = Line3DCollection(
        list(box_corners(*outline, scene.box)[BOX_EDGES]), colors=colours.error, linewidths=1.3)
    for order, thing in enumerate((package, cup, edges), 1):
        thing.set_zorder(order)
        space.add_collection3d(thing)
    drawn = space.plot(*arm.T, color=colours.quiet, linewidth=7.0, solid_capstyle='butt', zorder=2)
    if view.shows_tilt:
        drawn += space.plot(*scene.package.position[:i + 1].T, color=colours.predicted,
                            linewidth=1.6, zorder=1)
        tilt = float(np.degrees(np.arccos(np.clip(body_R[2, 2], -1.0, 1.0))))
        drawn.append(space.text2D(
            0.5, 0.8, f'tilt {tilt:4.1f} deg', transform=space.transAxes, ha='center',
            fontsize=15, color=colours.predicted, family='monospace'))
    return [package, cup, edges, *drawn]


def _gif(pictures: Iterator[Any], rate_hz: float) -> bytes:
    """Return an endless GIF."""
    from PIL import Image

    images = [Image.fromarray(p).quantize(64, dither=Image.Dither.NONE) for p in pictures]
    data = io.BytesIO()
    images[0].save(
        data, 'gif', save_all=True, append_images=images[1:], loop=0,
        duration=round(1000.0 / rate_hz), optimize=False)
    return data.getvalue()


def _mp4(pictures: Iterator[Any], rate_hz: float) -> bytes:
    """Return an MP4 by ffmpeg that plays everywhere, also before it is completely loaded."""
    width, height = (round(DPI * side) for side in SIZE)
    with TemporaryDirectory() as folder:
        target = Path(folder, 'animation.mp4')
        command = [_ffmpeg(), '-loglevel', 'error', '-f', 'rawvideo', '-pix_fmt', 'rgb24', '-s',
                   f'{width}x{height}', '-r', f'{rate_hz:g}', '-i', '-', '-pix_fmt', 'yuv420p',
                   '-movflags', '+faststart', str(target)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process, \
                suppress(BrokenPipeError):  # it has ended early; its exit code is checked below
            for frame in pictures:
                process.stdin.write(frame.tobytes())  # type: ignore[union-attr]
        if process.returncode != 0:
            raise BellowsError('ffmpeg failed, with the reason above. Write a .gif instead.')
        return target.read_bytes()


def box_corners(centre: Array, R: Array, size: Array) -> Array:
    """Return the corners (8, 3) of a box in the world, m, counted in binary: x, y, z."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(centre + (0.5 * signs * size) @ R.T)


def bellows_rings(top_o: Array, top_R: Array, lip_o: Array, lip_R: Array) -> Array:
    """
    Return the rings of a bellows between two z axes.

    Parameters
    ----------
    top_o, lip_o : array (3,)
        Tool tip E and lip S in the world, m.
    top_R, lip_R : array (3, 3)
        Orientations of tool tip and lip.

    Returns
    -------
    array (RINGS, SIDES, 3)
        Points in the world, m.

    """
    s = np.linspace(0.0, 1.0, RINGS)[:, None]
    reach = float(np.linalg.norm(lip_o - top_o))
    rates = -reach * top_R[:, 2], -reach * lip_R[:, 2]
    spine = ((2 * s**3 - 3 * s**2 + 1) * top_o + (s**3 - 2 * s**2 + s) * rates[0]
             + (3 * s**2 - 2 * s**3) * lip_o + (s**3 - s**2) * rates[1])
    radius = RADIUS * (0.75 + 0.2 * np.cos(2.0 * np.pi * CONVOLUTIONS * (s - 1.0)))
    angle = np.linspace(0.0, 2.0 * np.pi, SIDES)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)])
    return np.array([o + r * (circle @ ((1 - t) * top_R + t * lip_R).T)
                     for o, r, t in zip(spine, radius, s, strict=True)])
