"""The sections on a fit: K and P, validity range, method, standstills, and structures."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

from bellows_ros.core.identification.result import UNITS
from bellows_ros.core.model.structure import AXES, structure_named
from bellows_ros.core.model.validity_range import SHOWN_PER_SI, SHOWN_UNITS
from bellows_ros.core.signals.residuals import MILLI_UNITS, Spectrum
from bellows_ros.plots.prediction import excitation_figure, interval_figure, iteration_figure
from bellows_ros.workflows.identification import NORMAL_95
import numpy as np

from .page import bullets, figure, folded, paragraph, percent, table

NARROWED = 0.95
"""A standard error is mentioned if standstills reduce it below this fraction."""

NAMES = {'K': ('stiffness', 'Stiffness K'), 'P': ('damping', 'Damping P')}


def cup_content(content: Mapping[str, Any]) -> list[str]:
    """Return table and intervals of K and P of a result."""
    structure = structure_named(content['structure'])
    rows, intervals, folds = [], [], []
    for matrix, (key, title) in NAMES.items():
        values = np.array(content[key], dtype=float)
        errors = np.array(content[f'{key}_std'], dtype=float)  # NaN where not known
        labels = [label for label in structure.labels if label.startswith(matrix)]
        for label, (i, j) in zip(labels, structure.leads, strict=True):
            value, error = float(values[i, j]), float(errors[i, j])
            rows.append((label, *_shown(value, error), UNITS[matrix][(i > 2) + (j > 2)]))
            scale = 0.01 * math.sqrt(abs(values[i, i] * values[j, j])) or math.nan
            intervals.append((
                label, value / scale if i != j else 0.0, NORMAL_95 * error / scale))
        cells = [[name, *(f'{x:.6g}' for x in row)]
                 for name, row in zip(AXES, content[key], strict=True)]
        folds.append(folded(f'{title} ({", ".join(UNITS[matrix])})', table(['', *AXES], cells)))
    return [
        table(('entry', 'value', 'standard error', '95 % interval', 'unit'), rows, (0, 4)),
        figure(interval_figure(
            intervals, 'in percent of the entry; off the diagonal in percent of the root of the '
            'product of the two diagonal entries')),
        bullets(_facts(content)),
        *folds,
    ]


def _shown(value: float, error: float) -> tuple[str, str, str]:
    """Return a value, its standard error and its interval for the table."""
    if not math.isfinite(error):
        return '-', 'not identifiable', ''
    low, high = value - NORMAL_95 * error, value + NORMAL_95 * error
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0.0 else 6
    numbers = [f'{number:.{digits}f}' for number in (value, error, low, high)]
    return numbers[0], numbers[1], f'{numbers[2]} to {numbers[3]}'


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
        rate = 'm/s' if i < 3 else 'rad/s'
        low, high = (SHOWN_PER_SI[i] * seen[f'deflection_{end}'][i] for end in ('low', 'high'))
        rows.append((name, f'{low:.3g} to {high:.3g} {SHOWN_UNITS[i]}',
                     f'{seen["rates"][i]:.3g} {rate}'))
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


def parameter_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of what is known of each entry of K and P."""
    formats = {'value': '.4g', 'signal_to_noise': '.3g', 'bias': '+.1%'}
    return [('parameter', 'first estimate', 'signal to noise', 'expected bias', 'identifiable'), *(
        (label, *(format(p[key], how) if _known(p[key]) else '-' for key, how in formats.items()),
         'no' if not p['identifiable'] else 'weakly' if p['weak'] else 'well')
        for label, p in found['parameters'].items())]


def excitation_content(
    found: Mapping[str, Any], spectra: Mapping[str, Spectrum]
) -> list[str]:
    """Return what is identifiable from the recordings."""
    head, *rows = excitation_rows(found)
    parameter_head, *parameters = parameter_rows(found)
    condition = found['condition_number']
    return [
        paragraph(f'{found["rank"]} of {found["size"]} combinations of parameters are '
                  'identifiable; scaled condition number '
                  f'{f"{condition:.3g}" if _known(condition) else "not finite"}.'),
        bullets(found['warnings'], 'warning'),
        table(head, rows),
        folded(
            'Each parameter', table(parameter_head, parameters, (0, 4))),
        *(figure(excitation_figure(own, name)) for name, own in spectra.items()),
    ]


def iteration_content(iterations: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return how the minimum was found."""
    return [figure(iteration_figure(iterations, f'{len(iterations)} steps'))]


def standstill_content(content: Mapping[str, Any]) -> list[str]:
    """Return the standstills of a result, the nominal length, and the reduced errors."""
    found, added = content['static'], content['with_standstills']
    rows = [
        (recording['bag'], f'{recording["package"]["mass"]:.4g} kg', f'{still["duration"]:.1f} s',
         f'{math.degrees(still["tilt"]):.1f} deg', f'{-1e3 * still["lip"][2]:.3f} mm')
        for recording in found['recordings'] for still in recording['standstills']
    ]
    length = found['nominal_length']
    facts = [
        f'Nominal length {length["text"]}.'
        if length else f'No nominal length: {found["no_nominal_length"]}'
    ]
    if added:
        facts.append(
            f'{added["standstills"]} standstills are part of the fit; chi² per degree of freedom '
            f'{added["chi2"]:.3g}.')
        facts += [
            f'{label}: standard error {100.0 * part:.0f} % of that without them.'
            for label, part in added['narrowed'].items() if part < NARROWED
        ]
    return [table(('recording', 'mass', 'duration', 'tilt', 'length'), rows), bullets(facts)]


def selection_content(selection: Mapping[str, Any]) -> list[str]:
    """Return how the structures compare, and the advice."""
    head, *rows = structure_rows(selection)
    return [table(head, rows), bullets(selection['advice'])]


def structure_rows(selection: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a table, with its head, of the structures that were compared."""
    return [('structure', 'parameters', 'AIC', 'BIC', 'held-out error', 'usable'), *(
        (own['structure'], str(own['parameters']), f'+{own["aic"]:.1f}', f'+{own["bic"]:.1f}',
         percent(math.nan if own['held_out'] is None else own['held_out']),
         'yes' if own['usable'] else 'no') for own in selection['candidates'])]
