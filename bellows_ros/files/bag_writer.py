"""
Writing rosbag2 recordings of poses and twists, whole or not at all.

The bytes depend only on content, name and version of rosbags.
"""

from collections.abc import Sequence
import heapq
from itertools import repeat
from pathlib import Path
import sqlite3
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.errors import BellowsError
from bellows_ros.files import atomic, bags, File, messages
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


class Encoded(NamedTuple):
    """Messages to record on a topic: times of receipt (ns) in order, and CDR with its head."""

    topic: str
    type_name: str
    stamps_ns: Stamps
    data: Any


def as_messages(
    topic: str, type_name: str, stamps_ns: Stamps, values: Array, frame_id: str = 'world',
    child_frame_id: str = '', log_times_ns: Stamps | None = None,
) -> Encoded:
    """
    Encode poses or twists.

    Parameters
    ----------
    topic, type_name : str
        Topic and type, one of `messages.MOTIONS`, for example 'geometry_msgs/msg/PoseStamped'.
    stamps_ns : int array (N,)
        Header stamps, ns; any order.
    values : array (N, 7), (N, 6) or (N, 13)
        Poses as x, y, z and the quaternion (x, y, z, w); twists as linear, angular; Odometry has
        both, pose first. Any numbers are allowed, so that faults can be recorded. Covariances are
        zero.
    frame_id, child_frame_id : str
        Frame names; the child's only for TransformStamped and Odometry.
    log_times_ns : int array (N,), optional
        Times of receipt, ns, which give the order; default: the stamps.

    Raises
    ------
    BellowsError
        If times are before 1970.

    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    log_times = stamps if log_times_ns is None else np.asarray(log_times_ns)
    if min(stamps.min(initial=0), log_times.min(initial=0)) < 0:
        raise BellowsError(f"Topic '{topic}' has times before 1970.")
    order = np.argsort(log_times, kind='stable')
    names = (frame_id, child_frame_id)[:messages.LAYOUTS[type_name].strings]
    return Encoded(topic, type_name, log_times[order], messages.encode(
        stamps[order], np.asarray(values)[order], names, type_name))


def write_bag(
    path: File, recorded: Sequence[Encoded], storage: str = 'mcap', zstd: bool = False,
    replace: bool = False
) -> None:
    """
    Write a recording.

    Parameters
    ----------
    path : path
        Folder to make.
    recorded : sequence of Encoded
        Messages; several items may share a topic of one type.
    storage : str
        'mcap' or 'sqlite3'.
    zstd : bool
        Whether the recording is compressed.
    replace : bool
        Whether an existing recording may be replaced.

    Raises
    ------
    BellowsError
        If there is nothing to record, or the output exists.

    """
    if not any(len(r.stamps_ns) for r in recorded):
        raise BellowsError(f"Recording '{path}' would be empty. Give messages to record.")
    if replace:
        _require_replaceable(Path(path))
    with atomic.new_folder(path, replace) as folder:
        # ROS 2 Jazzy writes version 9 of metadata.yaml.
        writer = Writer(folder, version=9, storage_plugin=STORAGES[storage])
        if zstd:
            writer.set_compression(  # chunks inside an MCAP file, messages in a database
                CompressionMode.STORAGE if storage == 'mcap' else CompressionMode.MESSAGE,
                CompressionFormat.ZSTD)
        try:
            with writer:
                _write(writer, recorded)
        except sqlite3.Error as error:  # a full disk, reported by the system's message
            raise OSError(f'SQLite says {error}') from None


def _write(writer: Writer, recorded: Sequence[Encoded]) -> None:
    """Write messages in the order of their receipt."""
    names = [(r.topic, r.type_name) for r in recorded]
    connections = {name: writer.add_connection(*name, typestore=messages.message_types())
                   for name in dict.fromkeys(names)}
    streams = [zip(map(int, r.stamps_ns), repeat(number), map(bytes, r.data))
               for number, r in enumerate(recorded)]
    for log_time_ns, number, data in heapq.merge(*streams, key=lambda m: m[:2]):
        writer.write(connections[names[number]], log_time_ns, data)


def _require_replaceable(folder: Path) -> None:
    """Raise for a folder that contains anything but a recording."""
    names = [p.name for p in folder.iterdir()] if folder.is_dir() else [bags.METADATA]
    strange = [name for name in names if name != bags.METADATA
               and not name.endswith(('.mcap', '.db3', '.zstd'))]
    if strange or bags.METADATA not in names:
        why = f"it holds '{strange[0]}'" if strange else f'it has no {bags.METADATA}'
        raise BellowsError(
            f"Folder '{folder}' is not replaced because it is not just a recording: {why}. "
            'Give another name, or remove it first.')
