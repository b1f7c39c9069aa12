"""
Charts as inline SVG, drawn from numbers alone.

Colours are classes that the page gives a light and a dark meaning. Long series are thinned to the
lowest and the highest sample of every pixel column, so that no spike is lost; NaN interrupts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
import math

from bellows_ros.core.arrays import Array
import numpy as np

LEFT, RIGHT, TOP, BOTTOM = 58.0, 12.0, 10.0, 34.0
LETTER = 6.6  # width of a character of the charts' text, about
ROW = 18.0
MARK = 4.0


@dataclass(frozen=True, eq=False)
class Curve:
    """
    One line of a chart.

    Parameters
    ----------
    x, y : ndarray (N,)
        Points; NaN interrupts the line.
    kind : str
        Class of its colour: 'measured', 'predicted', 'error', 'other' or 'quiet'.
    label : str
        For the legend; '' for none.

    """

    x: Array
    y: Array
    kind: str
    label: str = ''


@dataclass(frozen=True)
class Scale:
    """An axis: the range of numbers, the range of pixels, and whether it is logarithmic."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def place(self, values: Array) -> Array:
        """Return pixels; NaN where a logarithm does not exist."""
        ends = np.array([self.low, self.high])
        if self.log:
            values, ends = np.log10(np.where(values > 0.0, values, np.nan)), np.log10(ends)
        part = (values - ends[0]) / (ends[1] - ends[0])
        return np.asarray(self.start + part * (self.end - self.start))

    def ticks(self, most: int) -> list[float]:
        """Return round numbers on the axis."""
        if self.log:
            first, last = math.ceil(math.log10(self.low)), math.floor(math.log10(self.high))
            step = max(1, math.ceil((last - first + 1) / most))
            return [10.0**power for power in range(first, last + 1, step)]
        return round_numbers(self.low, self.high, most)


def round_numbers(low: float, high: float, most: int) -> list[float]:
    """Return up to some multiples of 1, 2 or 5 times a power of ten in a range."""
    raw = (high - low) / max(most, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0, 20.0)
                if (high - low) / (factor * power) <= most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def line_chart(
    curves: Sequence[Curve],
    x_label: str,
    y_label: str,
    size: tuple[float, float] = (540.0, 190.0),
    log: tuple[bool, bool] = (False, False),
    least_span: float = 0.0,
    description: str = '',
) -> str:
    """
    Return a chart of lines.

    Parameters
    ----------
    curves : sequence of Curve
        Drawn in this order.
    x_label, y_label : str
        Quantities with their units.
    size : (float, float)
        Width and height, px.
    log : (bool, bool)
        Whether x and y are logarithmic.
    least_span : float
        The y axis shows at least this much, so that noise at rest does not look like motion.
    description : str
        For readers who cannot see it.

    """
    width, height = size
    top = TOP + (14.0 if any(curve.label for curve in curves) else 0.0)
    x_range = _range([curve.x for curve in curves], log[0], 0.0, 0.0)
    y_range = _range([curve.y for curve in curves], log[1], 0.05, least_span)
    x = Scale(*x_range, LEFT, width - RIGHT, log[0])
    y = Scale(*y_range, height - BOTTOM, top, log[1])
    parts = [*_axes(x, y, x_label, y_label, size), *_legend(curves, width)]
    for curve in curves:
        path = _path(x.place(curve.x), y.place(curve.y))
        if path:
            parts.append(f'<path class="line {curve.kind}" d="{path}"/>')
    return _svg(size, parts, description)


