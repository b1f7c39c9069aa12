"""Identify a cup's stiffness and damping from recordings."""

import argparse
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, TYPE_CHECKING

from bellows_ros.core.geometry.jit import COMPILED, NOT_COMPILED
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.report.sentences import listed, many
from bellows_ros.report.text import column, display_unit, formatted, print_identification
from bellows_ros.workflows.identification import Identification, save
from bellows_ros.workflows.identify import identify

from . import options
from .console import Console, Output

if TYPE_CHECKING:
    from bellows_ros.workflows.toss import ReleaseResult

OUTPUTS = {'out': 'output.parameters', 'out_cell': 'output.cell', 'json': 'output.json',
           'report': 'output.report'}
"""Parameters that name outputs, by the options that replace them."""


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Identify a cup or a release from recordings, and write the parameter files."""
    settings = _settings(arguments, console)
    if arguments.release:
        return _release(arguments, settings, console)

    if not COMPILED and settings.get('fit.method', 'output_error') == 'output_error':
        console.warn(
            f'Nothing is compiled, as {NOT_COMPILED}: the fit takes about 15 s for each second '
            'recorded. Consider fit.method: least_squares.')
    result = identify(settings, console.progress, arguments.params, arguments.jobs,
                      arguments.dask, arguments.force)
    if arguments.report:
        from bellows_ros.report.build import write_page

        write_page(result, arguments.report)
    then, usable = _next(arguments, result), not result.refusals
    if not (usable or arguments.force and result.fit.usable):
        arguments.out = arguments.out_cell = ''
    replaced = _names(arguments.out)
    save(result, arguments.out, '', arguments.force, arguments.out_cell)
    if lost := replaced - _names(arguments.out):
        console.warn(
            f'{", ".join(sorted(lost))} of the former {arguments.out} are not in the new one, '
            'which has the identified cup alone. State them in another file.')
    return options.Outcome(result, usable, then, draw=arguments.plot)


def _names(path: str) -> set[str]:
    """Return the names of the parameters in a file; none if there is no such file."""
    with suppress(BellowsError):
        return {*read_parameters(path)} if path else set()
    return set()


def _next(arguments: argparse.Namespace, result: Identification) -> tuple[str, ...]:
    """Return the exit status of the cup, and the next step as sentences."""
    out, cell = arguments.out, arguments.out_cell
    if result.refusals:
        written = 'written because of --force' if (
            arguments.force and result.fit.usable) else 'not written'
        state = f'its file was {written}' if out or cell else 'do not use it'
        return (f'This cup is refused: {state}.',)
    if not out:
        return ('The cup was not written to a file; give --out cup.yaml to keep it.',)
    lost = ', '.join(name for name in result.found if name != 'cup.length') if not cell else ''
    files = [cell] if cell else arguments.params
    replay = 'Next, check how well it predicts another recording:', ' '.join([
        '  bellows replay BAG', *(f'--params {file}' for file in (*files, out)),
        *([f'--observe {result.remappings.get("package/measured", "/tf")}'] if cell else [])])
    return (
        *([f'Estimated, but not written: {lost}; give --out-cell cell.yaml to keep them.']
          if lost else []),
        *replay * bool(result.values.topics.package_pose), *((
            'Then predict live:',
            f'  ros2 run bellows_ros predictor --ros-args --params-file {cell} --params-file {out}'
            + ''.join(f' -r {name}:={topic}' for name, topic in result.remappings.items())
        ) if cell else ()))


def _release(
    arguments: argparse.Namespace, settings: Mapping[str, Any], console: Console
) -> options.Outcome:
    """Identify the valve and write."""
    if excluded := [
            f'--{name}' for name in ('report', 'jobs', 'dask') if getattr(arguments, name)]:
        raise BellowsError(
            f'--release cannot be combined with {", ".join(excluded)}. Leave it out.')
    from bellows_ros.files.parameter_files import write_parameters
    from bellows_ros.workflows.toss import identify_release

    result = identify_release(settings, console.progress)
    if arguments.out:
        write_parameters(arguments.out, result.parameters())
    return options.Outcome(result, inputs=result.bags)


def print_result(result: 'Identification | ReleaseResult', console: Console) -> None:
    """Print the cup, or with --release the law of the valve."""
    if isinstance(result, Identification):
        print_identification(result, console)
        console.line()
    else:
        _print_release(result, console)


def _print_release(result: 'ReleaseResult', console: Console) -> None:
    """Print the law with its errors, and its residuals for the drops of each mass."""
    from bellows_ros.workflows.toss import RELEASE_UNITS

    fit, milli, names = result.fit, 1e3, list(RELEASE_UNITS)
    console.line(
        f'Release identified from {many(len(fit.drops), "drop")} in {listed(result.bags)}', 'bold')
    rows: list[tuple[str, ...]] = [('', '', 'standard error', 'scatter')]
    for k in set(range(len(names))) - set(fit.not_identifiable):
        factor, unit = display_unit(RELEASE_UNITS[names[k]])
        numbers = (fit.law[k], fit.std[k], 0.0 if k else fit.scatter)
        law, *errors = column([factor * x for x in numbers], factor * fit.std[k])
        rows.append((names[k], f'{law} {unit}', *(
            f'{text} {unit}' if number else ''
            for text, number in zip(errors, numbers[1:], strict=True))))
    rows += [(names[k], 'not identifiable', '', '') for k in fit.not_identifiable]
    console.table(rows, right=True)
    console.table([('mass', 'drops', 'lets go after', 'position', 'velocity'), *(
        (f'{mass:.3g} kg', f'{count}', formatted(released, '.1f', 'ms', milli, 'later'),
         f'{milli * position:.2f} mm', f'{milli * velocity:.1f} mm/s')
        for mass, count, released, position, velocity in result.masses())], right=True)
    speed = max(drop.speed for drop in fit.drops)
    console.paragraph(
        f'From drop to drop, the instant scatters by {milli * fit.scatter:.2f} ms (one sigma); '
        f'at {speed:.2f} m/s, the fastest release, that is {milli * fit.scatter * speed:.1f} '
        'mm along the flight.',
        f'The law leaves {milli * fit.position:.2f} mm of the positions (rms); chi2 per pose: '
        f'{fit.chi2:.3g} (1 if model and noise are right). Standard errors come from the '
        'scatter between drops, and between masses.')
    console.warn(*result.warnings)


def _settings(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Return all parameters, and the parameters set by arguments; outputs are taken out."""
    values = options.read_settings(arguments, 'identifier', console if arguments.release else None)
    if arguments.bags:
        values['bags'] = tuple(map(str, arguments.bags))
    for option, name in OUTPUTS.items() if not arguments.release else ():
        chosen = getattr(arguments, option) or values.get(name, '')
        values[name] = str(chosen)
        setattr(arguments, option, Output(chosen))
    options.require_named_outputs(arguments, options.inputs_of(values))
    return values
