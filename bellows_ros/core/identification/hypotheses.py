"""
Hypotheses on wrong inputs, or else on the cup (`variations`), tried one by one.

Each hypothesis frees some numbers, or changes one setting, and everything else is fitted again.
Which of them explains most is said first; it is certain only where nothing else explains nearly as
much, and where the change is many times its standard error.

Simulation (`given`) alone would not do: of 6 s recorded at 240 Hz in a wrong world it takes two
minutes, and names nothing; friction and an oval cup it calls a spring that is not linear, a slip a
turned marker. Nor would wrenches: noise hides a soft spring and a mass 10 % off from them, and
slow poses have none.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification.causes import (
    corrected,
    DISTINCT,
    DOUBTED,
    Finding,
    MATERIAL,
    NONE,
    radius_of_gyration,
    SIGNIFICANT,
)
from bellows_ros.core.identification.objective import (
    Ensemble,
    ensemble_of,
    extra_entries,
    Objective,
    refine,
    ROUNDS,
    SINGULAR,
    SLIPS,
    Solved,
)
from bellows_ros.core.identification.variations import (
    Given,
    hypotheses,
    Hypothesis,
    OTHERWISE,
    Variation,
)
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError
import numpy as np

CHANCE = 2.5
"""Noise floor of a mean of squares, in standard deviations of what chance makes of it."""

NOISE_KNOWN = 2.0
"""Noise floors by which squares may be below zero: noise in wrenches grows with K, and a cup with
which it would be more than all that is left is not the cup."""

COST = 0.1
"""Part by which squares must fall for each number that is freed."""

QUICK_ROUNDS, MOST_RETRIED, MOST_FINDINGS = 3, 6, 2
"""Rounds of a first look without regard to noise; how many are tried again, and returned."""

MOST_ROUNDS, MOST_STARTS = 3, 3
"""Times that a second cause is looked for, beside each of so many of the best."""

TENFOLD = float(np.log(10.0))
"""No inertia is off by more, but by its unit."""

BENT = 0.02
"""Part by which an entry of K is otherwise at the largest deflection, at least, to be said."""

MOST_TURNED = float(np.radians(30.0))
"""Frames and worlds that are turned further are in other axes."""


class Diagnosis(NamedTuple):
    """
    What was found to be otherwise.

    Parameters
    ----------
    excess : float
        What noise does not explain, in weights of the residuals.
    findings : tuple of Finding
        Each alone, the best first; or all that is wrong without any fit.
    besides : tuple of Finding
        What is wrong beside the first of them, once that is corrected.
    is_open : bool
        Whether what is seen without a fit leaves something that is not known.

    """

    excess: float
    findings: tuple[Finding, ...]
    besides: tuple[Finding, ...] = ()
    is_open: bool = False


def diagnose(
    recordings: Sequence[Recording], length: float, structure: Structure,
    known: Sequence[str] = (),
) -> Diagnosis:
    """
    Try every hypothesis where noise does not explain the residuals, and again beside the best.

    What is wrong without any fit is corrected first. What the trials leave is kept with the first
    recording: another call costs nothing.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one cup.
    length : float
        Nominal length, m.
    structure : Structure
        Of K and P.
    known : sequence of str
        Labels of the parameters that are identifiable; all where left out.

    """
    wrong, right = zip(*map(corrected, recordings), strict=True)
    facts: tuple[Finding, ...] = next(filter(None, wrong), ())
    try:
        rounds = right[0].cached(
            ('trials', *(own.name for own in right), length, structure),
            lambda: _rounds(right, length, structure))
    except BellowsError:
        if not facts:
            raise
        return Diagnosis(np.inf, facts, is_open=True)
    found = [_finding(own.tried[0], own, known) for own in rounds if own.tried]
    if facts:
        said = {name for own in facts for name in (own.name, own.instead)}
        besides = tuple(own for own in found if own.name not in said and (
            own.certain if rounds[0].is_explained else own.likely))
        return Diagnosis(np.inf, facts, besides, not (
            rounds[0].is_explained or any(own.certain for own in found)))
    first = rounds[0]
    findings = [_finding(trial, first, known) for trial in first.tried[:MOST_FINDINGS]]
    if first.is_explained and len(rounds) == 1:
        findings = [own for own in findings if own.certain]
    return Diagnosis(first.before.excess, tuple(findings), tuple(found[1:]))


def _rounds(
    recordings: Sequence[Recording], length: float, structure: Structure
) -> 'list[_Round]':
    """
    Return the trials of all hypotheses, or those of two causes, each beside the other.

    One cause may mimic what two do together, so that each of the best is begun with, but where
    one alone explains all, only those that do so, too.
    """
    ensemble, world = ensemble_of(recordings, length, structure), recordings[0].settings.world
    alone = _trials(ensemble, world)
    for best in alone.tried[:MOST_STARTS if alone.is_found else 0]:
        if best is not alone.tried[0] and alone.tried[0].is_all and (
                alone.is_explained or not best.is_all):
            break
        if both := _two(alone, best, ensemble, world):
            return both
    return [alone]


def _two(alone: '_Round', best: '_Trial', ensemble: Ensemble, world: str) -> 'list[_Round]':
    """
    Return the trials of two causes, each beside the other, from one of them, or none.

    The second is looked for where the first is corrected, and the first again where the second
    is, until both stay. Together they leave far less than one, or clearly less and noise alone
    where each is certain beside the other.
    """
    for _ in range(MOST_ROUNDS):
        second = _trials(ensemble.varied(*best.varied), world, best.hypothesis)
        if not second.is_found:
            break
        beside = second.tried[0]
        first = _trials(ensemble.varied(*beside.varied), world, beside.hypothesis, best)
        if not first.is_found:
            break
        again, best = best, first.tried[0]
        if again.named == best.named:
            one, pair = alone.tried[0], [first, second]
            both = alone.objective.solved(ensemble.varied(*best.varied).varied(*beside.varied))
            far = DISTINCT * min(DISTINCT * _left(alone.before), _left(one.solved))
            price = COST * (best.hypothesis.freed + beside.hypothesis.freed) * _left(both)
            is_clear = both.excess + price < min(_chance(both), _score(one) - _least(both))
            if _left(both) < far or is_clear and all(own.is_certain for own in pair):
                return pair
            break
    return []


class _Round(NamedTuple):
    """What is left as it was given, and by the hypotheses, the best first."""

    before: Solved
    tried: 'list[_Trial]'
    structure: Structure
    objective: Objective

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what is left as it was given."""
        return self.before.excess < _chance(self.before)

    @property
    def is_certain(self) -> bool:
        """Whether the best hypothesis is certain, were all parameters identifiable."""
        return bool(self.tried) and _finding(self.tried[0], self, ()).certain

    @property
    def is_found(self) -> bool:
        """Whether the best hypothesis explains most of what noise does not, or is certain."""
        return self.is_certain or bool(self.tried) and not self.is_explained and (
            _score(self.tried[0]) < DISTINCT * _left(self.before))


