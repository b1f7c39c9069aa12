"""The section on standstills, and on the comparison of structures."""

from collections.abc import Mapping
import math
from typing import Any

from .page import bullets, percent, table


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


NARROWED = 0.95
"""A standard error is mentioned if standstills reduce it below this fraction."""


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
