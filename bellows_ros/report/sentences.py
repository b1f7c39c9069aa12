"""
Sentences of findings, warnings and verdicts, from codes and numbers in SI units.

`texts/ROOM.toml` has the sentences of a room by code. A sentence is a format string; a format may
end with a unit of `SENTENCE_UNITS`, which is printed after the number, or with `# noun` for a
count:

    shift = "Topic '{topic}' jumps by {shift:.1f mm} and {rotation:.2g deg}, {count:# time}."

with shift in m and rotation in rad. Texts among the values are escaped by `errors.shown`; lists
become 'a, b and c'; None and numbers that are not finite become '-'.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import permutations
import json
import math
from pathlib import Path
from string import Formatter
import tomllib
from typing import Any

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Finding
from bellows_ros.core.recording import alignment
from bellows_ros.errors import shown
import numpy as np

TEXTS = Path(__file__).with_name('texts')

SENTENCE_UNITS: Mapping[str, tuple[float, str]] = {
    'mm': (1e3, 'mm'), 'um': (1e6, 'um'), 'mm/s': (1e3, 'mm/s'), 'ms': (1e3, 'ms'),
    'us': (1e6, 'us'), 'g': (1e3, 'g'), '%': (1e2, '%'), 'ppm': (1e6, 'ppm'),
    'mrad': (1e3, 'mrad'),
    'deg': (math.degrees(1.0), 'degrees'), 'deg/s': (math.degrees(1.0), 'degrees/s')}
"""Units in sentences: their number in one SI unit, and their printed name."""

MAX_LISTED = 5
"""Largest number of list items named in a sentence."""

MAX_TEXT = 200
"""Longest text within a sentence, characters."""


def sentence(room: str, code: str, **numbers: Any) -> str:
    """
    Return the sentence of a code.

    Parameters
    ----------
    room : str
        Name of a file in `texts/`.
    code : str
        Key in the file, or `table.key` for a table in it.
    **numbers : float, str, sequence or None
        Values of the sentence's fields, in SI units.

    Raises
    ------
    KeyError
        If the code or a field is unknown.

    """
    return formatted(texts(room)[code], **numbers)


def formatted(text: str, **numbers: Any) -> str:
    """Return a text with its fields, values in SI units, filled in."""
    return _Sentence().vformat(text, (), numbers)


def listed(items: Sequence[str]) -> str:
    """Return a list in words: of a long list the first items, and the number of further items."""
    if len(items) > MAX_LISTED:
        return f'{", ".join(items[:MAX_LISTED])} and {len(items) - MAX_LISTED} more'
    return ' and '.join(filter(None, [', '.join(items[:-1]), items[-1]]))


def many(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f'{count} {noun}{"" if count == 1 else "s"}'


@cache
def texts(room: str) -> Mapping[str, str]:
    """Return the sentences of a room by code."""
    return dict(_flat('', tomllib.loads((TEXTS / f'{room}.toml').read_text(encoding='utf-8'))))


def _flat(inside: str, table: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [entry for key, value in table.items() for entry in (
        _flat(f'{inside}{key}.', value) if isinstance(value, dict)
        else [(f'{inside}{key}', value)])]


class _Sentence(Formatter):
    """Formatter of numbers with units, counts with nouns, lists, and foreign text."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return a number with its unit, a count with its noun, or a list, as the format asks."""
        if format_spec.startswith('# '):
            return many(value, format_spec[2:])
        form, _, unit = format_spec.rpartition(' ')
        if format_spec in SENTENCE_UNITS:
            form, unit = '.3g', format_spec
        elif unit not in SENTENCE_UNITS:
            form, unit = format_spec, ''
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return '-'
        if isinstance(value, str):
            return f'{shown(value, MAX_TEXT):{form}}'
        if isinstance(value, list | tuple):
            return listed([self.format_field(item, format_spec) for item in value])
        factor, name = SENTENCE_UNITS.get(unit, (1, ''))
        return f'{factor * value:{form}} {name}'.rstrip()


def finding_sentence(finding: Finding, given: Mapping[str, Any]) -> str:
    """Return a sentence with cause and size of a finding, the corrected misfit, and a remedy."""
    name, theta, std = _cause_of(finding), finding.theta.tolist(), finding.std.tolist()
    numbers: dict[str, Any] = {'value': finding.value, 'theta': theta, 'std': std}
    if theta:
        sides = texts('causes').get(f'{name}.sides', ('', ''))
        numbers |= {
            'size': _thousandths(theta[0], std[0]), 'magnitude': abs(theta[0]),
            'last': abs(theta[-1]), 'pair': math.hypot(*theta[:2]), 'side': sides[theta[0] > 0.0]}
    if name in FINDING_FIELDS:
        numbers |= FINDING_FIELDS[name](finding, given)
    what, *more = (sentence('causes', f'{name}.{part}', **numbers) for part in ('what', 'remedy')
                   if f'{name}.{part}' in texts('causes'))
    if finding.name != 'unknown' and finding.share > 0.0:
        more.insert(0, f'It explains {100.0 * finding.share:.2g} % of the misfit.')
    return ' '.join([f'{what}.', *more])


