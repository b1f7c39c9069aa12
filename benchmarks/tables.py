"""Measurements as tables in Markdown."""

from collections.abc import Callable, Mapping
from typing import Any

from .live import BARE, EVENTS, LONG
from .step import OURS

Table = list[tuple[str, ...]]
"""Rows of cells; the first is the head."""

MEBI = 2**20
FLOORS = BARE, EVENTS


def tables(found: Mapping[str, Any]) -> dict[str, Table]:
    """Return the tables of what was measured, by name."""
    return {
        name: make(found[name.partition('.')[0]])
        for name, make in _TABLES.items() if name.partition('.')[0] in found
    }


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    head, *rows = table
    lines = [head, ('---',) * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(cells) + ' |' for cells in lines)


def _step(section: Mapping[str, Any]) -> Table:
    """Return the time of a step, and how many times ours it is."""
    steps = section['seconds_per_step']
    ours = steps.get('bellows_ros, compiled') or steps[OURS]
    rows: Table = [('one step', 'median', 'lowest to highest', 'this package takes')]
    for name, figures in steps.items():
        rows.append((
            name, _time(figures['median']),
            f'{_time(figures["lowest"])} to {_time(figures["highest"])}',
            f'{ours["median"] / figures["median"]:.3g} of it',
        ))
    rows += [(name, f'missing: {why}', '', '') for name, why in section['missing'].items()]
    return rows


def _accuracy(section: Mapping[str, Any]) -> Table:
    """Return error against cost."""
    rows: Table = [
        ('method', 'rate or tolerance', 'per simulated second', 'position error', 'rotation error')
    ]
    for row in section['accuracy']:
        setting = row['setting']
        rows.append((
            row['method'], f'{setting:g} Hz' if setting > 1 else f'rtol {setting:g}',
            _time(row['seconds_per_simulated_second']),
            f'{row["position_error"]:.1e} m', f'{row["rotation_error"]:.1e} rad',
        ))
    return rows


def _node(section: Mapping[str, Any]) -> Table:
    """Return latencies by rate, and against those of the bare nodes."""
    rows: Table = [(
        'node', 'rate', 'twists', 'p50', 'p99', 'p99.9', 'CPU per pose', 'memory', 'lost',
        *(f'{what} {floor}' for floor in FLOORS for what in ('p50, p99 to', 'CPU above')),
    )]
    measured = {(run['node'], *_case(run)): run for run in section['runs']}
    for run in section['runs']:
        floors = [measured.get((floor, *_case(run))) for floor in FLOORS]
        rows.append((
            _name_of(run), f'{run["rate_hz"]} Hz', 'yes' if run['twists'] else 'no',
            *(_time(run[name]) for name in ('p50', 'p99', 'p99.9', 'processor_per_pose')),
            _memory(run['memory']), f'{run["lost"]} of {run["sent"]}',
            *(cell for floor in floors for cell in _against(run, floor)),
        ))
    return rows


def _case(run: Mapping[str, Any]) -> tuple[float, bool, float]:
    """Return what runs that can be compared have in common."""
    return run['rate_hz'], run['twists'], run['seconds']


def _name_of(run: Mapping[str, Any]) -> str:
    """Return the name of a node, and how long it ran where that is long."""
    return f'{run["node"]}, for {run["seconds"]:g} s' if run['seconds'] >= LONG else run['node']


def _against(run: Mapping[str, Any], bare: Mapping[str, Any] | None) -> tuple[str, str]:
    """Return the ratios of latencies, and what a pose takes more of the processor, to a floor."""
    if bare is None or run['node'] in FLOORS:
        return '', ''
    more = run['processor_per_pose'] - bare['processor_per_pose']
    ratios = ', '.join(f'{run[name] / bare[name]:.2f}' for name in ('p50', 'p99'))
    return ratios, f'{more * 1e6:+.0f} us'


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
        *(
            (f'least squares, {part["seconds"]:g} s of it', '', _memory(part['peak']))
            for part in section.get('peaks', [])[:-1]
        ),
        ('bellows replay, the whole command',
         f'{_time(replay)}, {recording["seconds"] / replay:.0f} times real time',
         _memory(section['peak_replay'])),
        ('predicting alone, of that',
         f'{section["replay_factor"]["median"]:.0f} times real time', ''),
        ('output-error fit', f'{_time(error)} per recorded second', ''),
    ]


