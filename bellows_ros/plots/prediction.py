"""
Measured against predicted pose of the package relative to the tool, and pictures of a fit.

The content of Figs. 4.16 and 4.17 of the thesis on one page, with what is left over below each
axis, to its own scale.
"""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.signals.residuals import Comparison, MILLI_UNITS, Whiteness
import numpy as np

from .panels import LEFT, legend, Line, MILLI, picture, six_lines, six_pairs

SIZE = (11.0, 8.4)  # inches
GAP_PERIODS = 3.0
"""A line is interrupted where samples are missing for this many periods."""

LEAST_SPAN = 2.0
"""mm or mrad that an axis shows at least, so that noise at rest does not look like motion."""


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
        What is drawn; each line is interrupted where its own values are missing.
    title, note : str
        What is shown, and under which conditions.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    with picture(title, note, theme, SIZE) as (figure, colours):
        legend(figure, (('measured', colours.measured, 4.0), ('predicted', colours.predicted, 1.0),
                        ('predicted minus measured', colours.error, 1.0)))
        scores = comparison.scores
        titles = [
            f'error RMS {figures(rms)} {unit}, largest {figures(largest)} {unit}, '
            f'{percent(nrmse)} of the motion' for rms, largest, nrmse, unit in zip(
                MILLI * scores.rms, MILLI * scores.largest, scores.nrmse, MILLI_UNITS,
                strict=True)]
        times, measured, predicted = (with_gaps(seconds, values) for values in (
            seconds, MILLI * comparison.measured, MILLI * comparison.predicted))
        columns = six_pairs(
            figure, colours, (Line('', 'measured', 3.6, times, measured),
                              Line('', 'predicted', 0.9, times, predicted)),
            predicted - measured, titles, MILLI_UNITS, 'error\n({})', left=LEFT, right=0.985,
            top=0.855, bottom=0.065, hspace=0.2, wspace=0.19)
        for upper, _ in columns:
            low, high = upper.get_ylim()
            lack = 0.5 * max(0.0, LEAST_SPAN - (high - low))
            upper.set_ylim(low - lack, high + lack)
        for (top, _), what in zip(columns[::3], ('Position', 'Rotation'), strict=True):
            figure.text(top.get_position().x0, 0.885, f'{what} of B in tool axes', fontsize=10.5,
                        fontweight='bold')
    return figure


def errors_figure(ways: Mapping[str, Comparison], note: str, theme: str = 'light') -> Any:
    """
    Draw the errors of up to three estimates over time, each from the first stamp of all.

    Parameters
    ----------
    ways : mapping of str to Comparison
        By name.
    note : str
        Of which recording.
    theme : {'light', 'dark'}
        Colours for a light or a dark background.

    Returns
    -------
    matplotlib.figure.Figure

    """
    start_ns = min(way.stamps_ns[0] for way in ways.values())
    styles = (('predicted', 1.2), ('quiet', 0.9), ('error', 0.9))
    return six_lines('Predicted minus measured', note, theme, [
        Line(name, colour, width, (way.stamps_ns - start_ns) * 1e-9, MILLI * way.error)
        for (name, way), (colour, width) in zip(ways.items(), styles, strict=False)], 'time (s)')


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
    return six_lines('Autocorrelation of the errors', note, theme, (
        Line('95 % of white noise', 'quiet', 0.9, lags, band), Line('', 'quiet', 0.9, lags, -band),
        Line('autocorrelation', 'error', 1.2, lags, test.autocorrelation),
    ), 'lag (samples)', ('1',) * 6)


def figures(value: float) -> str:
    """Return a number with two figures."""
    return f'{value:#.2g}'.removesuffix('.')


def percent(ratio: float) -> str:
    """Return a ratio in percent with two figures, or a dash if nothing moved."""
    return f'{figures(100.0 * ratio)} %' if np.isfinite(ratio) else '-'


def with_gaps(seconds: Array, values: Array) -> Array:
    """Return values (N + G, ...) with NaN in each of the G gaps, so that lines are interrupted."""
    if len(seconds) < 3:
        return values
    steps = np.diff(seconds)
    gaps = np.flatnonzero(steps > GAP_PERIODS * np.median(steps)) + 1
    broken: Array = np.insert(values, gaps, np.nan, axis=0)
    return broken
