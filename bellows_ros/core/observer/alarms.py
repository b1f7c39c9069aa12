"""
What is wrong when measured poses are not where they should be: likelihood ratios of causes.

A fault is a step in some rows of the error of `filter`, at some time. It makes known changes of
all later innovations, up to its size: its signature, the error that the fault leaves in the
estimate, goes through transitions and updates as the error does. The likelihood of the innovations
with a fault, its size averaged over what is usual, over that without is a martingale where nothing
is wrong. Summed over the onsets, and over the causes by how usual they are, it grows by 1 with
each onset on average: it is A or more after A onsets at the earliest, on average (Shiryaev and
Roberts), so that the threshold follows from the false alarms allowed.

What is no fault is part of the error, and of the covariance of the innovations. What was found is
taken off: the estimate changes by the signature times the likeliest size, and its covariance by
that of the usual sizes.

The error is extended by what falls: by the part of the cup's force that is gone, and speed and
shift (m/s, m; world). Of a gripper of several cups the loss of each is a fault, too: its columns
are after those of the others, and its signature goes through a transition without that cup.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
import tomllib
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model.kernels import LawTuple, model_of
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer.filter import Evidence, ONSETS, predicted
from bellows_ros.core.observer.measurement import MeasuredPose, output_of, OUTSIDE, updated, USED
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

CAUSES = tomllib.loads(Path(__file__).with_name('alarms.toml').read_text())
"""Causes by name."""


class Cause(NamedTuple):
    """A kind of fault, as the file has it."""

    name: str
    steps: tuple[tuple[int, ...], ...]
    """The rows of the error that step, for each component."""
    prior_std: Sequence[float]
    ends: Sequence[int]
    share: float
    at_start: bool
    sets_in: bool
    parts: Sequence[tuple[int, int, bool]]
    """First and last component of each size, and whether it is a logarithm."""
    every: int = 1
    """One in so many of the onsets is tested, and counts for all of them."""
    after_ns: int = 0
    """How old (ns), for each component, the onset of the fault is at least when it is named:
    before, its size is not known, and it may be the beginning of another."""
    mean: float = 0.0
    """Prior mean of the only component."""
    least: float = 0.0
    """Least size of its first part that is named: a drifting camera looks like a small part of the
    force that has been gone for long, late stamps like a larger one, and a fall like late stamps.
    """
    confirmed: int = 2
    confirmed_ns: int = 80_000_000
    """Measurements and time (ns) required after half the threshold is passed: a marker may be
    confused with another one, or the pose of a tag flip, for some frames. Neither falls."""


NAMED = {
    name: Cause(name, **{**entry, 'steps': tuple(
        tuple(getattr(ekf, row) + place for row, place in step) for step in entry['steps'])})
    for name, entry in CAUSES.items()}
ALARM_CAUSES = tuple(sorted(NAMED.values(), key=lambda cause: cause.name == 'cup'))
"""
The faults that are tested. The last is the loss of one cup of several: each cup that holds has
its own columns, after all others.
"""

OUT_OF_REACH_ODDS = 100.0
"""Factor on the odds of a lost package by two poses where no cup can hold it."""

VACUUM_ODDS = 1000.0
"""Factor by a vacuum that breaks down; one that holds divides by it."""

START = tuple(cause for cause in ALARM_CAUSES if cause.at_start)
HYPOTHESES = START + tuple(cause for cause in ALARM_CAUSES if cause.sets_in)
"""First the faults present from the start, then those with an onset."""
AT_START, CUP = len(START), len(HYPOTHESES) - 1
"""Numbers of the first hypothesis with an onset, and of the loss of the first cup."""
STEPS = tuple(rows for cause in HYPOTHESES for rows in cause.steps)
FIRSTS = tuple(np.cumsum([0, *(len(cause.steps) for cause in HYPOTHESES)]).tolist())
"""First component of each hypothesis, and the end of the last one."""
IS_END = tuple(n + 1 in cause.ends for cause in HYPOTHESES for n in range(len(cause.steps)))
"""Whether a fault may have the components up to this one."""
OF_CAUSE = tuple(ALARM_CAUSES.index(cause) for cause in HYPOTHESES)
LOG_SHARES = tuple(math.log(cause.share / len(cause.ends)) for cause in ALARM_CAUSES)
PRIOR_STD = tuple(std for cause in HYPOTHESES for std in cause.prior_std)
MEANS = tuple(cause.mean for cause in HYPOTHESES)

ONSET_NS = 30_000_000
"""Spacing (ns) of the onsets tested."""

DENSE_NS, OLDEST_NS = 240_000_000, 10_000_000_000
"""
All onsets of a time (ns) are tested, what is older farther apart, and nothing that is older than
this (ns): all that falls for long has fallen out of any number's range.
"""

EVERY = tuple(cause.every for cause in HYPOTHESES)
SLOTS = (1,) * AT_START + tuple(ONSETS // every for every in EVERY[AT_START:])
"""Onsets of each hypothesis, ..."""
COLUMNS = tuple(np.cumsum([0, *(
    slots * len(cause.steps) for cause, slots in zip(HYPOTHESES, SLOTS, strict=True))]).tolist())
"""... and where its signatures begin: for each component, one for each onset."""
MAX_COMPONENTS = max(len(cause.steps) for cause in HYPOTHESES)

MARGIN, GRIPPER_MARGIN = -2.0, -1.0
"""
Added to the logarithm of the threshold for sums over all onsets, with one cup and with several:
only some of the older ones are tested, and an alarm is confirmed. Counted in
`python -m benchmarks.alarms`: there are fewer false ones than allowed.
"""

START_WEIGHT = 100.0
"""Prior odds of a fault from the start against an onset at any one of the times tested."""

SETTLING = 4
"""Measurements from the start, or an alarm, that are not compared: the noise is learned first."""

MIN_NOISE_COUNT, MAX_NOISE_RATIO = 33, 3.0
"""
Measurements from the start, or an alarm, that the noise is always learned from, and largest
log-likelihood ratio of a fault with which it is learned later: a fault would be taken for noise.
"""

MAX_COUNT = 300
"""
Measurements after which the evidence of faults from the start is collected anew. The noise of an
estimate is in its signatures, too: products of the two add up where there is little evidence.
"""

DISTURBED_COUNT = 3
"""Consecutive poses outside the gate from which a disturbance is named: outliers are rarer."""

VIEW_NS = 3_000_000_000
"""Time for which a camera that sees a tag must have moved, ns: work then shows other views."""

MIN_LEAD, DECIDE_NS = 3.0, 800_000_000
"""
A cause is named when its log-likelihood ratio leads that of the next by so much, which is 95 %, or
so long (ns) after half-way to the threshold.
"""

MAX_UNEXPLAINED = 0.2
"""Largest fraction of the misfit that a named cause may leave unexplained."""

SIZE_ROUNDS = 20
"""Rounds in which the usual sizes of a fault's components grow to those of a larger fault."""

