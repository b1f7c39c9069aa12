"""The table of hypotheses: kinds of faults, their places in the evidence, and thresholds."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
import tomllib
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.observer import filter as ekf
from bellows_ros.core.observer import states
from bellows_ros.core.observer.filter import ONSETS
import numpy as np


class Cause(NamedTuple):
    """A kind of fault, as in the file alarms.toml."""

    name: str
    steps: tuple[tuple[int, ...], ...]
    """Rows of the error that step, for each component."""
    prior_std: Sequence[float]
    ends: Sequence[int]
    share: float
    parts: Sequence[tuple[int, int, bool]]
    """First and last component of each size, and whether it is a logarithm."""
    at_start: bool = False
    """Whether the fault is present from the start; otherwise it has an onset."""
    every: int = 1
    """Interval of the tested onsets, in onsets of `ONSET_NS`; a tested onset stands for the
    skipped ones."""
    after_ns: int = 0
    """Smallest age of an onset per component, ns: a younger fault has no reliable size, and may be
    the begin of another."""
    mean: float = 0.0
    """Prior mean of the only component."""
    least: float = 0.0
    """Smallest reported size of the first part. Smaller sizes cannot be distinguished from other
    faults, such as a drifting camera from a small loss of force."""
    confirmed: int = 2
    confirmed_ns: int = 80_000_000
    """Number of measurements and time (ns) required after half the threshold, because swapped
    markers last for a few frames."""


_ROWS = {**states.FIRST, 'FORCE_LOSS': ekf.FORCE_LOSS}
NAMED = {
    key: Cause(**{'name': key, **entry, 'steps': tuple(
        tuple(_ROWS[row] + place for row, place in step) for step in entry['steps'])})
    for key, entry in tomllib.loads(
        Path(__file__).with_name('alarms.toml').read_text()).items()}
HYPOTHESES = tuple(NAMED.values())
"""
All tested faults, first the faults present from the start. The last fault is the loss of one cup
of several; each holding cup has separate columns, after the columns of all other faults.
"""

OUT_OF_REACH_ODDS = 100.0
"""Factor on the odds of a lost package by two poses out of any cup's reach."""

VACUUM_ODDS = 1000.0
"""Factor on the odds of a lost package or cup by a broken vacuum; a holding vacuum divides by
it."""

CAUSES = tuple([cause.name for cause in HYPOTHESES].index(own.name) for own in HYPOTHESES)
"""Index of the first hypothesis of the same cause, for each hypothesis."""

AT_START = sum(cause.at_start for cause in HYPOTHESES)
"""Index of the first hypothesis with an onset."""
CUP = len(HYPOTHESES) - 1
"""Index of the loss of the first cup."""
STEPS = tuple(rows for cause in HYPOTHESES for rows in cause.steps)
FIRSTS = tuple(np.cumsum([0, *(len(cause.steps) for cause in HYPOTHESES)]).tolist())
"""First component of each hypothesis, and the end of the last one."""
IS_END = tuple(n + 1 in cause.ends for cause in HYPOTHESES for n in range(len(cause.steps)))
"""Whether a fault may end with a component."""
LOG_SHARES = tuple(math.log(cause.share / len(cause.ends)) for cause in HYPOTHESES)
PRIOR_STD = tuple(std for cause in HYPOTHESES for std in cause.prior_std)
MEANS = tuple(cause.mean for cause in HYPOTHESES)


def steps_of(of_lip: bool) -> Array:
    """
    Return the error (n + 7, components) by each component of a fault.

    The measured lip moves with a slipping package, unlike a marker on it.
    """
    out = np.zeros((states.ROWS_WITHOUT_SENSOR + ekf.FALLEN, len(STEPS)))
    for component, step in enumerate(STEPS):
        for row in step:
            out[row, component] = 1.0
            if of_lip and states.COM <= row < states.COM + 3:
                out[states.MARKER + row - states.COM, component] = 1.0
    return out


ONSET_NS = 30_000_000
"""Mean spacing of the tested onsets, ns. Half of it is the smallest, so that an onset follows each
pose of a camera of 30 Hz with jittering stamps."""

DENSE_NS = 240_000_000
"""Age up to which all onsets are tested, ns; distances between older ones grow."""

OLDEST_NS = 10_000_000_000
"""Age of the oldest tested onset, ns."""

