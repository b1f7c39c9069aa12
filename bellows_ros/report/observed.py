"""The section on a camera: the gain by measured poses of the package."""

from bellows_ros.core.residuals import AXES, MILLI_UNITS
from bellows_ros.plots.prediction import errors_figure
from bellows_ros.workflows.observe import Observed

from .page import figure, paragraph, table, warnings

MILLI = 1e3


def observed_content(found: Observed) -> list[str]:
    """Return table and figures of the errors of prediction and camera, each alone and both."""
    rows = [
        (f'{name} ({unit})', *(f'{MILLI * w.scores.rms[i]:.3g}' for w in found.ways.values()))
        for i, (name, unit) in enumerate(zip(AXES, MILLI_UNITS, strict=True))
    ]
    return [
        paragraph(
            'RMS error at each instant of three causal estimates: the prediction from the tool '
            'alone, the newest measured pose alone, and the corrected prediction. '
            + found.sentence),
        warnings([f'Alarm at {line}' for line in found.alarm_lines]),
        table(('axis', *found.ways), rows),
        figure(errors_figure(found.ways, f'relative to the tool, with {found.topic}')),
    ]
