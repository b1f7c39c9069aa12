"""The command `identifier`: the node that identifies a cup from recordings."""

from collections.abc import Sequence
import sys

from .command import Interface, run

INTERFACE = Interface(
    name='identifier',
    purpose=(
        'Identify the stiffness and damping of a bellows suction cup from recordings of the '
        'tool arm and the package. The node shows the result as its parameters cup.stiffness '
        'and cup.damping, writes it to output.parameters and output.json, and sets it on the '
        'node named by predictor.'),
    examples=(
        'identifier --ros-args --params-file identifier.yaml',
        'identifier --ros-args --params-file identifier.yaml -p output.parameters:=cup.yaml'))


def main(args: Sequence[str] | None = None) -> int:
    """Run the identifier with a command line, or that of the process; return the exit code."""
    return run(INTERFACE, 'bellows_ros.nodes.identifier_node:IdentifierNode', args)


if __name__ == '__main__':
    sys.exit(main())
