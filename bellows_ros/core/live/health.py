"""
Diagnostics of the predictor: observations as levels (REP-107), messages and numbers; no ROS.

Rates, jitter, age and computing times of messages are kept in constant memory.

OK: works as intended. WARN: works, but needs attention. ERROR: does not work.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from enum import IntEnum
import math
from typing import Literal, NamedTuple

from bellows_ros.core.live.load import Safety, STRONGEST_BENDING
from bellows_ros.core.live.predictor import LivePredictor, LONGEST_GAP_NS
from bellows_ros.core.model.validity_range import Distance
import numpy as np

KEPT = 2048


class Quantiles(NamedTuple):
    """Median, 99 % quantile and maximum of some numbers; NaN without any."""

    p50: float
    p99: float
    largest: float


class Window:
    """The newest numbers of a series since last taken, at most `KEPT`."""

    def __init__(self) -> None:
        """Reserve the memory."""
        self._values = array('d', bytes(8 * KEPT))  # so that keeping a number takes no memory
        self.count = 0

    def add(self, value: float) -> None:
        """Keep a number."""
        self._values[self.count % KEPT] = value
        self.count += 1

    def take(self) -> Quantiles:
        """Return the quantiles since the last call, and begin again."""
        kept = self._values[:min(self.count, KEPT)]
        self.count = 0
        if len(kept) == 0:
            return Quantiles(math.nan, math.nan, math.nan)
        p50, p99 = np.percentile(kept, (50.0, 99.0))
        return Quantiles(float(p50), float(p99), max(kept))


class Rhythm(NamedTuple):
    """How messages of one topic came; NaN where too few did."""

    messages: int
    rate_hz: float
    jitter: float
    """Standard deviation of the time between two arrivals, s."""
    age: Quantiles
    """Of arrival minus stamp on the node's clock, s."""


class Arrivals:
    """
    Statistics of the arrivals of one topic since last taken.

    Attributes
    ----------
    last_ns : int
        When the newest came, -1 before the first.

    """

    def __init__(self) -> None:
        """Start without arrivals."""
        self.last_ns = -1
        self._ages = Window()
        self._intervals = 0
        self._sum = self._squares = 0.0

    @property
    def is_empty(self) -> bool:
        """Whether nothing has arrived since last taken."""
        return self._ages.count == 0

    def add(self, arrival_ns: int, age: float) -> None:
        """Note a message and how old (s) it is."""
        if self.last_ns >= 0:
            interval = (arrival_ns - self.last_ns) * 1e-9
            self._intervals += 1
            self._sum += interval
            self._squares += interval * interval
        self.last_ns = arrival_ns
        self._ages.add(age)

    def take(self) -> Rhythm:
        """Return how messages came since the last call, and begin again."""
        count, n = self._ages.count, self._intervals
        mean = self._sum / n if n else math.nan
        variance = self._squares / n - mean * mean if n else math.nan
        self._intervals, self._sum, self._squares = 0, 0.0, 0.0
        rate = 1.0 / mean if n and mean > 0.0 else math.nan
        jitter = math.sqrt(variance) if variance > 0.0 else 0.0
        return Rhythm(count, rate, jitter, self._ages.take())


STRANGE_AGE = 1.0
"""Messages older or younger (s) than this carry stamps of another clock."""

TWIST_MESSAGES = {
    'other_axes': 'The twists do not fit the poses in the axes of tool_twist.frame, but they do '
                  'in the other choice: switch it between world and tool.',
    'does_not_fit': 'The twists do not fit the poses. Check their units, and that they are '
                    'those of the tool tip.',
}
REASONS = {
    'nan': 'nan (a number in it is not finite)',
    'zero_quaternion': 'zero quaternion',
    'not_unit': 'quaternion not of unit length',
    'zero_stamp': 'no valid stamp',
    'duplicate_stamp': 'repeated stamp',
    'backward_stamp': 'backward stamp',
    'future_stamp': 'stamp in the future',
    'repeated_pose': 'the pose repeats although the tool moves (tracking lost?)',
    'jump': 'too far from the pose before (tracking lost, or two tools on one topic?)',
    'frame_id': 'frame_id is another than before',
    'twist_nan': 'nan (a number in it is not finite)',
    'twist_too_fast': 'faster than any arm',
    'twist_frame_id': 'frame_id is another than before',
    'twist_misses_pose': 'does not match the motion from pose to pose',
    'twist_unpaired': 'no pose near its stamp',
    'gap': f'no usable pose arrived for more than {LONGEST_GAP_NS * 1e-9:g} s',
    'clock_set_back': 'the stamps went back (a clock was set, or a recording started again)',
    'clock_set_forward': 'the stamps jumped ahead of the elapsed time',
    'clock_jump': 'the clock of the simulation was set, or switched on or off',
    'frame_changed': "the tool's poses are now in another frame",
    'moved': "the tool's poses jumped further than it can move",
    'diverged': 'the prediction diverged, with its lip further away than any cup reaches; check '
                'cup.stiffness, cup.damping and the package',
}
"""Why messages are refused, and why the prediction starts again."""