MIN_CLEAR_ODDS = 100.0
"""Odds below which an alarm has the sizes of the second cause, too."""

ALIKE = frozenset(('wear', 'payload'))
"""Causes told apart by damping only: an alarm has the sizes of both, whatever the odds."""

MAX_ODDS = math.exp(14.0)
"""Largest odds of a fault from the start, a lost package or a lost cup; of others 100."""

LOG_SHARE_OF_NONE = math.log(0.1)
"""Logarithm of the prior share of causes without a signature, a disturbance among them."""

NONE, PUSH, PAYLOAD, WEAR = -1, *(
    [cause.name for cause in ALARM_CAUSES].index(name)
    for name in ('disturbance', 'payload', 'wear'))
"""Places of the cause without a signature, of a push from outside, and of two more."""

LOG_PROVEN = math.log(100.0)
"""Logarithm of the odds of a wrong payload to a worn cup that has carried another package."""

Likeliest = tuple[float, float, tuple[int, int, int], int, tuple[int, int, int], int, float]
NO_FAULT = -math.inf, -math.inf, (0, 0, 0), 0, (0, 0, 0), 1, -math.inf
"""Result of `_assessed` without a fault or without a comparison."""


Sizes = tuple[tuple[float, float], ...]
"""Sizes of the parts of a fault with standard deviations: m, rad, m/s, s or relative."""


