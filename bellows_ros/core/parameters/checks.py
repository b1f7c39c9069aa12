"""Validation of parameter values against the table, and of the settings of other YAML files."""

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
import difflib
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import TERMS
from bellows_ros.core.parameters import table
from bellows_ros.core.parameters.table import Parameter, Value, ValueKind
from bellows_ros.core.parameters.values import Values
from bellows_ros.errors import BellowsError, NotSetError, shown
import numpy as np
from numpy.typing import ArrayLike

PACKAGE_PARAMETERS = ('package.mass', 'package.inertia', 'package.com')
"""Parameters required by both nodes, without defaults."""

RECORDING_PARAMETERS = ('recording.package_frame', *PACKAGE_PARAMETERS)
"""Parameters required to read a recording."""

MAX_PLACE = 1e3
"""Bound of the metres of a pose: in any cell, larger ones are millimetres."""

WRITTEN_UNIT_TOLERANCE = 1e-3
"""Tolerance of the length of a quaternion written with few digits."""

ESTIMATE = 'estimate'
"""Value of recording.package_world for its estimation."""


POSE_PARAMETERS = ('recording.package_world', 'tool_pose.offset', 'wrench.frame')
"""Parameters that are poses, as strings."""

MIN_VACUUM = 1000.0
"""Smallest vacuum in the correct unit, Pa below ambient."""

MAX_INERTIA_STD = 0.2
"""Largest relative standard deviation that excuses an impossible inertia."""


def validate(name: str, value: object) -> Value:
    """
    Check a value and return it in its normal form.

    Parameters
    ----------
    name : str
        Dotted name of the table.
    value : object
        Value from YAML, ROS or Python; integers are accepted as doubles, arrays may be lists,
        tuples or NumPy arrays, matrices row by row.

    Returns
    -------
    bool, int, float, str, or tuple of float or str

    Raises
    ------
    BellowsError
        If the name is unknown or the value is not allowed, with the reason.

    """
    parameter = table.lookup(name)
    if isinstance(value, np.ndarray | array):
        value = np.ravel(value).tolist()
    if name in POSE_PARAMETERS:
        value = _pose(parameter, value, name == POSE_PARAMETERS[0])
    normal = convert(parameter, value)
    if name in _PHYSICAL:
        _PHYSICAL[name](normal)
    term = _TERMS.get(name)
    if term and term.require:
        term.require(term.from_parameter(normal))
    return normal


def resolve(values: Mapping[str, object], required: Iterable[str] = ()) -> Values:
    """
    Check all values and fill in the defaults.

    Parameters
    ----------
    values : mapping
        Dotted name to value.
    required : names, optional
        Required names without defaults, for example `PACKAGE_PARAMETERS`.

    Returns
    -------
    Values
        Parameters in the table's order; parameters without a default and a given value are
        omitted.

    Raises
    ------
    BellowsError
        For an unknown name, a value that is not allowed, or a required parameter that is missing.

    """
    given = {name: validate(name, value) for name, value in values.items()}
    require(given, required)
    filled = {**{name: p.default for name, p in table.PARAMETERS.items()}, **given}
    return Values({name: value for name, value in filled.items() if value is not None})


