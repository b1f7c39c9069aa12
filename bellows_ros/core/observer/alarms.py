"""
What is wrong when measured poses are not where they should be: likelihood ratios of causes.

A fault that sets in at some time makes known changes of all later innovations, up to its size.
Their likelihood with a fault, its size averaged over what is usual, over that without is a
martingale where nothing is wrong. Summed over the onsets, and over the causes by how usual they
are, it grows by 1 with each onset on average: it is A or more after A onsets at the earliest, on
average (Shiryaev and Roberts), so that the threshold follows from the false alarms allowed.

The error of `filter`, extended by faults, is extended further (41,): by shift and turn of the
camera's frame in the world (m, rad), and by how far a lip that is measured has slipped (m).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.arrays import Array, Mask, Stamps
from bellows_ros.core.jit import kernel
from bellows_ros.core.observer.filter import (
    FALL,
    FORCE,
    GONE,
    Innovation,
    LENGTHENED,
    LENGTHENING,
    MOMENT,
    PASSAGE,
    product,
    SPEED,
)
from bellows_ros.core.tuples import cross, Quaternion, rotation_matrix, Vector
import numpy as np

FRAME, SLIPPED = slice(PASSAGE, PASSAGE + 6), slice(PASSAGE + 6, PASSAGE + 8)
EXTENDED = PASSAGE + 8


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
FIRSTS = np.cumsum([0, *(len(cause.rows) for cause in CAUSES)])
"""Where the numbers of each cause begin, and where the last end."""
AT_START: Mask = np.array([cause.at_start for cause in CAUSES])
SETS_IN: Mask = np.array([cause.sets_in for cause in CAUSES])
NOT_USED: Array = np.zeros((22, 6))
SHARES = np.log([cause.share for cause in CAUSES])
USUAL = np.array([std for cause in CAUSES for std in cause.usual])
JUMPS: Array = np.zeros((EXTENDED, len(ROWS)))
"""The error that each number of a size makes where it sets in."""
MEAN = np.where(np.array(ROWS) == GONE, 1.0, 0.0)
"""A package that is lost has lost all of the cup's force."""
JUMPS[ROWS, range(len(ROWS))] = 1.0
JUMPS[:2, :2] = JUMPS[SLIPPED, :2] = np.eye(2)  # a package that slips moves, its lip does not

ONSET_NS = 30_000_000
"""Time (ns) between two onsets that are looked at."""

ONSETS, DENSE_NS = 28, 550_000_000
"""So many of them, and the beginning: all of a time (ns), and what is older farther apart."""

START_WEIGHS = 30.0
"""A fault from the beginning is as likely as one that sets in at any of so many onsets."""

LEAST = 3
"""Measurements after an onset without which nothing is said."""

