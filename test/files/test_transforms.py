"""Poses out of transforms: trees of frames with links of several rates."""

from bellows_ros.core.geometry.lie import exp_se3, inverse_transform, rotation_to_quaternion
from bellows_ros.errors import BellowsError, NoTopicError
from bellows_ros.files.bag_writer import Encoded, write_bag
from bellows_ros.files.bags import read_streams
from bellows_ros.files.detections import read_contents, TagSought
from bellows_ros.files.plans import poses_in, read_transforms, TF
from bellows_ros.workflows.convert import bodies_in_transforms, to_bag
import numpy as np
from numpy.testing import assert_allclose
import pytest

from . import recordings as made

T0 = 1_700_000_000_000_000_000
MOUNT = exp_se3(np.array([0.1, -0.2, 0.3, 0.3, 0.1, -0.4]))
FLANGE = exp_se3(np.array([0.0, 0.0, 0.12, 0.0, 0.5, 0.0]))
CAMERA = exp_se3(np.array([1.0, 0.4, 1.5, 2.0, 0.3, 0.1]))


def base_in_rail(s):
    return exp_se3(np.array([0.2 * s, 0.0, 0.0, 0.0, 0.0, 0.0]))


def flange_in_base(s):
    return exp_se3(np.array([0.3, 0.1 * s, 0.2, 0.1 * s, 0.0, 0.2 * s]))


def box_in_camera(s):
    return exp_se3(np.array([0.1 * s, 0.05, 0.6, 0.0, 0.3 * s, 0.0]))


def message(parent, child, T, ns):
    pose = T[:3, 3], rotation_to_quaternion(T[:3, :3])
    return made.serialized(TF, [[(made.header(ns, parent), child, pose)]])


def recording(folder, more=(), topics=(), static='/tf_static'):
    """Write a rail (20 Hz), an arm (100 Hz) on it, and a camera that sees a box (60 Hz)."""
    moving = [
        (T0 + round(k / rate * 1e9), parent, child, pose(k / rate))
        for rate, parent, child, pose in ((20, 'rail', 'base', base_in_rail),
                                          (100, 'base', '/flange', flange_in_base),
                                          (60, 'camera', 'box', box_in_camera))
        for k in range(2 * rate + 1)]
    moving += more
    moving.sort(key=lambda each: each[0])
    fixed = [('hall', 'rail', MOUNT), ('flange', 'tool', FLANGE), ('hall', 'camera', CAMERA)]
    write_bag(folder, [
        Encoded(static, TF, np.full(3, T0), [message(*each, 0) for each in fixed]),
        Encoded('/tf', TF, np.array([each[0] for each in moving]), [
            message(parent, child, T, ns) for ns, parent, child, T in moving]), *topics])
    return folder


def test_both_bodies_are_found_in_the_world(tmp_path):
    with pytest.raises(NoTopicError, match='bellows convert .* --tool-frame FRAME'):
        read_streams(recording(tmp_path / 'only'), {'a': '/tool_arm/pose'})
    found = bodies_in_transforms(recording(tmp_path / 'tf'), 'tool', 'box')
    done = to_bag(found, tmp_path / 'out')
    assert [(b.topic, b.poses) for b in done.bodies] == [
        ('/tool_arm/pose', 201), ('/package/pose', 121)]
    found = read_streams(tmp_path / 'out', {'a': '/tool_arm/pose', 'b': '/package/pose'})
    assert found['a'].frame_id == found['b'].frame_id == 'hall'
    for role, pose in (
        ('a', lambda s: MOUNT @ base_in_rail(s) @ flange_in_base(s) @ FLANGE),
        ('b', lambda s: CAMERA @ box_in_camera(s)),
    ):
        s = (found[role].stamps_ns - T0) * 1e-9
        expected = np.array([pose(each) for each in s])
        assert_allclose(found[role].position, expected[:, :3, 3], atol=1e-8)
        assert_allclose(found[role].rotation, expected[:, :3, :3], atol=1e-8)


def test_what_interpolation_costs_is_stated(tmp_path, monkeypatch):
    """Of a base that moves by 20 mm at 1 Hz and comes at 20 Hz, against the true poses."""
    def moving(s):
        return exp_se3(np.array([0.02 * np.sin(2.0 * np.pi * s), 0.0, 0.0, 0.0, 0.0, 0.0]))

    monkeypatch.setitem(globals(), 'base_in_rail', moving)
    done = to_bag(bodies_in_transforms(
        recording(tmp_path / 'tf'), 'tool', 'box'), tmp_path / 'out')
    tool = read_streams(tmp_path / 'out', {'a': '/tool_arm/pose'})['a']
    s = (tool.stamps_ns - T0) * 1e-9
    true = np.array([(MOUNT @ moving(x) @ flange_in_base(x) @ FLANGE)[:3, 3] for x in s])
    error = float(np.sqrt(np.mean(np.sum((tool.position - true)**2, axis=1))))
    (note,) = done.notes
    stated = float(note.partition('an error of ')[2].split()[0])
    assert "'base' comes at 20 Hz" in note and abs(stated - 1e3 * error) < 0.2e3 * error


def test_the_world_may_be_any_frame(tmp_path):
    links = read_transforms(recording(tmp_path / 'tf', static='/robot/tf_static'))
    stamps, poses, world, bad = poses_in(links, '/box', 'tool', 'it')
    s = (stamps - T0) * 1e-9
    expected = [inverse_transform(MOUNT @ base_in_rail(x) @ flange_in_base(x) @ FLANGE)
                @ CAMERA @ box_in_camera(x) for x in s]
    assert world == 'tool' and len(s) == 121 and not bad  # the box's
    assert_allclose(poses[:, :3], np.array(expected)[:, :3, 3], atol=1e-4)


