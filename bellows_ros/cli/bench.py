"""`bellows bench`: measure the speed of this package on this machine."""

import argparse
from pathlib import Path
from typing import Any

from .commands import OK
from .console import Console
from .options import add_json_option, put_json, require_outputs, STDOUT

DESCRIPTION = (
    'Measure this package against what one would use instead, and against a version of its kernel '
    'in C: a step of the model, the live node, a long recording, starting up, many recordings. '
    'Repeated runs take turns; ratios mean more than times.'
)
EXAMPLES = (
    ('bellows bench --json bench.json', 'everything; some twenty minutes on an idle machine'),
    ('bellows bench --only step,startup', 'two of the sections'),
    ('bellows bench --from docs/performance.json --page docs/performance.md',
     'make the tables of the documentation anew from measurements'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_json_option(parser, 'all figures')
    parser.add_argument(
        '--short', action='store_true', help='only see that everything works, in a minute'
    )
    parser.add_argument(
        '--only', metavar='SECTIONS', default='',
        help='step, node, offline, startup, batch; several with commas',
    )  # fmt: skip
    parser.add_argument(
        '--from', metavar='FILE', dest='measured', type=Path, default=None,
        help='do not measure, take the figures of a file that --json has written',
    )  # fmt: skip
    parser.add_argument(
        '--page', metavar='FILE', default='', help='put the tables into a Markdown page'
    )


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Measure, write, show."""
    require_outputs(arguments.json, arguments.page)
    from bellows_ros.bench.tables import columns, missing, tables

    found = _found(arguments, console)
    put_json(arguments.json, found, console)
    if arguments.page:
        _renew(Path(arguments.page), found)
    with console.results_to_stderr(arguments.json == STDOUT):
        for table in tables(found).values():
            head, *lines = columns(table)
            console.say(head, 'bold')
            for line in lines:
                console.say(line)
            console.say()
        for section, why in missing(found).items():
            console.warn(f"Section '{section}' was not measured: {why}")
    return OK


def _found(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Return measurements, new ones or those of a file."""
    if arguments.measured:
        from bellows_ros.errors import BellowsError
        from bellows_ros.files.results import read_json

        found = read_json(arguments.measured)
        if not isinstance(found, dict) or 'machine' not in found:
            raise BellowsError(
                f"'{arguments.measured}' holds no measurements. Make them with 'bellows bench "
                "--json FILE'."
            )
        return found
    from bellows_ros.bench.run import run as measure

    with console.progress() as progress:
        return measure([name for name in arguments.only.split(',') if name],
                       arguments.short, progress)  # fmt: skip


def _renew(page: Path, found: dict[str, Any]) -> None:
    """Put the tables into a page."""
    from bellows_ros.bench.page import renewed
    from bellows_ros.errors import BellowsError
    from bellows_ros.files.atomic import write_text

    try:
        text = page.read_text()
    except OSError as error:
        raise BellowsError(f"Page '{page}' cannot be read: {error.strerror}.") from None
    write_text(page, renewed(text, found))
