"""The short form of all measurements runs, without a word on how long it took."""

from importlib.util import find_spec
import json

import bellows_ros
from bellows_ros.bench import batch, live, timing
from bellows_ros.bench.page import renewed
from bellows_ros.bench.run import run, SECTIONS
from bellows_ros.bench.tables import columns, markdown, missing, tables
from bellows_ros.cli import main
from bellows_ros.core.jit import COMPILED
from bellows_ros.errors import BellowsError
from bellows_ros.files.results import format_json
import pytest

NEEDED = {'node': ('rclpy',), 'batch': ('joblib',)}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize('section', SECTIONS)
def test_short_form_measures_and_shows(section):
    if not COMPILED and section in ('offline', 'batch'):
        pytest.skip('numba is not installed: measuring this takes minutes interpreted')
    found = json.loads(format_json(run([section], short=True)))
    assert set(found) == {'machine', 'short', section}
    made, left_out = tables(found), missing(found)
    assert bool(made) != bool(left_out)
    for module in NEEDED.get(section, ()):
        assert (section in left_out) == (find_spec(module) is None)
    for table in made.values():
        assert len({len(row) for row in table}) == 1
        assert all(len(line) for line in columns(table))


def test_steps_are_measured_from_the_shell(tmp_path, capsys):
    out = tmp_path / 'bench.json'
    assert main(['bench', '--short', '--only', 'step', '--json', str(out)]) == 0
    steps = json.loads(out.read_text())['step']['seconds_per_step']
    assert all(0.0 < figures['lowest'] <= figures['median'] for figures in steps.values())
    assert 'one step' in capsys.readouterr().out
    page = tmp_path / 'page.md'
    page.write_text('a\n<!-- bench: step -->\nold\n<!-- end -->\nb\n')
    assert main(['bench', '--from', str(out), '--page', str(page)]) == 0
    text = page.read_text()
    assert text.startswith('a\n<!-- bench: step -->\n| one step |')
    assert text.endswith('|\n<!-- end -->\nb\n')


def test_unknown_section(capsys):
    assert main(['bench', '--only', 'stp']) == 2
    assert "There is no section 'stp'" in capsys.readouterr().err


def test_what_is_missing_is_said(tmp_path, capsys):
    file = tmp_path / 'bench.json'
    file.write_text('{"machine": {}, "batch": {"missing": "joblib is not installed"}}')
    assert main(['bench', '--from', str(file)]) == 0
    said = ''.join(capsys.readouterr())
    assert "Section 'batch' was not measured: joblib is not installed" in said


def test_figures_of_another_version_are_refused(tmp_path, capsys):
    file = tmp_path / 'bench.json'
    file.write_text('{"machine": {}, "batch": {"recordings": 24, "seconds_one_job": 5.0}}')
    assert main(['bench', '--from', str(file)]) == 2
    assert "Section 'batch' was measured by another version" in capsys.readouterr().err


@pytest.mark.skipif(find_spec('joblib') is None, reason='joblib is not installed')
def test_a_measurement_that_fails_is_not_called_missing(monkeypatch):
    monkeypatch.setattr(batch, '_recordings', lambda folder, duration, count: [])
    monkeypatch.setattr(batch, 'MANY', 'raise SystemExit("boom")')
    with pytest.raises(BellowsError, match='boom'):
        batch.run(short=True)


def test_page_keeps_what_was_not_measured():
    page = '<!-- bench: node -->\nkept\n<!-- end -->'
    machine = {'date': '', 'cores': 1, 'processor': '', 'load': 0.0, 'system': '', 'python': '',
               'versions': {}}
    assert renewed(page, {'machine': machine}) == page
    with pytest.raises(BellowsError, match='bench: NAME'):
        renewed('nothing', {'machine': machine})


def test_interleaved_takes_turns():
    order = []

    def work(name):
        order.append(name)
        return 2

    found = timing.interleaved({'a': lambda: work('a'), 'b': lambda: work('b')}, 2)
    assert order == ['a', 'b', 'a', 'b', 'a', 'b']
    assert found['a']['runs'] == 2