class Alarm(NamedTuple):
    """A fault that was found."""

    stamp_ns: int
    cause: str
    size: float
    """Size of the clearest part, m, m/s, s or relative."""
    std: float
    second: str
    """The second likeliest cause; 'disturbance' for none with a signature."""
    odds: float
    """Odds of the cause against the second, at most `MAX_ODDS`."""
    parts: Sizes = ()
    second_parts: Sizes = ()
    """Sizes of the second cause, if it may well be the cause."""
    cup: int = -1
    """Index in cup.layout of a lost cup."""
    place: tuple[float, float] = (0.0, 0.0)
    """Position of a lost cup in the tool, m."""
    shown_by: str = 'poses'
    """'poses' of the package, or 'vacuum'."""


NO_ALARM = Alarm(0, '', 0.0, 0.0, '', 1.0)


class DetectedFault(NamedTuple):
    """An alarm, and what the fault makes of the error: likeliest value (n,) and spread (n, k)."""

    alarm: Alarm
    error: Array
    spread: Array
    cup: int = -1
    """Index of the lost cup among the cups of a gripper that held; -1 if none."""


class Alarms:
    """
    Look for causes in the innovations, one after the other.

    Parameters
    ----------
    false_per_hour : float
        How many false alarms are allowed.
    of_lip : bool
        Whether the lip is measured: a package that slips moves, a marker on it is no longer there.
    places : ndarray (cups, 4)
        Places of the holding cups of a gripper, as of `places_of`.
    of_tag : bool
        Whether a tag is measured: its errors in one view look like a camera that has moved.

    Attributes
    ----------
    steps : ndarray (rows + 7, components)
        The error that each component of a fault makes.
    is_cup_proven : bool
        Whether the cup has carried another package without an alarm.

    """

    is_cup_proven = False

    def __init__(
        self, false_per_hour: float, of_lip: bool, places: Array, of_tag: bool = False
    ) -> None:
        """Set the threshold, and the signatures at the onset."""
        self._places, self._of_tag = places, of_tag
        self._threshold = math.log(3600 * NS_PER_S / ONSET_NS / false_per_hour) + (
            MARGIN if len(places) == 1 else GRIPPER_MARGIN)
        self.steps: Array = np.zeros((ekf.ROWS + ekf.FALLEN, len(STEPS)))
        for component, step in enumerate(STEPS):
            for row in step:
                self.steps[row, component] = 1.0
                if of_lip and ekf.COM <= row < ekf.COM + 3:
                    self.steps[ekf.MARKER + row - ekf.COM, component] = 1.0

    def start(
        self, stamp_ns: int, place: Vector, cups: int, from_start: bool = True
    ) -> Evidence:
        """
        Return the evidence before any measurement, of a package at a place (m, world).

        Faults from the start begin at a stamp.
        """
        columns = COLUMNS[CUP] + cups * ONSETS
        none = Evidence(
            np.zeros((len(self.steps), columns), np.float32),
            np.zeros((1 + MAX_COMPONENTS, columns)), np.zeros(1 + ONSETS),
            np.repeat([[0], [-1]], 1 + ONSETS, axis=1), (), from_start)
        _add_onset(*none[:4], self.steps, stamp_ns, place, 1)
        return none

    def suspect_ns(self, before: tuple[int, ...], stamp_ns: int, total: float) -> tuple[int, ...]:
        """Return the stamps (ns) since half-way to the threshold, with one more measurement."""
        return (*before, stamp_ns) if total > 0.5 * self._threshold else ()

    def is_likely(self, likeliest: Likeliest) -> bool:
        """Return whether a cause has passed the threshold and leads."""
        return min(likeliest[0] - self._threshold, likeliest[1]) > 0.0

    def detected(
        self, evidence: Evidence, stamp_ns: int, likeliest: Likeliest, lost_cups: tuple[int, ...]
    ) -> DetectedFault | None:
        """
        Return a fault if one is found after a measurement, by the outcome of `filter_step`.

        The lost cups of a gripper have been found before.
        """
        _, lead, best, second, runner_up, *_ = likeliest
        if not self.is_likely(likeliest):
            return None
        if self.is_cup_proven and lead < LOG_PROVEN and second == PAYLOAD and (
                HYPOTHESES[min(best[1], CUP)].name == 'wear'):
            best, runner_up, second, lead = runner_up, best, WEAR, LOG_PROVEN - lead
        likely = HYPOTHESES[min(best[1], CUP)]
        in_view = self._of_tag and likely.name == 'camera'
        confirmed_ns = VIEW_NS if in_view else DECIDE_NS if (
            lead < MIN_LEAD) else likely.confirmed_ns
        suspect_ns = stamp_ns - min(evidence.suspect_ns, default=stamp_ns)
        if len(evidence.suspect_ns) <= likely.confirmed or suspect_ns < confirmed_ns or (
                stamp_ns < evidence.onsets[1, best[0]] + best[2] * likely.after_ns):
            return None
        holding = [k for k in range(len(self._places)) if k not in lost_cups]
        cause, error, spread, parts = _fault(evidence, best)
        logs = [part for part, (_, _, is_log) in zip(parts, cause.parts, strict=False) if is_log]
        size, std = max(logs or parts[:1], key=lambda each: each[0] / each[1])
        if size < cause.least:
            return None
        most = MAX_ODDS if likely.mean or best[1] < AT_START else MIN_CLEAR_ODDS
        odds, cup = min(math.exp(min(lead, 20.0)), most), -1
        name = 'disturbance' if second == NONE else ALARM_CAUSES[second].name if (
            second < OF_CAUSE[CUP]) else self._of_cup(holding[second - OF_CAUSE[CUP]]).cause
        alarm = Alarm(stamp_ns, cause.name, size, std, name, odds, parts)
        if second != NONE and (odds < MIN_CLEAR_ODDS or {cause.name, name} == ALIKE):
            _, _, other, others = _fault(evidence, runner_up)
            spread, alarm = np.hstack([spread, other]), alarm._replace(second_parts=others)
        if best[1] >= CUP:
            cup = holding[best[1] - CUP]
            alarm = self._of_cup(cup, alarm)
        return DetectedFault(alarm, error, spread, cup)

    def _of_cup(self, k: int, alarm: Alarm = NO_ALARM) -> Alarm:
        """Return an alarm as that of the cup at a place."""
        x, y, _, index = self._places[k].tolist()
        return alarm._replace(cause=f'cup {index:.0f}', cup=round(index), place=(x, y))

    def disturbance(
        self, stamp_ns: int, gated: int, likeliest: Likeliest
    ) -> Alarm | None:
        """Return the alarm on innovations of which no cause has the signature, if there are."""
        total, _, (_, number, _), *_, none = likeliest
        if gated < DISTURBED_COUNT or none < self._threshold or none < total + MIN_LEAD:
            return None
        cause = HYPOTHESES[min(number, CUP)].name if total > -math.inf else 'slip'
        odds = math.exp(min(none - total, math.log(MIN_CLEAR_ODDS)))
        return Alarm(stamp_ns, 'disturbance', 0.0, 0.0, cause, odds)

    def without_vacuum(self, stamp_ns: int, cup: int) -> Alarm | None:
        """Return the alarm on a cup whose vacuum breaks down, by its index; None if it is open."""
        places = np.flatnonzero(self._places[:, 3] == cup)
        if not len(places):
            return None
        odds = VACUUM_ODDS * NAMED['cup'].share / NAMED['leak'].share
        return self._of_cup(int(places[0]), Alarm(
            stamp_ns, 'cup', 1.0, 0.0, 'leak', odds, shown_by='vacuum'))

    @staticmethod
    def lost(
        stamp_ns: int, is_held: bool | None, is_seen: bool = True, reach: float = 0.0
    ) -> Alarm:
        """
        Return the alarm on poses out of reach (m), if they are seen, and on the vacuum, if known.

        The odds of a lost package to a camera that sees something else, or to a leak, are those of
        the shares, times `OUT_OF_REACH_ODDS` for the poses, times or by `VACUUM_ODDS`.
        """
        lost, second = NAMED['lost'], NAMED['camera' if is_seen else 'leak']
        odds = lost.share / second.share * (OUT_OF_REACH_ODDS if is_seen else 1.0)
        if is_held is not None:
            odds *= VACUUM_ODDS ** (1 - 2 * is_held)
        if odds < 1.0:
            return Alarm(
                stamp_ns, second.name, reach, 0.0, lost.name, 1.0 / odds, shown_by='vacuum')
        return Alarm(stamp_ns, lost.name, 1.0, 0.0, second.name, odds)


