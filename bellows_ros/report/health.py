"""
Diagnostics of the predictor: levels (REP-107), messages and numbers; no ROS.

Rates, jitter, age and computing times of messages are kept in constant memory.

OK: works as intended. WARN: works, but needs attention. ERROR: does not work.
"""

from collections import deque
from collections.abc import Mapping
from functools import partial
import math
from typing import NamedTuple

from bellows_ros.core.findings import Level as Level
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.live.load import Load, Safety
from bellows_ros.core.live.predictor import LivePredictor
from bellows_ros.core.model.validity_range import Distance, FLAT_MOMENT_BENDING
from bellows_ros.core.signals.screening import LONGEST_GAP_NS
from bellows_ros.core.signals.trajectory import NS_PER_S
from bellows_ros.files import messages
from bellows_ros.report.sentences import sentence, texts
import numpy as np

WINDOW_LENGTH = 2048


def window() -> deque[float]:
    """Return a queue of the newest numbers, at most `WINDOW_LENGTH`."""
    return deque(maxlen=WINDOW_LENGTH)


def taken(numbers: deque[float]) -> Array:
    """Return and clear the numbers of a queue."""
    values = np.array(numbers, np.float64)
    numbers.clear()
    return values


def quantiles(values: Array) -> dict[str, float]:
    """Return median, 99 % quantile and maximum of numbers (N,); NaN without any."""
    numbers = np.percentile(values if len(values) else math.nan, (50.0, 99.0, 100.0)).tolist()
    return dict(zip(('p50', 'p99', 'max'), numbers, strict=True))


class Arrivals:
    """
    Arrivals of the messages of one topic since the last reset.

    Attributes
    ----------
    last_ns : int
        Arrival of the newest message, -1 before the first.
    count : int
        Number of messages.

    """

    def __init__(self) -> None:
        self.last_ns, self.count = -1, 0
        self._ages, self._intervals = window(), window()

    def add(self, arrival_ns: int, age: float) -> None:
        """Record a message and its age (s)."""
        if self.last_ns >= 0:
            self._intervals.append((arrival_ns - self.last_ns) / NS_PER_S)
        self.last_ns = arrival_ns
        self.count += 1
        self._ages.append(age)

    def reset(self) -> tuple[int, float, float, dict[str, float]]:
        """
        Return statistics of the arrivals since the last call, and reset them.

        The statistics are number, rate (Hz), jitter and age (s) as in `InputReport`; NaN for too
        few messages.
        """
        count, self.count, intervals = self.count, 0, taken(self._intervals)
        mean = float(intervals.mean()) if len(intervals) else math.nan
        return (count, 1.0 / mean if mean > 0.0 else math.nan,
                float(intervals.std()) if len(intervals) else 0.0, quantiles(taken(self._ages)))


MAX_AGE = 1.0
"""Largest absolute age of a message on the node's clock, s; larger ages mean another clock."""

say = partial(sentence, 'live')
"""Function that returns the sentence of a code of the live predictor."""

REASONS: Mapping[str, str] = {**messages.REASONS, **{
    code.partition('.')[2]: text.format(gap=LONGEST_GAP_NS / NS_PER_S)
    for code, text in texts('live').items() if code.startswith(('refusals.', 'restarts.'))}}
"""Reasons for rejecting a message or for a restart, in words."""


class Status(NamedTuple):
    """One line of the diagnostics."""

    name: str
    level: Level
    message: str
    values: dict[str, str]


class InputReport(NamedTuple):
    """Statistics of one input since the last report."""

    topic: str
    publishers: int
    mismatch: str
    """QoS setting that is incompatible with a publisher, or ''."""
    messages: int
    rate_hz: float
    jitter: float
    """Standard deviation of the time between two arrivals, s."""
    age: dict[str, float]
    """Quantiles of arrival minus stamp on the node's clock, s."""
    silent: float
    """Time since the last message, s; infinite before the first."""
    refused: Mapping[str, int]
    """Counts since the last report."""
    total_refused: Mapping[str, int]
    """Counts since the start."""


