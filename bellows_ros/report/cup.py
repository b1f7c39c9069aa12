"""The section on a fit: K and P with their intervals, validity range, and method."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from bellows_ros.core.identification.identifiability import Excitation
from bellows_ros.core.identification.result import UNITS
from bellows_ros.core.identification.samples import Spectra
from bellows_ros.core.residuals import MILLI_UNITS, Spectrum
from bellows_ros.core.structure import AXES, structure_named
from bellows_ros.workflows.result_json import NORMAL_95
import numpy as np

from .page import bullets, figures, folded, heading, paragraph, table
from .svg import Curve, interval_chart, line_chart

LOWEST_HZ = 0.2
"""Lower end of spectra on a logarithmic axis."""

WIDE = 3.0
"""Ratio of values from which an axis is logarithmic."""

NAMES = {'K': ('stiffness', 'Stiffness K'), 'P': ('damping', 'Damping P')}


def cup_content(content: Mapping[str, Any]) -> list[str]:
    """Return table and intervals of K and P of a result."""
    rows = entry_rows(content)
    parts = [
        table(
            ('entry', 'value', 'standard error', '95 % interval', 'unit'),
            [_shown(label, value, error, unit) for label, value, error, _, unit in rows], (0, 4)),
        figures([(NAMES[m][1], _intervals(m, rows)) for m in 'KP']),
        paragraph(
            '95 % intervals, in percent of the entry; off the diagonal in percent of the root '
            'of the product of the two diagonal entries. Dashed if not identifiable.', 'quiet'),
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


def _intervals(
    matrix: str, rows: Sequence[tuple[str, float, float, float, str]]
) -> str:
    """Return the intervals of one matrix."""
    items = []
    for label, value, error, scale, _ in rows:
        if not label.startswith(matrix):
            continue
        half = 100.0 * NORMAL_95 * error / scale if scale else math.nan
        diagonal = '-' not in label
        centre = 0.0 if diagonal else 100.0 * value / scale if scale else math.nan
        text = f'±{half:.2g} %' if math.isfinite(half) else 'not identifiable'
        items.append((label, centre, half, text))
    return interval_chart(items, '% of the entry', f'Intervals of {NAMES[matrix][1]}')


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


def excitation_rows(found: Excitation) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the motion of the lip in each axis of the tool."""
    def milli(value: float, unit: str) -> str:
        return f'{1e3 * value:.3g} {unit}' if math.isfinite(value) else '-'

    rows: list[tuple[str, ...]] = [
        ('axis', 'deflection', 'moving', 'noise', 'velocity', 'noise', 'main band')]
    for axis, unit in zip(found.axes, MILLI_UNITS, strict=True):
        low, high = axis.band_hz
        rows.append((
            axis.name, milli(axis.strain, unit), milli(axis.motion, unit),
            milli(axis.strain_noise, unit), milli(axis.twist, f'{unit}/s'),
            milli(axis.twist_noise, f'{unit}/s'),
            f'{low:.1f}-{high:.1f} Hz' if math.isfinite(low) else '-'))
    return rows


def excitation_content(found: Excitation, spectra: Mapping[str, Spectra]) -> list[str]:
    """Return what is identifiable from the recordings."""
    head, *rows = excitation_rows(found)
    parameters = [
        (p.label, f'{100.0 * p.noise_share:.2g} %' if math.isfinite(p.noise_share) else '-',
         'not identifiable' if not p.identifiable else 'weakly' if p.weak else 'well')
        for p in found.parameters
    ]
    return [
        paragraph(f'{found.rank} of {found.size} combinations of parameters are identifiable; '
                  f'scaled condition number {found.condition_number:.3g}.'),
        bullets(found.warnings, 'warning'),
        table(head, rows),
        folded(
            'Each parameter', table(('parameter', 'noise', 'identifiable'), parameters, (0, 2))),
        *(part for name, own in spectra.items()
          for part in (heading(name), figures([
              ('Rate of the shift', _rates(own.twist, 0, 'm²/s²/Hz')),
              ('Rate of the rotation', _rates(own.twist, 3, 'rad²/s²/Hz'))]))),
    ]


def _rates(spectrum: Spectrum, first: int, unit: str) -> str:
    """Return the spectra of three rates."""
    shown = spectrum.frequency >= LOWEST_HZ
    curves = [
        Curve(spectrum.frequency[shown], spectrum.density[shown, i], kind, AXES[i])
        for i, kind in enumerate(('predicted', 'error', 'other'), first)]
    return line_chart(curves, 'frequency (Hz)', unit, log=(True, True),
                      description='Spectra of the excitation')


def iteration_content(iterations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return how the minimum was found."""
    number = np.arange(1.0, len(iterations) + 1.0)
    chi2 = np.array([float(step['chi2']) for step in iterations])
    charts = [('Chi² per degree of freedom', line_chart(
        [Curve(number, chi2, 'predicted')], 'step', 'chi²',
        log=(False, bool(chi2.max() > WIDE * chi2.min() > 0.0)),
        description='Chi squared over the steps'))]
    for key in ('stiffness', 'damping'):
        diagonals = np.array([np.diag(np.array(step[key], dtype=float)) for step in iterations])
        last = np.where(diagonals[-1] != 0.0, diagonals[-1], 1.0)
        kinds = ('predicted', 'error', 'other', 'measured', 'quiet', 'other dashed')
        curves = [
            Curve(number, diagonals[:, i] / last[i], kind, AXES[i]) for i, kind in enumerate(kinds)
            if i not in (1, 4) or (diagonals[:, i] != diagonals[:, i - 1]).any()]  # else tied
        charts.append((f'{key.capitalize()}, diagonal over its final value', line_chart(
            curves, 'step', 'ratio', description=f'{key} over the steps')))
    stages = [int(step.get('stage', 0)) for step in iterations]
    return [paragraph(f'{len(iterations)} steps in {len(set(stages))} stages.'), figures(charts)]
