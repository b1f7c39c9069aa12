"""The text of `--help` of a node, from the table of parameters; needs no ROS."""

from collections.abc import Sequence
from dataclasses import dataclass
import textwrap

from ..core import parameter_table as table

WIDTH = 96


@dataclass(frozen=True)
class Interface:
    """
    Purpose and connections of a node.

    Parameters
    ----------
    name : str
        Name of the node and of its command.
    purpose : str
        One sentence.
    topics : sequence of (name, type, sentence)
        Topics and services.
    examples : sequence of str
        Command lines.

    """

    name: str
    purpose: str
    topics: Sequence[tuple[str, str, str]]
    examples: Sequence[str]


def help_text(interface: Interface) -> str:
    """Return the text of `--help`: purpose, topics and services, parameters, examples."""
    parts = [
        f'usage: {interface.name} [--help] [--version] [--ros-args ...]\n\n'
        + textwrap.fill(interface.purpose, WIDTH),
        'Start it with:\n' + '\n'.join(f'  {example}' for example in interface.examples),
    ]
    if interface.topics:
        topics = [_entry(f'{name}  [{kind}]', text) for name, kind, text in interface.topics]
        parts.append('Topics and services (relative names; remap with -r FROM:=TO):\n'
                     + '\n'.join(topics))
    parameters = [_parameter(p) for p in table.parameters_of(interface.name)]
    parts.append('Parameters (set with -p NAME:=VALUE or --params-file FILE):\n'
                 + '\n'.join(parameters))
    return '\n\n'.join(parts) + '\n'


def _parameter(parameter: table.Parameter) -> str:
    """Return a parameter's lines: name, kind and unit, default, sentence."""
    if parameter.default is None:
        default = 'must be set'
    elif isinstance(parameter.default, tuple):
        default = f"default: {'thesis cup' if parameter.default else 'none'}"
    else:
        as_yaml = str(parameter.default).lower() if isinstance(parameter.default, bool) else repr(
            parameter.default)
        default = f'default: {as_yaml}'
    fixed = '; cannot change while the node runs' if parameter.read_only else ''
    return _entry(f'{parameter.name}  [{parameter.constraint}; {default}{fixed}]',
                  parameter.description)


def _entry(head: str, text: str) -> str:
    """Return a head and its indented, wrapped sentence."""
    head = textwrap.fill(head, WIDTH, initial_indent='  ', subsequent_indent='    ')
    body = textwrap.fill(text, WIDTH, initial_indent='      ', subsequent_indent='      ')
    return f'{head}\n{body}'