def _trials(
    ensemble: Ensemble, world: str, beside: Hypothesis | None = None, near: '_Trial | None' = None,
) -> _Round:
    """Return the trials of all hypotheses but one that is corrected, one from where it was."""
    objective, structure = Objective.of(ensemble, beside is not None), ensemble.given[0].structure
    before = objective.solved(ensemble)
    quiet = Ensemble(ensemble.given, ())
    level = objective.solved(quiet).excess - before.excess
    # Where noise explains what is left, causes are small: start at zero, but for a slip's time.
    is_explained = before.excess < _chance(before)
    starts = {near.named: near.theta} if near else {}
    tried = _in_order(
        _tried(h, objective, quiet, starts.get((h.name, h.value), (
            np.zeros(h.freed) if is_explained and h.name != 'slip' else None)),
            1 if is_explained else QUICK_ROUNDS, level)
        for h in hypotheses(ensemble.given, world)
        if beside is None or h.name != beside.name and (h.datum or beside.datum))
    if not tried or is_explained:
        tried = _in_order(_tried(own.hypothesis, objective, ensemble, own.theta)
                          for own in tried if _score(own) < before.excess and _is_known(before))
        return _Round(before, sorted(tried, key=lambda own: not own.is_significant), structure,
                      objective)
    # With weights as they are where the best of them is true.
    objective = Objective.of(ensemble.varied(*tried[0].varied), sound=True)
    return _Round(objective.solved(ensemble), _in_order(
        _tried(trial.hypothesis, objective, ensemble, trial.theta)
        for number, trial in enumerate(tried[:MOST_RETRIED])
        if number < MOST_FINDINGS or DISTINCT**3 * _score(trial) < _left(tried[0].solved)),
        structure, objective)


