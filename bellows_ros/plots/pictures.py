"""
Pictures of recordings and of plans.

A recording has pictures of motion, spectra, path, loads of the cup and predictions; a plan has
pictures of the predicted, steered, tossed or designed motion, and of the safety factor over time.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.identification.quantities import as_found
from bellows_ros.core.identification.result import WRENCH_UNITS
from bellows_ros.core.live.load import equivalent_box
from bellows_ros.core.model.grip import MODES
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals import residuals
from bellows_ros.core.signals.residuals import AXES, DISPLAY_FACTORS, DISPLAY_UNITS
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.core.toss.landing import ellipse
from bellows_ros.core.toss.release import flight_path
from bellows_ros.workflows import excite, plan, replay, steer, toss
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.plot import Loads, MeasuredMotion, Spectra
import numpy as np

from . import style
from .animation import box_corners, BOX_EDGES, RADIUS


def motion_figure(motion: MeasuredMotion, note: str, theme: str = 'light') -> Any:
    """
    Draw tool and package over time, each axis relative to its start.

    Parameters
    ----------
    motion : MeasuredMotion
        Motion of tool and package.
    note : str
        Name of the recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    start = int(np.argmax(motion.valid))

    def line(name: str, colour: str, width: float, position: Array, rotation: Array) -> Any:
        turned = log_so3(rotation @ rotation[start].T)
        moved = style.masked(np.hstack([position - position[start], turned]), motion.valid)
        return style.Line(name, colour, width, motion.seconds, DISPLAY_FACTORS * moved)

    return style.six_lines('Motion in the world, from the start', note, theme, (
        line('tool', 'measured', 3.0, motion.tool_position, motion.tool_rotation),
        line('package', 'predicted', 0.9, motion.package_position, motion.package_rotation),
    ), 'time (s)')


