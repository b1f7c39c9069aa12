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


def main(args: Sequence[str] | None = None) -> int:
    """Run the identifier with a command line, or that of the process; return the exit code."""
    def load_node() -> Callable[[], Any]:
        from .identifier_node import IdentifierNode  # late: imports ROS

        return IdentifierNode

    return run(INTERFACE, load_node, args)


if __name__ == '__main__':
    sys.exit(main())
