"""`bellows completion`: print a script that completes commands, options and parameters."""

import argparse
import importlib
import os
from pathlib import Path

from .app import COMMANDS
from .console import Console, OK

DESCRIPTION = (
    'Print a script for bash or zsh that completes commands, options, files, and the names of '
    'parameters after --set.'
)
EXAMPLES = (
    ('source <(bellows completion)', 'complete in this shell'),
    ('bellows completion bash > ~/.local/share/bash-completion/completions/bellows',
     'complete in every bash'),
    ('bellows completion zsh > ~/.zfunc/_bellows',
     'complete in every zsh; needs fpath+=~/.zfunc before compinit in ~/.zshrc'),
)

BASH = """# Completion of bellows {version} for bash; made by 'bellows completion bash'.
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
BASH_OPTIONS = '        {name}) words="{options}" ;;\n'
BASH_CHOICES = """        "{name} {before}") if [[ $word != -* ]]; then
            COMPREPLY=($(compgen -W "{words}" -- "$word")); return; fi ;;
"""

ZSH = """#compdef bellows
# Completion of bellows {version} for zsh; made by 'bellows completion zsh'.
_bellows() {{
    local word=$words[CURRENT] before=$words[CURRENT-1]
    local -a found
    if (( CURRENT == 2 )); then
        found=({described})
        _describe command found
        return
    fi
    if [[ $before == --set ]]; then
        compadd -S = -- {parameters}
        return
    fi
    case "$words[2] $before" in
{choices}    esac
    case $words[2] in
{options}    esac
    if [[ $word == -* ]]; then
        _describe -o option found
    elif [[ $words[CURRENT-2] != --set ]]; then
        _files
    fi
}}
if [[ $funcstack[1] == _bellows ]]; then _bellows "$@"; else compdef _bellows bellows; fi
"""
ZSH_OPTIONS = '        {name}) found=({described}) ;;\n'
ZSH_CHOICES = """        "{name} {before}") if [[ $word != -* ]]; then
            compadd -- {words}; return; fi ;;
"""

SHELLS = {'bash': (BASH, BASH_OPTIONS, BASH_CHOICES), 'zsh': (ZSH, ZSH_OPTIONS, ZSH_CHOICES)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'shell', nargs='?', choices=SHELLS,
        help='which shell (default: that of $SHELL, or bash)')


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Print the script."""
    own = Path(os.environ.get('SHELL', '')).name
    console.raw(script(arguments.shell or (own if own in SHELLS else 'bash')))
    return OK


def script(shell: str) -> str:
    """Return the script for a shell."""
    from bellows_ros import __version__
    from bellows_ros.core.parameters import PARAMETERS

    whole, of_command, of_choice = SHELLS[shell]
    options, choices = [], []
    for name in COMMANDS:
        parser = argparse.ArgumentParser()
        importlib.import_module(f'{__package__}.{name}').add_arguments(parser)
        found = [(option, action.help or '') for action in parser._actions
                 for option in action.option_strings if option.startswith('--')]
        options.append(of_command.format(
            name=name, options=' '.join(option for option, _ in found),
            described=' '.join(_described(*each) for each in found)))
        for action in parser._actions:
            words = ' '.join(map(str, action.choices or ()))
            for before in (action.option_strings or [name]) if words else ():
                choices.append(of_choice.format(name=name, before=before, words=words))
    return whole.format(
        version=__version__, commands=' '.join(COMMANDS), parameters=' '.join(PARAMETERS),
        described=' '.join(_described(name, text) for name, text in COMMANDS.items()),
        options=''.join(options), choices=''.join(choices))


def _described(name: str, text: str) -> str:
    """Return a word and its description, quoted for zsh."""
    quoted = f'{name}:{text}'.replace('%%', '%').replace("'", "'\\''")
    return f"'{quoted}'"