def _fault(
    evidence: Evidence, fault: tuple[int, int, int]
) -> tuple[Cause, Array, Array, Sizes]:
    """
    Return a fault by the slot, hypothesis and components of `Likeliest`.

    Its cause, the error that it has made (n,), the spread of this error (n, components), and the
    sizes of its parts.
    """
    onset, number, components = fault
    h, column = _layout(number)
    cause = HYPOTHESES[h]
    slots, slot = SLOTS[h], max(onset - 1, 0) // EVERY[h]
    std, mean = np.array(cause.prior_std[:components]), np.full(components, cause.mean)
    columns = column + slot + slots * np.arange(components)
    d, *products = evidence.statistics[:1 + components, columns]
    J = products + np.triu(products, 1).T
    for _ in range(1 if cause.mean else SIZE_ROUNDS):  # a large fault has larger parts
        P = np.asarray(np.linalg.inv(J + np.diag(std ** -2.0)), np.float64)
        size = mean + P @ (d - J @ mean)
        if not cause.mean:
            std = std * max(1.0, math.sqrt(np.mean((size**2 + np.diag(P)) / std**2)))
    E: Array = evidence.signatures[:-ekf.FALLEN, columns]
    made = size if number < CUP else mean  # the model goes on without the whole of a cup
    parts = tuple(
        _length(size[first:end], P[first:end, first:end], is_log)
        for first, end, is_log in cause.parts if first < components)
    return cause, E @ made, E * std, parts


