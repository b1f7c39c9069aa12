"""Recordings whose two bodies have different clocks or different worlds."""

from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.files.bags import as_messages, read_streams, write_bag
import numpy as np

TOPICS = {
    'tool_pose': '/tool_arm/pose', 'tool_twist': '/tool_arm/twist',
    'package_pose': '/package/pose'}


def rewritten(bags, out, seen, topics=None):
    """Write recordings as one, each stream of a role changed, and return the path."""
    topics = topics or {role: topic for role, topic in TOPICS.items() if 'twist' not in role}
    every = [read_streams(bag, topics) for bag in bags]
    recorded = []
    for role, topic in topics.items():
        streams = [seen(role, streams[role]) for streams in every]
        if role == 'tool_twist':
            kind = 'Twist'
            values = [np.hstack([s.linear, s.angular]) for s in streams]
        else:
            kind = 'Pose'
            values = [np.hstack([s.position, rotation_to_quaternion(s.rotation)]) for s in streams]
        recorded.append(as_messages(
            topic, f'geometry_msgs/msg/{kind}Stamped',
            np.concatenate([s.stamps_ns for s in streams]), np.concatenate(values),
            streams[0].frame_id))
    write_bag(out, recorded)
    return str(out)