def setting_of(finding: Finding) -> str:
    """Return the parameter to change, both if undecided, '' for a cause in the cup."""
    if finding.name == 'yaw':
        bodies = [text.split()[0] for text in (finding.value, finding.instead) if text]
        return ' or '.join(dict.fromkeys(f'the axes of topics.{body}_pose' for body in bodies))
    names = [_cause_of(finding)] if finding.instead in ('', 'force') else [
        finding.name, finding.instead]
    return ' or '.join(texts('causes').get(f'{name}.setting', '') for name in names)


def _cause_of(finding: Finding) -> str:
    """Return the name of a cause in the texts, as some causes have two forms."""
    if finding.name in ('com', 'length') and finding.instead:
        return 'length or com'
    if finding.instead == 'force':
        return 'gravity or force'
    if finding.name == 'inertia':
        is_factor = np.ptp(finding.theta) < 3.0 * np.max(finding.std)
        return f'{"factor" if is_factor else "moments"} of inertia'
    return 'axis of gravity' if finding.value.startswith('gravity') else finding.name


def order_of(given: Array, moments: Array) -> str:
    """Return the axes of which the given moments of inertia (3,) seem to be, '' if as given."""
    off = {order: float(np.max(np.abs(np.log(moments / given[list(order)]))))
           for order in permutations(range(3))}
    best = min(off, key=lambda order: off[order])
    if best == (0, 1, 2) or 2.0 * off[best] > off[(0, 1, 2)]:
        return ''
    axes = ', '.join('xyz'[best.index(axis)] for axis in range(3))
    return f'those of x, y and z seem to be given as those of {axes}'


def _moments_fields(finding: Finding, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return moments of inertia, and their order."""
    moments = np.array(given['package.inertia'][:3])
    order = order_of(moments, moments * np.exp(finding.theta))
    return {'moments': ', '.join(f'{x:.3g}' for x in moments * np.exp(finding.theta)),
            'order': order and f': {order}'}


def _com_fields(finding: Finding, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the significant shift of a centre of mass, and its position."""
    moved = np.where(np.abs(finding.theta) > 3.0 * finding.std, finding.theta, 0.0)
    return {'com': _numbers(np.add(given['package.com'], moved)), 'shifts': ', '.join(
        f'{axis} {1e3 * x:+.2f} ± {1e3 * s:.2g} mm'
        for axis, x, s in zip('xyz', moved, finding.std, strict=True) if x)}


def _marker_fields(finding: Finding, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the shift and rotation of a marker frame, and the settings that correct it."""
    shift, angle = map(np.linalg.norm, np.split(finding.theta, [len(finding.theta) - 3]))
    by_rest = '' if given.get('recording.align_at_rest') else (
        ", or recording.align_at_rest: true if it is the tool's and the recording begins at rest")
    return {'shift': float(shift), 'degrees': float(angle),
            'setting': f'fit.free: [package_marker]{by_rest}'}


def _yaw_fields(finding: Finding, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the frames of which one is rotated about z."""
    words = ', or '.join(
        f"the {body}'s frame is turned by {degrees} degrees about z"
        for body, degrees in map(str.split, filter(None, (finding.value, finding.instead))))
    return {'turns': words[0].upper() + words[1:], 'doubt': (
        ': these recordings cannot tell which' if finding.instead else '')}


def _down(given: Mapping[str, Any], down: Array) -> str:
    """Return gravity.direction of a direction in the levelled world."""
    return _numbers(
        alignment.levelling(given.get('gravity.direction', alignment.DOWN)).T @ down)


def _numbers(values: Array) -> str:
    """Return a list with four decimals."""
    return f'[{", ".join(f"{x:.4f}" for x in np.round(values, 4) + 0.0)}]'


def _thousandths(value: float, std: float) -> str:
    """Return a size with its standard error."""
    return f'{1e3 * abs(value):.3f} ± {1e3 * std:.2g}'


FINDING_FIELDS: Mapping[str, Callable[[Finding, Mapping[str, Any]], dict[str, Any]]] = {
    'package_world': lambda finding, given: {
        'motion': alignment.motion_sentence(finding.theta, finding.std)},
    'factor of inertia': lambda finding, given: {
        'factor': np.exp(-finding.theta[0]), 'std': np.exp(-finding.theta[0]) * finding.std[0]},
    'moments of inertia': _moments_fields,
    'time_offset': lambda finding, given: {
        'offset': f'{_thousandths(finding.theta[0], finding.std[0])} ms'},
    'com': _com_fields,
    'length': lambda finding, given: {'length': given['cup.length'] + finding.theta[0]},
    'package_marker': _marker_fields,
    **dict.fromkeys(('gravity.direction', 'gravity or force'), lambda finding, given: {
        'down': _down(given, lie.exp_so3(np.append(-finding.theta, 0.0)) @ alignment.DOWN)}),
    'axis of gravity': lambda finding, given: {
        'down': _down(given, np.array(json.loads(finding.value.removeprefix('gravity '))))},
    'unknown': lambda finding, given: {
        'band': ', at {:.1f} to {:.1f} Hz'.format(*finding.theta[2:4])
        if np.all(np.isfinite(finding.theta[2:4])) else ''},
    'yaw': _yaw_fields}
"""Further fields of the texts of causes."""