def spectra_figure(spectra: Spectra, note: str, theme: str = 'light') -> Any:
    """
    Draw the spectra of the package's motion in the tool frame, and of a prediction's error.

    Parameters
    ----------
    spectra : Spectra
        Spectra of motion and error.
    note : str
        Name of the recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    hertz = spectra.frequency_hz[1:]
    lines = [style.Line(
        'measured', 'measured', 2.2, hertz, DISPLAY_FACTORS * spectra.measured[1:])]
    if spectra.error is not None:
        lines.append(style.Line(
            'predicted minus measured', 'error', 1.1, hertz, DISPLAY_FACTORS * spectra.error[1:]))
    return style.six_lines(
        'Spectra of the package', f'{note}; relative to the tool', theme, lines, 'frequency (Hz)',
        [f'{unit}/√Hz' for unit in DISPLAY_UNITS], log=True)


def path_figure(motion: MeasuredMotion, note: str, theme: str = 'light') -> Any:
    """
    Draw the paths of tool and package in space, with the axes of both at intervals.

    Parameters
    ----------
    motion : MeasuredMotion
        Motion of tool and package.
    note : str
        Name of the recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    usable = np.flatnonzero(motion.valid)
    with style.picture('Paths of tool tip and package', note, theme, (8.4, 8.0)) as (
            figure, colours):
        space = figure.add_axes((0.02, 0.04, 0.92, 0.86), projection='3d')
        tool = style.masked(motion.tool_position, motion.valid)
        package = style.masked(motion.package_position, motion.valid)
        space.plot(*tool.T, color=colours.measured, linewidth=2.4, label='tool tip E')
        space.plot(*package.T, color=colours.predicted, linewidth=1.0, label='package B')
        for i in usable[:: max(1, len(usable) // 40)]:  # about forty
            space.plot(*np.array([tool[i], package[i]]).T, color=colours.quiet, linewidth=0.6)
        space.plot(*tool[usable[0]][:, None], 'o', color=colours.text, markersize=4.0)
        space.set_box_aspect((1.0, 1.0, 1.0), zoom=0.93)
        space.set_aspect('equal', adjustable='datalim')
        space.locator_params(nbins=5)
        space.set(xlabel='x (m)', ylabel='y (m)', zlabel='z (m)')
        figure.legend(loc='upper right', ncols=2)
    return figure


MAX_POINTS = 4000


def deflection_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the required load against the deflection, and the cup's stiffness.

    Parameters
    ----------
    loads : Loads
        Loads on the cup and deflections of the lip.
    note : str
        Name of recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    usable = np.flatnonzero(loads.valid)
    shown = usable[:: max(1, len(usable) // MAX_POINTS)]
    title = 'Load on the cup against its deflection'
    with style.picture(title, note, theme) as (figure, colours):
        for axis, panel in enumerate(style.six_panels(figure, WRENCH_UNITS)):
            x, y = loads.deflection[shown, axis], loads.load[shown, axis]
            scale, unit = DISPLAY_FACTORS[axis], DISPLAY_UNITS[axis]
            points, = panel.plot(scale * x, y, '.', color=colours.measured, markersize=2.8,
                                 alpha=0.8, markeredgewidth=0.0)
            ends = np.array([x.min(), x.max()])
            line, = panel.plot(scale * ends, loads.stiffness[axis] * ends,
                               color=colours.predicted, linewidth=1.3)
            panel.set_xlabel(f'deflection {AXES[axis]} ({unit})', labelpad=1.0)
            load = 'moment' if axis > 2 else 'force'
            panel.set_ylabel(f'{load} {AXES[axis]} ({WRENCH_UNITS[axis]})')
        figure.legend((points, line), ('needed by the motion', 'stiffness of the cup'),
                      loc='upper right', ncols=2, markerscale=4.0)
    return figure


def sketch_figure(values: Values, theme: str = 'light') -> Any:
    """Draw cup, lip and package to scale, viewed along y, with the points E, S and B."""
    depth, _, height = equivalent_box(values)
    x, _, z = values.package.com
    length = values.cup.length
    with style.picture('Cup and package to scale', f'{values.package.mass:.3g} kg', theme,
                       (6.4, 4.4)) as (figure, colours):
        panel = figure.add_axes((0.12, 0.13, 0.84, 0.7))
        turns = np.linspace(0.0, 1.0, 200)
        radius = RADIUS * (0.8 + 0.2 * np.cos(6.0 * np.pi * turns))
        panel.fill_betweenx(1e3 * length * (1.0 - turns), -1e3 * radius, 1e3 * radius,
                            color=colours.measured, alpha=0.8)
        sides = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]]) * [[0.5 * depth], [0.5 * height]]
        panel.fill(*(1e3 * (sides + [[x], [z]])), facecolor=colours.predicted, alpha=0.35,
                   edgecolor=colours.text)
        for name, at in (('E', (0.0, length)), ('S', (0.0, 0.0)), ('B', (x, z))):
            panel.plot(1e3 * at[0], 1e3 * at[1], 'o', color=colours.text, markersize=4.0)
            panel.annotate(name, (1e3 * at[0], 1e3 * at[1]), (6.0, 4.0),
                           textcoords='offset points', fontweight='bold')
        panel.set_aspect('equal')
        panel.margins(0.12)
        panel.set_xlabel('x (mm)')
        panel.set_ylabel('z from the lip (mm)')
    return figure


def residual_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the required load, and below it the part unexplained by the cup.

    Parameters
    ----------
    loads : Loads
        Loads on the cup and deflections of the lip.
    note : str
        Name of recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    load, residual = (style.masked(x, loads.valid) for x in (loads.load, loads.residual))
    rms = np.sqrt(np.nanmean(residual**2, axis=0))
    parts = 100.0 * rms / np.maximum(np.nanstd(load, axis=0), 1e-12)
    return style.six_pairs(
        'Load on the cup, and the unexplained part', note, theme,
        [style.Line('needed by the motion', 'measured', 1.8, loads.seconds, load)],
        style.Line('unexplained', 'error', 0.6, loads.seconds, residual),
        [f'unexplained RMS {value:.2g} {unit}, {part:.2g} % of the load'
         for value, unit, part in zip(rms, WRENCH_UNITS, parts, strict=True)], WRENCH_UNITS)


GAP_PERIODS = 3.0
"""Shortest gap that interrupts a line, periods."""


def prediction_figure(
    seconds: Array, comparison: residuals.Comparison, title: str, note: str, theme: str = 'light'
) -> Any:
    """
    Draw a comparison.

    Parameters
    ----------
    seconds : array (N,)
        Times from the recording's first stamp, s.
    comparison : Comparison
        Measured and predicted coordinates; lines are interrupted at missing values.
    title, note : str
        Content of the figure, and its conditions.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    scores = comparison.scores
    titles = [
        f'error RMS {two_digits(rms)} {unit}, largest {two_digits(largest)} {unit}, '
        f'{two_digits(100.0 * nrmse) + " %" if np.isfinite(nrmse) else "-"} of the motion'
        for rms, largest, nrmse, unit in zip(
            DISPLAY_FACTORS * scores.rms, DISPLAY_FACTORS * scores.largest, scores.nrmse,
            DISPLAY_UNITS, strict=True)]
    times, measured, predicted = (with_gaps(seconds, values) for values in (
        seconds, DISPLAY_FACTORS * comparison.measured, DISPLAY_FACTORS * comparison.predicted))
    figure = style.six_pairs(
        title, note, theme, (style.Line('measured', 'measured', 3.6, times, measured),
                             style.Line('predicted', 'predicted', 0.9, times, predicted)),
        style.Line('predicted minus measured', 'error', 0.6, times, predicted - measured), titles)
    for panel, least in zip(figure.axes[::2], (2.0,) * 3 + (0.1,) * 3, strict=True):  # mm and deg
        low, high = panel.get_ylim()
        lack = 0.5 * max(0.0, least - (high - low))
        panel.set_ylim(low - lack, high + lack)
    return figure


def errors_figure(
    estimates: Mapping[str, residuals.Comparison], note: str, theme: str = 'light'
) -> Any:
    """
    Draw the errors of up to three estimates over time, each from the first common stamp.

    Parameters
    ----------
    estimates : mapping of str to Comparison
        Estimates by name.
    note : str
        Name of the recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    start_ns = min(estimate.stamps_ns[0] for estimate in estimates.values())
    styles = (('predicted', 1.2), ('quiet', 0.9), ('error', 0.9))
    return style.six_lines('Predicted minus measured', note, theme, [
        style.Line(name, *drawn, (estimate.stamps_ns - start_ns) / NS_PER_S,
                   DISPLAY_FACTORS * estimate.error)
        for (name, estimate), drawn in zip(estimates.items(), styles, strict=False)],
        'time (s)')


def two_digits(value: float) -> str:
    """Return a number with two figures."""
    return f'{value:#.2g}'.removesuffix('.')


def with_gaps(seconds: Array, values: Array) -> Array:
    """Return values (N + G, ...) with NaN in each of the G gaps, so that lines are interrupted."""
    if len(seconds) < 3:
        return values
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > GAP_PERIODS * np.median(steps)) + 1
    return np.asarray(np.insert(values, gaps, np.nan, axis=0))


