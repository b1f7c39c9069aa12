"""`bellows completion`: a script that lets the shell complete commands, options and parameters."""

import argparse
from collections.abc import Iterator
import importlib

from .commands import COMMANDS, OK
from .console import Console

DESCRIPTION = (
    'Print a script for bash (zsh takes it with bashcompinit) that completes commands, options, '
    'files, and the names of parameters behind --set.'
)
EXAMPLES = (
    ('bellows completion > ~/.local/share/bash-completion/completions/bellows',
     'complete in all shells from now on'),
    ('source <(bellows completion)', 'complete in this shell'),
)  # fmt: skip

SCRIPT = """# Completion of bellows {version} for bash; made by 'bellows completion'.
_bellows() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} words=
    local before2=${{COMP_WORDS[COMP_CWORD-2]}}
    compopt +o nospace 2>/dev/null
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "{commands} --help --version" -- "$word"))
        return
    fi
    case $before in
        --set)
            compopt -o nospace 2>/dev/null
            COMPREPLY=($(compgen -S = -W "{parameters}" -- "$word"))
            return ;;
    esac
    case "${{COMP_WORDS[1]}} $before" in
{choices}    esac
    case ${{COMP_WORDS[1]}} in
{options}    esac
    case $word in
        -*) COMPREPLY=($(compgen -W "$words" -- "$word")) ;;
        *) [ "$before2" != --set ] && COMPREPLY=($(compgen -f -- "$word")) ;;
    esac
}}
complete -o filenames -F _bellows bellows
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'shell', nargs='?', choices=('bash',), default='bash', help='which shell (default: bash)'
    )


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Print the script."""
    console.raw(script())
    return OK


def script() -> str:
    """Return the script for bash."""
    from bellows_ros import __version__
    from bellows_ros.core.parameters import PARAMETERS

    actions = {name: list(_actions(name)) for name in COMMANDS}
    return SCRIPT.format(
        version=__version__,
        commands=' '.join(COMMANDS),
        parameters=' '.join(PARAMETERS),
        choices=''.join(_choices(name, found) for name, found in actions.items()),
        options=''.join(_options(name, found) for name, found in actions.items()),
    )


def _actions(name: str) -> Iterator[argparse.Action]:
    """Yield the options and arguments of a command."""
    parser = argparse.ArgumentParser()
    importlib.import_module(f'{__package__}.{name}').add_arguments(parser)
    yield from parser._actions


def _options(name: str, actions: list[argparse.Action]) -> str:
    """Return the line with all options of a command."""
    words = [option for action in actions for option in action.option_strings if option != '-h']
    return f'        {name}) words="{" ".join(words)}" ;;\n'


def _choices(name: str, actions: list[argparse.Action]) -> str:
    """Return a line for each option or first argument of a command that knows all its values."""
    lines = ''
    for action in actions:
        words = ' '.join(map(str, action.choices or ()))
        for before in (action.option_strings or [name]) if words else ():
            lines += (f'        "{name} {before}") if [[ $word != -* ]]; then '
                      f'COMPREPLY=($(compgen -W "{words}" -- "$word")); return; fi ;;\n')
    return lines