def _length(part: Array, P: Array, is_log: bool) -> tuple[float, float]:
    """Return the length of a part of a fault with a covariance, and its standard deviation."""
    length = float(np.linalg.norm(part))
    std = max(float(np.sqrt(part @ P @ part)) / max(length, 1e-12), 1e-12)
    if is_log:
        return abs(math.expm1(part[0])), std * math.exp(part[0])
    return length, std


@kernel
def filter_step(
    row: Any, law: LawTuple, estimate: ekf.EstimateTuple, samples: ekf.Samples,
    is_recorded: bool, until_ns: int, max_step: float, noise: ekf.Noise,
    faults: tuple[Any, Array, Array, Stamps, bool, Array], cups: Array, seen: MeasuredPose,
) -> Any:
    """
    Propagate an estimate to a later stamp, correct it with a measurement there, assess faults.

    Takes what `model_of`, `predicted` and `updated` take, and the faults: their evidence, and the
    steps (n + 7, components), the error that each component of a fault makes. Cups are those of a
    gripper that hold. All in one, and the model as an array:
    tuples of many numbers take long from Python. Returns a verdict, the estimate, the evidence,
    and what `_assessed` returns.
    """
    model, seconds = model_of(row, law), (until_ns - estimate[0]) / NS_PER_S
    E, statistics, distances, onsets, from_start, steps = faults
    verdict, likeliest, memory = USED, NO_FAULT, estimate[5]
    after, E, gain = predicted(
        model, estimate, samples, is_recorded, until_ns, max_step, noise, E, cups)
    _, tool, body, theta, P, _ = after
    if seen[5] > 0.0:
        verdict, innovation, body, theta, learned = updated(
            model, after, seconds, seen, gain)
        if len(E) > 0 and verdict <= OUTSIDE:
            statistics, distances = statistics.copy(), distances.copy()
            onsets = onsets.copy()
            likeliest = _assessed(
                E, statistics, distances, onsets, steps, until_ns, body[0], innovation,
                seen[3][2], verdict <= USED, from_start)
        if likeliest[0] < MAX_NOISE_RATIO or onsets[0, 0] < MIN_NOISE_COUNT:
            memory = learned
    return (verdict, (until_ns, tool, body, theta, P, memory),
            (E, statistics, distances, onsets), likeliest)


