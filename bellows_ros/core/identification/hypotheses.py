"""
What may be wrong with what was given, or else with the cup: one list, tried one by one.

Each hypothesis frees a block of numbers, or changes one setting, and everything else is fitted
again. Which of them explains most is said first; it is certain only where nothing else explains
nearly as much, and where the change is many times its standard error.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TYPE_CHECKING

from bellows_ros.core.arrays import Array
from bellows_ros.core.identification import variations
from bellows_ros.core.identification.objective import (
    covariance_of,
    Ensemble,
    ensemble_of,
    extra_entries,
    Objective,
    SLIPS,
    Solved,
)
from bellows_ros.core.identification.variations import Given, Variation
from bellows_ros.core.lie import apply
from bellows_ros.core.model import Package
from bellows_ros.core.recording.alignment import levelling, R_WORLD_MOTIVE
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.structure import Structure, STRUCTURES
import numpy as np

if TYPE_CHECKING:
    from bellows_ros.core.identification.free import Block

TRIED = 0.08
"""Residuals beyond noise, in their weights, below which nothing is looked for."""

SURE = 0.3
"""Standard errors that are smaller than this part of a change tell its sign."""

CHANCE = 2.0
"""The same in standard deviations of what chance leaves of so many residuals."""

NOTHING = 0.06
"""Residuals that chance leaves."""

EXPLAINS, BETTER = 0.2, 0.5
"""A certain hypothesis leaves at most this part of what there was, and of what others leave."""

OF_THE_CUP = 0.25
"""The same as the latter for what the cup may be, beside what may be wrong in what was given."""

GAINED, SMALL = 20.0, 1.0
"""Chi2 that what the cup is gains over others, and residuals up to which that is enough."""

SOLID = 0.01
"""Radius of gyration (m) that no package is below."""

MISSES = 1e-3
"""Mean square by which twists miss those of the poses, in theirs, below which they suit."""

ERRORS, OF_STIFFNESS = 6.0, 4.0
"""Standard errors that a certain change is away from nothing, and that of a stiffness."""

PENALTY = 0.1
"""By how much residuals must fall for each number that is freed."""

LEAST = {
    'time_offset': 5e-4, 'com': 5e-4, 'length': 2e-4, 'inertia': 0.03, 'mass': 0.03,
    'package_world': 5e-4, 'drift': 0.02, 'cubic': 0.02, 'friction': 0.02,
}
"""Changes that are smaller (s, m, ln 1, m and rad, parts of K) are not worth a word."""

ALIKE = 1.5
"""Residuals of two hypotheses that cannot be distinguished differ by less."""

ROUGHLY = 3
"""Rounds in which numbers are found at first, with noise left in."""

AGAIN = 6
"""Hypotheses that are tried a second time, with noise taken off."""

SHOWN, NEAR = 2, 10.0
"""So many are named; others that leave more than so many times the best are not tried again."""

K_MOVES = 0.05
"""Part by which a material change moves an entry of K."""

HEAVIEST = 50.0
"""No suction cup of this kind holds more, kg: beyond it the mass has the wrong unit."""

LARGEST_FACTOR = float(np.log(10.0))
"""ln of the factor by which no inertia is off but by its unit."""

WIDEST, TYPICAL = 1.0, 0.3
"""Radius of gyration (m) that no package has, and that any of these has at most."""

UNITS = (('g m^2', 1e3), ('kg cm^2', 1e4), ('kg mm^2', 1e6))
"""What moments of inertia may be in, and how many of each are 1 kg m^2."""


class Hypothesis(NamedTuple):
    """
    What may be otherwise.

    Parameters
    ----------
    name : str
        Of the cause: a name of fit.free, a parameter, or what the cup is.
    vary : Variation
        The change, with no number freed.
    freed : int
        Numbers that it has more.
    value : str
        What the setting is then; '' where numbers are freed.
    block : Block or None
        The numbers that are freed.
    datum : bool
        Whether something that was given is wrong, and not the cup otherwise.

    """

    name: str
    vary: Variation
    freed: int = 0
    value: str = ''
    block: 'Block | None' = None
    datum: bool = True


class Finding(NamedTuple):
    """
    A hypothesis tried.

    Parameters
    ----------
    name, value : str
        See `Hypothesis`.
    theta, std : ndarray (n,)
        The numbers freed, and their standard errors.
    left : float
        RMS of the residuals beyond noise over what it was.
    moved : float
        Largest part by which it moves an entry of the diagonal of K that is identifiable.
    datum, certain : bool
        Whether it is of what was given, and whether nothing else explains the recordings so well.
    instead : str
        Name or value of another datum that these recordings cannot tell from it; '' for none.

    """

    name: str
    value: str
    theta: Array
    std: Array
    left: float
    moved: float
    datum: bool
    certain: bool
    instead: str

    @property
    def material(self) -> bool:
        """Whether a cup is wrong without it: errors halve, or K moves."""
        return self.certain and self.datum and (self.left < 0.5 or self.moved > K_MOVES)


def hypotheses(given: Given, world: str) -> Iterator[Hypothesis]:
    """
    Yield all that may be otherwise with recordings that were given so, in a recording.world.

    K and P scaled with mass and inertia make the same motion. So another mass is the same as
    another inertia, and only that is tried.
    """
    from bellows_ros.core.identification.free import BLOCKS, FEWEST_SECONDS, SCALE

    enough = Ensemble((given,), ()).seconds > FEWEST_SECONDS
    for name in (*(('time_offset',) if enough else ()), 'com', 'length', 'package_world'):
        block = BLOCKS[name]._replace(each=False)
        yield Hypothesis(name, block.vary, len(block.steps), block=block)
    yield Hypothesis('inertia', SCALE.vary, 1, block=SCALE)
    gyration = radius_of_gyration(given.samples.payload)
    for unit, factor in UNITS:
        if gyration < SOLID * np.sqrt(factor):
            continue
        yield Hypothesis(
            'inertia', variations.scaled(variations.inertia, 1.0 / factor), value=unit)
    for value, R in _worlds(world):
        yield Hypothesis('recording.world', variations.gravity(R), value=value)
    for body in ('tool', 'package'):
        for degrees in (90, 180, -90):
            yield Hypothesis('yaw', variations.yaw(np.radians(degrees), body == 'tool'),
                             value=f'{body} {degrees}')
    yield Hypothesis('recording.package_frame', variations.other_frame,
                     value='com' if given.lip_recorded else 'lip')
    own = given.structure
    for other in STRUCTURES.values():
        if other.size > own.size and set(own.labels) <= set(other.labels):
            yield Hypothesis('structure', variations.structure(other), 2 * (other.size - own.size),
                             other.name, datum=False)
    yield from _OTHERWISE


_OTHERWISE = tuple(Hypothesis(name, variations.extra(name), 6, datum=False)
                   for name in ('drift', 'cubic', 'friction'))
"""What the cup may be, whatever was given."""


def _worlds(world: str) -> Iterator[tuple[str, Array]]:
    """Yield worlds other than the given one: values of a setting, and the turn to it."""
    R = R_WORLD_MOTIVE if world == 'z_up' else R_WORLD_MOTIVE.T
    yield 'motive_y_up' if world == 'z_up' else 'z_up', R
    for down in np.concatenate([np.eye(3), -np.eye(3)[:2]]):
        if down @ R[2] > -0.5:  # where things fall in the other world
            yield f'gravity {down.astype(int).tolist()}', levelling(down)


class Diagnosis(NamedTuple):
    """What noise does not explain, in weights of the residuals, and findings, the best first."""

    excess: float
    findings: tuple[Finding, ...]


def diagnose(
    recordings: Sequence[Recording], length: float, structure: Structure,
    known: Sequence[str] = (),
) -> Diagnosis:
    """
    Try every hypothesis where noise does not explain the residuals.

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
    for own in recordings:
        if wrong := _absurd(own.payload) or _in_other_axes(own):
            return Diagnosis(np.inf, (wrong,))
    ensemble = ensemble_of(recordings, length, structure)
    objective = Objective.of(ensemble)
    before = objective.solved(ensemble)
    labels = known or structure.labels
    if before.excess < max(TRIED, CHANCE * np.sqrt(2.0 / before.residuals)):
        tried = _in_order(_tried(h, objective, ensemble) for h in _OTHERWISE)
        found = [_finding(trial, tried, before, structure, labels) for trial in tried[:1]]
        return Diagnosis(before.excess, tuple(own for own in found if own.certain))
    quiet = Ensemble(ensemble.given, ())
    level = objective.solved(quiet).excess - before.excess
    tried = _in_order(_tried(h, objective, quiet, rounds=ROUGHLY, level=level)
                      for h in hypotheses(ensemble.given[0], recordings[0].settings.world))
    # With weights as they are where the best of them is true.
    objective = Objective.of(ensemble.varied(tried[0].vary), sound=True)
    before = objective.solved(ensemble)
    tried = _in_order(_tried(trial.hypothesis, objective, ensemble, trial.theta)
                      for number, trial in enumerate(tried[:AGAIN])
                      if number < SHOWN or _mark(trial) < NEAR * _mark(tried[0]))
    return Diagnosis(before.excess, tuple(
        _finding(trial, tried, before, structure, labels) for trial in tried[:SHOWN]))


