"""
Nested settings from YAML, read one by one, with errors that name the setting.

Every name that is asked for is remembered, so that `Settings.done` can refuse the others, also in
the blocks inside.
"""

from collections.abc import Callable, Mapping, Sequence
import difflib
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.parameters.checks import convert
from bellows_ros.core.parameters.table import Kind, Parameter, short
from bellows_ros.errors import BellowsError
import numpy as np

Where = Callable[[Sequence[str]], str]

LARGEST = 1e15
"""Bound of all numbers, which few come near: no square or product of some overflows."""


def _nowhere(_: Sequence[str]) -> str:
    """Return that nothing is known of where a setting stands."""
    return ''


class Settings:
    """
    One block of settings.

    Parameters
    ----------
    values : object
        Mapping of names to values, or to blocks and lists of blocks; None is an empty block.
    path : str
        Where the block stands, for messages: '' or 'tool.outliers', for instance.
    where : callable, optional
        From the names that lead to a setting to what errors on it begin with, as its line; that
        of the values where they have one.

    Raises
    ------
    BellowsError
        If it is not a mapping of strings.

    """

    def __init__(self, values: object, path: str = '', where: Where | None = None) -> None:
        """Check that it is a block."""
        self.path = path
        self._where: Where = getattr(values, 'where', where or _nowhere)
        values = {} if values is None else values
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            what = f"Setting '{path}'" if path else 'The file'
            raise self.error(
                '', f'{what} must hold names and values, got {short(repr(values), 60)}.')
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
        """Return a finite number in bounds (minimum, above, maximum), required if no default."""
        return float(self._take(name, default, 'double', unit=unit, **bounds))

    def whole(self, name: str, default: int, minimum: int = 0, **bounds: int) -> int:
        """Return an integer in bounds (minimum, maximum)."""
        return int(self._take(name, default, 'integer', minimum=minimum, **bounds))

    def flag(self, name: str, default: bool) -> bool:
        """Return a truth value."""
        return bool(self._take(name, default, 'bool'))

    def text(self, name: str, default: str | None = None) -> str:
        """Return a string that is not empty."""
        return str(self._take(name, default, 'string', required_text=True))

    def choice(self, name: str, choices: Sequence[str], default: str | None = None) -> str:
        """Return one of some strings."""
        return str(self._take(name, default, 'string', choices=tuple(choices)))

    def vector(
        self, name: str, length: int, default: Sequence[float] | None = None, unit: str = ''
    ) -> Array:
        """Return so many finite numbers."""
        return np.array(self._take(name, default, 'double_array', unit=unit, length=length))

    def numbers(
        self, name: str, unit: str = '', default: Sequence[float] | None = None, **bounds: float
    ) -> Array:
        """Return finite numbers, each in bounds; one or more without a default."""
        found = np.array(self._take(name, default, 'double_array', unit=unit, **bounds))
        if default is None and not len(found):
            raise self.refuse(name, 'a list of one or more numbers', [])
        return found

    def block(self, name: str) -> 'Settings':
        """Return a block of this one; an empty one when it is not given."""
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
        """Return a block of this one, to be done with it."""
        self._blocks[name] = Settings(values, self.name(name), self._where)
        return self._blocks[name]

    def done(self, ignored: Sequence[str] = ()) -> None:
        """
        Refuse settings that nobody asked for, here and in blocks, but for those ignored.

        Raises
        ------
        BellowsError
            Naming the unknown setting and the nearest known one.

        """
        for name in self._values:
            if name not in self._asked and name not in ignored:
                near = difflib.get_close_matches(name, self._asked, n=1, cutoff=0.6)
                known = ', '.join(dict.fromkeys(self._asked))
                hint = f"Did you mean '{self.name(near[0])}'?" if near else f'Known here: {known}.'
                raise self.error(name, f"Unknown setting '{self.name(name)[:200]}'. {hint}")
        for name, block in self._blocks.items():
            if name not in ignored:
                block.done(ignored)

    def refuse(self, name: str, expected: str, got: object) -> BellowsError:
        """Return the error for a setting that is not what it must be."""
        return self.error(
            name, f"Setting '{self.name(name)}' must be {expected}, got {short(repr(got), 60)}.")

    def error(self, name: str, message: str) -> BellowsError:
        """Return an error on a setting, which begins with where it stands."""
        return BellowsError(self._where(tuple(self.name(name).split('.'))) + message)

    def _take(self, name: str, default: object, kind: Kind, **constraint: Any) -> Any:
        """Return a setting as it is given, or its default, if it is as a parameter would be."""
        self._asked.append(name)
        value = self._values.get(name, default)
        parameter = Parameter(
            f"Setting '{self.name(name)}'", None, used_by=(), kind=kind,
            **{'unit': '', **constraint})
        if value is None:
            raise self.error(
                name, f'{parameter.name} is missing; it must be {parameter.constraint}.')
        try:
            found = convert(parameter, value)
        except BellowsError as error:
            raise self.error(name, str(error)) from None
        if kind in ('double', 'double_array') and np.max(np.abs(found), initial=0.0) > LARGEST:
            raise self.refuse(name, f'between {-LARGEST:g} and {LARGEST:g}', value)
        return found
