"""
What is wrong when measured poses are not where they should be: likelihood ratios of causes.

A fault that sets in at some time makes known changes of all later innovations, up to its size.
Their likelihood with a fault, its size averaged over what is usual, over that without is a
martingale where nothing is wrong. Summed over the onsets, and over the causes by how usual they
are, it grows by 1 with each onset on average: it is A or more after A onsets at the earliest, on
average (Shiryaev and Roberts), so that the threshold follows from the false alarms allowed.

The error of `filter` is extended by faults (41,): the cup's length (m) and its rate (m/s), the
part by which its spring's force and moment are too small, shift and turn of the camera's frame in
the world (m, rad), how far a lip that is measured has slipped (m), whether the force of the
cup is gone, and speed and shift (m/s, m) of the fall that follows.
"""

from __future__ import annotations

from typing import NamedTuple

from bellows_ros.core.arrays import Array
from bellows_ros.core.kernels import lip_wrench, ModelTuple, State
from bellows_ros.core.lie import hat
from bellows_ros.core.observer.filter import BIAS, EXTENDED, Innovation, SIZE, ZERO
from bellows_ros.core.tuples import apply, Quaternion, rotation_matrix, Vector
import numpy as np

LENGTHENED, LENGTHENING, FORCE, MOMENT = range(SIZE, SIZE + 4)
FRAME, SLIPPED = slice(SIZE + 4, SIZE + 10), slice(SIZE + 10, SIZE + 12)
GONE, SPEED, FALL = SIZE + 12, slice(SIZE + 13, SIZE + 16), slice(SIZE + 16, SIZE + 19)


class Cause(NamedTuple):
    """A kind of fault."""

    name: str
    rows: tuple[int, ...]
    """Of the extended error, one for each number of its size."""
    usual: tuple[float, ...]
    """Standard deviations of its size."""
    share: float
    """Of all faults."""
    at_start: bool
    sets_in: bool
    """Whether it may be there from the beginning, and whether it may set in."""
    words: str
    """Finding, and what to do."""
    unit: float = 1e3


CAUSES = (
    Cause('slip', (13, 14), (3e-3, 3e-3), 0.4, False, True,
          'The grip has slipped by {:.1f} mm: move slower, or raise the vacuum.'),
    Cause('leak', (LENGTHENING,), (5e-3,), 0.15, False, True,
          'The cup gives way by {:.1f} mm/s, as with a leak: look at its lip and the vacuum.'),
    Cause('wear', (FORCE, MOMENT), (0.2, 0.2), 0.1, True, False,
          'The stiffness of the cup is off by {:.0f} %: it is worn, or another one is mounted; '
          "identify it with 'bellows identify'.", 100.0),
    Cause('payload', (12, 13, 14, 15), (0.2, 0.01, 0.01, 0.01), 0.1, True,
          False,
          'Mass or centre of mass are not those of package.*: correct them, or set '
          'payload.estimate.'),
    Cause('lost', (GONE,), (0.3,), 0.1, False, True,
          'The package is lost: stop the arm.'),
    Cause('camera', tuple(range(FRAME.start, FRAME.stop)), (0.01,) * 6, 0.15,
          True, True,
          'The frame of the camera has moved by {:.1f} mm: calibrate it.'),
)
"""What is looked for."""

ROWS = tuple(row for cause in CAUSES for row in cause.rows)
SHARES = np.log([cause.share for cause in CAUSES])
USUAL = np.array([std for cause in CAUSES for std in cause.usual])
JUMPS: Array = np.zeros((EXTENDED, len(ROWS)))
"""The error that each number of a size makes where it sets in."""
MEAN = np.where(np.array(ROWS) == GONE, 1.0, 0.0)
"""A package that is lost has lost all of the cup's force."""
JUMPS[ROWS, range(len(ROWS))] = 1.0
JUMPS[:2, :2] = JUMPS[SLIPPED, :2] = np.eye(2)  # a package that slips moves, its lip does not

ONSET_NS = 100_000_000
"""Time (ns) between two onsets that are looked at."""

ONSETS = 12
"""So many of them, and the beginning."""

LEAST = 3
"""Measurements after an onset without which nothing is said."""

