"""Recordings whose tool is stamped by another clock than the package."""

from bellows_ros.core.lie import rotation_to_quaternion
from bellows_ros.files.bag_writer import Recorded, write_bag
from bellows_ros.files.bags import read_streams
import numpy as np

TOPICS = {
    'tool_pose': '/tool_arm/pose', 'tool_twist': '/tool_arm/twist',
    'package_pose': '/package/pose'}


def late(bag, out, seconds):
    """Write a recording again with the tool stamped later, and return its path."""
    streams = read_streams(bag, TOPICS)
    recorded = []
    for role, topic in TOPICS.items():
        stream = streams[role]
        if role == 'tool_twist':
            kind, values = 'Twist', np.hstack([stream.linear, stream.angular])
        else:
            kind = 'Pose'
            values = np.hstack([stream.position, rotation_to_quaternion(stream.rotation)])
        behind = 0 if role == 'package_pose' else round(1e9 * seconds)
        recorded.append(Recorded(
            topic, f'geometry_msgs/msg/{kind}Stamped', stream.stamps_ns + behind, values,
            stream.frame_id))
    write_bag(out, recorded)
    return str(out)
