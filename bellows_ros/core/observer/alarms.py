"""Detection of the fault that makes measured poses deviate from predicted poses."""

from __future__ import annotations

import math
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import hypotheses as bank
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import Estimate, Evidence, ONSETS
from bellows_ros.core.observer.hypotheses import Cause, HYPOTHESES, Likeliest, Tested
from bellows_ros.core.observer.likelihood import layout, of_start, Prior
from bellows_ros.core.signals.trajectory import NS_PER_S
import numpy as np

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
    """Second likeliest cause; 'disturbance' for a cause without a signature."""
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
    places : ndarray (cups, 4)
        Places of the holding cups of a gripper, as `places_of` returns them.
    of_tag : bool
        Whether a tag is measured, whose errors change with the view, see `LIKE_VIEW`.
    latency_std : float
        Stated standard deviation of the latency, s.

    Attributes
    ----------
    is_cup_proven : bool
        Whether the cup has carried another package without an alarm.

    """

    is_cup_proven = False

    def __init__(
        self, false_per_hour: float, places: Array, of_tag: bool = False, latency_std: float = 0.0,
    ) -> None:
        """Set the threshold."""
        self._places, self._of_tag, self._latency_std = places, of_tag, latency_std
        self._threshold = math.log(3600 * NS_PER_S / bank.ONSET_NS / false_per_hour) + (
            bank.MARGIN if len(places) == 1 else bank.GRIPPER_MARGIN)

    def start(self, stamp_ns: int, rows: int, cups: int, from_start: bool = True) -> Evidence:
        """Return the initial evidence, for rows of the error and a gripper with holding cups."""
        columns = bank.COLUMNS[bank.CUP] + cups * ONSETS
        onsets: Stamps = np.repeat([[0], [-1]], 1 + ONSETS, axis=1)
        onsets[1, 0] = stamp_ns
        return Evidence(
            np.zeros((rows + ekf.FALLEN, columns), np.float32),
            np.zeros((1 + bank.MAX_COMPONENTS, columns)), np.zeros(1 + ONSETS), onsets, from_start)

    def suspect_ns(self, before: tuple[int, ...], stamp_ns: int, total: float) -> tuple[int, ...]:
        """Return the stamps (ns) since half the threshold, including another measurement."""
        return (*before, stamp_ns) if total > 0.5 * self._threshold else ()

    def is_likely(self, total: float, lead: float) -> bool:
        """Return whether a cause exceeds the threshold and leads."""
        return min(total - self._threshold, lead) > 0.0

    def detected(
        self, estimate: Estimate, prior: Prior, likeliest: Likeliest,
        has_vacuum: bool | None = None,
    ) -> DetectedFault | None:
        """
        Return a fault detected by a measurement, from the result of `filter_step`, if any.

        A holding vacuum contradicts a loss. A push is a `disturbance`.
        """
        evidence, stamp_ns = estimate.evidence, estimate.stamp_ns
        total, lead, best, second, runner_up, *_ = likeliest
        likely = HYPOTHESES[min(best.number, bank.CUP)]
        if likely.name == 'lost':
            lead -= bool(has_vacuum) * math.log(bank.VACUUM_ODDS)
        if best.number == bank.PUSH or not self.is_likely(total, lead) or (
                _is_undecided(likely.name, second, lead)):
            return None
        if self.is_cup_proven and lead < bank.CLEAR_LEAD and second == bank.PAYLOAD and (
                likely.name == 'wear'):
            best, runner_up, second, lead = runner_up, best, bank.WEAR, bank.CLEAR_LEAD - lead
            likely = HYPOTHESES[bank.PAYLOAD]
        in_view = self._of_tag and likely.name in bank.LIKE_VIEW
        confirmed_ns = bank.VIEW_NS if in_view else bank.DECIDE_NS if (
            lead < bank.MIN_LEAD) else likely.confirmed_ns
        suspect_ns = stamp_ns - min(estimate.suspect_ns, default=stamp_ns)
        if len(estimate.suspect_ns) <= likely.confirmed or suspect_ns < confirmed_ns or (
                stamp_ns < evidence.onsets[1, best.onset] + best.components * likely.after_ns):
            return None
        holding = [k for k in range(len(self._places)) if k not in estimate.lost_cups]
        cause, error, spread, parts = _fault(estimate, prior, best)
        logs = [part for part, (_, _, is_log) in zip(parts, cause.parts, strict=False) if is_log]
        size, std = max(logs or parts[:1], key=lambda each: each[0] / each[1])
        usual = bank.MAX_DEVIATION * self._latency_std if cause.name == 'latency' else 0.0
        if size < max(cause.least, usual):
            return None
        most = bank.MAX_ODDS if likely.mean or best.number < bank.AT_START else bank.MIN_CLEAR_ODDS
        odds, cup = min(math.exp(min(lead, 20.0)), most), -1
        name = 'disturbance' if second == bank.NONE else HYPOTHESES[second].name if (
            second < bank.CUP) else self._of_cup(holding[second - bank.CUP]).cause
        alarm = Alarm(stamp_ns, cause.name, size, std, name, odds, parts)
        if second != bank.NONE and (
                odds < bank.MIN_CLEAR_ODDS or {cause.name, name} == bank.ALIKE):
            _, _, other, others = _fault(estimate, prior, runner_up)
            spread, alarm = np.hstack([spread, other]), alarm._replace(second_parts=others)
        if best.number >= bank.CUP:
            cup = holding[best.number - bank.CUP]
            alarm = self._of_cup(cup, alarm)
        return DetectedFault(alarm, error, spread, cup)

    def _of_cup(self, k: int, alarm: Alarm = NO_ALARM) -> Alarm:
        """Return an alarm for the cup at a place."""
        x, y, _, index = self._places[k].tolist()
        return alarm._replace(cause=f'cup {index:.0f}', cup=round(index), place=(x, y))

    def disturbance(
        self, stamp_ns: int, gated: int, likeliest: Likeliest, onsets: Stamps
    ) -> Alarm | None:
        """
        Return the alarm on a push, or on innovations that match no signature, if any.

        The alarm requires `DISTURBED_COUNT` poses since the onset of a push, or as many
        consecutive poses outside the gate; for a tag `TAG_BURST`.
        """
        total, lead, best, second, _, _, none = likeliest
        if best.number == bank.PUSH and total >= self._threshold:
            count, other = max(gated, onsets[0, best.onset]), second
        elif none >= max(self._threshold, total + bank.MIN_LEAD):
            count, lead = gated, none - total
            other = best.number if total > -math.inf else bank.NONE
        else:
            return None
        if count < (bank.TAG_BURST if self._of_tag else bank.DISTURBED_COUNT):
            return None
        name = 'slip' if other == bank.NONE else HYPOTHESES[min(other, bank.CUP)].name
        return Alarm(stamp_ns, 'disturbance', 0.0, 0.0, name, math.exp(min(lead, bank.CLEAR_LEAD)))

    def without_vacuum(self, stamp_ns: int, cup: int) -> Alarm | None:
        """Return the alarm on a cup with broken vacuum, by its index; None if the cup is open."""
        places = np.flatnonzero(self._places[:, 3] == cup)
        if not len(places):
            return None
        return self._of_cup(int(places[0]), Alarm(
            stamp_ns, 'cup', 1.0, 0.0, 'leak', bank.VACUUM_ODDS, shown_by='vacuum'))

    def fallen(self, stamp_ns: int, ratio: float) -> Alarm | None:
        """Return the alarm for a fall near a support, by the log-likelihood ratio of the fall."""
        odds = math.exp(min(ratio - self._threshold, bank.CLEAR_LEAD))
        return Alarm(stamp_ns, 'lost', 1.0, 0.0, 'disturbance', odds) if odds > 1.0 else None

    @staticmethod
    def lost(
        stamp_ns: int, is_held: bool | None, is_seen: bool = True, reach: float = 0.0
    ) -> Alarm:
        """
        Return the alarm for poses out of reach (m) and for the vacuum, as far as both are known.

        The odds of a lost package against a camera that sees another object, or against a leak,
        are the ratio of prior shares, times `OUT_OF_REACH_ODDS` for poses out of reach, and times
        `VACUUM_ODDS` for a broken vacuum (divided for a holding vacuum).
        """
        lost, second = bank.NAMED['lost'], bank.NAMED['camera' if is_seen else 'leak']
        odds = lost.share / second.share * (bank.OUT_OF_REACH_ODDS if is_seen else 1.0)
        if is_held is not None:
            odds *= bank.VACUUM_ODDS ** (1 - 2 * is_held)
        if odds < 1.0:
            return Alarm(
                stamp_ns, second.name, reach, 0.0, lost.name, 1.0 / odds, shown_by='vacuum')
        return Alarm(stamp_ns, lost.name, 1.0, 0.0, second.name, odds)


def _is_undecided(name: str, second: int, lead: float) -> bool:
    """Return whether a cause leads too little over one that has another remedy."""
    return bank.NONE < second and lead < bank.MIN_LEAD and (
        {name, HYPOTHESES[min(second, bank.CUP)].name} not in (bank.ALIKE, {'cup'}))


def _fault(
    estimate: Estimate, prior: Prior, fault: Tested
) -> tuple[Cause, Array, Array, Sizes]:
    """Return cause, error (n,), spread of the error (n, components) and sizes of a fault."""
    onset, number, components = fault
    h, column = layout(number)
    cause = HYPOTHESES[h]
    slots, slot = bank.SLOTS[h], max(onset - 1, 0) // bank.EVERY[h]
    std, mean = np.array(cause.prior_std[:components]), np.full(components, cause.mean)
    columns = column + slot + slots * np.arange(components)
    statistics: Array = estimate.evidence.statistics
    if h < bank.AT_START:
        statistics = of_start(prior, estimate.theta, estimate.covariance)
        E = estimate.covariance[:, bank.START_ROWS] @ prior.weights[:, columns]
    else:
        E = estimate.evidence.signatures[:-ekf.FALLEN, columns]
    d, *products = statistics[:1 + components, columns]
    J = products + np.triu(products, 1).T
    for _ in range(1 if cause.mean else bank.SIZE_ROUNDS):  # large faults have larger parts
        P = np.asarray(np.linalg.inv(J + np.diag(std ** -2.0)), np.float64)
        size = mean + P @ (d - J @ mean)
        if not cause.mean:
            std = std * max(1.0, math.sqrt(np.mean((size**2 + np.diag(P)) / std**2)))
    made = size if number < bank.CUP else mean  # the model continues without the whole cup
    parts = tuple(
        _length(size[first:end], P[first:end, first:end], is_log)
        for first, end, is_log in cause.parts if first < components)
    if cause.name == 'latency':  # a part is estimated already
        (size, std_of_size), row = parts[0], states.LATENCY
        share = float(E[row, 0])
        parts = ((float(estimate.theta[row - states.STATE]) + share * size, math.hypot(
            math.sqrt(estimate.covariance[row, row]), share * std_of_size)),)
    return cause, E @ made, E * std, parts


def _length(part: Array, P: Array, is_log: bool) -> tuple[float, float]:
    """Return length and standard deviation of a part of a fault with a covariance."""
    length = float(np.linalg.norm(part))
    std = max(float(np.sqrt(part @ P @ part)) / max(length, 1e-12), 1e-12)
    if is_log:
        return abs(math.expm1(part[0])), std * math.exp(part[0])
    return length, std
