"""Plans as CDR against the serialiser of rosbags, and uneven ones refused."""

from bellows_ros.errors import BellowsError
from bellows_ros.files.plans import encode, JOINTS, MULTI_DOF, PATH, Plan, plans_of
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from . import recordings as made
from .recordings import TYPES

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