def test_missing_parts_are_reported(tmp_path):
    links = read_transforms(recording(tmp_path / 'tf', [(T0 + 5, 'elsewhere', 'lone', CAMERA)]))
    for frame, world, named in (
        ('tol', '', "'tol'.* base, box, camera"), ('tool', 'elsewhere', "'elsewhere'.*'hall'"),
        ('camera', 'rail', "'camera'.*'rail'"),
    ):
        with pytest.raises(BellowsError, match=named):
            poses_in(links, frame, world, 'it')
    two = read_transforms(recording(tmp_path / 'two', [(T0 + 5, 'tool', 'box', CAMERA)]))
    with pytest.raises(BellowsError, match="'box' has two parents"):
        poses_in(two, 'box', 'tool', 'it')
    with pytest.raises(BellowsError, match="'tool'"):
        bodies_in_transforms(tmp_path / 'tf', 'tool', '/tool')


def test_a_frame_with_two_parents_off_the_path_is_allowed(tmp_path):
    """Two cameras see another tag, and the arm's base has a second parent above both bodies."""
    more = [(T0 + 5, 'camera', 'other', CAMERA), (T0 + 6, 'side_camera', 'other', CAMERA),
            (T0 + 7, 'map', 'hall', CAMERA), (T0 + 8, 'odom', 'hall', CAMERA)]
    links = read_transforms(recording(tmp_path / 'tf', more))
    plain = read_transforms(recording(tmp_path / 'plain'))
    for frame in ('box', 'tool'):
        assert_allclose(poses_in(links, frame, 'hall', 'it')[1],
                        poses_in(plain, frame, 'hall', 'it')[1])
    with pytest.raises(BellowsError, match="'hall' has two parents.*'map' and 'odom'"):
        poses_in(links, 'box', '', 'it')


@pytest.mark.parametrize('world, worlds', [
    ('', ('hall', 'lens')), ('hall', ('hall', 'lens')), ('lens', ('hall', 'lens'))])
def test_bodies_in_two_trees_keep_their_worlds(tmp_path, world, worlds):
    """A tag in its camera alone, and an arm."""
    tag = [(T0 + k * 10**7, 'lens', 'tag', box_in_camera(0.01 * k)) for k in range(100)]
    folder = recording(tmp_path / 'tf', tag)
    tool, box = bodies_in_transforms(folder, 'tool', 'tag', world)
    done = to_bag([tool, box], tmp_path / 'out')
    found = read_streams(tmp_path / 'out', {'t': '/tool_arm/pose', 'p': '/package/pose'})
    assert (found['t'].frame_id, found['p'].frame_id) == worlds and len(done.bodies) == 2
    with pytest.raises(BellowsError, match="'nowhere'"):
        bodies_in_transforms(folder, 'tool', 'tag', 'nowhere')


def test_circles_and_invalid_poses_are_reported(tmp_path):
    nothing = CAMERA.copy()
    nothing[0, 3] = np.nan
    folder = recording(tmp_path / 'tf', [
        (T0 + 5, 'b', 'a', CAMERA), (T0 + 6, 'c', 'b', CAMERA), (T0 + 7, 'a', 'c', CAMERA),
        (T0 + 8, 'hall', 'lost', nothing), (T0 + 10**9 + 5, 'camera', 'box', nothing)])
    links = read_transforms(folder)
    with pytest.raises(BellowsError, match="'a'.*'b'"):
        poses_in(links, 'a', '', 'it')
    with pytest.raises(BellowsError, match="'lost'.*'hall'"):
        poses_in(links, 'tool', 'lost', 'it')
    done = to_bag(bodies_in_transforms(folder, 'tool', 'box'), tmp_path / 'out')
    assert [b.left_out for b in done.bodies] == [{}, {'transforms that are no poses': 1}]


@pytest.mark.skipif(TF not in made.TYPES.types, reason='this rosbags does not know tf2_msgs')
def test_damaged_transforms_are_an_error(tmp_path):
    for damaged in (b'', b'\0\1\0\0', b'\0\1\0\0' + b'\xff' * 12):
        write_bag(
            tmp_path / 'bag', [Encoded('/tf', TF, np.array([10**18]), [damaged])], replace=True)
        with pytest.raises(BellowsError):
            read_transforms(tmp_path / 'bag')


def test_a_tag_on_tf_alone_is_read_in_the_frame_of_its_camera(tmp_path):
    """As measured.type: tf reads it, also where another tag has two parents."""
    more = [(T0 + 5, 'camera', 'other', CAMERA), (T0 + 6, 'side_camera', 'other', CAMERA)]
    folder = recording(tmp_path / 'tf', more)
    found = read_contents(folder, {'package_pose': '/tf'}, TagSought(child_frame='/box'))
    stream = found.streams['package_pose']
    expected = np.array([box_in_camera(s) for s in (stream.stamps_ns - T0) * 1e-9])
    assert stream.frame_id == 'camera' and len(stream) == 121 and not found.problems
    assert_allclose(stream.position, expected[:, :3, 3], atol=1e-9)
    assert_allclose(stream.rotation, expected[:, :3, :3], atol=1e-9)
    for child, named in (('other', 'camera, side_camera'), ('tag', 'base, box, flange')):
        problem = read_contents(
            folder, {'package_pose': 'tf'}, TagSought(child_frame=child)).problems['package_pose']
        assert named in str(problem) and 'measured.child_frame' in str(problem)
