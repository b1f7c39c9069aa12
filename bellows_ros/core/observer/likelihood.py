"""
Causes of deviating measured poses: likelihood ratios of faults.

A fault is a step in some rows of the error of `filter` at its onset. The fault changes all later
innovations in proportion to its size: the signature, which is the error that a fault of unit size
leaves in the estimate, is propagated and updated like the error. The likelihood ratio of the
innovations with and without a fault is averaged over the prior of the size, and is then a
martingale without faults. The sum of the ratios over onsets, and over causes by prior shares,
grows by 1 per onset on average, so it reaches A after at least A onsets on average (Shiryaev and
Roberts). This gives the threshold for the allowed rate of false alarms.

A fault from the start is a larger prior covariance, P0 + U S U^T with steps U of sizes with
variances S. The change x of its rows since the start and their covariance P contain its evidence:
with W = P0^-1 U, W^T x is the score of its size, W^T (P0 - P) W the information on it, and P W its
signature.

Ordinary errors are part of the error and of the covariance of the innovations. A detected fault is
removed from the estimate: the estimate changes by the signature times the likeliest size, and the
covariance grows by the prior of the size.

The error is extended by the fall of the package: the lost fraction of the cup's force, and speed
and shift of the fall (m/s, m; world). For a gripper, the loss of each cup is also a fault: its
columns follow all other columns, and its signature is propagated without the lost cup.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model.kernels import LawTuple, model_of
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import hypotheses as bank
from bellows_ros.core.observer import measurement as measured
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import ONSETS, predicted
from bellows_ros.core.observer.hypotheses import Likeliest, Tested
from bellows_ros.core.observer.measurement import Innovation, MeasuredPose
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np


class Prior(NamedTuple):
    """Rows of the error with faults from the start, before the first measurement."""

    theta: Array
    """Values (k,) of the rows `START_ROWS`."""
    weights: Array
    """Weights W (k, components)."""
    information: Array
    """Products U^T W (components, components)."""


def prior_of(theta: Array, P: Array) -> Prior:
    """Return the prior for theta and the covariance (n, n) at the start."""
    W = np.linalg.solve(P[np.ix_(bank.START_ROWS, bank.START_ROWS)], bank.START_STEPS)
    return Prior(theta[bank.START_ROWS - states.STATE], W, bank.START_STEPS.T @ W)


class Assessment(NamedTuple):
    """An estimate after a measurement, and the evidence of faults."""

    verdict: int
    estimate: ekf.EstimateTuple
    evidence: ekf.Evidence
    likeliest: Likeliest
    rise: float
    """Log-likelihood ratio of a rise by `vertical_ratios`; 0 without a support."""
    fall: float


@entry
def filter_step(
    row: Any, law: LawTuple, estimate: ekf.EstimateTuple, samples: ekf.Samples,
    is_recorded: bool, until_ns: int, max_step: float, noise: ekf.Noise,
    evidence: ekf.Evidence, prior: Prior, steps: Array, cups: Array, seen: MeasuredPose,
) -> Assessment:
    """
    Propagate an estimate to a later stamp, correct it with a measurement, and assess faults.

    Other inputs are as for `model_of`, `predicted` and `updated`. Steps (n + 7, components) are
    the errors by each component of a fault, cups the holding cups of a gripper. One kernel, with
    the model as an array, is faster to call from Python.
    """
    model, seconds = model_of(row, law), (until_ns - estimate[0]) / NS_PER_S
    E, statistics, distances, onsets, from_start = evidence
    verdict, likeliest, memory = measured.USED, bank.NO_FAULT, estimate[5]
    after, E, gain = predicted(
        model, estimate, samples, is_recorded, until_ns, max_step, noise, E, cups)
    _, tool, body, theta, P, _ = after
    rise = fall = 0.0
    if seen.gate > 0.0:
        is_early = from_start and len(E) > 0 and onsets[0, 0] < bank.MIN_NOISE_COUNT
        verdict, is_used, innovation, body, theta, learned = measured.updated(
            model, after, seconds, seen, gain, is_early)
        if seen.sag > 0.0 and verdict <= measured.OUTSIDE:
            rise, fall = measured.vertical_ratios(body, model[2], innovation, seen.sag)
            rise = rise if verdict == measured.USED else 0.0
        elif verdict == measured.FALLING:
            fall = measured.FALL_RATIO
        if len(E) > 0 and verdict <= measured.OUTSIDE:
            statistics, distances = statistics.copy(), distances.copy()
            onsets = onsets.copy()
            likeliest = _assessed(
                E, statistics, distances, onsets, steps, until_ns, body[0], innovation,
                seen.marker[2], is_used, from_start, of_start(prior, theta, P))
        if likeliest.total < bank.MAX_NOISE_RATIO or onsets[0, 0] < bank.MIN_NOISE_COUNT:
            memory = learned
    return Assessment(
        verdict, (until_ns, tool, body, theta, P, memory),
        ekf.Evidence(E, statistics, distances, onsets, from_start), likeliest, rise, fall)


@kernel
def layout(number: int) -> tuple[int, int]:
    """Return hypothesis and first column of a fault."""
    h = min(number, bank.CUP)
    return h, bank.COLUMNS[h] + (number - h) * ONSETS


@entry
def of_start(prior: Prior, theta: Array, P: Array) -> Array:
    """Return the statistics of faults from the start, of theta and P now, as in `Evidence`."""
    W, rows = prior.weights, bank.START_ROWS
    m, out = W.shape[1], np.zeros((1 + bank.MAX_COMPONENTS, W.shape[1]))
    PW = np.zeros((len(rows), m))
    for i in range(len(rows)):
        change = theta[rows[i] - states.STATE] - prior.theta[i]
        for a in range(m):
            out[0, a] += W[i, a] * change
            for j in range(len(rows)):
                PW[i, a] += P[rows[i], rows[j]] * W[j, a]
    for h in range(bank.AT_START):
        for a in range(bank.FIRSTS[h], bank.FIRSTS[h + 1]):
            for b in range(bank.FIRSTS[h], a + 1):
                gained = prior.information[a, b]
                for i in range(len(rows)):
                    gained -= W[i, a] * PW[i, b]
                out[1 + b - bank.FIRSTS[h], a] = gained
            if gained <= 0.0:  # less is known than at the start
                out[:, a] = 0.0
    return out


@kernel
def _assessed(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, innovation: Innovation, of_lip: bool, used: bool,
    from_start: bool, since_start: Array,
) -> Likeliest:
    """Update the evidence by the next `Innovation`, for a package at a place (m, world)."""
    z, H, root, _, whitened = innovation
    n, C = H.shape[1], H.astype(np.float32)
    response = measured.output_of(C, E, np.empty((6, E.shape[1]), np.float32), of_lip)
    t3.add_product(  # fall, as a shift in the world
        np.ascontiguousarray(C[:3, states.CAMERA:states.CAMERA + 3]), E[n + 4:], response[:3])
    change = t3.product(
        root.astype(np.float32), response, np.empty((6, E.shape[1]), np.float32))
    counts, is_settled = onsets[0], onsets[0, 0] >= bank.SETTLING
    for k in range(1 + ONSETS):
        if onsets[1, k] >= 0:
            distances[k] += (z * z).sum() if is_settled else 0.0
            counts[k] += 1
    faults = bank.CUP + (E.shape[1] - bank.COLUMNS[bank.CUP]) // ONSETS
    if counts[0] > bank.SETTLING:
        for number in range(bank.AT_START, faults):
            _add_products(z, change, number, statistics)
    if used:
        t3.subtract_product(whitened.astype(np.float32), change, E)
    likeliest = _likeliest_fault(
        statistics, since_start, distances, onsets, 0 if from_start else bank.AT_START, faults)
    if counts[0] >= bank.SETTLING and stamp_ns - onsets[1].max() >= bank.ONSET_NS // 2:
        add_onset(E, statistics, distances, onsets, steps, stamp_ns, place, likeliest.pinned)
    return likeliest


@kernel
def _free_slot(onsets: Stamps, stamp_ns: int, pinned: int) -> int:
    """
    Return the slot for a new onset: of the older onset nearest to its neighbour.

    The likeliest onset of each cause is kept (the bits of `pinned`), because the evidence of a
    small fault grows slowly.
    """
    slot, least = 0, math.inf
    for k in range(len(onsets)):
        before_ns, after_ns = onsets[0], stamp_ns
        if onsets[k] < 0:
            return k
        if pinned >> k & 1:
            continue
        if stamp_ns - onsets[k] > bank.OLDEST_NS:
            return k
        for other in onsets:
            if other < onsets[k]:
                before_ns = max(before_ns, other)
            elif other > onsets[k]:
                after_ns = min(after_ns, other)
        gap = (after_ns - before_ns) / max(stamp_ns - bank.DENSE_NS - onsets[k], 1)
        if gap < least:
            slot, least = k, gap
    return slot


@entry
def add_onset(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, pinned: int,
) -> None:
    """
    Write the error by each fault with an onset now, into a slot of `_free_slot`.

    The camera rotates about the place (m, world) of the package.
    """
    k = _free_slot(onsets[1], stamp_ns, pinned)
    distances[k], onsets[0, k], onsets[1, k] = 0.0, 0, stamp_ns
    faults = bank.CUP + (E.shape[1] - bank.COLUMNS[bank.CUP]) // ONSETS
    for number in range(bank.AT_START, faults):
        h, column = layout(number)
        if (k - 1) % bank.EVERY[h] > 0:
            continue
        first, slots, slot = bank.FIRSTS[h], bank.SLOTS[h], (k - 1) // bank.EVERY[h]
        for a in range(bank.FIRSTS[h + 1] - first):
            signature = E[:, column + a * slots + slot]
            statistics[:, column + a * slots + slot] = 0.0
            signature[:] = 0.0
            for i in range(len(steps)):
                row = i if i < states.ROWS_WITHOUT_SENSOR else i - len(steps)
                signature[row] = steps[i, first + a]
            x, y, z = signature[states.CAMERA + 3:states.CAMERA + 6]
            shift = t3.cross(place, (x, y, z))
            for i in range(3):
                signature[states.CAMERA + i] += shift[i]


@kernel
def _add_products(z: Array, change: Array, number: int, statistics: Array) -> None:
    """Add a measurement's information on the sizes of a fault."""
    h, column = layout(number)
    m = bank.SLOTS[h]
    for a in range(bank.FIRSTS[h + 1] - bank.FIRSTS[h]):
        i = column + a * m
        for k in range(m):
            statistics[0, i + k] += (
                z[0] * change[0, i + k] + z[1] * change[1, i + k] + z[2] * change[2, i + k]
                + z[3] * change[3, i + k] + z[4] * change[4, i + k] + z[5] * change[5, i + k])
        for b in range(a + 1):
            j, J = column + b * m, statistics[1 + b, i:]
            for k in range(m):
                J[k] += (
                    change[0, i + k] * change[0, j + k] + change[1, i + k] * change[1, j + k]
                    + change[2, i + k] * change[2, j + k] + change[3, i + k] * change[3, j + k]
                    + change[4, i + k] * change[4, j + k] + change[5, i + k] * change[5, j + k])