@kernel
def _layout(number: int) -> tuple[int, int]:
    """Return of a fault its hypothesis, and where its signatures begin."""
    h = min(number, CUP)
    return h, COLUMNS[h] + (number - h) * ONSETS


@array_kernel
def _assessed(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, innovation: tuple[Array, Array, Array, float, Array], of_lip: bool, used: bool,
    from_start: bool,
) -> Likeliest:
    """
    Update the evidence, in place, with the next `Innovation`, of a package at a place (m, world).

    Returns
    -------
    total : float
        Logarithm of the sum of all likelihood ratios.
    lead : float
        By how much that of the likeliest cause leads the next.
    best : tuple of int
        Likeliest cause: slot of its onset, place in `HYPOTHESES`, number of components.
    second, runner_up : int, tuple of int
        The next, its place in `ALARM_CAUSES` or `NONE`, and the next cause as the likeliest; cups
        of a gripper are after all others in both.
    pinned : int
        Slots of the likeliest onset of each cause, as bits.
    none : float
        As total, of `_none_of_these`.

    """
    z, H, root, _, whitened = innovation
    n, C = H.shape[1], H.astype(np.float32)
    response = output_of(C, E, np.empty((6, E.shape[1]), np.float32), of_lip)
    t3.add_product(  # what falls, as a shift in the world
        C[:3, ekf.CAMERA:ekf.CAMERA + 3], E[n + 4:], response[:3])
    change = t3.product(
        root.astype(np.float32), response, np.empty((6, E.shape[1]), np.float32))
    counts, is_settled = onsets[0], onsets[0, 0] >= SETTLING
    if counts[0] >= MAX_COUNT:
        counts[0], distances[0] = MIN_NOISE_COUNT, 6.0 * MIN_NOISE_COUNT
        statistics[:, :COLUMNS[AT_START]] = 0.0
    for k in range(1 + ONSETS):
        if onsets[1, k] >= 0:
            distances[k] += (z * z).sum() if is_settled else 0.0
            counts[k] += 1
    faults = CUP + (E.shape[1] - COLUMNS[CUP]) // ONSETS
    if counts[0] > SETTLING:
        t3.add_product(z.reshape((1, 6)), change, statistics[:1])
        for number in range(faults):
            _add_products(change, number, statistics)
    if used:
        t3.subtract_product(whitened.astype(np.float32), change, E)
    likeliest = _likeliest_fault(statistics, distances, onsets, from_start, faults)
    if counts[0] >= SETTLING and stamp_ns - onsets[1].max() >= ONSET_NS:
        _add_onset(E, statistics, distances, onsets, steps, stamp_ns, place, likeliest[5])
    return likeliest


