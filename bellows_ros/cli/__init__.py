# PYTHON_ARGCOMPLETE_OK
"""
The command `bellows`: the package from a shell, without ROS.

Finds the command, runs it, and turns errors into a message and an exit code. A command is a module
of this package with its name, whose `run(arguments, console)` does the work and returns an
`options.Outcome`. The module is imported only to run; help and arguments are in `commands.toml`.

An argument of the table has `name` (with placeholders of its values in the help) and `help`, and

- `type`: path, int or float; output, binary or folder of an output; or switch;
- `repeat`: an option may be repeated, a positional argument may have several values;
- `optional`: its value may be left out;
- arguments of `add_argument` of a parser: default, choices, required, dest, nargs.

Instead it may `use` shared arguments, with texts for their placeholders.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
import difflib
import os
from pathlib import Path
import sys
import textwrap
import tomllib
from types import MappingProxyType
from typing import Any, NoReturn

from bellows_ros.core import configure_process
from bellows_ros.errors import shown
from bellows_ros.version import __version__

from .console import Binary, Console, Folder, MAX_TEXT, Output, run_guarded, USER_ERROR, WIDTH

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
    """Yield arguments with texts for their placeholders, and with shared ones expanded."""
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


class Parser(argparse.ArgumentParser):
    """A parser with short errors: the fault, and a pointer to the help."""

    commands: Mapping[str, 'Parser'] = MappingProxyType({})
    """Parsers of the commands; empty in the parser of a command."""

    arguments: tuple[argparse.Action, ...] = ()
    """Arguments in the order in which they were added."""

    def __init__(self, prog: str, description: str, epilog: str) -> None:
        """Wrap the description; the epilog is unchanged."""
        super().__init__(
            prog=prog, epilog=epilog, allow_abbrev=False,
            description=textwrap.fill(' '.join(description.split()), WIDTH),
            formatter_class=argparse.RawDescriptionHelpFormatter)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Reject unknown words here: the parser of the program does not know the options."""
        self._words = list(args or ())
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f'unrecognized arguments: {" ".join(unknown)}')
        return parsed, unknown

    def add_argument(self, *names: Any, **settings: Any) -> argparse.Action:
        """Add an argument, and remember it for corrections and completions."""
        action = super().add_argument(*names, **settings)
        self.arguments = (*self.arguments, action)
        return action

    def print_help(self, file: Any = None) -> None:
        """Print the help; unlike the base class, raise if the stream cannot be written."""
        print(self.format_help(), end='', file=file or sys.stdout, flush=True)

    def error(self, message: str) -> NoReturn:
        """Report the fault of the command line and a likely correction, and exit with 2."""
        known = [*self.commands, *(
            name for action in self.arguments for name in action.option_strings)]
        for word in (word.partition('=')[0] for word in (
                self._words[:1] if self.commands else self._words)):
            matches = difflib.get_close_matches(word, known, n=1)
            if (self.commands or word.startswith('--')) and word not in known and matches:
                kind = 'an option' if word.startswith('-') else 'a command'
                message = f"'{word}' is not {kind}. Did you mean '{matches[0]}'?"
        message = shown(message, MAX_TEXT, '\n')  # words of the command line may be hostile
        self.exit(USER_ERROR, f'{self.prog}: {message}\nSee {self.prog} --help.\n')


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    Parameters
    ----------
    args : sequence of str, optional
        Command line; default: the arguments of this process.

    Returns
    -------
    int
        The exit code, of `console`.

    Raises
    ------
    SystemExit
        After --help, and for a faulty command line.

    """
    return run_guarded(lambda console: _run(sys.argv[1:] if args is None else args, console))


def _run(args: Sequence[str], console: Console) -> int:
    """Run the named command, or handle options of `bellows` itself."""
    program = program_parser()
    if '_ARGCOMPLETE' in os.environ:
        _complete(program)
    if not args:
        program.print_help(sys.stderr)
        return USER_ERROR
    parsed = program.parse_args(args)
    if parsed.version:
        print(f'bellows {__version__}', flush=True)
        return 0
    configure_process()
    from .options import run_command

    return run_command(parsed, console)


def _complete(program: Parser) -> None:
    """Print completions of a command line, which the shell gives in its environment, and end."""
    import argcomplete
    from bellows_ros.core.parameters.table import PARAMETERS

    def assignments(**_: object) -> dict[str, str]:
        return {f'{name}=': parameter.description for name, parameter in PARAMETERS.items()}

    for command in program.commands.values():
        for action in command.arguments:
            if action.dest == 'overrides':
                action.completer = assignments  # type: ignore[attr-defined]
    argcomplete.autocomplete(program)


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the arguments of a command to a parser."""
    for argument, settings in arguments_of(name):
        parser.add_argument(argument, **settings)


def program_parser() -> Parser:
    """Return the parser of the program with the parsers of its commands."""
    width = max(map(len, COMMANDS))
    listed = '\n'.join(f'  {name:{width}}  {entry["does"]}' for name, entry in COMMANDS.items())
    program = Parser('bellows', PROGRAM['text'], PROGRAM['ends'].format(
        commands=listed, exit_codes=PROGRAM['exit_codes']))
    program.add_argument('--version', action='store_true', help='print the version and exit')
    commands = program.add_subparsers(dest='command', metavar='COMMAND', help=argparse.SUPPRESS)
    program.usage = 'bellows COMMAND [ARGUMENTS]'
    for name, entry in COMMANDS.items():
        examples = '\n'.join(
            f'  {each["line"]}\n      {each["what"]}' for each in entry['examples'])
        code_1 = f'1 if {entry["negative"]}, ' if 'negative' in entry else ''
        ends = textwrap.fill(f'Exit code 0 when done, {code_1}2 on an error.', WIDTH)
        add_arguments(commands.add_parser(
            name, help=entry['does'], description=entry['text'],
            epilog=f'examples:\n{examples}\n\n{ends}'), name)
    program.commands = commands.choices
    return program