class _Trial(NamedTuple):
    """A hypothesis, its numbers with their standard errors, and what they leave."""

    hypothesis: Hypothesis
    theta: Array
    std: Array
    solved: Solved
    of_structure: float = np.inf
    """RMS of what another structure has more, in its standard errors."""

    @property
    def is_significant(self) -> bool:
        """Whether one of its numbers is many standard errors from nothing, or it has none."""
        if len(self.theta):
            return bool(np.any(np.abs(self.theta) > SIGNIFICANT * self.std))
        return self.of_structure > SIGNIFICANT

    @property
    def is_all(self) -> bool:
        """Whether noise explains what it leaves."""
        return self.solved.excess < _chance(self.solved)

    @property
    def named(self) -> tuple[str, str]:
        """Name and value of the hypothesis."""
        return self.hypothesis.name, self.hypothesis.value

    @property
    def varied(self) -> tuple[Variation, Array]:
        """What it does to a recording, and its numbers."""
        return self.hypothesis.vary, self.theta


def _tried(
    hypothesis: Hypothesis, objective: Objective, ensemble: Ensemble, start: Array | None = None,
    rounds: int = 0, level: float = 0.0,
) -> _Trial:
    """
    Return a hypothesis with the numbers that explain most, less a level of noise.

    Infinite squares are left where it cannot be: K is positive and keeps its sign, friction takes
    energy, and no inertia is that far off.
    """
    if hypothesis.steps:
        theta, covariance, solved = refine(
            objective, ensemble, hypothesis, start, rounds or ROUNDS)
        std = np.sqrt(np.diag(covariance))
    else:
        theta = std = NONE
        solved = objective.solved(ensemble.varied(hypothesis.vary, NONE))
    is_physical = True
    if hypothesis in OTHERWISE:
        # Parts by which K changes, or friction as a part of the largest force.
        own = ensemble.given[0].structure
        entries, n = extra_entries(own, hypothesis.name), 2 * own.size
        each = {'friction': SLIPS, 'cubic': (1.0, 1.0)}.get(hypothesis.name, (1.0,))
        K = solved.x[entries]
        T = np.kron(each, np.eye(len(entries))) / K[:, None]
        covariance = T @ solved.covariance[n:, n:] @ T.T
        theta, std = T @ solved.x[n:], np.sqrt(np.diag(covariance))
        size, best = np.abs(theta), int(np.argmax(np.abs(theta) / std))
        row, column = own.leads[entries[best]]
        is_physical = bool(K[best] > 0.0 or row != column) and bool(
            0.0 < theta[best] < 1.0 if hypothesis.name == 'friction'
            else np.all((size < 1.0) | (size < SIGNIFICANT * std)))
    elif hypothesis.steps:
        is_physical = _is_within(hypothesis.name, theta, ensemble.given[0])
    is_physical &= bool(rounds) or _is_known(solved)
    excess = solved.excess - level if is_physical else np.inf
    return _Trial(hypothesis, theta, std, solved._replace(excess=excess), (
        _beyond(solved, ensemble.given[0].structure, STRUCTURES[hypothesis.value])
        if hypothesis.name == 'structure' else np.inf))


def _beyond(solved: Solved, own: Structure, other: Structure) -> float:
    """Return the RMS of what another structure has more than one, in its standard errors."""
    both = [other.parameters(*pair) for unit in own.model_basis
            for pair in ((unit, 0.0 * unit), (0.0 * unit, unit))]
    more = np.linalg.svd(np.array(both))[2][len(both):]
    covariance = more @ solved.covariance @ more.T
    std = np.sqrt(np.diag(covariance))
    z = more @ solved.x / std
    correlation = covariance / np.outer(std, std)
    return float(np.sqrt(z @ np.linalg.pinv(correlation, SINGULAR, hermitian=True) @ z / len(z)))


