"""
Start one identifier: it finds the cup's stiffness and damping in recordings.

Starts the node `identifier` of bellows_ros, and nothing else. The parameter file names the
recordings and their topics (see config/identifier.yaml):

    ros2 launch bellows_ros identifier.launch.py params_file:=identifier.yaml

All arguments: `ros2 launch bellows_ros identifier.launch.py --show-args`.
"""

ARGUMENTS = {
    'params_file': (None, 'Parameter file (YAML) with recordings, topics and package. Required.'),
    'namespace': ('', 'Namespace of the node.'),
    'use_sim_time': ('false', 'Whether its clock is the topic /clock.'),
    'log_level': ('info', 'Least severe log level shown: debug, info, warn, error.'),
}


def generate_launch_description():
    """
    Describe the start of the identifier.

    Returns
    -------
    launch.LaunchDescription
        Its arguments and the one node.

    """
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node
    from launch_ros.parameter_descriptions import ParameterValue

    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, Node(
        package='bellows_ros',
        executable='identifier',
        name='identifier',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), {'use_sim_time': ParameterValue(
            LaunchConfiguration('use_sim_time'), value_type=bool)}],
        arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')],
        output='screen',
    )])
