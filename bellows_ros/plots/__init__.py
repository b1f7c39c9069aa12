"""Pictures, made with matplotlib (extra `plot`)."""

from typing import Any

from bellows_ros.errors import require_pictures
from bellows_ros.workflows import CommandResult


def figure_of(result: CommandResult, theme: str) -> Any:
    """Draw a result; the pictures are loaded at the first use."""
    require_pictures()
    from bellows_ros.plots.pictures import FIGURES

    return FIGURES[type(result)](result, theme)


CommandResult.figure = figure_of