# ---------------------------------------------------------------------------------------- plans

WIDE = (9.4, 4.2)  # inches
BANDS = 'bands: two standard deviations'
"""Explanation of the bands in the subtitle of a picture."""


def _with_bands(note: str, std: np.ndarray) -> str:
    """Return a subtitle that explains the bands, if any standard deviation is above 0."""
    return f'{note}; {BANDS}' if np.any(std > 0.0) else note


def plan_figure(report: plan.PlanReport, theme: str = 'light') -> Any:
    """
    Draw tool and package along a plan, with bands of two standard deviations.

    Parameters
    ----------
    report : PlanReport
        Prediction of the plan.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    curves = report.curves
    seconds, values, std = curves.seconds, curves.values, curves.std
    offset = values[:, :3] - curves.tool
    note = _with_bands(str(report.source.path), std)
    with style.picture('Package and grip along the plan', note, theme) as (figure, colours):
        grid = {**style.BELOW_HEAD, 'hspace': 0.28, 'wspace': 0.2}
        panels = figure.subplots(3, 2, sharex=True, gridspec_kw=grid).ravel()
        style.draw_series(panels[0], seconds, curves.tool, [colours.quiet] * 3)
        safety = 'safety factor: set cup.lip_radius, vacuum.holding'
        if report.prediction.grip:
            safety = 'safety factor'
            _draw_margins(panels[1], replay.Margins(
                seconds, values[:, 4:6], std[:, 4:6],
                report.prediction.smallest_safety, report.least), colours)
        for panel, factor, shown, sigma, names in (
            (panels[0], 1.0, values[:, :3], std[:, :3], 'xyz'),
            (panels[2], style.MILLI, offset - offset[0], std[:, :3], 'xyz'),
            (panels[3], 1.0, values[:, 6:9], std[:, 6:9], 'xyz'),
            (panels[4], style.DEGREES, values[:, 3:4], std[:, 3:4], ''),
            (panels[5], 1.0, values[:, 9:], std[:, 9:], 'xyz'),
        ):
            style.draw_series(panel, seconds, factor * shown, colours.three, names, factor * sigma)
        for panel, name in zip(panels, (
                'position (m), grey: the tool', safety, 'package seen from the tool tip (mm)',
                'force at the lip (N)', 'bending of the cup (deg)',
                'moment at the lip (N m)'), strict=True):
            style.name_panel(panel, name)
            panel.axvline(
                report.source.duration, color=colours.quiet, linewidth=0.8, linestyle=':')
            panel.set_xlim(0.0, seconds[-1])
        for panel in panels[-2:]:
            panel.set_xlabel('time (s); dotted: end of the plan')
    return figure


def margin_figure(margins: replay.Margins, note: str, theme: str = 'light') -> Any:
    """
    Draw the safety factors of a grip over time, with bands of two standard deviations.

    Parameters
    ----------
    margins : Margins
        Safety factors of the grip.
    note : str
        Name of recording and cup.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    note = _with_bands(note, margins.std)
    with style.picture('How firmly the grip holds', note, theme, WIDE) as (figure, colours):
        panel = figure.subplots(gridspec_kw={
            **style.BELOW_HEAD, 'top': 1.0 - 0.9 / WIDE[1], 'bottom': 0.52 / WIDE[1]})
        _draw_margins(panel, margins, colours)
        panel.set_xlim(margins.seconds[0], margins.seconds[-1])
        style.name_panel(panel, 'safety factor', 'time (s)')
    return figure


