"""
Causes of deviating measured poses: likelihood ratios of faults.

A fault is a step in some rows of the error of `filter` at its onset. It changes all later
innovations in a known manner up to its size: its signature, the error that the fault leaves in the
estimate, is propagated and updated like the error. The likelihood ratio of the innovations with
and without a fault, averaged over the prior of its size, is a martingale without faults. Summed
over onsets, and over causes by their prior shares, it grows by 1 per onset on average, and thus
reaches A after A onsets on average at the earliest (Shiryaev and Roberts): the threshold follows
from the allowed rate of false alarms.

Ordinary errors are part of the error and of the covariance of the innovations. A detected fault is
removed from the estimate: the estimate changes by the signature times the likeliest size, and the
covariance grows by the prior of the size.

The error is extended by the fall of the package: the lost fraction of the cup's force, and speed
and shift of the fall (m/s, m; world). The loss of each of several cups of a gripper is a fault,
too: its columns follow all others, and its signature is propagated without that cup.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
import tomllib
from typing import Any, NamedTuple

from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model.kernels import LawTuple, model_of
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import Evidence, ONSETS, predicted
from bellows_ros.core.observer.measurement import (
    MeasuredPose,
    output_of,
    OUTSIDE,
    rise_ratio,
    updated,
    USED,
)
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

CAUSES = tomllib.loads(Path(__file__).with_name('alarms.toml').read_text())
"""Causes by name."""


class Cause(NamedTuple):
    """A kind of fault, as in the file alarms.toml."""

    name: str
    steps: tuple[tuple[int, ...], ...]
    """Rows of the error that step, for each component."""
    prior_std: Sequence[float]
    ends: Sequence[int]
    share: float
    at_start: bool
    sets_in: bool
    parts: Sequence[tuple[int, int, bool]]
    """First and last component of each size, and whether it is a logarithm."""
    every: int = 1
    """Interval of the tested onsets; each represents the onsets between."""
    after_ns: int = 0
    """Smallest age of an onset per component, ns: a younger fault has no reliable size, and may be
    the begin of another."""
    mean: float = 0.0
    """Prior mean of the only component."""
    least: float = 0.0
    """Smallest reported size of the first part: smaller ones are confused with other faults (a
    drifting camera with a small loss of force, late stamps with a larger one, a fall with late
    stamps)."""
    confirmed: int = 2
    confirmed_ns: int = 80_000_000
    """Number of measurements and time (ns) required after half the threshold: swapped markers and
    flipped tags, unlike falls, last for a few frames."""


_ROWS = {**states.FIRST, 'FORCE_LOSS': ekf.FORCE_LOSS}
NAMED = {
    name: Cause(name, **{**entry, 'steps': tuple(
        tuple(_ROWS[row] + place for row, place in step) for step in entry['steps'])})
    for name, entry in CAUSES.items()}
ALARM_CAUSES = tuple(sorted(NAMED.values(), key=lambda cause: cause.name == 'cup'))
"""
All tested faults. The last is the loss of one cup of several, with columns of its own for each
holding cup, after all others.
"""

OUT_OF_REACH_ODDS = 100.0
"""Factor on the odds of a lost package by two poses out of any cup's reach."""

VACUUM_ODDS = 1000.0
"""Factor on the odds of a lost package or cup by a broken vacuum; a holding vacuum divides by
it."""

START = tuple(cause for cause in ALARM_CAUSES if cause.at_start)
HYPOTHESES = START + tuple(cause for cause in ALARM_CAUSES if cause.sets_in)
"""Hypotheses: first the faults present from the start, then those with an onset."""
AT_START, CUP = len(START), len(HYPOTHESES) - 1
"""Index of the first hypothesis with an onset, and of the loss of the first cup."""
STEPS = tuple(rows for cause in HYPOTHESES for rows in cause.steps)
FIRSTS = tuple(np.cumsum([0, *(len(cause.steps) for cause in HYPOTHESES)]).tolist())
"""First component of each hypothesis, and the end of the last one."""
IS_END = tuple(n + 1 in cause.ends for cause in HYPOTHESES for n in range(len(cause.steps)))
"""Whether a fault may end with a component."""
OF_CAUSE = tuple(ALARM_CAUSES.index(cause) for cause in HYPOTHESES)
LOG_SHARES = tuple(math.log(cause.share / len(cause.ends)) for cause in ALARM_CAUSES)
PRIOR_STD = tuple(std for cause in HYPOTHESES for std in cause.prior_std)
MEANS = tuple(cause.mean for cause in HYPOTHESES)

