"""Measured figures as tables in Markdown."""

from collections.abc import Callable, Mapping
from typing import Any

from .live import RAW, WITHOUT_TWISTS

Table = list[tuple[str, ...]]
"""Rows of cells; the first is the head."""

Make = Callable[[Mapping[str, Any]], Table]

MEBI = 2**20


def tables(results: Mapping[str, Any]) -> dict[str, Table]:
    """Return the tables of the figures, by name."""
    return {name: make(results[name]) for name, make in _TABLES.items() if name in results}


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    head, *rows = table
    head_line, *lines = ('| ' + ' | '.join(cells) + ' |' for cells in (head, *rows))
    return '\n'.join((head_line, '|---' * len(head) + '|', *lines))


def _times(subject: str, statistic: str = 'median') -> Make:
    """Return a function that makes a table of medians by name."""
    return lambda section: [(subject, statistic), *(
        (name, _time(figures['median'])) for name, figures in section['seconds'].items())]


def _node(section: Mapping[str, Any]) -> Table:
    """Return latencies of bare node and predictor by rate; the JSON file has the other nodes."""
    rows: Table = [('node', 'p50', 'p99', 'p99.9', 'CPU per pose', 'memory', 'lost')]
    for run in section['runs']:
        if run['node'] in (RAW, WITHOUT_TWISTS):
            continue
        rows.append((
            f'{run["node"]}, {run["rate_hz"]} Hz',
            *(_time(run[name]) for name in ('p50', 'p99', 'p99.9', 'processor_per_pose')),
            _memory(run['memory']), f'{run["lost"]} of {run["sent"]}'))
    return rows


def _offline(section: Mapping[str, Any]) -> Table:
    """Return identification and replay of a long recording."""
    plain, fit = section['plain_loop']['median'], section['least_squares']['median']
    recording, replay = section['recording'], section['replay']['median']
    error = section['output_error']['median'] / section['output_error_recorded']
    about = f'{recording["seconds"]:g} s, {recording["messages"]} messages'
    return [
        ('offline', about, ''),
        ('rosbags, read and decode', _time(plain), _memory(section['peak_plain_loop'])),
        ('least squares, end to end', f'{_time(fit)}, {fit / plain:.2f} times that',
         _memory(section['peak_least_squares'])),
        ('bellows replay, the whole command',
         f'{_time(replay)}, {recording["seconds"] / replay:.0f} times real time',
         _memory(section['peak_replay'])),
        ('predicting alone, of that',
         f'{section["replay_factor"]["median"]:.0f} times real time', ''),
        ('output-error fit', f'{_time(error)} per recorded second', '')]


_TABLES: Mapping[str, Make] = {
    'step': _times('one step'), 'node': _node, 'offline': _offline, 'startup': _times('start'),
    'plans': _times('a plan of 1 s at 1 kHz', 'processor time, median'),
    'camera': _times('500 Hz, a camera of 30 Hz')}


def _time(seconds: float) -> str:
    """Return a time in a unit that fits."""
    for unit, size in (('s', 1.0), ('ms', 1e-3), ('us', 1e-6)):
        if seconds >= size:
            return f'{seconds / size:.3g} {unit}'
    return f'{seconds / 1e-9:.3g} ns'


def _memory(size: float) -> str:
    """Return a size of memory."""
    return f'{size / MEBI:.0f} MiB'
