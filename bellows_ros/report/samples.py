"""The section on samples: used samples, and reasons for rejected ones."""

from bellows_ros.core.arrays import Array, Mask
from bellows_ros.core.recording.recording import Recording
import numpy as np

from .page import bullets, figures, table
from .svg import strip_chart


def samples_content(recording: Recording) -> list[str]:
    """Return a strip of time and a table."""
    report = recording.report
    seconds = recording.since_start(recording.package.stamps_ns)
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    strips = [(name, kind, spans(mask, seconds, step)) for name, kind, mask in (
        ('used', 'used', recording.valid),
        ('tool poses lost', 'lost', ~recording.measured_tool.valid),
        ('package poses lost', 'lost', ~recording.measured_package.valid))]
    rows = []
    for stream in (report.tool, report.package):
        refused = [f'{len(where)} {reason.replace("_", " ")}'
                   for reason, where in stream.refused.items() if where]
        longest = max((gap.duration_s for gap in stream.timing.gaps), default=0.0)
        gaps = f'{len(stream.timing.gaps)}, longest {longest:.3g} s' if longest else '0'
        rows.append((
            stream.name, str(stream.samples), f'{stream.timing.rate_hz:.6g} Hz',
            ', '.join(refused) or '0', str(stream.marked), gaps, str(stream.touched)))
    return [
        figures([(
            f'{report.valid} of {report.samples} samples are used; a lost pose rejects all '
            'samples whose filter window contains it',
            strip_chart(
                strips, (0.0, float(seconds[-1]) + step), 'time (s)', 'Used and lost samples'))]),
        table(
            ('topic', 'poses', 'rate', 'refused', 'outliers', 'gaps', 'left out by the filter'),
            rows),
        bullets(report.warnings, 'warning'),
    ]


def spans(
    mask: Mask, seconds: Array, step: float
) -> list[tuple[float, float]]:
    """Return start and end (s) of the runs of samples in a mask; each lasts a step."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [
        (float(seconds[first]), float(seconds[end - 1]) + step)
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    ]
