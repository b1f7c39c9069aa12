"""
Hypotheses on wrong inputs, or else on the cup (`variations`), tried one by one.

Each hypothesis frees some numbers, or changes one setting, and everything else is fitted again.
Which of them explains most is said first; it is certain only where nothing else explains nearly as
much, and where the change is many times its standard error.

Where a recording is fitted by simulation, too, the causes of that (`given`) come first. It alone
would not do: of 6 s recorded at 240 Hz it finds no frame that is turned by a quarter (16 s, no
convergence), calls another world and friction a tilt of gravity, an oval cup a spring that is not
linear. Nor would wrenches: noise hides a soft spring and a mass 10 % off from them, slow poses
have none, and they take what was given for exact.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.identification import causes, variations
from bellows_ros.core.identification.causes import DISTINCT, Finding, SIGNIFICANT
from bellows_ros.core.identification.objective import (
    Ensemble,
    ensemble_of,
    extra_entries,
    refine,
    ROUNDS,
    SLIPS,
    Solved,
)
from bellows_ros.core.identification.variations import CUP_EFFECTS, Hypothesis, Variation
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.recording.recording import Recording
from bellows_ros.errors import BellowsError
import numpy as np

FLOOR_STDS = 2.5
"""Noise floor of a mean of squares, in standard deviations of what chance makes of it."""

MAX_NEGATIVE_FLOORS = 2.0
"""Noise floors by which squares may be below zero: noise in wrenches grows with K, and a cup with
which it would be more than all that is left is not the cup."""

PRICE = 0.1
"""Part by which squares must fall for each number that is freed."""

QUICK_ROUNDS, MAX_REFITTED, MAX_FINDINGS = 3, 6, 2
"""Rounds of a first look without regard to noise; how many are tried again, and returned."""

MAX_ROUNDS, MAX_STARTS = 3, 3
"""Times that a second cause is looked for, beside each of so many of the best."""

MAX_LOG_INERTIA = float(np.log(10.0))
"""No inertia is off by more, but by its unit."""

SINGULAR = 1e-10
"""Eigenvalues of a correlation below this count as zero."""

MIN_CUP_EFFECT = 0.02
"""Part by which an entry of K is otherwise at the largest deflection, at least, to be said."""

MAX_ANGLE = float(np.radians(30.0))
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
    identifiable: Sequence[str] = (),
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
    identifiable : sequence of str
        Labels of the parameters that are identifiable; all where left out.

    """
    wrong, right = zip(*map(causes.corrected, recordings), strict=True)
    facts: tuple[Finding, ...] = next(filter(None, wrong), ())
    if not facts and (off := causes.wrong_length(right[0], length)):
        return Diagnosis(np.inf, (off,), is_open=True)
    try:
        names = [recording.name for recording in right]
        rankings = right[0].cached(('trials', *names, length, structure),
                                   lambda: _rankings(right, length, structure))
    except BellowsError:
        if not facts:
            raise
        return Diagnosis(np.inf, facts, is_open=True)
    best = [_finding(ranking.trials[0], ranking, identifiable)
            for ranking in rankings if ranking.trials]
    first = rankings[0]
    if facts:
        corrected = {name for fact in facts for name in (fact.name, fact.instead)}
        besides = tuple(finding for finding in best if finding.name not in corrected and (
            finding.certain if first.is_explained else finding.likely))
        return Diagnosis(np.inf, facts, besides, not (
            first.is_explained or any(finding.certain for finding in best)))
    if len(best) > 1:  # a turned frame looks like couplings
        is_coupled = any(finding.name == 'structure' and finding.certain for finding in best)
        best = [finding._replace(certain=finding.certain and not (
            is_coupled and finding.name == 'package_marker')) for finding in best]
        if best[1].certain and not best[0].certain and best[1].left < best[0].left:
            best.reverse()
        return Diagnosis(first.before.excess, (best[0],), tuple(best[1:]))
    findings = [_finding(trial, first, identifiable) for trial in first.trials[:MAX_FINDINGS]]
    if first.is_explained:
        findings = [finding for finding in findings if finding.certain]
    return Diagnosis(first.before.excess, tuple(findings))


def _rankings(
    recordings: Sequence[Recording], length: float, structure: Structure
) -> 'list[_Ranking]':
    """
    Return the trials of all hypotheses, or those of two causes, each beside the other.

    One cause may mimic what two do together, so that each of the best is begun with, but where
    one alone explains all, only those that do so, too.
    """
    ensemble, world = ensemble_of(recordings, length, structure), recordings[0].settings.world
    alone = _ranking(ensemble, world)
    for best in alone.trials[:MAX_STARTS if alone.is_found else 0]:
        if best is not alone.trials[0] and alone.trials[0].is_sufficient and (
                alone.is_explained or not best.is_sufficient):
            break
        if both := _two(alone, best, ensemble, world):
            return both
    return [alone]