def radius_of_gyration(held: Package) -> float:
    """Return the root of the sum of a package's moments of inertia over its mass, m."""
    return float(np.sqrt(np.trace(held.inertia) / held.mass))


def _absurd(held: Package) -> Finding | None:
    """Return the unit of a mass or an inertia that no package has, None where it may have it."""
    none, gyration = np.empty(0), radius_of_gyration(held)
    if held.mass > HEAVIEST:
        return Finding('mass', 'g', none, none, 0.0, 1.0, True, True, '')
    if gyration < WIDEST:
        return None
    unit = next((u for u, k in UNITS if gyration / np.sqrt(k) < TYPICAL), UNITS[-1][0])
    return Finding('inertia', unit, none, none, 0.0, 1.0, True, True, '')


def _in_other_axes(own: Recording) -> Finding | None:
    """Return in which axes the tool's recorded twists are, None where it is as given."""
    tool, measured = own.tool, own.measured_tool
    if measured.twist is None or tool.twist is None:
        return None
    _, i, j = np.intersect1d(measured.stamps_ns, tool.stamps_ns, return_indices=True)
    known = measured.valid[i] & tool.valid[j]
    given, true = measured.twist[i][known], tool.twist[j][known]
    if not len(given):
        return None
    R_E_A = np.swapaxes(measured.rotation[i][known], 1, 2)
    turn = own.settings.R_world_recorded.T @ np.swapaxes(R_E_A, 1, 2)  # from E to as recorded
    other = 'tool'
    if own.settings.tool_twist_frame == 'tool':
        turn = R_E_A @ own.settings.R_world_recorded
        other = 'world'
    markers = own.alignment.R_tool_markers_tool
    turn = turn @ markers if other == 'world' else markers.T @ turn
    before, after = (sum(
        float(np.mean((twist[:, part] - true[:, part]) ** 2) / np.mean(true[:, part] ** 2 + 1e-12))
        for part in (slice(0, 3), slice(3, 6)))
        for twist in (given, np.hstack([apply(turn, given[:, :3]), apply(turn, given[:, 3:])])))
    if before < MISSES or after > EXPLAINS**2 * before:
        return None
    none = np.empty(0)
    return Finding('tool_twist.frame', other, none, none, float(np.sqrt(after / before)), 0.0,
                   True, True, '')


