"""`bellows convert` as a user runs it."""

import re
import shlex

from bellows_ros.core.geometry.lie import rotation_to_quaternion
from bellows_ros.files.bag_writer import as_messages, write_bag
from bellows_ros.files.bags import read_streams
import numpy as np


def test_a_recording_survives_a_round_trip_through_text(succeed, quietly, workshop, tmp_path):
    """Write both bodies as TUM, and make a recording of them."""
    for name, topic in (('tool', '/tool_arm/pose'), ('box', '/package/pose')):
        done = quietly('convert', 'recording', '--topic', topic, '--out', tmp_path / f'{name}.tum',
                       cwd=workshop)
    done = succeed('convert', 'tool.tum', 'box.tum', '--out', 'bag', cwd=tmp_path)
    assert '/box/pose' in done.stdout


def test_millimetres_and_w_first_are_named_and_converted_as_the_sentence_says(
    bellows, succeed, workshop, tmp_path
):
    """Follow the command that `info`, `identify` and `replay` print; then the cup predicts."""
    topics = {'tool': '/tool_arm/pose', 'package': '/package/pose'}
    write_bag(tmp_path / 'raw', [
        as_messages(own.name, 'geometry_msgs/msg/PoseStamped', own.stamps_ns, np.hstack([
            1e3 * own.position, np.roll(rotation_to_quaternion(own.rotation), 1, axis=1)]),
            own.frame_id) for own in read_streams(workshop / 'recording', topics).values()])
    given = ('--params', workshop / 'package.yaml', '--set', 'topics.tool_twist=')
    with_cup = (*given, '--params', workshop / 'cup.yaml')
    said = [bellows(*command, cwd=tmp_path) for command in (
        ('info', 'raw'), ('identify', 'raw', *given), ('replay', 'raw', *with_cup))]
    assert [done.returncode for done in said] == [0, 2, 2]
    assert "'bellows convert raw" in ' '.join(said[0].stdout.split())
    for done in said[1:]:
        words = ' '.join(done.stderr.split())
        assert 'are in millimetres' in words and 'are of quaternions with w first' in words
    command = re.search(r"'bellows (convert [^']*)'", ' '.join(said[1].stderr.split()))
    assert command and bellows(*shlex.split(command[1]), cwd=tmp_path).returncode == 0
    done = succeed('replay', 'raw_converted', *with_cup, cwd=tmp_path)


def test_poses_are_converted_for_any_topic_name(bellows, succeed, tmp_path):
    """Convert poses on a topic whose name ends as those of twists do; no twists of that name."""
    poses = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    stamps_ns = 1_000_000_000 * np.arange(1, 4)
    for kind, values in (('Pose', poses), ('Twist', poses[:, :6])):
        write_bag(tmp_path / kind, [as_messages(
            '/arm_twist', f'geometry_msgs/msg/{kind}Stamped', stamps_ns, values, 'world')])
    done = succeed('convert', 'Pose', '--unit', 'mm', '--out', 'm', cwd=tmp_path)
    pose = read_streams(tmp_path / 'm', {'pose': '/arm_twist'})['pose']
    np.testing.assert_allclose(pose.position, 1e-3 * poses[:, :3])
    done = bellows('convert', 'Twist', '--unit', 'mm', '--topic', 'arm_twist', '--out', 't',
                   cwd=tmp_path)
    assert done.returncode == 2 and "'/arm_twist'" in done.stderr and 'the topic' in done.stderr
