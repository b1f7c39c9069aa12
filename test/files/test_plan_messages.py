"""Plans as CDR against the serialiser of rosbags, and uneven ones refused."""

from bellows_ros.errors import BellowsError
from bellows_ros.files import plan_messages
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from . import recordings as made
from .recordings import TYPES


def message(parts=(1, 1), count=5, frame='base', names=('tool',)):
    """Return a plan of our kind, and the same as rosbags has it."""
    rng = np.random.default_rng(count)
    poses, twists = rng.normal(size=(count, 7)), rng.normal(size=(count, 6))
    times = np.arange(count) * 1_234_567_891
    theirs = made.built(plan_messages.MULTI_DOF, ((((17, 5), frame), list(names), [
        (parts[0] * [(p[:3], p[3:])], parts[1] * [(v[:3], v[3:])], [], divmod(int(t), 10**9))
        for t, p, v in zip(times, poses, twists, strict=True)])))
    ours = plan_messages.PlanMessage(
        17_000_000_005, frame, tuple(names), times, poses, twists if parts[1] else None)
    return ours, theirs


@pytest.mark.parametrize('parts', [(1, 0), (1, 1)])
@pytest.mark.parametrize('frame', ['', 'a', 'ab', 'base', 'world', 'base_link'])
@pytest.mark.parametrize('names', [('tool',), (), ('tool0_tip',)])
def test_is_what_rosbags_reads_and_writes(parts, frame, names):
    ours, theirs = message(parts, 5, frame, names)
    plain = bytes(TYPES.serialize_cdr(theirs, plan_messages.MULTI_DOF))
    assert plan_messages.encode_multi_dof(ours) == plain
    for each in (theirs, TYPES.deserialize_cdr(plain, plan_messages.MULTI_DOF)):
        found, = plan_messages.plans_of(each)
        assert (found.stamp_ns, found.frame_id, found.names) == (17_000_000_005, frame, names)
        assert_array_equal(found.times_ns, ours.times_ns)
        assert_array_equal(found.poses, ours.poses)
        assert (found.twists is None) == (ours.twists is None)
        if found.twists is not None:
            assert_array_equal(found.twists, ours.twists)


@pytest.mark.parametrize('frame', ['', 'a', 'map', 'base', 'world', 'base_link'])
def test_path_is_what_rosbags_reads(frame):
    poses = np.random.default_rng(0).normal(size=(4, 7))
    times = np.arange(4) * 700_000_000
    data = plan_messages.encode_path(3_500_000_000, frame, times, poses)
    found = TYPES.deserialize_cdr(data, plan_messages.PATH)
    assert found.header.frame_id == frame and found.header.stamp.sec == 3
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in found.poses]
    assert_array_equal(stamps, 3_500_000_000 + times)
    assert {p.header.frame_id for p in found.poses} == {frame}
    read = [[p.pose.position.x, p.pose.position.y, p.pose.position.z, p.pose.orientation.x,
             p.pose.orientation.y, p.pose.orientation.z, p.pose.orientation.w]
            for p in found.poses]
    assert_array_equal(read, poses)


@pytest.mark.parametrize(('parts', 'count', 'figures'), [
    ((1, 1), 0, r'\b0\b'), ((2, 1), 5, r'\b2 transforms\b.*\b1 in every'),
    ((1, 2), 5, r'\b2 velocities\b')])
def test_other_than_one_thing_is_refused(parts, count, figures):
    _, theirs = message(parts, count)
    with pytest.raises(BellowsError, match=figures):
        plan_messages.plans_of(theirs)


def test_two_names_and_velocities_of_some_points_alone_are_refused():
    _, twice = message()
    twice.joint_names *= 2
    _, uneven = message()
    uneven.points[3].velocities = []
    for theirs, figures in ((twice, r'\b1\b'), (uneven, None)):
        with pytest.raises(BellowsError, match=figures):
            plan_messages.plans_of(theirs)
