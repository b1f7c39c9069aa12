"""Identify a cup's stiffness and damping from recordings."""

import argparse
from typing import Any, TYPE_CHECKING

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.errors import BellowsError
from bellows_ros.report import column, formatted, in_milli, listed, many, print_identification
from bellows_ros.workflows.identification import save
from bellows_ros.workflows.identify import identify

from . import options
from .arguments import STDOUT
from .console import Console, NOT_USABLE, OK

if TYPE_CHECKING:
    from bellows_ros.workflows.toss import ReleaseResult


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Identify, write, report."""
    settings = _settings(arguments, console)
    cup_file, json_file, page = (
        str(settings.get(f'output.{name}', '')) for name in ('parameters', 'json', 'report'))
    options.require_outputs((cup_file, json_file, page), options.inputs_of(settings))
    if arguments.release:
        return _release(arguments, settings, console)

    if not COMPILED and settings.get('fit.method', 'output_error') == 'output_error':
        console.warn(
            'numba is not installed, and without it the fit takes about half a minute for each '
            'second recorded. Install numba, or set fit.method: least_squares.')
    with console.progress() as progress:
        result = identify(settings, progress, arguments.params, arguments.jobs, arguments.dask,
                          arguments.force)
    usable = not result.refusals
    written = usable or (arguments.force and result.fit.usable)
    save(result, cup_file if written else '', json_file, arguments.force)
    if page:
        from bellows_ros.report.build import write_page

        write_page(result, page)
    if STDOUT in (cup_file, json_file, page):
        console.keep_stdout_free()
    print_identification(result, console)
    console.line()
    console.wrote(json_file, page)
    if not usable:
        file_state = f'its file was {"written because of --force" if written else "not written"}'
        console.paragraph(
            f'This cup is refused: {file_state if cup_file else "do not use it"}.', style='red')
    elif cup_file:
        console.wrote(cup_file, then=(
            'Next, check how well it predicts another recording:',
            '  bellows replay BAG ' + ' '.join(
                f'--params {file}' for file in (*arguments.params, cup_file))))
    else:
        console.line('The cup was not written to a file; give --out cup.yaml to keep it.')
    return OK if usable else NOT_USABLE


def _release(arguments: argparse.Namespace, settings: dict[str, Any], console: Console) -> int:
    """Identify the valve, write, report."""
    if excluded := [
            f'--{name}' for name in ('report', 'jobs', 'dask') if getattr(arguments, name)]:
        raise BellowsError(
            f'--release cannot be combined with {", ".join(excluded)}. Leave it out.')
    from bellows_ros.files.parameter_files import write_parameters
    from bellows_ros.files.results import provenance
    from bellows_ros.workflows.toss import identify_release

    with console.progress() as progress:
        result = identify_release(settings, progress)
    if arguments.out:
        write_parameters(arguments.out, result.parameters())
    options.write_result(arguments.json, {
        **result.as_json(), 'provenance': provenance(result.bags, arguments.params)})
    _print_release(result, console)
    console.wrote(arguments.out, arguments.json)
    return OK


def _print_release(result: 'ReleaseResult', console: Console) -> None:
    """Print the law with its errors, and how it explains the drops of each mass."""
    from bellows_ros.workflows.toss import RELEASE_UNITS

    fit, milli, names = result.fit, 1e3, list(RELEASE_UNITS)
    console.line(
        f'Release identified from {many(len(fit.drops), "drop")} in {listed(result.bags)}', 'bold')
    rows: list[tuple[str, ...]] = [('', '', 'standard error', 'scatter')]
    for k in fit.free:
        factor, unit = in_milli(RELEASE_UNITS[names[k]])
        numbers = (fit.law[k], fit.std[k], fit.scatter[k])
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
        f'From drop to drop, the instant scatters by {milli * fit.scatter[0]:.2f} ms (one sigma); '
        f'at {speed:.2f} m/s, the fastest release, that is {milli * fit.scatter[0] * speed:.1f} '
        'mm along the flight.',
        f'The law leaves {milli * fit.position:.2f} mm of the positions (rms); chi2 per pose: '
        f'{fit.chi2:.3g} (1 if model and noise are right). {milli * fit.common:.2f} mm of it is '
        f'alike in all drops of a mass, {fit.lack:.3g} times the mean square that their scatter '
        'explains; the standard errors include it.')
    console.warn(*result.warnings)


def _settings(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Return the parameters of files and --set, with those that have an argument."""
    values = options.read_settings(arguments, 'identifier', console if arguments.release else None)
    named = {
        'bags': [str(bag) for bag in arguments.bags], 'output.parameters': str(arguments.out),
        'output.json': str(arguments.json), 'output.report': str(arguments.report)}
    return {**values, **{name: value for name, value in named.items() if value}}