SURE, DECIDE_NS = 3.0, 200_000_000
"""A cause is named when it is ahead of the next by so much, or so long (ns) after half-way."""

CONFIRMED = 2
"""Nor before so many measurements after half-way to the threshold: one jump can be anything."""

UNEXPLAINED = 0.2
"""A cause leaves no more of what is unusual: wild measurements have none."""


class Alarm(NamedTuple):
    """What was found to be wrong."""

    stamp_ns: int
    cause: str
    size: float
    """m, m/s or 1."""
    words: str


def extended(
    model: ModelTuple, tool: State, body: State, F: Array, seconds: float, passage: Array
) -> Array:
    """
    Return a passage (41, 41) of the extended error from then to now, one sample further.

    Parameters
    ----------
    model, tool, body : tuples
        At the beginning of the sample.
    F : ndarray (12, 23)
        Of `filter.carried`.
    seconds : float
        Of the sample.
    passage : ndarray (41, 41)
        Up to its beginning.

    """
    force, moment = lip_wrench(model, (*tool[:2], ZERO, ZERO), (*body[:2], ZERO, ZERO))
    push = F[:, BIAS]
    T: Array = np.zeros((12, EXTENDED))
    T[:, :LENGTHENING] = F
    T[:, LENGTHENING] = 0.5 * seconds * F[:, LENGTHENED]
    T[:, FORCE], T[:, MOMENT] = push[:, :3] @ force, push[:, 3:] @ moment
    later = passage.copy()
    later[:12] = T @ passage
    later[LENGTHENED] += seconds * passage[LENGTHENING]
    pull = apply(rotation_matrix(body[1]), lip_wrench(model, tool, body)[0])
    drop = np.multiply.outer(np.array(pull) * (-seconds / model[1][0]), passage[GONE])
    later[FALL] += seconds * (passage[SPEED] + 0.5 * drop)
    later[SPEED] += drop
    return later


