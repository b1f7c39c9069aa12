"""Conversion of the poses of bodies in text files to a recording."""

from collections.abc import Sequence
import os
from pathlib import Path
import re
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Mask
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, File, trajectory_files
from bellows_ros.files.messages import POSE
from bellows_ros.files.trajectory_files import TrackedBody
import numpy as np

MAX_REPEATED = 0.1
"""Largest share of lines with the time of the previous line that is treated as faults of single
lines: a clock printed with too few digits repeats nearly all."""


class Body(NamedTuple):
    """Topic, source, and number of written poses of a body; number of other rows by reason."""

    topic: str
    source: str
    poses: int
    left_out: dict[str, int]


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
    worlds = ['motive_y_up' if trajectory_files.is_motive(source) else 'z_up'
              for source in sources]
    found = [(body, source, world) for source, world in zip(sources, worlds, strict=True)
             for body in _bodies(Path(source), world)]
    topics = [bags.absolute(name) for name in names] or [_topic(b.name) for b, *_ in found]
    if not len(set(topics)) == len(topics) == len(found):
        raise BellowsError(
            f'There are {len(found)} bodies ({", ".join(body.name for body, *_ in found)}), and '
            f'the topics {", ".join(topics)}. Give a topic of its own for each, in this order.')
    notes = [f"'{body.name}' of '{source}' was never tracked; its topic is empty."
             for body, source, _ in found if not len(body.stamps_ns)]
    # An earlier stamp is a time since a start.
    notes += [f"'{source}' has no date: the stamps of '{body.name}' start near zero."
              for body, source, _ in found if 0 < len(body.stamps_ns)
              and body.stamps_ns[0] < 86400 * 10**9]
    if not any(len(body.stamps_ns) for body, *_ in found):
        raise BellowsError('No pose can be used: ' + '; '.join(
            f"'{source}' ({body.name}): {body.left_out}" for body, source, _ in found)
            + '. Track the bodies again.')
    bags.write_bag(out, [
        bags.as_messages(topic, POSE, body.stamps_ns, body.values,
                         'motive' if world == 'motive_y_up' else 'world')
        for topic, (body, _, world) in zip(topics, found, strict=True)],
        storage, replace=replace)
    bodies = tuple(Body(topic, f'{source} ({body.name})', len(body.stamps_ns), body.left_out)
                   for topic, (body, source, _) in zip(topics, found, strict=True))
    return Conversion(os.fspath(out), bodies, min(worlds), tuple(notes))


def _bodies(source: Path, world: str) -> list[TrackedBody]:
    """Return the bodies in a file, without poses that are not finite or repeat a time."""
    if world == 'motive_y_up':
        return trajectory_files.read_motive(source)
    stamps, values = trajectory_files.read_tum(source)
    finite: Mask = np.asarray(np.isfinite(values).all(axis=1))
    stamps, values = stamps[finite], values[finite]
    new = np.append(True, np.diff(stamps) != 0)[:len(stamps)]
    if np.mean(~new) > MAX_REPEATED:
        raise BellowsError(
            f"'{source}': {np.sum(~new)} of {len(finite)} lines repeat the time before: times "
            'were written with too few digits (%g). Write all decimals, as %.9f does.')
    lost = {'not finite': int(np.sum(~finite)), 'repeated stamp': int(np.sum(~new))}
    return [TrackedBody(source.stem, stamps[new], values[new],
                        {reason: count for reason, count in lost.items() if count})]


def _topic(name: str) -> str:
    """Return a topic for the poses of a body."""
    word = re.sub(r'[^A-Za-z0-9_]+', '_', name).strip('_').lower() or 'body'
    return f'/{word}/pose' if not word[0].isdigit() else f'/body_{word}/pose'
