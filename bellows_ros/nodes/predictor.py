"""The command `predictor`: the node that publishes where the held package is."""

from collections.abc import Callable, Sequence
import sys
from typing import Any

from .command import run
from .help_text import Interface

INTERFACE = Interface(
    name='predictor',
    purpose=(
        'Predict live where a package held by a bellows suction cup is, from the pose (and the '
        'twist, if there is one) of the tool arm.'
    ),
    topics=(
        ('tool_arm/pose', 'geometry_msgs/PoseStamped, subscribed',
         'Pose of the tool tip E in the world, m.'),
        ('tool_arm/twist', 'geometry_msgs/TwistStamped, subscribed, optional',
         'Velocity of the tool tip, m/s, and angular velocity, rad/s, in the axes that '
         'tool_twist.frame names; paired with the pose by stamp. Without it they are estimated '
         'from the poses.'),
        ('package/pose', 'geometry_msgs/PoseStamped, published',
         'Pose of the centre of mass B in the world, m; one for each tool pose, with its stamp.'),
        ('package/twist', 'geometry_msgs/TwistStamped, published',
         'Velocity of B, m/s, and angular velocity, rad/s, in axes of B.'),
        ('cup/wrench', 'geometry_msgs/WrenchStamped, published',
         "Force, N, and moment, N m, of the cup on the package at the lip's centre, in lip axes."),
        ('~/reset', 'std_srvs/Trigger, service',
         'Start again from static equilibrium at the next tool pose.'),
    ),
    examples=(
        'predictor --ros-args --params-file package.yaml --params-file cup.yaml',
        'predictor --ros-args --params-file package.yaml '
        '-r tool_arm/pose:=/tcp_pose_broadcaster/pose',
    ),
)  # fmt: skip


def _load_node() -> Callable[[], Any]:
    """Import ROS and return the node."""
    from .predictor_node import PredictorNode

    return PredictorNode


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the predictor.

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
