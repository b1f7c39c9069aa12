"""The commands identify, plan, toss, parameters, info and replay: what they print and write."""

import importlib.util
import json
from pathlib import Path
import re
import shlex

from bellows_ros.core.identification import estimate
from bellows_ros.core.parameters.checks import RECORDING_PARAMETERS, resolve
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.files.bags import read_streams, topics
from bellows_ros.files.parameter_files import read_parameters
import numpy as np
import pytest

from .conftest import contents, KNOWN, TRUTH, write_yaml
from ..files.test_detections import calibration, detections, recorded, views

GRIP = ('--set', 'cup.lip_radius=0.025', '--set', 'vacuum.holding=60000',
        '--set', 'package.mass_std=0.01')


def test_says_writes_and_draws(bellows, succeed, workshop, transport, tmp_path):
    """Say in words what stands in the JSON; write picture and recording."""
    done = succeed(
        'plan', transport, '--params', workshop / 'cup.yaml', *GRIP, '--fastest', '--json',
        'plan.json', '--plot', 'plan.png', '--out', 'predicted', cwd=tmp_path)
    found = json.loads((tmp_path / 'plan.json').read_text())
    for name in ('smallest_safety_factor', 'peak_bending', 'peak_deflection', 'peak_force',
                 'peak_moment', 'swing_left', 'settled_after', 'duration',
                 'smallest_safety_time', 'fastest_scale'):
        assert found[name] > 0.0 and found[f'{name}_std'] >= 0.0, name
    assert found['smallest_safety_mode'] == 'peel' and found['outside_validity'] == []
    assert f'{found["smallest_safety_factor"]:.2f}' in done.stdout
    assert 'as planned' in done.stdout and 'Wrote predicted.' in done.stdout
    assert (tmp_path / 'plan.png').read_bytes().startswith(b'\x89PNG')
    assert {t.name for t in topics(tmp_path / 'predicted')} >= {
        '/tool_arm/plan', '/package/plan', '/package/plan_path', '/package/pose'}
    before = contents(tmp_path)
    done = bellows('plan', transport, '--params', workshop / 'cup.yaml', '--out', 'predicted',
                   '--json', 'other.json', cwd=tmp_path)
    assert done.returncode == 2 and '--force' in done.stderr
    assert contents(tmp_path) == before


def test_a_cup_that_lets_go_is_a_no(bellows, workshop, transport):
    """End with 1; never say that the grip holds where the data are doubtful."""
    line = ('plan', transport, '--params', workshop / 'cup.yaml', '--set', 'cup.lip_radius=0.03')
    weak = bellows(*line, '--set', 'vacuum.holding=15000')
    assert weak.returncode == 1 and 'lets go' in ' '.join(weak.stderr.split())
    above = bellows(*line, '--set', 'vacuum.holding=60000', '--set', 'package.com=0,0,0.03')
    assert 'above the lip' in ' '.join(above.stderr.split())
    assert 'The grip holds' not in above.stdout


BAGS = Path(__file__).parents[2] / 'bags'
PLAN, PARAMS = BAGS / 'throw.yaml', BAGS / 'tossing.yaml'


def test_toss_prints_draws_and_writes_the_landing(succeed, tmp_path):
    """Held, parting and flying: the package leaves the cup, and falls to where it lands."""
    file, picture, bag = (tmp_path / name for name in ('toss.json', 'toss.png', 'thrown'))
    done = succeed('toss', PLAN, '--params', PARAMS, '--release', 3.0, '--json', file, '--plot',
                   picture, '--out', bag)
    found = json.loads(file.read_text())
    assert found['release_mode'] == 'peel'
    assert 3.012 < found['release_time'] < found['landing_time'] < 4.0
    assert set(found['budget'][0]) == {'name', 'std', 'contribution_mm', 'contribution_deg'}
    assert 'Reduce first: release,' in done.stdout
    assert picture.stat().st_size > 20_000
    poses = read_streams(bag, {'package_pose': '/package/pose'})['package_pose']
    seconds = (poses.stamps_ns - poses.stamps_ns[0]) * 1e-9
    assert seconds[-1] == pytest.approx(found['landing_time'], abs=2.1e-3)
    speed = np.linalg.norm(found['landing_twist'][:3])
    miss = np.linalg.norm(poses.position[-1] - found['landing_position'])
    assert miss < 2.1e-3 * speed
    at = np.searchsorted(seconds, found['release_time'])
    np.testing.assert_allclose(poses.position[at], found['release_pose'][:3], atol=6e-3)


def test_a_target_out_of_reach_is_a_no(bellows):
    far = bellows('toss', PLAN, '--params', PARAMS, '--target', 100.0, 0.0)
    assert far.returncode == 1
    assert 'No release of this plan lands at the target' in ' '.join(far.stderr.split())


def test_names_choose(bellows):
    """Show only those whose names begin as asked for."""
    done = bellows('parameters', 'vacuum.t', 'gravity')
    names = [line for line in done.stdout.splitlines() if not line.startswith(' ')]
    assert names == ['gravity.magnitude', 'gravity.direction', 'vacuum.thresholds']


def test_the_template_is_a_parameter_file_to_fill_in(bellows, tmp_path):
    """Read the defaults; then make it complete by removing the comment signs, as it says."""
    file = tmp_path / 'all.yaml'
    names = ('bags', *RECORDING_PARAMETERS)
    text = bellows('parameters', '--yaml').stdout
    file.write_text(text)
    assert read_parameters(file) == {
        p.name: p.default for p in PARAMETERS.values() if p.default not in (None, ())
    }
    for name in names:
        assert f'    #{name}: ' in text
        text = text.replace(f'    #{name}: ', f'    {name}: ')
    file.write_text(text)
    assert list(resolve(read_parameters(file), names)) == list(PARAMETERS)


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


