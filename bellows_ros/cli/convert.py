"""Make recordings from files of Motive or TUM, from joints or from transforms."""

import argparse
import os

from bellows_ros.errors import BellowsError
from bellows_ros.workflows import convert
from bellows_ros.workflows.convert import Conversion

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Convert trajectories to a recording, or a recording to trajectories."""
    span = options.interval_settings(arguments)
    text = arguments.out.lower().endswith(('.tum', '.txt'))
    frames = bool(arguments.tool_frame or arguments.package_frame) and not text
    _require_possible(arguments, text, frames)
    source, topics = arguments.sources[0], arguments.topic
    topic = topics[0] if topics else ''
    console.progress('converting')
    if text:
        done = convert.to_tum(source, arguments.out, topic, span)
        return options.Outcome(done)
    if frames:
        bodies = convert.bodies_in_transforms(
            source, arguments.tool_frame, arguments.package_frame, arguments.world_frame, topics)
    elif _is_of_units(arguments):
        bodies = convert.bodies_in_recording(
            source, topics, arguments.unit == 'mm', arguments.quaternion == 'wxyz')
    elif arguments.tool_link:
        bodies = convert.tool_of_joints(
            source, arguments.tool_link, str(arguments.urdf or ''), topic)
    else:
        bodies = convert.bodies_in_files(arguments.sources, topics, arguments.markers)
    done = convert.to_bag(bodies, arguments.out, arguments.storage, arguments.force, span)
    return options.Outcome(done, then=(
        'Next, check the recording:', f'  bellows info {done.out} --write-params my_cell.yaml'))


def _is_of_units(arguments: argparse.Namespace) -> bool:
    """Return whether poses must be converted to m, and to quaternions with w last."""
    return bool(arguments.unit != 'm' or arguments.quaternion != 'xyzw')


def _require_possible(arguments: argparse.Namespace, text: bool, frames: bool) -> None:
    """Raise for an impossible conversion to a text, of two frames, or to a recording."""
    alone = bool(text or arguments.tool_link) and not frames
    if _is_of_units(arguments):
        if frames or alone or len(arguments.sources) > 1:
            raise BellowsError(
                '--unit and --quaternion convert one recording to another. Leave out --tool-link '
                'and frames, and give --out a name that does not end in .tum.')
        return
    if frames and not (arguments.tool_frame and arguments.package_frame):
        raise BellowsError(
            '--tool-frame and --package-frame go together. Give both; for the tool alone, use '
            '--tool-link.')
    if (frames or alone) and len(arguments.sources) > 1 or alone and len(arguments.topic) > 1:
        raise BellowsError(
            'Only one recording can be converted, and of it one trajectory, unless two frames are '
            'named. Give one, with one --topic.')
    for source in arguments.sources if not (frames or alone) else ():
        if os.path.isdir(source) or source.suffix in ('.mcap', '.db3'):
            raise BellowsError(
                f"'{source}' is already a recording. To write its poses as text, give --out a "
                'name that ends in .tum. To make tool poses from its joints or transforms, name '
                'the link of the tool: --tool-link LINK.')


def print_result(done: Conversion, console: Console) -> None:
    """Print the numbers of converted and of rejected poses."""
    for body in done.bodies:
        rejected = ', '.join(f'{count} {reason}' for reason, count in body.left_out.items())
        console.line(f'{body.topic}: {body.poses} poses of {body.source}'
                     + (f'; left out: {rejected}' if rejected else ''))
    if done.world != 'z_up':
        console.line(f'Its world has y up: set recording.world to {done.world}.')
    console.warn(*done.notes)