def interval_chart(
    rows: Sequence[tuple[str, float, float, str]], x_label: str, description: str = ''
) -> str:
    """
    Return intervals, a row for each.

    Parameters
    ----------
    rows : sequence of (label, centre, half, text)
        Middle and half length on the axis, infinite or NaN where nothing is known, and what is
        written beside it.
    x_label : str
        What the axis is.
    description : str
        For readers who cannot see it.

    """
    width = 540.0
    right = 20.0 + LETTER * max(len(text) for *_, text in rows)
    known = [(c, h) for _, c, h, _ in rows if math.isfinite(c) and math.isfinite(h)]
    reach = 1.05 * (max((abs(c) + h for c, h in known), default=1.0) or 1.0)
    x, parts = _row_axis([label for label, *_ in rows], (-reach, reach), width - right, x_label)
    for number, (_, centre, half, text) in enumerate(rows):
        at = TOP + ROW * (number + 0.5)
        parts.append(_text(width - right + 8.0, at + 4.0, text, 'start'))
        if (centre, half) in known:
            low, middle, high = x.place(np.array([centre - half, centre, centre + half])).tolist()
            ends = ''.join(f'M{_px(end)} {_px(at - MARK)}V{_px(at + MARK)}' for end in (low, high))
            parts += [f'<path class="interval" d="M{_px(low)} {_px(at)}H{_px(high)}{ends}"/>',
                      f'<circle class="dot" cx="{_px(middle)}" cy="{_px(at)}" r="2.6"/>']
        else:
            parts.append(f'<path class="endless" d="M{_px(x.start)} {_px(at)}H{_px(x.end)}"/>')
    return _svg((width, TOP + ROW * len(rows) + BOTTOM), parts, description)


def strip_chart(
    rows: Sequence[tuple[str, str, Sequence[tuple[float, float]]]],
    span: tuple[float, float],
    x_label: str,
    description: str = '',
) -> str:
    """
    Return spans of time, a row for each list of them.

    Parameters
    ----------
    rows : sequence of (label, kind, spans)
        Class of the colour; start and end of each span.
    span : (float, float)
        Of the axis.
    x_label : str
        What the axis is.
    description : str
        For readers who cannot see it.

    """
    width = 1100.0
    x, parts = _row_axis([label for label, *_ in rows], span, width - RIGHT, x_label, 12)
    for number, (_, kind, spans) in enumerate(rows):
        edges = x.place(np.array(spans, dtype=float).reshape(-1, 2))
        parts += [
            f'<rect class="{kind}" x="{_px(a)}" y="{_px(TOP + ROW * number + 3.0)}" '
            f'width="{_px(max(b - a, 1.0))}" height="{_px(ROW - 6.0)}"/>'
            for a, b in edges.tolist()]
    return _svg((width, TOP + ROW * len(rows) + BOTTOM), parts, description)


def _row_axis(
    labels: Sequence[str], span: tuple[float, float], end: float, x_label: str, most: int = 8
) -> tuple[Scale, list[str]]:
    """Return the axis of a chart with a row for each label, and what is drawn of it."""
    left, bottom = 20.0 + LETTER * max(map(len, labels)), TOP + ROW * len(labels)
    x = Scale(*span, left, end)
    return x, [*_x_ticks(x, TOP, bottom, most), _x_label(x, x_label, bottom + BOTTOM), *(
        _text(left - 8.0, TOP + ROW * (number + 0.5) + 4.0, label, 'end')
        for number, label in enumerate(labels))]


def thinned(x: Array, y: Array) -> list[tuple[float, float]]:
    """
    Return points of a line of pixels: of each column the lowest and the highest, in order.

    NaN in y stays where it interrupts the line, once.
    """
    column = np.floor(np.nan_to_num(x, nan=-1.0)).astype(np.int64)
    missing = ~(np.isfinite(x) & np.isfinite(y))
    change = (np.diff(column) != 0) | (np.diff(missing.astype(np.int8)) != 0)
    starts = np.concatenate([[0], np.flatnonzero(change) + 1, [len(y)]])
    points: list[tuple[float, float]] = []
    for a, b in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if a == b:
            continue
        if missing[a]:
            if points and math.isfinite(points[-1][1]):
                points.append((float('nan'), float('nan')))
            continue
        part = y[a:b]
        for i in sorted({0, int(np.argmin(part)), int(np.argmax(part)), b - a - 1}):
            points.append((float(x[a + i]), float(part[i])))
    return points


def _path(x: Array, y: Array) -> str:
    """Return the path of a line through pixels."""
    pieces, pen = [], 'M'
    for px, py in thinned(x, y):
        if math.isfinite(py):
            pieces.append(f'{pen}{_px(px)} {_px(py)}')
            pen = 'L'
        else:
            pen = 'M'
    return ''.join(pieces)