def _filter(section: Mapping[str, Any]) -> Table:
    """Return the time of the filter per sample."""
    rows: Table = [('filter, 61 samples, order 6', 'per sample')]
    rows += [(name, _time(figures['median'])) for name, figures in section['filter'].items()]
    return rows


def _startup(section: Mapping[str, Any]) -> Table:
    """Return times to start."""
    return [
        ('start', 'median'),
        ('bellows --help', _time(section['help']['median'])),
        ('numba, numpy and rclpy imported', _time(section['imports']['median'])),
        ('predictor ready with ROS, compiled before', _time(section['predictor_warm']['median'])),
        ('predictor ready with ROS, nothing compiled', _time(section['predictor_cold']['median'])),
    ]


def _plans(section: Mapping[str, Any]) -> Table:
    """Return what a second of plan costs."""
    rows: Table = [('a plan of 1 s at 1 kHz', 'processor time, median')]
    return rows + [(name, _time(figures['median']))
                   for name, figures in section['seconds'].items()]


def _motions(section: Mapping[str, Any]) -> Table:
    """Return what steered motions do to the package."""
    rows: Table = [('motion of the tool', 'takes', 'largest tilt', 'swing left')]
    return rows + [
        (name, f'{row["duration"]:.3f} s', f'{row["tilt"]:.3g} degrees',
         f'{row["swing_left"]:.2g} degrees') for name, row in section['motions'].items()]


def _camera(section: Mapping[str, Any]) -> Table:
    """Return the errors of all ways to know where the package is, and below the camera's noise."""
    noise = section['noise']
    rows: Table = [('', 'position', 'rotation', 'below the noise')]
    return rows + [
        (name, f'{1e3 * row["position"]:.3g} mm', f'{1e3 * row["rotation"]:.3g} mrad',
         ', '.join(f'{noise[what] / row[what]:.2g} times' for what in noise))
        for name, row in section['errors'].items()]


def _corrected(section: Mapping[str, Any]) -> Table:
    """Return what corrections cost, in the predictor and in the node."""
    rows: Table = [('500 Hz, a camera of 30 Hz', 'median')]
    rows += [(name, _time(times['median'])) for name, times in section['seconds'].items()]
    rows += [(f'{run["node"]}: p50, p99', f'{_time(run["p50"])}, {_time(run["p99"])}')
             for run in section['node']['runs']]
    return [
        *rows,
        ('p50 of the second to the first', f'{section["node"]["to_without"]:.2f}'),
        ('p50, p99 while corrected to while not', ', '.join(
            f'{section["node"][name]:.2f}' for name in ('p50', 'p99')))]


_TABLES: Mapping[str, Callable[[Mapping[str, Any]], Table]] = {
    'step': _step,
    'step.accuracy': _accuracy,
    'node': _node,
    'offline': _offline,
    'offline.filter': _filter,
    'startup': _startup,
    'plans': _plans,
    'plans.motions': _motions,
    'camera': _camera,
    'camera.cost': _corrected,
}


def _time(seconds: float) -> str:
    """Return a time in a unit that fits."""
    for unit, size in (('s', 1.0), ('ms', 1e-3), ('us', 1e-6)):
        if seconds >= size:
            return f'{seconds / size:.3g} {unit}'
    return f'{seconds / 1e-9:.3g} ns'


def _memory(size: float) -> str:
    """Return a size of memory."""
    return f'{size / MEBI:.0f} MiB'
