"""
Pictures of results and animations of their motion, made with matplotlib (extra `plot`).

A measured quantity is a wide pale line, a predicted quantity a thin strong line on top, in colours
that are distinct with all common kinds of colour vision.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import io
from pathlib import Path
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.identification.validation import Validation
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.residuals import (
    AXES,
    Comparison,
    DISPLAY_FACTORS,
    DISPLAY_UNITS,
    relative_coordinates,
)
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss.landing import ellipse
from bellows_ros.errors import BellowsError, require_pictures, shown
from bellows_ros.files import File
from bellows_ros.files.atomic import write_bytes
from bellows_ros.workflows import CommandResult
import numpy as np

TEXT, QUIET, GRID, MEASURED, PREDICTED, ERROR = (
    '#1b1f24', '#57606a', '#e3e6ea', '#7593b1', '#b3261e', '#5b4a9e')
THREE = (PREDICTED, ERROR, MEASURED)
"""Colours of x, y and z, and of several motions."""

STYLE: Mapping[Any, Any] = {
    'font.size': 9.0, 'text.color': TEXT, 'text.parse_math': False, 'axes.labelcolor': TEXT,
    'axes.edgecolor': QUIET, 'axes.grid': True, 'axes.axisbelow': True, 'axes.linewidth': 0.6,
    'axes.spines.top': False, 'axes.spines.right': False, 'axes.titlesize': 9.5,
    'axes.titlelocation': 'left', 'axes.xmargin': 0.0, 'xtick.color': QUIET, 'ytick.color': QUIET,
    'grid.color': GRID, 'grid.linewidth': 0.6, 'legend.frameon': False, 'legend.fontsize': 8.0,
    'svg.fonttype': 'none', 'svg.hashsalt': 'bellows_ros', 'path.simplify_threshold': 0.5}

ENDINGS = ('.png', '.svg', '.pdf', '.gif')
FRAME_RATE = 12.0
"""Frames of an animation per second."""
SHORTEST = 6.0
"""Shortest animation, s: shorter motions are slowed down."""
LONGEST = 20.0
"""Longest animation, s: longer motions are cut."""
MIN_SPAN = np.repeat([2.0, 0.1], 3)
"""Smallest range of an axis with measured coordinates, mm and degrees: the noise of cameras."""
DRAWN_SECONDS = 5.0
"""Part of a long recording that is drawn in full, s: a package swings 10 to 20 times in it."""
BINS = 40
"""Number of bins of the envelope of a long recording: each is longer than a swing."""
GAP_PERIODS = 3.0
"""Shortest gap that interrupts a line, median periods."""
MAX_FACTOR = 4.0
"""Largest drawn safety factor, relative to the required factor, and to half the smallest one."""
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
EDGES = [[i, i | bit] for i in range(8) for bit in (1, 2, 4) if not i & bit]
"""Corners of a unit box, and its edges as indices of corners."""
AZIMUTH, ELEVATION = np.radians([-50.0, 12.0])
"""Direction to the viewer of an animation, rad."""
VIEW = np.array([
    [-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0],
    [-np.sin(ELEVATION) * np.cos(AZIMUTH), -np.sin(ELEVATION) * np.sin(AZIMUTH),
     np.cos(ELEVATION)]])
"""Projection (2, 3) to the picture, right and up, without mpl_toolkits, which may belong to
another matplotlib."""
REACH = 3.0
"""Largest distance of a held package's lip from the tool tip, lengths of the cup."""
MIN_MARGIN = 0.06
"""Margin about the motion of the package's box in an animation, m."""


class Scene(NamedTuple):
    """Poses of E and B over common times, of B for comparison if any, with cup and package."""

    label: str
    tool: Trajectory
    package: Trajectory
    outline: Trajectory | None
    values: Values


def require_ending(path: File) -> None:
    """Raise for a picture without matplotlib, or with an unknown ending of its name."""
    require_pictures()
    if Path(path).suffix.lower() not in ENDINGS:
        raise BellowsError(f"Picture '{path}' must end in {', '.join(ENDINGS[:-1])}, or in .gif "
                           'for an animation.')


