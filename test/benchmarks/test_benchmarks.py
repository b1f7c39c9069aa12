"""The short form of every measurement runs, and its figures come into the page."""

import ast
from importlib import import_module
from importlib.util import find_spec
import json
from pathlib import Path

from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.errors import BellowsError
from bellows_ros.files.results import format_json
from benchmarks import __main__ as command
from benchmarks import live, offline, plans, startup, step, timing
from benchmarks.tables import markdown, tables
import pytest

NEEDED = {'node': 'rclpy', 'camera': 'rclpy', 'startup': 'rclpy'}


@pytest.mark.stress
@pytest.mark.timeout(300)
@pytest.mark.skipif(not COMPILED, reason='numba is not installed: this takes minutes')
@pytest.mark.parametrize('section', command.SECTIONS)
def test_short_form_measures_and_shows(section, root):
    if section in NEEDED:
        pytest.importorskip(NEEDED[section])
    found = json.loads(format_json(command.measured([section], short=True)))
    page = command.renewed((root / 'docs' / 'performance.md').read_text(), found)
    made = tables(found)
    assert made
    for table in made.values():
        assert len({len(row) for row in table}) == 1
        assert markdown(table) in page


SCRIPTS = [
    node.value
    for module in (offline, plans, startup, step)
    for node in ast.walk(ast.parse(Path(module.__file__).read_text()))
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and '\nimport ' in node.value
]


@pytest.mark.parametrize('code', SCRIPTS, ids=range(len(SCRIPTS)))
def test_scripts_of_other_processes_import_what_is_there(code):
    if 'rclpy' in code:
        pytest.importorskip('rclpy')
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom):
            module = import_module(node.module)
            assert all(hasattr(module, alias.name) for alias in node.names), node.module
        elif isinstance(node, ast.Import):
            assert all(import_module(alias.name) for alias in node.names)


def test_page_holds_the_figures_beside_it(root):
    docs = root / 'docs'
    page, found = (docs / 'performance.md').read_text(), (docs / 'performance.json').read_text()
    assert command.renewed(page, json.loads(found)) == page


def test_interleaved_takes_turns():
    order = []

    def work(name):
        order.append(name)
        return 2

    found = timing.interleaved({'a': lambda: work('a'), 'b': lambda: work('b')}, 2)
    assert order == ['a', 'b', 'a', 'b', 'a', 'b']
    assert found['a']['runs'] == 2


def test_a_measurement_that_fails_is_said():
    with pytest.raises(BellowsError, match='boom'):
        timing.in_process('raise SystemExit("boom")')


def test_node_is_shown_against_the_bare_one():
    def run(node, seconds, times, lost=0):
        return {'node': node, 'rate_hz': 500, 'twists': False, 'seconds': seconds, 'runs': 1,
                'p50': 4e-4 * times, 'p99': 1e-3 * times, 'p99.9': 1e-2, 'memory': 2**20,
                'processor_per_pose': 3e-4 * times, 'sent': 10, 'lost': lost}

    runs = [run('bare', 10.0, 1.0), run('bare, events', 10.0, 0.5), run('predictor', 10.0, 1.1),
            run('bare', 60.0, 2.0), run('predictor', 60.0, 1.0, 3)]
    head, *rows = tables({'node': {'runs': runs}})['node']
    assert head[-4:] == ('p50, p99 to bare', 'CPU above bare',
                         'p50, p99 to bare, events', 'CPU above bare, events')
    assert [row[0] for row in rows] == [
        'bare', 'bare, events', 'predictor', 'bare, for 60 s', 'predictor, for 60 s']
    assert [row[-4:] for row in rows] == [
        ('',) * 4, ('',) * 4, ('1.10, 1.10', '+30 us', '2.20, 2.20', '+180 us'),
        ('',) * 4, ('0.50, 0.50', '-300 us', '', '')]
    assert rows[4][8] == '3 of 10'


@pytest.mark.stress
@pytest.mark.skipif(find_spec('rclpy') is None, reason='no rclpy here')
def test_other_topics_are_published_where_they_are_heard(tmp_path):
    assert live.measured(live.PREDICTOR, 125, 1.0, True, tmp_path)['others'] == 0
    assert live.measured(live.HEARD, 125, 1.0, True, tmp_path)['others'] > 0
