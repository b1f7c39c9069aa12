"""
The commands and what their command lines take, from `commands.toml`; nothing here loads slowly.

An argument of the table has `name` (with what stands for its values in the help) and `help`, and

- `type`: path, int or float; output, binary or folder of what is written; or switch;
- `repeat`: an option may be repeated, a positional argument may have several values;
- `optional`: its value may be left out;
- what `add_argument` of a parser takes: default, choices, required, dest, nargs.

Instead it may `use` shared arguments, with texts for their placeholders.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
import tomllib
from typing import Any

STDOUT = '-'
"""As of `files.atomic`."""


class Output(str):
    """The name of a text file to write, '-' for stdout; inputs are a Path."""


class Binary(Output):
    """The name of a file to write that is no text."""


class Folder(Binary):
    """The name of a folder to write."""


TYPES = {
    'path': Path, 'int': int, 'float': float, 'output': Output, 'binary': Binary,
    'folder': Folder}

COMMANDS: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name('commands.toml').read_text())
SHARED, PROGRAM = COMMANDS.pop('shared'), COMMANDS.pop('bellows')


def arguments_of(command: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the arguments of a command, each as name and settings for `add_argument`."""
    return [_argument(**entry) for entry in _expanded(COMMANDS[command]['arguments'], {})]


def _expanded(
    entries: Iterable[Mapping[str, Any]], texts: Mapping[str, str]
) -> Iterator[dict[str, Any]]:
    """Yield arguments with texts for their placeholders, shared ones in place of their use."""
    for entry in entries:
        filled = {key: value.format_map(texts) if isinstance(value, str) else value
                  for key, value in entry.items()}
        if 'use' in filled:
            yield from _expanded(SHARED[filled['use']], defaultdict(str, filled))
        else:
            yield filled


def _argument(
    name: str, type: str = '', repeat: bool = False,  # noqa: A002 (named as in the table)
    optional: bool = False, **settings: Any,
) -> tuple[str, dict[str, Any]]:
    """Return name and settings of an argument of the table."""
    word, *metavars = name.split()
    if type == 'switch':
        return word, {**settings, 'action': 'store_true'}
    is_input = type and not issubclass(TYPES[type], Output)
    implied: dict[str, Any] = {'default': None if is_input or optional else ''}
    if type:
        implied['type'] = TYPES[type]
    if metavars:
        implied['metavar'] = metavars[0] if len(metavars) == 1 else tuple(metavars)
    if len(metavars) > 1:
        implied['nargs'] = len(metavars)
    if repeat:
        implied |= {'default': [], **(
            {'action': 'append'} if word.startswith('-') else {'nargs': '*'})}
    if optional:
        implied |= {'nargs': '?', 'const': ''}
    return word, {**implied, **settings}
