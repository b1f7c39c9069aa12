"""Decoding and encoding of messages, against rosbags' own."""

from bellows_ros.files import messages as cdr
from hypothesis import given, strategies
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from . import recordings as made

KINDS = sorted(cdr.MOTIONS)
ANY_DOUBLE = strategies.floats(width=64)
ANY_NAME = strategies.text(
    strategies.characters(whitelist_categories=['L', 'N', 'P', 'S']), max_size=9)


def parts(kind):
    """Return which of a type's doubles can be asked for, by name."""
    layout = cdr.LAYOUTS[kind]
    return {k: v for k, v in (('pose', layout.pose), ('twist', layout.twist)) if v}


def decode(messages, kind, part):
    """Return messages decoded, as they were recorded one after the other, and their frames."""
    return cdr.decode(messages, range(len(messages)), kind, part)


def names(kind, frame_id, child_frame_id):
    """Return the frame names a type has."""
    return (frame_id, child_frame_id)[: cdr.LAYOUTS[kind].strings]


@pytest.mark.parametrize('kind', KINDS)
@given(
    numbers=strategies.lists(ANY_DOUBLE, min_size=13, max_size=13),
    sec=strategies.integers(0, 2**31 - 1), nanosec=strategies.integers(0, 10**9 - 1),
    frame_id=ANY_NAME, child_frame_id=ANY_NAME, little_endian=strategies.booleans())
def test_decoding_returns_what_rosbags_encoded(
    kind, numbers, sec, nanosec, frame_id, child_frame_id, little_endian
):
    given_parts = {'pose': numbers[:7], 'twist': numbers[7:]}
    stamp_ns = sec * 10**9 + nanosec
    data = made.encoded(
        kind, stamp_ns, **given_parts, frame_id=frame_id, child_frame_id=child_frame_id,
        little_endian=little_endian)
    for name, part in parts(kind).items():
        decoded, frames = decode([data], kind, part)
        assert decoded['stamp'][0] == stamp_ns
        assert frames == [names(kind, frame_id, child_frame_id)]
        assert_array_equal(decoded['values'], [given_parts[name]])


@pytest.mark.parametrize('kind', KINDS)
def test_encoding_is_that_of_rosbags(kind):
    given_parts = {'pose': made.pose_values(5), 'twist': made.twist_values(5)}
    values = np.hstack([given_parts[name] for name in parts(kind)])
    for frame_id in ('', 'w', 'world', 'a frame of 24 characters', 'wörld'):
        data = cdr.encode(made.stamps(5), values, names(kind, frame_id, 'tool'), kind)
        for i, one in enumerate(data):
            row = {name: part[i] for name, part in given_parts.items()}
            assert bytes(one) == made.encoded(
                kind, made.stamps(5)[i], **row, frame_id=frame_id, child_frame_id='tool',
                covariance=np.zeros(36))


@pytest.mark.parametrize('kind', KINDS)
def test_a_message_cut_short_anywhere_is_not_decoded(kind):
    data = made.encoded(kind, made.EPOCH_NS, pose=made.pose_values(1)[0], twist=[1.0] * 6)
    cut = [data[:size] for size in range(len(data))]
    for part in parts(kind).values():
        decoded, _ = decode([data, *cut], kind, part)
        assert_array_equal(decoded['frame'], [0] + [-1] * len(cut))


@pytest.mark.parametrize('at, value', [
    (0, 1),  # not CDR
    (1, 7),  # another version of CDR
    (12, 0),  # a string without its end
    (15, 0xFF),  # a string longer than memory
    (16, 0xFF),  # not UTF-8
    (21, 0x20),  # a string without its zero
])
def test_damaged_messages_are_not_decoded(at, value):
    good = made.encoded(made.POSE, made.EPOCH_NS, pose=made.pose_values(1)[0])
    damaged = bytearray(good)
    damaged[at] = value
    decoded, _ = decode([bytes(damaged), good], made.POSE, slice(0, 7))
    assert decoded['frame'].tolist() == [-1, 0]


@pytest.mark.parametrize('at, value', [(7, 0x80), (11, 0xFF)])
def test_times_before_1970_or_with_more_nanoseconds_than_a_second_are_no_stamps(at, value):
    damaged = bytearray(made.encoded(made.POSE, made.EPOCH_NS, pose=made.pose_values(1)[0]))
    damaged[at] = value
    assert decode([bytes(damaged)], made.POSE, slice(0, 7))[0]['stamp'][0] <= 0
