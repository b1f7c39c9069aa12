"""Options that commands share, and the settings that come out of them."""

import argparse
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
import re
import signal
import threading
from typing import Any, TYPE_CHECKING

from bellows_ros.errors import BellowsError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from bellows_ros.core.parameters import Parameter, Value

    from .console import Console

STDOUT = '-'
THESIS_CUP = 'cup.stiffness is not set: this is the cup of the thesis, (4.78, 4.79).'


def add_bag_argument(parser: argparse.ArgumentParser) -> None:
    """Add the recording that a command is about."""
    parser.add_argument(
        'bag', metavar='BAG', type=Path,
        help='recording: a rosbag2 folder, or a .mcap or .db3 file',
    )  # fmt: skip


def add_parameter_options(parser: argparse.ArgumentParser) -> None:
    """Add --params and --set."""
    parser.add_argument(
        '--params', metavar='FILE', action='append', default=[], type=Path,
        help='parameter file (YAML, as ROS nodes take it); may be repeated, later ones prevail',
    )  # fmt: skip
    parser.add_argument(
        '--set', metavar='NAME=VALUE', action='append', default=[], dest='overrides',
        help='set one parameter, over those of the files; may be repeated. '
        "All of them, with units and defaults: 'bellows parameters'",
    )  # fmt: skip


def add_json_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add --json."""
    parser.add_argument(
        '--json', metavar='FILE', default='',
        help=f"write {what} as JSON; '-' for stdout (the summary then goes to stderr)",
    )  # fmt: skip


def put_json(target: str, content: 'Mapping[str, Any]', console: 'Console') -> None:
    """Write a result where --json says: to a file, to stdout, or nowhere."""
    from bellows_ros.files.results import format_json, write_json

    if target == STDOUT:
        console.raw(format_json(content))
    elif target:
        write_json(target, content)


def given_parameters(
    files: Sequence[Path], overrides: Sequence[str], node: str | None = None
) -> 'dict[str, Value]':
    """
    Return the parameters of the files and, over them, those of the command line.

    Parameters
    ----------
    files : sequence of Path
        Parameter files; later ones prevail.
    overrides : sequence of str
        'name=value'.
    node : str, optional
        Only what a file holds for this node.

    Raises
    ------
    BellowsError
        If a file cannot be read, or a name or value is not allowed.

    """
    from bellows_ros.files.parameter_files import read_parameters

    values: dict[str, Value] = {}
    for file in files:
        values.update(read_parameters(file, node))
    for override in overrides:
        name, value = parse_override(override)
        values[name] = value
    return values


def parse_override(text: str) -> 'tuple[str, Value]':
    """
    Return name and checked value of 'name=value'.

    Lists are written as in YAML or without brackets: `package.com=[0, 0, -0.03]` or
    `package.com=0,0,-0.03`.

    Raises
    ------
    BellowsError
        If there is no '=', or name or value are not allowed.

    """
    from bellows_ros.core.parameters import lookup, validate

    name, equals, value = (part.strip() for part in text.partition('='))
    if not (name and equals):
        raise BellowsError(
            f"--set takes NAME=VALUE, got '{text}'. For example: --set fit.structure=full"
        )
    try:
        return name, validate(name, _parsed(lookup(name), value))
    except BellowsError as error:
        raise BellowsError(f'--set {name}: {error}') from None


def _parsed(parameter: 'Parameter', text: str) -> object:
    """Return a value in the parameter's kind, or the text itself where it is none."""
    if parameter.kind == 'string':
        return _unquoted(text)
    if parameter.kind == 'string_array':
        return [_unquoted(item.strip()) for item in _inside(text).split(',') if item.strip()]
    if parameter.kind == 'double_array':
        return [_number(item) for item in re.split(r'[,\s]+', _inside(text)) if item]
    if parameter.kind == 'bool':
        return {'true': True, 'false': False}.get(text.lower(), text)
    return _number(text)


def _inside(text: str) -> str:
    """Return a list's items without its brackets."""
    return text.removeprefix('[').removesuffix(']').strip()


def _unquoted(text: str) -> str:
    """Return a text without the quotes that YAML would want."""
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in '\'"'
    return text[1:-1] if quoted else text


def _number(text: str) -> int | float | str:
    """Return a number, or the text itself where it is none."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def require_outputs(*paths: str) -> None:
    """
    Refuse files that cannot be written, before any work; '' and '-' are none.

    Raises
    ------
    BellowsError
        If a folder is missing, something else is in a file's place, or two are the same.

    """
    from bellows_ros.files.atomic import require_file_target

    targets = [require_file_target(path) for path in paths if path not in ('', STDOUT)]
    if len(set(targets)) < len(targets):
        raise BellowsError(f"Two outputs have the same name, '{targets[0]}'. Give another to one.")


@contextmanager
def uninterrupted() -> 'Iterator[None]':
    """Put Ctrl-C off while finished work is written, so that all of it is or nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[Any] = []
    before = signal.signal(signal.SIGINT, lambda *of_signal: asked.append(of_signal))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
