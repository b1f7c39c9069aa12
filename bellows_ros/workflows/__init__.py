"""
One complete job each: files in, `bellows_ros.core` in the middle, files out.

Prints nothing and knows no ROS, so that commands, nodes and scripts share the same work. Results
draw and write themselves.
"""

from typing import Any

from bellows_ros.errors import require_pictures
from bellows_ros.files import File
from bellows_ros.files.results import write_json


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
        from bellows_ros import __version__

        write_json(path, {**self.as_json(), 'version': __version__})

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
        from bellows_ros.plots.plan import figure_of  # needs matplotlib, which is optional

        return figure_of(self, theme)
