"""Results as plain mappings, for JSON files."""

from typing import Any

from bellows_ros.core.identification.excitation import Axis, Excitation
from bellows_ros.core.identification.result import Fit
from bellows_ros.core.recording.preparation import Report, StreamReport
import numpy as np


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return what the JSON file says of a fit."""
    return {
        'method': fit.method,
        'structure': fit.structure,
        'stiffness': fit.stiffness,
        'damping': fit.damping,
        'stiffness_std': fit.stiffness_std,
        'damping_std': fit.damping_std,
        'samples_used': fit.samples_used,
        'samples_rejected': fit.samples_rejected,
        'condition_number': fit.condition_number,
        'usable': fit.usable,
        'parameters': {'labels': fit.labels, 'covariance': fit.covariance},
        'weight': fit.weight,
        'residual_rms': fit.residual_rms,
        'chi2': fit.chi2,
        'time_offsets': fit.delays,
        'iterations': [
            {'stage': i.stage, 'chi2': i.chi2, 'stiffness': i.stiffness, 'damping': i.damping}
            for i in fit.iterations
        ],
    }


def recording_json(bag: str, report: Report) -> dict[str, Any]:
    """Return what became of a recording, for the JSON file."""
    return {
        'bag': bag,
        'samples': report.samples,
        'valid': report.valid,
        'tool_pose': _stream_json(report.tool),
        'package_pose': _stream_json(report.package),
        'warnings': report.warnings,
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
