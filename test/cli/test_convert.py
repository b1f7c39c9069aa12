"""`bellows convert` as a user runs it."""

from ..files.test_trajectory_files import export


def test_a_take_becomes_a_recording(succeed, bellows, tmp_path):
    """Say the topics, the omitted frames, the world and the next step; replace only if asked."""
    command = 'convert', export(tmp_path / 'take.csv'), '--out', tmp_path / 'bag'
    said = ' '.join(succeed(*command).stdout.split())
    for words in ('/tool/pose: 3 poses of', 'left out: 1 too few markers',
                  'set recording.world to motive_y_up', 'bellows info'):
        assert words in said
    assert bellows(*command).returncode == 2
    succeed(*command, '--force')
