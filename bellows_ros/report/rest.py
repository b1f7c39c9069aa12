"""What standstills have added to a fit, and how the structures of K and P compare."""

from collections.abc import Mapping
import math
from typing import Any

from .page import bullets, table


def rest_content(content: Mapping[str, Any]) -> list[str]:
    """Return the standstills of a result, the nominal length, and what they have narrowed."""
    found, added = content['at_rest'], content.get('static')
    rows = [
        (recording['bag'], f'{recording["mass"]:.4g} kg', f'{hold["duration"]:.1f} s',
         f'{math.degrees(hold["tilt"]):.1f} deg', f'{-1e3 * hold["lip"][2]:.3f} mm')
        for recording in found['recordings'] for hold in recording['standstills']
    ]  # fmt: skip
    length = found['cup_length']
    facts = [
        f'Nominal length {1e3 * length["length"]:.3f} ± {1e3 * length["length_std"]:.3f} mm.'
        if length else f'No nominal length: {found["no_cup_length"]}'
    ]  # fmt: skip
    if added:
        facts.append(
            f'{added["standstills"]} standstills count in the fit; chi² per degree of freedom '
            f'{added["chi2"]:.3g}.')
        facts += [
            f'{label}: standard error {100.0 * part:.0f} % of that without them.'
            for label, part in added['narrowed'].items() if part < NARROWED
        ]  # fmt: skip
    return [table(('recording', 'mass', 'duration', 'tilt', 'length'), rows), bullets(facts)]


NARROWED = 0.95
"""A standard error above this part of that without the standstills is not mentioned."""


def ladder_content(ladder: Mapping[str, Any]) -> list[str]:
    """Return how the structures compare, and the advice."""
    rows = [
        (rung['structure'], str(rung['parameters']), f'+{rung["aic"]:.1f}', f'+{rung["bic"]:.1f}',
         '-' if rung['held_out'] is None else f'{100.0 * rung["held_out"]:.2f} %',
         'yes' if rung['usable'] else 'no')
        for rung in ladder['rungs']
    ]  # fmt: skip
    return [
        table(('structure', 'parameters', 'AIC', 'BIC', 'held-out error', 'usable'), rows),
        bullets(ladder['advice']),
    ]