@kernel
def _likeliest_fault(
    statistics: Array, since_start: Array, distances: Array, onsets: Stamps, tested: int,
    faults: int,
) -> Likeliest:
    """Return the result of `_assessed` for the faults from `tested` on."""
    top, sums, best = np.full(faults, -math.inf), np.zeros(faults), np.zeros((faults, 3), np.int64)
    most = bank.MAX_COMPONENTS
    A, z = np.empty((most, most, ONSETS)), np.empty((most, ONSETS))
    explained, determinant = np.empty(ONSETS), np.empty(ONSETS)
    unusual = _unusual(distances, onsets[0])
    for c in range(tested, faults):
        h, column = layout(c)
        first, later = bank.FIRSTS[h], h >= bank.AT_START
        given = statistics if later else since_start
        weight = math.log(bank.EVERY[h] if later else bank.START_WEIGHT)
        explained[:], determinant[:] = 0.0, 1.0
        for i in range(bank.FIRSTS[h + 1] - first):
            _explain(given[:, column:], h, i, A, z, explained, determinant)
            if bank.IS_END[first + i]:
                slot, top[c], sums[c] = _sum_over_onsets(
                    unusual[later::bank.EVERY[h]], explained[:bank.SLOTS[h]], determinant, weight,
                    top[c], sums[c])
                if slot >= 0:
                    best[c, 0], best[c, 1], best[c, 2] = slot * bank.EVERY[h] + later, c, i + 1
        top[c] += math.log(max(sums[c], 1.0)) + bank.LOG_SHARES[h]
        top[c] -= math.log(faults - bank.CUP) if h == bank.CUP else 0.0
    leader, pinned = int(top.argmax()), 1
    none = _none_of_these(distances, onsets)
    if top[leader] == -math.inf:
        return Likeliest(-math.inf, -math.inf, Tested(0, 0, 0), 0, Tested(0, 0, 0), 1, none)
    second, rival = bank.NONE, -math.inf if leader == bank.PUSH else none
    for c in range(faults):
        pinned |= 1 << best[c, 0]
        if not _is_one_cause(c, leader) and top[c] > rival:
            second, rival = c, top[c]
    first, other = best[leader], best[max(second, 0)]
    total = top[leader] + math.log(np.exp(top - top[leader]).sum())
    return Likeliest(total, top[leader] - rival, Tested(first[0], first[1], first[2]), second,
                     Tested(other[0], other[1], other[2]), pinned, none)


