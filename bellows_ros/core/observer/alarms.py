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

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import kernel
from bellows_ros.core.geometry.tuples import cross, Quaternion, rotation_matrix, Vector
from bellows_ros.core.observer.filter import (
    add_product,
    FORCE,
    LENGTHENED,
    LENGTHENING,
    MOMENT,
    product,
)
from bellows_ros.core.observer.measurement import Innovation
import numpy as np

GONE, SPEED, FALL = 26, 27, 30
FRAME, SLIPPED, EXTENDED = 33, 39, 41


class Cause(NamedTuple):
    """A kind of fault."""

    name: str
    rows: tuple[int, ...]
    """Of the extended error, one for each component of the fault."""
    usual: tuple[float, ...]
    """Prior standard deviations of the fault's components."""
    share: float
    """Prior share among all faults."""
    at_start: bool
    sets_in: bool
    """Whether it may be present from the start, and whether it may have an onset."""
    message: str
    """The finding, and what to do."""
    unit: float = 1e3
    every: int = 1
    """One in so many of the onsets is tested, and counts for all of them."""


CAUSES = (
    Cause('slip', (13, 14), (3e-3, 3e-3), 0.4, False, True,
          'The grip has slipped by {:.1f} mm: move slower, or raise the vacuum.'),
    Cause('leak', (LENGTHENING,), (5e-3,), 0.15, False, True,
          'The cup yields by {:.1f} mm/s, as with a leak: check its lip and the vacuum.'),
    Cause('wear', (FORCE, MOMENT), (0.2, 0.2), 0.1, True, False,
          'The stiffness of the cup is off by {:.0f} %: it is worn, or another cup is mounted. '
          "Identify it with 'bellows identify'.", 100.0),
    Cause('payload', (12, 13, 14, 15), (0.2, 0.01, 0.01, 0.01), 0.1, True,
          False,
          'Mass or centre of mass differs from package.*: correct it, or set payload.estimate.'),
    Cause('lost', (GONE,), (0.3,), 0.1, False, True,
          'The package is lost: stop the arm.'),
    Cause('camera', tuple(range(FRAME, FRAME + 6)), (0.01,) * 6, 0.15,
          True, True,
          'The frame of the camera has moved by {:.1f} mm: calibrate it.', every=2),
)
"""The faults that are tested."""

START = tuple(cause for cause in CAUSES if cause.at_start)
LOOKED_FOR = START + tuple(cause for cause in CAUSES if cause.sets_in)
"""First the faults present from the start, then those with an onset."""
ROWS = tuple(row for cause in LOOKED_FOR for row in cause.rows)
FIRSTS = tuple(np.cumsum([0, *(len(cause.rows) for cause in LOOKED_FOR)]).tolist())
"""First column of each fault, and the end of the last one."""
AT_START = len(START)
OF_CAUSE = tuple(CAUSES.index(cause) for cause in LOOKED_FOR)
SHARES = tuple(math.log(cause.share) for cause in CAUSES)
USUAL = tuple(std for cause in LOOKED_FOR for std in cause.usual)
MEAN = tuple(1.0 if row == GONE else 0.0 for row in ROWS)
"""A lost package has lost all of the cup's force."""

ONSET_NS = 30_000_000
"""Spacing (ns) of the onsets tested."""

ONSETS, DENSE_NS, OLDEST_NS = 20, 450_000_000, 10_000_000_000
"""
So many of them, beside the beginning: all of a time (ns), what is older farther apart, and nothing
that is older than this (ns): all that falls for long has fallen out of any number's range.
"""

