"""Recordings made by rosbags, so that the package's own writer does not judge its reader."""

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
EPOCH_NS = 1_760_000_000_000_000_000

POSE = 'geometry_msgs/msg/PoseStamped'
POSE_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TRANSFORM = 'geometry_msgs/msg/TransformStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
TWIST = 'geometry_msgs/msg/TwistStamped'

FORMS = [
    ('mcap', 'NONE'), ('mcap', 'MESSAGE'), ('mcap', 'FILE'), ('mcap', 'STORAGE'),
    ('sqlite3', 'NONE'), ('sqlite3', 'MESSAGE'), ('sqlite3', 'FILE'),
]
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


def message(kind, stamp_ns, pose=None, twist=None, frame_id='world', child_frame_id='body',
            covariance=None):
    """Return the object rosbags makes of a message, and its name."""
    t = TYPES.types
    sec, nanosec = divmod(int(stamp_ns), 10**9)
    stamp = t['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    header = t['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)

    def point(name, xyz):
        return t[f'geometry_msgs/msg/{name}'](*(float(x) for x in xyz))

    covariance = np.arange(36.0) if covariance is None else covariance
    if pose is not None:
        rotation = t['geometry_msgs/msg/Quaternion'](*(float(x) for x in pose[3:]))
        body = t['geometry_msgs/msg/Pose'](
            position=point('Point', pose[:3]), orientation=rotation)
        with_covariance = t['geometry_msgs/msg/PoseWithCovariance'](
            pose=body, covariance=covariance)
    if twist is not None:
        velocity = t['geometry_msgs/msg/Twist'](
            linear=point('Vector3', twist[:3]), angular=point('Vector3', twist[3:]))
    if kind == POSE:
        return t[kind](header=header, pose=body)
    if kind == POSE_COVARIANCE:
        return t[kind](header=header, pose=with_covariance)
    if kind == TRANSFORM:
        transform = t['geometry_msgs/msg/Transform'](
            translation=point('Vector3', pose[:3]), rotation=rotation)
        return t[kind](header=header, child_frame_id=child_frame_id, transform=transform)
    if kind == ODOMETRY:
        return t[kind](
            header=header,
            child_frame_id=child_frame_id,
            pose=with_covariance,
            twist=t['geometry_msgs/msg/TwistWithCovariance'](
                twist=velocity, covariance=covariance),
        )
    return t[TWIST](header=header, twist=velocity)


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


def poses(count, values=None, frame_id='world'):
    """Return (log time, bytes) of PoseStamped messages."""
    values = pose_values(count) if values is None else values
    return [
        (int(t), encoded(POSE, t, pose=v, frame_id=frame_id))
        for t, v in zip(stamps(count), values, strict=True)
    ]


def storage_file(folder):
    """Return the one storage file of a recording."""
    (path,) = (p for p in folder.iterdir() if p.name != 'metadata.yaml')
    return path