def _draw_margins(panel: Any, margins: replay.Margins, colours: style.Theme) -> None:
    """Draw the safety factors, the smallest, the required one, and the time of the loss."""
    style.draw_series(panel, margins.seconds, margins.factors, colours.three, MODES, margins.std)
    factor, mode, time = margins.smallest
    panel.plot([time], [factor], 'o', markersize=4.0, color=colours.text,
               label=f'{factor:.3g} ({mode}, {time:.3g} s)')
    panel.axhline(margins.least, color=colours.text, linewidth=0.8, linestyle='--')
    panel.axhspan(0.0, 1.0, color=colours.predicted, alpha=0.12, linewidth=0.0)
    box = {'facecolor': colours.background, 'alpha': 0.8, 'linewidth': 0.0, 'pad': 1.5}
    for height, words, place in ((margins.least, 'safety.least', 'bottom'),
                                 (0.5, 'lets go', 'center')):
        panel.text(0.99, height, words, fontsize=7.5, va=place, ha='right', bbox=box,
                   transform=panel.get_yaxis_transform(), color=colours.quiet)
    top = max(4.0 * margins.least, 1.5 * factor)
    panel.set_ylim(0.0, top)
    if np.nanmax(margins.factors) > top:
        panel.text(0.99, 0.97, f'above {top:.3g}: not shown', fontsize=7.5, va='top', ha='right',
                   transform=panel.transAxes, color=colours.quiet, bbox=box)


