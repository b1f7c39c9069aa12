"""
Each workflow is one complete job: files in, `bellows_ros.core` in the middle, files out.

Nothing is printed and ROS is not imported, so that commands, nodes and scripts share the work.
Results draw and write themselves. Rarely needed modules are loaded at their first use.
"""

from collections.abc import Callable
from typing import Any, ClassVar

from bellows_ros.core.findings import Finding
from bellows_ros.files import File
from bellows_ros.files.results import write_json
from bellows_ros.report import findings
from bellows_ros.version import __version__


class CommandResult:
    """A result that has `as_json()`."""

    figure: ClassVar[Callable[['CommandResult'], Any]]
    """Function that draws the result, set by `plots`."""

    @property
    def inputs(self) -> tuple[File, ...]:
        """Recordings and plans that the JSON file of a command names with their digests."""
        return ()

    @property
    def succeeded(self) -> bool:
        """Whether the exit code of a command is 0."""
        return True

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Facts on the result."""
        return ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that need attention."""
        return findings.warnings(self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return all numbers by name, SI units, null for unknown values."""
        raise NotImplementedError

    def to_json(self, path: File) -> None:
        """
        Write all numbers as JSON, whole or not at all.

        Raises
        ------
        BellowsError
            If the file cannot be written.

        """
        write_json(path, {**self.as_json(), 'version': __version__})

    def plot(self) -> Any:
        """
        Draw the result.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        BellowsError
            If matplotlib is not installed.

        """
        return self.figure()
