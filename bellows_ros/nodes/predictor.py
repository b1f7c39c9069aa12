"""The command `predictor`: the node that publishes the pose of the held package."""

from collections.abc import Sequence
import sys

from .command import Interface, run

INTERFACE = Interface(
    name='predictor',
    purpose=(
        'Predict live the pose of a package held by a bellows suction cup, from the pose (and '
        'optionally the twist) of the tool arm.'),
    examples=(
        'predictor --ros-args --params-file cup.yaml --params-file package.yaml',
        'predictor --ros-args --params-file package.yaml '
        '-r tool_arm/pose:=/tcp_pose_broadcaster/pose'))


def main(args: Sequence[str] | None = None) -> int:
    """Run the predictor with a command line, or that of the process; return the exit code."""
    return run(INTERFACE, 'bellows_ros.nodes.predictor_node:PredictorNode', args)


if __name__ == '__main__':
    sys.exit(main())
