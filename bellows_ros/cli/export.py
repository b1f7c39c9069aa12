"""Write a cup for MuJoCo, as SDF, or as C."""

import argparse
from collections.abc import Sequence

from bellows_ros.core.parameters import checks, conversion
from bellows_ros.files import atomic, exports

from . import options
from .console import Console


def run(arguments: argparse.Namespace, console: Console) -> options.Outcome:
    """Write the model, and list the limitations of the format."""
    values = options.read_settings(arguments, cup_for=console)
    settings = checks.resolve(values, checks.PACKAGE_PARAMETERS)
    cup, package = conversion.cup_of(settings), conversion.package_of(settings)
    target = exports.TARGETS[arguments.to]
    x, y, z = conversion.gravity_of(settings).tolist()
    missing = exports.limits(target, cup, (x, y, z))
    atomic.write_text(arguments.out, target.write(
        cup, package, (x, y, z), conversion.grip_of(settings), arguments.name))

    return options.Outcome((target.name, missing), content={
        'format': arguments.to, 'file': arguments.out, 'not_expressed': missing})


def print_result(missing: tuple[str, Sequence[str]], console: Console) -> None:
    """Print the name of the format, and its limitations."""
    console.line(f'What differs or is left out in {missing[0]}:')
    console.paragraph(*(f'  - {sentence}' for sentence in missing[1]))
