"""Write a cup for MuJoCo, as SDF, or as C."""

import argparse

from bellows_ros.core.model import cup_package, grip
from bellows_ros.core.parameters import checks
from bellows_ros.files import atomic, exports

from . import options
from .console import Console, OK


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Write the model, and list what the format cannot express."""
    values = options.read_settings(arguments, cup_for=console)
    settings = checks.resolve(values, checks.PACKAGE_PARAMETERS)
    console.final_warnings += checks.implausible(settings)
    cup, package = cup_package.cup_of(settings), cup_package.package_of(settings)
    target = exports.TARGETS[arguments.to]
    lost = exports.limits(target, cup)
    gravity = tuple(checks.gravity_of(settings).tolist())
    atomic.write_text(arguments.out, target.write(
        cup, package, gravity, grip.grip_of(settings), arguments.name))
    options.write_result(arguments.json, {
        'format': arguments.to, 'file': arguments.out, 'not_expressed': lost})
    console.wrote(arguments.out, arguments.json)
    console.line(f'What differs or is left out in {target.name}:')
    for sentence in lost:
        console.paragraph(f'  - {sentence}')
    return OK
