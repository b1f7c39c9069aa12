"""The tool's pose from a tree of transforms, live from tf or recorded."""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.tuples import Quaternion, Vector
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.trajectory import NS_PER_S

QUEUE_LENGTH = 500
"""Transforms stored for each moving link."""

MAX_FRAMES = 10_000
"""Largest number of frames in a tree."""


class Chain:
    """
    Links of a tree from one frame to another, which may be on different branches.

    The links have different stamps. A pose is returned for each stamp of the moving link next to
    the tool, once the other links reach this stamp; the other links are interpolated.

    Parameters
    ----------
    world, tool : str
        Names of the frames.

    Attributes
    ----------
    dropped : int
        Number of stamps for which a link had no sample, or none in time.

    """

    def __init__(self, world: str, tool: str) -> None:
        self.world, self.tool, self.dropped = world, tool, 0
        self._parents: dict[str, str] = {}
        self._static: dict[str, PoseSample] = {}
        self._links: tuple[str | None, dict[str, str]] = '', {}
        self._update_links()

    def add(self, parent: str, child: str, sample: PoseSample, static: bool = False) -> None:
        """Add the pose of a child frame in its parent."""
        if child not in self._parents and len(self._parents) >= MAX_FRAMES:
            return
        was_static = self._static.pop(child, None) is not None
        if static:
            self._static[child] = sample
        if self._parents.get(child) != parent or static != was_static:
            self._parents[child] = parent
            self._update_links()
        samples = self._moving.get(child)
        if samples is None or (samples and sample.stamp_ns == samples[-1].stamp_ns):
            return  # repeated, as by joint state publishers
        if samples and sample.stamp_ns < samples[-1].stamp_ns:
            samples.clear()
        samples.append(sample)
        if child != self._first:
            return
        before = len(self._waiting)
        while self._waiting and self._waiting[-1] > sample.stamp_ns:  # the clock was set back
            self._waiting.pop()
        if len(self._waiting) == QUEUE_LENGTH:
            self._waiting.popleft()
        self.dropped += before - len(self._waiting)
        self._waiting.append(sample.stamp_ns)

    def _update_links(self) -> None:
        """Find the links between both frames; discard the samples of other links."""
        paths = [self._ancestors(frame) for frame in (self.tool, self.world)]
        shared = next((frame for frame in paths[0] if frame in paths[1]), None)
        self._branches = [
            path[:path.index(shared)] if shared is not None else [] for path in paths]
        moving = {link: self._parents[link] for branch in self._branches for link in branch
                  if link not in self._static}
        if (shared, moving) != self._links:
            self._links = shared, moving
            self._moving: dict[str, deque[PoseSample]] = {
                link: deque(maxlen=QUEUE_LENGTH) for link in moving}
            self._first = next(iter(moving), '')
            self._waiting: deque[int] = deque()

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, up to the root or the end of a loop."""
        path = [frame]
        while (frame := self._parents.get(frame, '')) and frame not in path:
            path.append(frame)
        return path

    @property
    def missing(self) -> str:
        """Reason for a missing pose of the tool, or ''."""
        if self._links[0] is None:
            roots = [self._ancestors(frame)[-1] for frame in (self.world, self.tool)]
            return (f"no transforms connect '{self.world}' and '{self.tool}': they lead up to "
                    f"'{roots[0]}' and '{roots[1]}'")
        if not self._moving:
            return f"'{self.tool}' does not move in '{self.world}': all transforms are static"
        silent = [link for link, samples in self._moving.items() if not samples]
        if silent or not self._waiting:
            return f"no transform of '{silent[0]}' has come" if silent else ''
        slow = min(self._moving, key=lambda link: self._moving[link][-1].stamp_ns)
        behind = (self._waiting[-1] - self._moving[slow][-1].stamp_ns) / NS_PER_S
        return f"the transforms of '{slow}' are {behind:.3g} s behind those of '{self._first}'"

    def due(self) -> Iterator[PoseSample]:
        """Yield the newly determined poses of the tool in the world."""
        others = [samples for link, samples in self._moving.items() if link != self._first]
        while self._waiting and all(o and o[-1].stamp_ns >= self._waiting[0] for o in others):
            stamp_ns = self._waiting.popleft()
            if any(samples[0].stamp_ns > stamp_ns for samples in self._moving.values()):
                self.dropped += 1
                continue
            tool, world = (self._pose(branch, stamp_ns) for branch in self._branches)
            R = t3.rotation_matrix(world.quaternion_xyzw)
            yield PoseSample(
                stamp_ns, t3.apply_transposed(R, t3.subtract(tool.position, world.position)),
                t3.quaternion_product(
                    t3.quaternion_conjugate(world.quaternion_xyzw), tool.quaternion_xyzw))

    def _pose(self, branch: Sequence[str], stamp_ns: int) -> PoseSample:
        """Return the pose of the first frame of a branch in the parent of the last frame."""
        o: Vector = t3.ZERO
        q: Quaternion = (0.0, 0.0, 0.0, 1.0)
        for link in branch:
            _, position, outer = self._static.get(link) or interpolated_pose(
                self._moving[link], stamp_ns)
            o = t3.add(position, t3.apply(t3.rotation_matrix(outer), o))
            q = t3.quaternion_product(outer, q)
        return PoseSample(stamp_ns, o, q)


def interpolated_pose(samples: Sequence[PoseSample], stamp_ns: int) -> PoseSample:
    """Return a link's pose at a stamp between two samples, the rotation along the chord."""
    after = bisect_left(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
    new = samples[after]
    if new.stamp_ns == stamp_ns:
        return new
    old = samples[after - 1]
    s = (stamp_ns - old.stamp_ns) / (new.stamp_ns - old.stamp_ns)
    p, q = old.quaternion_xyzw, new.quaternion_xyzw
    sign = -1.0 if sum(a * b for a, b in zip(p, q, strict=True)) < 0.0 else 1.0
    x, y, z, w = ((1.0 - s) * a + sign * s * b for a, b in zip(p, q, strict=True))
    chord = (x, y, z, w)
    return PoseSample(
        stamp_ns, t3.add_scaled(t3.scale(1.0 - s, old.position), s, new.position),
        t3.normalised(chord) if any(chord) else chord)