def number(value: float) -> str:
    """Return a number for the diagnostics, or a text for a missing one."""
    return f'{value:.4g}' if math.isfinite(value) else 'none'


def _values(report: InputReport) -> dict[str, str]:
    """Return the numbers of an input."""
    numbers = {
        'rate (Hz)': report.rate_hz, 'jitter (s)': report.jitter,
        **{f'age {which} (s)': age for which, age in report.age.items()},
        'silent for (s)': report.silent}
    return {
        'topic': report.topic, 'publishers': str(report.publishers),
        **{name: number(value) for name, value in numbers.items()},
        **{f'refused: {reason}': str(count) for reason, count in report.total_refused.items()}}


def _listed(counts: Mapping[str, int]) -> str:
    """Return counts in words."""
    return ', '.join(
        f'{count} x {REASONS.get(reason, reason)}' for reason, count in counts.items() if count)


def _refusals(report: InputReport) -> str:
    """Return numbers and reasons of rejected messages since the last report."""
    refused = sum(report.refused.values())
    return f'{refused} of {report.messages} messages refused: {_listed(report.refused)}'


def _first(*cases: tuple[object, Level, str]) -> tuple[Level, str]:
    """Return level and message of the first case that applies."""
    return next((level, message) for applies, level, message in cases if applies)


def input_status(name: str, report: InputReport, optional: bool = False) -> Status:
    """Return the status of an input, which may be absent if optional."""
    topic, rate, age, silent = report.topic, report.rate_hz, report.age['p50'], report.silent
    worst = Level.WARN if optional else Level.ERROR
    refused = sum(report.refused.values())
    since = f'for {silent:.1f} s' if math.isfinite(silent) else 'so far'
    level, message = _first(
        (refused >= report.messages, worst, f'{_refusals(report)}.'),
        (refused, Level.WARN, f'{_refusals(report)}.'),
        (report.mismatch, Level.WARN, report.mismatch),
        (age > MAX_AGE, Level.WARN, say('inputs.behind', seconds=age)),
        (age < -MAX_AGE, Level.WARN, say('inputs.ahead', seconds=-age)),
        (math.isfinite(rate), Level.OK, f'{rate:.4g} Hz.'),
        (True, Level.OK, 'A single message.')) if report.messages else _first(
        (report.mismatch, worst, report.mismatch),
        (report.publishers, worst, say('inputs.silent', topic=topic, since=since)),
        (optional, Level.OK, say('inputs.estimated', topic=topic)),
        (True, worst, say('inputs.absent', topic=topic)))
    return Status(name, level, message, _values(report))


def twist_status(name: str, report: InputReport, poses: int, unpaired: int) -> Status:
    """Return the status of the twists, with the number of recent poses without one."""
    status = input_status(name, report, optional=True)
    rare = 2 * report.messages <= poses
    if status.level > Level.OK or rare or 2 * unpaired <= poses:
        return status
    return status._replace(
        level=Level.WARN, message=say('inputs.unpaired', unpaired=unpaired, poses=poses))


def vacuum_status(name: str, report: InputReport, held: bool, latched: bool) -> Status:
    """
    Return the status of the vacuum signal.

    A latched signal is sent when it changes, and may be silent after its first message.
    """
    worst = Level.WARN if held else Level.ERROR  # without a held package nothing is predicted
    state, topic = f'the package counts as {"" if held else "not "}held', report.topic
    level, message = _first(
        (report.mismatch, worst, report.mismatch),
        (not report.publishers, worst, say('inputs.no_vacuum', topic=topic, state=state)),
        (any(report.refused.values()), worst,
         f'{_refusals(report)}; {state}. {say("inputs.pressure", topic=topic)}'),
        (math.isinf(report.silent), Level.WARN, f'No message on {topic} so far: {state}.'),
        (not (report.messages or latched), worst,
         f'{topic} has been silent for {report.silent:.1f} s: {state}.'),
        (True, Level.OK, 'Held.' if held else 'Not held.'))
    return Status(name, level, message, _values(report) | {'held': str(held).lower()})


