"""
Find the command, run it, and turn errors into a message and an exit code.

A command is a module of this package with its name, whose `run(arguments, console)` does
the work and returns an `options.Outcome`. It is imported only to run; its help is in
`commands.toml`.
"""

import argparse
from collections.abc import Sequence
import difflib
import os
import sys
import textwrap
from typing import Any, NoReturn

from bellows_ros.core import configure_process

from .arguments import arguments_of, COMMANDS, PROGRAM
from .console import Console, run_guarded, USER_ERROR

WIDTH = 79


class Parser(argparse.ArgumentParser):
    """A parser with short errors: what is wrong, and where to find help."""

    def __init__(self, prog: str, text: str, epilog: str, **options: Any) -> None:
        """Wrap the description; the epilog stays as it is."""
        super().__init__(
            prog=prog, epilog=epilog, allow_abbrev=False,
            description=textwrap.fill(' '.join(text.split()), WIDTH),
            formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Keep the words, to find the option that was meant."""
        self._words = list(args or ())
        return super().parse_known_args(args, namespace)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print help or an error; unlike the base class, raise where that cannot be written."""
        print(message, end='', file=file or sys.stderr, flush=True)

    def error(self, message: str) -> NoReturn:
        """Report what is wrong with the command line, and exit with 2."""
        options = self._option_string_actions
        for word in (word.partition('=')[0] for word in self._words):
            matches = difflib.get_close_matches(word, options, n=1)
            if word.startswith('--') and word not in options and matches:
                message = f"'{word}' is not an option. Did you mean '{matches[0]}'?"
        self.exit(USER_ERROR, f'{self.prog}: {message}\nSee {self.prog} --help.\n')


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    Parameters
    ----------
    args : sequence of str, optional
        Command line behind the command's name; that of the process if left out.

    Returns
    -------
    int
        The exit code, of `console`.

    Raises
    ------
    SystemExit
        After --help and --version, and when the command line itself is wrong.

    """
    if '_ARGCOMPLETE' in os.environ:
        _complete()
    arguments = list(sys.argv[1:] if args is None else args)
    return run_guarded(lambda console: _run(arguments, console))


def _run(arguments: list[str], console: Console) -> int:
    """Run the named command, or answer for `bellows` itself."""
    if not arguments or arguments[0] not in COMMANDS:
        _answer(arguments)
    name, *rest = arguments
    configure_process()
    parsed = command_parser(name).parse_args(rest)
    from .options import run_command

    return run_command(name, parsed, console)


def _complete() -> None:
    """Print what can follow a command line, which the shell gives in its environment, and end."""
    import argcomplete
    from bellows_ros.core.parameters.table import PARAMETERS

    def assignments(**_: object) -> dict[str, str]:
        return {f'{name}=': parameter.description for name, parameter in PARAMETERS.items()}

    parser = argparse.ArgumentParser('bellows')
    commands = parser.add_subparsers()
    for name, entry in COMMANDS.items():
        command = commands.add_parser(name, help=entry['does'])
        add_arguments(command, name)
        for action in command._actions:
            if action.dest == 'overrides':
                action.completer = assignments  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)


def _answer(arguments: list[str]) -> NoReturn:
    """Answer --help and --version, and refuse an unknown command."""
    width = max(map(len, COMMANDS))
    commands = '\n'.join(f'  {name:{width}}  {entry["does"]}' for name, entry in COMMANDS.items())
    ends = PROGRAM['ends'].format(commands=commands, exit_codes=PROGRAM['exit_codes'])
    parser = Parser('bellows', PROGRAM['text'], ends, usage='bellows COMMAND [ARGUMENTS]')
    parser.add_argument('--version', action='store_true', help='print the version and exit')
    if not arguments:
        parser.print_help(sys.stderr)
        sys.exit(USER_ERROR)
    if parser.parse_known_args(arguments[:1])[0].version:
        from bellows_ros import __version__
        print(f'bellows {__version__}', flush=True)
        sys.exit(0)
    first = arguments[0]
    matches = difflib.get_close_matches(first, COMMANDS, n=1)
    hint = f"Did you mean '{matches[0]}'?" if matches else f'There are: {", ".join(COMMANDS)}.'
    parser.error(f"'{first}' is not a command. {hint}")


def add_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the arguments of a command to a parser."""
    for argument, settings in arguments_of(name):
        parser.add_argument(argument, **settings)


def command_parser(name: str) -> Parser:
    """Return the parser of a command."""
    entry = COMMANDS[name]
    examples = '\n'.join(f'  {each["line"]}\n      {each["what"]}' for each in entry['examples'])
    negative = entry.get('negative')
    ends = textwrap.fill(
        f'Exit code 0 when done, {f"1 if {negative}, " if negative else ""}2 on an error.', WIDTH)
    parser = Parser(f'bellows {name}', entry['text'], f'examples:\n{examples}\n\n{ends}')
    add_arguments(parser, name)
    return parser
