"""Messages and plans as CDR, against rosbags' own; uneven plans refused."""

from bellows_ros.errors import BellowsError
from bellows_ros.files import messages as cdr
from bellows_ros.files.plans import encode, JOINTS, MULTI_DOF, PATH, Plan, plans_of
from hypothesis import given, strategies
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from . import recordings as made
from .recordings import TYPES

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


STAMP, RNG = (17, 5), np.random.default_rng(5)
COUNT, STAMP_NS = 5, 17_000_000_005
TIMES = np.arange(COUNT) * 1_234_567_891
POSES, TWISTS = RNG.normal(size=(COUNT, 7)), RNG.normal(size=(COUNT, 6))


def of_tool(frame='base', names=('tool',), parts=(1, 1), count=COUNT):
    """Return a message of rosbags of transforms and velocities, so many in each point."""
    return made.built(MULTI_DOF, ((STAMP, frame), list(names), [
        (parts[0] * [(p[:3], p[3:])], parts[1] * [(v[:3], v[3:])], [], divmod(int(t), 10**9))
        for t, p, v in zip(TIMES[:count], POSES, TWISTS, strict=False)]))


def of_joints(frame, names):
    """Return a message of rosbags on three joints."""
    return made.built(JOINTS, ((STAMP, frame), list(names), [
        (p[:3].tolist(), v[:3].tolist(), v[3:].tolist(), [], divmod(int(t), 10**9))
        for t, p, v in zip(TIMES, POSES, TWISTS, strict=True)]))


def of_path(frame):
    """Return a Path of rosbags."""
    return made.built(PATH, ((STAMP, frame), [
        ((divmod(int(STAMP_NS + t), 10**9), frame), (p[:3], p[3:]))
        for t, p in zip(TIMES, POSES, strict=True)]))


THREE = ('turn', 'slide', 'spin')


@pytest.mark.parametrize('frame', ['', 'a', 'ab', 'map', 'base', 'world', 'base_link'])
@pytest.mark.parametrize(('make', 'kind', 'names', 'columns'), [
    (lambda frame: of_tool(frame), MULTI_DOF, ('tool',), (POSES, TWISTS)),
    (lambda frame: of_tool(frame, (), (1, 0)), MULTI_DOF, (), (POSES,)),
    (lambda frame: of_joints(frame, THREE), JOINTS, THREE,
     (POSES[:, :3], TWISTS[:, :3], TWISTS[:, 3:])),
    (of_path, PATH, ('tool',), (POSES,))])
def test_is_what_rosbags_reads_and_writes(make, kind, names, columns, frame):
    theirs, ours = make(frame), Plan(kind, STAMP_NS, frame, names, TIMES, *columns)
    plain = bytes(TYPES.serialize_cdr(theirs, kind))
    assert encode(ours) == plain
    for each in (theirs, TYPES.deserialize_cdr(plain, kind)):
        found, = plans_of(each)
        assert found[:4] == ours[:4]
        for part, expected in zip(found[4:], ours[4:], strict=True):
            assert_array_equal(part, expected)


def uneven(message):
    """Return a message without the velocities of one point."""
    message.points[3].velocities = []
    return message


@pytest.mark.parametrize(('message', 'figures'), [
    (of_tool(count=0), r'\b0\b'), (of_tool(parts=(2, 1)), r'\b2 transforms\b.*\b1 in every'),
    (of_tool(parts=(1, 2)), r'\b2 velocities\b'), (of_tool(names=('a', 'b')), r'\b1 name\b'),
    (uneven(of_tool()), r'point 3 .*\b0 velocities\b')])
def test_other_than_one_thing_is_refused(message, figures):
    with pytest.raises(BellowsError, match=figures):
        plans_of(message)
