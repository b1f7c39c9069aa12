"""
Run one node as a command: help, start, spin, and an orderly exit.

ROS is imported only to run a node, so that `--help` answers at once, also without ROS. Ctrl-C and
SIGTERM end a node in order, with exit code 0; errors that the user can correct are printed without
a traceback and end with 2.
"""

from collections.abc import Iterator, Sequence
import importlib.util
from itertools import pairwise, takewhile
import os
from pathlib import Path
from pkgutil import resolve_name
import signal
import sys
import textwrap
import tomllib
import traceback
from typing import Any, NoReturn

from bellows_ros.core import configure_process
from bellows_ros.version import __version__

from ..errors import BellowsError, CRASHED, install, NotSetError, shown

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
HELP_WIDTH = 96
NODES = {
    'predictor': 'bellows_ros.nodes.predictor_node:PredictorNode',
    'identifier': 'bellows_ros.nodes.identifier_node:IdentifierNode'}
"""Module and class of each command; the module imports ROS."""


def interface(name: str) -> dict[str, Any]:
    """Return purpose, examples and topics of a node."""
    content = tomllib.loads(Path(__file__).with_name('interface.toml').read_text())
    return dict(content[name])


def help_text(name: str) -> str:
    """Return the text of `--help`: purpose, topics and services, parameters, examples."""
    from ..core.parameters.table import parameters_for

    content = interface(name)
    topics = [(f'{each["name"]}  [{each["type"]}]', each['text'])
              for each in content.get('topics', ())]
    lines = [f'usage: {name} [--help] [--ros-args ...]\n',
             _wrapped(content['purpose']), '\nStart it with:',
             *(f'  {example}' for example in content['examples'])]
    for title, entries in (
            ('Topics and services (relative names; remap with -r FROM:=TO):', topics),
            ('Parameters (set with -p NAME:=VALUE or --params-file FILE):', [
                (f'{p.name}  [{p.constraint}; {p.default_text}'
                 f'{"; cannot change while the node runs" if p.read_only else ""}]',
                 p.description) for p in parameters_for(name)])):
        if entries:
            lines.append(f'\n{title}')
        for head, text in entries:
            lines += [_wrapped(head, '  ', '    '), _wrapped(text, '      ', '      ')]
    return '\n'.join(lines) + '\n'


def _wrapped(text: str, first: str = '', then: str = '') -> str:
    """Return a text in lines, with the beginnings of the first and of all others."""
    return textwrap.fill(text, HELP_WIDTH, initial_indent=first, subsequent_indent=then)


def run(name: str, args: Sequence[str] | None = None, node: str = '') -> int:
    """
    Run a node until it has finished or the process is asked to end.

    Parameters
    ----------
    name : str
        Name of the node and of its command.
    args : sequence of str, optional
        Command line; default: the arguments of this process.
    node : str, optional
        The node's module and class, instead of those in `NODES`. A node has a future `finished`:
        the result of the future ends the process with 0, and its exception is raised here.

    Returns
    -------
    int
        The exit code: 0, 2 for an error that the user can correct, 70 for a defect.

    """
    arguments = list(sys.argv[1:] if args is None else args)
    before_ros = list(takewhile(lambda argument: argument != '--ros-args', arguments))
    configure_process(is_node=True)
    if {'-h', '--help'} & set(before_ros):
        print(help_text(name), end='')
        return 0
    try:
        if before_ros:
            raise BellowsError(
                f"Unknown argument '{shown(before_ros[0])}'. Parameters and remappings follow "
                f'--ros-args, for example: {name} --ros-args --params-file FILE. See '
                f'{name} --help.')
        require_ros()
        _run_node([name, *arguments], node or NODES[name])
    except BellowsError as error:
        causes = list(map(str, _file_errors(name, arguments)))
        if str(error) not in ' '.join(causes):
            causes.append(str(error))
        if isinstance(error, NotSetError):
            causes.append('Give the file with --ros-args --params-file FILE.')
        print(*(f'{name}: {cause}' for cause in causes), sep='\n', file=sys.stderr)
        return error.exit_code
    except Exception as error:  # noqa: BLE001 (all others are defects, whose code is not 1, "no")
        jit: Any = sys.modules.get('bellows_ros.core.geometry.jit')
        if damaged := jit and jit.damage(error):
            print(f'{name}: {damaged}', file=sys.stderr)
            return BellowsError.exit_code
        traceback.print_exc()
        print(f'{name}: This is a defect of bellows_ros {__version__}: please report it, with the '
              'parameters and the lines above.', file=sys.stderr)
        return CRASHED
    return 0


def _file_errors(name: str, arguments: Sequence[str]) -> Iterator[BellowsError]:
    """Yield the errors in parameter files for this node, with file and line, which ROS omits."""
    from ..files.parameter_files import read_parameters

    is_renamed = any('__node:=' in argument for argument in arguments)
    for flag, file in pairwise(arguments):
        if flag == '--params-file' and Path(file).is_file() and not is_renamed:
            try:
                read_parameters(file, name)
            except BellowsError as error:
                yield error


def require_ros() -> None:
    """Raise BellowsError if ROS is missing, before any work."""
    if importlib.util.find_spec('rclpy') is None:
        raise BellowsError(
            "ROS 2 is not installed here (this Python has no 'rclpy'). Source an installation, "
            'for instance `source /opt/ros/jazzy/setup.bash`, or install the wheels: '
            f'{install("ros")}')


def _run_node(argv: Sequence[str], node: str) -> None:
    """
    Create a node and spin it until it has finished, or the process is asked to end.

    Signals are only recorded, because an exception could be raised in any code, also in a callback
    from C. A signal during the creation of the node ends the process at once, as there is nothing
    to close.
    """
    received, created = list[int](), list[Any]()

    def record(number: int, frame: object) -> None:
        received.append(number)
        if not created:
            _exit_at_once()

    handlers = {number: signal.signal(number, record) for number in STOP_SIGNALS}
    try:
        make_node = resolve_name(node)
        import rclpy
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import try_shutdown

        from .guarding import refusals_of_ros, spin

        try:
            with refusals_of_ros('start with these arguments'):
                rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
            created.append(make_node())
            spin(created[0], lambda: bool(received))
        finally:
            try_shutdown()
        if received:
            _exit_at_once()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _exit_at_once() -> NoReturn:
    """End the process without its interpreter, which waits for a compiler in a thread."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def predictor() -> int:
    """Run the node that publishes the pose of the held package."""
    return run('predictor')


def identifier() -> int:
    """Run the node that identifies a cup from recordings."""
    return run('identifier')


if __name__ == '__main__':
    sys.exit(run(sys.argv[1], sys.argv[2:]))