def test_failed_process_is_said():
    with pytest.raises(BellowsError, match='boom'):
        timing.in_process('raise SystemExit("boom")')


def test_process_finds_what_the_shell_does(tmp_path, monkeypatch):
    (tmp_path / 'from_the_shell.py').write_text('')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    code = 'import json, from_the_shell, bellows_ros; print(json.dumps(bellows_ros.__file__))'
    assert timing.in_process(code) == bellows_ros.__file__


@pytest.mark.parametrize(('with_ros', 'word'), [(True, 'with'), (False, 'without')])
def test_start_says_whether_ros_was_there(with_ros, word):
    figures = timing.figures([0.5])
    section = {'help': figures, 'predictor_warm': figures, 'predictor_cold': figures,
               'with_ros': with_ros}  # fmt: skip
    names = [row[0] for row in tables({'startup': section})['startup']]
    assert names[2:] == [f'predictor ready {word} ROS, compiled before',
                         f'predictor ready {word} ROS, nothing compiled']  # fmt: skip


def test_replay_is_shown_whole_and_without_reading():
    figures = timing.figures
    section = {
        'recording': {'seconds': 600.0, 'messages': 3}, 'plain_loop': figures([3.0]),
        'least_squares': figures([6.0]), 'peak_plain_loop': 2**20, 'peak_least_squares': 2**21,
        'replay': figures([6.0, 8.0, 9.0]), 'replay_factor': figures([150.0]),
        'peak_replay': 2**22, 'prediction_error': figures([3.0, 4.0]),
        'prediction_error_recorded': 35.0, 'filter': {}}  # fmt: skip
    rows = tables({'offline': section})['offline']
    assert rows[-3:] == [
        ('bellows replay, the whole command', '8 s, 75 times real time', '4 MiB'),
        ('predicting alone, of that', '150 times real time', ''),
        ('prediction-error fit', '100 ms per recorded second', '')]


def test_markdown():
    assert markdown([('a', 'b'), ('1', '2')]) == '| a | b |\n| --- | --- |\n| 1 | 2 |'


def test_node_is_shown_against_the_bare_one():
    def run(node, seconds, times, lost=0):
        return {'node': node, 'rate_hz': 500, 'twists': False, 'seconds': seconds, 'runs': 1,
                'p50': 4e-4 * times, 'p99': 1e-3 * times, 'p99.9': 1e-2, 'memory': 2**20,
                'processor_per_pose': 3e-4 * times, 'sent': 10, 'lost': lost}  # fmt: skip

    runs = [run('bare', 10.0, 1.0), run('bare, events', 10.0, 0.5), run('predictor', 10.0, 1.1),
            run('bare', 60.0, 2.0), run('predictor', 60.0, 1.0, 3)]
    head, *rows = tables({'node': {'runs': runs}})['node']
    assert head[-4:] == ('p50, p99 to bare', 'CPU above bare',
                         'p50, p99 to bare, events', 'CPU above bare, events')  # fmt: skip
    assert [row[0] for row in rows] == [
        'bare', 'bare, events', 'predictor', 'bare, for 60 s', 'predictor, for 60 s']
    assert [row[-4:] for row in rows] == [
        ('',) * 4, ('',) * 4, ('1.10, 1.10', '+30 us', '2.20, 2.20', '+180 us'),
        ('',) * 4, ('0.50, 0.50', '-300 us', '', '')]
    assert rows[4][8] == '3 of 10'


@pytest.mark.slow
@pytest.mark.skipif(find_spec('rclpy') is None, reason='no rclpy here')
def test_other_topics_are_published_where_they_are_heard(tmp_path):
    assert live._measured(live.PREDICTOR, 125, 1.0, True, tmp_path)['others'] == 0
    assert live._measured(live.HEARD, 125, 1.0, True, tmp_path)['others'] > 0
