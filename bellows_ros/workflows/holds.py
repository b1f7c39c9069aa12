"""Holds of a package in a recording of pick-and-place, by the recorded vacuum and valve."""

from collections.abc import Mapping, Sequence
from operator import itemgetter
import os
from typing import Any

from bellows_ros.core.geometry.arrays import Mask
from bellows_ros.core.live.cycle import holds, Signal
from bellows_ros.core.live.vacuum import ALL, Vacuum
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.recording.alignment import world_rotation
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream
from bellows_ros.errors import BellowsError
from bellows_ros.files import bags, File, messages
import numpy as np

SIGNALS = {'bool': (messages.BOOL, 'vacuum/held'),
           'pressure': ('sensor_msgs/msg/FluidPressure', 'vacuum/pressure')}
"""Message types and usual topics of the vacuum, by values of vacuum.signal."""

MIXED_NS = 86_400 * NS_PER_S
"""Smallest distance between header stamps and times of recording of two clocks, ns: a day, beyond
any delay and time zone."""


def signals_of(bag: File, values: Values) -> list[Signal]:
    """
    Return the recorded vacuum and valve, in order; empty if vacuum.signal is none.

    Topics may be in any namespace. Stamps are from the headers of messages with a header,
    otherwise times of recording.

    Raises
    ------
    BellowsError
        If vacuum.signal is not recorded.

    """
    vacuum, signals, signal = Vacuum(), list[Signal](), values.vacuum.signal
    if signal == 'none':
        return []
    kind, usual = SIGNALS[signal]
    name = values.topics.vacuum or usual
    for topic, log_ns, message in bags.messages_of(bag, {kind, messages.BOOL}):
        is_bool = hasattr(message, 'data')
        if is_bool and topic.endswith('/vacuum/valve'):
            signals.append((log_ns, 'valve', bool(message.data), ALL))
        if is_bool != (signal == 'bool') or not is_named(topic, name):
            continue
        if is_bool:
            signals.append((log_ns, 'vacuum', bool(message.data), ALL))
            continue
        stamp_ns = message.header.stamp.sec * NS_PER_S + message.header.stamp.nanosec
        states = vacuum.update(values, message.fluid_pressure, message.header.frame_id)
        if not isinstance(states, str):  # the reason for a rejected message
            signals += [(stamp_ns or log_ns, 'vacuum', *state) for state in states]
    if not any(each[1] == 'vacuum' for each in signals):
        there = ', '.join(t.name for t in bags.topics(bag) if t.type_name == kind and t.messages)
        raise BellowsError(
            f"vacuum.signal is '{signal}', but recording '{os.fspath(bag)}' has no usable {kind} "
            f'on {name}; it has: {there or "none"}. Set topics.vacuum to the topic of '
            'the vacuum, or vacuum.signal: none.')
    return sorted(signals, key=itemgetter(0))


def is_named(topic: str, name: str) -> bool:
    """Return whether a recorded topic has a name, in any namespace."""
    return topic.endswith(bags.absolute(name))


def spans_held(
    tool: PoseStream, signals: Sequence[Signal], values: Values
) -> list[tuple[int, int]]:
    """
    Return the first and last stamp (ns) of each hold of a package, lifted from any support.

    Raises
    ------
    BellowsError
        If poses and vacuum are stamped by two clocks.

    """
    stamps = tool.stamps_ns
    if signals[0][0] > stamps[-1] + MIXED_NS or signals[-1][0] < stamps[0] - MIXED_NS:
        raise BellowsError(
            f"The recording mixes two clocks: the header stamps of '{tool.name}' begin at "
            f'{stamps[0] / NS_PER_S:.0f} s, and the vacuum, which has no header, was recorded '
            f'at {signals[0][0] / NS_PER_S:.0f} s. With simulated time, record with '
            "'ros2 bag record --use-sim-time', or set vacuum.signal: none.")
    up = world_rotation(values.recording.world, values.gravity.direction)[2]
    return [*holds(tool.stamps_ns, tool.position @ up, signals)]


def masks_held(path: File, streams: Mapping[str, Any], values: Values) -> list[Mask]:
    """
    Return masks of the messages of streams, by role, during the holds of a lifted package.

    Raises
    ------
    BellowsError
        If there is no such hold.

    """
    signals = signals_of(path, values)
    spans = spans_held(streams['tool_pose'], signals, values)
    if not spans:
        raise BellowsError(
            f"Recording '{path}' has no lifted package while the vacuum holds: the tool never "
            'rises by 1 cm. Check recording.world and the vacuum signal, or set vacuum.signal: '
            'none.')
    return [np.any([(stream.stamps_ns >= first) & (stream.stamps_ns <= last)
                    for first, last in spans], axis=0) for stream in streams.values()]
