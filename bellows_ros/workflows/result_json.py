"""
Results as plain mappings for JSON files; unknown numbers are not finite, and null there.

Every mapping with numbers that have a unit holds it beside them: in `units` under the number's own
key, or in `unit` of its only one; and counts, stamps in ns and rates in Hz say so in their keys.
"""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.identification.identifiability import Excitation
from bellows_ros.core.identification.result import Fit, parameter_units, POSE_UNITS, UNITS
from bellows_ros.core.structure import structure_named

NORMAL_95 = 1.959963984540054
"""Half width of a 95 % interval in standard errors."""

MATRIX_UNITS = {
    name: [[UNITS[matrix][(row > 2) + (column > 2)] for column in range(6)] for row in range(6)]
    for name, matrix in (('stiffness', 'K'), ('damping', 'P'))
}


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return the JSON content on a fit."""
    units, found = parameter_units(structure_named(fit.structure)), fit.standstills
    residual = list(fit.residual_units)
    return {
        **attributes(
            fit, 'method', 'structure', 'stiffness', 'damping', 'stiffness_std', 'damping_std',
            'samples_used', 'samples_rejected', 'condition_number', 'usable', 'weight',
            'residual_rms', 'noise_rms', 'chi2', 'robust_chi2', 'converged'),
        'intervals_95': {
            **{name: {'low': value - half, 'high': value + half} for name, value, half in (
                ('stiffness', fit.stiffness, NORMAL_95 * fit.stiffness_std),
                ('damping', fit.damping, NORMAL_95 * fit.damping_std))},
            'units': MATRIX_UNITS,
        },
        'parameters': {
            'labels': fit.labels, 'covariance': fit.covariance, 'noise_bias': fit.bias,
            'units': {'covariance': _products(units), 'noise_bias': units},
        },
        'time_offsets': fit.delays,
        'time_offsets_std': fit.delays_std,
        'iterations': [
            {**attributes(i, 'stage', 'chi2', 'stiffness', 'damping'),
             'units': {'chi2': '1', **MATRIX_UNITS}} for i in fit.iterations
        ],
        'with_standstills': found and {
            'standstills': found.count,
            'chi2': found.chi2,
            'cup_length': found.length,
            'cup_length_std': found.length_std,
            'narrowed': dict(zip(fit.labels, found.narrowed.tolist(), strict=True)),
            'units': {
                'chi2': '1', 'cup_length': 'm', 'cup_length_std': 'm', 'narrowed': '1'},
        },
        'units': {
            **MATRIX_UNITS,
            **{f'{name}_std': unit for name, unit in MATRIX_UNITS.items()},
            'condition_number': '1',
            'weight': _products([f'1/({unit})' for unit in residual]),
            'residual_rms': residual,
            'noise_rms': residual,
            **dict.fromkeys(('chi2', 'robust_chi2'), '1'),
            **dict.fromkeys(('time_offsets', 'time_offsets_std'), 's'),
            'cup_length': 'm',
        },
    }


def attributes(found: object, *names: str) -> dict[str, Any]:
    """Return some attributes by name."""
    return {name: getattr(found, name) for name in names}


def _products(units: Any) -> list[list[str]]:
    """Return the units of products of numbers with these units."""
    return [[f'{one} {other}' for other in units] for one in units]


def excitation_json(excitation: Excitation) -> dict[str, Any]:
    """Return what is identifiable from recordings, for a JSON file; null is unknown."""
    units = dict(zip(
        structure_named(excitation.structure).labels,
        parameter_units(structure_named(excitation.structure)), strict=True))
    return {
        'structure': excitation.structure,
        'axes': {axis.name: {
            **attributes(
                axis, 'strain', 'motion', 'twist', 'band_hz', 'strain_noise', 'twist_noise'),
            'units': {
                **dict.fromkeys(('strain', 'motion', 'strain_noise'), unit),
                **dict.fromkeys(('twist', 'twist_noise'), f'{unit}/s')},
        } for axis, unit in zip(excitation.axes, POSE_UNITS, strict=True)},
        'parameters': {
            own.label: {
                **attributes(
                    own, 'value', 'noise_share', 'signal_to_noise', 'bias', 'identifiable'),
                'units': {'value': units[own.label], 'noise_share': '1', 'signal_to_noise': '1',
                          'bias': '1'},
            }
            for own in excitation.parameters
        },
        **attributes(excitation, 'rank', 'size', 'condition_number'),
        'pairs': [list(pair) for pair in excitation.pairs],
        'warnings': excitation.warnings,
        'units': {'condition_number': '1', 'pairs': '1'},
    }


def selection_json(selection: Any) -> dict[str, Any]:
    """Return a `StructureSelection` for the JSON file."""
    marks: Mapping[str, str] = dict.fromkeys(
        ('aic', 'bic', 'held_out_wrench', 'held_out', 'simulated'), '1')
    return {
        'candidates': [
            {
                **attributes(candidate, 'structure', 'parameters', 'usable', 'refused', *marks),
                'units': marks,
            }
            for candidate in selection.candidates
        ],
        **attributes(selection, 'samples', 'effective_samples', 'advised', 'advice', 'fits'),
        'units': {'effective_samples': '1'},
    }


def consistency_json(found: Any) -> dict[str, Any]:
    """Return a `Consistency`, whether recordings are of one cup, for the JSON file."""
    return {
        'probability': found.probability,
        'probability_stiffness': found.of_stiffness,
        'probability_damping': found.of_damping,
        'verdict': found.verdict,
        'deviations': found.deviations,
        'units': dict.fromkeys(
            ('probability', 'probability_stiffness', 'probability_damping', 'deviations'), '1'),
    }
