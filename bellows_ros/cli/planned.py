"""Options and order of work shared by the commands on plans."""

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bellows_ros.extras import require_pictures

from . import options
from .console import Console, NOT_USABLE, OK


def add_plan_options(
    parser: argparse.ArgumentParser, numbers: str, picture: str, recording: str = ''
) -> None:
    """Add the options for a plan, its parameters and its outputs."""
    parser.add_argument(
        'plan', metavar='PLAN', type=Path,
        help='a recording with a MultiDOFJointTrajectory, Path or JointTrajectory, with tool '
             'poses, joint states or transforms; a YAML file with such a message or with a '
             'motion for bellows simulate; or a TUM, KITTI or EuRoC file',
    )
    parser.add_argument(
        '--topic', metavar='TOPIC', default='',
        help='topic of the plan, if the recording has several plans')
    options.add_span_options(parser, '0')  # a file may hold the part of another recording
    options.add_arm_options(parser)
    options.add_parameter_options(parser, span=False)
    options.add_json_option(parser, numbers)
    options.add_output(parser, '--plot', f'picture to write: {picture}', options.Binary)
    if recording:
        options.add_output(parser, '--out', f'recording to write: {recording}', options.Folder)
        options.add_force_option(parser)


def run_plan_command(
    arguments: argparse.Namespace, console: Console,
    work: Callable[[Mapping[str, Any], Callable[..., None]], Any],
    print_result: Callable[[Any, Console], None],
    write: Callable[[Any], None] | None = None, film: Callable[[Any], None] | None = None,
    good: Callable[[Any], bool] = lambda result: True,
) -> int:
    """
    Read, work, write, report.

    Parameters
    ----------
    arguments, console
        Of the command.
    work : callable
        From parameters by name and a progress to a `workflows.result.CommandResult`.
    write : callable
        Writes a result as the recording `out`.
    print_result : callable
        Print the result.
    film : callable
        Writes a film of a result as `plot`.
    good : callable
        Whether the answer is yes.

    """
    values = options.cup_parameters(arguments, console)
    if write is not None:
        options.require_free(arguments.out, arguments.force)
    from bellows_ros.plots import style

    if arguments.plot:
        require_pictures()
        style.require_picture(arguments.plot, (*style.PICTURES, *(style.FILMS if film else ())))
    with console.progress() as progress:
        progress('planning')
        result = work(values, progress)
        with options.naming_written() as written:
            if write is not None and arguments.out:
                write(result)
                written += [arguments.out]
            if film and arguments.plot.lower().endswith(style.FILMS):
                film(result)
            elif arguments.plot:
                style.write_figure(arguments.plot, result.plot())
            written += [arguments.plot]
            if arguments.json:
                from bellows_ros import __version__
                from bellows_ros.files.results import provenance

                plans = [arguments.plan] if 'plan' in arguments else []
                options.put_json(arguments.json, {
                    **result.as_json(), 'version': __version__,
                    'provenance': provenance(plans, arguments.params)})
    print_result(result, console)
    console.wrote(*(getattr(arguments, name, '')
                    for name in ('json', 'plot', 'csv', 'urscript', 'out')))
    return OK if good(result) else NOT_USABLE
