"""
Results as plain mappings for JSON files; unknown numbers are not finite, and null there.

Every mapping with numbers that have a unit holds it beside them: in `units` under the number's own
key, or in `unit` of its only one; and counts, stamps in ns and rates in Hz say so in their keys.
"""

from collections.abc import Mapping
from typing import Any

from bellows_ros.core.identification.identifiability import Excitation
from bellows_ros.core.identification.result import Fit, parameter_units, POSE_UNITS, UNITS
from bellows_ros.core.model.structure import structure_named

NORMAL_95 = 1.959963984540054
"""Half width of a 95 % interval in standard errors."""

UNIT_OF: Mapping[str, Any] = {
    **{
        name: [[UNITS[matrix][(row > 2) + (column > 2)] for column in range(6)]
               for row in range(6)]
        for name, matrix in (('stiffness', 'K'), ('damping', 'P'))
    },
    **dict.fromkeys((
        'rms', 'largest', 'motion', 'noise_rms', 'lip', 'measured', 'predicted',
    ), POSE_UNITS),
    **dict.fromkeys((
        'chi2', 'robust_chi2', 'condition_number', 'narrowed', 'noise_share', 'signal_to_noise',
        'bias', 'pairs', 'aic', 'bic', 'held_out', 'simulated',
        'effective_samples', 'probability', 'probability_stiffness', 'probability_damping',
        'deviations', 'excess', 'left', 'moved', 'nrmse', 'model_error', 'limit', 'p_value',
        'portmanteau', 'largest_autocorrelation', 'real_time_factor',
    ), '1'),
    **dict.fromkeys(('cup_length', 'length', 'lengths'), 'm'),
    **dict.fromkeys(('time_offsets', 'duration', 'late', 'took'), 's'),
    **dict.fromkeys(('load', 'loads', 'linear_load'), 'N'),
    'impulse': 'N s', 'speed': 'm/s', 'tilt': 'rad',
}
"""Units of numbers by their keys, and of their standard errors."""

WITHOUT = ('settings', 'provenance', 'units')
"""Mappings whose numbers have their units in their names, or none."""


def with_units(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return content with the units of its numbers beside them, at all depths."""
    units = {key: UNIT_OF[key.removesuffix('_std')] for key, value in content.items()
             if key.removesuffix('_std') in UNIT_OF and value is not None}
    found = {
        key: value if key in WITHOUT else _inside(value) for key, value in content.items()}
    return {**found, 'units': {**units, **content.get('units', {})}} if units else found


def _inside(value: Any) -> Any:
    """Return a value with units in all mappings in it."""
    if isinstance(value, list | tuple):
        return [_inside(item) for item in value]
    return with_units(value) if isinstance(value, Mapping) else value


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return the JSON content on a fit."""
    units, found = parameter_units(structure_named(fit.structure)), fit.standstills
    return {
        **attributes(
            fit, 'method', 'structure', 'stiffness', 'damping', 'stiffness_std', 'damping_std',
            'relaxation', 'relaxation_std', 'samples_used', 'samples_rejected',
            'condition_number', 'usable', 'weight', 'residual_rms', 'noise_rms', 'chi2',
            'robust_chi2', 'converged'),
        'intervals_95': {
            name: {'low': value - half, 'high': value + half} for name, value, half in (
                ('stiffness', fit.stiffness, NORMAL_95 * fit.stiffness_std),
                ('damping', fit.damping, NORMAL_95 * fit.damping_std))},
        'parameters': {
            'labels': fit.labels, 'covariance': fit.covariance, 'noise_bias': fit.bias,
            'units': {'covariance': _products(units), 'noise_bias': units},
        },
        'time_offsets': fit.delays,
        'time_offsets_std': fit.delays_std,
        'iterations': [
            attributes(i, 'chi2', 'stiffness', 'damping') for i in fit.iterations],
        'with_standstills': found and {
            'standstills': found.count,
            'chi2': found.chi2,
            'cup_length': found.length,
            'cup_length_std': found.length_std,
            'narrowed': dict(zip(fit.labels, found.narrowed.tolist(), strict=True)),
        },
        'units': {
            'weight': _products([f'1/({unit})' for unit in fit.residual_units]),
            **dict.fromkeys(('residual_rms', 'noise_rms'), fit.residual_units),
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
    units = parameter_units(structure_named(excitation.structure))
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
                    own, 'value', 'noise_share', 'signal_to_noise', 'bias', 'identifiable',
                    'weak'),
                'units': {'value': unit},
            }
            for own, unit in zip(excitation.parameters, units, strict=True)
        },
        **attributes(excitation, 'rank', 'size', 'condition_number', 'pairs', 'warnings'),
    }


def selection_json(selection: Any) -> dict[str, Any]:
    """Return a `StructureSelection` for the JSON file."""
    return {
        'candidates': [
            attributes(candidate, 'structure', 'parameters', 'usable', 'refused', 'aic', 'bic',
                       'held_out', 'simulated')
            for candidate in selection.candidates],
        **attributes(selection, 'samples', 'effective_samples', 'advised', 'advice', 'fits'),
    }