class Alarms:
    """
    Look for causes in the innovations, one after the other.

    Parameters
    ----------
    false_per_hour : float
        How many false alarms are allowed.

    """

    def __init__(self, false_per_hour: float) -> None:
        """Know of nothing."""
        self._threshold = float(np.log(3.6e12 / ONSET_NS / false_per_hour))
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.last_ns = -1
        self._E: Array = np.zeros((EXTENDED, 0))
        self._information: Array = np.zeros((0, len(ROWS), len(ROWS)))
        self._evidence: Array = np.zeros((0, len(ROWS)))
        self._total: Array = np.zeros(0)  # of the squared distances since each onset
        self._onsets: list[tuple[int, int]] = []  # stamp, measurements since
        self._half_way: list[int] = []  # stamps since half-way to the threshold

    def step(
        self, stamp_ns: int, passage: Array, found: Innovation, used: bool,
        position: Vector, quaternion_xyzw: Quaternion,
    ) -> Alarm | None:
        """
        Take the next innovation, and say what is wrong.

        Parameters
        ----------
        stamp_ns : int
            Of the measurement.
        passage : ndarray (41, 41)
            Of the extended error since then.
        found : Innovation
            Of its pose.
        used : bool
            Whether the estimate was corrected with it.
        position, quaternion_xyzw : tuple
            Measured pose of B in the world.

        """
        if not self._onsets or stamp_ns - self._onsets[-1][0] >= ONSET_NS:
            self._begin(stamp_ns)
        self.last_ns = stamp_ns
        self._take(passage, found, used, _sight(found.H, position, quaternion_xyzw))
        self._onsets = [(onset, count + 1) for onset, count in self._onsets]
        return self._judge(stamp_ns)

    def lost(self, stamp_ns: int) -> Alarm:
        """Return that the package is lost."""
        self.forget()
        return Alarm(stamp_ns, 'lost', 1.0, next(c.words for c in CAUSES if c.name == 'lost'))

    def _begin(self, stamp_ns: int) -> None:
        """Look at another onset, and no longer at the oldest but the first."""
        n = len(ROWS)
        keep = [k for k in range(len(self._onsets)) if k != 1 or len(self._onsets) <= ONSETS]
        self._onsets = [self._onsets[k] for k in keep] + [(stamp_ns, 0)]
        columns = [c for k in keep for c in range(k * n, k * n + n)]
        self._E = np.hstack([self._E[:, columns], JUMPS])
        self._information = np.concatenate([self._information[keep], np.zeros((1, n, n))])
        self._evidence = np.concatenate([self._evidence[keep], np.zeros((1, n))])
        self._total = np.append(self._total[keep], 0.0)

    def _take(self, passage: Array, found: Innovation, used: bool, C: Array) -> None:
        """Follow what each fault makes of the error, and compare with the innovation."""
        E = passage @ self._E
        made = C @ E
        root = np.linalg.inv(np.linalg.cholesky(found.S))
        y = root @ found.y
        seen = (root @ made).reshape(6, len(self._onsets), len(ROWS)).transpose(1, 0, 2)
        self._information += seen.transpose(0, 2, 1) @ seen
        self._evidence += y @ seen
        self._total += found.distance
        if used:
            E[:SIZE] -= found.gain @ made
        self._E = E

    def _ratios(self) -> Array:
        """Return the logarithms of the likelihood ratios, by onset and cause."""
        out = np.full((len(self._onsets), len(CAUSES)), -np.inf)
        counts = np.array([count for _, count in self._onsets])
        enough = counts >= LEAST
        usual = 6.0 * counts + 4.0 * np.sqrt(12.0 * counts)
        at = 0
        for k, cause in enumerate(CAUSES):
            part = slice(at, at + len(cause.rows))
            at = part.stop
            rows = enough.copy()
            rows[0] &= cause.at_start
            rows[1:] &= cause.sets_in
            if not rows.any():
                continue
            J, d = self._information[rows, part, part], self._evidence[rows, part]
            mean, std = MEAN[part], USUAL[part]
            d = d - J @ mean
            shift = d @ mean + 0.5 * mean @ J @ mean
            A = np.eye(len(std)) + J * std[:, None] * std
            z = d * std
            best = np.linalg.solve(A, z[..., None])[..., 0]
            explained = (z * best).sum(axis=1) + 2.0 * shift
            left = self._total[rows] - explained
            fits = left <= usual[rows] + UNEXPLAINED * explained
            ratio = 0.5 * (explained - np.linalg.slogdet(A)[1])
            out[rows, k] = np.where(fits, ratio, -np.inf)
        return out

    def _judge(self, stamp_ns: int) -> Alarm | None:
        """Return an alarm when one is due, with the likeliest cause."""
        ratios = self._ratios()
        sums = np.logaddexp.reduce(ratios, axis=0) + SHARES
        order = np.argsort(sums)[::-1]
        total = np.logaddexp.reduce(sums)
        self._half_way = [*self._half_way, stamp_ns] if total > 0.5 * self._threshold else []
        if total < self._threshold or len(self._half_way) <= CONFIRMED:
            return None
        ahead = sums[order[0]] - sums[order[1]]
        if ahead < SURE and stamp_ns - self._half_way[0] < DECIDE_NS:
            return None
        cause = CAUSES[order[0]]
        size = self._size(int(ratios[:, order[0]].argmax()), int(order[0]))
        self.forget()
        return Alarm(stamp_ns, cause.name, size, cause.words.format(cause.unit * size))

    def _size(self, onset: int, which: int) -> float:
        """Return the most likely size of a fault: of a vector its length, of the first three."""
        at = sum(len(cause.rows) for cause in CAUSES[:which])
        part = slice(at, at + len(CAUSES[which].rows))
        J, d = self._information[onset, part, part], self._evidence[onset, part]
        found = np.linalg.solve(J + np.diag(USUAL[part] ** -2.0), d)
        return float(np.linalg.norm(found[:3]))


def _sight(H: Array, position: Vector, quaternion_xyzw: Quaternion) -> Array:
    """Return what the extended error makes of an innovation (6, 41)."""
    C: Array = np.zeros((6, EXTENDED))
    C[:, :SIZE] = H
    turn = np.reshape(rotation_matrix(quaternion_xyzw), (3, 3)).T
    C[:3, FRAME] = np.hstack([turn, -turn @ hat(np.array(position))])
    C[3:, FRAME.start + 3:FRAME.stop] = turn
    C[:3, FALL] = turn
    C[:3, SLIPPED] = -H[:3, 13:15]
    return C
