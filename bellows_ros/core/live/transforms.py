"""The tool's pose from a tree of transforms, as they arrive on tf."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.live.samples import PoseSample
from bellows_ros.core.model.kernels import ORIGIN

KEPT = 500
"""Transforms kept for each moving link."""

LARGEST_TREE = 10_000
"""Most frames in a tree."""

STATIC = 0
"""Stamp of static transforms."""

IDENTITY = PoseSample(STATIC, *ORIGIN[:2])


class Chain:
    """
    The way through the tree from one frame to another, which need not be above it.

    Each link has its own stamps. A pose is given for each stamp of the moving link that is next to
    the tool, as soon as the others reach it; these are interpolated.

    Parameters
    ----------
    world, tool : str
        Names of the frames.

    Attributes
    ----------
    dropped : int
        Stamps for which some link had nothing so old, or that waited too long for one.

    """

    def __init__(self, world: str, tool: str) -> None:
        """Start without transforms."""
        self.world, self.tool, self.dropped = world, tool, 0
        self._parents: dict[str, str] = {}
        self._left: dict[str, str | None] = {}  # with the last message, for another parent
        self._both: dict[str, tuple[str, str]] = {}
        self._static: dict[str, PoseSample] = {}
        self._found: tuple[str | None, list[tuple[str, str]]] = '', []
        self._follow()

    def add(self, parent: str, child: str, sample: PoseSample, static: bool = False) -> None:
        """Take the pose of a child frame in its parent."""
        if child not in self._parents and len(self._parents) >= LARGEST_TREE:
            return
        was_static = self._static.pop(child, None) is not None
        if static:
            self._static[child] = sample._replace(stamp_ns=STATIC)
        before = self._parents.get(child)
        if before != parent or static != was_static:
            if before is not None and self._left.get(child) == parent != before:
                self._both[child] = before, parent
            self._left[child] = before
            self._parents[child] = parent
            self._follow()
        elif child in self._left:
            del self._left[child]
        link = self._moving.get(child)
        if link is None:
            return
        if link and sample.stamp_ns == link[-1].stamp_ns:
            return  # repeated, as by publishers of joints
        if link and sample.stamp_ns < link[-1].stamp_ns:
            link.clear()
        link.append(sample)
        if child == self._first:
            self._wait_for(sample.stamp_ns)

    def _wait_for(self, stamp_ns: int) -> None:
        """Want a pose at a stamp; later ones, before the clock went back, are not."""
        before = len(self._waiting)
        while self._waiting and self._waiting[-1] > stamp_ns:
            self._waiting.pop()
        if len(self._waiting) == KEPT:
            self._waiting.popleft()
        self.dropped += before - len(self._waiting)
        self._waiting.append(stamp_ns)

    def _follow(self) -> None:
        """Find the chain of links; discard the links of another one."""
        ups = [self._up(self.tool), self._up(self.world)]
        shared = next((frame for frame in ups[0] if frame in ups[1]), None)
        self._ways = [up[:up.index(shared)] if shared is not None else [] for up in ups]
        moving = [(link, self._parents[link]) for way in self._ways for link in way
                  if link not in self._static]
        if (shared, moving) == self._found:
            return
        self._found = shared, moving
        self._moving: dict[str, deque[PoseSample]] = {
            link: deque(maxlen=KEPT) for link, _ in moving}
        self._first = moving[0][0] if moving else ''
        self._waiting: deque[int] = deque()

    def _up(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, up to the root or a circle."""
        way = [frame]
        while (frame := self._parents.get(frame, '')) and frame not in way:
            way.append(frame)
        return way

    @property
    def missing(self) -> str:
        """Why there is no pose of the tool, or ''."""
        ups = [self._up(frame) for frame in (self.world, self.tool)]
        for frame in (*ups[0], *ups[1]):
            if frame in self._both:
                one, other = self._both[frame]
                return f"'{frame}' has two alternating parents, '{one}' and '{other}'"
        if self._found[0] is None:
            for way in ups:
                if way[-1] in self._parents:
                    return (f"the transforms form a loop: '{self._parents[way[-1]]}' is above "
                            f"'{way[-1]}', and below it")
            return (f"no transforms connect '{self.world}' and '{self.tool}': they lead up to "
                    f"'{ups[0][-1]}' and '{ups[1][-1]}'")
        if not self._moving:
            return f"'{self.tool}' does not move in '{self.world}': all transforms are static"
        silent = [link for link, samples in self._moving.items() if not samples]
        if silent or not self._waiting:
            return f"no transform of '{silent[0]}' has come" if silent else ''
        slow = min(self._moving, key=lambda link: self._moving[link][-1].stamp_ns)
        behind = (self._waiting[-1] - self._moving[slow][-1].stamp_ns) * 1e-9
        return f"the transforms of '{slow}' are {behind:.3g} s behind those of '{self._first}'"

    def due(self) -> Iterator[PoseSample]:
        """Yield the tool's poses in the world that are now known."""
        others = [samples for link, samples in self._moving.items() if link != self._first]
        while self._waiting and all(o and o[-1].stamp_ns >= self._waiting[0] for o in others):
            stamp_ns = self._waiting.popleft()
            if any(samples[0].stamp_ns > stamp_ns for samples in self._moving.values()):
                self.dropped += 1
                continue
            tool, world = (self._pose(way, stamp_ns) for way in self._ways)
            yield relative(world, tool)._replace(stamp_ns=stamp_ns)

    def _pose(self, way: Sequence[str], stamp_ns: int) -> PoseSample:
        """Return the pose of the first frame of a way in the parent of the last."""
        pose = IDENTITY
        for link in way:
            pose = composed(self._static.get(link) or at(self._moving[link], stamp_ns), pose)
        return pose


def at(samples: Sequence[PoseSample], stamp_ns: int) -> PoseSample:
    """Return a link at a stamp from the first to the last; the turn between two is a chord."""
    after = bisect_left(samples, stamp_ns, key=lambda sample: sample.stamp_ns)
    new = samples[after]
    if new.stamp_ns == stamp_ns:
        return new
    old = samples[after - 1]
    part = (stamp_ns - old.stamp_ns) / (new.stamp_ns - old.stamp_ns)
    p, q = old.quaternion_xyzw, new.quaternion_xyzw
    sign = -1.0 if sum(a * b for a, b in zip(p, q, strict=True)) < 0.0 else 1.0
    x, y, z, w = ((1.0 - part) * a + sign * part * b for a, b in zip(p, q, strict=True))
    chord = (x, y, z, w)
    return PoseSample(
        stamp_ns, t3.add_scaled(t3.scale(1.0 - part, old.position), part, new.position),
        t3.normalised(chord) if any(chord) else chord)


def composed(outer: PoseSample, inner: PoseSample) -> PoseSample:
    """Return a pose given in another pose."""
    turned = t3.apply(t3.rotation_matrix(outer.quaternion_xyzw), inner.position)
    return PoseSample(
        outer.stamp_ns, t3.add(outer.position, turned),
        t3.quaternion_product(outer.quaternion_xyzw, inner.quaternion_xyzw))


def relative(base: PoseSample, pose: PoseSample) -> PoseSample:
    """Return a pose relative to another, both given in the same frame."""
    back = t3.subtract(pose.position, base.position)
    return PoseSample(
        pose.stamp_ns, t3.apply_transposed(t3.rotation_matrix(base.quaternion_xyzw), back),
        t3.quaternion_product(t3.quaternion_conjugate(base.quaternion_xyzw), pose.quaternion_xyzw))
