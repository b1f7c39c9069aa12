"""
Nested settings from YAML, read one by one, with errors that name the setting.

Every name that is asked for is remembered, so that `Settings.done` can refuse the others, also in
the blocks inside.
"""

from collections.abc import Callable, Mapping, Sequence
import difflib
import math
from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.core.parameter_table import short
from bellows_ros.errors import BellowsError
import numpy as np


class Settings:
    """
    One block of settings.

    Parameters
    ----------
    values : object
        Mapping of names to values, or to blocks and lists of blocks; None is an empty block.
    path : str
        Where the block stands, for messages: '' or 'tool.outliers', for instance.

    Raises
    ------
    BellowsError
        If it is not a mapping of texts.

    """

    def __init__(self, values: object, path: str = '') -> None:
        """Check that it is a block."""
        self.path = path
        values = {} if values is None else values
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            where = f"Setting '{path}'" if path else 'A motion file'
            raise BellowsError(f'{where} must hold names and values, got {_shown(values)}.')
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
        self,
        name: str,
        default: float | None = None,
        unit: str = '',
        least: float = -math.inf,
        above: float = -math.inf,
        most: float = math.inf,
    ) -> float:
        """Return a finite number in a range; without a default it must be given."""
        what = f'a number {_limits(least, above, most)}'.rstrip() + _in_unit(unit)
        return float(self._take(name, default, what, lambda x: (
            _is_number(x) and least <= x <= most and x > above)))

    def whole(self, name: str, default: int, least: int = 0, most: int = 2**62) -> int:
        """Return a whole number in a range."""
        what = f'a whole number from {least} to {most}'
        return int(self._take(name, default, what, lambda x: (
            isinstance(x, int) and not isinstance(x, bool) and least <= x <= most)))

    def flag(self, name: str, default: bool) -> bool:
        """Return a truth value."""
        return bool(self._take(
            name, default, 'true or false', lambda x: isinstance(x, bool)))

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        return str(self._take(name, default, 'a text that is not empty', lambda x: (
            isinstance(x, str) and x != '' and x.isprintable())))

    def choice(self, name: str, choices: Sequence[str], default: str | None = None) -> str:
        """Return one of some texts."""
        return str(self._take(
            name, default, 'one of ' + ', '.join(choices), lambda x: x in tuple(choices)))

    def vector(
        self, name: str, length: int, default: Sequence[float] | None = None, unit: str = ''
    ) -> Array:
        """Return so many finite numbers."""
        what = f'a list of {length} numbers' + _in_unit(unit)
        return np.array(self._take(name, default, what, lambda x: (
            _is_list(x) and len(x) == length and all(map(_is_number, x)))), dtype=np.float64)

    def numbers(
        self, name: str, unit: str = '', least: float = -math.inf, most: float = math.inf,
        default: Sequence[float] | None = None,
    ) -> Array:
        """Return finite numbers, each in a range; one or more without a default."""
        limits = _limits(least, -math.inf, most)
        what = 'a list of numbers' + _in_unit(unit) + f', each {limits}' * bool(limits)
        return np.array(self._take(name, default, what, lambda x: (
            _is_list(x) and (len(x) > 0 or default == ())
            and all(_is_number(item) and least <= item <= most for item in x))), dtype=np.float64)

    def block(self, name: str) -> 'Settings':
        """Return a block of this one; an empty one when it is not given."""
        self._asked.append(name)
        return self._inside(name, self._values.get(name))

    def blocks(self, name: str) -> list['Settings']:
        """Return a list of one or more blocks."""
        value = self._take(
            name, None, 'a list of one or more blocks', lambda x: _is_list(x) and len(x) > 0)
        return [self._inside(f'{name}[{i}]', item) for i, item in enumerate(value)]

    def _inside(self, name: str, values: object) -> 'Settings':
        """Return a block of this one, to be done with it."""
        self._blocks[name] = Settings(values, self.name(name))
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
                raise BellowsError(f"Unknown setting '{self.name(name)[:200]}'. {hint}")
        for name, block in self._blocks.items():
            if name not in ignored:
                block.done(ignored)

    def refuse(self, name: str, expected: str, got: object) -> BellowsError:
        """Return the error for a setting that is not what it must be."""
        return BellowsError(f"Setting '{self.name(name)}' must be {expected}, got {_shown(got)}.")

    def _take(
        self, name: str, default: object, what: str, fits: Callable[[Any], bool]
    ) -> Any:
        """Return a setting as it is given, or its default, if it fits."""
        self._asked.append(name)
        value = self._values.get(name, default)
        if value is None:
            raise BellowsError(f"Setting '{self.name(name)}' is missing; it must be {what}.")
        if not fits(value):
            raise self.refuse(name, what, value)
        return value


def _shown(value: object) -> str:
    """Return a value as messages show it, cut when long."""
    return short(repr(value), 60)


def _is_list(value: object) -> bool:
    """Return whether a value is a list."""
    return isinstance(value, list | tuple)


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number that a double can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _in_unit(unit: str) -> str:
    """Return a unit in words."""
    return f' ({unit})' if unit else ''


def _limits(least: float, above: float, most: float) -> str:
    """Return the limits of a number in words; '' for none."""
    return ' and '.join(
        f'{word} {limit:g}'
        for word, limit in (('above', above), ('at least', least), ('at most', most))
        if math.isfinite(limit))
