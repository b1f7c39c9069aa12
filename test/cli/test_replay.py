"""`bellows replay`: how well a cup predicts a recording, and what that says of the cup."""

import json
import re

from bellows_ros.core.signals.residuals import AXES
import pytest

NOISE = {'mm': 0.02, 'deg': 0.0057}  # of the package's poses in the recording


@pytest.fixture(scope='module')
def replayed(quietly, workshop, tmp_path_factory):
    """Replay once with the true cup; give the summary and the JSON."""
    file = tmp_path_factory.mktemp('replayed') / 'replay.json'
    done = quietly('replay', 'recording', '--params', 'cup.yaml', '--json', file, cwd=workshop)
    return done.stdout, json.loads(file.read_text())


def test_the_true_cup_predicts_to_the_noise(replayed):
    """Print errors per axis, with units, that are little more than the noise."""
    rows = [line.split() for line in replayed[0].splitlines()]
    errors = {row[0]: row[1:] for row in rows if row and row[0] in AXES}
    assert len(errors) == 6
    for axis, (unit, rms, live, of_noise, peak, percent, sign) in errors.items():
        assert (unit, sign[0]) == ('deg' if axis.startswith('r') else 'mm', '%')
        noise = NOISE[unit]
        # that of the tool's poses, to whose axes the package is taken, comes on top
        assert 0.5 * noise < float(rms) < 2.0 * noise
        assert float(rms) < float(peak) and float(percent) > 0.0
        assert 0.9 * float(rms) < float(live) < 1.1 * float(rms)
        assert 0.5 * noise < float(of_noise) < 2.0 * noise


def test_a_wrong_cup_exits_with_1(bellows, workshop):
    """Tell scripts; also without a limit, where it is several times worse than noise."""
    arguments = ('replay', 'recording', '--params', 'package.yaml')
    done = bellows(*arguments, '--limit', '5', cwd=workshop)
    assert done.returncode == 1
    assert '5 %' in done.stdout and 'cup.stiffness' in done.stderr
    assert bellows(*arguments, cwd=workshop).returncode == 1


def test_a_time_offset_is_printed_and_json_and_page_are_written(succeed, workshop, tmp_path):
    """Say what was taken from the tool's stamps, on the screen and the page; JSON on stdout."""
    page = tmp_path / 'page.html'
    done = succeed('replay', 'recording', '--params', 'cup.yaml', '--set',
                   'fit.free=[time_offset]', '--report', page, '--json', '-', cwd=workshop)
    for text in (done.stderr, page.read_text()):
        assert re.search(
            r'recording: a \w+ stamp is 0\.0\d\d ms .* later than the \w+ stamp', text)
    content = json.loads(done.stdout)
    assert content['provenance']['parameter_files'][0]['path'] == 'cup.yaml'
    assert page.read_text().startswith('<!DOCTYPE html>')


@pytest.mark.parametrize(('changes', 'named', 'code'), [
    (('package.mass=3.6',), r'package.mass.* 1\.[789] kg', 1),
    (('package.mass=180.0',), r' 1\.[789] kg.* package.mass', 2),
    (('topics.tool_pose=/package/pose', 'topics.package_pose=/tool_arm/pose',
      'topics.tool_twist='), '^bellows: The topics are exchanged', 2),
    (('topics.package_pose=/tool_arm/pose',), '^bellows: The package does not swing', 2),
])
def test_a_bad_prediction_is_a_no_and_names_its_cause(changes, named, code, bellows, workshop):
    """End with 1 where errors are several times those of noise, 2 where data cannot be used."""
    done = bellows('replay', 'recording', '--params', 'cup.yaml',
                   *(part for change in changes for part in ('--set', change)), cwd=workshop)
    assert done.returncode == code
    assert re.search(named, ' '.join(done.stderr.split()))
