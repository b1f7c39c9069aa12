"""Pictures of a recording: motion, spectra, path, loads of the cup, predictions."""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3
from bellows_ros.core.signals.residuals import AXES, Comparison, Spectrum, Whiteness
from bellows_ros.workflows.plot import Loads, MeasuredMotion, Spectra
import numpy as np

from . import style


def motion_figure(motion: MeasuredMotion, note: str, theme: str = 'light') -> Any:
    """
    Draw tool and package over time, each axis from its start.

    Parameters
    ----------
    motion : MeasuredMotion
        What is drawn.
    note : str
        Which recording.
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
        return style.Line(name, colour, width, motion.seconds, style.SHOWN * moved)

    return style.six_lines('Motion in the world, from the start', note, theme, (
        line('tool', 'measured', 3.0, motion.tool_position, motion.tool_rotation),
        line('package', 'predicted', 0.9, motion.package_position, motion.package_rotation),
    ), 'time (s)')


def spectra_figure(
    spectra: Spectra, note: str, theme: str = 'light', one_step: Spectrum | None = None
) -> Any:
    """
    Draw the spectra of the package's motion seen from the tool, and of a prediction's error.

    Parameters
    ----------
    spectra : Spectra
        What is drawn.
    note : str
        Which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.
    one_step : Spectrum, optional
        Of one-step prediction errors, as a third line.

    Returns
    -------
    matplotlib.figure.Figure

    """
    hertz = spectra.frequency_hz[1:]
    lines = [style.Line('measured', 'measured', 2.2, hertz, style.SHOWN * spectra.measured[1:])]
    if spectra.error is not None:
        lines.append(style.Line(
            'predicted minus measured', 'error', 1.1, hertz, style.SHOWN * spectra.error[1:]))
    if one_step:
        lines.append(style.Line('one-step error', 'predicted', 0.9, one_step.frequency[1:],
                                style.SHOWN * np.sqrt(one_step.density[1:])))
    return style.six_lines(
        'Spectra of the package', f'{note}; relative to the tool', theme, lines, 'frequency (Hz)',
        [f'{unit}/√Hz' for unit in style.SHOWN_UNITS], log=True)


def path_figure(motion: MeasuredMotion, note: str, theme: str = 'light') -> Any:
    """
    Draw the paths of tool and package in space, with the axes of both now and then.

    Parameters
    ----------
    motion : MeasuredMotion
        What is drawn.
    note : str
        Which recording.
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
        for i in usable[:: max(1, len(usable) // 40)]:  # some forty
            space.plot(*np.array([tool[i], package[i]]).T, color=colours.quiet, linewidth=0.6)
        space.plot(*tool[usable[0]][:, None], 'o', color=colours.text, markersize=4.0)
        space.set_box_aspect((1.0, 1.0, 1.0), zoom=0.93)
        space.set_aspect('equal', adjustable='datalim')
        space.locator_params(nbins=5)
        space.set(xlabel='x (m)', ylabel='y (m)', zlabel='z (m)')
        figure.legend(loc='upper right', ncols=2)
    return figure


MAX_POINTS = 4000
UNITS = ('N',) * 3 + ('N m',) * 3


def deflection_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the load that the motion needs against the deflection, and the cup's stiffness.

    Parameters
    ----------
    loads : Loads
        What is drawn.
    note : str
        Which recording and cup.
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
        for axis, panel in enumerate(style.six_panels(figure, UNITS)):
            x, y = loads.deflection[shown, axis], loads.load[shown, axis]
            scale, unit = style.SHOWN[axis], style.SHOWN_UNITS[axis]
            points, = panel.plot(scale * x, y, '.', color=colours.measured, markersize=2.8,
                                 alpha=0.8, markeredgewidth=0.0)
            ends = np.array([x.min(), x.max()])
            line, = panel.plot(scale * ends, loads.stiffness[axis] * ends,
                               color=colours.predicted, linewidth=1.3)
            panel.set_xlabel(f'deflection {AXES[axis]} ({unit})', labelpad=1.0)
            panel.set_ylabel(f'{"moment" if axis > 2 else "force"} {AXES[axis]} ({UNITS[axis]})')
        figure.legend((points, line), ('needed by the motion', 'stiffness of the cup'),
                      loc='upper right', ncols=2, markerscale=4.0)
    return figure


def residual_figure(loads: Loads, note: str, theme: str = 'light') -> Any:
    """
    Draw the load that the motion needs, and below it the part unexplained by the cup.

    Parameters
    ----------
    loads : Loads
        What is drawn.
    note : str
        Which recording and cup.
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
         for value, unit, part in zip(rms, UNITS, parts, strict=True)], UNITS)


GAP_PERIODS = 3.0
"""A line is interrupted where samples are missing for this many periods."""

MIN_SPAN = (2.0,) * 3 + (0.1,) * 3
"""mm and degrees that an axis shows at least, so that noise at rest does not look like motion."""


def prediction_figure(
    seconds: Array, comparison: Comparison, title: str, note: str, theme: str = 'light'
) -> Any:
    """
    Draw a comparison.

    Parameters
    ----------
    seconds : array (N,)
        From the recording's first stamp, s.
    comparison : Comparison
        What is drawn; each line is interrupted where its values are missing.
    title, note : str
        What is shown, and under which conditions.
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
            style.SHOWN * scores.rms, style.SHOWN * scores.largest, scores.nrmse,
            style.SHOWN_UNITS, strict=True)]
    times, measured, predicted = (with_gaps(seconds, values) for values in (
        seconds, style.SHOWN * comparison.measured, style.SHOWN * comparison.predicted))
    figure = style.six_pairs(
        title, note, theme, (style.Line('measured', 'measured', 3.6, times, measured),
                             style.Line('predicted', 'predicted', 0.9, times, predicted)),
        style.Line('predicted minus measured', 'error', 0.6, times, predicted - measured), titles)
    for panel, least in zip(figure.axes[::2], MIN_SPAN, strict=True):
        low, high = panel.get_ylim()
        lack = 0.5 * max(0.0, least - (high - low))
        panel.set_ylim(low - lack, high + lack)
    return figure


def errors_figure(estimates: Mapping[str, Comparison], note: str, theme: str = 'light') -> Any:
    """
    Draw the errors of up to three estimates over time, each from the first stamp of all.

    Parameters
    ----------
    estimates : mapping of str to Comparison
        By name.
    note : str
        Of which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    start_ns = min(estimate.stamps_ns[0] for estimate in estimates.values())
    styles = (('predicted', 1.2), ('quiet', 0.9), ('error', 0.9))
    return style.six_lines('Predicted minus measured', note, theme, [
        style.Line(name, *drawn, (estimate.stamps_ns - start_ns) * 1e-9,
                   style.SHOWN * estimate.error)
        for (name, estimate), drawn in zip(estimates.items(), styles, strict=False)],
        'time (s)')


def whiteness_figure(test: Whiteness, note: str, theme: str = 'light') -> Any:
    """
    Draw the autocorrelation of errors, and the band in which that of white noise stays.

    Parameters
    ----------
    test : Whiteness
        What is drawn.
    note : str
        Of which errors.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    lags = np.arange(1.0, test.lags + 1.0)
    band = np.full((test.lags, 6), 1.96 / np.sqrt(test.samples))
    return style.six_lines('Autocorrelation of the errors', note, theme, (
        style.Line('95 % of white noise', 'quiet', 0.9, lags, band),
        style.Line('', 'quiet', 0.9, lags, -band),
        style.Line('autocorrelation', 'error', 1.2, lags, test.autocorrelation),
    ), 'lag (samples)', ('1',) * 6)


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
