"""Values of parameters, read by attribute: `values.package.mass`; mypy finds wrong names."""

from collections.abc import Iterator, Mapping
from typing import Any

from bellows_ros.core.parameters.groups import Groups


class Values(Groups, Mapping[str, Any]):
    """
    Immutable values of parameters, by dotted name or by attribute.

    A parameter without a value is not a key, and raises `NotSetError` as an attribute.

    Parameters
    ----------
    items : mapping
        Checked values by dotted name, as `checks.resolve` returns them.

    """

    def __init__(self, items: Mapping[str, Any]) -> None:
        super().__init__('')
        self._items = dict(items)
        for name, value in self._items.items():
            *prefixes, leaf = name.split('.')
            group: Any = self
            for prefix in prefixes:
                group = vars(group).setdefault(prefix, Groups(f'{group._prefix}{prefix}.'))
            vars(group)[leaf] = value

    def __getitem__(self, name: str) -> Any:
        """Return the value of a dotted name."""
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def replaced(self, items: Mapping[str, Any]) -> 'Values':
        """Return a copy with other values of some names."""
        return Values({**self._items, **items})
