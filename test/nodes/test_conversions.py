"""The bytes of messages against those of rclpy, there and back."""

import struct

from bellows_ros.core.live.uncertainty import STILL
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.files import messages
from bellows_ros.nodes import conversions
from builtin_interfaces.msg import Time
from geometry_msgs import msg as geometry
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

KINDS = {conversions.type_name(kind): kind for kind in (
    geometry.PoseStamped, geometry.PoseWithCovarianceStamped, geometry.TransformStamped,
    geometry.TwistStamped, geometry.WrenchStamped, geometry.Vector3Stamped,
    geometry.InertiaStamped, Odometry)}
BIG, LITTLE, XCDR2_BIG, XCDR2_LITTLE = 0, 1, 6, 7
"""Second byte of a message: its encoding."""

SECONDS = st.integers(-(2**31), 2**31 - 1)
NAMES = st.text(
    st.characters(blacklist_categories=['C', 'Z'], whitelist_characters=' '), max_size=40)
DOUBLES = st.lists(st.floats(-1e5, 1e5), min_size=85, max_size=85)


@pytest.mark.parametrize('name', ['tool_pose.type', 'measured.type'])
def test_every_pose_type_is_declared_with_its_layout(name):
    """Have a message with a pose for each choice but those with an input of their own."""
    for choice in {*PARAMETERS[name].choices} - {'tf', 'detections'}:
        kind = messages.POSE_TYPES[choice]
        assert messages.LAYOUTS[kind].pose
        assert conversions.message_class(kind, name, '') is KINDS[kind]


def filled(message, numbers):
    """Give all doubles of a message their numbers, in the order of its fields."""
    for name, kind in message.get_fields_and_field_types().items():
        if kind == 'double':
            setattr(message, name, next(numbers))
        elif kind == 'double[36]':
            setattr(message, name, [next(numbers) for _ in range(36)])
        elif '/' in kind and name != 'header':
            filled(getattr(message, name), numbers)
    return message


def made(kind, sec, nanosec, names, numbers):
    """Return the message object of some content."""
    message = filled(kind(), iter(numbers))
    message.header.stamp = Time(sec=sec, nanosec=nanosec)
    message.header.frame_id, *child = names
    if child:
        message.child_frame_id, = child
    return message


@pytest.mark.parametrize('name', KINDS)
@given(SECONDS, st.integers(0, 10**9 - 1), st.lists(NAMES, min_size=2, max_size=2), DOUBLES)
def test_bytes_are_those_of_ros(name, sec, nanosec, names, numbers):
    """Encode as rclpy serialises, and decode what it serialised."""
    layout, stamp_ns = messages.LAYOUTS[name], sec * 10**9 + nanosec
    names, numbers = tuple(names[:layout.strings]), numbers[:layout.doubles]
    data = messages.pack(name, names, stamp_ns, *numbers)
    gaps = encoded(name, LITTLE, sec, nanosec, names, numbers, b'\xff')
    serialized = serialize_message(made(KINDS[name], sec, nanosec, names, numbers))
    assert len(data) == len(serialized) == len(gaps)
    assert bytes(  # ROS leaves any bytes in the gaps before aligned numbers
        0 if gap != byte else theirs
        for gap, byte, theirs in zip(gaps, data, serialized, strict=True)) == data
    back_ns, back_names, back = conversions.reader(KINDS[name])(data)
    assert back_ns == stamp_ns
    assert back_names == tuple(each.removeprefix('/') for each in names)  # as in tf2
    form = f'{layout.doubles}d'  # of bytes, as NaN differs from itself
    assert struct.pack(form, *back) == struct.pack(form, *numbers)


def encoded(name, encoding, sec, nanosec, names, numbers, gap=b'\0'):
    """Return a message in an encoding."""
    order, alignment = '<>'[encoding in (BIG, XCDR2_BIG)], 4 if encoding > LITTLE else 8
    body = struct.pack(f'{order}iI', sec, nanosec)
    for text in names:
        raw = text.encode() + b'\0'
        body += gap * (-len(body) % 4) + struct.pack(f'{order}I', len(raw)) + raw
    body += gap * (-len(body) % alignment) + struct.pack(f'{order}{len(numbers)}d', *numbers)
    return bytes([0, encoding, 0, 0]) + body


