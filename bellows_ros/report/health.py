"""
Diagnostics of the predictor: a finding with numbers for each line; no ROS.

Rates, jitter, age and computing times of messages are kept in constant memory.

OK: works as intended. WARN: works, but needs attention. ERROR: does not work.
"""

from collections import deque
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.live.vacuum import Load
from bellows_ros.core.model.grip import safety_finding
from bellows_ros.core.model.validity_range import FLAT_MOMENT_BENDING
from bellows_ros.files.messages import REASONS
from bellows_ros.report import findings
import numpy as np

WINDOW_LENGTH = 2048
"""Number of messages of which times are kept."""

MAX_AGE = 1.0
"""Largest absolute age of a message on the node's clock, s; larger ages mean another clock."""


def window() -> deque[float]:
    """Return a queue of the newest numbers, at most `WINDOW_LENGTH`."""
    return deque(maxlen=WINDOW_LENGTH)


def taken(numbers: deque[float]) -> Array:
    """Return and clear the numbers of a queue."""
    values = np.array(numbers, np.float64)
    numbers.clear()
    return values


def quantiles(name: str, values: Array, factor: float = 1.0) -> dict[str, str]:
    """Return median, 99 % quantile and maximum of numbers (N,), with a name."""
    numbers = factor * np.percentile(values if len(values) else math.nan, (50.0, 99.0, 100.0))
    return {name.format(which): number(x)
            for which, x in zip(('p50', 'p99', 'max'), numbers.tolist(), strict=True)}


def number(value: float) -> str:
    """Return a number for the diagnostics, or a text for a missing one."""
    return f'{value:.4g}' if math.isfinite(value) else 'none'


def fact(code: str, level: Level = Level.WARN, topic: str = '', **numbers: Any) -> Finding:
    """Return a finding with numbers."""
    return Finding(code, level, numbers, topic)


class Status(NamedTuple):
    """One line of the diagnostics."""

    name: str
    finding: Finding
    values: dict[str, str]

    @property
    def level(self) -> Level:
        """Level of the finding."""
        return self.finding.level

    @property
    def message(self) -> str:
        """Sentences of the finding."""
        return findings.text(self.finding)


class InputReport(NamedTuple):
    """Statistics of one input since the last report."""

    topic: str
    publishers: int
    mismatch: Finding | None
    """Frames that are missing despite a publisher, or several publishers."""
    messages: int
    intervals: Array
    """Times between arrivals, s."""
    ages: Array
    """Arrivals minus stamps on the node's clock, s; NaN without stamps."""
    silent: float
    """Time since the last message, s; infinite before the first."""
    refused: Mapping[str, int]
    """Counts since the last report."""
    total_refused: Mapping[str, int]
    """Counts since the start."""

    @property
    def rate_hz(self) -> float:
        """Mean rate; NaN for too few messages."""
        mean = float(self.intervals.mean()) if len(self.intervals) else 0.0
        return 1.0 / mean if mean > 0.0 else math.nan

    @property
    def values(self) -> dict[str, str]:
        """Numbers for the diagnostics."""
        jitter = float(self.intervals.std()) if len(self.intervals) else 0.0
        return {
            'topic': self.topic, 'publishers': str(self.publishers),
            'rate (Hz)': number(self.rate_hz), 'jitter (s)': number(jitter),
            **quantiles('age {} (s)', self.ages), 'silent for (s)': number(self.silent),
            **{f'refused: {reason}': str(count) for reason, count in self.total_refused.items()}}


def listed(counts: Mapping[str, int]) -> str:
    """Return counts in words."""
    return ', '.join(
        f'{count} x {REASONS.get(reason, reason)}' for reason, count in counts.items() if count)


