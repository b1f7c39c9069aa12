"""The sections on a recording: free simulation, gain by measured poses, and samples."""

from bellows_ros.core.identification.validation import LIMIT, Validation
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES, CONFIDENT, MILLI_UNITS, SMALL
from bellows_ros.plots.plan import margin_figure
from bellows_ros.plots.prediction import errors_figure, prediction_figure, whiteness_figure
from bellows_ros.plots.recording import samples_figure, spectra_figure
from bellows_ros.workflows.observe import Observed
from bellows_ros.workflows.plot import Spectra
from bellows_ros.workflows.replay import Replay
import numpy as np

from .page import bullets, figure, heading, paragraph, percent, table, warnings

MILLI = 1e3


def motion_content(replayed: Replay) -> list[str]:
    """Return tables and figures of a recording that was simulated freely."""
    found, bag = replayed.validation, replayed.bag
    start = 'static equilibrium' if found.start == 'equilibrium' else 'the measured state'
    return [
        paragraph(found.verdict()),
        *([paragraph(replayed.margin.sentence), figure(margin_figure(replayed.margins, bag))]
          if replayed.margin else []),
        warnings(replayed.warnings),
        paragraph(
            f'The model ran freely from {start} to the end, with only the motion of the tool as '
            f'input. {found.scores.samples} samples are compared. Coordinates are those of the '
            'centre of mass B in the axes of the tool E: position, and rotation vector. NRMSE '
            'is the RMS error over the RMS motion, noise included; the model error is NRMSE '
            'without the noise.'
        ),
        _score_table(found),
        figure(prediction_figure(
            replayed.recording.since_start(found.stamps_ns), found, 'Measured and simulated',
            f'{bag}, relative to the tool')),
        heading('Spectra'),
        paragraph(
            'Amplitude spectral densities of the motion, of the error of the free simulation, '
            'and of the one-step prediction errors, for which every sample corrects the model, '
            "scaled to the noise of the package's poses: their spectrum is flat if only noise "
            'remains. Lost samples of motion and error are interpolated.', 'quiet'),
        figure(spectra_figure(
            Spectra(found.motion.frequency, np.sqrt(found.motion.density),
                    np.sqrt(found.spectrum.density)),
            bag, one_step=found.one_step.spectrum if found.one_step else None)),
        heading('Whiteness'),
        *_whiteness(found, bag),
    ]


def _score_table(found: Validation) -> str:
    """Return errors per axis."""
    head = ('axis', 'RMS error', 'of noise alone', 'largest', 'motion', 'NRMSE',
            'model error', 'judged')
    rows = []
    for i, (name, unit) in enumerate(zip(AXES, MILLI_UNITS, strict=True)):
        numbers = (found.scores.rms[i], found.noise[i], found.scores.largest[i],
                   found.scores.motion[i])
        word = 'good' if found.scores.nrmse[i] <= LIMIT else f'above {100 * LIMIT:g} %'
        rows.append((
            name, *(f'{MILLI * value:.3g} {unit}' for value in numbers),
            percent(found.scores.nrmse[i]), percent(found.model_error[i]),
            word if found.moves[i] else 'moves too little'))
    return table(head, rows, (0, 7))


def _whiteness(found: Validation, bag: str) -> list[str]:
    """Return table and figure of the portmanteau tests."""
    tests = [('free run', found.whiteness)]
    if found.one_step:
        tests.append(('one step', found.one_step.whiteness))
    content = [
        paragraph(
            f'Portmanteau test of Ljung and Box over {found.whiteness.lags} lags. White: a '
            f'probability of {CONFIDENT:g} or more; nearly white: less, but no autocorrelation '
            f'of {SMALL:g} or more; else coloured. The errors of a free simulation may be '
            "coloured even for a perfect cup, because the tool's noise excites the cup's modes. "
            'One-step prediction errors are white if the model explains all but noise.', 'quiet'),
        table(
            ('errors', 'axis', 'Q', 'probability', 'largest autocorrelation', 'verdict'),
            [(name, AXES[i], f'{test.statistic[i]:.1f}',
              f'{test.p_value[i]:.3f}' if test.p_value[i] >= 1e-3 else 'below 0.001',
              f'{test.largest[i]:.3f}', test.verdicts[i])
             for name, test in tests for i in range(6)], (0, 1, 5)),
    ]
    if found.one_step:
        content.append(paragraph(
            f'Chi² per degree of freedom of the one-step errors: {found.one_step.chi2:.4f} (1 if '
            'model and noise explain everything).'))
    shown = found.one_step.whiteness if found.one_step else found.whiteness
    content.append(figure(whiteness_figure(shown, bag)))
    return content


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


def samples_content(recording: Recording) -> list[str]:
    """Return a strip of time and a table."""
    report = recording.report
    rows = []
    for stream in (report.tool, report.package):
        refused = [f'{len(where)} {reason.replace("_", " ")}'
                   for reason, where in stream.recorded.refused.items() if where]
        longest = max((gap.duration_s for gap in stream.timing.gaps), default=0.0)
        gaps = f'{len(stream.timing.gaps)}, longest {longest:.3g} s' if longest else '0'
        rows.append((
            stream.recorded.name, str(len(stream.recorded)), f'{stream.timing.rate_hz:.6g} Hz',
            ', '.join(refused) or '0', str(stream.marked), gaps, str(stream.touched)))
    return [
        figure(samples_figure(
            recording, f'{np.count_nonzero(recording.valid)} of {len(recording.valid)} samples '
            'are used; a lost pose rejects all samples whose filter window contains it')),
        table(
            ('topic', 'poses', 'rate', 'refused', 'outliers', 'gaps', 'left out by the filter'),
            rows),
        bullets(report.warnings, 'warning'),
    ]
