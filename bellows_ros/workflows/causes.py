"""Findings on the causes of a misfit, by the numbers of their estimates."""

from collections.abc import Callable, Mapping
from itertools import permutations
import json
import math
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Finding as Cause
from bellows_ros.core.recording import alignment
import numpy as np

SIDES = {'time_offset': ('ahead of', 'behind'), 'length': ('long', 'short'),
         'scale': ('large', 'small'), 'length_drift': ('shortens', 'lengthens')}
"""Words for a number that is not positive, and for a positive one, by cause."""

CODES = {'recording.package_frame': 'package_frame', 'gravity.direction': 'gravity',
         'recording.world': 'world', 'package.files': 'package_files'}
"""Codes of causes with the names of parameters."""

Numbers = dict[str, Any]


def cause_finding(cause: Cause, given: Mapping[str, Any]) -> Finding:
    """Return a cause with its size, its share of the misfit, and given values corrected by it."""
    theta, std = cause.theta.tolist(), cause.std.tolist()
    share = f' It explains {100.0 * cause.share:.2g} % of the misfit.' * (
        cause.name != 'unknown' and cause.share > 0.0)
    numbers: Numbers = {'value': cause.value, 'share': share}
    if theta:
        numbers |= {
            'size': f'{1e3 * abs(theta[0]):.3f} ± {1e3 * std[0]:.2g}', 'magnitude': abs(theta[0]),
            'first': theta[0], 'second': theta[min(1, len(theta) - 1)], 'last': theta[-1],
            'offset': abs(theta[-1]), 'pair': math.hypot(*theta[:2]),
            'side': SIDES.get(cause.name, ('', ''))[theta[0] > 0.0]}
    code = _code_of(cause)
    if code in MORE:
        numbers |= MORE[code](cause, given)
    return Finding('length' if code == 'length_or_com' else f'cause_{code}', Level.WARN, numbers)


def _code_of(cause: Cause) -> str:
    """Return the code of a cause, as some causes have two forms."""
    if cause.name in ('com', 'length') and cause.instead:
        return 'length_or_com'
    if cause.instead == 'force':
        return 'force'
    if cause.name == 'inertia':
        return 'inertia' if np.ptp(cause.theta) < 3.0 * np.max(cause.std) else 'moments'
    return 'axis' if cause.value.startswith('gravity') else CODES.get(cause.name, cause.name)


def order_of(given: Array, moments: Array) -> str:
    """Return the axes of which the given moments of inertia (3,) seem to be, '' if as given."""
    off = {order: float(np.max(np.abs(np.log(moments / given[list(order)]))))
           for order in permutations(range(3))}
    best = min(off, key=lambda order: off[order])
    if best == (0, 1, 2) or 2.0 * off[best] > off[(0, 1, 2)]:
        return ''
    axes = ', '.join('xyz'[best.index(axis)] for axis in range(3))
    return f'those of x, y and z seem to be given as those of {axes}'


def _moments(cause: Cause, given: Mapping[str, Any]) -> Numbers:
    """Return moments of inertia, and their order."""
    before = np.array(given['package.inertia'][:3])
    moments = before * np.exp(cause.theta)
    order = order_of(before, moments)
    return {'moments': ', '.join(f'{x:.3g}' for x in moments), 'order': order and f': {order}'}


def _com(cause: Cause, given: Mapping[str, Any]) -> Numbers:
    """Return the significant shift of a centre of mass, and its position."""
    moved = np.where(np.abs(cause.theta) > 3.0 * cause.std, cause.theta, 0.0)
    return {'com': _listed(np.add(given['package.com'], moved)), 'shifts': ', '.join(
        f'{axis} {1e3 * x:+.2f} ± {1e3 * s:.2g} mm'
        for axis, x, s in zip('xyz', moved, cause.std, strict=True) if x)}


def _marker(cause: Cause, given: Mapping[str, Any]) -> Numbers:
    """Return the shift and rotation of a marker frame, and the settings that correct it."""
    shift, angle = map(np.linalg.norm, np.split(cause.theta, [len(cause.theta) - 3]))
    by_rest = '' if given.get('recording.align_at_rest') else (
        ", or recording.align_at_rest: true if it is the tool's and the recording begins at rest")
    return {'shift': float(shift), 'angle': float(angle),
            'setting': f'fit.free: [package_marker]{by_rest}'}


def _yaw(cause: Cause, given: Mapping[str, Any]) -> Numbers:
    """Return the frames of which one is rotated about z."""
    words = ', or '.join(
        f"the {body}'s frame is turned by {degrees} degrees about z"
        for body, degrees in map(str.split, filter(None, (cause.value, cause.instead))))
    doubt = ': these recordings cannot tell which' * bool(cause.instead)
    return {'turns': f'{words[0].upper()}{words[1:]}{doubt}'}


def _down(given: Mapping[str, Any], down: Array) -> Numbers:
    """Return gravity.direction of a direction in the levelled world."""
    return {'down': _listed(
        alignment.levelling(given.get('gravity.direction', alignment.DOWN)).T @ down)}


def _tilted(cause: Cause, given: Mapping[str, Any]) -> Numbers:
    """Return gravity.direction after a rotation about x and y."""
    return _down(given, lie.exp_so3(np.append(-cause.theta, 0.0)) @ alignment.DOWN)


def _listed(values: Array) -> str:
    """Return a list with four decimals."""
    return f'[{", ".join(f"{x:.4f}" for x in np.round(values, 4) + 0.0)}]'


MORE: Mapping[str, Callable[[Cause, Mapping[str, Any]], Numbers]] = {
    'package_world': lambda cause, given: {
        'motion': alignment.motion_sentence(cause.theta, cause.std)},
    'inertia': lambda cause, given: {
        'factor': np.exp(-cause.theta[0]), 'factor_std': np.exp(-cause.theta[0]) * cause.std[0]},
    'moments': _moments, 'com': _com, 'package_marker': _marker, 'yaw': _yaw,
    'length': lambda cause, given: {'length': given['cup.length'] + cause.theta[0]},
    'gravity': _tilted, 'force': _tilted,
    'axis': lambda cause, given: _down(
        given, np.array(json.loads(cause.value.removeprefix('gravity ')))),
    'unknown': lambda cause, given: {
        'band': ', at {:.1f} to {:.1f} Hz'.format(*cause.theta[2:4])
        if np.all(np.isfinite(cause.theta[2:4])) else ''}}
"""Further numbers of causes."""