@kernel
def _is_one_cause(a: int, b: int) -> bool:
    """Return whether two hypotheses have one cause; the losses of single cups are several."""
    return a == b or (max(a, b) < bank.CUP and bank.CAUSES[a] == bank.CAUSES[b])


@kernel
def _unusual(distances: Array, counts: Stamps) -> Array:
    """Return the parts of the squared distances beyond their usual ones, infinite without any."""
    unusual = np.full(len(distances), math.inf)
    for k in range(len(distances)):
        if counts[k] > 0:
            unusual[k] = distances[k] - 6.0 * counts[k] - 4.0 * math.sqrt(12.0 * counts[k])
    return unusual


@kernel
def _none_of_these(distances: Array, onsets: Stamps) -> float:
    """
    Return the log-likelihood ratio of larger innovations without a signature since an onset.

    For n innovations with the sum D of squared distances, the likeliest factor of the variance is
    D / 6 n. The likelihood with this factor limits the odds of a cause.
    """
    top = -math.inf
    for k in range(1, len(distances)):
        expected = 6.0 * onsets[0, k]
        if expected > 0.0 and distances[k] > expected:
            top = max(top, 0.5 * (distances[k] - expected) - 0.5 * expected * math.log(
                distances[k] / expected))
    return top + bank.LOG_SHARE_OF_NONE