def write(path: File, result: CommandResult) -> None:
    """
    Write the picture of a result, or with .gif an animation, whole or not at all.

    Raises
    ------
    BellowsError
        If matplotlib is missing, or the file cannot be written.

    """
    require_ending(path)
    if Path(path).suffix.lower() != '.gif':
        return write_figure(path, figure_of(result))
    write_bytes(path, animation([*DRAWINGS[type(result).__name__][1](result)]))


def write_figure(path: File, figure: Any) -> None:
    """Write a figure in the format of the name's ending, whole or not at all."""
    write_bytes(path, encoded(figure, Path(path).suffix.lower()[1:]))


def svg_of(figure: Any) -> str:
    """Return a figure as an SVG element."""
    return '<svg ' + encoded(figure, 'svg').decode().partition('<svg ')[2]


def encoded(figure: Any, ending: str) -> bytes:
    """Return the file of a figure, the same for the same figure."""
    import matplotlib

    data = io.BytesIO()
    with matplotlib.rc_context(dict(STYLE)):
        figure.savefig(data, format=ending, dpi=150, metadata={
            'svg': {'Date': None}, 'pdf': {'CreationDate': None}}.get(ending))
    return data.getvalue()


@contextmanager
def picture(title: str, note: str, size: tuple[float, float] = (9.4, 7.2)) -> Iterator[Any]:
    """Provide a figure of a size (inches) with a title and its conditions, without a window."""
    require_pictures()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(dict(STYLE)):
        figure = Figure(size, layout='constrained')
        figure.suptitle(f'{title}\n{shown(note, 150)}', x=0.01, ha='left', fontsize=11.0)
        yield figure


def figure_of(result: CommandResult) -> Any:
    """Return the figure of a result."""
    return DRAWINGS[type(result).__name__][0](result)


CommandResult.figure = figure_of


class Compared(NamedTuple):
    """Coordinates to draw, in displayed units: times, s, with measured and predicted ones."""

    seconds: Array
    measured: Array
    predicted: Array
    curve: tuple[Array, Array]
    """Times (M,), s, and coordinates (M, 6) of the whole prediction."""
    of_tag: bool
    """Whether the measured poses are of a tag."""

    @property
    def error(self) -> Array:
        """Predicted minus measured (N, 6); NaN where one is missing."""
        return self.predicted - self.measured

    @property
    def error_name(self) -> str:
        """Name of the error."""
        return 'noise of the tag' if self.of_tag else 'error'

    def between(self, begin: float, end: float) -> 'Compared':
        """Return the part between two times, s, with all gaps (NaN)."""
        inside, within = (~((t < begin) | (t > end)) for t in (self.seconds, self.curve[0]))
        return Compared(
            self.seconds[inside], self.measured[inside], self.predicted[inside],
            (self.curve[0][within], self.curve[1][within]), self.of_tag)


def compared(
    seconds: Array, comparison: Comparison, whole: tuple[Array, Array] | None
) -> Compared:
    """
    Return measured and predicted coordinates to draw, with NaN in gaps.

    Positions are drawn from the first predicted one. Of a tag the times (s) and coordinates (M, 6)
    of the whole prediction are given.
    """
    curve = (seconds, comparison.predicted) if whole is None else whole
    known = curve[1][np.isfinite(curve[1]).all(axis=1)]
    first = np.append(known[0, :3], np.zeros(3)) if len(known) else np.zeros(6)
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > GAP_PERIODS * np.median(steps)) + 1
    t, measured, predicted = (np.insert(rows, gaps, np.nan, axis=0) for rows in (
        seconds, DISPLAY_FACTORS * (comparison.measured - first),
        DISPLAY_FACTORS * (comparison.predicted - first)))
    drawn = (t, predicted) if whole is None else (
        whole[0], DISPLAY_FACTORS * (whole[1] - first))
    return Compared(t, measured, predicted, drawn, whole is not None)


