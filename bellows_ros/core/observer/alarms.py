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

import math
import re
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.geometry.jit import array_kernel, kernel
from bellows_ros.core.geometry.tuples import (
    add_product,
    product,
    Quaternion,
    subtract_product,
    Vector,
)
from bellows_ros.core.model.kernels import Branch, model_of, State
from bellows_ros.core.model.simulation import first_after
from bellows_ros.core.observer.filter import (
    CAMERA,
    COM,
    Evidence,
    FALLEN,
    LENGTHENING,
    MARKER,
    MASS,
    ONSETS,
    predicted,
    SHIFT,
    STIFFNESS,
)
from bellows_ros.core.observer.measurement import Marker, observed, OUT_OF_REACH, updated, USED
import numpy as np

GONE = -FALLEN
"""The first of the rows of what falls."""


PERCENT = 100.0
"""Unit of the numbers whose error is a logarithm."""


class Cause(NamedTuple):
    """A kind of fault."""

    name: str
    steps: tuple[tuple[int, ...], ...]
    """The rows of the error that step, for each component of the fault."""
    usual: tuple[float, ...]
    """Prior standard deviations of the fault's components."""
    ends: tuple[int, ...]
    """How many of the components, from the first on, a fault of this kind has."""
    share: float
    """Prior share among all faults."""
    at_start: bool
    sets_in: bool
    """Whether it may be present from the start, and whether it may have an onset."""
    message: str
    """The finding, by the sizes of its parts, and what to do; [] holds what it may lack."""
    parts: tuple[tuple[int, int, float], ...] = ((0, 1, 1e3),)
    """Components from first to before last make a size, shown in this unit."""
    every: int = 1
    """One in so many of the onsets is tested, and counts for all of them."""
    after_ns: int = 0
    """How long (ns) after its onset the fault can be told from others."""


CAUSES = (
    Cause('slip', ((COM, SHIFT), (COM + 1, SHIFT + 1), *((MARKER + 3 + i,) for i in range(3))),
          (3e-3, 3e-3, 0.1, 0.1, 0.1), (2, 5), 0.4, False, True,
          'The grip has slipped by {} mm[ and turned by {} degrees]: move slower, or raise '
          'the vacuum.', ((0, 2, 1e3), (2, 5, 180.0 / math.pi))),
    Cause('leak', ((LENGTHENING,),), (5e-3,), (1,), 0.1, False, True,
          'The cup yields by {} mm/s, as with a leak: check its lip and the vacuum.',
          after_ns=300_000_000),
    Cause('wear', tuple(tuple(range(first, first + 3)) for first in (STIFFNESS, STIFFNESS + 3)),
          (0.2, 0.2), (2,), 0.1, True, False,
          'The stiffness of the cup is off by {} % in translation and {} % in rotation: '
          "it is worn, or another cup is mounted. Identify it with 'bellows identify'.",
          ((0, 1, PERCENT), (1, 2, PERCENT))),
    Cause('payload', tuple((row,) for row in range(MASS, MASS + 4)), (0.2, 0.01, 0.01, 0.01),
          (1, 4), 0.1, True, False,
          'The mass is off by {} %[ and the centre of mass by {} mm]: correct package.*, or '
          'set payload.estimate.', ((0, 1, PERCENT), (1, 4, 1e3))),
    Cause('lost', ((GONE,),), (0.3,), (1,), 0.1, False, True,
          'The package is lost: stop the arm.', ((0, 1, 1.0),), 2),
    Cause('camera', tuple((row,) for row in range(CAMERA, CAMERA + 6)), (6e-3,) * 6, (3, 6), 0.2,
          True, True,
          'The frame of the camera has moved by {} mm[ and {} mrad]: calibrate it.',
          ((0, 3, 1e3), (3, 6, 1e3))),
)
"""The faults that are tested."""

CUP_USUAL, CUP_SHARE = 0.15, 0.1
"""Prior standard deviation of the part of a cup's wrench that is lost, whose mean is 1; share."""

