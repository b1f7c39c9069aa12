"""Conversion of poses in files, joints or transforms to recordings, and of recordings to TUM."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import compress
import os
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Mask
from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.core.recording.conventions import reordered
from bellows_ros.core.signals.trajectory import pose_rows, PoseStream
from bellows_ros.errors import BellowsError, shown
from bellows_ros.files import bag_writer, bags, File, plans, results, trajectory_files
from bellows_ros.files.bag_folder import Channel
from bellows_ros.files.messages import POSE
from bellows_ros.workflows.recordings import FULL_RANGE, interval_masks, within_interval
import numpy as np

MAX_REPEATED = 0.1
"""Largest share of lines with the time of the previous line that is treated as faults of single
lines."""

TOOL_POSE, PACKAGE_POSE = '/tool_arm/pose', '/package/pose'

MIN_STATED_NOISE = 2e-5
"""Smallest stated error by interpolation, m: a fifth of the noise of motion capture, 0.1 mm."""


class Body(NamedTuple):
    """
    The messages of a body.

    Parameters
    ----------
    messages : Encoded
        Messages of one topic: converted poses, or copied messages.
    source : str
        File, with the name of the body if the file has several bodies.
    left_out : mapping of str to int
        Number of omitted frames by reason.
    world : {'z_up', 'motive_y_up'}
        The value of recording.world.
    notes : tuple of str
        Warnings of the source.

    """

    messages: bag_writer.Encoded
    source: str
    left_out: Mapping[str, int] = MappingProxyType({})
    world: str = 'z_up'
    notes: tuple[str, ...] = ()

    @property
    def topic(self) -> str:
        """Topic of the written messages."""
        return self.messages.topic

    @property
    def poses(self) -> int:
        """Number of messages."""
        return len(self.messages.stamps_ns)

    def at(self, chosen: Mask) -> 'Body':
        """Return selected messages."""
        return self._replace(messages=replace(
            self.messages, stamps_ns=self.messages.stamps_ns[chosen],
            data=tuple(compress(self.messages.data, chosen))))


class Conversion(NamedTuple):
    """
    A conversion.

    Parameters
    ----------
    out : str
    bodies : tuple of Body
    world : str
        Value of recording.world for the written poses.
    notes : tuple of str
        Notes for the user, one sentence each.

    """

    out: str
    bodies: tuple[Body, ...]
    world: str = 'z_up'
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        bodies = [results.attributes(body, 'topic', 'source', 'poses', 'left_out')
                  for body in self.bodies]
        return {**self._asdict(), 'bodies': bodies}


def bodies_in_files(
    sources: Sequence[File], names: Sequence[str] = (),
    min_markers: int = trajectory_files.MIN_MARKERS,
) -> list[Body]:
    """
    Return the bodies in trajectory files.

    Parameters
    ----------
    sources : sequence of path
        Motive CSV exports, with a topic for each rigid body, or TUM files, with a topic each.
    names : sequence of str, optional
        Topics, in the order of files and bodies; default: '/NAME/pose'.
    min_markers : int
        Smallest number of visible markers of a pose from Motive.

    Raises
    ------
    BellowsError
        If a source cannot be read, or two bodies would have the same topic.

    """
    bodies = [body for source in sources for body in _bodies_in_file(Path(source), min_markers)]
    if names and len(names) != len(bodies):
        raise BellowsError(
            f'{len(names)} topics are given for {len(bodies)} bodies: '
            f'{", ".join(body.source for body in bodies)}. Give one for each, in this order.')
    if names:
        bodies = [body._replace(messages=replace(body.messages, topic=bags.absolute(name)))
                  for body, name in zip(bodies, names, strict=True)]
    chosen = [body.topic for body in bodies]
    if len(set(chosen)) < len(chosen):
        raise BellowsError(
            f'Several bodies have the same topic, among {", ".join(chosen)}. Give a topic for '
            'each.')
    return bodies


def tool_of_joints(bag: File, tool_link: str, urdf: str = '', topic: str = '') -> list[Body]:
    """
    Return the tool of a recording with joint states or transforms, and its poses and twists.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    tool_link : str
        Link or frame at the tool tip E.
    urdf : str, optional
        File with the arm; default: the arm on /robot_description, or otherwise the transforms.
    topic : str, optional
        Topic for the tool's poses; default: '/tool_arm/pose'.

    Raises
    ------
    BellowsError
        If the recording has neither joints nor transforms of the tool.

    """
    read = plans.joints_or_tf(bag, urdf, tool_link)
    name = bags.absolute(topic or TOOL_POSE)
    others = _copied_topics(bag, {*bags.accepted_types('pose'), *bags.accepted_types('twist')})
    if any(other.topic == name for other in others):
        raise BellowsError(
            f"Topic '{name}' is already in recording '{bag}'. Choose another for the tool with "
            '--topic.')
    messages = bag_writer.as_messages(
        name, POSE, read.stamp_ns + read.times_ns, read.poses, read.frame_id)
    return [Body(messages, f"{tool_link} in '{read.frame_id}' of {bag}"), *others]


def bodies_in_transforms(
    bag: File, tool_frame: str, package_frame: str, world_frame: str = '',
    names: Sequence[str] = (),
) -> list[Body]:
    """
    Return tool and package of a recording with transforms.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file, with /tf and optionally /tf_static.
    tool_frame, package_frame : str
        Frames of the tool tip E and of the package.
    world_frame : str
        Frame of the returned poses; default: the farthest ancestor of the tool frame. A body
        without a connection to this frame has poses in the farthest ancestor of its own frame.
    names : sequence of str, optional
        Topics of tool and package; default: '/tool_arm/pose' and '/package/pose'.

    Raises
    ------
    BellowsError
        If no chain of transforms leads from a frame to a named world.

    """
    transforms, bodies = plans.read_transforms(bag), list[Body]()
    names = names or (TOOL_POSE, PACKAGE_POSE)
    if len(set(names)) != 2:
        raise BellowsError('Name two topics with --topic, of the tool and of the package.')
    if tool_frame.lstrip('/') == package_frame.lstrip('/'):
        raise BellowsError(
            f"'{tool_frame}' is named as the frame of the tool and of the package. Name two.")
    for frame, topic in zip((tool_frame, package_frame), names, strict=True):
        try:
            stamps, rows, world, bad = plans.poses_in(transforms, frame, world_frame, f"'{bag}'")
        except plans.UnconnectedError:  # a body in the tree of its camera
            if topic == names[0] and not plans.connected(transforms, package_frame, world_frame):
                raise
            stamps, rows, world, bad = plans.poses_in(transforms, frame, '', f"'{bag}'")
        world_frame = world_frame or world
        bodies.append(Body(
            bag_writer.as_messages(bags.absolute(topic), POSE, stamps, rows, world),
            f"{frame} in '{world}' of {bag}",
            {'transforms that are no poses': bad} if bad else {}, notes=tuple(
                f"{topic}: '{shown(link)}' comes at {rate_hz:.0f} Hz and is interpolated: an "
                f'error of {1e3 * error:.2g} mm (RMS), which counts as noise of the poses. '
                'Record it more often.' for link, rate_hz, error in plans.interpolation_noise(
                    transforms, frame, world, f"'{bag}'") if error > MIN_STATED_NOISE)))
    return bodies


def bodies_in_recording(
    bag: File, names: Sequence[str] = (), millimetres: bool = False, w_first: bool = False
) -> list[Body]:
    """
    Return poses of a recording, converted to m and to quaternions with w last, and other messages.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    names : sequence of str
        Topics to convert; default: all with poses.
    millimetres, w_first : bool
        Unit and order of the recorded numbers.

    Raises
    ------
    BellowsError
        If the recording cannot be read, or a topic has no poses.

    """
    counts, types = bags.topics(bag), bags.accepted_types('pose')
    chosen = [bags.absolute(name) for name in names] or [
        topic.name for topic in counts if topic.type_name in types and topic.messages]
    bodies = list[Body]()
    for stream in bags.read_streams(bag, {f'{name} pose': name for name in chosen}).values():
        assert isinstance(stream, PoseStream)
        values = np.hstack([
            stream.position * (1e-3 if millimetres else 1.0),
            rotation_to_quaternion(reordered(stream.rotation) if w_first else stream.rotation)])
        bodies.append(Body(
            bag_writer.as_messages(stream.name, POSE, stream.stamps_ns, values, stream.frame_id),
            os.fspath(bag), _refused_counts(stream)))
    return bodies + _copied_topics(bag, {topic.type_name for topic in counts}, chosen)


def _copied_topics(bag: File, types: Collection[str], without: Collection[str] = ()) -> list[Body]:
    """Return unchanged messages of some types, except on some topics."""
    grouped: dict[Channel, list[tuple[int, bytes]]] = {}
    for topic, log_ns, data in bags.messages_of(bag, types):
        if topic.name not in without:
            grouped.setdefault(topic, []).append((log_ns, data))
    return [
        Body(bag_writer.Encoded(
            topic.name, topic.type_name, np.array([at for at, _ in messages], dtype=np.int64),
            tuple(data for _, data in messages)), os.fspath(bag))
        for topic, messages in grouped.items()]


def to_bag(
    bodies: Sequence[Body], out: File, storage: str = 'mcap',
    replace: bool = False, span: Mapping[str, Any] = FULL_RANGE,
) -> Conversion:
    """
    Write bodies as a recording.

    Parameters
    ----------
    bodies : sequence of Body
        Bodies to write.
    out : path
        Folder to make.
    storage : str
        'mcap' or 'sqlite3'.
    replace : bool
        Whether an existing recording may be replaced.
    span : mapping
        Parameters 'recording.start' and 'recording.end', s, for a part.

    Raises
    ------
    BellowsError
        If no pose remains, or the output exists or cannot be written.

    """
    notes = [note for body in bodies for note in body.notes]
    notes += [
        f'{body.source} was never tracked; its topic is empty.' for body in bodies
        if not body.poses]
    # earlier stamps are times since a start
    undated = [body.source for body in bodies
               if body.poses and body.messages.stamps_ns[0] < 86400 * 10**9]
    if undated:
        notes.append(f'{", ".join(undated)}: the file has no date; the stamps start near zero.')
    masks = interval_masks([body.messages.stamps_ns for body in bodies], span)
    parts = tuple(body.at(mask) for body, mask in zip(bodies, masks, strict=True))
    if not any(body.poses for body in parts):
        reasons = '; '.join(
            f'{body.source}: {", ".join(f"{n} {reason}" for reason, n in body.left_out.items())}'
            for body in parts)
        raise BellowsError(f'No pose can be used: {reasons}. Lower --markers.')
    bag_writer.write_bag(out, [body.messages for body in parts], storage, replace=replace)
    world = next((body.world for body in bodies if body.world != 'z_up'), 'z_up')
    return Conversion(os.fspath(out), parts, world, tuple(notes))


def _bodies_in_file(source: Path, min_markers: int) -> list[Body]:
    """Return the bodies in a file, with the number of omitted frames."""
    if not os.path.isfile(source):
        raise BellowsError(
            f"'{source}' is not a file. Give a Motive CSV export, or a TUM file.")
    if source.suffix.lower() == '.csv' and trajectory_files.is_motive(source):
        return [Body(
            bag_writer.as_messages(
                _topic_of(body.name), POSE, body.stamps_ns, body.values, 'motive'),
            f'{source} ({body.name})', {reason: count for reason, count in (
                ('not tracked', body.missing), ('too few markers', body.unseen)) if count},
            'motive_y_up')
            for body in trajectory_files.read_motive(source, min_markers)]
    stamps, values = trajectory_files.read_tum(source)
    finite: Mask = np.asarray(np.isfinite(values).all(axis=1))
    kept = finite.copy()
    kept[finite] = np.diff(stamps[finite], prepend=-1) != 0
    repeated = int(finite.sum() - kept.sum())
    if repeated > MAX_REPEATED * len(stamps):
        raise BellowsError(
            f"'{source}': {repeated} of {len(stamps)} lines repeat the time before: times were "
            'written with too few digits (%g). Write all decimals, as %.9f does.')
    lost = {'not finite': int(np.sum(~finite)), 'repeated stamp': repeated}
    return [Body(
        bag_writer.as_messages(_topic_of(source.stem), POSE, stamps[kept], values[kept]),
        str(source), {reason: count for reason, count in lost.items() if count})]


def _topic_of(name: str) -> str:
    """Return a topic for the poses of a body."""
    word = re.sub(r'[^A-Za-z0-9_]+', '_', name).strip('_').lower() or 'body'
    return f'/{word}/pose' if not word[0].isdigit() else f'/body_{word}/pose'


def to_tum(
    bag: File, out: File, topic: str = '', span: Mapping[str, Any] = FULL_RANGE
) -> Conversion:
    """
    Write the poses of a topic of a recording as a TUM file.

    Parameters
    ----------
    bag : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    out : path
        Text file.
    topic : str, optional
        Topic of the poses; optional for a recording with a single topic of poses.
    span : mapping
        Parameters 'recording.start' and 'recording.end', s, for a part.

    Raises
    ------
    BellowsError
        If the recording cannot be read, or has several topics of poses.

    """
    if not topic:
        types = bags.accepted_types('pose')
        fitting = [t.name for t in bags.topics(bag) if t.type_name in types]
        if len(fitting) != 1:
            raise BellowsError(
                f"Recording '{bag}' has {len(fitting)} topics with poses"
                f'{": " + ", ".join(fitting) if fitting else ""}. Name one with --topic.')
        topic = fitting[0]
    stream = within_interval(bags.read_streams(bag, {'pose': topic}), span)['pose']
    trajectory_files.write_tum(out, stream.stamps_ns, pose_rows(stream))
    written = bag_writer.Encoded(stream.name, POSE, stream.stamps_ns, ())
    return Conversion(os.fspath(out), (Body(written, os.fspath(bag), _refused_counts(stream)),))


def _refused_counts(stream: PoseStream) -> dict[str, int]:
    """Return the numbers of rejected messages of a stream, by reason."""
    return {reason: len(where) for reason, where in stream.refused.items() if len(where)}
