"""Pages of an identification and of a replay, and their sections on recordings."""

from collections.abc import Mapping, Sequence
import json
from typing import Any

from bellows_ros.core.identification.reduction import SEED as EXCITATION_SEED
from bellows_ros.core.identification.samples import samples_of
from bellows_ros.core.identification.validation import LIMIT, SEED, Validation
from bellows_ros.core.model.validity_range import Envelope, FIELDS
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.residuals import AXES, CONFIDENT, MILLI_UNITS, SMALL
from bellows_ros.errors import UnstableError
from bellows_ros.files import File
from bellows_ros.files.atomic import write_text
from bellows_ros.files.results import format_json, provenance
from bellows_ros.plots.plan import margin_figure
from bellows_ros.plots.prediction import errors_figure, prediction_figure, whiteness_figure
from bellows_ros.plots.recording import samples_figure, spectra_figure
from bellows_ros.workflows.identification import Identification
from bellows_ros.workflows.observe import Observed
from bellows_ros.workflows.plot import Spectra
from bellows_ros.workflows.recordings import offset_sentence, values_of_each
from bellows_ros.workflows.replay import Replay, validated
import numpy as np

from . import cup, page

INERTIA = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Entries of package.inertia in the tensor."""


def identification_report(
    content: Mapping[str, Any],
    recordings: Sequence[Recording],
    validations: Sequence[Replay] = (),
) -> str:
    """
    Return the page of a fit.

    Parameters
    ----------
    content : mapping
        The result as its JSON file holds it (plain lists and numbers, None for not known).
    recordings : sequence of Recording
        The recordings of the fit, in their order in the result.
    validations : sequence of Replay
        Recordings that the fit has not seen, simulated with its cup.

    Raises
    ------
    BellowsError
        If the content lacks something, or a file of its provenance cannot be read.

    """
    settings = content['settings']
    bags = [recording.name for recording in recordings]
    spectra = {own.name: samples_of(own).twist_spectrum for own in recordings}
    refusals = ' '.join(content.get('refusals', ()))
    method = str(content['method']).replace('_', ' ')
    origin = dict(content['provenance'])  # and of what the fit has not seen
    origin['recordings'] = [*origin['recordings'],
                            *provenance([v.bag for v in validations])['recordings']]
    sections = [
        page.section(
            'Cup', page.paragraph(
                'The fit can be used.' if content['usable'] else
                f'The fit cannot be used: {refusals or "the warnings say why."}'),
            *(page.paragraph(v.sentence) for v in validations), page.warnings(content['warnings']),
            page.bullets(content.get('findings', ())), *cup.cup_content(content)),
        page.section('Validity range', *cup.envelope_content(content)),
        *(page.section(f'Not used in the fit: {v.bag}', *motion_content(v)) for v in validations),
        *(page.section(f'Used in the fit: {recording.name}', *_simulated(own, recording))
          for own, recording in zip(values_of_recordings(content), recordings, strict=True)),
        page.section('Excitation', *cup.excitation_content(content['excitation'], spectra)),
        *([page.section('Iteration', *cup.iteration_content(content['iterations']))]
          if content.get('iterations') else []),
        *(page.section(f'Samples of {bag}', *samples_content(recording))
          for bag, recording in zip(bags, recordings, strict=True)),
        *(page.section(f'Samples of {v.bag}', *samples_content(v.recording)) for v in validations),
        *([page.section('Standstills', *cup.standstill_content(content))]
          if content.get('static') else []),
        *([page.section('Structures', *cup.selection_content(content['structures']))]
          if content.get('structures') else []),
        page.section('Provenance', *_origin(origin, settings)),
    ]
    title = f'Cup identified from {", ".join(bags)}'
    return page.page(title, f'{method}, {content["structure"]}', sections)


def replay_report(found: Replay, parameter_files: Sequence[File] = ()) -> str:
    """Return the page of a replay."""
    sections = [
        page.section(
            'Free simulation', page.bullets(offset_sentence(found.bag, found.time_offset)),
            *motion_content(found)),
        *([page.section(f'With {found.observed.topic}', *observed_content(found.observed))]
          if found.observed else []),
        page.section('Samples', *samples_content(found.recording)),
        page.section('Provenance', *_origin(
            provenance([found.bag], parameter_files), found.values)),
    ]
    return page.page(f'Replay of {found.bag}', 'free simulation from start to end', sections)


def write_page(result: Identification, path: File) -> None:
    """
    Write the page of an identification for which the parameter output.report was set.

    Raises
    ------
    BellowsError
        If the file cannot be written.

    """
    content = json.loads(format_json(result.as_json()))
    write_text(path, identification_report(content, result.recordings, result.validations))


def cup_values(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a result with its cup and its validity range in them."""
    flat = {f'cup.{key}': tuple(x for row in content[key] for x in row)
            for key in ('stiffness', 'damping')}
    known = Envelope(**{name: content['envelope'][name] for name in FIELDS}).parameters()
    return {**content['settings'], **flat, **known, 'cup.length': content['cup_length']}


