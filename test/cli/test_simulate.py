"""`bellows simulate`: recordings of a known cup."""

import json

from bellows_ros.files.bags import topics

from .conftest import MOTION


def test_the_recording_holds_what_was_reported(bellows, workshop, tmp_path):
    """Count the messages in the recording, in the summary and in JSON alike."""
    done = bellows(
        'simulate', '--params', workshop / 'cup.yaml', '--motion', workshop / 'motion.yaml',
        '--out', tmp_path / 'new', '--json', '-',
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report['duration_s'] == MOTION['duration']
    assert report['messages'] == {t.name: t.messages for t in topics(tmp_path / 'new')}
    for topic, count in report['messages'].items():
        assert topic in done.stderr and str(count) in done.stderr
    assert '1 dropouts' not in done.stderr and '1 dropout' in done.stderr
