"""Recordings made by rosbags, which do not judge the package by itself, and plans as YAML."""

import json

from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.files.bags import as_messages
import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
MOVEIT_TYPES = {
    'moveit_msgs/msg/RobotTrajectory': 'trajectory_msgs/JointTrajectory joint_trajectory\n'
    'trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory',
    'moveit_msgs/msg/DisplayTrajectory':
    'string model_id\nmoveit_msgs/RobotTrajectory[] trajectory'}
for name, definition in MOVEIT_TYPES.items():
    TYPES.register(get_types_from_msg(definition, name))
EPOCH_NS = 1_760_000_000_000_000_000

POSE = 'geometry_msgs/msg/PoseStamped'
POSE_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
TWIST = 'geometry_msgs/msg/TwistStamped'

FORMS = [
    ('mcap', 'NONE'), ('mcap', 'MESSAGE'), ('mcap', 'FILE'), ('mcap', 'STORAGE'),
    ('sqlite3', 'NONE'), ('sqlite3', 'MESSAGE'), ('sqlite3', 'FILE')]
PLUGINS = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


def stamps(count, rate_hz=360.0):
    """Return stamps at a rate, ns."""
    return EPOCH_NS + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def pose_values(count, seed=0):
    """Return random poses: x, y, z and a unit quaternion (x, y, z, w)."""
    values = np.random.default_rng(seed).normal(size=(count, 7))
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return values


def twist_values(count, seed=1):
    """Return random twists: linear, angular."""
    return np.random.default_rng(seed).normal(size=(count, 6))


def built(kind, values):
    """Return the object rosbags makes of nested values in the order of a type's fields."""
    def part(value, node, of):
        if node == Nodetype.NAME:
            return built(of, value)
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, name), _ = of
            return ([built(name, each) for each in value] if inner == Nodetype.NAME else
                    np.asarray(value, float) if name[0] != 'string' else list(value))
        return float(value) if of[0] == 'float64' else value

    fields = TYPES.fielddefs[kind][1]
    return TYPES.types[kind](*(
        part(value, *field) for value, (_, field) in zip(values, fields, strict=True)))


def serialized(kind, values):
    """Return a message of nested values as rosbags serialises it."""
    if kind not in TYPES.types:
        pytest.skip(f'this rosbags does not know {kind}')
    return bytes(TYPES.serialize_cdr(built(kind, values), kind))


def header(stamp_ns, frame_id='world'):
    """Return the values of a header."""
    return divmod(int(stamp_ns), 10**9), frame_id


def message(kind, stamp_ns, pose=None, twist=None, frame_id='world', child_frame_id='body',
            covariance=None):
    """Return the object rosbags makes of a message."""
    head, cov = header(stamp_ns, frame_id), np.arange(36.0) if covariance is None else covariance
    body, velocity = (part if part is None else (part[:3], part[3:]) for part in (pose, twist))
    return built(kind, {
        POSE: (head, body), POSE_COVARIANCE: (head, (body, cov)), TWIST: (head, velocity),
        TRANSFORM: (head, child_frame_id, body),
        ODOMETRY: (head, child_frame_id, (body, cov), (velocity, cov))}[kind])


def encoded(kind, *args, little_endian=True, **kwargs):
    """Return the bytes of a message as rosbags makes them."""
    content = message(kind, *args, **kwargs)
    return bytes(TYPES.serialize_cdr(content, kind, little_endian=little_endian))


def write(path, topics, storage='mcap', compression='NONE', version=9):
    """
    Write a recording with rosbags.

    `topics` maps (topic, type) to a list of (log time in ns, bytes).
    """
    writer = Writer(path, version=version, storage_plugin=PLUGINS[storage])
    writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        for (topic, kind), messages in topics.items():
            connection = writer.add_connection(topic, kind, typestore=TYPES)
            for log_time_ns, data in messages:
                writer.write(connection, log_time_ns, data)
    return path


def again(stream, topic='', late_ns=0):
    """Return a stream that was read, of poses or twists, to record it again."""
    stamps_ns = stream.stamps_ns + late_ns
    if hasattr(stream, 'linear'):
        return as_messages(topic or stream.name, TWIST, stamps_ns, np.hstack(
            [stream.linear, stream.angular]), stream.frame_id)
    return as_messages(topic or stream.name, POSE, stamps_ns, np.hstack(
        [stream.position, rotation_to_quaternion(stream.rotation)]), stream.frame_id)


def poses(count, values=None, frame_id='world'):
    """Return (log time, bytes) of PoseStamped messages."""
    values = pose_values(count) if values is None else values
    return [(int(t), encoded(POSE, t, pose=v, frame_id=frame_id))
            for t, v in zip(stamps(count), values, strict=True)]


def storage_file(folder):
    """Return the one storage file of a recording."""
    (path,) = (p for p in folder.iterdir() if p.name != 'metadata.yaml')
    return path


def cartesian(times_ns, poses, twists):
    """Return a plan of the tool, from poses (N, 7) and twists (N, 6)."""
    def parts(axes, row):
        return dict(zip(axes, map(float, row), strict=True))

    return {'header': {'stamp': {'sec': 0, 'nanosec': 0}, 'frame_id': 'base'},
            'joint_names': ['tool'], 'points': [{
                'transforms': [{
                    'translation': parts('xyz', p[:3]), 'rotation': parts('xyzw', p[3:])}],
                'velocities': [{'linear': parts('xyz', v[:3]), 'angular': parts('xyz', v[3:])}],
                'accelerations': [],
                'time_from_start': dict(zip(
                    ('sec', 'nanosec'), divmod(int(at), 10**9), strict=True)),
            } for at, p, v in zip(times_ns, poses, twists, strict=True)]}


def plan_messages(count=4):
    """Return a plan of each message type, with 0.1 s per point."""
    rows = [(0.01 * k, -0.0, 1e-05, 0.0, 0.0, 0.0, 1.0) for k in range(count)]
    multi = cartesian(
        [k * 10**8 for k in range(count)], rows, [(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)] * count)
    header = multi['header']
    poses = [each['transforms'][0] for each in multi['points']]
    times = [each['time_from_start'] for each in multi['points']]
    return json.loads(json.dumps({  # without parts that YAML would write as aliases
        'multi': multi,
        'path': {'header': header, 'poses': [{
            'header': {'stamp': at, 'frame_id': 'base'},
            'pose': {'position': pose['translation'], 'orientation': pose['rotation']},
        } for pose, at in zip(poses, times, strict=True)]},
        'joints': {'header': header, 'joint_names': ['turn', 'slide', 'spin'], 'points': [{
            'positions': [pose['translation']['x'], 0.0, 0.0], 'velocities': [],
            'accelerations': [], 'effort': [], 'time_from_start': at,
        } for pose, at in zip(poses, times, strict=True)]}}))