EVERY = tuple(cause.every for cause in LOOKED_FOR)
SLOTS = (1,) * AT_START + tuple(ONSETS // every for every in EVERY[AT_START:])
"""Onsets of each that is looked for, ..."""
COLUMNS = tuple(np.cumsum([0, *(
    slots for cause, slots in zip(LOOKED_FOR, SLOTS, strict=True) for _ in cause.rows)]).tolist())
"""... and where the errors by each number begin, one for each onset, and where the last end."""
LINE = 8
"""Rows begin where lines of the processor's cache do, which hold so many numbers."""
LARGEST = max(len(cause.rows) for cause in LOOKED_FOR)

OVERSHOOT = 2.1
"""
So much lower the threshold is, as the sum does not reach it but leaps over it, older onsets are
let go, and a cause must lead. Ten hours of sound work gave three alarms, of ten that are allowed.
"""

START_WEIGHS = 30.0
"""Prior odds of a fault from the start against an onset at any one of the times tested."""

FEWEST = 3
"""Measurements after an onset required for a decision."""

SURE, DECIDE_NS = 5.0, 500_000_000
"""
A cause is named when its log-likelihood ratio leads that of the next by so much, or so long (ns)
after half-way to the threshold.
"""

CONFIRMED = 2
"""Measurements required after half the threshold is passed: one jump proves nothing."""

UNEXPLAINED = 0.2
"""Largest fraction of the misfit that a named cause may leave unexplained."""


class Alarm(NamedTuple):
    """A fault that was found."""

    stamp_ns: int
    cause: str
    size: float
    """m, m/s or relative."""
    message: str


class Alarms:
    """
    Look for causes in the innovations, one after the other.

    Parameters
    ----------
    false_per_hour : float
        How many false alarms are allowed.

    """

    def __init__(self, false_per_hour: float) -> None:
        """Start without measurements."""
        self._threshold = math.log(3.6e12 / ONSET_NS / false_per_hour) - OVERSHOOT
        self.forget()

    def forget(self, named: int = -1) -> None:
        """Start again; of what is wrong from the start only what has been named is looked for."""
        self.named = named
        self.last_ns = -1
        self._E: Array = np.zeros((EXTENDED, COLUMNS[-1] + -COLUMNS[-1] % LINE))
        self._information: Array = np.zeros((len(ROWS), LARGEST, ONSETS))
        self._evidence: Array = np.zeros((len(ROWS), ONSETS))
        self._distances: Array = np.zeros(1 + ONSETS)  # the sum of the squared ones since each
        self._counts: Stamps = np.zeros(1 + ONSETS, np.int64)  # of measurements since each
        self._onsets: Stamps = np.full(1 + ONSETS, -1, np.int64)  # stamps
        self._half_way: list[int] = []  # stamps since half-way to the threshold

    def step(
        self, stamp_ns: int, passage: Array, found: Innovation, used: bool
    ) -> Alarm | None:
        """
        Process the next innovation, and return an alarm if there is one.

        Parameters
        ----------
        stamp_ns : int
            Of the measurement.
        passage : ndarray (13, 26)
            Since the one before.
        found : Innovation
            Of its pose.
        used : bool
            Whether the estimate was corrected with it.

        """
        self.last_ns = stamp_ns
        total, lead, onset, which = _step(
            self._E, self._information, self._evidence, self._distances, self._counts,
            self._onsets, stamp_ns, passage, found, used, self.named)
        self._half_way = [*self._half_way, stamp_ns] if total > 0.5 * self._threshold else []
        if total < self._threshold or len(self._half_way) <= CONFIRMED or (
                lead < SURE and stamp_ns - self._half_way[0] < DECIDE_NS):
            return None
        cause, size = LOOKED_FOR[which], self._size(onset, which)
        self.forget(OF_CAUSE[which])
        return Alarm(stamp_ns, cause.name, size, cause.message.format(cause.unit * size))

    def lost(self, stamp_ns: int) -> Alarm:
        """Return that the package is lost."""
        lost = next(cause for cause in CAUSES if cause.name == 'lost')
        self.forget(CAUSES.index(lost))
        return Alarm(stamp_ns, lost.name, 1.0, lost.message)

    def _size(self, onset: int, which: int) -> float:
        """Return the most likely size of a fault: of a vector its length, of the first three."""
        usual = np.array(LOOKED_FOR[which].usual)
        part, slot = slice(*FIRSTS[which:which + 2]), max(onset - 1, 0) // EVERY[which]
        J, d = self._information[part, :len(usual), slot], self._evidence[part, slot]
        J = np.tril(J) + np.tril(J, -1).T
        found = np.linalg.solve(J + np.diag(usual ** -2.0), d)
        return float(np.linalg.norm(found[:3]))


@kernel
def _step(
    E: Array, information: Array, evidence: Array, distances: Array, counts: Stamps,
    onsets: Stamps, stamp_ns: int, M: Array, found: Innovation, used: bool,
    named: int,
) -> tuple[float, float, int, int]:
    """
    Take the next innovation.

    Returns
    -------
    total : float
        Logarithm of the sum of all likelihood ratios.
    lead : float
        By how much that of the likeliest cause leads the next.
    onset, which : int
        Of the likeliest cause, and its place in `LOOKED_FOR`.

    """
    position, quaternion_xyzw, y, H, root, distance, gain = found
    if stamp_ns - onsets.max() >= ONSET_NS:
        k = _place(onsets, stamp_ns)
        onsets[k], distances[k], counts[k] = stamp_ns, 0.0, 0
        _set_in(E, information, evidence, k)
    _pass_on(E, M)
    made = product(_sight(H, position, quaternion_xyzw), E, np.empty((6, E.shape[1])))
    seen = product(root, made, np.empty((6, E.shape[1])))
    z = product(root, y.reshape((6, 1)), np.empty((6, 1)))
    for k in range(len(onsets)):
        if onsets[k] >= 0:
            distances[k] += distance
            counts[k] += 1
    for what in range(len(SLOTS)):
        _compare(seen, z, what, information, evidence)
    if used:
        add_product(-gain, made, E[:22])
    return _judged(information, evidence, distances, counts, named)


@kernel
def _place(onsets: Stamps, stamp_ns: int) -> int:
    """Return the slot for another onset: that of the older one nearest to its neighbour."""
    place, least = 0, math.inf
    for k in range(len(onsets)):
        before_ns, after_ns = onsets[0], stamp_ns
        if onsets[k] < 0 or (k > 0 and stamp_ns - onsets[k] > OLDEST_NS):
            return k
        for other in onsets:
            if other < onsets[k]:
                before_ns = max(before_ns, other)
            elif other > onsets[k]:
                after_ns = min(after_ns, other)
        room = (after_ns - before_ns) / max(stamp_ns - DENSE_NS - onsets[k], 1)
        if k > 0 and room < least:
            place, least = k, room
    return place


@kernel
def _set_in(E: Array, J: Array, d: Array, k: int) -> None:
    """Write the error that each component of a fault causes at its onset."""
    for what in range(0 if k == 0 else AT_START, AT_START if k == 0 else len(SLOTS)):
        slot, is_tested = max(k - 1, 0) // EVERY[what], k == 0 or (k - 1) % EVERY[what] == 0
        for a in range(FIRSTS[what], FIRSTS[what + 1] if is_tested else FIRSTS[what]):
            c, row = COLUMNS[a] + slot, ROWS[a]
            d[a, slot] = 0.0
            J[a, :, slot] = 0.0
            E[:, c] = 0.0
            E[row, c] = 1.0
            if k > 0 and 13 <= row <= 14:  # a package that slips moves, its lip does not
                E[row - 13, c] = E[SLIPPED + row - 13, c] = 1.0


@kernel
def _sight(H: Array, position: Vector, quaternion_xyzw: Quaternion) -> Array:
    """Return the derivative (6, 41) of an innovation by the extended error."""
    C = np.zeros((6, EXTENDED))
    for i in range(6):
        for j in range(22):
            C[i, j] = H[i, j]
    R = rotation_matrix(quaternion_xyzw)
    for i in range(3):
        row = R[i], R[3 + i], R[6 + i]
        across = cross(row, position)
        for j in range(3):
            C[i, FRAME + j] = C[3 + i, FRAME + 3 + j] = C[i, FALL + j] = row[j]
            C[i, FRAME + 3 + j] = -across[j]
        C[i, SLIPPED], C[i, SLIPPED + 1] = -H[i, 13], -H[i, 14]
    return C


@kernel
def _pass_on(E: Array, M: Array) -> None:
    """Carry the state's error along, and let the faults go on as they do."""
    last = M[12]
    moved = product(M[:12, :22], E[:22], np.empty((12, E.shape[1])))
    for i in range(12):  # E[:12] = moved takes seconds to compile: what it may raise
        for c in range(E.shape[1]):
            E[i, c] = moved[i, c]
    for a in range(len(ROWS)):
        first, end = COLUMNS[a], COLUMNS[a + 1]
        own, longer = E[ROWS[a], first:end], E[LENGTHENED, first:end]
        for i in range(12 if LENGTHENING <= ROWS[a] <= MOMENT else 0):
            part, by_own, by_longer = E[i, first:end], M[i, ROWS[a]], M[i, LENGTHENED]
            for c in range(len(part)):
                part[c] += by_own * own[c] + by_longer * longer[c]
        if ROWS[a] == LENGTHENING:
            longer += last[0] * own
        for i in range(3 if ROWS[a] == GONE else 0):
            fall, speed = E[FALL + i, first:end], E[SPEED + i, first:end]
            for c in range(len(fall)):
                fall[c] += last[0] * speed[c] + last[4 + i] * own[c]
                speed[c] += last[1 + i] * own[c]


@kernel
def _compare(seen: Array, z: Array, what: int, J: Array, d: Array) -> None:
    """Add what a measurement says of the sizes of a fault; J below its diagonal."""
    first, m = FIRSTS[what], SLOTS[what]
    for a in range(FIRSTS[what + 1] - first):
        column = COLUMNS[first + a]
        for i in range(6):
            one = seen[i, column:column + m]
            for k in range(m):
                d[first + a, k] += one[k] * z[i, 0]
            for b in range(a + 1):
                other = seen[i, COLUMNS[first + b]:COLUMNS[first + b] + m]
                for k in range(m):
                    J[first + a, b, k] += one[k] * other[k]


@kernel
def _judged(
    information: Array, evidence: Array, distances: Array, counts: Stamps, named: int
) -> tuple[float, float, int, int]:
    """Return what `_step` does."""
    top, sums = np.full(len(SHARES), -math.inf), np.zeros(len(SHARES))
    onset, which = np.zeros(len(SHARES), np.int64), np.zeros(len(SHARES), np.int64)
    A, z = np.empty((LARGEST, LARGEST, ONSETS)), np.empty((LARGEST, ONSETS))
    explained, determinant = np.empty(ONSETS), np.empty(ONSETS)
    for what in range(len(SLOTS)):
        _explain(information, evidence, what, A, z, explained, determinant)
        c, later = OF_CAUSE[what], what >= AT_START
        for slot in range(SLOTS[what] if later or named in (-1, c) else 0):
            k = slot * EVERY[what] + later
            usual = 6.0 * counts[k] + 4.0 * math.sqrt(12.0 * counts[k])
            if counts[k] < FEWEST or (
                    distances[k] - explained[slot] > usual + UNEXPLAINED * explained[slot]):
                continue
            ratio = 0.5 * (explained[slot] - math.log(determinant[slot]))
            ratio += math.log(EVERY[what] if later else START_WEIGHS)
            if ratio > top[c]:
                sums[c] = 1.0 + sums[c] * math.exp(top[c] - ratio)
                top[c], onset[c], which[c] = ratio, k, what
            else:
                sums[c] += math.exp(ratio - top[c])
    for c in range(len(SHARES)):
        top[c] += math.log(max(sums[c], 1.0)) + SHARES[c]
    best = top.argmax()
    if top[best] == -math.inf:
        return -math.inf, 0.0, 0, 0
    total, second = 0.0, -math.inf
    for c in range(len(SHARES)):
        total += math.exp(top[c] - top[best])
        if c != best:
            second = max(second, top[c])
    return top[best] + math.log(total), top[best] - second, onset[best], which[best]


@kernel
def _explain(
    J: Array, d: Array, what: int, A: Array, z: Array, explained: Array, determinant: Array
) -> None:
    """
    Write how much of the squared distances a fault explains, and the price of its freedom.

    With J and d information and evidence of its numbers, for each onset: z^T A^-1 z and det A,
    where A = I + s J s and z = s d with s the numbers' usual sizes; beside what their mean
    explains. A (6, 6, n) and z (6, n) are room to work in.
    """
    first, m = FIRSTS[what], SLOTS[what]
    explained[:m], determinant[:m] = 0.0, 1.0
    for i in range(FIRSTS[what + 1] - first):
        a, usual = first + i, USUAL[first + i]
        for k in range(m):
            z[i, k] = usual * d[a, k]
        if MEAN[a] != 0.0:  # it is the only number of its fault
            for k in range(m):
                explained[k] = 2.0 * d[a, k] - J[a, 0, k]
                z[i, k] -= usual * J[a, 0, k]
        for j in range(i + 1):
            both, one = usual * USUAL[first + j], 1.0 if i == j else 0.0
            for k in range(m):
                A[i, j, k] = both * J[a, j, k] + one
        _eliminate(A, z, i, m)
        for k in range(m):
            explained[k] += z[i, k] ** 2 / A[i, i, k]
            determinant[k] *= A[i, i, k]


@kernel
def _eliminate(A: Array, z: Array, i: int, m: int) -> None:
    """Write row i of L and D, with A = L D L^T for each of m onsets, and of L^-1 z."""
    for j in range(i):
        for n in range(j):
            for k in range(m):
                A[i, j, k] -= A[i, n, k] * A[j, n, k] * A[n, n, k]
        for k in range(m):
            A[i, j, k] /= A[j, j, k]
            A[i, i, k] -= A[i, j, k] ** 2 * A[j, j, k]
            z[i, k] -= A[i, j, k] * z[j, k]
