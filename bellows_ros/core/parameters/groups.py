"""Parameters with one prefix, as attributes; their types are in `groups.pyi`, for mypy."""

from typing import Any

from bellows_ros.errors import NotSetError


class Groups:
    """Parameters with one prefix, as attributes; groups within are attributes, too."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix

    def __getattr__(self, name: str) -> Any:
        """Raise for a parameter without a value."""
        if name.startswith('_'):
            raise AttributeError(name)
        raise NotSetError(f"'{self._prefix}{name}' is not set, and has no default. Set it.")
