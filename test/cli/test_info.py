"""`bellows info` as a user runs it."""

import json
import re

from bellows_ros.files.parameter_files import read_parameters
import pytest

from .conftest import KNOWN
from ..files.test_detections import calibration, detections, recorded, views


def test_it_says_the_noise_and_which_axis_is_up(bellows, root):
    """Print what the choice of a method and of recording.world asks for; truth from the motion."""
    done = bellows('info', root / 'bags' / 'identification')
    found = re.search(r'/package/pose: noise of (.+) mm, (.+) deg', done.stdout)
    assert found, done.stdout
    for size, axes in zip((0.1, 0.0286), found.groups(), strict=True):
        assert [float(x) for x in axes.split()] == pytest.approx([size] * 3, rel=0.03)
    assert 'World    probably z up (recording.world: z_up).' in done.stdout


def test_the_parameter_file_serves_once_the_package_is_filled_in(
        bellows, succeed, workshop, tmp_path):
    """Lead from a recording to a cup without writing a topic's name."""
    file = tmp_path / 'my_cell.yaml'
    done = succeed('info', 'recording', '--write-params', file, cwd=workshop)
    assert f'--params {file}' in done.stdout
    again = ('info', 'recording', '--write-params', tmp_path / 'mine.yaml')
    (tmp_path / 'mine.yaml').write_text('filled in by hand')
    refused = bellows(*again, cwd=workshop)
    assert refused.returncode == 2 and '--force' in refused.stderr
    assert (tmp_path / 'mine.yaml').read_text() == 'filled in by hand'
    succeed(*again, '--force', cwd=workshop)
    assert (tmp_path / 'mine.yaml').read_text() == file.read_text()
    refused = bellows('identify', '--params', file, cwd=workshop)
    assert refused.returncode == 2 and 'package.mass' in refused.stderr

    file.write_text(re.sub(
        r'#((?:package|cup\.length|recording\.package_frame)[.\w]*): .*',
        lambda found: f'{found[1]}: {json.dumps(KNOWN[found[1]])}', file.read_text()))
    done = succeed('identify', '--params', file, '--set', 'fit.method=least_squares', '--out',
                   tmp_path / 'cup.yaml', cwd=workshop)
    assert read_parameters(tmp_path / 'cup.yaml')['cup.length'] == 0.046
    assert read_parameters(file)['topics.tool_pose'] == '/tool_arm/pose'


def test_a_parameter_of_its_advice_may_be_set(bellows, succeed, tmp_path):
    """Ask for the number of one of two tags, take it, and write it into the file."""
    path, file = tmp_path / 'b', tmp_path / 'cell.yaml'
    recorded(path, detections(views()[2] * 900.0 + 600.0, (3, 7)), calibration('plumb_bob', ()))
    assert '/detections cannot be used' in bellows('info', path).stdout
    (tmp_path / 'size.yaml').write_text('measured.tag_size: 0.06')
    done = succeed('info', path, '--params', tmp_path / 'size.yaml', '--set',
                   'measured.child_frame=36h11:7', '--write-params', file)
    assert 'cannot be used' not in done.stdout
    assert read_parameters(file)['measured.child_frame'] == '36h11:7'


def test_a_part_of_a_recording_is_looked_at(succeed, workshop, tmp_path):
    """Describe what lies between --from and --to, and write them down."""
    out = tmp_path / 'cell.yaml'
    span = ('--from', '1', '--to', '2.5')
    done = succeed('info', 'recording', *span, '--json', '-', '--write-params', str(out),
                   cwd=workshop)
    found = json.loads(done.stdout)
    assert all(1.4 < topic['duration_s'] <= 1.5 for topic in found['topics'] if topic['kind'])
    written = read_parameters(out)
    assert (written['recording.start'], written['recording.end']) == (1.0, 2.5)
