"""Conversion of the poses of bodies in text files to a recording."""

from collections.abc import Sequence
import os
from pathlib import Path
import re
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Mask
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, File, trajectory_files
from bellows_ros.files.messages import POSE
from bellows_ros.files.trajectory_files import TrackedBody
import numpy as np

MAX_REPEATED = 0.1
"""Largest share of lines with the time of the previous line that is treated as faults of single
lines: a clock printed with too few digits repeats nearly all."""

FIRST_DATE_NS = 86_400 * NS_PER_S
"""Smallest stamp of a clock with a date, ns; a smaller stamp is a time since a start."""


class Body(NamedTuple):
    """Topic, source, and number of written poses of a body; number of other rows by reason."""

    topic: str
    source: str
    poses: int
    left_out: dict[str, int]


class BodyInFile(NamedTuple):
    """A tracked body, its file, and the recording.world of its poses."""

    body: TrackedBody
    source: File
    world: str


class Conversion(NamedTuple):
    """Recording, bodies, their recording.world ('z_up' or 'motive_y_up'), notes for the user."""

    out: str
    bodies: tuple[Body, ...]
    world: str
    notes: tuple[str, ...]


def convert(
    sources: Sequence[File], out: File, names: Sequence[str] = (),
    storage: str = 'mcap', replace: bool = False,
) -> Conversion:
    """
    Write the bodies in trajectory files as a recording.

    Parameters
    ----------
    sources : sequence of path
        Motive CSV exports, with a topic for each rigid body, or TUM files, with a topic each.
    out : path
        Folder to make.
    names : sequence of str
        Topics, in the order of files and bodies; default: '/NAME/pose'.
    storage : {'mcap', 'sqlite3'}
        Storage of the recording.
    replace : bool
        Whether an existing recording may be replaced.

    Raises
    ------
    BellowsError
        If a source cannot be read, topics are not one for each body, no pose remains, or the
        output exists or cannot be written.

    """
    found = [each for source in sources for each in _bodies(source)]
    topics = [bags.absolute(name) for name in names] or [_topic(each.body.name) for each in found]
    if not len(set(topics)) == len(topics) == len(found):
        raise BellowsError(
            f'There are {len(found)} bodies ({", ".join(each.body.name for each in found)}), and '
            f'the topics {", ".join(topics)}. Give a topic of its own for each, in this order.')
    tracked = [each for each in found if len(each.body.stamps_ns)]
    if not tracked:
        raise BellowsError('No pose can be used: ' + '; '.join(
            f"'{each.source}' ({each.body.name}): {each.body.left_out}" for each in found)
            + '. Track the bodies again.')
    notes = [f"'{each.body.name}' of '{each.source}' was never tracked; its topic is empty."
             for each in found if not len(each.body.stamps_ns)]
    notes += [f"'{each.source}' has no date: the stamps of '{each.body.name}' start near zero."
              for each in tracked if each.body.stamps_ns[0] < FIRST_DATE_NS]
    written, bodies = [], list[Body]()
    for topic, (body, source, world) in zip(topics, found, strict=True):
        frame = 'motive' if world == 'motive_y_up' else 'world'
        written.append(bags.as_messages(topic, POSE, body.stamps_ns, body.values, frame))
        bodies.append(Body(topic, f'{source} ({body.name})', len(body.stamps_ns), body.left_out))
    bags.write_bag(out, written, storage, replace=replace)
    return Conversion(
        os.fspath(out), tuple(bodies), min(each.world for each in found), tuple(notes))


def _bodies(source: File) -> list[BodyInFile]:
    """Return the bodies in a file."""
    if trajectory_files.is_motive(source):
        return [BodyInFile(body, source, 'motive_y_up')
                for body in trajectory_files.read_motive(Path(source))]
    return [BodyInFile(_tum_body(Path(source)), source, 'z_up')]


def _tum_body(source: Path) -> TrackedBody:
    """Return the body in a TUM file, without poses that are not finite or repeat a time."""
    stamps, values = trajectory_files.read_tum(source)
    finite: Mask = np.asarray(np.isfinite(values).all(axis=1))
    stamps, values = stamps[finite], values[finite]
    new = np.append(True, np.diff(stamps) != 0)[:len(stamps)]
    if np.mean(~new) > MAX_REPEATED:
        raise BellowsError(
            f"'{source}': {np.sum(~new)} of {len(finite)} lines repeat the time before: times "
            'were written with too few digits (%g). Write all decimals, as %.9f does.')
    lost = {'not finite': int(np.sum(~finite)), 'repeated stamp': int(np.sum(~new))}
    return TrackedBody(source.stem, stamps[new], values[new],
                       {reason: count for reason, count in lost.items() if count})


def _topic(name: str) -> str:
    """Return a topic for the poses of a body."""
    word = re.sub(r'[^A-Za-z0-9_]+', '_', name).strip('_').lower() or 'body'
    return f'/{word}/pose' if not word[0].isdigit() else f'/body_{word}/pose'
