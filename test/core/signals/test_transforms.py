"""The tool's pose by a tree of frames, against SciPy's rotations and matrices."""

from bellows_ros.core.geometry.lie import transform
from bellows_ros.core.signals.screening import PoseSample
from bellows_ros.core.signals.transforms import Chain, MAX_FRAMES, QUEUE_LENGTH
import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation, Slerp

MS = 1_000_000
ONE = (0.0, 0.0, 0.0, 1.0)


def random_pose(rng, stamp_ns=0):
    """Return a pose anywhere."""
    return PoseSample(
        stamp_ns, tuple(rng.normal(size=3).tolist()),
        tuple(Rotation.random(random_state=rng).as_quat().tolist()))


def four(pose):
    """Turn a pose into four rows."""
    return transform(Rotation.from_quat(pose.quaternion_xyzw).as_matrix(), pose.position)


def along_x(stamp_ns, x):
    """Return a pose that is only shifted."""
    return PoseSample(stamp_ns, (x, 0.0, 0.0), ONE)


def test_a_chain_of_links_whose_world_is_in_another_branch():
    rng = np.random.default_rng(1)
    base, camera, wrist, tip = (random_pose(rng) for _ in range(4))
    chain = Chain('camera', 'tip')
    chain.add('root', 'base', base, static=True)
    chain.add('root', 'camera', camera, static=True)
    chain.add('wrist', 'tip', tip, static=True)
    for k in range(1, 4):
        moved = random_pose(rng, k * MS)
        chain.add('base', 'wrist', moved)
        (pose,) = chain.due()
        assert pose.stamp_ns == k * MS
        expected = np.linalg.inv(four(camera)) @ four(base) @ four(moved) @ four(tip)
        assert_allclose(four(pose), expected, atol=1e-12)
    assert not chain.missing and not chain.dropped


def test_a_slower_link_is_interpolated_between_its_stamps():
    rng = np.random.default_rng(2)
    chain = Chain('world', 'tool')
    ends = [PoseSample(k * 10 * MS, (0.1 * k, 0.0, 0.0), tuple(
        Rotation.from_euler('z', 0.02 * k).as_quat().tolist())) for k in range(3)]
    turns = Slerp([0, 10, 20], Rotation.from_quat([end.quaternion_xyzw for end in ends]))
    poses, fast = [], {}
    chain.add('rail', 'tool', along_x(-MS, 0.0))  # with which the way is known
    for k in range(21):
        if k % 10 == 0:
            chain.add('world', 'rail', ends[k // 10])
        fast[k * MS] = random_pose(rng, k * MS)
        chain.add('rail', 'tool', fast[k * MS])
        poses += chain.due()
    assert [pose.stamp_ns for pose in poses] == [k * MS for k in range(21)]
    for k, pose in enumerate(poses):
        rail = PoseSample(0, (0.01 * k, 0.0, 0.0), turns(k).as_quat())
        # Along the chord the turn is off by up to the cube of its angle over 125.
        assert_allclose(four(pose), four(rail) @ four(fast[k * MS]), atol=0.02**3 / 100)


def test_missing_parts_are_reported():
    chain = Chain('world', 'tool')
    assert "no transforms connect 'world' and 'tool'" in chain.missing
    chain.add('arm', 'tool', along_x(5 * MS, 0.0))
    assert "lead up to 'world' and 'arm'" in chain.missing
    assert not list(chain.due())
    chain.add('world', 'arm', along_x(0, 1.0), static=True)
    assert chain.missing == "no transform of 'tool' has come" and not list(chain.due())
    chain.add('world', 'arm', along_x(7 * MS, 1.0))
    chain.add('arm', 'tool', along_x(2007 * MS, 0.0))
    assert not list(chain.due())  # where the other end is at that time is not known
    assert chain.missing == "the transforms of 'arm' are 2 s behind those of 'tool'"
    still = Chain('world', 'tool')
    still.add('world', 'tool', along_x(0, 0.0), static=True)
    assert 'all transforms are static' in still.missing


def test_two_parents_in_turn_and_loops_yield_no_pose():
    chain = Chain('world', 'tool')
    chain.add('world', 'left', along_x(0, 1.0), static=True)
    chain.add('world', 'right', along_x(0, -1.0), static=True)
    chain.add('rail', 'tool', along_x(0, 0.0))
    for stamp in range(1, 6):
        chain.add(('left', 'right')[stamp % 2], 'rail', along_x(2 * stamp * MS, 0.0))
        chain.add('rail', 'tool', along_x((2 * stamp - 1) * MS, 0.0))
        assert not list(chain.due())  # between a rail on the left and one on the right is none
    for parent, child in (('a', 'tool'), ('b', 'a'), ('tool', 'b'), ('world', 'world')):
        chain.add(parent, child, along_x(MS, 0.0))
        assert not list(chain.due())
    assert "'world' and 'b'" in chain.missing


def test_a_clock_set_back_is_followed_and_a_repetition_left_out():
    chain, got = Chain('world', 'tool'), []
    for stamp in (5, 6, 6, 7, 3, 4):
        chain.add('world', 'tool', along_x(stamp * MS, 0.1 * stamp))
        got += [(pose.stamp_ns // MS, round(pose.position[0], 9)) for pose in chain.due()]
    assert got == [(5, 0.5), (6, 0.6), (7, 0.7), (3, 0.3), (4, 0.4)]


def test_memory_is_bounded_and_what_is_dropped_counted():
    chain = Chain('world', 'tool')
    chain.add('world', 'rail', along_x(MS, 0.0))
    for k in range(2, QUEUE_LENGTH + 52):
        chain.add('rail', 'tool', along_x(k * MS, 0.0))
        assert not list(chain.due())
    assert chain.dropped == 50
    for k in range(MAX_FRAMES + 10):
        chain.add('world', f'frame {k}', along_x(MS, 0.0))
    assert len(chain._parents) == MAX_FRAMES