PHASE_MESSAGES = {
    'detached': 'Detached: no package is held, so nothing is predicted.',
    'waiting': 'Waiting for the first pose of the tool.',
    'settling': 'Settling: the prediction started while the tool moved, or after doubtful poses.',
    'coasting': 'Coasting: no pose of the tool arrives, so its motion is extrapolated.',
    'released': 'Released: the valve is switched off, and the cup still holds the package.',
    'flying': 'Flying: the cup has let the package go.',
    'landed': 'Landed: nothing is published until vacuum/valve is true again.',
    'lost': 'Lost: no usable pose of the tool arrives, so nothing is published.',
}


class Mismatch(NamedTuple):
    """Why an input cannot be received: a QoS policy, another type, or a missing part."""

    of: Literal['qos', 'type', 'frames']
    name: str


class Level(IntEnum):
    """Levels of REP-107, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Status(NamedTuple):
    """One line of the diagnostics."""

    name: str
    level: Level
    message: str
    values: dict[str, str]


class InputSeen(NamedTuple):
    """One input as seen since the last report."""

    topic: str
    publishers: int
    mismatch: Mismatch | None
    """What does not match some publisher's, if any."""
    rhythm: Rhythm
    silent: float
    """Seconds since the last message; infinite before the first."""
    refused: Mapping[str, int]
    """Counts since the last report."""
    total_refused: Mapping[str, int]
    """Counts since the start."""


def number(value: float) -> str:
    """Return a number for the diagnostics, or a text for a missing one."""
    return f'{value:.4g}' if math.isfinite(value) else 'none'


def input_status(name: str, seen: InputSeen, optional: bool = False) -> Status:
    """Return the line on an input; one that is optional may be absent."""
    return Status(name, *_judge_input(seen, optional), _values(seen))


def _values(seen: InputSeen) -> dict[str, str]:
    """Return the numbers of an input."""
    return {
        'topic': seen.topic,
        'publishers': str(seen.publishers),
        'rate (Hz)': number(seen.rhythm.rate_hz),
        'jitter (s)': number(seen.rhythm.jitter),
        'age p50 (s)': number(seen.rhythm.age.p50),
        'age p99 (s)': number(seen.rhythm.age.p99),
        'age max (s)': number(seen.rhythm.age.largest),
        'silent for (s)': number(seen.silent),
        **{f'refused: {reason}': str(count) for reason, count in seen.total_refused.items()},
    }


def _listed(counts: Mapping[str, int]) -> str:
    """Return what has been counted, as words."""
    return ', '.join(
        f'{count} x {REASONS.get(reason, reason)}' for reason, count in counts.items() if count)


def _refusals(seen: InputSeen) -> str:
    """Return how many messages were refused since the last report, and why."""
    refused, of = sum(seen.refused.values()), seen.rhythm.messages
    return f'{refused} of {of} messages refused: {_listed(seen.refused)}'


def _judge_input(seen: InputSeen, optional: bool) -> tuple[Level, str]:
    """Return level and words on an input."""
    lowest = Level.WARN if optional else Level.ERROR
    if seen.rhythm.messages == 0:
        return _judge_silence(seen, optional, lowest)
    refused = sum(seen.refused.values())
    if refused:
        return lowest if refused >= seen.rhythm.messages else Level.WARN, f'{_refusals(seen)}.'
    if seen.mismatch:
        return Level.WARN, _mismatch_message(seen.topic, seen.mismatch)
    age = seen.rhythm.age.p50
    if abs(age) > STRANGE_AGE:
        side = 'behind' if age > 0.0 else 'ahead of'
        return Level.WARN, (
            f'Stamps are {abs(age):.3g} s {side} the clock of this node. Synchronise the clocks, '
            'or set use_sim_time while playing a recording.'
        )
    known = math.isfinite(seen.rhythm.rate_hz)
    return Level.OK, f'{seen.rhythm.rate_hz:.4g} Hz.' if known else 'A single message.'


