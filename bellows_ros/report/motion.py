"""The section on a free simulation: motion, residuals, spectra, whiteness."""

from bellows_ros.core.arrays import Array
from bellows_ros.core.holding import MODES
from bellows_ros.core.identification.validation import LIMIT, Validation
from bellows_ros.core.residuals import AXES, CONFIDENT, MILLI_UNITS, SMALL, Whiteness
from bellows_ros.workflows.replay import Margins, Replay
import numpy as np

from .page import figures, heading, paragraph, percent, table, warnings
from .svg import Curve, line_chart

MILLI = 1e3
LEAST_SPAN = 2.0
"""Smallest range of an axis, mm or mrad."""

ERROR_SIZE, MARGIN_SIZE = (540.0, 110.0), (1080.0, 220.0)
LARGEST_SHOWN = 4.0
"""Safety factors are drawn up to this multiple of the required one."""
LOWEST_HZ = 0.4
"""Lower end of spectra on a logarithmic axis."""


def motion_content(replayed: Replay) -> list[str]:
    """Return tables and figures of a recording that was simulated freely."""
    found = replayed.validation
    start = 'static equilibrium' if found.start == 'equilibrium' else 'the measured state'
    return [
        paragraph(_verdict(found)),
        *([paragraph(replayed.margin.sentence), figures([('', _margins(replayed.margins))])]
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
        heading('Measured and simulated, and the difference'),
        figures(_motion_figures(found, replayed.recording.since_start(found.stamps_ns))),
        heading('Spectra'),
        paragraph(
            'Amplitude spectral densities of the motion, of the error of the free simulation, '
            'and of the one-step prediction errors, for which every sample corrects the model: '
            'their spectrum is flat if only noise remains. Lost samples of motion and error are '
            'interpolated.', 'quiet'),
        figures([(AXES[i], _spectrum(found, i)) for i in range(6)]),
        heading('Whiteness'),
        *_whiteness(found),
    ]


def _margins(found: Margins) -> str:
    """Return the safety factors over time, with bands of two standard deviations."""
    most = LARGEST_SHOWN * found.least
    curves = [
        Curve(found.seconds, np.minimum(found.factors[:, i] + side * found.std[:, i], most), kind,
              label)
        for i, mode in enumerate(MODES)
        for side, kind, label in (
            (-2.0, 'quiet', ''), (2.0, 'quiet', ''), (0.0, ('predicted', 'error')[i], mode))]
    return line_chart(
        [*curves, Curve(found.seconds[[0, -1]], np.full(2, found.least), 'measured',
                        'safety.least')],
        'time (s)', 'safety factor', MARGIN_SIZE,
        description='Safety factors of the grip over time, with two standard deviations',
    )


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


def _verdict(found: Validation) -> str:
    """Return the meaning of the table, in words."""
    failing = found.failing()
    if failing:
        return f'Errors above {100 * LIMIT:g} % of the motion: {", ".join(failing)}.'
    if not found.moves.any():
        return 'No axis moves enough for a verdict.'
    return f'All axes that move are predicted within {100 * LIMIT:g} % of their motion.'


def _motion_figures(found: Validation, seconds: Array) -> list[tuple[str, str]]:
    """Return two charts per axis, both of an axis below each other."""
    items = []
    for i in (0, 3, 1, 4, 2, 5):
        measured, predicted = (MILLI * part[:, i] for part in (found.measured, found.predicted))
        motion = line_chart(
            [Curve(seconds, measured, 'measured', 'measured'),
             Curve(seconds, predicted, 'predicted', 'simulated')],
            '', f'{AXES[i]} ({MILLI_UNITS[i]})', least_span=LEAST_SPAN,
            description=f'Measured and simulated {AXES[i]} over time')
        error = line_chart(
            [Curve(seconds, predicted - measured, 'error', 'simulated minus measured')],
            'time (s)', f'error ({MILLI_UNITS[i]})', ERROR_SIZE,
            description=f'Error of {AXES[i]} over time')
        items.append(('', motion + error))
    return items


def _spectrum(found: Validation, axis: int) -> str:
    """Return the spectra of an axis."""
    spectra = [('measured', 'motion', found.motion), ('error', 'error', found.spectrum)]
    if found.one_step:
        spectra.append(('predicted', 'one-step error', found.one_step.spectrum))
    curves = []
    for kind, label, own in spectra:
        shown = own.frequency >= LOWEST_HZ
        density = MILLI * np.sqrt(own.density[shown, axis])
        curves.append(Curve(own.frequency[shown], density, kind, label))
    return line_chart(
        curves, 'frequency (Hz)', f'{MILLI_UNITS[axis]}/√Hz', log=(True, True),
        description=f'Spectra of {AXES[axis]}')


def _whiteness(found: Validation) -> list[str]:
    """Return table and figures of the portmanteau tests."""
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
    content.append(figures([(AXES[i], _correlation(shown, i)) for i in range(6)]))
    return content


def _correlation(test: Whiteness, axis: int) -> str:
    """Return the autocorrelation of an axis with the band in which white noise stays."""
    lags = np.arange(1.0, test.lags + 1.0)
    band = np.full(test.lags, 1.96 / np.sqrt(test.samples))
    return line_chart(
        [Curve(lags, band, 'quiet', '95 % of white noise'), Curve(lags, -band, 'quiet'),
         Curve(lags, test.autocorrelation[:, axis], 'error')],
        'lag (samples)', 'autocorrelation', ERROR_SIZE,
        description=f'Autocorrelation of {AXES[axis]}',
    )