def excite_figure(result: excite.DesignedMotion, theme: str = 'light') -> Any:
    """
    Draw a motion, its spectrum, and its ratios to the limits.

    Parameters
    ----------
    result : DesignedMotion
        Designed motion.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    motion, ratios = result.design.motion, result.design.ratios
    t = np.arange(0.0, motion.duration, 0.01)
    u: Array = motion.displacement(t)[0]
    lines = np.abs(motion.coefficients)
    hertz = np.arange(1, len(lines) + 1) / motion.period
    title = 'Motion for identifying stiffness and damping'
    with style.picture(title, f'{motion.duration:g} s', theme) as (figure, colours):
        grid = figure.add_gridspec(3, 2, **style.BELOW_HEAD, hspace=0.6, wspace=0.2)
        for line, (kind, factor, unit) in enumerate(
                (('shift', style.MILLI, 'mm'), ('rotation', style.DEGREES, 'deg'))):
            of_time, of_frequency = (figure.add_subplot(grid[line, i]) for i in (0, 1))
            axes = slice(3 * line, 3 * line + 3)
            style.draw_series(of_time, t, factor * u[:, axes], colours.three, width=0.7)
            style.draw_series(of_frequency, hertz, factor * lines[:, axes], colours.three,
                              AXES[axes], width=0.8)
            of_frequency.set_yscale('log')
            style.name_panel(of_time, f'{kind} of the tool ({unit})', 'time (s)')
            style.name_panel(of_frequency, f'amplitude ({unit})', 'frequency (Hz)')
        panel = figure.add_subplot(grid[2, :])
        panel.bar(range(len(ratios)), [100.0 * ratio for ratio in ratios.values()],
                  color=colours.measured, width=0.6)
        panel.axhline(100.0, color=colours.text, linewidth=0.8, linestyle='--')
        panel.set_xticks(range(len(ratios)), [name.replace(' ', '\n') for name in ratios],
                         fontsize=7)
        style.name_panel(panel, 'largest part of each limit (%)')
    return figure


TAIL_SHOWN = 1.0
"""Time shown after the end of the last motion, s."""


def steer_figure(report: steer.SteerReport, theme: str = 'light') -> Any:
    """
    Draw the bending of the cup, and the path length of the tool, of several motions.

    Parameters
    ----------
    report : SteerReport
        Steered motion.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    motions = report.motions
    note = f'{report.source.path}; dotted: the motion of the tool ends'
    with style.picture('The motion as planned and steered', note, theme) as (figure, colours):
        panels = figure.subplots(2, 1, sharex=True, gridspec_kw={
            **style.BELOW_HEAD, 'hspace': 0.28, 'height_ratios': [2.0, 1.0]})
        lines = (colours.predicted, colours.measured)
        end = TAIL_SHOWN + max(float(motion.tool.seconds[-1]) for motion in motions.values())
        for (name, motion), colour in zip(motions.items(), lines, strict=False):
            tool = motion.tool
            distance = np.linalg.norm(tool.position - tool.position[0], axis=1)
            line = {'color': colour, 'linewidth': 1.4}
            panels[0].plot(motion.along.seconds, np.degrees(motion.tilt), label=name, **line)
            seconds = np.append(tool.seconds, end)  # at rest after its motion
            panels[1].plot(seconds, np.append(distance, distance[-1]), **line)
            for panel in panels:
                panel.axvline(tool.seconds[-1], color=colour, linewidth=0.8, linestyle=':')
        for panel, title in zip(panels, (
                'bending of the cup (deg)', 'distance of the tool (m)'), strict=True):
            style.name_panel(panel, title)
        panels[0].set_xlim(0.0, end)
        panels[-1].set_xlabel('time (s)')
    return figure