def _two(alone: '_Ranking', best: '_Trial', ensemble: Ensemble, world: str) -> 'list[_Ranking]':
    """
    Return the trials of two causes, each beside the other, from one of them, or none.

    The second is looked for where the first is corrected, and the first again where the second
    is, until both stay. Together they leave far less than one, or clearly less and noise alone
    where each is certain beside the other.
    """
    for _ in range(MAX_ROUNDS):
        second = _ranking(ensemble.varied(*best.varied), world, best.hypothesis)
        if not second.is_found:
            return []
        other = second.trials[0]
        first = _ranking(ensemble.varied(*other.varied), world, other.hypothesis, best)
        if not first.is_found:
            return []
        previous, best = best, first.trials[0]
        if previous.key == best.key:
            one = alone.trials[0]
            both = alone.ensemble.varied(*best.varied).varied(*other.varied).solved()
            half = DISTINCT * min(DISTINCT * _floored(alone.before), _floored(one.solved))
            price = PRICE * (best.hypothesis.freed + other.hypothesis.freed) * _floored(both)
            is_clear = both.excess + price < min(
                _noise_floor(both), _score(one) - _resolution(both))
            is_better = _floored(both) < half or (
                is_clear and first.is_certain and second.is_certain)
            return [first, second] if is_better else []
    return []


class _Ranking(NamedTuple):
    """Weighted recordings, what is left of them, and by the hypotheses, the best first."""

    ensemble: Ensemble
    before: Solved
    trials: 'list[_Trial]'

    @property
    def is_explained(self) -> bool:
        """Whether noise explains what is left as it was given."""
        return self.before.excess < _noise_floor(self.before)

    @property
    def is_certain(self) -> bool:
        """Whether the best hypothesis is certain, were all parameters identifiable."""
        return bool(self.trials) and _finding(self.trials[0], self, ()).certain

    @property
    def is_found(self) -> bool:
        """Whether the best hypothesis explains most of what noise does not, or is certain."""
        return self.is_certain or bool(self.trials) and not self.is_explained and (
            _score(self.trials[0]) < DISTINCT * _floored(self.before))


def _ranking(
    ensemble: Ensemble, world: str, corrected: Hypothesis | None = None,
    near: '_Trial | None' = None,
) -> _Ranking:
    """Return the trials of all hypotheses but one that is corrected, one from where it was."""
    ensemble = ensemble.weighted(corrected is not None)
    before, quiet = ensemble.solved(), ensemble._replace(noise_draws=())
    level = quiet.solved().excess - before.excess
    # Where noise explains what is left, causes are small: start at zero, but for a slip's time.
    is_explained = before.excess < _noise_floor(before)
    starts = {near.key: near.theta} if near else {}
    trials = _ranked(
        _fitted(h, quiet, starts.get((h.name, h.value), (
            np.zeros(h.freed) if is_explained and h.name != 'slip' else None)),
            1 if is_explained else QUICK_ROUNDS, level)
        for h in variations.hypotheses(ensemble.given, world)
        if corrected is None or h.name != corrected.name and (h.datum or corrected.datum))
    if not trials or is_explained:
        trials = _ranked(
            _fitted(trial.hypothesis, ensemble, trial.theta)
            for trial in trials if _score(trial) < before.excess and _is_above_noise(before))
        trials.sort(key=lambda trial: not trial.is_significant)
        return _Ranking(ensemble, before, trials)
    # With weights as they are where the best of them is true.
    sound = ensemble.varied(*trials[0].varied).weighted(sound=True)
    ensemble = ensemble._replace(weight=sound.weight)
    return _Ranking(ensemble, ensemble.solved(), _ranked(
        _fitted(trial.hypothesis, ensemble, trial.theta)
        for number, trial in enumerate(trials[:MAX_REFITTED])
        if number < MAX_FINDINGS or DISTINCT**3 * _score(trial) < _floored(trials[0].solved)))


