"""The command `identifier`: the node that identifies a cup from recordings."""

from collections.abc import Callable, Sequence
import sys
from typing import Any

from .command import run
from .help_text import Interface

INTERFACE = Interface(
    name='identifier',
    purpose=(
        'Identify the stiffness and damping of a bellows suction cup from recordings of the '
        'tool arm and the package. The node shows the result as its parameters cup.stiffness '
        'and cup.damping, writes it to output.parameters and output.json, and sets it on the '
        'node named by predictor.'
    ),
    topics=(),
    examples=(
        'identifier --ros-args --params-file identifier.yaml',
        'identifier --ros-args --params-file identifier.yaml -p output.parameters:=cup.yaml',
    ),
)


def _load_node() -> Callable[[], Any]:
    """Import ROS and return the node."""
    from .identifier_node import IdentifierNode

    return IdentifierNode


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the identifier.

    Parameters
    ----------
    args : sequence of str, optional
        Command line behind the command's name; that of the process if left out.

    Returns
    -------
    int
        The exit code.

    """
    return run(INTERFACE, _load_node, args)


if __name__ == '__main__':
    sys.exit(main())
