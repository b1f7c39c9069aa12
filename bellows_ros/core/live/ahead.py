"""
The tool's future while a plan is driven: where on the plan the tool is, and what is left of it.

Drivers start late and run scaled, so the plan is anchored to the tool: to the plan's nearest time
along its path, not to the clock. Pure code, no ROS.
"""

from __future__ import annotations

from bellows_ros.core.arrays import Array
from bellows_ros.core.lie import quaternion_to_rotation, rotation_to_quaternion
from bellows_ros.core.live.flight import steadily
from bellows_ros.core.live.payload import extrapolated
from bellows_ros.core.live.samples import Prediction
from bellows_ros.core.resampling import resample
from bellows_ros.core.trajectory import NS_PER_S, Trajectory
import numpy as np

LEVER = 0.1
"""A turn by 1 rad counts as so far (m)."""
WINDOW = 0.25
"""So far ahead (s of the plan) of where it is expected the tool is sought."""
AT_ONCE = 2e-4
"""Places of the plan whose distances differ by less (m) are distinguished by the clock."""
OFF = 0.05
"""A tool so far (m) from the plan does not drive it."""

MOVING = 0.05
"""Where the plan is faster than this part of its highest speed, it shows how fast it is driven."""
SLOWEST, QUICKEST = 0.1, 2.0
"""Factors on the plan's speed that a driver may have; below it pauses."""

NEWEST = 0.8
"""Weight of the newest such factor beside those before."""

JOIN_SPEED, LONGEST_JOIN = 0.05, 0.1
"""The tool comes back to the plan at this speed (m/s), within this time (s)."""
SPACING = 0.01
"""Points of the rest of a plan are no nearer to each other (s)."""


