"""Findings on the causes of a misfit, by the numbers of their estimates."""

from collections.abc import Callable, Mapping
from itertools import permutations
import json
import math
from typing import Any

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.result import Cause
from bellows_ros.core.recording import alignment
import numpy as np

SIDES = {'time_offset': ('ahead of', 'behind'), 'scale': ('large', 'small'),
         'length_drift': ('shortens', 'lengthens')}
"""Words for a number that is not positive, and for a positive one, by cause."""

Given = Mapping[str, Any]
Differing = tuple[str, str, str]
"""Name of a parameter, by how much its given value is wrong, and the value by the recordings."""


def cause_finding(cause: Cause, given: Given) -> Finding:
    """Return a cause with its size, its share of the misfit, and given values corrected by it."""
    share = f' It explains {100.0 * cause.share:.2g} % of the misfit.' * (
        cause.name != 'unknown' and cause.share > 0.0)
    if cause.name in ('com', 'length') and cause.instead:
        return Finding('length', Level.WARN, {'offset': abs(float(cause.theta[-1]))})
    if cause.name in DIFFERING:
        topic, off, value = DIFFERING[cause.name](cause, given)
        return Finding('differs', Level.WARN, {'off': off, 'found': value, 'share': share}, topic)
    theta, std = cause.theta.tolist(), cause.std.tolist()
    numbers: dict[str, Any] = {'share': share}
    if theta:
        numbers |= {'first': theta[0], 'last': theta[-1], 'magnitude': abs(theta[0]),
                    'size': f'{1e3 * abs(theta[0]):.3f} ± {1e3 * std[0]:.2g} mm',
                    'side': SIDES.get(cause.name, ('', ''))[theta[0] > 0.0]}
    if cause.name in MORE:
        numbers |= MORE[cause.name](cause, given)
    code = cause.name if cause.name != 'unknown' else 'unknown_cause'
    return Finding(code, Level.WARN, numbers)


def order_of(given: Array, moments: Array) -> str:
    """Return the axes of which the given moments of inertia (3,) seem to be, '' if as given."""
    off = {order: float(np.max(np.abs(np.log(moments / given[list(order)]))))
           for order in permutations(range(3))}
    best = min(off, key=lambda order: off[order])
    if best == (0, 1, 2) or 2.0 * off[best] > off[(0, 1, 2)]:
        return ''
    axes = ', '.join('xyz'[best.index(axis)] for axis in range(3))
    return f'those of x, y and z seem to be given as those of {axes}'


def _inertia(cause: Cause, given: Given) -> Differing:
    """Return moments of inertia, and their order or their ratio to the mass."""
    before = np.array(given['package.inertia'][:3])
    moments = before * np.exp(cause.theta)
    factor, order = float(np.exp(-cause.theta[0])), order_of(before, moments)
    off = f'{factor:.3g} ± {factor * cause.std[0]:.2g} times the value that fits package.mass' if (
        np.ptp(cause.theta) < 3.0 * np.max(cause.std)) else 'wrong'
    found = f'{", ".join(f"{x:.3g}" for x in moments)} kg m^2 (ixx, iyy, izz)'
    return 'package.inertia', off, found + (order and f'; {order}')


def _com(cause: Cause, given: Given) -> Differing:
    """Return the significant shift of a centre of mass, and its position."""
    moved = np.where(np.abs(cause.theta) > 3.0 * cause.std, cause.theta, 0.0)
    off = ', '.join(f'{axis} {1e3 * x:+.2f} ± {1e3 * s:.2g} mm'
                    for axis, x, s in zip('xyz', moved, cause.std, strict=True) if x)
    return 'package.com', f'off by {off}', _listed(np.add(given['package.com'], moved))


def _length(cause: Cause, given: Given) -> Differing:
    """Return a length of the cup."""
    size, std = float(cause.theta[0]), float(cause.std[0])
    side = 'short' if size > 0.0 else 'long'
    return ('cup.length', f'{1e3 * abs(size):.3f} ± {1e3 * std:.2g} mm too {side}',
            f'{given["cup.length"] + size:.5f}')


def _gravity(cause: Cause, given: Given) -> Differing:
    """Return gravity.direction after a rotation about x and y."""
    angle = math.degrees(math.hypot(*cause.theta[:2].tolist()))
    doubt = ', or a hose or cable pulls at the package: these recordings cannot tell which' * (
        cause.instead == 'force')
    return 'gravity.direction', f'{angle:.1f} degrees off{doubt}', _down(
        given, lie.exp_so3(np.append(-cause.theta, 0.0)) @ alignment.DOWN)


def _world(cause: Cause, given: Given) -> Differing:
    """Return another vertical axis of the recording."""
    if cause.value.startswith('gravity'):
        return 'gravity.direction', 'wrong', _down(
            given, np.array(json.loads(cause.value.removeprefix('gravity '))))
    return 'recording.world', 'wrong', cause.value


def _marker(cause: Cause, given: Given) -> dict[str, Any]:
    """Return the shift and rotation of a marker frame, and the settings that correct it."""
    shift, angle = map(np.linalg.norm, np.split(cause.theta, [len(cause.theta) - 3]))
    by_rest = '' if given.get('recording.align_at_rest') else (
        ", or recording.align_at_rest: true if it is the tool's and the recording begins at rest")
    return {'shift': float(shift), 'angle': float(angle),
            'setting': f'fit.free: [package_marker]{by_rest}'}


def _yaw(cause: Cause, given: Given) -> dict[str, Any]:
    """Return the frames of which one is rotated about z."""
    words = ', or '.join(
        f"the {body}'s frame is turned by {degrees} degrees about z"
        for body, degrees in map(str.split, filter(None, (cause.value, cause.instead))))
    doubt = ': these recordings cannot tell which' * bool(cause.instead)
    return {'turns': f'{words[0].upper()}{words[1:]}{doubt}'}


def _down(given: Given, down: Array) -> str:
    """Return gravity.direction of a direction in the levelled world."""
    return _listed(
        alignment.levelling(given.get('gravity.direction', alignment.DOWN)).T @ down)


def _listed(values: Array) -> str:
    """Return a list with four decimals."""
    return f'[{", ".join(f"{x:.4f}" for x in np.round(values, 4) + 0.0)}]'


DIFFERING: Mapping[str, Callable[[Cause, Given], Differing]] = {
    'inertia': _inertia, 'com': _com, 'length': _length, 'gravity': _gravity,
    'gravity.direction': _gravity, 'recording.world': _world,
    'recording.package_frame': lambda cause, given: (cause.name, 'wrong', cause.value),
    'package.files': lambda cause, given: (cause.name, cause.value, 'the other order')}
"""Causes that are wrong parameters."""

MORE: Mapping[str, Callable[[Cause, Given], dict[str, Any]]] = {
    'time_offset': lambda cause, given: {
        'size': f'{1e3 * abs(cause.theta[0]):.3f} ± {1e3 * cause.std[0]:.2g} ms'},
    'package_world': lambda cause, given: {
        'motion': alignment.motion_sentence(cause.theta, cause.std)},
    'slip': lambda cause, given: {
        'size': math.hypot(*cause.theta[:2]), 'at': float(cause.theta[-1])},
    'package_marker': _marker, 'yaw': _yaw,
    'unknown': lambda cause, given: {
        'axis': cause.value, 'second': float(cause.theta[min(1, len(cause.theta) - 1)]),
        'band': ', at {:.1f} to {:.1f} Hz'.format(*cause.theta[2:4])
        if np.all(np.isfinite(cause.theta[2:4])) else ''}}
"""Numbers of other causes."""
