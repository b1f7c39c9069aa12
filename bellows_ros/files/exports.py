"""
Cups for other programs: MuJoCo (MJCF), SDF and C, and the limits of each.

The simulators have a spring with the diagonals of K and P between the tool tip and the package, in
the middle of the cup. These springs have neither the energy (3.17) of the thesis, nor off-diagonal
entries, nor the damper (3.35). The C header (bellows_cup.h, followed by the numbers) is the model
itself.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
import re
from string import Template
import tomllib
from typing import Any, NamedTuple
import zlib

from bellows_ros.core.model import equilibrium, kernels
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package, STANDARD_GRAVITY
from bellows_ros.core.model.grip import cup_of_gripper, Grip
from bellows_ros.errors import BellowsError
import numpy as np

# Fraction of the package's mass and inertia for the tool and for links between single joints; a
# link of SDF without a mass weighs 1 kg.
DUMMY = 1e-3
HEADER = Path(__file__).with_name('bellows_cup.h')
"""The model in C, with placeholders for the numbers."""

DOWN = (0.0, 0.0, -STANDARD_GRAVITY)


class Target(NamedTuple):
    """A format: its writer, and its limitations."""

    name: str
    write: Callable[..., str]
    limits: Sequence[str]
    """Names of sentences about the limitations."""
    whole: bool = False
    """Whether the format has all entries of K and P."""


def limits(target: Target, cup: Cup, gravity: tuple[float, float, float] = DOWN) -> list[str]:
    """Return the limitations of a format: in general, for this cup, for gravity (m/s^2)."""
    gaps = [TABLES['sentences'][name] for name in target.limits]
    if target.whole:
        return gaps
    if target.name == 'SDF' and gravity != DOWN:
        gaps.insert(0, 'Gravity belongs to the world, not to the model: set <gravity>'
                    f'{" ".join(f"{g:.6g}" for g in gravity)}</gravity> in the <world>.')
    for name, matrix in (('K', cup.stiffness), ('P', cup.damping)):
        root = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        coupling = float(np.max(np.abs(matrix - np.diag(np.diag(matrix))) / np.outer(root, root)))
        if coupling > 0.0:
            gaps.insert(0, f'The off-diagonal entries of {name} are left out; the largest couples '
                           f'two axes by {100 * coupling:.2g} %.')
    if any(cup.relaxation):
        gaps.insert(0, 'The relaxation of the rubber is left out: the springs are the static K, '
                    f'and a sudden motion meets {1.0 + sum(cup.relaxation):.3g} times as much.')
    if any(cup.stretch):
        gaps.insert(0, 'The stretch of the cup (cup.stretch) is left out: the springs are as '
                    'stiff in tension as in compression, and bending is as stiff under any load.')
    return gaps


def simulator_model(
    template: str, cup: Cup, package: Package, gravity: tuple[float, float, float] = DOWN, *_: Any
) -> str:
    """
    Return a model for a simulator (XML) from a template, with six joints in the middle of the cup.

    The joints of SDF form a chain with dummy links. Gravity (m/s^2) is part of MJCF alone.
    """
    middle = -cup.length / 2.0
    return Path(__file__).with_name(template).read_text().format(
        K=np.diag(cup.stiffness).tolist(), P=np.diag(cup.damping).tolist(), middle=middle,
        com=(package.com + [0.0, 0.0, middle]).tolist(), mass=package.mass,
        gravity=gravity, inertia=package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist(),
        light=DUMMY * package.mass, moment=DUMMY * float(np.linalg.eigvalsh(package.inertia)[0]))


def header(
    cup: Cup, package: Package, gravity: tuple[float, float, float] = DOWN,
    grip: Grip | None = None, name: str = 'bellows_exported',
) -> str:
    """
    Return a C99 header with the model, and the numbers of this cup and package by their name.

    The model has a separate include guard, so that a program may include several cups; two cups
    with the same name do not compile. Gravity is in the world, m/s^2.

    Raises
    ------
    BellowsError
        If the name is invalid in C.

    """
    if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name):
        raise BellowsError(
            'A name of the export has letters, digits and underscores, beginning with a letter; '
            f"got '{name}'.")
    model = model_tuple(cup, package, gravity)
    numbers = '\n'.join([
        f'static const bellows_model {name} = {_braced((_fields(model[0]), *model[1:]))};',
        *_grip(name, grip, model[0]),
        '/* Longest step of integration, s. */',
        f'static const double {name}_longest = {equilibrium.largest_step(model)!r};'])
    guard = f'BELLOWS_{zlib.crc32(numbers.encode()):08X}'  # different numbers of one name clash
    branches, stretches = model[0][4:], any(cup.stretch)
    defined = ''.join(f'#define BELLOWS_{name} 1\n' for name, is_part in (
        ('RELAXATION', branches), ('STRETCH', stretches)) if is_part)
    return defined + Template(HEADER.read_text()).substitute(
        guard=guard, relaxes=int(bool(branches)), stretches=int(stretches), numbers=numbers)


def _fields(cup: kernels.CupTuple) -> tuple[Any, ...]:
    """Return a cup in the order of bellows_cup, with the coefficients of stretch last."""
    return (*cup[:2], cup[2][:3], *cup[3:], *filter(any, cup[2][3:]))


def _grip(name: str, grip: Grip | None, cup: kernels.CupTuple) -> list[str]:
    """Return the definition of the grip; for a gripper, of one cup, with the places of all."""
    if grip is None:
        return [f'/* There is no {name}_grip: cup.lip_radius and vacuum.holding are not set. */']
    gripper, rest = [], '0, 0, 0'
    if len(grip) > 3:
        places = grip[3][:, :3].tolist()
        gripper = [
            f'static const bellows_cup {name}_one = '
            f'{_braced(_fields(cup_of_gripper(cup, grip[3])))};',
            f'static const bw_vec {name}_places[] = {_braced(tuple(map(tuple, places)))};']
        rest = f'{len(places)}, &{name}_one, {name}_places'
    return [*gripper, f'static const bellows_grip {name}_grip = {{'
            f'{", ".join(map(_braced, grip[:3]))}, {rest}}};']


def _braced(values: Any) -> str:
    """Return nested tuples of numbers as C initialisers; a matrix becomes an array in a struct."""
    if not isinstance(values, tuple):
        return float(values).hex()
    inner = ', '.join(_braced(value) for value in values)
    matrix = len(values) == 9 and not isinstance(values[0], tuple)
    return f'{{{{{inner}}}}}' if matrix else f'{{{inner}}}'


WRITERS: Mapping[str, Callable[..., str]] = {
    'mjcf': partial(simulator_model, 'cup.mjcf'), 'sdf': partial(simulator_model, 'cup.sdf'),
    'c': header}
"""Writers, which take cup, package, gravity, grip and name; the last three are used in C only."""

TABLES = tomllib.loads(Path(__file__).with_name('exports.toml').read_text())
TARGETS: Mapping[str, Target] = {
    name: Target(write=WRITERS[name], **entry) for name, entry in TABLES['formats'].items()}