def input_status(
    name: str, report: InputReport, worst: Level = Level.ERROR, state: str = '',
    effect: str = '', is_latched: bool = False,
) -> Status:
    """
    Return the status of an input.

    Parameters
    ----------
    name : str
        Name of the line.
    report : InputReport
        Statistics of the input.
    worst : Level
        Level without any usable message.
    state : str
        Words for a working input; by default its rate.
    effect : str
        Effect of missing messages.
    is_latched : bool
        Whether messages come at changes only, so that silence after the first is right.

    """
    refused, age = sum(report.refused.values()), float(
        np.median(report.ages)) if len(report.ages) else math.nan
    level = Level.WARN if report.messages > refused else worst
    if report.mismatch:
        found = report.mismatch._replace(level=level)
    elif refused and report.messages:
        found = fact('refused', level, report.topic, refused=refused, messages=report.messages,
                     reasons=listed(report.refused), effect=effect)
    elif abs(age) > MAX_AGE:
        found = fact('clock', seconds=abs(age), side='behind' if age > 0.0 else 'ahead of')
    elif report.messages or is_latched and math.isfinite(report.silent):
        found = fact('state', Level.OK, state=state or f'{report.rate_hz:.4g} Hz')
    else:
        since = f'for {report.silent:.1f} s' if math.isfinite(report.silent) else 'so far'
        found = fact('silent', worst, report.topic, since=since, publishers=report.publishers,
                     effect=effect)
    return Status(name, found, report.values)


def twist_status(name: str, report: InputReport, poses: int, unpaired: int) -> Status:
    """Return the status of the twists, with the number of recent poses without one."""
    status = input_status(name, report, Level.WARN)
    if not report.publishers and status.finding.code == 'silent':
        return status._replace(finding=fact(
            'state', Level.OK, state=f'No publisher of {report.topic}: estimated from the poses'))
    if status.level > Level.OK or 2 * report.messages <= poses or 2 * unpaired <= poses:
        return status
    return status._replace(finding=fact('unpaired', unpaired=unpaired, poses=poses))


def vacuum_status(
    name: str, report: InputReport, held: bool, open_cups: tuple[int, ...], latched: bool
) -> Status:
    """
    Return the status of the vacuum signal, with the cups without vacuum.

    Without a held package nothing is predicted.
    """
    state = 'held' if held else 'not held'
    status = input_status(
        name, report, Level.WARN if held else Level.ERROR, state.capitalize(),
        f'; the package counts as {state}', latched)
    return status._replace(values=status.values | {
        'held': str(held).lower(), 'cups without vacuum': ', '.join(map(str, open_cups))})


def prediction_finding(
    phase: str, restarts: Mapping[str, int], twists_fit: bool, has_covariance: bool,
    above: bool,
) -> Finding:
    """
    Return the finding on the prediction since the last report.

    Parameters
    ----------
    phase : str
        Result of `Predictor.phase`.
    restarts : mapping of str to int
        Counts since the last report.
    twists_fit, has_covariance, above : bool
        Whether the twists fit the poses; whether the odometry has a covariance; whether z of the
        tool points down, with the package above it.

    """
    for code, applies, level in (
            ('no_equilibrium', restarts.get('no_equilibrium'), Level.ERROR),
            ('failed', restarts.get('failure'), Level.ERROR),
            ('no_poses', phase == 'interrupted', Level.ERROR), ('tool_z', above, Level.ERROR),
            ('restarted', any(restarts.values()), Level.WARN),
            ('no_poses', phase == 'coasting', Level.WARN),
            ('twists', not twists_fit, Level.WARN),
            ('no_equilibrium', not has_covariance, Level.WARN)):
        if applies:
            return fact(code, level, phase=phase.capitalize(), reasons=listed(restarts),
                        failures=restarts.get('failure', 0))
    level = Level.WARN if phase == 'settling' else Level.OK
    return fact('state', level, state=phase.capitalize())


def load_status(name: str, load: Load) -> Status:
    """Return the status of the cup's load since the last report, and reset it."""
    safety, excess, bending = load.reset()
    factor, mode = safety or (math.inf, 'nothing')
    values = {
        'safety factor': number(factor) if load.grip else 'not known', 'limited by': mode,
        'distance from envelope': number(
            excess.value if excess else math.nan) if load.has_envelope else 'not known',
        'largest bending (degrees)': number(math.degrees(bending))}
    if not (found := safety_finding(factor, mode, 0.0, load.required)):
        if bending > FLAT_MOMENT_BENDING:
            found = fact('flips', angle=bending, limit=FLAT_MOMENT_BENDING)
        elif excess and excess.outside:
            found = fact('outside', ranges='; '.join(excess.outside))
        elif not (load.grip or load.has_envelope):
            found = fact('no_factor', Level.OK)
        else:
            found = fact('state', Level.OK, state='Within all known limits' if (
                safety or excess) else 'No package is held')
    return Status(name, found, values)
