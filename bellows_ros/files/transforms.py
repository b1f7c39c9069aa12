"""
Poses from the transforms of a recording: a tree of frames on /tf and /tf_static.

Links of one way may come at different times and rates: those of the link with most messages count,
and the others are interpolated there.
"""

from collections.abc import Mapping
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import inverse_transform, quaternion_to_rotation, transform
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
from bellows_ros.files import File
from bellows_ros.files.bags import decoded, messages_of
import numpy as np

TF, STATIC_TF = 'tf2_msgs/msg/TFMessage', '/tf_static'

LONGEST_GAP = 4.0
"""Gaps in a link's transforms longer than this many periods are not interpolated."""


class Link(NamedTuple):
    """
    A frame in its parent: poses (N, 4, 4) at stamps (ns), one if it is fixed.

    Bad: how many others are no poses.
    """

    parent: str
    stamps_ns: Stamps
    poses: Array
    bad: int = 0


def read_transforms(path: File) -> dict[str, Link]:
    """
    Return the links of all frames in a recording by name; a fixed link counts once.

    Raises
    ------
    BellowsError
        If it cannot be read, or a frame has two parents.

    """
    found: dict[str, dict[int, tuple[float, ...]]] = {}
    parents: dict[str, str] = {}
    for topic, kind, _, data in messages_of(path, (TF,)):
        for each in decoded(data, kind).transforms:
            child, parent = (name.lstrip('/') for name in (
                each.child_frame_id, each.header.frame_id))
            if parents.setdefault(child, parent) != parent:
                raise BellowsError(
                    f"Frame '{child}' has two parents in the transforms of '{path}', "
                    f"'{parents[child]}' and '{parent}'. Record one of them.")
            stamp, o, q = each.header.stamp, each.transform.translation, each.transform.rotation
            at = 0 if topic == STATIC_TF else stamp.sec * NS_PER_S + stamp.nanosec
            found.setdefault(child, {})[at] = (o.x, o.y, o.z, q.x, q.y, q.z, q.w)
    return {child: _link(parents[child], series) for child, series in found.items()}


def _link(parent: str, series: Mapping[int, tuple[float, ...]]) -> Link:
    """Return a link in the order of its stamps, without invalid transforms."""
    stamps = np.array(sorted(series), dtype=np.int64)
    rows = np.array([series[stamp] for stamp in stamps.tolist()])
    length = np.linalg.norm(rows[:, 3:], axis=1)
    good = np.isfinite(rows).all(axis=1) & (np.abs(length - 1.0) < 0.01)
    q = rows[good, 3:] / length[good, None]
    return Link(parent, stamps[good], transform(quaternion_to_rotation(q), rows[good, :3]),
                int(np.count_nonzero(~good)))


def poses_in(
    links: Mapping[str, Link], frame: str, world: str, of: str
) -> tuple[Stamps, Array, str, int]:
    """
    Return stamps (N,), poses (N, 4, 4) of a frame in another one, and the name of that.

    And how many transforms on the way are left out because they are no poses.

    Parameters
    ----------
    links : mapping of str to Link
        By the names of frames.
    frame, world : str
        The frame wanted, and in which one; in the farthest one above it where that is ''.
    of : str
        What the transforms are of, for messages.

    Raises
    ------
    BellowsError
        If one is unknown, no way leads from one to the other, or nothing moves on it.

    """
    frame, world = frame.lstrip('/'), world.lstrip('/')
    up = _way(links, frame, of)
    root = world or (links[up[-1]].parent if up else frame)
    down = _way(links, root, of)
    while up and down and up[-1] == down[-1]:
        up, down = up[:-1], down[:-1]
    ends = [links[way[-1]].parent if way else end for way, end in ((up, frame), (down, root))]
    if ends[0] != ends[1]:
        raise BellowsError(
            f"No way leads from '{frame}' to '{root}' in the transforms of {of}: one ends at "
            f"'{ends[0]}', the other at '{ends[1]}'. Record what connects them.")
    for name in (*up, *down):
        if not len(links[name].stamps_ns):
            raise BellowsError(
                f"No transform of '{name}' in '{links[name].parent}' of {of} is a pose "
                f'({links[name].bad} came): numbers are not finite, or the length of the '
                'quaternion is not 1. Mend what publishes them.')
    moving = [links[name] for name in (*up, *down) if len(links[name].stamps_ns) > 1]
    if not moving:
        raise BellowsError(f"'{frame}' does not move in '{root}' in the transforms of {of}.")
    stamps = max(moving, key=lambda link: len(link.stamps_ns)).stamps_ns
    first = max(link.stamps_ns[0] for link in moving)
    last = min(link.stamps_ns[-1] for link in moving)
    stamps = stamps[(stamps >= first) & (stamps <= last)]
    (T, known), (T_common_world, there) = (_along(links, way, stamps) for way in (up, down))
    T, valid = inverse_transform(T_common_world) @ T, known & there
    if valid.sum() < 2:
        raise BellowsError(
            f"The transforms between '{frame}' and '{root}' in {of} have no time in common. "
            'Record them together, with stamps of one clock.')
    return stamps[valid], T[valid], root, sum(links[name].bad for name in (*up, *down))


def rotations_in_root(
    links: Mapping[str, Link], frame: str, of: str
) -> tuple[Array, str]:
    """
    Return rotations (N, 3, 3) of a frame in the farthest one above it, and the name of that.

    All of each link, with the last ones of the others; parameters as of `poses_in`.
    """
    R: Array = np.eye(3)[None]
    way = _way(links, frame, of)
    for name in way:
        own = links[name].poses[:, :3, :3]
        R = np.concatenate([own @ R[-1], own[-1:] @ R])
    return R, links[way[-1]].parent if way else frame


def _way(links: Mapping[str, Link], frame: str, of: str) -> list[str]:
    """Return the frames from this one up to below the root; refuse circles."""
    if frame not in links and frame not in {link.parent for link in links.values()}:
        raise BellowsError(
            f"Frame '{frame}' is not among the transforms of {of}. There are: "
            f"{', '.join(sorted(links)[:8]) or 'none'}.")
    way: list[str] = []
    while frame in links:
        way.append(frame)
        frame = links[frame].parent
        if frame in way:
            circle = ' in '.join(f"'{name}'" for name in [*way[way.index(frame):], frame])
            raise BellowsError(
                f'The transforms of {of} go in a circle: {circle}. A frame can have only one '
                'parent, and none that is below it; record without what publishes one of these.')
    return way


def _along(links: Mapping[str, Link], way: list[str], stamps: Stamps) -> tuple[Array, Mask]:
    """Return poses (N, 4, 4) of the first frame of a path above its last, and which are valid."""
    T: Array = np.tile(np.eye(4), (len(stamps), 1, 1))
    valid: Mask = np.ones(len(stamps), dtype=bool)
    for name in way:
        link = links[name]
        if len(link.stamps_ns) == 1:
            T = link.poses @ T
            continue
        there = Trajectory(link.stamps_ns, link.poses[:, :3, 3], link.poses[:, :3, :3])
        longest = LONGEST_GAP * float(np.median(np.diff(link.stamps_ns)))
        found = resample(there, stamps, round(longest))
        T, valid = transform(found.rotation, found.position) @ T, valid & found.valid
    return T, valid
