"""
One complete job each: files in, `bellows_ros.core` in the middle, files out.

Prints nothing and knows no ROS, so that commands, nodes and scripts share the same work. Results
draw and write themselves. A module is loaded when `workflows.module` is first used: few runs need
all of them.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import Any, TYPE_CHECKING

import bellows_ros
from bellows_ros.errors import require_pictures
from bellows_ros.files import File
from bellows_ros.files.results import write_json

if TYPE_CHECKING:
    from bellows_ros.workflows import (  # noqa: F401
        compare,
        excite,
        identification,
        identify,
        plan,
        registration,
        replay,
        steer,
        structures,
        toss,
        workers,
    )


def __getattr__(name: str) -> Any:
    """Load a module of this room."""
    if find_spec(f'{__name__}.{name}') is None:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return import_module(f'{__name__}.{name}')


class CommandResult:
    """A result that has `as_json()`."""

    def as_json(self) -> dict[str, Any]:
        """Return all figures by name, SI units, null for unknown values."""
        raise NotImplementedError

    def to_json(self, path: File) -> None:
        """
        Write all figures as JSON, whole or not at all.

        Raises
        ------
        BellowsError
            If the file cannot be written.

        """
        write_json(path, {**self.as_json(), 'version': bellows_ros.__version__})

    def plot(self, theme: str = 'light') -> Any:
        """
        Draw the result.

        Parameters
        ----------
        theme : {'light', 'dark'}
            Colours for a light or a dark background.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        BellowsError
            If matplotlib is not installed.

        """
        require_pictures()
        from bellows_ros.plots.pictures import FIGURES  # matplotlib is optional

        return FIGURES[type(self)](self, theme)