class _Trial(NamedTuple):
    """A hypothesis, its numbers with their standard errors, and what they leave."""

    hypothesis: Hypothesis
    theta: Array
    std: Array
    solved: Solved

    def vary(self, given: Sequence[Given]) -> list[Given]:
        """Return recordings as they are by the hypothesis."""
        return [self.hypothesis.vary(own, self.theta) for own in given]


def _tried(
    hypothesis: Hypothesis, objective: Objective, ensemble: Ensemble, start: Array | None = None,
    rounds: int = 0, level: float = 0.0,
) -> _Trial:
    """Return a hypothesis with the numbers that explain most, less a level of noise."""
    if hypothesis.block is not None:
        from bellows_ros.core.identification.free import refine, ROUNDS

        found = refine(objective, ensemble, [hypothesis.block], start, rounds or ROUNDS)
        found = found._replace(solved=found.solved._replace(excess=found.solved.excess - level))
        return _Trial(hypothesis, found.theta, found.std, found.solved)
    solved = objective.solved(ensemble.varied(
        lambda given: [hypothesis.vary(own, np.empty(0)) for own in given]))
    solved = solved._replace(excess=solved.excess - level)
    if hypothesis not in _OTHERWISE:
        return _Trial(hypothesis, np.empty(0), np.empty(0), solved)
    # Parts by which K changes, or friction as a part of the largest force, and standard errors.
    own = ensemble.given[0].structure
    entries, n = extra_entries(own, hypothesis.name), 2 * own.size
    each = SLIPS if hypothesis.name == 'friction' else (1.0,)
    T = np.kron(each, np.eye(len(entries))) / solved.x[entries, None]
    covariance = T @ covariance_of(solved, solved.rows.A)[n:, n:] @ T.T
    return _Trial(hypothesis, T @ solved.x[n:], np.sqrt(np.diag(covariance)), solved)