@kernel
def _sum_over_onsets(
    unusual: Array, explained: Array, determinant: Array, weight: float, top: float, total: float
) -> tuple[int, float, float]:
    """
    Return the likeliest onset, and the sum of likelihood ratios including all onsets.

    An onset counts only if the fault explains most of the unusual squared distances since this
    onset. The sum is relative to the largest ratio so far, whose logarithm is `top`; the onset is
    -1 if no ratio is larger.
    """
    slot, largest = -1, -math.inf
    for k in range(len(explained)):
        if unusual[k] <= (1.0 + bank.MAX_UNEXPLAINED) * explained[k]:
            largest = max(largest, explained[k])
    if largest == -math.inf:
        return slot, top, total
    base = max(0.5 * largest, top - weight)
    greatest = math.exp(top - weight - base)
    total *= greatest
    for k in range(len(explained)):
        if unusual[k] <= (1.0 + bank.MAX_UNEXPLAINED) * explained[k]:
            ratio = math.exp(0.5 * explained[k] - base) / math.sqrt(determinant[k])
            total += ratio
            if ratio > greatest:
                slot, greatest = k, ratio
    if slot >= 0:
        top = base + math.log(greatest) + weight
    return slot, top, total / greatest


@kernel
def _explain(
    statistics: Array, h: int, i: int, A: Array, z: Array, explained: Array, determinant: Array
) -> None:
    """
    Add the squared distances explained by component i, and the cost of its freedom.

    With information J and score d of a fault's sizes, for each onset: z^T A^-1 z and det A, where
    A = I + s J s and z = s d with prior sizes s; plus the part explained by their mean. A (6, 6,
    n) and z (6, n) hold the factors of previous components.
    """
    first, m = bank.FIRSTS[h], bank.SLOTS[h]
    std, d, J = bank.PRIOR_STD[first + i], statistics[0, i * m:], statistics[1:, i * m:]
    for k in range(m):
        z[i, k] = std * d[k]
    if bank.MEANS[h] != 0.0:
        for k in range(m):
            explained[k] = 2.0 * d[k] - J[0, k]
            z[i, k] -= std * J[0, k]
    for j in range(i + 1):
        both, one = std * bank.PRIOR_STD[first + j], 1.0 if i == j else 0.0
        for k in range(m):
            A[i, j, k] = both * J[j, k] + one
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