@kernel
def _free_slot(onsets: Stamps, stamp_ns: int, pinned: int) -> int:
    """
    Return the slot for another onset: that of the older one nearest to its neighbour.

    The likeliest onset of each cause stays, by the bits of `pinned`: evidence of a small fault
    grows slowly, and an alarm takes size and odds from there.
    """
    slot, least = 0, math.inf
    for k in range(len(onsets)):
        before_ns, after_ns = onsets[0], stamp_ns
        if onsets[k] < 0:
            return k
        if pinned >> k & 1:
            continue
        if stamp_ns - onsets[k] > OLDEST_NS:
            return k
        for other in onsets:
            if other < onsets[k]:
                before_ns = max(before_ns, other)
            elif other > onsets[k]:
                after_ns = min(after_ns, other)
        gap = (after_ns - before_ns) / max(stamp_ns - DENSE_NS - onsets[k], 1)
        if gap < least:
            slot, least = k, gap
    return slot


@kernel
def _add_onset(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, pinned: int,
) -> None:
    """
    Write the error that each fault causes with an onset now, into a slot of `_free_slot`.

    A camera that turns, turns about the place (m, world) of the package.
    """
    k = _free_slot(onsets[1], stamp_ns, pinned)
    distances[k], onsets[0, k], onsets[1, k] = 0.0, 0, stamp_ns
    faults = CUP + (E.shape[1] - COLUMNS[CUP]) // ONSETS
    for number in range(0 if k == 0 else AT_START, AT_START if k == 0 else faults):
        h, column = _layout(number)
        if (k - 1) % EVERY[h] > 0 and k > 0:
            continue
        first, slots, slot = FIRSTS[h], SLOTS[h], max(k - 1, 0) // EVERY[h]
        for a in range(FIRSTS[h + 1] - first):
            signature = E[:, column + a * slots + slot]
            statistics[:, column + a * slots + slot] = 0.0
            signature[:] = steps[:, first + a]
            x, y, z = signature[ekf.CAMERA + 3:ekf.CAMERA + 6]
            shift = t3.cross(place, (x, y, z))
            for i in range(3):
                signature[ekf.CAMERA + i] += shift[i]


@kernel
def _add_products(change: Array, number: int, statistics: Array) -> None:
    """Add what a measurement, which a fault changes, says of how sure the fault's sizes are."""
    h, column = _layout(number)
    m = SLOTS[h]
    for a in range(FIRSTS[h + 1] - FIRSTS[h]):
        i = column + a * m
        for b in range(a + 1):
            j, J = column + b * m, statistics[1 + b, i:]
            for k in range(m):
                J[k] += (
                    change[0, i + k] * change[0, j + k] + change[1, i + k] * change[1, j + k]
                    + change[2, i + k] * change[2, j + k] + change[3, i + k] * change[3, j + k]
                    + change[4, i + k] * change[4, j + k] + change[5, i + k] * change[5, j + k])


