"""Every command with the least input it takes, and with each optional group left out."""

import json

from bellows_ros.cli import COMMANDS
from bellows_ros.core.geometry.jit import COMPILED
from bellows_ros.files.parameter_files import read_parameters
import pytest

from .conftest import write_yaml
from ..conftest import ROOT

pytestmark = pytest.mark.skipif(
    not COMPILED, reason='numba is not installed: interpreted commands take minutes')

WHOLE = dict(read_parameters(ROOT / 'bags' / 'tossing.yaml'))
GROUPS = {
    'nothing': (), 'standard deviations': ('_std', 'correlation'),
    'grip': ('cup.lip_radius', 'cup.suction_area', 'vacuum.', 'cup.friction'),
    'box': ('package.size',), 'release': ('release.',), 'landing': ('landing.',),
    'all': ('_std', 'cup.lip_radius', 'vacuum.', 'package.size', 'release.', 'landing.')}
"""Parts of the names of optional parameters, by group."""
LEAST = {
    'info': ['recording'], 'convert': None, 'parameters': [],
    'identify': ['recording', '--params', 'package.yaml'],
    'replay': ['recording', '--params', 'cup.yaml'],
    'plan': ['move.yaml', '--params', 'cup.yaml'],
    'toss': ['throw.yaml', '--params', 'cup.yaml', '--release', '2.95'],
    'simulate': ['--params', 'cup.yaml', '--motion', 'move.yaml', '--out', 'made', '--force']}
"""The least arguments of each command; None where its own tests have them."""
NEEDED = {('toss', 'box'): 'package.size', ('toss', 'all'): 'package.size'}
"""The parameter that a command asks for without a group."""


def without(parts):
    """Return all parameters but those with one of these parts in their names."""
    return {name: value for name, value in WHOLE.items()
            if not any(part in name for part in parts)}


@pytest.fixture(scope='module')
def kitchen(workshop, identified, tmp_path_factory):
    """Give a folder with the inputs of all commands."""
    folder = tmp_path_factory.mktemp('kitchen')
    for source, name in (
            (workshop / 'recording', 'recording'), (workshop / 'package.yaml', 'package.yaml'),
            (identified / 'fit.json', 'fit.json'), (ROOT / 'bags' / 'throw.yaml', 'throw.yaml')):
        (folder / name).symlink_to(source)
    write_yaml(folder / 'move.yaml', {
        'kind': 'waypoints', 'rest_duration': 0.5,
        'waypoints': {'poses': [{'position': [0.3, 0.0, 0.0], 'move': 0.5}]},
        'tool': {'rate_hz': 250.0}, 'package': {'rate_hz': 200.0}})
    return folder


def test_every_command_has_its_least_input():
    assert set(LEAST) == set(COMMANDS)


@pytest.mark.parametrize('group', GROUPS)
@pytest.mark.parametrize('command', [
    'plan', 'toss', 'simulate', 'replay'])
def test_commands_run_without_an_optional_group(command, group, kitchen, bellows):
    """End to end, with a result as JSON; or name the parameter that is needed."""
    write_yaml(kitchen / 'cup.yaml', without(GROUPS[group]))
    (kitchen / 'result.json').unlink(missing_ok=True)
    done = bellows(command, *LEAST[command], '--json', 'result.json', cwd=kitchen)
    assert 'Traceback' not in done.stderr
    if needed := NEEDED.get((command, group)):
        assert done.returncode == 2 and needed in done.stderr
        return
    assert done.returncode in (0, 1), done.stderr
    json.loads((kitchen / 'result.json').read_text())


@pytest.mark.parametrize(('command', 'more'), [
    *((command, ()) for command in ('info', 'identify', 'parameters')),
    *(('plan', ('--steer', method)) for method in ('zvd', 'zv'))])
def test_commands_run_with_their_least_input(command, more, kitchen, bellows):
    write_yaml(kitchen / 'cup.yaml', without(GROUPS['all']))
    done = bellows(command, *LEAST[command], *more, cwd=kitchen)
    assert done.returncode in (0, 1) and 'Traceback' not in done.stderr, done.stderr
