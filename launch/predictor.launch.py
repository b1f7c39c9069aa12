"""
Start one predictor: it publishes where the held package is, from the motion of the tool arm.

A managed node: it configures and activates itself unless `autostart:=false`.
Starts the node `predictor` of bellows_ros, and nothing else. The driver that publishes the pose
(and twist) of the tool arm runs elsewhere; name its topics with `tool_pose` and `tool_twist`:

    ros2 launch bellows_ros predictor.launch.py cup_file:=cup.yaml params_file:=package.yaml \
        tool_pose:=/tcp_pose_broadcaster/pose

All arguments: `ros2 launch bellows_ros predictor.launch.py --show-args`.
"""

ARGUMENTS = {
    'params_file': (None, 'Parameter file (YAML) with the package. Required; over cup_file.'),
    'cup_file': ('', "Parameter file with the cup, as the identifier writes it; '' for none."),
    'namespace': ('', 'Namespace of the node and its relative topics.'),
    'tool_pose': ('tool_arm/pose', "Topic of the tool arm's pose (PoseStamped)."),
    'tool_twist': ('tool_arm/twist', "Topic of the tool arm's twist (TwistStamped); optional."),
    'measured': ('package/measured', "Topic of the package's measured pose; optional."),
    'plan': ('tool_arm/plan', 'Topic of plans (MultiDOFJointTrajectory); optional.'),
    'plan_joints': ('tool_arm/plan_joints', 'Topic of plans of joints; optional.'),
    'robot_description': ('robot_description', "Topic of the arm's URDF, for these."),
    'valve': ('vacuum/valve', 'Topic of the vacuum valve (Bool); optional.'),
    'pressure': ('vacuum/pressure', 'Topic of the pressure in the cup; optional.'),
    'autostart': ('true', 'Whether it activates itself, or waits for a lifecycle manager.'),
    'log_level': ('info', 'Least severe log level shown: debug, info, warn, error.'),
}
REMAPPED = ('tool_pose', 'tool_twist', 'measured', 'plan', 'plan_joints', 'robot_description',
            'valve', 'pressure')
"""Arguments that name the topics which are their defaults."""


def generate_launch_description():
    """
    Describe the start of the predictor.

    Returns
    -------
    launch.LaunchDescription
        Its arguments and the one node.

    """
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_predictor)])


def parameter_files(value):
    """Return the parameter files; the last prevails."""
    return [file for file in (value['cup_file'], value['params_file']) if file]


def start_predictor(context):
    """Return the node, with the arguments' values as they stand at start."""
    from launch_ros.actions import Node

    value = {name: context.launch_configurations[name] for name in ARGUMENTS}
    return [Node(
        package='bellows_ros',
        executable='predictor',
        name='predictor',
        namespace=value['namespace'],
        parameters=[
            *parameter_files(value), {'autostart': value['autostart'].lower() == 'true'}],
        remappings=[(ARGUMENTS[name][0], value[name]) for name in REMAPPED],
        arguments=['--ros-args', '--log-level', value['log_level']],
        output='screen',
    )]
