"""The section on samples: used samples, and reasons for rejected ones."""

from bellows_ros.core.recording.recording import Recording
from bellows_ros.plots.recording import samples_figure

from .page import bullets, figure, table


def samples_content(recording: Recording) -> list[str]:
    """Return a strip of time and a table."""
    report = recording.report
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
        figure(samples_figure(
            recording, f'{report.valid} of {report.samples} samples are used; a lost pose rejects '
            'all samples whose filter window contains it')),
        table(
            ('topic', 'poses', 'rate', 'refused', 'outliers', 'gaps', 'left out by the filter'),
            rows),
        bullets(report.warnings, 'warning'),
    ]