def prediction_status(
    name: str, state: str, phase: str, cup: str, compute: Array, counts: Mapping[str, int],
    restarts: Mapping[str, int], twist_verdict: str, has_covariance: bool, above: bool,
) -> Status:
    """
    Return the status of the prediction since the last report.

    Parameters
    ----------
    name : str
        Name of the line.
    state : str
        Lifecycle state, 'active' or another one.
    phase, cup, twist_verdict : str
        Results of `LivePredictor.phase` and `ToolMotion.verdict`, and the cup in use.
    compute : array
        Time from each message's arrival until the publication of its predictions, s.
    counts, restarts : mapping of str to int
        Counts since the start, and since the last report.
    has_covariance, above : bool
        Whether the odometry has a covariance; whether z of the tool points down, with the package
        above it.

    """
    failures, reasons, said = restarts.get('failure'), _listed(restarts), texts('live')
    level, message = _first(
        (state != 'active', Level.OK, f'{state.capitalize()}: nothing is published.'),
        (restarts.get('no_equilibrium'), Level.ERROR, say('faults.no_equilibrium')),
        (failures, Level.ERROR,
         f'{failures} callbacks failed, a fault of this node. Report its log.'),
        (phase == 'lost', Level.ERROR, say('phases.lost')),
        (above, Level.ERROR, say('faults.above')),
        (reasons, Level.WARN, f'Started again from static equilibrium: {reasons}.'),
        (phase in ('coasting', 'settling'), Level.WARN, said.get(f'phases.{phase}', '')),
        (f'twists.{twist_verdict}' in said, Level.WARN,
         said.get(f'twists.{twist_verdict}', '')),
        (not has_covariance, Level.WARN, say('faults.no_covariance')),
        (True, Level.OK, said.get(f'phases.{phase}', 'Predicting.')))
    return Status(name, level, message, {
        'lifecycle': state, 'phase': phase, 'cup': cup,
        **{f'compute time {which} (us)': number(1e6 * seconds)
           for which, seconds in quantiles(compute).items()},
        'twists against poses': twist_verdict,
        **{name: str(count) for name, count in counts.items()}})


def load_status(
    name: str, load: Load, safety: Safety | None, excess: Distance | None, bending: float
) -> Status:
    """Return the status of the cup's load, from the results of its `reset`."""
    factor, mode = safety or Safety(math.nan, 'nothing')
    has_grip, required = load.grip is not None, load.required
    values = {
        'safety factor': number(factor) if has_grip else 'not known',
        'limited by': mode,
        'distance from envelope': number(
            excess.value if excess else math.nan) if load.has_envelope else 'not known',
        'largest bending (degrees)': number(math.degrees(bending))}
    unsafe = partial(say, 'faults.unsafe', factor=factor, mode=mode)
    return Status(name, *_first(
        (factor < min(required, 1.0), Level.ERROR, unsafe(limit='1: the cup lets go')),
        (factor < required, Level.WARN, unsafe(limit=f'safety.least, {required:g}')),
        (bending > FLAT_MOMENT_BENDING, Level.WARN, say('faults.bending', bending=bending)),
        (excess and excess.outside, Level.WARN, excess.text if excess else ''),
        (not (has_grip or load.has_envelope), Level.OK, say('faults.no_limits')),
        (safety is None and excess is None, Level.OK, 'No load: no package is held.'),
        (True, Level.OK, 'Within all known limits.')), values)


def summary(live: LivePredictor) -> str:
    """Return all counts of a predictor in one sentence."""
    refused = live.refused
    reasons = ', '.join(f'{count} {name}' for name, count in refused.items() if count)
    return (
        f'{live.poses_in} poses and {live.twists_in} twists in, {live.predictions} predictions '
        f'out, {sum(refused.values())} refused{f" ({reasons})" if reasons else ""}, '
        f'{live.twists_estimated} twists estimated.')