CUP_MESSAGE = (
    'Cup {:.0f} of cup.layout, at x {:.0f} mm, y {:.0f} mm, holds no more ({}): check its lip and '
    'its vacuum, and add it to cup.open.')

OF_LEAK, LOST, OF_CAMERA = 1, 4, 5

OUT_OF_REACH_ODDS = 100.0
"""Factor on the odds of a lost package by two poses where no cup can hold it."""

VACUUM_ODDS = 1000.0
"""Factor by a vacuum that breaks down; one that holds divides by it."""

SEES_ANOTHER = (
    'The vacuum stays, but the camera sees the package where the cup cannot hold it: check the '
    'camera, and the marker on the package.')

START = tuple(cause for cause in CAUSES if cause.at_start)
HYPOTHESES = START + tuple(cause for cause in CAUSES if cause.sets_in)
"""First the faults present from the start, then those with an onset."""
STEPS = tuple(rows for cause in HYPOTHESES for rows in cause.steps)
FIRSTS = tuple(np.cumsum([0, *(len(cause.steps) for cause in HYPOTHESES)]).tolist())
"""First component of each fault, and the end of the last one."""
AT_START = len(START)
IS_END = tuple(n + 1 in cause.ends for cause in HYPOTHESES for n in range(len(cause.steps)))
"""Whether a fault may have the components up to this one."""
OF_CAUSE = tuple(CAUSES.index(cause) for cause in HYPOTHESES)
SHARES = tuple(math.log(cause.share / len(cause.ends)) for cause in CAUSES)
USUAL = tuple(std for cause in HYPOTHESES for std in cause.usual)
MEAN = tuple(1.0 if rows == (GONE,) else 0.0 for rows in STEPS)
"""A lost package has lost all of the cup's force."""

ONSET_NS = 30_000_000
"""Spacing (ns) of the onsets tested."""

DENSE_NS, OLDEST_NS = 240_000_000, 10_000_000_000
"""
All onsets of a time (ns) are tested, what is older farther apart, and nothing that is older than
this (ns): all that falls for long has fallen out of any number's range.
"""

