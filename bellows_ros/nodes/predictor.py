"""The command `predictor`: the node that publishes the pose of the held package."""

from collections.abc import Sequence
import sys

from .command import Interface, run

INTERFACE = Interface(
    name='predictor',
    purpose=(
        'Predict live the pose of a package held by a bellows suction cup, from the pose (and '
        'optionally the twist) of the tool arm.'
    ),
    topics=(
        ('tool_arm/pose', 'geometry_msgs/PoseStamped, subscribed',
         'Pose of the tool tip E in the world, m; PoseWithCovarianceStamped, '
         'TransformStamped or Odometry with tool_pose.type.'),
        ('tool_arm/twist', 'geometry_msgs/TwistStamped, subscribed, optional',
         'Velocity of the tool tip, m/s, and angular velocity, rad/s, in the axes of '
         'tool_twist.frame; paired with the pose by stamp. Without it the twist is estimated '
         'from the poses.'),
        ('package/measured', 'geometry_msgs/PoseStamped, subscribed, optional',
         'Measured pose of the package in the frame of the tool poses, at any rate, up to 0.5 s '
         'late; corrects the prediction. PoseWithCovarianceStamped or Odometry with '
         'measured.type.'),
        ('package/pose', 'geometry_msgs/PoseStamped, published',
         'Pose of the centre of mass B in the world, m; one for each tool pose, with its stamp.'),
        ('package/twist', 'geometry_msgs/TwistStamped, published',
         'Velocity of B, m/s, and angular velocity, rad/s, in axes of B.'),
        ('cup/wrench', 'geometry_msgs/WrenchStamped, published',
         "Force, N, and moment, N m, of the cup on the package at the lip's centre, in lip axes."),
        ('cup/safety_factor', 'geometry_msgs/Vector3Stamped, published',
         'Safety factor of the grip: x against peeling, y against slipping, z the smaller one, '
         'each at most 1000; needs cup.lip_radius and the vacuum.'),
        ('package/odometry', 'nav_msgs/Odometry, published',
         'Pose and twist of B with covariances from cup.*_std and tool_noise.* (1e6 on the '
         'diagonal if unknown); continues, with growing covariance, while the tool is '
         'extrapolated.'),
        ('cup/deflection', 'geometry_msgs/PoseStamped, published',
         'Pose of the lip S relative to its pose without load.'),
        ('package/markers', 'visualization_msgs/MarkerArray, published',
         'Package, cup and force for RViz.'),
        ('package/state', 'std_msgs/String, published, latched',
         'waiting, settling, predicting, coasting, lost, detached or inactive; after the valve '
         'released, flying and landed; for 5 s after an alarm "alarm: " and its cause.'),
        ('package/ok', 'std_msgs/Bool, published, latched',
         'True while the package is held, predicted, without an alarm, and with a safety factor '
         'of at least safety.least; no safety function.'),
        ('package/estimated', 'geometry_msgs/InertiaStamped, published',
         'Estimated mass, centre of mass in the frame of the lip, and inertia, with '
         'payload.estimate; standard deviations are in the diagnostics.'),
        ('package/landing', 'geometry_msgs/PoseWithCovarianceStamped, published',
         'Landing if the valve were switched now; needs package.size.'),
        ('package/landing_markers', 'visualization_msgs/MarkerArray, published',
         'Flight path and landing ellipse for RViz.'),
        ('release/at', 'std_msgs/Header, published',
         'When to switch the valve for landing.target; needs landing.aim.'),
        ('tool_arm/plan', 'trajectory_msgs/MultiDOFJointTrajectory, subscribed',
         'A plan of the tool, answered on package/plan at once, and at plan.rate while the tool '
         'drives it; with stamp 0 it starts with the tool.'),
        ('package/plan', 'trajectory_msgs/MultiDOFJointTrajectory, published',
         'B along the plan, or along the rest of it.'),
        ('package/plan_path', 'nav_msgs/Path, published', 'The same for RViz.'),
        ('package/predict_at', 'std_msgs/Header, subscribed',
         'Asks for the pose of the package at a stamp, with the tool on its plan or moving '
         'steadily.'),
        ('package/predicted_at', 'nav_msgs/Odometry, published', 'The answer.'),
        ('tool_arm/steer', 'trajectory_msgs/MultiDOFJointTrajectory, subscribed',
         'A desired motion of the tool, or of B if its joint has the name frames.package.'),
        ('tool_arm/steered', 'trajectory_msgs/MultiDOFJointTrajectory, published',
         'The answer: the motion of the tool without swing of the package.'),
        ('tool_arm/plan_joints', 'trajectory_msgs/JointTrajectory, subscribed',
         'A plan of the joints of the arm on robot_description, answered as tool_arm/plan; needs '
         'tool_link.'),
        ('tool_arm/steer_joints', 'trajectory_msgs/JointTrajectory, subscribed',
         'A desired motion of these joints.'),
        ('tool_arm/steered_joints', 'trajectory_msgs/JointTrajectory, published',
         'The answer: the motion of the same joints without swing of the package, slowed down '
         'where their speeds need that.'),
        ('robot_description', 'std_msgs/String, subscribed', 'URDF of the arm.'),
        ('vacuum/valve', 'std_msgs/Bool, subscribed',
         'Whether the vacuum valve is on: off tosses the package, on picks up the next.'),
        ('/diagnostics', 'diagnostic_msgs/DiagnosticArray, published',
         'Health of prediction, inputs and load at 1 Hz.'),
        ('/tf', 'tf2_msgs/TFMessage, subscribed, with tool_pose.type tf',
         'Transforms from frames.world to frames.tool, instead of tool_arm/pose; together with '
         'those of /tf_static.'),
        ('/tf', 'tf2_msgs/TFMessage, published',
         'The frame of the package; needs tf2_msgs and frames.tf.'),
        ('vacuum/held', 'std_msgs/Bool, subscribed, with vacuum.signal bool',
         'Attaches and detaches the package.'),
        ('vacuum/pressure', 'sensor_msgs/FluidPressure, subscribed, with vacuum.signal pressure',
         'Absolute pressure in the cup, Pa; attaches and detaches the package. Sensors of single '
         'cups of cup.layout have the frame_id cup_0, cup_1 and so on.'),
        ('package/attach', 'std_srvs/Trigger, service',
         'The cup holds the package now: predict from static equilibrium.'),
        ('package/detach', 'std_srvs/Trigger, service',
         'The cup holds nothing now: stop predicting. Both services apply until the vacuum '
         'signal, if there is one, changes.'),
        ('~/change_state', 'lifecycle_msgs/ChangeState, service',
         'Configure, activate, deactivate, clean up, shut down; see autostart.'),
        ('~/reset', 'std_srvs/Trigger, service',
         'Start again from static equilibrium at the next tool pose.'),
    ),
    examples=(
        'predictor --ros-args --params-file cup.yaml --params-file package.yaml',
        'predictor --ros-args --params-file package.yaml '
        '-r tool_arm/pose:=/tcp_pose_broadcaster/pose',
    ),
)


def main(args: Sequence[str] | None = None) -> int:
    """Run the predictor with a command line, or that of the process; return the exit code."""
    return run(INTERFACE, 'bellows_ros.nodes.predictor_node:PredictorNode', args)


if __name__ == '__main__':
    sys.exit(main())