EVERY = tuple(cause.every for cause in HYPOTHESES)
SLOTS = (1,) * AT_START + tuple(ONSETS // every for every in EVERY[AT_START:])
"""Number of onsets of each hypothesis."""
COLUMNS = FIRSTS[:AT_START] + tuple(np.cumsum([0, *(
    slots * len(cause.steps) for cause, slots in zip(
        HYPOTHESES[AT_START:], SLOTS[AT_START:], strict=True))]).tolist())
"""First column of each hypothesis, with one column per component and onset: faults from the start
and faults with an onset have columns of their own."""
START_ROWS: Array = np.unique([row for step in STEPS[:FIRSTS[AT_START]] for row in step])
"""Rows of the error that faults from the start change."""
START_STEPS: Array = np.array([
    [float(row in step) for step in STEPS[:FIRSTS[AT_START]]] for row in START_ROWS])
"""Change of these rows by each component."""
LEAST_PRIOR = 1e-3
"""Smallest prior standard deviation of a row, relative to the prior size of its fault: rounding
hides the information on a smaller one."""
MAX_COMPONENTS = max(len(cause.steps) for cause in HYPOTHESES)

MAX_DEVIATION = 3.0
"""Largest deviation of a cup or a latency from its parameters without an alarm, standard
deviations."""

MARGIN = -2.0
"""
Correction of the logarithm of the threshold for one cup, as only some of the older onsets are
tested, and alarms are confirmed. By `python -m benchmarks.alarms` false alarms are fewer than
allowed.
"""

GRIPPER_MARGIN = -1.0
"""Correction of the logarithm of the threshold for several cups."""

START_WEIGHT = 100.0
"""Prior odds of a fault from the start against an onset at one of the tested times."""

SETTLING = 4
"""Number of measurements after the start or an alarm without a test, in which the noise is
estimated."""

MIN_NOISE_COUNT = 33
"""Number of measurements after the start or an alarm in which the noise is estimated."""

MAX_NOISE_RATIO = 3.0
"""Largest log-likelihood ratio of a fault with which the noise is estimated later: a fault would
increase the noise."""

DISTURBED_COUNT = 3
"""Number of poses since the onset of a push, or of consecutive poses outside the gate, from which
a disturbance is named: outliers are rarer."""

TAG_BURST = 7
"""Number of poses of a tag, as `DISTURBED_COUNT`; blurred poses come in bursts of 2 to 6."""

VIEW_NS = 3_000_000_000
"""Shortest duration of a fault like `LIKE_VIEW` seen with a tag, ns: work changes the view within
this time."""

LIKE_VIEW = frozenset(('camera', 'leak'))
"""Causes that resemble the errors of a tag in a new view, a shift or a change of depth."""

MIN_LEAD = 3.0
"""Smallest lead in log-likelihood ratio of a reported cause, 95 %."""

DECIDE_NS = 800_000_000
"""Time after half the threshold from which causes with one remedy need no lead, ns."""

MAX_UNEXPLAINED = 0.2
"""Largest fraction of the misfit not explained by a reported cause."""

SIZE_ROUNDS = 20
"""Number of iterations in which the prior sizes of a large fault's components grow."""

MIN_CLEAR_ODDS = 100.0
"""Odds below which an alarm also has the sizes of the second cause."""

CLEAR_LEAD = math.log(MIN_CLEAR_ODDS)
"""Lead of a wrong payload over a worn cup, after the cup has carried another package."""

ALIKE = frozenset(('wear', 'payload'))
"""Causes distinguished by damping only: an alarm has the sizes of both at any odds."""

MAX_ODDS = math.exp(14.0)
"""Largest odds of a fault from the start, a lost package or a lost cup; other faults have at most
100."""

LOG_SHARE_OF_NONE = math.log(0.1)
"""Logarithm of the prior share of causes without a signature, including disturbances."""

NONE = -1
"""Index of the cause without a signature."""

PUSH = [*NAMED].index('disturbance')
"""Index of an external push."""

PAYLOAD = [*NAMED].index('payload')
"""Index of a wrong payload."""

WEAR = [*NAMED].index('wear')
"""Index of wear."""


class Tested(NamedTuple):
    """A tested fault."""

    onset: int
    """Slot of its onset."""
    number: int
    """Index in `HYPOTHESES`; cups of a gripper follow all others."""
    components: int
    """Number of components."""


class Likeliest(NamedTuple):
    """Likelihood ratios of faults after a measurement."""

    total: float
    """Logarithm of the sum of all ratios."""
    lead: float
    """Lead of the likeliest cause's logarithm over the next."""
    best: Tested
    """Likeliest fault."""
    second: int
    """Index of the next likeliest cause in `HYPOTHESES`, cups last, or `NONE`."""
    runner_up: Tested
    """Next likeliest fault, if `second` is not `NONE`."""
    pinned: int
    """Slots of the likeliest onset of each cause, as bits."""
    none: float
    """Ratio of larger innovations without a signature."""


NO_FAULT = Likeliest(-math.inf, -math.inf, Tested(0, 0, 0), 0, Tested(0, 0, 0), 1, -math.inf)
"""Result without a fault or without a test."""
