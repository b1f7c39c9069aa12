"""The section on a fit: K and P with their intervals, validity range, and method."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from bellows_ros.core.identification.result import UNITS
from bellows_ros.core.residuals import MILLI_UNITS, Spectrum
from bellows_ros.core.structure import AXES, structure_named
from bellows_ros.plots.fit import excitation_figure, interval_figure, iteration_figure
from bellows_ros.workflows.result_json import NORMAL_95
import numpy as np

from .page import bullets, figure, folded, paragraph, table

NAMES = {'K': ('stiffness', 'Stiffness K'), 'P': ('damping', 'Damping P')}


def cup_content(content: Mapping[str, Any]) -> list[str]:
    """Return table and intervals of K and P of a result."""
    rows = entry_rows(content)
    parts = [
        table(
            ('entry', 'value', 'standard error', '95 % interval', 'unit'),
            [_shown(label, value, error, unit) for label, value, error, _, unit in rows], (0, 4)),
        figure(interval_figure(
            [_interval(label, value, error, scale) for label, value, error, scale, _ in rows],
            'in percent of the entry; off the diagonal in percent of the root of the product of '
            'the two diagonal entries')),
        bullets(_facts(content)),
    ]
    for matrix, (key, title) in NAMES.items():
        unit = ', '.join(UNITS[matrix])
        cells = [[name, *(f'{x:.6g}' for x in row)]
                 for name, row in zip(AXES, content[key], strict=True)]
        parts.append(folded(f'{title} ({unit})', table(['', *AXES], cells)))
    return parts


def entry_rows(content: Mapping[str, Any]) -> list[tuple[str, float, float, float, str]]:
    """Return label, value, standard error (NaN: unknown), scale and unit of each parameter."""
    structure = structure_named(content['structure'])
    rows = []
    for matrix, (key, _) in NAMES.items():
        values = np.array(content[key], dtype=float)
        errors = np.array(
            [[math.nan if x is None else x for x in row] for row in content[f'{key}_std']])
        labels = [label for label in structure.labels if label.startswith(matrix)]
        for label, (i, j) in zip(labels, structure.leads, strict=True):
            scale = math.sqrt(abs(values[i, i] * values[j, j]))
            unit = UNITS[matrix][(i > 2) + (j > 2)]
            rows.append((label, float(values[i, j]), float(errors[i, j]), scale, unit))
    return rows


def _shown(label: str, value: float, error: float, unit: str) -> tuple[str, ...]:
    """Return a row of the table."""
    if not math.isfinite(error):
        return label, '-', 'not identifiable', '', unit
    low, high = value - NORMAL_95 * error, value + NORMAL_95 * error
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0.0 else 6
    numbers = [f'{number:.{digits}f}' for number in (value, error, low, high)]
    return label, numbers[0], numbers[1], f'{numbers[2]} to {numbers[3]}', unit


def _interval(label: str, value: float, error: float, scale: float) -> tuple[str, float, float]:
    """Return label, middle and half length (percent) of the interval of a parameter."""
    half, centre = 100.0 * NORMAL_95 * error, 100.0 * value if '-' in label else 0.0
    return (label, centre / scale, half / scale) if scale else (label, 0.0, math.nan)


def _facts(content: Mapping[str, Any]) -> list[str]:
    """Return samples, condition number and chi squared of a fit."""
    condition = content['condition_number']
    found = [
        f'{content["samples_used"]} samples used, {content["samples_rejected"]} left out.',
        f'Condition number {"not finite" if condition is None else f"{condition:.3g}"}.']
    if content.get('chi2') is not None:
        found.append(f'Chi² per degree of freedom of the fit {content["chi2"]:.4f}.')
    if not content.get('usable', True):
        found.append('K or P is not valid for a cup: the predictor refuses it.')
    return found


def envelope_content(content: Mapping[str, Any]) -> list[str]:
    """Return the validity range of a result."""
    seen = content['envelope']
    rows = []
    for i, name in enumerate(seen['directions']):
        unit, rate = ('mm', 'm/s') if i < 3 else ('mrad', 'rad/s')
        low, high = (1e3 * seen[f'deflection_{end}'][i] for end in ('low', 'high'))
        rows.append((name, f'{low:.3g} to {high:.3g} {unit}', f'{seen["rates"][i]:.3g} {rate}'))
    bands = [f'{low:.3g} to {high:.3g} Hz' for low, high in seen['frequencies']]
    mass = ' to '.join(f'{m:.4g}' for m in sorted(set(seen['mass'])))
    return [
        paragraph(
            'Ranges of the lip in the tool. A prediction outside them is an extrapolation.',
            'quiet'),
        table(('lip in the tool', 'seen', 'fastest'), rows),
        bullets([f'95 % of the power of the shift lies in {bands[0]}, of the rotation in '
                 f'{bands[1]}.', f'Mass: {mass} kg.']),
    ]


def excitation_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the motion of the lip in each axis of the tool."""
    def milli(value: Any, unit: str) -> str:
        return f'{1e3 * value:.3g} {unit}' if _known(value) else '-'

    rows: list[tuple[str, ...]] = [
        ('axis', 'deflection', 'moving', 'noise', 'velocity', 'noise', 'main band')]
    for (name, axis), unit in zip(found['axes'].items(), MILLI_UNITS, strict=True):
        low, high = axis['band_hz']
        rows.append((
            name, *(milli(axis[key], unit) for key in ('strain', 'motion', 'strain_noise')),
            *(milli(axis[key], f'{unit}/s') for key in ('twist', 'twist_noise')),
            f'{low:.1f}-{high:.1f} Hz' if _known(low) else '-'))
    return rows


def _known(value: float | None) -> bool:
    """Return whether a number of a result is known."""
    return value is not None and math.isfinite(value)


def excitation_content(
    found: Mapping[str, Any], spectra: Mapping[str, Spectrum]
) -> list[str]:
    """Return what is identifiable from the recordings."""
    head, *rows = excitation_rows(found)
    parameters = [
        (label, f'{100.0 * p["noise_share"]:.2g} %' if _known(p['noise_share']) else '-',
         'not identifiable' if not p['identifiable'] else 'weakly' if p['weak'] else 'well')
        for label, p in found['parameters'].items()
    ]
    condition = found['condition_number']
    return [
        paragraph(f'{found["rank"]} of {found["size"]} combinations of parameters are '
                  'identifiable; scaled condition number '
                  f'{f"{condition:.3g}" if _known(condition) else "not finite"}.'),
        bullets(found['warnings'], 'warning'),
        table(head, rows),
        folded(
            'Each parameter', table(('parameter', 'noise', 'identifiable'), parameters, (0, 2))),
        *(figure(excitation_figure(own, name)) for name, own in spectra.items()),
    ]


def iteration_content(iterations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return how the minimum was found."""
    stages = {int(step.get('stage', 0)) for step in iterations}
    return [figure(iteration_figure(
        iterations, f'{len(iterations)} steps in {len(stages)} stages'))]