def _in_order(trials: Iterable[_Trial]) -> list[_Trial]:
    """Return trials, the best first, without cups and packages that cannot be."""
    def can_be(trial: _Trial) -> bool:
        """Return whether K keeps its sign, friction takes energy, and a package is one."""
        if trial.hypothesis.name == 'inertia' and len(trial.theta):
            return bool(np.abs(trial.theta[0]) < LARGEST_FACTOR)
        if trial.hypothesis not in _OTHERWISE:
            return True
        if trial.hypothesis.name == 'friction':
            return bool(trial.theta[np.argmax(np.abs(trial.theta) / trial.std)] > 0.0)
        return bool(np.all((np.abs(trial.theta) < 1.0) | (SURE * np.abs(trial.theta) < trial.std)))
    return sorted(filter(can_be, trials), key=_mark)


def _left(trial: _Trial) -> float:
    """Return the residuals that a hypothesis leaves, never less than chance does."""
    return max(trial.solved.excess, 0.0) + NOTHING


def _mark(trial: _Trial) -> float:
    """Return what hypotheses are ordered by: residuals, more for each number freed."""
    return _left(trial) * (1.0 + PENALTY * trial.hypothesis.freed)


def _finding(
    trial: _Trial, tried: list[_Trial], before: Solved, structure: Structure,
    labels: Sequence[str],
) -> Finding:
    """Return what is said of a hypothesis."""
    own, value, theta, std = trial.hypothesis, trial.hypothesis.value, trial.theta, trial.std
    instead = [t for t in tried if _left(t) < ALIKE * _left(trial) and (
        {t.hypothesis.name, own.name} == {'length', 'com'} or (
            t.hypothesis.name == own.name == 'yaw' and t is not trial))]
    others = [t for t in tried if t.hypothesis.name != own.name
              and t.hypothesis.freed <= own.freed and not any(t is i for i in instead)]
    first = max(before.excess, 0.0) + NOTHING
    certain = trial is tried[0] and all(_left(trial) < most for most in (
        BETTER * first, EXPLAINS * first + NOTHING,
        *((BETTER if own.datum or not t.hypothesis.datum else OF_THE_CUP) * _left(t)
          for t in others)))
    if trial is tried[0] and own in _OTHERWISE and before.excess < SMALL:
        most = min([before.excess, *(t.solved.excess for t in tried[1:])])
        certain = GAINED < before.residuals * (most - trial.solved.excess)
    if own.block is not None or own in _OTHERWISE:
        many = OF_STIFFNESS if own.name in ('drift', 'cubic') else ERRORS
        far = np.abs(theta) > np.maximum(many * std, LEAST[own.name])
        certain = certain and bool(far.any())
    n = structure.size
    diagonal = [i for i, (row, column) in enumerate(structure.leads)
                if row == column and structure.labels[i] in labels]
    moved = np.abs(trial.solved.x[diagonal] / before.x[diagonal] - 1.0) if (
        len(trial.solved.x) >= n and own.name != 'structure') else np.zeros(1)
    if own in _OTHERWISE:  # the entry of K that shows it best is enough
        entries = extra_entries(structure, own.name)
        best = int(np.argmax(np.isin(entries, diagonal) * np.abs(theta) / std))
        value, theta, std = structure.labels[entries[best]], theta[[best]], std[[best]]
    return Finding(
        own.name, value, theta, std, float(np.sqrt(_left(trial) / first)),
        float(moved.max(initial=0.0)), own.datum, certain,
        instead[0].hypothesis.value or instead[0].hypothesis.name if instead else '')