def _range(
    values: Sequence[Array], log: bool, margin: float, least_span: float
) -> tuple[float, float]:
    """Return the range of an axis that shows all finite values."""
    joined = np.concatenate([np.ravel(part) for part in values] or [np.zeros(0)])
    joined = joined[np.isfinite(joined) & ((joined > 0.0) | (not log))]
    if not len(joined):
        return (0.1, 10.0) if log else (0.0, 1.0)
    low, high = float(joined.min()), float(joined.max())
    if log:
        low = max(low, high * 1e-12)
        return (low, high) if high > 1.5 * low else (low / 2.0, high * 2.0)
    lack = 0.5 * max(0.0, least_span - (high - low))
    low, high = low - lack, high + lack
    if high - low <= 1e-12 * max(abs(low), abs(high), 1e-300):
        pad = 0.5 * max(abs(low), 1e-9)
        low, high = low - pad, high + pad
    extra = margin * (high - low)
    return low - extra, high + extra


def _axes(
    x: Scale, y: Scale, x_label: str, y_label: str, size: tuple[float, float]
) -> list[str]:
    """Return grid, numbers and labels."""
    parts = _x_ticks(x, y.end, y.start)
    for tick in y.ticks(5):
        at = float(y.place(np.array(tick)))
        parts.append(f'<path class="grid" d="M{_px(x.start)} {_px(at)}H{_px(x.end)}"/>')
        parts.append(_text(x.start - 6.0, at + 4.0, tick_text(tick, y.log), 'end'))
    parts.append(_x_label(x, x_label, size[1]))
    middle = 0.5 * (y.start + y.end)
    parts.append(
        f'<text class="label" text-anchor="middle" transform="translate(12 {_px(middle)}) '
        f'rotate(-90)">{escape(y_label)}</text>'
    )
    return parts


def _x_ticks(x: Scale, top: float, bottom: float, most: int = 8) -> list[str]:
    """Return vertical grid lines and their numbers."""
    parts = []
    for tick in x.ticks(most):
        at = float(x.place(np.array(tick)))
        parts.append(f'<path class="grid" d="M{_px(at)} {_px(top)}V{_px(bottom)}"/>')
        parts.append(_text(at, bottom + 14.0, tick_text(tick, x.log), 'middle'))
    return parts


def _x_label(x: Scale, label: str, height: float) -> str:
    """Return the label below a chart."""
    at = 0.5 * (x.start + x.end)
    return (
        f'<text class="label" x="{_px(at)}" y="{_px(height - 5.0)}" '
        f'text-anchor="middle">{escape(label)}</text>'
    )


def _legend(curves: Sequence[Curve], width: float) -> list[str]:
    """Return the legend, from right to left at the top."""
    parts, at = [], width - RIGHT
    for curve in reversed([curve for curve in curves if curve.label]):
        parts.append(_text(at, 12.0, curve.label, 'end'))
        at -= LETTER * len(curve.label) + 8.0
        parts.append(f'<path class="line {curve.kind}" d="M{_px(at - 18.0)} 8H{_px(at)}"/>')
        at -= 34.0
    return parts


def tick_text(value: float, log: bool = False) -> str:
    """Return a number of an axis."""
    if log:
        power = round(math.log10(value))
        return f'{value:g}' if -3 < power < 4 else f'1e{power}'
    return f'{value:.6g}' if abs(value) > 1e-12 else '0'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    """Return a text."""
    return (
        f'<text x="{_px(x)}" y="{_px(y)}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _px(value: float) -> str:
    """Return a coordinate with a tenth of a pixel."""
    text = f'{value:.1f}'.removesuffix('.0')
    return '0' if text == '-0' else text


def _svg(size: tuple[float, float], parts: Sequence[str], description: str) -> str:
    """Return the whole picture."""
    return (
        f'<svg viewBox="0 0 {_px(size[0])} {_px(size[1])}" role="img" '
        f'aria-label="{escape(description)}">{"".join(parts)}</svg>'
    )