class _Trial(NamedTuple):
    """A hypothesis, its numbers with their standard errors, and what they leave."""

    hypothesis: Hypothesis
    theta: Array
    std: Array
    solved: Solved
    is_significant: bool
    """Whether one of its numbers is many standard errors from nothing, or it has none."""

    @property
    def is_sufficient(self) -> bool:
        """Whether noise explains what it leaves."""
        return self.solved.excess < _noise_floor(self.solved)

    @property
    def key(self) -> tuple[str, str]:
        """Name and value of the hypothesis."""
        return self.hypothesis.name, self.hypothesis.value

    @property
    def varied(self) -> tuple[Variation, Array]:
        """What it does to a recording, and its numbers."""
        return self.hypothesis.variation, self.theta


def _fitted(
    hypothesis: Hypothesis, ensemble: Ensemble, start: Array | None, rounds: int = 0,
    level: float = 0.0,
) -> _Trial:
    """
    Return a hypothesis with the numbers that explain most, less a level of noise.

    Infinite squares are left where it cannot be: K is positive and keeps its sign, friction takes
    energy, and no inertia is that far off.
    """
    given, is_physical = ensemble.given[0], True
    theta = std = causes.NONE
    if hypothesis.steps:
        theta, covariance, solved = refine(ensemble, hypothesis, start, rounds or ROUNDS)
        std = np.sqrt(np.diag(covariance))
        is_physical = _is_within(hypothesis.name, theta, given)
    else:
        solved = ensemble.varied(hypothesis.variation, theta).solved()
    if hypothesis in CUP_EFFECTS:
        theta, std, is_physical = _cup_effect(hypothesis.name, solved, given.structure)
    is_physical &= bool(rounds) or _is_above_noise(solved)
    excess = solved.excess - level if is_physical else np.inf
    is_significant = bool(np.any(np.abs(theta) > SIGNIFICANT * std)) if len(theta) else (
        hypothesis.name != 'structure' or SIGNIFICANT < _structure_change(
            solved, given.structure, STRUCTURES[hypothesis.value]))
    return _Trial(hypothesis, theta, std, solved._replace(excess=excess), is_significant)


def _cup_effect(name: str, solved: Solved, structure: Structure) -> tuple[Array, Array, bool]:
    """
    Return parts by which K changes, with their standard errors, and whether they are physical.

    Friction is a part of the largest force.
    """
    entries, n = extra_entries(structure, name), 2 * structure.size
    each = {'friction': SLIPS, 'cubic': (1.0, 1.0)}.get(name, (1.0,))
    K = solved.x[entries]
    T = np.kron(each, np.eye(len(entries))) / K[:, None]
    theta, std = T @ solved.x[n:], np.sqrt(np.diag(T @ solved.covariance[n:, n:] @ T.T))
    size, best = np.abs(theta), int(np.argmax(np.abs(theta) / std))
    row, column = structure.leads[entries[best]]
    is_physical = np.all((size < 1.0) | (size < SIGNIFICANT * std)) and (
        theta[best] > 0.0 or name != 'friction') and (K[best] > 0.0 or row != column)
    return theta, std, bool(is_physical)


def _structure_change(solved: Solved, structure: Structure, other: Structure) -> float:
    """Return the RMS of what another structure has more than one, in its standard errors."""
    both = [other.parameters(*pair) for unit in structure.model_basis
            for pair in ((unit, 0.0 * unit), (0.0 * unit, unit))]
    more = np.linalg.svd(np.array(both))[2][len(both):]
    covariance = more @ solved.covariance @ more.T
    std = np.sqrt(np.diag(covariance))
    z = more @ solved.x / std
    correlation = covariance / np.outer(std, std)
    return float(np.sqrt(z @ np.linalg.pinv(correlation, SINGULAR, hermitian=True) @ z / len(z)))


def _is_within(name: str, theta: Array, given: variations.Given) -> bool:
    """Return whether numbers are no larger than what they are of, nor a package above its lip."""
    payload = given.samples.payload
    if name == 'com' and payload.com[2] + theta[2] > max(payload.com[2], 0.0):
        return False
    radius = causes.radius_of_gyration(payload)
    largest = {
        'length': 0.5 * given.length, 'com': radius, 'slip': given.length,
        'inertia': MAX_LOG_INERTIA, 'gravity.direction': MAX_ANGLE, 'package_marker': MAX_ANGLE}
    numbers, since = (theta[:2], theta[2]) if name == 'slip' else (theta, 0.0)
    return bool(np.linalg.norm(numbers) < largest.get(name, np.inf) and since >= 0.0)


def _ranked(trials: Iterable[_Trial]) -> list[_Trial]:
    """Return trials, the best first, without cups and packages that cannot be."""
    return sorted((trial for trial in trials if np.isfinite(trial.solved.excess)), key=_score)