def twist_status(name: str, seen: InputSeen, poses: int, alone: int) -> Status:
    """Return the line on the twists, with the number of recent poses without one."""
    status = input_status(name, seen, optional=True)
    seldom = 2 * seen.rhythm.messages <= poses
    if status.level > Level.OK or seldom or 2 * alone <= poses:
        return status
    return status._replace(level=Level.WARN, message=(
        f'{alone} of {poses} poses had no twist of the same stamp; it was estimated. Check that '
        'one clock stamps poses and twists.'
    ))


def _judge_silence(seen: InputSeen, optional: bool, lowest: Level) -> tuple[Level, str]:
    """Return level and text for a silent input."""
    if seen.mismatch:
        return lowest, _mismatch_message(seen.topic, seen.mismatch)
    if seen.publishers == 0:
        if optional:
            return Level.OK, f'Nobody publishes {seen.topic}: estimated from the poses.'
        return lowest, (
            f'Nobody publishes {seen.topic}. Start the driver, or remap the topic.'
        )
    since = f'for {seen.silent:.1f} s' if math.isfinite(seen.silent) else 'so far'
    return lowest, (
        f'The publisher of {seen.topic} is silent: no message {since}. Check that the driver and '
        'its controller are active.'
    )


def _mismatch_message(topic: str, mismatch: Mismatch) -> str:
    """Return the text on a mismatch of QoS, type or frames."""
    of, name = mismatch
    if of == 'frames':
        return (f'No pose of the tool from {topic}: {name}. Check frames.world and frames.tool, '
                'and their publishers.')
    if of == 'type':
        return (f'A publisher of {topic} sends {name}, but the node subscribes to another type. '
                'Set tool_pose.type, or remap the topic.')
    return (f'QoS does not match: a publisher of {topic} offers a {name} other than the '
            f'requested one. Set qos_overrides.{topic}.subscription.{name} to the offered value.')


def vacuum_status(name: str, seen: InputSeen, held: bool, latched: bool) -> Status:
    """
    Return the line on the signal of the vacuum.

    A latched one is sent when it changes, and may be silent after its first message.
    """
    values = _values(seen) | {'held': str(held).lower()}
    return Status(name, *_judge_vacuum(seen, held, latched), values)


def _judge_vacuum(seen: InputSeen, held: bool, latched: bool) -> tuple[Level, str]:
    """Return level and words on the vacuum signal."""
    lost = Level.WARN if held else Level.ERROR  # not held, nothing is predicted
    counts = f'the package counts as {"" if held else "not "}held'
    if seen.mismatch:
        return lost, _mismatch_message(seen.topic, seen.mismatch)
    if seen.publishers == 0:
        return lost, (
            f'Nobody publishes {seen.topic}: {counts}. Start the driver, remap the topic, or set '
            'vacuum.signal to none.'
        )
    if any(seen.refused.values()):
        return lost, f'{_refusals(seen)}; {counts}. Publish the absolute pressure, Pa.'
    if not math.isfinite(seen.silent):
        return Level.WARN, f'No message on {seen.topic} so far: {counts}.'
    if not (seen.rhythm.messages or latched):
        return lost, f'{seen.topic} has been silent for {seen.silent:.1f} s: {counts}.'
    return Level.OK, 'Held.' if held else 'Not held.'


class PredictionSeen(NamedTuple):
    """The prediction as seen since the last report."""

    state: str
    """Of the lifecycle: 'active' or another."""
    phase: str
    cup: str
    compute: Quantiles
    """Seconds from a message's arrival until its predictions were published."""
    counts: Mapping[str, int]
    """Since the start."""
    restarts: Mapping[str, int]
    """Since the last report."""
    twist_verdict: str
    covariance_known: bool = True
    """Whether the odometry's covariance is one."""
    above: bool = False
    """Whether z of the tool points down, so that the package is above it."""


