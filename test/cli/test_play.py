"""`bellows play`: a recording to ROS, as a process of its own."""

import importlib.util
import json

import pytest

needs_ros = pytest.mark.skipif(
    importlib.util.find_spec('rclpy') is None, reason="no rclpy here (pip install '.[ros]')")


@needs_ros
def test_played_messages_are_printed(succeed, workshop, tmp_path):
    """Count the messages of each topic between two times, and warn where nobody listens."""
    done = succeed(
        'play', 'recording', '--topic', '/tool_arm/pose:=/pose', '--rate', 8, '--from', 2, '--to',
        6, '--json', tmp_path / 'played.json', cwd=workshop)
    content = json.loads((tmp_path / 'played.json').read_text())
    assert content['messages'] == {'/pose': 1201} and content['duration'] == 0.5
    assert '/pose  1201 messages' in done.stdout
    assert 'Warning: No subscriber was connected' in done.stderr


@needs_ros
def test_what_cannot_be_played_is_refused(bellows, workshop):
    """Name topics that are there, and speeds that may be."""
    done = bellows('play', 'recording', '--topic', '/x', cwd=workshop)
    assert done.returncode == 2 and '/package/pose (geometry_msgs' in done.stderr
    for rate in ('0', '-1', 'nan', 'inf'):
        done = bellows('play', 'recording', '--rate', rate, cwd=workshop)
        assert done.returncode == 2 and '--rate' in done.stderr


def test_missing_ros_is_reported_with_the_remedy(bellows, workshop, tmp_path):
    """End with 2, and name both ways."""
    (tmp_path / 'sitecustomize.py').write_text(
        'import importlib.util as u\nfind = u.find_spec\n'
        "u.find_spec = lambda name, *rest: None if name == 'rclpy' else find(name, *rest)\n")
    done = bellows('play', 'recording', cwd=workshop, PYTHONPATH=str(tmp_path))
    assert done.returncode == 2 and 'rclpy' in done.stderr
