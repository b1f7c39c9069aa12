"""
Replay a recording and show it in the viewer Rerun, or write a file for the viewer.

It shows tool, cup and package (predicted, and measured as an outline), the deflection of the cup,
and the errors. Needs no RViz; needs the extra view.
"""

import argparse

from . import options
from .console import Console, OK

EXAMPLES = (
    ('bellows view bags/validation --params bags/cup.yaml', 'open the viewer'),
    ('bellows view bags/validation --params bags/cup.yaml --out replay.rrd',
     "write a file; 'rerun replay.rrd' opens it on any machine"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    options.add_bag_argument(parser)
    options.add_parameter_options(parser)
    options.add_output(
        parser, '--out', 'write an .rrd file instead of opening the viewer', options.Binary)
    options.add_json_option(parser, 'the scores')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Replay, then show or write."""
    from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
    from bellows_ros.plots.viewer import open_view, require_viewer, write_view
    from bellows_ros.workflows.plot import replayed

    settings = resolve(options.cup_parameters(arguments, console), PACKAGE_PARAMETERS)
    require_viewer(arguments.out)
    with console.progress() as progress:
        shown = replayed(arguments.bag, settings, progress)
        if arguments.out:
            progress('writing')
            write_view(arguments.out, shown, str(arguments.bag))
    options.put_json(arguments.json, shown.live)
    console.wrote(arguments.json)
    console.wrote(arguments.out, then=('Open it with:', f'  rerun {arguments.out}'))
    if not arguments.out:
        open_view(shown, str(arguments.bag))
    return OK