def implausible(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a sentence for each allowed but unlikely value of the package or the cup."""
    moments = values['package.inertia'][:3]
    of_package = structure.unit_doubts(values['package.mass'], moments, values['package.com'])
    if max(moments) > (1.0 + structure.INERTIA_ROUNDING) * (sum(moments) - max(moments)):
        of_package = (*of_package, f'{structure.no_body(moments)} The nearest is used.')
    return of_package + structure.cup_doubts(
        structure.matrix(values['cup.stiffness']), values['cup.length'])


def pose_text(pose: Array) -> str:
    """Return position and quaternion (7,) as the text of the parameter recording.package_world."""
    return ' '.join(f'{x:.10g}' for x in pose)


def convert(parameter: Parameter, value: object) -> Value:
    """
    Return a value of a parameter in its normal form, without physical checks.

    Raises
    ------
    BellowsError
        If the value is not of the parameter's kind or not in its range.

    """
    is_list = parameter.kind.endswith('_array')
    if isinstance(value, str) and parameter.kind == 'double_array':
        with suppress(ValueError):  # a list of 0 and 0.5 by `ros2 param set`
            value = [float(part) for part in value.strip('[] ').split(',')]
    if is_list and not isinstance(value, list | tuple):
        raise _refuse(parameter, _got(value))
    items: Any = value if is_list else [value]
    if parameter.length not in (0, len(items)):
        raise _refuse(parameter, f'{len(items)} of them')
    one: Any = _item if parameter.kind in ('bool', 'string', 'string_array') else _number
    if not is_list:
        return one(parameter, value, '')  # type: ignore[no-any-return]
    return tuple(one(parameter, item, f' at index {i}') for i, item in enumerate(items))


def _refuse(parameter: Parameter, got: str) -> BellowsError:
    return BellowsError(
        f'{parameter.name} must be {parameter.constraint}, got {got}. {parameter.description}'
        .rstrip())


def _got(value: object) -> str:
    return f"the text '{shown(value)}'" if isinstance(value, str) else (
        f'{shown(value)} ({type(value).__name__})')


def _pose(parameter: Parameter, value: object, estimated: bool) -> object:
    """Return seven numbers of a list or string as a string; '' and `ESTIMATE` unchanged."""
    parts: Any = value.replace(',', ' ').strip('[] ').split() if isinstance(value, str) else value
    if parts == [] or (estimated and parts == [ESTIMATE]):
        return ''.join(parts)
    try:
        pose = np.array(parts, dtype=np.float64, ndmin=1)
    except (TypeError, ValueError):
        pose = np.empty(0)
    length = float(np.linalg.norm(pose[3:]))
    if pose.shape != (7,) or not (np.abs(pose) < MAX_PLACE).all() or (
            abs(length - 1.0) > WRITTEN_UNIT_TOLERANCE):
        or_estimate = f'or {ESTIMATE}, ' if estimated else ''
        raise BellowsError(
            f"{parameter.name} must be seven numbers 'x y z qx qy qz qw' with a quaternion of "
            f"length 1, {or_estimate}or '', got {shown(value)}. {parameter.description}")
    return pose_text(np.append(pose[:3], pose[3:] / length))


def _item(parameter: Parameter, value: object, where: str) -> bool | str:
    """Return a truth value, or a string: one of the choices if any, without control characters."""
    if parameter.kind == 'bool' and isinstance(value, bool | np.bool_):
        return bool(value)
    if parameter.kind == 'bool' or not isinstance(value, str):
        raise _refuse(parameter, _got(value) + where)
    if any(ord(c) < 32 or ord(c) == 127 for c in value):  # invalid in files, topics and frames
        raise _refuse(parameter, f"a control character in '{shown(value)}'{where}")
    is_needed = where or parameter.required_text
    if (is_needed and not value) or (parameter.choices and value not in parameter.choices):
        raise _refuse(parameter, f"'{shown(value)}'{where}")
    return value


def _number(parameter: Parameter, value: object, where: str) -> int | float:
    """Return a finite number in range, an integer if required; Boolean values are rejected."""
    is_integer = parameter.kind == 'integer'
    kinds = (int, np.integer) if is_integer else (int, float, np.integer, np.floating)
    if isinstance(value, bool) or not isinstance(value, kinds):
        raise _refuse(parameter, _got(value) + where)
    low, high, above = (end if given is None else given for given, end in (
        (parameter.minimum, -math.inf), (parameter.maximum, math.inf),
        (parameter.above, -math.inf)))
    try:
        fits = math.isfinite(value) and low <= value <= high and value > above
    except OverflowError:  # an integer beyond doubles
        fits = False
    if not fits:
        is_large = parameter.unit and (value > high or -value > high)
        unit = f' (is it in {parameter.unit}?)' if is_large else ''
        raise _refuse(parameter, f'{shown(value)}{where}{unit}')
    return int(value) if is_integer else float(value)


def require(values: Mapping[str, object], required: Iterable[str]) -> None:
    """Raise for missing required parameters, in one message with an example."""
    missing = [table.lookup(name) for name in required if name not in values]
    if missing:
        lines = [f'    {p.name}: {p.example}  # ' + (
            f'{p.unit}. {p.description}' if p.unit else p.description) for p in missing]
        names = ', '.join(p.name for p in missing)
        raise NotSetError(
            f'Not set, and without a default: {names}. Set {"them" if missing[1:] else "it"}, or '
            "give a parameter file, which 'bellows info BAG --write-params FILE' writes for a "
            'recording; for example:\n\n/**:\n  ros__parameters:\n' + '\n'.join(lines))


_PHYSICAL: Mapping[str, Callable[[Any], object]] = {
    'package.inertia': lambda value: structure.check_inertia(
        structure.inertia_matrix(value), MAX_INERTIA_STD * np.array(value[:3])),
    'gravity.direction': lambda value: require_direction(value),
    'release.mass_range': lambda value: _require_mass_range(*value),
    'vacuum.holding': lambda value: _require_vacuum(value)}


_TERMS = {term.parameter: term for term in TERMS.values()}


def _require_vacuum(holding: float) -> None:
    """Raise BellowsError for a vacuum (Pa) in another unit."""
    if 0.0 < holding < MIN_VACUUM:
        raise BellowsError(
            f'vacuum.holding is {holding:g} Pa, which holds nothing; expected 0 for unknown, or '
            f'{MIN_VACUUM:g} Pa and more: 0.6 bar, 60 kPa and 600 mbar are 60000 Pa.')


def _require_mass_range(lightest: float, heaviest: float) -> None:
    """Raise BellowsError for masses (kg) that are not a range or two zeros."""
    if (lightest or heaviest) and not 0.0 < lightest <= heaviest:
        raise BellowsError(
            f'release.mass_range is {lightest:g} to {heaviest:g} kg; expected the lightest '
            'package of the drops, and then the heaviest.')


def require_direction(direction: ArrayLike) -> None:
    """Raise BellowsError for a vector (3,) without a direction."""
    if not np.linalg.norm(direction) > 1e-6:
        raise BellowsError(
            'gravity.direction is zero, so that nothing is down. Give the direction in which '
            'things fall, in axes of the world: [0.0, 0.0, -1.0] where z is up.')


Where = Callable[[Sequence[str]], str]

MAX_NUMBER = 1e15
"""Bound of all numbers against overflows of squares and products."""


def is_measured(values: Values) -> bool:
    """Return whether measured.* describes the recorded package: a tag, its own world, a marker."""
    return values.measured.tag_size > 0.0 or (
        values.recording.package_world not in ('', ESTIMATE)) or (
        any(values.measured.offset) and values.get('recording.package_frame') == 'com')


class Settings:
    """
    One block of settings.

    Parameters
    ----------
    values : object
        Mapping of names to values, or to blocks and lists of blocks; None is an empty block.
    path : str
        Path of the block for messages: '' or, for example, 'tool.outliers'.
    where : callable, optional
        Function of the names that lead to a setting; returns the prefix of error messages, such as
        the line. Default: the prefix of the values, if any.

    Raises
    ------
    BellowsError
        If the values are not a mapping of strings.

    """

    def __init__(self, values: object, path: str = '', where: Where | None = None) -> None:
        self.path = path
        self._where: Where = getattr(values, 'where', where or (lambda names: ''))
        values = {} if values is None else values
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            what = f"Setting '{path}'" if path else 'The file'
            raise self.error(
                '', f'{what} must hold names and values, got {shown(repr(values), 60)}.')
        self._values: Mapping[str, object] = values
        self._asked: list[str] = []
        self._blocks: dict[str, Settings] = {}

    def __contains__(self, name: str) -> bool:
        """Return whether a setting is given."""
        return name in self._values

    def name(self, name: str) -> str:
        """Return the full name of a setting of this block."""
        return f'{self.path}.{name}' if self.path else name

    def number(
        self, name: str, default: float | None = None, unit: str = '', **bounds: float
    ) -> float:
        """Return a finite number in bounds (minimum, above, maximum), required without default."""
        return float(self._get(name, default, 'double', unit=unit, **bounds))

    def integer(self, name: str, default: int, minimum: int = 0, **bounds: int) -> int:
        """Return an integer in bounds (minimum, maximum)."""
        return int(self._get(name, default, 'integer', minimum=minimum, **bounds))

    def flag(self, name: str, default: bool) -> bool:
        """Return a truth value."""
        return bool(self._get(name, default, 'bool'))

    def choice(self, name: str, choices: Sequence[str], default: str | None = None) -> str:
        """Return one of several strings."""
        return str(self._get(name, default, 'string', choices=tuple(choices)))

    def vector(
        self, name: str, length: int = 0, default: Sequence[float] | None = None, unit: str = '',
        **bounds: float
    ) -> Array:
        """Return finite numbers, each in bounds; any number of them for a length of 0."""
        return np.array(self._get(
            name, default, 'double_array', unit=unit, length=length, **bounds))

    def block(self, name: str) -> 'Settings':
        """Return a block inside this block, empty if not given."""
        self._asked.append(name)
        return self._inside(name, self._values.get(name))

    def blocks(self, name: str) -> list['Settings']:
        """Return a list of one or more blocks."""
        self._asked.append(name)
        value = self._values.get(name)
        if not isinstance(value, list | tuple) or not value:
            raise self.refuse(name, 'a list of one or more blocks', value)
        return [self._inside(f'{name}[{i}]', item) for i, item in enumerate(value)]

    def _inside(self, name: str, values: object) -> 'Settings':
        """Return a block inside this block, and register the block for `done`."""
        self._blocks[name] = Settings(values, self.name(name), self._where)
        return self._blocks[name]

    def done(self) -> None:
        """
        Raise for settings that have not been read, here and in blocks.

        Raises
        ------
        BellowsError
            The error names the unknown setting and the nearest allowed setting.

        """
        for name in self._values:
            if name not in self._asked:
                similar = difflib.get_close_matches(name, self._asked, n=1, cutoff=0.6)
                hint = f"Did you mean '{self.name(similar[0])}'?" if similar else (
                    f'Known here: {", ".join(dict.fromkeys(self._asked))}.')
                raise self.error(name, f"Unknown setting '{self.name(name)[:200]}'. {hint}")
        for block in self._blocks.values():
            block.done()

    def refuse(self, name: str, expected: str, got: object) -> BellowsError:
        """Return the error for a setting that is not allowed."""
        return self.error(
            name, f"Setting '{self.name(name)}' must be {expected}, got {shown(repr(got), 60)}.")

    def error(self, name: str, message: str) -> BellowsError:
        """Return an error on a setting, with file and line before the message."""
        return BellowsError(self._where(tuple(self.name(name).split('.'))) + message)

    def _get(self, name: str, default: object, kind: ValueKind, **constraint: Any) -> Any:
        """Return a given setting or its default, checked like a parameter."""
        self._asked.append(name)
        value = self._values.get(name, default)
        parameter = Parameter(f"Setting '{self.name(name)}'", kind=kind, **constraint)
        if value is None:
            raise self.error(
                name, f'{parameter.name} is missing; it must be {parameter.constraint}.')
        try:
            normal = convert(parameter, value)
        except BellowsError as error:
            raise self.error(name, str(error)) from None
        if kind in ('double', 'double_array') and np.max(np.abs(normal), initial=0.0) > MAX_NUMBER:
            raise self.refuse(name, f'between {-MAX_NUMBER:g} and {MAX_NUMBER:g}', value)
        return normal