EVERY = tuple(cause.every for cause in HYPOTHESES)
AFTER_NS = tuple(cause.after_ns for cause in HYPOTHESES)
SLOTS = (1,) * AT_START + tuple(ONSETS // every for every in EVERY[AT_START:])
"""Onsets of each hypothesis, ..."""
COLUMNS = tuple(np.cumsum([0, *(
    slots for cause, slots in zip(HYPOTHESES, SLOTS, strict=True) for _ in cause.steps)]).tolist())
"""... and where the signatures of each component begin, one for each onset, and the end."""
DISTANCES = COLUMNS[-1]
INFORMATION = tuple((DISTANCES + 1 + ONSETS + np.cumsum([0, *(
    slots * len(cause.steps) * (len(cause.steps) + 1) // 2
    for cause, slots in zip(HYPOTHESES, SLOTS, strict=True))])).tolist())
"""
Where in the numbers of `Evidence` squared distances begin, after the scores of all columns, and
for each hypothesis the lower triangle of its information, row by row, each entry for all onsets.
"""
LARGEST = max(len(cause.steps) for cause in HYPOTHESES)

MARGIN = -1.0
"""
Added to the logarithm of the threshold for sums over all onsets: only some of the older ones are
tested. Counted in `python -m benchmarks.alarms`.
"""

START_WEIGHS = 30.0
"""Prior odds of a fault from the start against an onset at any one of the times tested."""

SETTLING = 4
"""Measurements from the start, or an alarm, that are not compared: the noise is learned first."""

SURE, DECIDE_NS = 3.0, 500_000_000
"""
A cause is named when its log-likelihood ratio leads that of the next by so much, which is 95 %, or
so long (ns) after half-way to the threshold.
"""

CONFIRMED, CONFIRMED_NS = 2, 80_000_000
"""
Measurements and time (ns) required after half the threshold is passed: a marker may be confused
with another one, or the pose of a tag flip, for some frames.
"""

UNEXPLAINED = 0.2
"""Largest fraction of the misfit that a named cause may leave unexplained."""

UNSURE = 100.0
"""Below these odds to the second cause the message has both with their sizes."""

DECIDES = {
    frozenset(('wear', 'payload')): ' Weigh the package to decide between them.',
    frozenset(('slip', 'camera')): ' If the camera has moved, what stands still is shifted, too.',
}
"""What tells causes apart; of the first mass with inertia is K and P the other way round."""


Likeliest = tuple[float, float, tuple[int, int, int], int, tuple[int, int, int]]
NOTHING_FOUND = -math.inf, 0.0, (0, 0, 0), 0, (0, 0, 0)
"""What `_step` returns, and where nothing is compared."""


class Alarm(NamedTuple):
    """A fault that was found."""

    stamp_ns: int
    cause: str
    size: float
    """m, m/s or relative."""
    size_std: float
    second: str
    """The second likeliest cause."""
    odds: float
    """Of the cause to the second, at most a million."""
    message: str
    cup: int = -1
    """Index in cup.layout of a cup that is lost."""


class DetectedFault(NamedTuple):
    """An alarm, and what the fault makes of the error: likeliest value (n,) and spread (n, k)."""

    alarm: Alarm
    error: Array
    spread: Array
    cup: int = -1
    """Which cup of a gripper is lost, by its place among those that held; -1 if none."""


class Alarms:
    """
    Look for causes in the innovations, one after the other.

    Parameters
    ----------
    false_per_hour : float
        How many false alarms are allowed.
    rows : int
        Of the error.
    of_lip : bool
        Whether the lip is measured: a package that slips moves, a marker on it is no longer there.
    places : ndarray (cups, 4)
        Of the cups of a gripper that hold, as of `places_of`.

    Attributes
    ----------
    steps : ndarray (rows + 7, components)
        The error that each component of a fault makes.

    """

    def __init__(self, false_per_hour: float, rows: int, of_lip: bool, places: Array) -> None:
        """Know the signatures at the onset."""
        self._places = places
        self._threshold = math.log(3.6e12 / ONSET_NS / false_per_hour) + MARGIN
        self.steps: Array = np.zeros((rows + FALLEN, len(STEPS)))
        for component, step in enumerate(STEPS):
            for row in step:
                self.steps[row, component] = 1.0
                if of_lip and COM <= row < COM + 3:
                    self.steps[MARKER + row - COM, component] = 1.0

    def start(self, stamp_ns: int, cups: int, is_first: bool = True) -> Evidence:
        """Return that there is none; faults from the start begin at a stamp."""
        none = Evidence(
            np.zeros((len(self.steps), COLUMNS[-1] + cups * ONSETS), np.float32),
            np.zeros(INFORMATION[-1] + 2 * cups * ONSETS),
            np.repeat([[0], [-1]], 1 + ONSETS, axis=1), (), is_first)
        _set_in(*none[:3], self.steps, stamp_ns, 0)
        return none

    def half_way(self, before: tuple[int, ...], stamp_ns: int, total: float) -> tuple[int, ...]:
        """Return the stamps (ns) since half-way to the threshold, with one more measurement."""
        return (*before, stamp_ns) if total > 0.5 * self._threshold else ()

    def found(
        self, known: Evidence, stamp_ns: int, outcome: Likeliest,
        opened: tuple[int, ...],
    ) -> DetectedFault | None:
        """
        Return a fault if one is found after a measurement, by the outcome of `processed`.

        Those cups of a gripper that are opened have been found to be lost before.
        """
        total, lead, best, second, runner_up = outcome
        if total < self._threshold or len(known.half_way) <= CONFIRMED or (
                stamp_ns - known.half_way[0] < (DECIDE_NS if lead < SURE else CONFIRMED_NS)):
            return None
        holding = [k for k in range(len(self._places)) if k not in opened]
        names = [*(cause.name for cause in CAUSES), *(self._cup(k) for k in holding)]
        odds = math.exp(min(lead, 14.0))
        if best[1] >= len(HYPOTHESES):
            return self._cup_found(known, stamp_ns, best, holding, names[second], odds)
        return self._found(known, stamp_ns, best, names[second], odds, runner_up)

    def _cup(self, k: int) -> str:
        """Return the name of a cup."""
        return f'cup {self._places[k, 3]:.0f}'

    def _cup_found(
        self, known: Evidence, stamp_ns: int, best: tuple[int, ...], holding: list[int],
        second: str, odds: float,
    ) -> DetectedFault:
        """Return what is known of a cup that is lost."""
        which, slot = best[1] - len(HYPOTHESES), best[0] - 1
        at, number = which * ONSETS + slot, holding[which]
        d, J = known.numbers[INFORMATION[-1]:].reshape(2, -1)[:, at].tolist()
        variance = 1.0 / (J + CUP_USUAL**-2.0)
        size, std = 1.0 + variance * (d - J), math.sqrt(variance)
        x, y, _, index = self._places[number].tolist()
        message = CUP_MESSAGE.format(
            index, 1e3 * x, 1e3 * y, f'lost: {_with_std(100.0, size, std)} % of its wrench')
        E: Array = known.signatures[:-FALLEN, COLUMNS[-1] + at].astype(np.float64)
        return DetectedFault(
            Alarm(stamp_ns, self._cup(number), size, std, second, odds,
                  message + _runner_up(second, odds), round(index)),
            E, E.reshape(-1, 1) * CUP_USUAL, number)

    def _found(
        self, known: Evidence, stamp_ns: int, best: tuple[int, ...], second: str, odds: float,
        runner_up: tuple[int, ...],
    ) -> DetectedFault:
        """Return what is known of the likeliest fault, and of the next where it may be that."""
        onset, which, components = best
        cause = HYPOTHESES[which]
        size, P, columns = self._size(known, onset, which, components)
        message = _sentence(cause, size, P) + _runner_up(second, odds)
        E: Array = known.signatures[:-FALLEN, columns]
        spread = E * np.array(cause.usual[:components])
        if odds < UNSURE and runner_up[1] < len(HYPOTHESES):
            other = HYPOTHESES[runner_up[1]]
            other_size, other_P, columns = self._size(known, *runner_up)
            message += f' Then: {_sentence(other, other_size, other_P)}' + DECIDES.get(
                frozenset((cause.name, second)), '')
            spread = np.hstack([spread, known.signatures[:-FALLEN, columns] * np.array(
                other.usual[:len(columns)])])
        alarm = Alarm(
            stamp_ns, cause.name, *_length(size, P, *cause.parts[0]), second, odds, message)
        return DetectedFault(alarm, E @ size, spread)

    def _size(
        self, known: Evidence, onset: int, which: int, components: int
    ) -> tuple[Array, Array, list[int]]:
        """Return the likeliest size of a fault, its covariance, and its columns."""
        first, end = FIRSTS[which], FIRSTS[which] + components
        slot = max(onset - 1, 0) // EVERY[which]
        usual, mean = np.array(USUAL[first:end]), np.array(MEAN[first:end])
        of_slot = known.numbers[INFORMATION[which] + slot:INFORMATION[which + 1]:SLOTS[which]]
        J = np.zeros((components, components))
        J[np.tril_indices(components)] = of_slot[:components * (components + 1) // 2]
        J += np.tril(J, -1).T
        columns = [column + slot for column in COLUMNS[first:end]]
        P = np.asarray(np.linalg.inv(J + np.diag(usual ** -2.0)), np.float64)
        return mean + P @ (known.numbers[columns] - J @ mean), P, columns

    def without_vacuum(self, stamp_ns: int, cup: int) -> Alarm | None:
        """Return the alarm on a cup whose vacuum breaks down, by its index; None if it is open."""
        leak, place = CAUSES[OF_LEAK], self._places[self._places[:, 3] == cup]
        if not len(place):
            return None
        odds = VACUUM_ODDS * CUP_SHARE / leak.share
        x, y = (1e3 * place[0, :2]).tolist()
        return Alarm(
            stamp_ns, f'cup {cup}', 1.0, 0.0, leak.name, odds,
            CUP_MESSAGE.format(cup, x, y, 'its vacuum breaks down') + _runner_up(leak.name, odds))

    def lost(
        self, stamp_ns: int, is_held: bool | None, is_seen: bool = True, reach: float = 0.0
    ) -> Alarm:
        """
        Return the alarm on poses out of reach (m), if they are seen, and on the vacuum, if known.

        The odds of a lost package to a camera that sees something else, or to a leak, are those of
        the shares, times `OUT_OF_REACH_ODDS` for the poses, times or by `VACUUM_ODDS`.
        """
        second = CAUSES[OF_CAMERA if is_seen else OF_LEAK]
        odds = CAUSES[LOST].share / second.share * (OUT_OF_REACH_ODDS if is_seen else 1.0)
        if is_held is not None:
            odds *= VACUUM_ODDS ** (1 - 2 * is_held)
        if odds < 1.0:
            return Alarm(stamp_ns, second.name, reach, 0.0, CAUSES[LOST].name, 1.0 / odds,
                         SEES_ANOTHER + _runner_up(CAUSES[LOST].name, 1.0 / odds))
        return Alarm(stamp_ns, CAUSES[LOST].name, 1.0, 0.0, second.name, odds,
                     CAUSES[LOST].message + _runner_up(second.name, odds))


def _sentence(cause: Cause, size: Array, P: Array) -> str:
    """Return a finding with the sizes of its parts."""
    sizes = [_with_std(part[-1], *_length(size, P, *part))
             for part in cause.parts if part[0] < len(size)]
    lacks = len(sizes) < len(cause.parts)
    message = re.sub(r'\[(.*?)\]', '' if lacks else r'\1', cause.message)
    return message.format(*sizes)


def _with_std(unit: float, value: float, std: float) -> str:
    return f'{unit * value:.1f} ± {unit * std:.1f}'


def _runner_up(second: str, odds: float) -> str:
    return f' Second likeliest: {second}, odds {max(odds, 1.0):.0f} to 1.'


def _length(size: Array, P: Array, first: int, end: int, unit: float) -> tuple[float, float]:
    """Return the length of a part of a fault with a covariance, and its standard deviation."""
    part = size[first:end]
    length = float(np.linalg.norm(part))
    std = float(np.sqrt(part @ P[first:end, first:end] @ part)) / max(length, 1e-12)
    if unit == PERCENT:  # of a logarithm
        return abs(math.expm1(part[0])), std * math.exp(part[0])
    return length, std


@kernel
def processed(
    row: Any, branches: tuple[Branch, ...], theta: Array, tool: State, body: State, P: Array,
    memory: Array, stamps: Any, starts: Any, ends: Any, bodies: Any, is_known: bool, count: int,
    now_ns: int, until_ns: int, longest: float, drive: Array, walk: Array, E: Any, numbers: Array,
    onsets: Stamps, is_first: bool, steps: Array, cups: Array, is_seen: bool, position: Vector,
    quaternion_xyzw: Quaternion, noise: Array, marker: Marker, reach: float, gate: float,
) -> Any:
    """
    Carry an estimate to a later stamp, correct it with what is seen there, and look for faults.

    Takes what `model_of`, `predicted` and `updated` take, how many samples of the tool there are,
    the evidence, and the steps (n + 7, components): the error that each component of a fault
    makes; cups are those of a gripper that hold. All in one, and the model as an array: tuples
    take long from Python. Returns a verdict, tool, body, theta, covariance and memory as
    `updated`, the evidence, and what `_step` returns.
    """
    model, k = model_of(row, branches), first_after(stamps, now_ns, count)
    seconds, verdict, outcome = (until_ns - now_ns) * 1e-9, USED, NOTHING_FOUND
    tool, body, theta, P, E = predicted(
        model, theta, tool, body, P, memory, stamps, starts, ends, bodies, is_known, k, now_ns,
        until_ns, longest, drive, walk, E, cups)
    if is_seen:
        verdict, found, body, theta, memory = updated(
            model, tool, body, theta, P, memory, seconds, position, quaternion_xyzw, noise, marker,
            reach, gate)
        if len(E) > 0 and verdict != OUT_OF_REACH:
            numbers, onsets = numbers.copy(), onsets.copy()
            outcome = _step(
                E, numbers, onsets, steps, until_ns, found, marker[2], verdict == USED, is_first)
    return verdict, tool, body, theta, P, memory, E, numbers, onsets, outcome


@array_kernel
def _step(
    E: Any, numbers: Array, onsets: Stamps, steps: Array, stamp_ns: int,
    found: tuple[Array, Array, Array, float, Array], of_lip: bool, used: bool, is_first: bool,
) -> Likeliest:
    """
    Take the next `Innovation`.

    Returns
    -------
    total : float
        Logarithm of the sum of all likelihood ratios.
    lead : float
        By how much that of the likeliest cause leads the next.
    best : tuple of int
        Of the likeliest cause: slot of its onset, place in `HYPOTHESES`, number of components.
    second, runner_up : int, tuple of int
        The next, its place in `CAUSES`, and as the likeliest; cups of a gripper are after all
        others in both.

    """
    z, H, root, distance, whitened = found
    n, C = H.shape[1], H.astype(np.float32)
    made = observed(C, E, np.empty((6, E.shape[1]), np.float32), of_lip)
    add_product(C[:3, CAMERA:CAMERA + 3], E[n + 4:], made[:3])  # as a shift in the world
    seen = product(root.astype(np.float32), made, np.empty((6, E.shape[1]), np.float32))
    counts, is_settled = onsets[0], onsets[0, 0] >= SETTLING
    for k in range(1 + ONSETS):
        if onsets[1, k] >= 0:
            numbers[DISTANCES + k] += distance if is_settled else 0.0
            counts[k] += 1
    for what in range(len(SLOTS) if counts[0] > SETTLING else 0):
        _compare(seen, z, what, numbers)
    for k in range(E.shape[1] - COLUMNS[-1] if counts[0] > SETTLING else 0):
        made_k, d, J = COLUMNS[-1] + k, 0.0, 0.0
        for i in range(6):
            d += seen[i, made_k] * z[i]
            J += seen[i, made_k] ** 2
        numbers[INFORMATION[-1] + k] += d
        numbers[INFORMATION[-1] + E.shape[1] - COLUMNS[-1] + k] += J
    if used:
        subtract_product(whitened.astype(np.float32), seen, E)
    outcome = _judged(numbers, onsets, stamp_ns, is_first)
    if counts[0] >= SETTLING and stamp_ns - onsets[1].max() >= ONSET_NS:
        _set_in(E, numbers, onsets, steps, stamp_ns, outcome[2][0])
    return outcome


@kernel
def _place(onsets: Stamps, stamp_ns: int, likeliest: int) -> int:
    """
    Return the slot for another onset: that of the older one nearest to its neighbour.

    The slot of the likeliest onset stays: an alarm takes the size of its fault from there.
    """
    place, least = 0, math.inf
    for k in range(len(onsets)):
        before_ns, after_ns = onsets[0], stamp_ns
        if onsets[k] < 0:
            return k
        if k == 0 or k == likeliest:
            continue
        if stamp_ns - onsets[k] > OLDEST_NS:
            return k
        for other in onsets:
            if other < onsets[k]:
                before_ns = max(before_ns, other)
            elif other > onsets[k]:
                after_ns = min(after_ns, other)
        room = (after_ns - before_ns) / max(stamp_ns - DENSE_NS - onsets[k], 1)
        if room < least:
            place, least = k, room
    return place


@kernel
def _set_in(
    E: Any, numbers: Array, onsets: Stamps, steps: Array, stamp_ns: int, likeliest: int
) -> None:
    """Write the error that each fault causes with an onset now, but in the likeliest's slot."""
    k = _place(onsets[1], stamp_ns, likeliest)
    numbers[DISTANCES + k], onsets[0, k], onsets[1, k] = 0.0, 0, stamp_ns
    for what in range(0 if k == 0 else AT_START, AT_START if k == 0 else len(SLOTS)):
        if k > 0 and (k - 1) % EVERY[what] > 0:
            continue
        slot = max(k - 1, 0) // EVERY[what]
        for a in range(FIRSTS[what], FIRSTS[what + 1]):
            numbers[COLUMNS[a] + slot] = 0.0
            E[:, COLUMNS[a] + slot] = steps[:, a]
        numbers[INFORMATION[what] + slot:INFORMATION[what + 1]:SLOTS[what]] = 0.0
    if k > 0:
        E[:, COLUMNS[-1] + k - 1::ONSETS] = 0.0
        numbers[INFORMATION[-1] + k - 1::ONSETS] = 0.0


@kernel
def _compare(seen: Array, z: Array, what: int, numbers: Array) -> None:
    """Add what a measurement says of the sizes of a fault."""
    first, m, J = FIRSTS[what], SLOTS[what], numbers[INFORMATION[what]:]
    for a in range(first, FIRSTS[what + 1]):
        i = COLUMNS[a]
        d = numbers[i:i + m]
        for k in range(m):
            d[k] += (
                seen[0, i + k] * z[0] + seen[1, i + k] * z[1] + seen[2, i + k] * z[2]
                + seen[3, i + k] * z[3] + seen[4, i + k] * z[4] + seen[5, i + k] * z[5])
        for b in range(a + 1 - first):
            j, row = COLUMNS[first + b], m * ((a - first) * (a - first + 1) // 2 + b)
            for k in range(m):
                J[row + k] += (
                    seen[0, i + k] * seen[0, j + k] + seen[1, i + k] * seen[1, j + k]
                    + seen[2, i + k] * seen[2, j + k] + seen[3, i + k] * seen[3, j + k]
                    + seen[4, i + k] * seen[4, j + k] + seen[5, i + k] * seen[5, j + k])


@array_kernel
def _judged(
    numbers: Array, onsets: Stamps, stamp_ns: int, is_first: bool
) -> Likeliest:
    """Return what `_step` does."""
    cups = (len(numbers) - INFORMATION[-1]) // (2 * ONSETS)
    causes = len(SHARES) + cups
    top, sums, best = np.full(causes, -math.inf), np.zeros(causes), np.zeros((causes, 3), np.int64)
    A, z = np.empty((LARGEST, LARGEST, ONSETS)), np.empty((LARGEST, ONSETS))
    explained, determinant = np.empty(ONSETS), np.empty(ONSETS)
    for what in range(0 if is_first else AT_START, len(SLOTS)):
        first, c, later = FIRSTS[what], OF_CAUSE[what], what >= AT_START
        weighs = math.log(EVERY[what] if later else START_WEIGHS)
        explained[:], determinant[:] = 0.0, 1.0
        for i in range(FIRSTS[what + 1] - first):
            _explain(numbers, what, i, A, z, explained, determinant)
            for slot in range(SLOTS[what] if IS_END[first + i] else 0):
                k = slot * EVERY[what] + later
                if stamp_ns >= onsets[1, k] + AFTER_NS[what] and _explains(
                        numbers[DISTANCES + k], explained[slot], onsets[0, k]):
                    ratio = 0.5 * (explained[slot] - math.log(determinant[slot]))
                    _add_ratio(ratio + weighs, c, (k, what, i + 1), top, sums, best)
    _judge_cups(numbers, onsets, cups, top, sums, best)
    for c in range(causes):
        top[c] += math.log(max(sums[c], 1.0)) + (
            SHARES[c] if c < len(SHARES) else math.log(CUP_SHARE / cups))
    likeliest = top.argmax()
    if top[likeliest] == -math.inf:
        return NOTHING_FOUND
    total, second = 0.0, 1 if likeliest == 0 else 0
    for c in range(causes):
        total += math.exp(top[c] - top[likeliest])
        if c != likeliest and top[c] > top[second]:
            second = c
    return (top[likeliest] + math.log(total), top[likeliest] - top[second],
            (best[likeliest, 0], best[likeliest, 1], best[likeliest, 2]), second,
            (best[second, 0], best[second, 1], best[second, 2]))


@kernel
def _judge_cups(
    numbers: Array, onsets: Stamps, cups: int, top: Array, sums: Array, best: Array
) -> None:
    """Add the likelihood ratios of lost cups, whose only number is the part that is lost."""
    first = INFORMATION[-1]
    for at in range(cups * ONSETS):
        cup, k, J = at // ONSETS, at % ONSETS + 1, numbers[first + cups * ONSETS + at]
        d, freedom = numbers[first + at], 1.0 + CUP_USUAL**2 * J
        explained = 2.0 * d - J + (CUP_USUAL * (d - J)) ** 2 / freedom
        if _explains(numbers[DISTANCES + k], explained, onsets[0, k]):
            _add_ratio(0.5 * (explained - math.log(freedom)), len(SHARES) + cup,
                       (k, len(SLOTS) + cup, 1), top, sums, best)


@kernel
def _explains(distance: float, explained: float, count: int) -> bool:
    """Return whether a fault leaves of the squared distances since its onset what is usual."""
    usual = 6.0 * count + 4.0 * math.sqrt(12.0 * count)
    return count > 0 and distance - explained <= usual + UNEXPLAINED * explained


@kernel
def _add_ratio(
    ratio: float, c: int, found: tuple[int, int, int], top: Array, sums: Array, best: Array
) -> None:
    """Add a likelihood ratio, by its logarithm, to the sum of a cause, relative to the largest."""
    if ratio > top[c]:
        sums[c] = 1.0 + sums[c] * math.exp(top[c] - ratio)
        top[c], best[c, 0], best[c, 1], best[c, 2] = ratio, found[0], found[1], found[2]
    else:
        sums[c] += math.exp(ratio - top[c])


@kernel
def _explain(
    numbers: Array, what: int, i: int, A: Array, z: Array, explained: Array, determinant: Array
) -> None:
    """
    Add how much of the squared distances component i explains, and the price of its freedom.

    With J and d information and score of a fault's sizes, for each onset: z^T A^-1 z and det A,
    where A = I + s J s and z = s d with s the usual sizes; beside what their mean explains.
    A (6, 6, n) and z (6, n) hold the factors of the components before.
    """
    first, m, J = FIRSTS[what], SLOTS[what], numbers[INFORMATION[what]:]
    a, usual = first + i, USUAL[first + i]
    d = numbers[COLUMNS[a]:COLUMNS[a] + m]
    for k in range(m):
        z[i, k] = usual * d[k]
    if MEAN[a] != 0.0:  # it is the only number of its fault
        for k in range(m):
            explained[k] = 2.0 * d[k] - J[k]
            z[i, k] -= usual * J[k]
    for j in range(i + 1):
        both, one, row = usual * USUAL[first + j], 1.0 if i == j else 0.0, i * (i + 1) // 2 + j
        for k in range(m):
            A[i, j, k] = both * J[row * m + k] + one
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