def _is_above_noise(solved: Solved) -> bool:
    """Return whether the noise that was taken is not clearly more than all that is left."""
    return solved.excess > -MAX_NEGATIVE_FLOORS * _noise_floor(solved)


def _noise_floor(solved: Solved) -> float:
    """Return the noise floor of squares: the mean of so many residuals is off by chance."""
    return float(FLOOR_STDS * np.sqrt(2.0 / solved.residuals))


def _resolution(solved: Solved) -> float:
    """Return the squares that tell two hypotheses apart."""
    return SIGNIFICANT**2 / solved.residuals


def _floored(solved: Solved) -> float:
    """Return the squares that are left, never less than chance leaves."""
    return max(solved.excess, 0.0) + _noise_floor(solved)


def _score(trial: _Trial) -> float:
    """Return what hypotheses are ordered by: squares beyond noise, more for each number freed."""
    return trial.solved.excess + PRICE * trial.hypothesis.freed * _floored(trial.solved)


def _finding(trial: _Trial, ranking: _Ranking, identifiable: Sequence[str]) -> Finding:
    """Return what is reported of a hypothesis."""
    ensemble, before, trials = ranking
    structure = ensemble.given[0].structure
    labels = identifiable or structure.labels
    hypothesis, theta, std, *_ = trial
    value = hypothesis.value
    excess, rest, first = max(trial.solved.excess, 0.0), _floored(trial.solved), _floored(before)
    similar = {'length': 'com', 'com': 'length', 'yaw': 'yaw'}.get(hypothesis.name)
    instead = [t.hypothesis for t in trials if t is not trial and t.hypothesis.name == similar
               and t.solved.excess < max(excess / DISTINCT, excess + _resolution(before))]
    rivals = [t for t in trials
              if t.hypothesis.name != hypothesis.name and t.hypothesis not in instead]
    diagonal = [i for i, (row, column) in enumerate(structure.leads)
                if row == column and structure.labels[i] in labels]
    moved = change = np.zeros(1)
    if hypothesis.name != 'structure':
        moved = change = np.abs(trial.solved.x[diagonal] / before.x[diagonal] - 1.0)
    if hypothesis in CUP_EFFECTS:  # the entry of K that shows it best is enough
        entries = extra_entries(structure, hypothesis.name)
        is_shown = np.isin(entries, diagonal) & (np.abs(theta) < 1.0)
        best = int(np.argmax(is_shown * np.abs(theta) / std))
        value, theta, std = structure.labels[entries[best]], theta[[best]], std[[best]]
        change = np.abs(theta)
    is_material = hypothesis.name == 'structure' or rest < DISTINCT**2 * first or np.any(
        change > (MIN_CUP_EFFECT if hypothesis in CUP_EFFECTS else causes.MATERIAL))
    is_certain = bool(is_material and trial.is_significant and trial is trials[0]
                      and _is_certain(trial, rivals, before))
    return Finding(
        hypothesis.name, value, theta, std, float(np.sqrt(rest / first)),
        float(moved.max(initial=0.0)), hypothesis.datum, is_certain,
        instead[0].value or instead[0].name if instead else '', excess)


def _is_certain(trial: _Trial, rivals: Sequence[_Trial], before: Solved) -> bool:
    """Return whether a hypothesis explains nearly all, and each rival clearly less."""
    hypothesis, *_, solved, _ = trial
    excess, rest = max(solved.excess, 0.0), _floored(solved)
    resolution, noise_floor = _resolution(before), _noise_floor(before)
    if before.excess < causes.DOUBTED:
        # Another setting, without any number that is significant, must explain more than chance.
        gain = resolution if len(trial.theta) or hypothesis.name == 'structure' else noise_floor
        return trial.is_sufficient and before.excess - trial.solved.excess > gain and all(
            _score(t) - _score(trial) > resolution for t in rivals if t.is_significant)

    def is_dominated(other: _Trial) -> bool:
        """Return whether another explains clearly less, or not all where this one does."""
        rival, most = other.hypothesis, _floored(other.solved)
        if rival.freed > hypothesis.freed:
            return rival.datum or rest < most
        part = DISTINCT if hypothesis.datum or not rival.datum else DISTINCT**2
        return rest < part * most or (
            excess < noise_floor and other.solved.excess - excess > resolution)

    return excess < causes.DOUBTED and all(map(is_dominated, rivals)) and rest < min(
        DISTINCT * _floored(before), DISTINCT**2 * _floored(before) + noise_floor)
