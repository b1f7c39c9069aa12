"""`bellows convert`: trajectory files to recordings, and recordings to trajectory files."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bellows_ros.errors import BellowsError

from .commands import OK
from .console import Console
from .options import add_json_option, put_json, require_outputs, STDOUT

if TYPE_CHECKING:
    from bellows_ros.workflows.convert import Conversion

DESCRIPTION = (
    'Make a recording (rosbag2) of Motive CSV exports, TUM or EuRoC trajectories; or write the '
    'poses of a topic of a recording as a TUM file, for evo and other tools.'
)
EXAMPLES = (
    ('bellows convert take.csv --out my_recording',
     'a Motive export: every rigid body becomes a topic'),
    ('bellows convert tool.tum box.tum --topic /tool_arm/pose --topic /package/pose \\\n'
     '      --out my_recording', 'two TUM trajectories, with the topics they get'),
    ('bellows convert bags/validation --topic /package/pose --out package.tum',
     'poses of a recording as text'),
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'sources', metavar='SOURCE', nargs='+', type=Path,
        help='Motive or EuRoC .csv, TUM .tum or .txt; or one recording, to write a TUM file',
    )  # fmt: skip
    parser.add_argument(
        '--out', metavar='NAME', required=True,
        help='recording to make; or, from a recording, a file that ends in .tum or .txt',
    )  # fmt: skip
    parser.add_argument(
        '--topic', metavar='TOPIC', action='append', default=[],
        help='topic of a source, in their order (default: /NAME/pose); of a recording, which '
        'topic to write',
    )  # fmt: skip
    parser.add_argument(
        '--markers', metavar='N', type=int, default=3,
        help='leave out poses of Motive for which fewer markers were seen (default: 3)',
    )  # fmt: skip
    parser.add_argument(
        '--storage', choices=('mcap', 'sqlite3'), default='mcap', help='of the recording made'
    )
    parser.add_argument(
        '--force', action='store_true', help='replace a recording that is there already'
    )
    add_json_option(parser, 'what was converted')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Convert and report."""
    require_outputs(arguments.json)
    from bellows_ros.workflows.convert import TEXT_ENDINGS, to_bag, to_tum

    with console.progress() as progress:
        progress('converting')
        if arguments.out.lower().endswith(TEXT_ENDINGS):
            _require_one(arguments)
            topic = arguments.topic[0] if arguments.topic else ''
            done = to_tum(arguments.sources[0], arguments.out, topic)
        else:
            _require_text(arguments)
            done = to_bag(arguments.sources, arguments.out, arguments.topic, arguments.storage,
                          arguments.markers, arguments.force)  # fmt: skip
    put_json(arguments.json, done.as_json(), console)
    with console.results_to_stderr(arguments.json == STDOUT):
        _say(done, console)
        if not done.out.lower().endswith(TEXT_ENDINGS):
            console.say('Next, see what is in it:')
            console.say(f'  bellows info {done.out} --write-params my_cell.yaml')
    return OK


def _require_one(arguments: argparse.Namespace) -> None:
    """Refuse to write one file from several recordings."""
    if len(arguments.sources) > 1 or len(arguments.topic) > 1:
        raise BellowsError('A TUM file holds one trajectory: give one recording and one --topic.')


def _require_text(arguments: argparse.Namespace) -> None:
    """Say how a recording can be converted, where a recording is to be made of one."""
    for source in arguments.sources:
        if source.is_dir() or source.suffix in ('.mcap', '.db3'):
            raise BellowsError(
                f"'{source}' is a recording already. To write its poses as text, give --out a "
                'name that ends in .tum.'
            )


def _say(done: 'Conversion', console: Console) -> None:
    """Print what was written, and what was left out."""
    console.say(f'Wrote {done.out}', 'bold')
    width = max(len(body.topic) for body in done.bodies)
    for body in done.bodies:
        left = ', '.join(f'{count} {reason}' for reason, count in body.left_out.items())
        console.say(f'  {body.topic:{width}}  {body.poses:6} poses of {body.source}'
                    + (f'; left out: {left}' if left else ''))
    if done.world != 'z_up':
        console.say(f'Its world has y up: set recording.world to {done.world}.')
    for note in done.notes:
        console.warn(note)