def toss_figure(result: toss.TossResult, theme: str = 'light') -> Any:
    """
    Draw a toss.

    Parameters
    ----------
    result : TossResult
        Predicted toss.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    toss, motion = result.toss, result.case.held
    tool, path = result.source.tool, flight_path(motion.model, toss, 60)
    held = motion.states[motion.times <= toss.release_time]
    valve = held[np.searchsorted(motion.times[:len(held)], result.case.switched) - 1]
    spread = 1e3 * np.sqrt(np.diag(result.covariance))
    x, y, _ = toss.landing[0]
    note = (f'valve {result.case.switched:.3f} s, lets go {toss.release_time:.3f} s, lands '
            f'{toss.landing_time:.3f} s at x {x:.3f} m, y {y:.3f} m ± {spread[0]:.1f}, '
            f'{spread[1]:.1f} mm')
    title = f'Toss of {Path(result.source.path).name}'
    with style.picture(title, note, theme, (11.0, 7.2)) as (figure, colours):
        reach = np.vstack([tool.position, path[:, :3]])
        spans = np.ptp(reach, axis=0) + 0.3
        grid = figure.add_gridspec(
            2, 2, **style.BELOW_HEAD, width_ratios=(3.0, 1.0), height_ratios=(spans[2], spans[1]),
            hspace=0.12, wspace=0.14)
        side = figure.add_subplot(grid[0, 0])
        above = figure.add_subplot(grid[1, 0], sharex=side)
        close = figure.add_subplot(grid[:, 1])
        height, box = result.case.release.height, result.case.release.box
        for panel, axes in ((side, [0, 2]), (above, [0, 1])):
            for rows, mark, colour, name in (
                    (tool.position, '-', colours.measured, 'tool'),
                    (held, '--', colours.predicted, 'package, held'),
                    (path, '-', colours.predicted, 'package, flying'),
                    (valve[None], 'v', colours.text, 'valve'),
                    (path[:1], 'o', colours.text, 'lets go')):
                panel.plot(*rows[:, axes].T, mark, color=colour, linewidth=1.2, label=name)
            for lines in _outlines(path, *map(np.array, box)):
                for line in lines:
                    panel.plot(*line[:, axes].T, color=colours.predicted, linewidth=0.6)
        side.axhline(height, color=colours.text, linewidth=1.0)
        side.set_ylabel('z (m), from the side')
        above.set_ylabel('y (m), from above')
        above.set_xlabel('x (m)')
        _draw_landing(above, close, result, colours)
        if result.aim is not None:
            side.plot(result.aim.target[0], height, '+', color=colours.text, markersize=12)
        width = max(np.ptp(side.get_xlim()), *(  # equal scale for all three axes
            np.ptp(panel.get_ylim()) * panel.bbox.width / panel.bbox.height
            for panel in (side, above)))
        side.set_xlim(np.mean(side.get_xlim()) + width * np.array([-0.5, 0.5]))
        for panel in (side, above):
            panel.set_aspect('equal', adjustable='datalim')
        figure.legend(*above.get_legend_handles_labels(), loc='upper right',
                      bbox_to_anchor=(0.99, 0.985), ncols=4, fontsize=8,
                      columnspacing=0.8, handlelength=1.1, handletextpad=0.5)
    return figure


def _outlines(path: Array, half: Array, middle: Array) -> Iterator[Array]:
    """Yield the edges (12, 2, 3) of the flying box at a few positions."""
    for row in path[np.linspace(0, len(path) - 1, 6).astype(int)]:
        R = quaternion_to_rotation(row[3:7])
        yield box_corners(row[:3] + R @ middle, R, 2.0 * half)[BOX_EDGES]


def _draw_landing(above: Any, close: Any, result: toss.TossResult, colours: style.Theme) -> None:
    """Draw ellipse, drawn landings and target from above, and a close-up."""
    landing = np.array(result.toss.landing[0][:2])
    for panel, origin, scale in ((above, np.zeros(2), 1.0), (close, landing, style.MILLI)):
        panel.plot(*(scale * (landing - origin + ellipse(result.covariance, 121))).T,
                   color=colours.error, linewidth=1.4, label='95 % ellipse')
        if result.drawn is not None:
            panel.plot(*(scale * (landing - origin + result.drawn.errors[:, :2])).T, '.',
                       markersize=2.0, color=colours.error, alpha=0.5, label='drawn tosses')
        if result.aim is not None:
            panel.plot(*(scale * (result.aim.target - origin)), '+', color=colours.text,
                       markersize=12, label='target')
    close.set_title('landing from above\n(scales differ)', fontsize=9)
    close.set_xlabel('x from the prediction (mm)')
    close.set_ylabel('y from the prediction (mm)')


def replay_figure(result: replay.Replay, theme: str = 'light') -> Any:
    """Draw a replay by `prediction_figure`."""
    return prediction_figure(
        result.recording.since_start(result.validation.stamps_ns), result.validation,
        'Measured and predicted', f'{result.bag}, relative to the tool', theme)


def identification_figure(result: Identification, theme: str = 'light') -> Any:
    """Draw the free simulation of a validation recording, or otherwise of the first fitted one."""
    return replay_figure(next(iter(result.validations), None) or replay.validated(
        result.cup_values(), as_found(result.recordings[0], result.fit.nuisances, 0)), theme)


FIGURES: Mapping[type, Callable[[Any, str], Any]] = {
    plan.PlanReport: plan_figure, steer.SteerReport: steer_figure, toss.TossResult: toss_figure,
    excite.DesignedMotion: excite_figure, replay.Replay: replay_figure,
    Identification: identification_figure}
