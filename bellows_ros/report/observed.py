"""The section on a camera: the gain by measured poses of the package."""

from bellows_ros.core.residuals import AXES, Comparison, MILLI_UNITS
from bellows_ros.workflows.observe import Observed

from .page import figures, paragraph, table, warnings
from .svg import Curve, line_chart

MILLI = 1e3
KINDS = ('predicted', 'quiet', 'error')


def observed_content(found: Observed) -> list[str]:
    """Return table and figures of the errors of prediction and camera, each alone and both."""
    rows = [
        (f'{name} ({unit})', *(f'{MILLI * w.scores.rms[i]:.3g}' for w in found.ways.values()))
        for i, (name, unit) in enumerate(zip(AXES, MILLI_UNITS, strict=True))
    ]
    start_ns = found.camera.stamps_ns[0]

    def curve(name: str, way: Comparison, kind: str, axis: int) -> Curve:
        seconds = (way.stamps_ns - start_ns) * 1e-9
        return Curve(seconds, MILLI * way.error[:, axis], kind, name)

    return [
        paragraph(
            'RMS error at each instant of three causal estimates: the prediction from the tool '
            'alone, the newest measured pose alone, and the corrected prediction. '
            + found.sentence),
        warnings([f'Alarm at {line}' for line in found.alarm_lines]),
        table(('axis', *found.ways), rows),
        figures([('', line_chart(
            [curve(name, way, kind, i) for (name, way), kind in zip(
                found.ways.items(), KINDS, strict=True)],
            'time (s)', f'error of {AXES[i]} ({MILLI_UNITS[i]})',
            description=f'Error of {AXES[i]} over time: {", ".join(found.ways)}',
        )) for i in range(6)]),
    ]
