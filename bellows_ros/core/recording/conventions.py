"""Units and quaternion orders in which poses of tool and package fit together."""

from dataclasses import replace
from itertools import product
import os
from typing import NamedTuple, TypeVar

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.parameters.table import short
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
import numpy as np

SAMPLES = 300
"""Poses that are compared."""

FARTHEST = 2.0
"""Distance (m) of the package from the tool that no cup reaches."""

REACH, MOST_CHANGE = (0.01, 0.5), 0.25
"""Distances (m) of a held package, and by which part they vary at most: two worlds are no other
convention."""

BETTER = 0.4
"""Part of the motion of the package in the tool that is left with another order, at most ..."""

HANGING, ASKEW = 0.2, 0.5
"""... or how far from hanging it is at most where it hangs, and beyond which it does not (see
`_motion`): poses of two worlds come near to hanging by chance."""


class Convention(NamedTuple):
    """How poses were recorded: positions in mm, quaternions with w first."""

    millimetres: bool = False
    w_first: bool = False

    @property
    def words(self) -> str:
        """What is wrong, as in 'The poses of x are ...'."""
        return ' and '.join([*['in millimetres'] * self.millimetres,
                             *['of quaternions with w first'] * self.w_first])


def reordered(rotation: Array) -> Array:
    """Return rotations (N, 3, 3) whose quaternions were read as if w came last."""
    return lie.quaternion_to_rotation(np.roll(lie.rotation_to_quaternion(rotation), -1, axis=-1))


Poses = TypeVar('Poses', PoseStream, Trajectory)


def converted(poses: Poses, own: Convention) -> Poses:
    """Return poses in metres, with w last, that were recorded by a convention."""
    return replace(poses, position=poses.position * (1e-3 if own.millimetres else 1.0),
                   rotation=reordered(poses.rotation) if own.w_first else poses.rotation)


def conventions_of(tool: PoseStream, package: PoseStream) -> tuple[Convention, Convention]:
    """Return the conventions of two streams of one world; as they should be where they may be."""
    first = max(tool.stamps_ns[0], package.stamps_ns[0])
    last = min(tool.stamps_ns[-1], package.stamps_ns[-1])
    units = Convention(), Convention()
    if last <= first:
        return units
    stamps = np.linspace(0, last - first, SAMPLES).astype(np.int64) + first
    bodies = [resample(own.trajectory(), np.unique(stamps)) for own in (tool, package)]
    if _distance(bodies, units)[0] > FARTHEST:
        both = [(Convention(a), Convention(b)) for a, b in product((False, True), repeat=2)]
        units = min((own for own in both if _is_held(bodies, own)),
                    key=lambda own: _distance(bodies, own)[1], default=units)
    if not _is_held(bodies, units):
        return units
    orders = [(units[0]._replace(w_first=a), units[1]._replace(w_first=b))
              for a, b in product((False, True), repeat=2)]
    seen = [_motion(bodies, own) for own in orders]
    best = int(np.argmin([sum(own) for own in seen]))
    (moves, hangs), (before, hung) = seen[best], seen[0]
    upright = moves < before and hangs < HANGING and ASKEW < hung
    return orders[best] if moves < BETTER * before or upright else units


def _is_held(bodies: list[Trajectory], units: tuple[Convention, Convention]) -> bool:
    """Return whether the bodies are apart as tool and package, in some units."""
    distance, change = _distance(bodies, units)
    return REACH[0] < distance < REACH[1] and change < MOST_CHANGE


def _distance(
    bodies: list[Trajectory], units: tuple[Convention, Convention]
) -> tuple[float, float]:
    """Return the median distance of the bodies, m, and by which part it varies."""
    tool, package = map(converted, bodies, units)
    distance = np.linalg.norm(package.position - tool.position, axis=1)
    low, middle, high = np.percentile(distance, (25, 50, 75))
    return float(middle), float((high - low) / max(middle, 1e-12))


def _motion(bodies: list[Trajectory], given: tuple[Convention, Convention]) -> tuple[float, float]:
    """
    Return how the package moves in the tool, and how far it is from hanging along its z axis.

    The first is a turn (rad) and a way in parts of the distance, the second of two cosines.
    """
    tool, package = map(converted, bodies, given)
    back = np.swapaxes(tool.rotation, 1, 2)
    offset, turned = lie.apply(back, package.position - tool.position), back @ package.rotation
    offset = offset / np.median(np.linalg.norm(offset, axis=1))
    turn = lie.log_so3(turned[len(turned) // 2].T @ turned)
    return (spread(offset) + spread(turn),
            2.0 + float(np.mean(offset[:, 2]) - np.mean(turned[:, 2, 2])))


def spread(values: Array) -> float:
    """Return the norm of the interquartile ranges of values (N, 3)."""
    return float(np.linalg.norm(np.subtract(*np.percentile(values, (75, 25), axis=0))))


def convention_sentence(
    tool: PoseStream, package: PoseStream, bag: str | os.PathLike[str] = ''
) -> str:
    """Return what is said of two streams that fit in other conventions, with commands, or ''."""
    names: dict[Convention, list[str]] = {}
    for own, stream in zip(conventions_of(tool, package), (tool, package), strict=True):
        names.setdefault(own, []).append(stream.name)
    wrong = {own: topics for own, topics in names.items() if own.words}
    if not wrong:
        return ''
    source = first = short(os.fspath(bag)) or 'RECORDING'
    commands = []
    for number, (own, topics) in enumerate(wrong.items(), 1):
        out = f"{first.rstrip('/')}_converted{number if number > 1 else ''}"
        options = [f'--topic {topic}' for topic in topics]
        options += ['--unit mm'] * own.millimetres + ['--quaternion wxyz'] * own.w_first
        commands.append(f"bellows convert {source} {' '.join(options)} --out {out}")
        source = out
    what = '; '.join(f"The poses of {' and '.join(map(repr, topics))} are {own.words}"
                     for own, topics in wrong.items())
    return f"{what}. Correct the driver, or convert the recording: '{' && '.join(commands)}'."