SURE, DECIDE_NS = 5.0, 500_000_000
"""
A cause is named when its log-likelihood ratio leads that of the next by so much, or so long (ns)
after half-way to the threshold.
"""

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
        n = len(ROWS)
        self.last_ns = -1
        self._E: Array = np.zeros((EXTENDED, (ONSETS + 1) * n))
        self._information: Array = np.zeros((ONSETS + 1, n, n))
        self._evidence: Array = np.zeros((ONSETS + 1, n))
        self._total: Array = np.zeros(ONSETS + 1)  # of the squared distances since each onset
        self._counts = np.zeros(ONSETS + 1, np.int64)  # of measurements since each onset
        self._onsets: list[int] = []  # stamps
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
        passage : ndarray (33, 33)
            Of the error and of faults, since then.
        found : Innovation
            Of its pose.
        used : bool
            Whether the estimate was corrected with it.
        position, quaternion_xyzw : tuple
            Measured pose of B in the world.

        """
        if not self._onsets or stamp_ns - max(self._onsets) >= ONSET_NS:
            self._begin(stamp_ns)
        self.last_ns = stamp_ns
        C = _sight(found.H, position, quaternion_xyzw)
        _take(self._E, self._information, self._evidence, passage, C, found.y, found.whitener,
              found.gain if used else NOT_USED)
        known = slice(0, len(self._onsets))
        self._total[known] += found.distance
        self._counts[known] += 1
        return self._judge(stamp_ns)

    def lost(self, stamp_ns: int) -> Alarm:
        """Return that the package is lost."""
        self.forget()
        return Alarm(stamp_ns, 'lost', 1.0, next(c.words for c in CAUSES if c.name == 'lost'))

    def _begin(self, stamp_ns: int) -> None:
        """Look at another onset, for one of the older ones that is nearest to its neighbours."""
        k, n = len(self._onsets), len(ROWS)
        if k > ONSETS:
            order = np.argsort(self._onsets)
            stamps = np.array(self._onsets)[order]
            older = np.maximum(stamp_ns - DENSE_NS - stamps[1:-1], 1)
            k = int(order[1 + np.argmin((stamps[2:] - stamps[:-2]) / older)])
            self._onsets[k] = stamp_ns
        else:
            self._onsets.append(stamp_ns)
        self._E[:, k * n:k * n + n] = JUMPS
        self._information[k], self._evidence[k] = 0.0, 0.0
        self._total[k], self._counts[k] = 0.0, 0

    def _judge(self, stamp_ns: int) -> Alarm | None:
        """Return an alarm when one is due, with the likeliest cause."""
        ratios = _ratios(self._information, self._evidence, self._total, self._counts)
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
        part = slice(FIRSTS[which], FIRSTS[which + 1])
        J, d = self._information[onset, part, part], self._evidence[onset, part]
        found = np.linalg.solve(J + np.diag(USUAL[part] ** -2.0), d)
        return float(np.linalg.norm(found[:3]))


@kernel
def _sight(H: Array, position: Vector, quaternion_xyzw: Quaternion) -> Array:
    """Return what the extended error makes of an innovation (6, 41)."""
    C = np.zeros((6, 41))
    for i in range(6):
        for j in range(22):
            C[i, j] = H[i, j]
    R = rotation_matrix(quaternion_xyzw)
    for i in range(3):
        row = R[i], R[3 + i], R[6 + i]
        across = cross(row, position)
        for j in range(3):
            C[i, 33 + j] = C[3 + i, 36 + j] = C[i, FALL + j] = row[j]
            C[i, 36 + j] = -across[j]
        C[i, 39], C[i, 40] = -H[i, 13], -H[i, 14]
    return C


@kernel
def _take(
    E: Array, information: Array, evidence: Array, M: Array, C: Array, y: Array, root: Array,
    gain: Array,
) -> None:
    """Follow what each fault makes of the error, and compare with the innovation, in place."""
    width, n = E.shape[1], evidence.shape[1]
    _pass_on(E, M, product(M[:12], E[:PASSAGE], np.empty((12, width))))
    made = product(C, E, np.empty((6, width)))
    seen = product(root, made, np.empty((6, width)))
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += root[i, j] * y[j]
        for c in range(width):
            k, a = divmod(c, n)
            evidence[k, a] += seen[i, c] * z
            for b in range(n):
                information[k, a, b] += seen[i, c] * seen[i, c - a + b]
    taken_out = product(gain, made, np.empty((22, width)))
    for i in range(22):
        for c in range(width):
            E[i, c] -= taken_out[i, c]


@kernel
def _pass_on(E: Array, M: Array, state: Array) -> None:
    """Write what becomes of the state's error, and let the other faults go on as they do."""
    for c in range(E.shape[1]):
        for i in range(12):
            E[i, c] = state[i, c]
        E[LENGTHENED, c] += M[LENGTHENED, LENGTHENING] * E[LENGTHENING, c]
        for i in range(3):
            speed, fall = SPEED + i, FALL + i
            E[fall, c] += M[fall, speed] * E[speed, c] + M[fall, GONE] * E[GONE, c]
            E[speed, c] += M[speed, GONE] * E[GONE, c]


@kernel
def _ratios(information: Array, evidence: Array, total: Array, counts: Stamps) -> Array:
    """Return the logarithms of the likelihood ratios, by onset and cause."""
    out = np.empty((len(counts), len(AT_START)))
    for k in range(len(counts)):
        usual = 6.0 * counts[k] + 4.0 * math.sqrt(12.0 * counts[k])
        for cause in range(len(AT_START)):
            out[k, cause] = -math.inf
            if counts[k] >= LEAST and (AT_START[cause] if k == 0 else SETS_IN[cause]):
                explained, spread = _explained(
                    information[k], evidence[k], FIRSTS[cause], FIRSTS[cause + 1])
                if total[k] - explained <= usual + UNEXPLAINED * explained:
                    out[k, cause] = 0.5 * explained - spread + (
                        math.log(START_WEIGHS) if k == 0 else 0.0)
    return out


@kernel
def _explained(J: Array, d: Array, first: int, end: int) -> tuple[float, float]:
    """
    Return how much of the squared distances some numbers explain, and the price of their freedom.

    With J and d their information and evidence: z^T A^-1 z, and half of log det A, where
    A = I + s J s and z = s d with s the numbers' usual sizes; beside what their mean explains.
    """
    n, by_mean = end - first, 0.0
    A, z = np.zeros((6, 6)), np.zeros(6)
    for i in range(n):
        z[i] = d[first + i]
        for j in range(n):
            a = J[first + i, first + j]
            z[i] -= a * MEAN[first + j]
            by_mean += 0.5 * MEAN[first + i] * a * MEAN[first + j]
            A[i, j] = USUAL[first + i] * a * USUAL[first + j] + (1.0 if i == j else 0.0)
        by_mean += z[i] * MEAN[first + i]
        z[i] *= USUAL[first + i]
    explained, spread = 2.0 * by_mean, 0.0
    for i in range(n):  # A = L L^T, z becomes L^-1 z
        for j in range(i):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
            A[i, i] -= A[i, j] ** 2
            z[i] -= A[i, j] * z[j]
        A[i, i] = math.sqrt(A[i, i])
        z[i] /= A[i, i]
        explained += z[i] ** 2
        spread += math.log(A[i, i])
    return explained, spread
