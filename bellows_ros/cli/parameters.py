"""List all parameters, or write a parameter file to fill in."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
import textwrap
from typing import Any

from bellows_ros.core.parameters import checks, conversion
from bellows_ros.core.parameters.table import lookup, Parameter, PARAMETERS
from bellows_ros.files import atomic, mjcf
from bellows_ros.files.parameter_files import format_parameters

from . import options
from .console import Console, WIDTH

SECTION = 'ros__parameters:\n'
INDENT = '    '


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Select the parameters, and print their file, or write the model for MuJoCo."""
    if arguments.mjcf:
        return _mjcf(arguments, console)
    chosen = [p for p in PARAMETERS.values()
              if not arguments.names or p.name.startswith(tuple(arguments.names))]
    for prefix in arguments.names:
        if not any(p.name.startswith(prefix) for p in chosen):
            lookup(prefix)  # raises, and names the nearest
    if arguments.yaml:
        print(template(chosen), end='')
    return options.Outcome([] if arguments.yaml or arguments.json else chosen, content={
        p.name: {**asdict(p), 'constraint': p.constraint} for p in chosen})


def _mjcf(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Write the model for MuJoCo, and warn of the properties that it lacks."""
    settings = checks.resolve(
        options.read_settings(arguments, cup_for=console), checks.PACKAGE_PARAMETERS)
    text, lacking = mjcf.mjcf(conversion.cup_of(settings), conversion.package_of(settings),
                              conversion.gravity_of(settings))
    atomic.write_text(arguments.mjcf, text)
    if lacking:
        console.warn(f'The model lacks {", ".join(lacking)}.')
    return options.Outcome([], content={'file': arguments.mjcf, 'not_expressed': lacking})


def print_result(parameters: list[Parameter], console: Console) -> None:
    """Print the table."""
    for parameter in parameters:
        console.line(parameter.name, 'bold')
        users = ' and '.join(parameter.used_by)
        facts = f'{parameter.constraint}; {parameter.default_text}; {users}'
        for text in (facts, parameter.description):
            for line in textwrap.wrap(
                    text, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT):
                console.line(line)


def template(parameters: Iterable[Parameter]) -> str:
    """
    Return a parameter file with the defaults.

    A parameter without a default, or with an empty list, which ROS files lack, is a comment.
    """
    parameters = list(parameters)
    required = [p for p in parameters if p.default in (None, ())]
    values = {p.name: p.default for p in parameters if p not in required}
    return template_with(required, values, ['Parameters of bellows_ros at their defaults.'])


def template_with(
    required: list[Parameter], values: Mapping[str, Any], header: Sequence[str],
) -> str:
    """Return a parameter file with values; required ones as comments to fill in."""
    text = format_parameters(values, header)
    head, body = text.split(SECTION, 1)
    lines = [f"{INDENT}# SET THESE where they apply: remove the '#', and change the example."]
    for parameter in required:
        comment = f'{INDENT}# '
        lines += textwrap.wrap(
            parameter.description, 97, initial_indent=comment, subsequent_indent=comment)
        unit = f'  # {parameter.unit}' if parameter.unit else ''
        example = parameter.example or parameter.default
        lines.append(f'{INDENT}#{parameter.name}: {example}{unit}')
    to_fill_in = ''.join(f'{line}\n' for line in lines if required)
    return head + SECTION + to_fill_in + (body if values else '')
