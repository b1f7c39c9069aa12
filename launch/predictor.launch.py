"""
Start one predictor: it publishes where the held package is, from the motion of the tool arm.

A managed node: it configures and activates itself unless `autostart:=false`.
Starts the node `predictor` of bellows_ros, and nothing else. The driver that publishes the pose
(and twist) of the tool arm runs elsewhere; name its topics with `tool_pose` and `tool_twist`. Each
other topic has an argument, too: its name with _ for each slash.

    ros2 launch bellows_ros predictor.launch.py cup_file:=cup.yaml params_file:=package.yaml \
        tool_pose:=/tcp_pose_broadcaster/pose

All arguments: `ros2 launch bellows_ros predictor.launch.py --show-args`.
"""

from bellows_ros.nodes.command import interface

SETTINGS = {
    'params_file': (None, 'Parameter file (YAML) with the package. Required; over cup_file.'),
    'cup_file': ('', "Parameter file with the cup, as the identifier writes it; '' for none."),
    'namespace': ('', 'Namespace of the node and its relative topics.'),
    'autostart': ('true', 'Whether it activates itself, or waits for a lifecycle manager.'),
    'use_sim_time': ('false', 'Whether its clock is the topic /clock.'),
    'log_level': ('info', 'Least severe log level shown: debug, info, warn, error.'),
}
SHORT = {
    'tool_arm/pose': 'tool_pose', 'tool_arm/twist': 'tool_twist', 'package/measured': 'measured',
    'tool_arm/plan': 'plan', 'tool_arm/plan_joints': 'plan_joints', 'vacuum/valve': 'valve',
    'vacuum/pressure': 'pressure'}
"""Shorter names of arguments."""

TOPICS = {
    SHORT.get(topic['name'], topic['name'].replace('/', '_').strip('_')): topic
    for topic in interface('predictor')['topics']
    if 'service' not in topic['type'] and not topic['name'].startswith('~')}
"""Topics of the node by the names of their arguments."""

ARGUMENTS = SETTINGS | {
    argument: (topic['name'], f"Topic ({topic['type']}).") for argument, topic in TOPICS.items()}


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


def node_arguments(value):
    """Return the arguments of the node for the values of `ARGUMENTS`."""
    files = [file for file in (value['cup_file'], value['params_file']) if file]
    switches = {name: value[name].lower() == 'true' for name in ('autostart', 'use_sim_time')}
    return {
        'package': 'bellows_ros', 'executable': 'predictor', 'name': 'predictor',
        'namespace': value['namespace'], 'parameters': [*files, switches],
        'remappings': [(topic['name'], value[name]) for name, topic in TOPICS.items()
                       if value[name] != topic['name']],
        'arguments': ['--ros-args', '--log-level', value['log_level']], 'output': 'screen'}


def start_predictor(context):
    """Return the node, with the arguments' values as they stand at start."""
    from launch_ros.actions import Node

    return [Node(**node_arguments(
        {name: context.launch_configurations[name] for name in ARGUMENTS}))]