def comparison_figure(
    seconds: Array, comparison: Comparison, title: str, note: str,
    whole: tuple[Array, Array] | None = None,
) -> Any:
    """
    Draw predicted and measured coordinates (N, 6) over time (s), each with its error below.

    Lines are interrupted at missing values. Poses of a tag are points, beside times (s) and
    coordinates (M, 6) of the whole prediction. A long recording is drawn as an envelope, with the
    `DRAWN_SECONDS` of the largest error beside it.
    """
    part = everything = compared(seconds, comparison, whole)
    is_long = float(seconds[-1] - seconds[0]) > 2.0 * DRAWN_SECONDS
    note += '; positions from the first predicted one'
    if is_long:
        begin, end = worst_part(seconds, comparison.error)
        part = everything.between(begin, end)
        note += f'; left: envelope of all, right: the worst {end - begin:.0f} s'
    with picture(title, note, (15.0, 8.4) if is_long else (11.0, 8.4)) as figure:
        columns = 4 if is_long else 2
        panels = figure.subplots(6, columns, sharex='col', height_ratios=(3.2, 1.0) * 3)
        for i, scores in enumerate(zip(
                DISPLAY_FACTORS * comparison.scores.rms,
                DISPLAY_FACTORS * comparison.scores.largest, strict=True)):
            pairs = panels[2 * (i % 3):2 * (i % 3) + 2]
            last = (i // 3 + 1) * columns // 2 - 1
            _draw_curves(pairs[:, last], part, i)
            if is_long:
                _draw_envelopes(pairs[:, last - 1], everything, i)
                pairs[0, last - 1].axvspan(begin, end, color=GRID, zorder=0)
            _name_axis(pairs[:, last - is_long], i, everything.error_name, *scores)
        for panel in panels[-1]:
            panel.set_xlabel('time (s)')
        handles = [line for panel in panels[:2, columns // 2 - 1] for line in panel.get_lines()]
        figure.legend(handles=handles, loc='upper right', ncols=3)
    return figure


def _draw_curves(panels: Any, part: Compared, i: int) -> None:
    """Draw measured and predicted coordinate i in the first panel, and their difference below."""
    points: Mapping[str, Any] = {'linestyle': '', 'marker': '.', 'markersize': 2.0}
    wide, thin = (points, points) if part.of_tag else ({'linewidth': 3.6}, {'linewidth': 0.6})
    upper, lower = panels
    upper.plot(part.seconds, part.measured[:, i], color=MEASURED, label='measured', **wide)
    upper.plot(part.curve[0], part.curve[1][:, i], color=PREDICTED, linewidth=0.9,
               label='predicted')
    lower.plot(part.seconds, part.error[:, i], color=ERROR, label='predicted minus measured',
               **thin)
    _widen(upper, i)


def _draw_envelopes(panels: Any, everything: Compared, i: int) -> None:
    """Draw smallest and largest values of coordinate i in the first panel, of its error below."""
    upper, lower = panels
    upper.fill_between(*envelope(everything.seconds, everything.measured[:, i]), color=MEASURED,
                       linewidth=0.0)
    times, low, high = envelope(everything.curve[0], everything.curve[1][:, i])
    for edge in (low, high):
        upper.plot(times, edge, color=PREDICTED, linewidth=0.9)
    lower.fill_between(*envelope(everything.seconds, everything.error[:, i]), color=ERROR,
                       linewidth=0.0)
    _widen(upper, i)


def _widen(panel: Any, i: int) -> None:
    """Widen the range of coordinate i to at least `MIN_SPAN`."""
    low, high = panel.get_ylim()
    lack = 0.5 * max(0.0, MIN_SPAN[i] - (high - low))
    panel.set_ylim(low - lack, high + lack)


def _name_axis(panels: Any, i: int, error: str, rms: float, largest: float) -> None:
    """Write the name of coordinate i, and its RMS and largest error in displayed units."""
    upper, lower = panels
    unit = DISPLAY_UNITS[i]
    upper.set_ylabel(f'{AXES[i]} ({unit})')
    lower.set_ylabel(error.split()[0], color=ERROR)
    upper.set_title(f'{error} RMS {rms:.2g} {unit}, largest {largest:.2g} {unit}', loc='right',
                    fontsize=8.5)


def worst_part(seconds: Array, error: Array) -> tuple[float, float]:
    """
    Return begin and end (s) of the `DRAWN_SECONDS` with the largest error.

    The errors (N, 6) at times (N,) are counted relative to the RMS of each axis.
    """
    rms = np.sqrt(np.nanmean(error**2, axis=0))
    relative = error / np.where(rms > 0.0, rms, 1.0)
    summed = np.append(0.0, np.cumsum(np.nansum(relative**2, axis=1)))
    ends = np.searchsorted(seconds, seconds + DRAWN_SECONDS, 'right')
    begin = float(seconds[np.argmax(summed[ends] - summed[:-1])])
    begin = max(min(begin, float(seconds[-1]) - DRAWN_SECONDS), float(seconds[0]))
    return begin, begin + DRAWN_SECONDS


def envelope(seconds: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return middles (K,), s, and smallest and largest values in `BINS` bins; NaN if empty."""
    finite = np.isfinite(seconds)
    seconds, values = seconds[finite], values[finite]
    edges = np.linspace(seconds[0], seconds[-1], BINS + 1)
    low, high = np.full((2, BINS), np.nan)
    bounds = np.append(np.searchsorted(seconds, edges[:-1]), len(seconds))
    for k in range(BINS):
        inside = values[bounds[k]:bounds[k + 1]]
        if np.isfinite(inside).any():
            low[k], high[k] = np.nanmin(inside), np.nanmax(inside)
    return 0.5 * (edges[:-1] + edges[1:]), low, high


def simulation_figure(found: Validation) -> Any:
    """Draw the free simulation of a recording."""
    since = found.recording.since_start
    return comparison_figure(
        since(found.stamps_ns), found, 'Package: predicted, and measured',
        f'{found.recording.name}, relative to the tool', found.corners and (
            since(found.tool.stamps_ns), relative_coordinates(found.tool, found.package)))


def first_simulation(result: Any) -> Validation:
    """Return the first free simulation with an identified cup."""
    simulations: tuple[Validation, ...] = result.verdict.simulations
    if not simulations:
        raise BellowsError('There is no picture: no recording can be simulated with this cup.')
    return simulations[0]


def _plan_note(report: Any, is_part: bool, has_bands: bool) -> str:
    """Return the conditions and signs of the picture of a plan, which may show only a part."""
    motion, name = report.result, next(iter(report.motions))
    parts = [f'{report.source.path}, {name}', 'dashed: safety.least', 'red: the cup lets go']
    if is_part:
        begin, end = motion.drawn
        parts.append(f'the worst {end - begin:.0f} of {motion.duration:.0f} s')
    else:
        parts.append('dotted: the end')
    if has_bands:
        parts.append('bands: ± 2 std')
    return '; '.join(parts)


def plan_figure(report: Any) -> Any:
    """Draw package and grip along a plan, with bands of two standard deviations."""
    motion = report.result
    (t, tool, values, std), least = motion.curves, report.source.values.safety.least
    begin, end = motion.drawn
    stop = motion.begin + motion.duration
    factor = 'safety factor'
    if report.prediction.grip is None:
        factor += ': set cup.lip_radius, vacuum.holding'
    inside, first = (t >= begin) & (t <= end), values[0, 12:]
    t, tool, values, std = t[inside], tool[inside], values[inside], std[inside]
    note = _plan_note(report, end < stop, bool(std.any()))
    with picture('Package and grip along the plan', note) as figure:
        panels = figure.subplots(3, 2, sharex=True).ravel()
        panels[0].plot(t, tool, color=QUIET)
        panels[1].axhline(least, color=TEXT, linewidth=0.8, linestyle='--')
        panels[1].axhspan(0.0, 1.0, color=PREDICTED, alpha=0.12, linewidth=0.0)
        shown_curves = (
            ('position (m), grey: the tool', values[:, :3], std[:, :3], 'xyz'),
            (factor, values[:, 4:6], std[:, 4:6], ('peel', 'slip')),
            ('shift in the frame of the tool (mm)', 1e3 * (values[:, 12:] - first),
             1e3 * std[:, 12:], 'xyz'),
            ('force at the lip (N)', values[:, 6:9], std[:, 6:9], 'xyz'),
            ('bending of the cup (deg)', np.degrees(values[:, 3:4]), np.degrees(std[:, 3:4]),
             ['angle']),
            ('moment at the lip (N m)', values[:, 9:12], std[:, 9:12], 'xyz'))
        for panel, (title, rows, errors, names) in zip(panels, shown_curves, strict=True):
            for value, band, colour, name in zip(
                    rows.T, 2.0 * errors.T, THREE, names, strict=False):
                panel.fill_between(t, value - band, value + band, color=colour, alpha=0.25)
                panel.plot(t, value, color=colour, linewidth=1.2, label=name)
            panel.set_title(title)
            panel.legend(loc='lower right', bbox_to_anchor=(1.0, 0.98), ncols=4)
            panel.axvline(stop, color=QUIET, linewidth=0.8, linestyle=':')
            panel.set_xlim(t[0], t[-1])
        smallest = float(values[:, 4:6].min())
        panels[1].set_ylim(0.0, max(MAX_FACTOR * least, 0.5 * MAX_FACTOR * smallest))
        for panel in panels[-2:]:
            panel.set_xlabel('time (s)')
    return figure


def toss_figure(result: Any) -> Any:
    """Draw a toss from the side and from above, and its landing enlarged."""
    toss, case, landing = result.toss, result.case, np.array(result.toss.landing[0][:2])
    ((tool, package),) = result.scenes().values()
    times = result.source.begin + package.seconds
    held, path = np.split(package.position, [np.searchsorted(times, toss.release_time)])
    switched = held[np.searchsorted(times[:len(held)], case.switched) - 1]
    note = (f'{result.source.path}: valve {case.switched:.3f} s, lets go {toss.release_time:.3f} '
            f's, lands {toss.landing_time:.3f} s')
    with picture('Toss', note, (11.0, 7.2)) as figure:
        side, close, above = figure.subplot_mosaic(
            [['side', 'close'], ['above', 'close']], width_ratios=(2.0, 1.0),
            height_ratios=(3.0, 1.0)).values()
        for panel, rows in ((side, [0, 2]), (above, [0, 1])):
            for points, mark, colour, name in (
                    (tool.position, '-', MEASURED, 'tool'),
                    (held, '--', PREDICTED, 'package, held'),
                    (path, '-', PREDICTED, 'package, flying'),
                    (switched[None], 'v', TEXT, 'valve'), (path[:1], 'o', TEXT, 'lets go')):
                panel.plot(*points[:, rows].T, mark, color=colour, linewidth=1.2, label=name)
            panel.margins(0.05)
            panel.set_aspect('equal', adjustable='datalim')
        side.axhline(case.release.height, color=TEXT, linewidth=1.0)
        side.set_ylabel('z (m), from the side')
        above.set(xlabel='x (m)', ylabel='y (m), from above')
        for panel, origin, scale in ((above, 0.0 * landing, 1.0), (close, landing, 1e3)):
            panel.plot(*(scale * (landing - origin + ellipse(result.covariance, 121))).T,
                       color=ERROR, label='95 % ellipse of the landing')
            panel.plot(*(scale * (landing - origin + result.scatter.errors[:, :2])).T, '.',
                       markersize=2.0, color=ERROR, alpha=0.5, label='drawn tosses')
            if result.aim is not None:
                panel.plot(*(scale * (result.aim.target - origin)), '+', color=TEXT, markersize=12,
                           label='target')
        close.set(title='landing from above (mm)', xlabel='x from the prediction',
                  ylabel='y from the prediction')
        close.margins(0.1)
        close.set_aspect('equal', adjustable='datalim')
        figure.legend(handles=above.get_legend_handles_labels()[0], ncols=3,
                      loc='outside upper right')
    return figure


# ----------------------------------------------------------------------------------- animations


def simulation_scenes(validation: Validation, values: Values) -> Iterator[Scene]:
    """Yield the free simulation of a recording, with the measured package."""
    tool, package = (resample(body, validation.stamps_ns)
                     for body in (validation.tool, validation.package))
    position, rotation = np.hsplit(validation.measured, 2)
    outline = Trajectory(
        tool.stamps_ns, tool.position + apply(tool.rotation, np.nan_to_num(position)),
        tool.rotation @ exp_so3(np.nan_to_num(rotation)))
    yield Scene(f'{validation.recording.name}; violet: measured', tool, package, outline, values)


def identification_scenes(result: Any) -> Iterator[Scene]:
    """Yield the first free simulation with an identified cup."""
    simulation = first_simulation(result)
    return simulation_scenes(simulation, result.cup_values().replaced({
        'package.com': tuple(simulation.recording.payload.com.tolist())}))


def plan_scenes(result: Any) -> Iterator[Scene]:
    """Yield the predicted motions along a plan, or a toss until its landing."""
    for title, (tool, package) in result.scenes().items():
        yield Scene(title, tool, package, None, result.source.values)


def animation(scenes: Sequence[Scene]) -> bytes:
    """Return scenes side by side as an endless GIF."""
    last = max(float(scene.tool.seconds[-1]) for scene in scenes)
    speed = min(1.0, last / SHORTEST)
    times, images = np.arange(0.0, min(last, LONGEST), speed / FRAME_RATE), []
    with picture('Tool, cup and package', f'{speed:.2g} times real time', (8.0, 4.8)) as figure:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from PIL import Image

        canvas = FigureCanvasAgg(figure)
        panels = [_space(panel, scene) for panel, scene in zip(figure.subplots(
            1, len(scenes), squeeze=False)[0], scenes, strict=True)]
        for t in times:
            drawn = [artist for panel, scene in zip(panels, scenes, strict=True)
                     for artist in _bodies(panel, scene, t)]
            drawn.append(figure.text(0.99, 0.02, f'{t:.2f} s', ha='right'))
            canvas.draw()
            figure.set_layout_engine('none')
            images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(
                64, dither=Image.Dither.NONE))
            for artist in drawn:
                artist.remove()
    data = io.BytesIO()
    images[0].save(data, 'gif', save_all=True, append_images=images[1:], loop=0,
                   duration=round(1000.0 / FRAME_RATE))
    return data.getvalue()


def _space(panel: Any, scene: Scene) -> Any:
    """Return a panel that shows a whole scene in equal scales."""
    bodies = np.vstack([scene.tool.position, scene.package.position]) @ VIEW.T
    margin = MIN_MARGIN + 0.5 * float(np.linalg.norm(scene.values.package.size))
    low, high = bodies.min(axis=0) - margin, bodies.max(axis=0) + margin
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), title=scene.label)
    panel.set_aspect('equal')
    panel.plot(*(scene.package.position @ VIEW.T).T, color=MEASURED, linewidth=0.8)
    panel.set_axis_off()
    return panel


def _bodies(panel: Any, scene: Scene, t: float) -> list[Any]:
    """Draw the bodies at a time (s), and return their artists."""
    from matplotlib.collections import LineCollection

    i = min(int(np.searchsorted(scene.tool.seconds, t)), len(scene.tool) - 1)
    com, size = np.array(scene.values.package.com), np.array(scene.values.package.size)
    tip, arm = scene.tool.position[i], 0.1 * scene.tool.rotation[i, :, 2]  # m
    lip = scene.package.position[i] - scene.package.rotation[i] @ com
    lines = [([[tip, tip + arm]], QUIET, 7.0)]
    if np.linalg.norm(lip - tip) < REACH * scene.values.cup.length:
        lines.append(([[tip, lip]], MEASURED, 5.0))
    for body, colour in ((scene.package, PREDICTED), (scene.outline, ERROR)):
        if body is not None:  # without a given size the line from the lip to the centre of mass
            box = CORNERS[EDGES] * size if size.all() else np.array([[-com, 0.0 * com]])
            lines.append((body.position[i] + box @ body.rotation[i].T, colour, 1.6))
    return [panel.add_collection(LineCollection(
        list(np.asarray(each) @ VIEW.T), colors=colour, linewidths=width))
            for each, colour, width in lines]


DRAWINGS: Mapping[str, tuple[Callable[[Any], Any], Callable[[Any], Iterator[Scene]]]] = {
    'Replay': (lambda result: simulation_figure(result.validation),
               lambda result: simulation_scenes(result.validation, result.values)),
    'Identification': (
        lambda result: simulation_figure(first_simulation(result)), identification_scenes),
    'PlanReport': (plan_figure, plan_scenes), 'TossResult': (toss_figure, plan_scenes)}
"""Functions that draw a result of a type: its figure, and the scenes of its animation."""
