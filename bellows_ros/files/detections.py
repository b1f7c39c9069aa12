"""Corners of detected tags, as apriltag_ros records them with the camera's calibration."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bellows_ros.core.sensors.camera import (
    Camera,
    camera_of,
    CornerViews,
    directions,
    tags_in,
    tags_of,
    tags_shown,
)
from bellows_ros.core.signals.screening import repeated, unusable_stamps
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, same_frame
from bellows_ros.errors import BellowsError, NoTopicError, shown
from bellows_ros.files import bags, File, messages
from bellows_ros.files.bags import absolute, Contents
from bellows_ros.files.messages import CAMERA_INFO, DETECTIONS
from bellows_ros.files.plans import ns_of, TRANSFORM
import numpy as np

TF_TOPIC = '/tf'


class TagSought(NamedTuple):
    """
    The detected tag on the package.

    Parameters
    ----------
    side : float
        Side of the tag, m; 0 if unknown.
    child_frame : str
        Frame of the tag on /tf, or its family and number.
    rectified : bool
        Whether the image was rectified before the detection.

    """

    side: float = 0.0
    child_frame: str = ''
    rectified: bool = False


NO_TAG = TagSought()


def read_contents(
    path: File, wanted: Mapping[str, str], tag: TagSought = NO_TAG
) -> Contents:
    """
    Read the streams of a recording, poses also from the detected corners of a tag.

    Parameters and errors are as for `bags.read_contents`; corners need the side of the tag. The
    topic `TF_TOPIC` stands for the poses of the tag's frame in its parent.
    """
    contents = bags.read_contents(path, wanted)
    missing = [role for role, problem in contents.problems.items()
               if isinstance(problem, NoTopicError)]
    if missing:
        kinds = {topic.name: topic.type_name for topic in bags.topics(path) if topic.messages}
        for role in missing:
            topic = absolute(wanted[role])
            if not role.endswith('twist') and kinds.get(topic) in (
                    DETECTIONS, messages.TRANSFORMS):
                try:
                    contents.streams[role] = (
                        _poses(read_views(path, topic, tag), tag.side)
                        if kinds[topic] == DETECTIONS else poses_on_tf(path, tag.child_frame))
                    del contents.problems[role]
                except BellowsError as problem:
                    contents.problems[role] = problem
    return contents


def poses_on_tf(path: File, child: str) -> PoseStream:
    """
    Return the poses of a frame in its parent, as a detector of tags publishes them on /tf.

    Raises
    ------
    BellowsError
        If the recording lacks the frame, or it has two parents.

    """
    name = child.lstrip('/')
    found = [each for topic, _, message in bags.messages_of(path, {messages.TRANSFORMS})
             if not topic.endswith('/tf_static') for each in message.transforms]
    own = sorted((ns_of(each.header.stamp), each.header.frame_id.lstrip('/'), each.transform)
                 for each in found if each.child_frame_id.lstrip('/') == name)
    parents = sorted({parent for _, parent, _ in own})
    if len(parents) != 1:
        others = ', '.join(map(shown, sorted({each.child_frame_id for each in found})))
        what = f"has the parents {', '.join(map(shown, parents))}" if own else 'is not there'
        raise BellowsError(
            f"Frame '{shown(name)}' of measured.child_frame {what} on /tf in recording "
            f"'{Path(path)}'. Frames: {others or 'none'}. Name one with one parent.")
    rows = [(stamp, stamp, 0, TRANSFORM(each)) for stamp, _, each in own]
    return messages.pose_stream(
        f'/tf, {name}', np.array(rows, messages.rows(7)), [(parents[0], name)])


def _poses(views: CornerViews, side: float) -> Any:
    """Return the poses of a tag with its corners; raise without its side."""
    if not side:
        raise BellowsError(
            f"Topic '{views.name}' has the corners of tag {views.tag}. Set measured.tag_size "
            'to the side of its black square, in m.')
    return views.poses(side)


def read_views(path: File, topic: str, tag: TagSought = NO_TAG) -> CornerViews:
    """
    Read the views of one tag.

    Parameters
    ----------
    path : path
        rosbag2 folder, or a bare .mcap or .db3 file.
    topic : str
        Topic of an AprilTagDetectionArray.
    tag : TagSought
        The tag; its side is not used.

    Returns
    -------
    CornerViews
        Directions of the corners, undistorted by the CameraInfo of the same frame.

    Raises
    ------
    BellowsError
        If the recording lacks the tag or the calibration of the camera, or has several tags and no
        number is given.

    """
    arrays = [(log_ns, array) for _, log_ns, array
              in bags.messages_of(path, {DETECTIONS}, topic)]
    tags = [tags_in(array) for _, array in arrays]
    name = _name_of(topic, path, tags, tag)
    frame = Counter(array.header.frame_id for _, array in arrays).most_common(1)[0][0]
    of_frame: dict[str, list[int]] = defaultdict(list)
    views, stamps, arrivals, places = [], [], [], []
    for place, (log_ns, array) in enumerate(arrays):
        seen = tags[place].get(name, [])
        if array.header.frame_id != frame:
            of_frame['frame_id'].append(place)
        elif len(seen) > 1:
            of_frame['tag_twice'].append(place)
        elif seen:
            stamp = array.header.stamp
            stamps.append(stamp.sec * NS_PER_S + stamp.nanosec)
            arrivals.append(log_ns)
            views.append(seen[0])
            places.append(place)
    camera, calibration = _calibration(path, frame, tag.rectified)
    corners = directions(np.array(views).reshape(-1, 4, 2), *camera)
    found = CornerViews(absolute(topic), frame, name, np.array(stamps, np.int64), corners,
                        calibration, {reason: tuple(at) for reason, at in of_frame.items()},
                        camera.matrix[0])
    return _usable(found, np.array(arrivals), np.array(places), path)


def _name_of(topic: str, path: File, views: list[Any], tag: TagSought) -> str:
    """Return family and number of the selected tag."""
    found = tags_of(views, tag.child_frame)
    if len(found) == 1:
        return next(iter(found))
    seen = ', '.join(f'{shown(name)} ({count} views)' for name, count in sorted(
        tags_of(views).items())) or 'none'
    what = f'{len(found)} tags' if found else f'no tag {shown(tag.child_frame)}'.rstrip()
    raise BellowsError(
        f"Topic '{topic}' in recording '{Path(path)}' has {what}; seen are: {seen}. "
        'Set measured.child_frame to family:number of one.')


def _calibration(path: File, frame: str, rectified: bool) -> tuple[Camera, str]:
    """Return the camera of a frame, and the topic of its calibration."""
    found: dict[Camera, str] = {}
    for topic, _, info in bags.messages_of(path, {CAMERA_INFO}):
        if same_frame(info.header.frame_id, frame):
            found.setdefault(camera_of(info, rectified), topic)
    if not found:
        raise BellowsError(
            f"Recording '{Path(path)}' has no {CAMERA_INFO} of the frame '{frame}', in which tags "
            "were detected. Record the camera's camera_info too.")
    if len(found) > 1:
        raise BellowsError(
            f"Recording '{Path(path)}' has {len(found)} calibrations of the frame '{frame}', on "
            f'{", ".join(sorted(found.values()))}. Record the one of the image in which tags are '
            'detected.')
    ((camera, topic),) = found.items()
    return camera, topic


def _usable(views: CornerViews, arrivals: Any, places: Any, path: File) -> CornerViews:
    """Return the usable views, and the indices of the unusable ones by reason."""
    refused = dict(views.refused)
    kept = messages.refuse(refused, places, {
        'zero_stamp': views.stamps_ns <= 0, 'tag_no_pose': ~tags_shown(views.corners)[0]})
    at = np.searchsorted(places, kept)
    kept = messages.refuse(refused, kept, unusable_stamps(views.stamps_ns[at], arrivals[at]))
    at = np.searchsorted(places, kept)
    kept = messages.refuse(refused, kept, {'repeated': repeated(
        np.linalg.norm(np.diff(views.corners[at], axis=0), axis=(1, 2)))})
    at = np.searchsorted(places, kept)
    if not len(kept):
        raise BellowsError(
            f"Topic '{views.name}' in recording '{Path(path)}' has no usable view of tag "
            f'{views.tag}: {messages.describe(refused)}. Check the camera, and record '
            'again.')
    return replace(views, stamps_ns=views.stamps_ns[at], corners=views.corners[at],
                   refused=refused)
