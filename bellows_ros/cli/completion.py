"""
Print a script for bash or zsh that completes what is typed after bellows.

It completes commands, options, files, and the names of parameters after --set.
"""

import argparse
from collections.abc import Mapping
import os
from pathlib import Path

from .app import command_parser, COMMANDS
from .console import Console, OK

EXAMPLES = (
    ('source <(bellows completion)', 'complete in this shell'),
    ('bellows completion bash > ~/.local/share/bash-completion/completions/bellows',
     'complete in every bash'),
    ('bellows completion zsh > ~/.zfunc/_bellows',
     'complete in every zsh; needs fpath+=~/.zfunc before compinit in ~/.zshrc'),
)

SHELLS = {
    'bash': """# Completion of bellows for bash; made by 'bellows completion bash'.
_bellows() {
    local word=${COMP_WORDS[COMP_CWORD]} IFS=$'\\n'
    COMPREPLY=($("$1" completion bash "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
    COMPREPLY=("${COMPREPLY[@]%%:*}")
    if [[ ${COMPREPLY[0]} == *= ]]; then compopt -o nospace 2>/dev/null; fi
    if [[ ! ${COMPREPLY[0]} ]]; then COMPREPLY=($(compgen -f -- "$word")); fi
}
complete -o filenames -F _bellows bellows
""",
    'zsh': """#compdef bellows
# Completion of bellows for zsh; made by 'bellows completion zsh'.
_bellows() {
    local -a found
    found=(${(f)"$($words[1] completion zsh "${(@)words[2,CURRENT]}" 2>/dev/null)"})
    if [[ ${found[1]%%:*} == *= ]]; then
        _describe parameter found -S ''
    elif (( $#found )); then
        _describe bellows found
    else
        _files
    fi
}
if [[ $funcstack[1] == _bellows ]]; then _bellows "$@"; else compdef _bellows bellows; fi
""",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'shell', nargs='?', choices=SHELLS,
        help='which shell (default: that of $SHELL, or bash)')
    parser.add_argument(
        'words', metavar='WORD', nargs=argparse.REMAINDER,
        help='print what can follow on a command line, as the scripts ask')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Print the script, or what it asks for."""
    if arguments.words:
        for name, text in offers(arguments.words).items():
            if name.startswith(arguments.words[-1]):
                console.say(f'{name}:{text.replace("%%", "%")}')
        return OK
    own = Path(os.environ.get('SHELL', '')).name
    print(SHELLS[arguments.shell or (own if own in SHELLS else 'bash')], end='')
    return OK


def offers(words: list[str]) -> Mapping[str, str]:
    """Return what can stand for the last of some words, with descriptions; {} for files."""
    command, *between, word = ['', *words] if len(words) == 1 else words
    if not command:
        return {**COMMANDS, '--help': 'show the help', '--version': 'show the version'}
    if command not in COMMANDS:
        return {}
    if '--set' in between[-1:]:
        from bellows_ros.core.parameters.table import PARAMETERS

        return {f'{name}=': each.description for name, each in PARAMETERS.items()}
    parser = command_parser(command)
    if word.startswith('-'):
        return {name: action.help or '' for action in parser._actions
                for name in action.option_strings if name.startswith('--')}
    asked = parser._option_string_actions.get(between[-1] if between else '')
    return {str(choice): '' for action in ([asked] if asked else parser._actions)
            if action.choices and (asked or not action.option_strings)
            for choice in action.choices}