def _is_within(name: str, theta: Array, given: Given) -> bool:
    """Return whether numbers are no larger than what they are of: cup, package, lip."""
    held = radius_of_gyration(given.samples.payload)
    largest = {
        'length': 0.5 * given.length, 'com': held, 'inertia': TENFOLD, 'slip': given.length,
        'gravity.direction': MOST_TURNED, 'package_marker': MOST_TURNED}
    numbers = theta[:2] if name == 'slip' else theta
    return float(np.linalg.norm(numbers)) < largest.get(name, np.inf)


def _in_order(trials: Iterable[_Trial]) -> list[_Trial]:
    """Return trials, the best first, without cups and packages that cannot be."""
    return sorted((own for own in trials if np.isfinite(own.solved.excess)), key=_score)


def _is_known(solved: Solved) -> bool:
    """Return whether the noise that was taken is not clearly more than all that is left."""
    return solved.excess > -NOISE_KNOWN * _chance(solved)


def _chance(solved: Solved) -> float:
    """Return the noise floor of squares: the mean of so many residuals is off by chance."""
    return float(CHANCE * np.sqrt(2.0 / solved.residuals))


def _least(solved: Solved) -> float:
    """Return the squares that tell two hypotheses apart."""
    return SIGNIFICANT**2 / solved.residuals


def _left(solved: Solved) -> float:
    """Return the squares that are left, never less than chance leaves."""
    return max(solved.excess, 0.0) + _chance(solved)


def _score(trial: _Trial) -> float:
    """Return what hypotheses are ordered by: squares beyond noise, more for each number freed."""
    return trial.solved.excess + COST * trial.hypothesis.freed * _left(trial.solved)


def _finding(trial: _Trial, among: _Round, known: Sequence[str]) -> Finding:
    """Return what is said of a hypothesis."""
    before, tried, structure, _ = among
    labels = known or structure.labels
    own, value, theta, std = trial.hypothesis, trial.hypothesis.value, trial.theta, trial.std
    left, first = _left(trial.solved), _left(before)
    least = _least(before)
    excess = max(trial.solved.excess, 0.0)
    instead = [t for t in tried if t.solved.excess < max(excess / DISTINCT, excess + least) and (
        {t.hypothesis.name, own.name} == {'length', 'com'} or (
            t.hypothesis.name == own.name == 'yaw' and t is not trial))]

    def dominated(other: _Trial) -> bool:
        """Return whether another explains clearly less, or not all where this one does."""
        rival, most = other.hypothesis, _left(other.solved)
        if rival.freed > own.freed:
            return rival.datum or left < most
        part = DISTINCT if own.datum or not rival.datum else DISTINCT**2
        return left < part * most or (
            excess < _chance(before) and other.solved.excess - excess > least)

    if before.excess < DOUBTED:
        # Another setting, without any number that is significant, must explain more than chance.
        rest = least if len(theta) or own.name == 'structure' else _chance(before)
        certain = trial.is_all and before.excess - trial.solved.excess > rest and all(
            _score(t) - _score(trial) > least for t in tried
            if t.is_significant and t.hypothesis.name != own.name
            and not any(t is i for i in instead))
    else:
        certain = left < DISTINCT**2 * first + _chance(before) and (
            left < DISTINCT * first and excess < DOUBTED) and all(
                dominated(t) for t in tried
                if t.hypothesis.name != own.name and not any(t is i for i in instead))
    diagonal = [i for i, (row, column) in enumerate(structure.leads)
                if row == column and structure.labels[i] in labels]
    moved = change = np.zeros(1)
    if own.name != 'structure':
        moved = change = np.abs(trial.solved.x[diagonal] / before.x[diagonal] - 1.0)
    if own in OTHERWISE:  # the entry of K that shows it best is enough
        entries = extra_entries(structure, own.name)
        best = int(np.argmax(np.isin(entries, diagonal) * np.abs(theta) / std))
        value, theta, std = structure.labels[entries[best]], theta[[best]], std[[best]]
        change = np.abs(theta)
    material = own.name == 'structure' or left < DISTINCT**2 * first or np.any(
        change > (BENT if own in OTHERWISE else MATERIAL))
    return Finding(
        own.name, value, theta, std, float(np.sqrt(left / first)), float(moved.max(initial=0.0)),
        own.datum, bool(certain and material and trial.is_significant and trial is tried[0]),
        instead[0].hypothesis.value or instead[0].hypothesis.name if instead else '', excess)