def prediction_status(name: str, seen: PredictionSeen) -> Status:
    """Return the line on the prediction."""
    values = {
        'lifecycle': seen.state,
        'phase': seen.phase,
        'cup': seen.cup,
        'compute time p50 (us)': number(1e6 * seen.compute.p50),
        'compute time p99 (us)': number(1e6 * seen.compute.p99),
        'compute time max (us)': number(1e6 * seen.compute.largest),
        'twists against poses': seen.twist_verdict,
        **{what: str(count) for what, count in seen.counts.items()},
    }
    return Status(name, *_judge_prediction(seen), values)


def _judge_prediction(seen: PredictionSeen) -> tuple[Level, str]:
    """Return level and words on the prediction."""
    if seen.state != 'active':
        return Level.OK, f'{seen.state.capitalize()}: nothing is published.'
    if seen.restarts.get('no_equilibrium'):
        return Level.ERROR, (
            'Nothing is published: the cup cannot hold the package at rest in this tool pose. '
            'Check package.mass, package.com, cup.stiffness and their units, and that z of the '
            'tool points from the cup back into the arm.'
        )
    if failures := seen.restarts.get('failure'):
        return Level.ERROR, f'{failures} callbacks failed, a fault of this node. Report its log.'
    if seen.phase == 'lost':
        return Level.ERROR, PHASE_MESSAGES[seen.phase]
    if seen.above:
        return Level.ERROR, (
            'The package is above the tool: z of the tool points down, but must point from the '
            "cup back into the arm. Turn the driver's tool frame by 180 degrees about x, or set "
            'gravity.direction if the arm is not mounted upright.'
        )
    if restarts := _listed(seen.restarts):
        return Level.WARN, f'Started again from static equilibrium: {restarts}.'
    if seen.phase in ('coasting', 'settling'):
        return Level.WARN, PHASE_MESSAGES[seen.phase]
    if seen.twist_verdict in TWIST_MESSAGES:
        return Level.WARN, TWIST_MESSAGES[seen.twist_verdict]
    if not seen.covariance_known:
        return Level.WARN, (
            'The covariance of package/odometry is unknown, because the package has no stable '
            'equilibrium under the tool. Check package.com, and that z of the tool points from '
            'the cup back into the arm.'
        )
    return Level.OK, PHASE_MESSAGES.get(seen.phase, 'Predicting.')


def load_status(
    name: str, safety: Safety | None, away: Distance | None, bending: float,
    grip_known: bool, envelope_known: bool, required: float,
) -> Status:
    """Return the line on the cup's load: safety factor and validity range."""
    values = {
        'safety factor': 'not known' if not grip_known else number(
            math.nan if safety is None else safety.factor),
        'limited by': 'nothing' if safety is None else safety.mode,
        'distance from envelope': 'not known' if not envelope_known else number(
            math.nan if away is None else away.value),
        'largest bending (rad)': number(bending),
    }
    level, message = Level.OK, 'Within all known limits.'
    if safety is not None and safety.factor < required:
        level = Level.ERROR if safety.factor < 1.0 else Level.WARN
        below = '1: the cup lets go' if safety.factor < 1.0 else f'safety.least, {required:g}'
        message = (f'The safety factor of the grip is {safety.factor:.2f} ({safety.mode}), below '
                   f'{below}. Move slower, or raise the vacuum.')
    elif bending > STRONGEST_BENDING:
        level, message = Level.WARN, (
            f'The cup bends by {bending:.2g} rad, where its restoring moment hardly grows.')
    elif away is not None and away.outside:
        level, message = Level.WARN, away.text
    elif not (grip_known or envelope_known):
        message = ('The limits of the cup are unknown. Set cup.lip_radius with vacuum.holding, '
                   'and envelope.*.')
    elif safety is None and away is None:
        message = 'No load: no package is held.'
    return Status(name, level, message, values)


def summary(live: LivePredictor) -> str:
    """Return all counts of a predictor in one sentence."""
    def many(count: int, thing: str) -> str:
        return f'{count} {thing}' if count == 1 else f'{count} {thing}s'

    refused = [f'{count} {name}' for name, count in live.refused.items() if count]
    detail = f' ({", ".join(refused)})' if refused else ''
    return (
        f'{many(live.poses_in, "pose")} and {many(live.twists_in, "twist")} in, '
        f'{many(live.predictions, "prediction")} out, {sum(live.refused.values())} refused'
        f'{detail}, {many(live.twists_estimated, "twist")} estimated.'
    )