def values_of_recordings(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the settings of a result for each of its recordings, with cup and package."""
    values, each = cup_values(content), []
    own = dict(zip(map(str, values['bags']), values_of_each(values), strict=True))
    for recording in content['recordings']:
        payload = recording['package']
        each.append({
            **own[str(recording['bag'])],
            'package.mass': payload['mass'],
            'package.inertia': tuple(payload['inertia'][i][j] for i, j in INERTIA),
            'package.com': tuple(payload['com']),
        })
    return each


def _simulated(values: Mapping[str, Any], recording: Recording) -> list[str]:
    """Return how a recording of the fit is simulated, or why it cannot be."""
    try:
        return motion_content(validated(values, recording))
    except UnstableError as error:
        return [page.paragraph(f'This cup cannot be simulated: {error}', 'quiet')]


def _origin(provenance: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return tables of digests, versions and settings."""
    files = [
        (kind, entry['path'], file['name'], str(file['bytes']), file['sha256'])
        for kind, key in (('recording', 'recordings'), ('parameters', 'parameter_files'))
        for entry in provenance.get(key, ())
        for file in entry['files']
    ]
    versions = [(name, version or 'not there') for name, version in provenance['versions'].items()]
    seeds = f'{SEED} (validation), {EXCITATION_SEED} (excitation)'
    versions.append(('seeds of made-up noise', seeds))
    rows = [(name, _setting(value)) for name, value in settings.items()]
    return [
        page.table(('', 'path', 'file', 'bytes', 'SHA-256'), files, (0, 1, 2, 4)),
        page.table(('', 'version or seed'), versions, (0, 1)),
        page.folded('All settings', page.table(('parameter', 'value'), rows, (0, 1))),
    ]


def _setting(value: Any) -> str:
    """Return a setting; of a matrix its rows."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(_setting(item) for item in value) + ']'
    if isinstance(value, float):
        return f'{value:.8g}'
    return str(value).lower() if isinstance(value, bool) else str(value) or "''"


MILLI = 1e3


def motion_content(replayed: Replay) -> list[str]:
    """Return tables and figures of a recording that was simulated freely."""
    found, bag = replayed.validation, replayed.bag
    start = 'static equilibrium' if found.start == 'equilibrium' else 'the measured state'
    return [
        page.paragraph(found.verdict()),
        *([page.paragraph(replayed.margin.sentence),
           page.figure(margin_figure(replayed.margins, bag))] if replayed.margin else []),
        page.warnings(replayed.warnings),
        page.paragraph(
            f'The model ran freely from {start} to the end, with only the motion of the tool as '
            f'input. {found.scores.samples} samples are compared. Coordinates are those of the '
            'centre of mass B in the axes of the tool E: position, and rotation vector. NRMSE '
            'is the RMS error over the RMS motion, noise included; the model error is NRMSE '
            'without the noise.'
        ),
        _score_table(found),
        page.figure(prediction_figure(
            replayed.recording.since_start(found.stamps_ns), found, 'Measured and simulated',
            f'{bag}, relative to the tool')),
        page.heading('Spectra'),
        page.paragraph(
            'Amplitude spectral densities of the motion, of the error of the free simulation, '
            'and of the one-step prediction errors, for which every sample corrects the model, '
            "scaled to the noise of the package's poses: their spectrum is flat if only noise "
            'remains. Lost samples of motion and error are interpolated.', 'quiet'),
        page.figure(spectra_figure(
            Spectra(found.motion.frequency, np.sqrt(found.motion.density),
                    np.sqrt(found.spectrum.density)),
            bag, one_step=found.one_step.spectrum if found.one_step else None)),
        page.heading('Whiteness'),
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
            page.percent(found.scores.nrmse[i]), page.percent(found.model_error[i]),
            word if found.moves[i] else 'moves too little'))
    return page.table(head, rows, (0, 7))


def _whiteness(found: Validation, bag: str) -> list[str]:
    """Return table and figure of the portmanteau tests."""
    tests = [('free run', found.whiteness)]
    if found.one_step:
        tests.append(('one step', found.one_step.whiteness))
    content = [
        page.paragraph(
            f'Portmanteau test of Ljung and Box over {found.whiteness.lags} lags. White: a '
            f'probability of {CONFIDENT:g} or more; nearly white: less, but no autocorrelation '
            f'of {SMALL:g} or more; else coloured. The errors of a free simulation may be '
            "coloured even for a perfect cup, because the tool's noise excites the cup's modes. "
            'One-step prediction errors are white if the model explains all but noise.', 'quiet'),
        page.table(
            ('errors', 'axis', 'Q', 'probability', 'largest autocorrelation', 'verdict'),
            [(name, AXES[i], f'{test.statistic[i]:.1f}',
              f'{test.p_value[i]:.3f}' if test.p_value[i] >= 1e-3 else 'below 0.001',
              f'{test.largest[i]:.3f}', test.verdicts[i])
             for name, test in tests for i in range(6)], (0, 1, 5)),
    ]
    if found.one_step:
        content.append(page.paragraph(
            f'Chi² per degree of freedom of the one-step errors: {found.one_step.chi2:.4f} (1 if '
            'model and noise explain everything).'))
    shown = found.one_step.whiteness if found.one_step else found.whiteness
    content.append(page.figure(whiteness_figure(shown, bag)))
    return content


def observed_content(found: Observed) -> list[str]:
    """Return table and figures of the errors of prediction and camera, each alone and both."""
    rows = [
        (f'{name} ({unit})', *(f'{MILLI * w.scores.rms[i]:.3g}' for w in found.ways.values()))
        for i, (name, unit) in enumerate(zip(AXES, MILLI_UNITS, strict=True))
    ]
    return [
        page.paragraph(
            'RMS error at each instant of three causal estimates: the prediction from the tool '
            'alone, the newest measured pose alone, and the corrected prediction. '
            + found.sentence),
        page.warnings([f'Alarm at {line}' for line in found.alarm_lines]),
        page.table(('axis', *found.ways), rows),
        page.figure(errors_figure(found.ways, f'relative to the tool, with {found.topic}')),
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
            ', '.join(refused) or '0', str(stream.marked), gaps, str(stream.overlapping_gap)))
    return [
        page.figure(samples_figure(
            recording, f'{np.count_nonzero(recording.valid)} of {len(recording.valid)} samples '
            'are used; a lost pose rejects all samples whose filter window contains it')),
        page.table(
            ('topic', 'poses', 'rate', 'refused', 'outliers', 'gaps', 'left out by the filter'),
            rows),
        page.bullets(report.warnings, 'warning'),
    ]