@pytest.mark.parametrize(('name', 'value', 'size'), [
    ('package.com', [0.0028, -0.0028, -0.03], 4.0),
    ('package.inertia', [1.15 * x for x in KNOWN['package.inertia']], 13.0),
    ('cup.length', 0.048, 2.0)])
def test_a_changed_quantity_is_said_and_the_printed_commands_are_right_with_it(
        bellows, succeed, workshop, tmp_path, name, value, size):
    """Run the printed commands as printed, for the recording itself."""
    write_yaml(tmp_path / 'wrong.yaml', {**KNOWN, name: value})
    recording = workshop / 'recording'
    done = succeed('identify', recording, '--params', 'wrong.yaml', '--out', 'a cup.yaml',
                   '--json', 'found.json', cwd=tmp_path)
    found = json.loads((tmp_path / 'found.json').read_text())
    said, = (each for each in found['findings'] if each['code'] == 'off_given')
    assert said['topic'] == name and said['text'] in ' '.join(done.stdout.split())
    assert float(said['numbers']['off'].split()[0]) == pytest.approx(size, rel=0.1)
    plain = bellows('replay', recording, '--params', 'wrong.yaml', '--params', 'a cup.yaml',
                    cwd=tmp_path)
    if name == 'package.com':  # the replay without the cell file has the cause of its error
        said, = re.findall(r'package.com: (\[.*?\])', plain.stderr)
        assert plain.returncode == 1
        assert json.loads(said) == pytest.approx(KNOWN['package.com'], abs=2e-4)
    commands = [shlex.split(line)[1:] for line in done.stdout.splitlines()
                if line.startswith('  bellows ')]
    assert ('a cup_cell.yaml' in commands[-1]) == (name != 'cup.length')
    for command in commands:
        words = [str(recording) if word == 'BAG' else word for word in command]
        succeed(*words, cwd=tmp_path)
    replay = json.loads(succeed(*words, '--json', '-', cwd=tmp_path).stdout)
    assert max(replay['rms'][:3]) < 1.2 * 2e-5


def test_a_parameter_of_its_advice_may_be_set(bellows, succeed, tmp_path):
    """Ask for the number of one of two tags, take it, and write it into the file."""
    path, file = tmp_path / 'b', tmp_path / 'cell.yaml'
    recorded(path, detections(views()[2] * 900.0 + 600.0, (3, 7)), calibration('plumb_bob', ()))
    wrong = bellows('info', path, '--write-params', tmp_path / 'half.yaml').stdout
    assert '/detections cannot be used' in wrong and 'lacks topics.package_pose' in wrong
    assert 'bellows identify' not in wrong and '--force --set NAME=VALUE' in wrong
    (tmp_path / 'size.yaml').write_text('measured.tag_size: 0.06')
    done = succeed('info', path, '--params', tmp_path / 'size.yaml', '--set',
                   'measured.child_frame=36h11:7', '--write-params', file)
    assert 'cannot be used' not in done.stdout
    assert read_parameters(file)['measured.child_frame'] == '36h11:7'


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
        assert re.search(r'(?s)recording: the delay of.{0,120}was\s+estimated: ', text)
    content = json.loads(done.stdout)
    assert content['provenance']['parameter_files'][0]['path'] == 'cup.yaml'
    assert page.read_text().startswith('<!DOCTYPE html>')


def test_parameters_from_several_places(succeed, workshop, tmp_path):
    """Take later files over earlier ones, --set over files, and bags from a file."""
    more = tmp_path / 'more.yaml'
    more.write_text(
        f"identifier:\n  ros__parameters:\n    bags: ['{workshop / 'recording'}']\n"
        '    package.mass: 99.0\n    fit: {structure: axisymmetric}\n')
    done = succeed(
        'identify', '--params', workshop / 'package.yaml', '--params', more,
        '--set', 'fit.structure=full', '--set', 'package.mass=1.8', '--json', '-')
    fit = json.loads(done.stdout)
    assert fit['structure'] == 'full'
    np.testing.assert_allclose(  # 21 unknowns from 8 s
        np.diag(fit['stiffness']), TRUTH['cup.stiffness'][::7], rtol=0.2)
    assert 'K in N/m, N and N m/rad:' in done.stderr


def test_a_page_without_matplotlib_is_refused_before_any_work(bellows, root, monkeypatch):
    """Say how to install it, before the recording is found to be missing."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec',
                        lambda name, *rest: None if name == 'matplotlib' else find(name, *rest))
    for command, params in (('identify', 'package.yaml'), ('replay', 'cup.yaml')):
        done = bellows(command, 'none', '--params', f'bags/{params}', '--report', 'x.html',
                       cwd=root)
        assert done.returncode == 2 and 'pip install matplotlib' in ' '.join(done.stderr.split())


def test_a_search_that_does_not_end_gives_no_cup(bellows, root, tmp_path, monkeypatch):
    """End with 1, without standard errors and without a cup file."""
    monkeypatch.setattr(estimate, 'MAX_STEPS', (2, 2))
    monkeypatch.setattr(estimate, 'LOOSE_TOLERANCE', 0.0)
    cup, fit = tmp_path / 'cup.yaml', tmp_path / 'fit.json'
    done = bellows('identify', 'bags/validation', '--params', 'bags/package.yaml', '--to', '6',
                   '--out', cup, '--json', fit, cwd=root)
    content = json.loads(fit.read_text())
    assert done.returncode == 1 and 'did not converge' in ' '.join(done.stderr.split())
    assert 'No cup identified' in done.stdout
    assert not content['converged'] and not content['usable'] and not cup.exists()
    assert all(content['stiffness_std'][i][i] is None for i in range(6))