class Ahead:
    """
    A plan of the tool that is being driven, or will be.

    Parameters
    ----------
    plan : Trajectory
        Of E in the world with body twists.
    stamp_ns : int
        When it starts, ns; 0 for when the tool starts.

    Attributes
    ----------
    progress : float
        s of the plan.
    rate : float
        Its speed is so many times that of the plan.
    done, off : bool
        Whether the tool has arrived, and whether it is elsewhere.

    """

    def __init__(self, plan: Trajectory, stamp_ns: int) -> None:
        """Take the plan."""
        self.plan, self._stamp_ns = plan, stamp_ns
        self._seconds = plan.seconds
        self._pose = np.hstack([plan.position, rotation_to_quaternion(plan.rotation)])
        self._twist = np.asarray(plan.twist) * np.repeat([1.0, LEVER], 3)
        speed = np.linalg.norm(self._twist, axis=1)
        self._moving = speed > MOVING * speed.max()
        gaps = np.diff(self._seconds)
        self._half = 0.5 * speed * np.maximum(np.append(gaps, 0.0), np.append(0.0, gaps))
        self.progress, self.rate = 0.0, 1.0
        self.done = self.off = False
        self._seen_ns = -1

    def distances(self, now: Prediction) -> Array:
        """Return how far (N,) the tool is from each point of the plan, m."""
        o, q, _, _ = now.tool
        turned = 2.0 * np.sqrt(np.maximum(0.0, 2.0 - 2.0 * np.abs(self._pose[:, 3:] @ q)))
        far: Array = np.hypot(np.linalg.norm(self._pose[:, :3] - o, axis=1), LEVER * turned)
        return far

    def follow(self, now: Prediction) -> None:
        """Find where on the plan the tool is, and how fast it is driven."""
        expected = self._expected(now.stamp_ns)
        self._seen_ns = now.stamp_ns
        far = self.distances(now)
        allowed = (self._seconds >= self.progress - 1e-9) & (
            self._seconds <= max(expected, self.progress) + WINDOW)
        far[~allowed] = np.inf
        self.off = bool(far.min() > OFF)
        near = np.flatnonzero(far <= far.min() + AT_ONCE + self._half)
        i = int(near[np.argmin(np.abs(self._seconds[near] - expected))])
        self.progress = max(self.progress, self._projected(i, now))
        self.done = self.progress >= self._seconds[-1] - 1e-3
        self._measure(i, now)

    def _expected(self, stamp_ns: int) -> float:
        """Return where it would be by the clock, s of the plan."""
        if self._seen_ns >= 0 and self.progress > 0.0:
            return self.progress + self.rate * (stamp_ns - self._seen_ns) / NS_PER_S
        return max(0.0, (stamp_ns - self._stamp_ns) / NS_PER_S) if self._stamp_ns else 0.0

    def _projected(self, i: int, now: Prediction) -> float:
        """Return the time of the plan (s) near a point at which the tool is nearest."""
        if not self._moving[i]:
            return float(self._seconds[i])
        R = self.plan.rotation[i]
        turn = quaternion_to_rotation(np.array(now.tool[1]))
        angle = 0.5 * (R.T @ turn - turn.T @ R)[[2, 0, 1], [1, 2, 0]]
        way = np.concatenate([np.array(now.tool[0]) - self._pose[i, :3], LEVER * angle])
        rate = np.concatenate([R @ self._twist[i, :3], self._twist[i, 3:]])
        return float(np.clip(
            self._seconds[i] + way @ rate / (rate @ rate), 0.0, self._seconds[-1]))

    def _measure(self, i: int, now: Prediction) -> None:
        """Note how fast the plan is driven, where it moves; not while the driver pauses."""
        if not self._moving[i]:
            return
        planned = self._twist[i]
        twist = np.array([*now.tool[2], *now.tool[3]]) * np.repeat([1.0, LEVER], 3)
        rate = float(twist @ planned) / float(planned @ planned)
        if rate > SLOWEST:
            self.rate += NEWEST * (min(rate, QUICKEST) - self.rate)

    def rest(self, now: Prediction, spacing: float = SPACING) -> Trajectory:
        """Return what is left of the plan, from the tool as it is; stamps count from now."""
        wait = 0.0
        if self.progress == 0.0 and self._stamp_ns > now.stamp_ns:
            wait = (self._stamp_ns - now.stamp_ns) / NS_PER_S
        error = float(self.distances(now)[np.argmin(np.abs(self._seconds - self.progress))])
        join = min(LONGEST_JOIN, error / JOIN_SPEED)
        first = self.progress + max(join, 1e-4 if wait == 0.0 else 0.0)
        left = np.flatnonzero(self._seconds >= first)
        if not len(left):
            left = np.array([len(self.plan) - 1])
        kept = left[:: max(1, round(spacing * (len(left) - 1) / max(
            self._seconds[left[-1]] - self._seconds[left[0]], 1e-9)))]
        kept = kept if kept[-1] == left[-1] else np.append(kept, left[-1])
        later = wait + np.maximum(self._seconds[kept] - self.progress, 1e-4) / self.rate
        o, q, v, w = now.tool
        return Trajectory(
            np.append(0, np.round(later * NS_PER_S)).astype(np.int64),
            np.vstack([o, self.plan.position[kept]]),
            np.concatenate([quaternion_to_rotation(np.array(q))[None], self.plan.rotation[kept]]),
            np.vstack([(*v, *w), np.asarray(self.plan.twist)[kept] * self.rate]))


def future(ahead: Ahead | None, now: Prediction, duration: float) -> Trajectory:
    """Return the tool going on for a time (s) from a prediction, by its plan or steadily."""
    if ahead is None or ahead.done or ahead.off:
        return steadily(now, duration)
    rest = ahead.rest(now)
    end_ns = round(duration * NS_PER_S)
    if rest.stamps_ns[-1] >= end_ns:
        inside = rest.stamps_ns[(rest.stamps_ns > 0) & (rest.stamps_ns < end_ns)]
        return resample(rest, np.concatenate([[0], inside, [end_ns]]))
    last = rest.select(slice(-1, None))
    twist = np.asarray(last.twist)[0]
    state = (tuple(last.position[0].tolist()),
             tuple(rotation_to_quaternion(last.rotation[0]).tolist()),
             tuple(twist[:3].tolist()), tuple(twist[3:].tolist()))
    o, q, v, w = extrapolated(state, (end_ns - int(rest.stamps_ns[-1])) / NS_PER_S)
    return Trajectory(
        np.append(rest.stamps_ns, end_ns), np.vstack([rest.position, o]),
        np.concatenate([rest.rotation, quaternion_to_rotation(np.array(q))[None]]),
        np.vstack([np.asarray(rest.twist), (*v, *w)]))
