"""
The table of all parameters: for both nodes, the parameter files and the command line.

The file `table.toml` has their entries. A 6x6 matrix is 36 numbers, row-major; an inertia is
[ixx, iyy, izz, ixy, ixz, iyz]; units are SI.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
import tomllib
from types import MappingProxyType
from typing import Any, Literal

from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import TERMS
from bellows_ros.errors import BellowsError, shown
import numpy as np

ValueKind = Literal['bool', 'integer', 'double', 'string', 'double_array', 'string_array']
Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

MIN_SIMILARITY = 0.75
"""Smallest similarity (difflib ratio, 0 to 1) of a misspelt name to the correct one."""


@dataclass(frozen=True)
class Parameter:
    """
    One parameter: its meaning, its constraints and its users.

    Parameters
    ----------
    name : str
        Dotted name.
    default : value or None
        Default value, or None for a required parameter.
    unit : str
        SI unit, '' without.
    used_by : tuple of str
        Names of the users: 'identifier', 'predictor'.
    kind : str
        One of bool, integer, double, string, double_array or string_array, as in ROS.
    minimum, maximum : float, optional
        Allowed range, both ends included, of the number or of each number of an array.
    above : float, optional
        Exclusive lower bound of the number.
    choices : tuple of str
        Allowed strings, if not empty.
    length : int
        Length of an array, 0 for any.
    required_text : bool
        Whether the empty string is rejected.
    read_only : bool
        Whether a running node cannot change it.
    example : str
        Example value of a parameter without a default.
    description : str
        Description in one or two sentences.

    """

    name: str
    default: Value | None = None
    unit: str = ''
    used_by: tuple[str, ...] = ('identifier', 'predictor')
    kind: ValueKind = 'string'
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    length: int = 0
    required_text: bool = False
    read_only: bool = False
    example: str = ''
    description: str = ''

    @property
    def constraint(self) -> str:
        """Constraint in words: kind, count, range, choices and unit."""
        is_list, unit = self.kind.endswith('_array'), f' ({self.unit})' if self.unit else ''
        if self.choices:
            return ('a list of some of ' if is_list else 'one of ') + ', '.join(self.choices)
        ends = (('above', self.above), ('at least', self.minimum), ('at most', self.maximum))
        limits = ' and '.join(f'{word} {end:g}' for word, end in ends if end is not None)
        kind = _KIND_MESSAGES[self.kind].format(f'{self.length} ' if self.length else '')
        if not limits:
            return f'{kind}{unit}'
        return f'{kind}, each {limits}{unit}' if is_list else f'{kind}, {limits}{unit}'

    @property
    def default_text(self) -> str:
        """Default in words."""
        default = self.default
        if default is None:
            return 'must be given'
        if isinstance(default, tuple):
            if len(set(default)) < 2:
                return f'default all {default[0]:g}' if default else 'default none'
            name = 'the unit matrix' if self.name == 'release.correlation' else 'from the thesis'
            return f'default {name if len(default) > 6 else list(default)}'
        return f'default {str(default).lower() if isinstance(default, bool) else repr(default)}'


_KIND_MESSAGES: Mapping[ValueKind, str] = {
    'bool': 'true or false', 'integer': 'an integer', 'double': 'a number', 'string': 'a string',
    'double_array': 'a list of {}numbers', 'string_array': 'a list of strings'}


FILE = Path(__file__).with_name('table.toml')

_COMPUTED: Mapping[str, Mapping[str, Any]] = {
    **{term.parameter: {'default': term.default, 'unit': ', '.join(filter(None, term.units))}
       for term in TERMS.values()},
    'release.correlation': {'default': tuple(np.eye(6).ravel().tolist())},
    'fit.structure': {
        'choices': structure.STRUCTURE_NAMES,
        'description': 'Form of K and P: ' + '; '.join([
            f'{structure.AUTO}: axisymmetric_coupled where the coupling is significant, else '
            'axisymmetric',
            *(f'{s.name}: {s.meaning} ({s.size} + {s.size} unknowns)'
              for s in map(structure.structure_named, structure.STRUCTURE_NAMES[1:]))]) + '.'}}
"""Fields that follow from the terms of a cup and the structures of K and P, by parameter; the file
has the others."""


def _parameter(name: str, entry: Mapping[str, Any]) -> Parameter:
    """Return a parameter from its entry in the file; a default, if any, decides on the kind."""
    fields: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in {**entry, **_COMPUTED.get(name, {})}.items()}
    if 'range' in fields:
        fields['minimum'], fields['maximum'] = fields.pop('range')
    default = fields.get('default')
    if 'length' in fields and isinstance(default, float):
        fields['default'] = default = (default,) * fields['length']
    if isinstance(default, tuple):
        kind = 'double_array' if default else 'string_array'
        fields = {'kind': kind, 'length': len(default), **fields}
    elif default is not None:
        fields['kind'] = {bool: 'bool', int: 'integer', float: 'double', str: 'string'}[
            type(default)]
    return Parameter(name, **fields)


PARAMETERS: Mapping[str, Parameter] = MappingProxyType({
    name: _parameter(name, entry) for name, entry in tomllib.loads(FILE.read_text()).items()})


def parameters_for(user: str) -> tuple[Parameter, ...]:
    """Return the parameters of 'identifier' or 'predictor', in the table's order."""
    return tuple(p for p in PARAMETERS.values() if user in p.used_by)


SUCCESSORS: Mapping[str, str] = tomllib.loads(
    Path(__file__).with_name('successors.toml').read_text())
"""What replaces the parameters of earlier versions, by name; a group ends with *."""


def lookup(name: str) -> Parameter:
    """
    Return the parameter with a name.

    Raises
    ------
    BellowsError
        If there is none; the message names the nearest.

    """
    if name in PARAMETERS:
        return PARAMETERS[name]
    for old in (name, f'{name.partition(".")[0]}.*'):
        if old in SUCCESSORS:
            raise BellowsError(f"Parameter '{name}' is of an earlier version: {SUCCESSORS[old]}")
    raise BellowsError(f"Unknown parameter '{shown(name)}'. {_nearest(name[:80])}")


def _nearest(name: str) -> str:
    """Return a hint with the nearest name, the names of the group, or all groups."""
    group, _, leaf = name.rpartition('.')
    known = [other for other in PARAMETERS if other.startswith(f'{name}.')]  # name is a group
    if not known:
        known = [other for other in PARAMETERS if group and other.startswith(f'{group}.')]
        similar = get_close_matches(name, known or PARAMETERS, 1, MIN_SIMILARITY)
        if not (known or similar):  # in another group
            leaves = {other.rpartition('.')[2]: other for other in reversed([*PARAMETERS])}
            similar = [leaves[word] for word in get_close_matches(leaf, leaves, 1, MIN_SIMILARITY)]
        if similar:
            return f"Did you mean '{similar[0]}'?"
    if not known:
        known = [*dict.fromkeys(
            f'{other.partition(".")[0]}.*' for other in PARAMETERS if '.' in other)]
    return f"Known are {', '.join(known)}; 'bellows parameters' lists them all."
