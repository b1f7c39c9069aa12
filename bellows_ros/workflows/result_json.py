"""Results as plain mappings, for JSON files; what is not known is not finite, and null there."""

from typing import Any

from bellows_ros.core.identification.advice.added_noise import FilterNoise
from bellows_ros.core.identification.advice.excitation import Axis, Excitation
from bellows_ros.core.identification.advice.ladder import Ladder, Rung
from bellows_ros.core.identification.advice.package_check import CentreOfMass, Checked, CupLength
from bellows_ros.core.identification.judgement.consistency import Consistency
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.model import Package
from bellows_ros.core.recording.preparation import Recording, Report, StreamReport
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NORMAL_95 = 1.959963984540054
"""Half width of a 95 % interval in standard errors."""


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return what the JSON file says of a fit."""
    return {
        'method': fit.method,
        'structure': fit.structure,
        'stiffness': fit.stiffness,
        'damping': fit.damping,
        'stiffness_std': fit.stiffness_std,
        'damping_std': fit.damping_std,
        'intervals_95': {
            name: _interval(getattr(fit, name), getattr(fit, f'{name}_std'))
            for name in ('stiffness', 'damping')
        },
        'samples_used': fit.samples_used,
        'samples_rejected': fit.samples_rejected,
        'condition_number': fit.condition_number,
        'usable': fit.usable,
        'parameters': {
            'labels': fit.labels, 'covariance': fit.covariance, 'noise_bias': fit.bias,
        },
        'weight': fit.weight,
        'residual_rms': fit.residual_rms,
        'noise_rms': fit.noise_rms,
        'chi2': fit.chi2,
        'time_offsets': fit.delays,
        'time_offsets_std': fit.delays_std,
        'iterations': [
            {'stage': i.stage, 'chi2': i.chi2, 'stiffness': i.stiffness, 'damping': i.damping}
            for i in fit.iterations
        ],
        'static': fit.rest and {
            'standstills': fit.rest.holds,
            'chi2': fit.rest.chi2,
            'cup_length': fit.rest.length,
            'cup_length_std': fit.rest.length_std,
            'narrowed': dict(zip(fit.labels, fit.rest.narrowed.tolist(), strict=True)),
        },
    }


def _interval(value: Array, error: Array) -> dict[str, Array]:
    """Return both ends of the 95 % intervals of a matrix's entries."""
    return {'low': value - NORMAL_95 * error, 'high': value + NORMAL_95 * error}


def consistency_json(found: Consistency) -> dict[str, Any]:
    """Return whether recordings are of one cup, for the JSON file."""
    return {
        'probability': found.probability,
        'probability_stiffness': found.of_stiffness,
        'probability_damping': found.of_damping,
        'verdict': found.verdict,
        'deviations': found.deviations,
    }


def ladder_json(ladder: Ladder) -> dict[str, Any]:
    """Return structures compared, for the JSON file."""
    return {
        'rungs': [_rung_json(rung) for rung in ladder.rungs],
        'samples': ladder.samples,
        'effective_samples': ladder.effective_samples,
        'advised': ladder.advised,
        'advice': ladder.advice,
    }


def _rung_json(rung: Rung) -> dict[str, Any]:
    """Return one structure's marks."""
    return {
        'structure': rung.structure,
        'parameters': rung.parameters,
        'usable': rung.usable,
        'refused': rung.refused,
        'aic': rung.aic,
        'bic': rung.bic,
        'held_out_wrench': rung.held_out_wrench,
        'held_out': known(rung.held_out),
        'simulated': [known(float(error)) for error in rung.simulated],
    }


def recording_json(bag: str, report: Report) -> dict[str, Any]:
    """Return what became of a recording, for the JSON file."""
    return {
        'bag': bag,
        'samples': report.samples,
        'valid': report.valid,
        'tool_pose': _stream_json(report.tool),
        'package_pose': _stream_json(report.package),
        'time_offset': report.time_offset and report.time_offset._asdict(),
        'warnings': report.warnings,
    }


def package_json(package: Package) -> dict[str, Any]:
    """Return what a recording held: kg, kg m^2, m."""
    return {'mass': package.mass, 'inertia': package.inertia, 'com': package.com}


def checked_json(checked: Checked) -> dict[str, Any]:
    """Return what a recording says of the values that were given, null where it cannot."""
    return {
        'cup_length': checked.length and length_json(checked.length),
        'centre_of_mass': checked.centre and centre_json(checked.centre),
    }


def centre_json(centre: CentreOfMass) -> dict[str, Any]:
    """Return where a recording wants the centre of mass, m from where it was said to be."""
    return {'shift': centre.shift, 'shift_std': centre.shift_std, 'off': centre.off}


def length_json(length: CupLength) -> dict[str, Any]:
    """Return by how much a recording wants the cup longer, m."""
    return {'shift': length.shift, 'shift_std': length.shift_std, 'off': length.off}


def measured_json(recording: Recording) -> dict[str, Any]:
    """Return the noise (m, rad) of a recording's poses and its pick-up offset (m)."""
    noise = FilterNoise.of(recording)
    return {
        'noise': {'tool': noise.tool._asdict(), 'package': noise.package._asdict()},
        'lateral_offset': recording.alignment.lateral_offset,
    }


def _stream_json(stream: StreamReport) -> dict[str, Any]:
    """Return what became of a topic's messages."""
    return {
        'topic': stream.name,
        'poses': stream.samples,
        'rate_hz': stream.timing.rate_hz,
        'refused': {reason: list(where) for reason, where in stream.refused.items()},
        'outliers': stream.marked,
        'gaps': [
            {'start_ns': gap.start_ns, 'duration_s': gap.duration_s} for gap in stream.timing.gaps
        ],
        'filtered_samples_left_out': stream.touched,
    }


def excitation_json(excitation: Excitation) -> dict[str, Any]:
    """Return what recordings can tell, for a JSON file; what is not known is null."""
    return {
        'structure': excitation.structure,
        'axes': {axis.name: _axis_json(axis) for axis in excitation.axes},
        'parameters': {
            told.label: {
                'value': known(told.value),
                'noise_share': known(told.noise_share),
                'signal_to_noise': known(told.signal_to_noise),
                'bias': known(told.bias),
                'told': not told.untold,
            }
            for told in excitation.parameters
        },
        'rank': excitation.rank,
        'size': excitation.size,
        'condition_number': known(excitation.condition_number),
        'pairs': [list(pair) for pair in excitation.pairs],
        'warnings': excitation.warnings,
    }


def _axis_json(axis: Axis) -> dict[str, Any]:
    """Return one direction's excitation."""
    return {
        'strain': axis.strain,
        'motion': axis.motion,
        'twist': axis.twist,
        'band_hz': [known(end) for end in axis.band_hz],
        'strain_noise': known(axis.strain_noise),
        'twist_noise': known(axis.twist_noise),
    }


def known(value: float) -> float | None:
    """Return a number, or None where it is none."""
    return float(value) if np.isfinite(value) else None
