"""
Nested settings from YAML, read one by one, with errors that name the setting.

Every name that is asked for is remembered, so that `Settings.done` can refuse the others.
"""

from collections.abc import Mapping, Sequence
import difflib
import math
from typing import Any

from bellows_ros.core.arrays import Array
from bellows_ros.errors import BellowsError
import numpy as np

LONGEST_SHOWN = 60


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
            raise BellowsError(f'{where} must hold names and values, got {shown(values)}.')
        self._values: Mapping[str, object] = values
        self._asked: list[str] = []

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
        what = _number_message(unit, least, above, most)
        value = self._take(name, default, what)
        if not _is_number(value) or not (least <= value <= most and value > above):
            raise self.refuse(name, what, value)
        return float(value)

    def whole(self, name: str, default: int, least: int = 0, most: int = 2**62) -> int:
        """Return a whole number in a range."""
        what = f'a whole number from {least} to {most}'
        value = self._take(name, default, what)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self.refuse(name, what, value)
        return int(value)

    def flag(self, name: str, default: bool) -> bool:
        """Return a truth value."""
        value = self._take(name, default, 'true or false')
        if not isinstance(value, bool):
            raise self.refuse(name, 'true or false', value)
        return value

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self._take(name, default, 'a text')
        if not isinstance(value, str) or not value or not value.isprintable():
            raise self.refuse(name, 'a text that is not empty', value)
        return value

    def choice(self, name: str, choices: Sequence[str], default: str | None = None) -> str:
        """Return one of some texts."""
        what = 'one of ' + ', '.join(choices)
        value = self._take(name, default, what)
        if not isinstance(value, str) or value not in choices:
            raise self.refuse(name, what, value)
        return value

    def vector(
        self, name: str, length: int, default: Sequence[float] | None = None, unit: str = ''
    ) -> Array:
        """Return so many finite numbers."""
        what = f'a list of {length} numbers' + _in_unit(unit)
        value = self._take(name, default, what)
        if not _is_list(value) or len(value) != length or not all(map(_is_number, value)):
            raise self.refuse(name, what, value)
        return np.array(value, dtype=np.float64)

    def numbers(
        self, name: str, unit: str = '', least: float = -math.inf,
        default: Sequence[float] | None = None,
    ) -> Array:
        """Return finite numbers, each at least the given one; one or more without a default."""
        what = 'a list of numbers' + _in_unit(unit)
        what += f', each at least {least:g}' if math.isfinite(least) else ''
        value = self._take(name, default, what)
        if not _is_list(value) or not (value or default == ()) or not all(map(_is_number, value)):
            raise self.refuse(name, what, value)
        if min(value, default=least) < least:
            raise self.refuse(name, what, value)
        return np.array(value, dtype=np.float64)

    def block(self, name: str) -> 'Settings':
        """Return a block of this one; an empty one when it is not given."""
        self._asked.append(name)
        return Settings(self._values.get(name), self.name(name))

    def blocks(self, name: str) -> list['Settings']:
        """Return a list of one or more blocks."""
        value = self._take(name, None, 'a list of blocks')
        if not _is_list(value) or not value:
            raise self.refuse(name, 'a list of one or more blocks', value)
        return [Settings(item, f'{self.name(name)}[{i}]') for i, item in enumerate(value)]

    def done(self, ignored: Sequence[str] = ()) -> None:
        """
        Refuse settings that nobody asked for, but for those that are ignored.

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

    def refuse(self, name: str, expected: str, got: object) -> BellowsError:
        """Return the error for a setting that is not what it must be."""
        return BellowsError(f"Setting '{self.name(name)}' must be {expected}, got {shown(got)}.")

    def _take(self, name: str, default: object, what: str) -> Any:
        """Return a setting as it is given, or its default."""
        self._asked.append(name)
        value = self._values.get(name, default)
        if value is None:
            raise BellowsError(f"Setting '{self.name(name)}' is missing; it must be {what}.")
        return value


def shown(value: object) -> str:
    """Return a value as messages show it, cut when long."""
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 3] + '...'


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


def _number_message(unit: str, least: float, above: float, most: float) -> str:
    """Return what a number must be, in words."""
    limits = [f'above {above:g}'] if math.isfinite(above) else []
    limits += [f'at least {least:g}'] if math.isfinite(least) else []
    limits += [f'at most {most:g}'] if math.isfinite(most) else []
    return 'a number ' + ' and '.join(limits) + _in_unit(unit) if limits else (
        'a number' + _in_unit(unit)
    )