@array_kernel
def _likeliest_fault(
    statistics: Array, distances: Array, onsets: Stamps, from_start: bool, faults: int
) -> Likeliest:
    """Return the result of `_assessed`."""
    causes = OF_CAUSE[CUP] + faults - CUP
    top, sums, best = np.full(causes, -math.inf), np.zeros(causes), np.zeros((causes, 3), np.int64)
    A, z = np.empty((MAX_COMPONENTS, MAX_COMPONENTS, ONSETS)), np.empty((MAX_COMPONENTS, ONSETS))
    explained, determinant = np.empty(ONSETS), np.empty(ONSETS)
    unusual = np.where(
        onsets[0] > 0, distances - 6.0 * onsets[0] - 4.0 * np.sqrt(12.0 * onsets[0]), math.inf)
    for number in range(0 if from_start else AT_START, faults):
        h, column = _layout(number)
        first, later = FIRSTS[h], h >= AT_START
        weight = math.log(EVERY[h] if later else START_WEIGHT)
        explained[:], determinant[:] = 0.0, 1.0
        for i in range(FIRSTS[h + 1] - first):
            _explain(statistics[:, column:], h, i, A, z, explained, determinant)
            if IS_END[first + i]:
                c = OF_CAUSE[h] + number - h
                slot, top[c], sums[c] = _sum_over_onsets(
                    unusual[later::EVERY[h]], explained[:SLOTS[h]], determinant, weight, top[c],
                    sums[c])
                if slot >= 0:
                    best[c, 0], best[c, 1], best[c, 2] = slot * EVERY[h] + later, number, i + 1
    for c in range(causes):
        top[c] += math.log(max(sums[c], 1.0)) + LOG_SHARES[min(c, OF_CAUSE[CUP])]
        top[c] -= math.log(faults - CUP) if c >= OF_CAUSE[CUP] else 0.0
    leader, pinned = top.argmax(), 1
    none = _none_of_these(distances, onsets)
    if top[leader] == -math.inf:
        return -math.inf, -math.inf, (0, 0, 0), 0, (0, 0, 0), 1, none
    second, rival = NONE, -math.inf if leader == PUSH else none
    for c in range(causes):
        pinned |= 1 << best[c, 0]
        if c != leader and top[c] > rival:
            second, rival = c, top[c]
    first, other = best[leader], best[max(second, 0)]
    total = top[leader] + math.log(np.exp(top - top[leader]).sum())
    return (total, top[leader] - rival, (first[0], first[1], first[2]), second,
            (other[0], other[1], other[2]), pinned, none)


@kernel
def _none_of_these(distances: Array, onsets: Stamps) -> float:
    """
    Return the log-likelihood ratio of larger innovations without a signature since an onset.

    Of n innovations with the sum D of squared distances, the likeliest factor of their variance
    is D / 6 n. It is what a cause must explain better: the odds of a cause are capped by its fit.
    """
    top = -math.inf
    for k in range(1, len(distances)):
        expected = 6.0 * onsets[0, k]
        if expected > 0.0 and distances[k] > expected:
            top = max(top, 0.5 * (distances[k] - expected) - 0.5 * expected * math.log(
                distances[k] / expected))
    return top + LOG_SHARE_OF_NONE


@kernel
def _sum_over_onsets(
    unusual: Array, explained: Array, determinant: Array, weight: float, top: float, total: float
) -> tuple[int, float, float]:
    """
    Return the likeliest onset, and the sum of likelihood ratios with those of all onsets.

    Of onsets since when a fault explains most of the squared distances that are unusual. The sum
    is in the largest ratio so far, whose logarithm is `top`; -1 where none of them is larger.
    """
    slot, largest = -1, -math.inf
    for k in range(len(explained)):
        if unusual[k] <= (1.0 + MAX_UNEXPLAINED) * explained[k]:
            largest = max(largest, explained[k])
    if largest == -math.inf:
        return slot, top, total
    base = max(0.5 * largest, top - weight)
    greatest = math.exp(top - weight - base)
    total *= greatest
    for k in range(len(explained)):
        if unusual[k] <= (1.0 + MAX_UNEXPLAINED) * explained[k]:
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
    Add how much of the squared distances component i explains, and the price of its freedom.

    With J and d information and score of a fault's sizes, for each onset: z^T A^-1 z and det A,
    where A = I + s J s and z = s d with s the usual sizes; beside what their mean explains.
    A (6, 6, n) and z (6, n) hold the factors of the components before.
    """
    first, m = FIRSTS[h], SLOTS[h]
    std, d, J = PRIOR_STD[first + i], statistics[0, i * m:], statistics[1:, i * m:]
    for k in range(m):
        z[i, k] = std * d[k]
    if MEANS[h] != 0.0:
        for k in range(m):
            explained[k] = 2.0 * d[k] - J[0, k]
            z[i, k] -= std * J[0, k]
    for j in range(i + 1):
        both, one = std * PRIOR_STD[first + j], 1.0 if i == j else 0.0
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