@pytest.mark.parametrize('encoding', [BIG, XCDR2_BIG, XCDR2_LITTLE])
@pytest.mark.parametrize('name', KINDS)
@pytest.mark.parametrize('frame_id', ['', 'abc', 'abcd', 'abcdefgh', 'wörld'])
def test_other_encodings_are_read_by_ros(name, encoding, frame_id):
    """Return from each encoding what stands in it, also between messages of the common one."""
    layout = messages.LAYOUTS[name]
    names, numbers = (frame_id, 'child')[:layout.strings], tuple(map(float, range(layout.doubles)))
    read = conversions.reader(KINDS[name])
    for each in (encoding, LITTLE, encoding):
        assert read(encoded(name, each, 5, 6, names, numbers)) == (5_000_000_006, names, numbers)


@pytest.mark.parametrize('name', KINDS)
def test_a_damaged_message_has_no_stamp(name):
    """Return no stamp for a message cut short, of a string that is none, or of another kind."""
    read, layout = conversions.reader(KINDS[name]), messages.LAYOUTS[name]
    names = ('world', 'child')[:layout.strings]
    data = messages.pack(name, names, 5, *range(layout.doubles))
    assert read(data)[0] == 5
    broken = bytearray(data)
    broken[16] = 0xFF
    cut = [data[:size] for size in range(0, len(data) - 4, 7)]
    for each in (*cut, bytes(broken), b'\1' + data[1:]):
        stamp_ns, frames, numbers = read(each)
        assert stamp_ns == messages.NO_STAMP or frames != names or each == data
        assert len(numbers) == layout.doubles
    assert read(data)[:2] == (5, names)


@pytest.mark.parametrize('huge', [1e6, -1e308, np.inf])
def test_numbers_beyond_the_bound_are_not_numbers(huge):
    """Of poses, twists and wrenches, but not in a covariance."""
    for name, kind in KINDS.items():
        layout = messages.LAYOUTS[name]
        names, numbers = ('world', 'child')[:layout.strings], [1.0] * layout.doubles
        read = conversions.reader(kind)
        twist = (layout.twist or slice(0)).start
        for place, is_kept in ((0, False), (twist or 0, False), (-1, layout.doubles > 7)):
            changed = [*numbers]
            changed[place] = huge
            found = read(messages.pack(name, names, 5, *changed))
            assert found[:2] == (5, names)
            assert bool(np.isnan(found[2]).all()) is not is_kept


def test_predictions_and_payloads_become_messages():
    """Put each number where it belongs; rotate the covariance of the pose to world axes."""
    now = STILL._replace(
        stamp_ns=1_700_000_000_987_654_321, position=(0.1, 0.2, 0.3),
        quaternion_xyzw=(0.5, -0.5, 0.5, -0.5), linear=(1.0, 2.0, 3.0), angular=(4.0, 5.0, 6.0))
    P = np.diag(np.square(np.arange(1.0, 13.0)))
    message = deserialize_message(conversions.odometry('base', 'box', now, P), Odometry)
    assert (message.header.frame_id, message.child_frame_id) == ('base', 'box')
    assert conversions.stamp_to_ns(message.header.stamp) == now.stamp_ns
    assert now[1:5] == (
        conversions.vector(message.pose.pose.position),
        conversions.quaternion_xyzw(message.pose.pose.orientation),
        conversions.vector(message.twist.twist.linear),
        conversions.vector(message.twist.twist.angular))
    assert sorted(np.diag(np.reshape(message.pose.covariance, (6, 6)))) == pytest.approx(
        [1, 4, 9, 16, 25, 36])
    assert list(np.diag(np.reshape(message.twist.covariance, (6, 6)))) == [
        49, 64, 81, 100, 121, 144]