ONSET_NS = 30_000_000
"""Mean spacing of the tested onsets, ns. Half of it is the smallest, so that an onset follows each
pose of a camera of 30 Hz with jittering stamps."""

DENSE_NS, OLDEST_NS = 240_000_000, 10_000_000_000
"""
Age up to which all onsets are tested, and age of the oldest tested onset, with growing distances
between, ns.
"""

EVERY = tuple(cause.every for cause in HYPOTHESES)
SLOTS = (1,) * AT_START + tuple(ONSETS // every for every in EVERY[AT_START:])
"""Number of onsets of each hypothesis."""
COLUMNS = tuple(np.cumsum([0, *(
    slots * len(cause.steps) for cause, slots in zip(HYPOTHESES, SLOTS, strict=True))]).tolist())
"""First column of each hypothesis, with one column per component and onset."""
MAX_COMPONENTS = max(len(cause.steps) for cause in HYPOTHESES)

MARGIN, GRIPPER_MARGIN = -2.0, -1.0
"""
Corrections of the logarithm of the threshold for one cup and for several, as only some of the
older onsets are tested, and alarms are confirmed. By `python -m benchmarks.alarms` false alarms
are fewer than allowed.
"""

START_WEIGHT = 100.0
"""Prior odds of a fault from the start against an onset at one of the tested times."""

SETTLING = 4
"""Number of measurements after the start or an alarm without a test, in which the noise is
estimated."""

MIN_NOISE_COUNT, MAX_NOISE_RATIO = 33, 3.0
"""
Number of measurements after the start or an alarm in which the noise is estimated in any case, and
largest log-likelihood ratio of a fault with which the noise is estimated later: a fault would
increase the noise.
"""

MAX_COUNT = 300
"""
Number of measurements after which the evidence of faults from the start is reset: signatures
contain the noise of estimates, whose products add up.
"""

DISTURBED_COUNT, TAG_BURST = 3, 7
"""Numbers of consecutive poses outside the gate from which a disturbance is named: outliers are
rarer, and blurred poses of a tag come in bursts of 2 to 6."""

VIEW_NS = 3_000_000_000
"""Shortest duration of a camera shift seen with a tag, ns: work changes the view within this
time."""

MIN_LEAD, DECIDE_NS = 3.0, 800_000_000
"""
Smallest lead in log-likelihood ratio of a reported cause (95 %), and time after half the threshold
from which none is required, ns.
"""

MAX_UNEXPLAINED = 0.2
"""Largest fraction of the misfit not explained by a reported cause."""

SIZE_ROUNDS = 20
"""Number of iterations in which the prior sizes of a large fault's components grow."""

MIN_CLEAR_ODDS = 100.0
CLEAR_LEAD = math.log(MIN_CLEAR_ODDS)
"""
Odds below which an alarm also has the sizes of the second cause, and their logarithm. A wrong
payload has these odds against a worn cup after the cup has carried another package.
"""

ALIKE = frozenset(('wear', 'payload'))
"""Causes distinguished by damping only: an alarm has the sizes of both at any odds."""

MAX_ODDS = math.exp(14.0)
"""Largest odds of a fault from the start, of a lost package or of a lost cup; of others 100."""

LOG_SHARE_OF_NONE = math.log(0.1)
"""Logarithm of the prior share of causes without a signature, including disturbances."""

NONE, PUSH, PAYLOAD, WEAR = -1, *(
    [cause.name for cause in ALARM_CAUSES].index(name)
    for name in ('disturbance', 'payload', 'wear'))
"""Indices of the cause without a signature, of an external push, of a wrong payload and of
wear."""

Likeliest = tuple[float, float, tuple[int, int, int], int, tuple[int, int, int], int, float]
NO_FAULT = -math.inf, -math.inf, (0, 0, 0), 0, (0, 0, 0), 1, -math.inf
"""Result of `_assessed` without a fault or without a test."""


Sizes = tuple[tuple[float, float], ...]
"""Sizes of the parts of a fault, with standard deviations: m, rad, m/s, s or relative."""


class Alarm(NamedTuple):
    """A detected fault."""

    stamp_ns: int
    cause: str
    size: float
    """Size of the most significant part, m, m/s, s or relative."""
    std: float
    second: str
    """Second likeliest cause; 'disturbance' for one without a signature."""
    odds: float
    """Odds of the cause against the second cause, at most `MAX_ODDS`."""
    parts: Sizes = ()
    second_parts: Sizes = ()
    """Sizes of the second cause, if its odds are considerable."""
    cup: int = -1
    """Index in cup.layout of a lost cup."""
    place: tuple[float, float] = (0.0, 0.0)
    """Position of a lost cup in the tool, m."""
    shown_by: str = 'poses'
    """Origin of the alarm: 'poses' of the package, or 'vacuum'."""


NO_ALARM = Alarm(0, '', 0.0, 0.0, '', 1.0)


class DetectedFault(NamedTuple):
    """An alarm, and the error by the fault: likeliest value (n,) and spread (n, k)."""

    alarm: Alarm
    error: Array
    spread: Array
    cup: int = -1
    """Index of the lost cup among the holding cups of a gripper; -1 if none."""


class Alarms:
    """
    Detect faults in successive innovations.

    Parameters
    ----------
    false_per_hour : float
        Allowed rate of false alarms.
    of_lip : bool
        Whether the lip is measured, which a slipping package moves, instead of a marker on the
        package.
    places : ndarray (cups, 4)
        Places of the holding cups of a gripper, as `places_of` returns them.
    of_tag : bool
        Whether a tag is measured, whose errors in one view resemble a shifted camera.

    Attributes
    ----------
    steps : ndarray (rows + 7, components)
        Error by each component of a fault.
    is_cup_proven : bool
        Whether the cup has carried another package without an alarm.

    """

    is_cup_proven = False

    def __init__(
        self, false_per_hour: float, of_lip: bool, places: Array, of_tag: bool = False
    ) -> None:
        """Set the threshold and the initial signatures."""
        self._places, self._of_tag = places, of_tag
        self._threshold = math.log(3600 * NS_PER_S / ONSET_NS / false_per_hour) + (
            MARGIN if len(places) == 1 else GRIPPER_MARGIN)
        self.steps: Array = np.zeros((states.ROWS + ekf.FALLEN, len(STEPS)))
        for component, step in enumerate(STEPS):
            for row in step:
                self.steps[row, component] = 1.0
                if of_lip and states.COM <= row < states.COM + 3:
                    self.steps[states.MARKER + row - states.COM, component] = 1.0

    def start(
        self, stamp_ns: int, place: Vector, cups: int, from_start: bool = True
    ) -> Evidence:
        """
        Return the initial evidence, for a package at a place (m, world).

        Faults from the start begin at the given stamp.
        """
        columns = COLUMNS[CUP] + cups * ONSETS
        none = Evidence(
            np.zeros((len(self.steps), columns), np.float32),
            np.zeros((1 + MAX_COMPONENTS, columns)), np.zeros(1 + ONSETS),
            np.repeat([[0], [-1]], 1 + ONSETS, axis=1), (), from_start)
        _add_onset(*none[:4], self.steps, stamp_ns, place, 1)
        return none

    def suspect_ns(self, before: tuple[int, ...], stamp_ns: int, total: float) -> tuple[int, ...]:
        """Return the stamps (ns) since half the threshold, with one more measurement."""
        return (*before, stamp_ns) if total > 0.5 * self._threshold else ()

    def is_likely(self, total: float, lead: float) -> bool:
        """Return whether a cause exceeds the threshold and leads."""
        return min(total - self._threshold, lead) > 0.0

    def detected(
        self, evidence: Evidence, stamp_ns: int, likeliest: Likeliest, lost_cups: tuple[int, ...],
        has_vacuum: bool = False,
    ) -> DetectedFault | None:
        """
        Return a fault detected by a measurement, from the result of `filter_step`, if any.

        Lost cups of a gripper are those detected before. A holding vacuum contradicts a loss.
        """
        _, lead, best, second, runner_up, *_ = likeliest
        if HYPOTHESES[min(best[1], CUP)].name == 'lost':
            lead -= has_vacuum * math.log(VACUUM_ODDS)
        if not self.is_likely(likeliest[0], lead):
            return None
        if self.is_cup_proven and lead < CLEAR_LEAD and second == PAYLOAD and (
                HYPOTHESES[min(best[1], CUP)].name == 'wear'):
            best, runner_up, second, lead = runner_up, best, WEAR, CLEAR_LEAD - lead
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
        """Return an alarm for the cup at a place."""
        x, y, _, index = self._places[k].tolist()
        return alarm._replace(cause=f'cup {index:.0f}', cup=round(index), place=(x, y))

    def disturbance(
        self, stamp_ns: int, gated: int, likeliest: Likeliest
    ) -> Alarm | None:
        """Return the alarm on innovations that match no signature, if any."""
        total, lead, (_, number, _), second, *_, none = likeliest
        least = TAG_BURST if self._of_tag else DISTURBED_COUNT
        cause = HYPOTHESES[min(number, CUP)].name if total > -math.inf else 'slip'
        is_push = cause == 'disturbance' and max(total, none) >= self._threshold
        if gated < least or not (
                is_push or none >= max(self._threshold, total + MIN_LEAD)):
            return None
        if is_push:
            cause, none = ALARM_CAUSES[second].name if second >= 0 else 'slip', total + lead
        odds = math.exp(min(max(none - total, 0.0), CLEAR_LEAD))
        return Alarm(stamp_ns, 'disturbance', 0.0, 0.0, cause, odds)

    def without_vacuum(self, stamp_ns: int, cup: int) -> Alarm | None:
        """Return the alarm on a cup with broken vacuum, by its index; None if the cup is open."""
        places = np.flatnonzero(self._places[:, 3] == cup)
        if not len(places):
            return None
        return self._of_cup(int(places[0]), Alarm(
            stamp_ns, 'cup', 1.0, 0.0, 'leak', VACUUM_ODDS, shown_by='vacuum'))

    @staticmethod
    def lost(
        stamp_ns: int, is_held: bool | None, is_seen: bool = True, reach: float = 0.0
    ) -> Alarm:
        """
        Return the alarm on poses out of reach (m), if seen, and on the vacuum, if known.

        The odds of a lost package against a camera that sees another object, or against a leak,
        are the ratio of their shares, times `OUT_OF_REACH_ODDS` for the poses, times or divided by
        `VACUUM_ODDS`.
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
    Return a fault from slot, hypothesis and components of `Likeliest`.

    The results are its cause, its error (n,), the spread of the error (n, components), and the
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
    for _ in range(1 if cause.mean else SIZE_ROUNDS):  # large faults have larger parts
        P = np.asarray(np.linalg.inv(J + np.diag(std ** -2.0)), np.float64)
        size = mean + P @ (d - J @ mean)
        if not cause.mean:
            std = std * max(1.0, math.sqrt(np.mean((size**2 + np.diag(P)) / std**2)))
    E: Array = evidence.signatures[:-ekf.FALLEN, columns]
    made = size if number < CUP else mean  # the model continues without the whole cup
    parts = tuple(
        _length(size[first:end], P[first:end, first:end], is_log)
        for first, end, is_log in cause.parts if first < components)
    return cause, E @ made, E * std, parts


def _length(part: Array, P: Array, is_log: bool) -> tuple[float, float]:
    """Return length and standard deviation of a part of a fault with a covariance."""
    length = float(np.linalg.norm(part))
    std = max(float(np.sqrt(part @ P @ part)) / max(length, 1e-12), 1e-12)
    if is_log:
        return abs(math.expm1(part[0])), std * math.exp(part[0])
    return length, std


@entry
def filter_step(
    row: Any, law: LawTuple, estimate: ekf.EstimateTuple, samples: ekf.Samples,
    is_recorded: bool, until_ns: int, max_step: float, noise: ekf.Noise,
    faults: tuple[Any, Array, Array, Stamps, bool, Array], cups: Array, seen: MeasuredPose,
) -> Any:
    """
    Propagate an estimate to a later stamp, correct it with a measurement, and assess faults.

    Inputs are as for `model_of`, `predicted` and `updated`, and the faults: their evidence, and
    the error (n + 7, components) by each component. Cups are the holding cups of a gripper. One
    kernel, with the model as an array, is faster to call from Python. The results are a verdict,
    the estimate, the evidence, the result of `_assessed`, and of `rise_ratio` near a support.
    """
    model, seconds = model_of(row, law), (until_ns - estimate[0]) / NS_PER_S
    E, statistics, distances, onsets, from_start, steps = faults
    verdict, likeliest, memory = USED, NO_FAULT, estimate[5]
    after, E, gain = predicted(
        model, estimate, samples, is_recorded, until_ns, max_step, noise, E, cups)
    _, tool, body, theta, P, _ = after
    rise = 0.0
    if seen[7] > 0.0:
        verdict, innovation, body, theta, learned = updated(
            model, after, seconds, seen, gain)
        if seen[6] > 0.0 and verdict <= USED:
            rise = rise_ratio(body, model[2], innovation, seen[6])
        if len(E) > 0 and verdict <= OUTSIDE:
            statistics, distances = statistics.copy(), distances.copy()
            onsets = onsets.copy()
            likeliest = _assessed(
                E, statistics, distances, onsets, steps, until_ns, body[0], innovation,
                seen[3][2], verdict <= USED, from_start)
        if likeliest[0] < MAX_NOISE_RATIO or onsets[0, 0] < MIN_NOISE_COUNT:
            memory = learned
    return (verdict, (until_ns, tool, body, theta, P, memory),
            (E, statistics, distances, onsets), likeliest, rise)


@kernel
def _layout(number: int) -> tuple[int, int]:
    """Return hypothesis and first column of a fault."""
    h = min(number, CUP)
    return h, COLUMNS[h] + (number - h) * ONSETS


@kernel
def _assessed(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, innovation: tuple[Array, Array, Array, float, Array], of_lip: bool, used: bool,
    from_start: bool,
) -> Likeliest:
    """
    Update the evidence in place by the next `Innovation`, for a package at a place (m, world).

    Returns
    -------
    total : float
        Logarithm of the sum of all likelihood ratios.
    lead : float
        Lead of the likeliest cause's logarithm over the next.
    best : tuple of int
        Likeliest cause: slot of its onset, index in `HYPOTHESES`, number of components.
    second, runner_up : int, tuple of int
        Next likeliest cause: index in `ALARM_CAUSES` or `NONE`, and its triple like `best`; cups
        of a gripper follow all others in both.
    pinned : int
        Slots of the likeliest onset of each cause, as bits.
    none : float
        Result of `_none_of_these`.

    """
    z, H, root, _, whitened = innovation
    n, C = H.shape[1], H.astype(np.float32)
    response = output_of(C, E, np.empty((6, E.shape[1]), np.float32), of_lip)
    t3.add_product(  # fall, as a shift in the world
        np.ascontiguousarray(C[:3, states.CAMERA:states.CAMERA + 3]), E[n + 4:], response[:3])
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
        for number in range(faults):
            _add_products(z, change, number, statistics)
    if used:
        t3.subtract_product(whitened.astype(np.float32), change, E)
    likeliest = _likeliest_fault(statistics, distances, onsets, from_start, faults)
    if counts[0] >= SETTLING and stamp_ns - onsets[1].max() >= ONSET_NS // 2:
        _add_onset(E, statistics, distances, onsets, steps, stamp_ns, place, likeliest[5])
    return likeliest


@kernel
def _free_slot(onsets: Stamps, stamp_ns: int, pinned: int) -> int:
    """
    Return the slot for a new onset: of the older onset nearest to its neighbour.

    The likeliest onset of each cause is kept, by the bits of `pinned`: evidence of a small fault
    grows slowly, and determines size and odds of an alarm.
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


@entry
def _add_onset(
    E: Any, statistics: Array, distances: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    place: Vector, pinned: int,
) -> None:
    """
    Write the error by each fault with an onset now, into a slot of `_free_slot`.

    The camera rotates about the place (m, world) of the package.
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
            for i in range(len(signature)):
                signature[i] = steps[i, first + a]
            x, y, z = signature[states.CAMERA + 3:states.CAMERA + 6]
            shift = t3.cross(place, (x, y, z))
            for i in range(3):
                signature[states.CAMERA + i] += shift[i]


@kernel
def _add_products(z: Array, change: Array, number: int, statistics: Array) -> None:
    """Add a measurement's information on the sizes of a fault."""
    h, column = _layout(number)
    m = SLOTS[h]
    for a in range(FIRSTS[h + 1] - FIRSTS[h]):
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
    statistics: Array, distances: Array, onsets: Stamps, from_start: bool, faults: int
) -> Likeliest:
    """Return the result of `_assessed`."""
    causes = OF_CAUSE[CUP] + faults - CUP
    top, sums, best = np.full(causes, -math.inf), np.zeros(causes), np.zeros((causes, 3), np.int64)
    A, z = np.empty((MAX_COMPONENTS, MAX_COMPONENTS, ONSETS)), np.empty((MAX_COMPONENTS, ONSETS))
    explained, determinant = np.empty(ONSETS), np.empty(ONSETS)
    unusual = _unusual(distances, onsets[0])
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

    For n innovations with the sum D of squared distances, the likeliest factor of their variance
    is D / 6 n. A cause must fit better than this: the ratio caps its odds.
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
    Return the likeliest onset, and the sum of likelihood ratios including all onsets.

    Only onsets count since which a fault explains most of the unusual squared distances. The sum
    is relative to the largest ratio so far, whose logarithm is `top`; the onset is -1 if none is
    larger.
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
    Add the squared distances explained by component i, and the cost of its freedom.

    With information J and score d of a fault's sizes, for each onset: z^T A^-1 z and det A, where
    A = I + s J s and z = s d with prior sizes s; plus the part explained by their mean. A (6, 6,
    n) and z (6, n) hold the factors of previous components.
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
