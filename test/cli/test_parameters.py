"""`bellows parameters`: the table, and a parameter file to fill in."""

import json

from bellows_ros.core.parameters.checks import RECORDING_PARAMETERS, resolve
from bellows_ros.core.parameters.table import PARAMETERS
from bellows_ros.files.parameter_files import read_parameters


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


def test_the_table_is_there_as_json(bellows):
    """Give scripts unit, default and constraint."""
    content = json.loads(bellows('parameters', 'package', '--json', '-').stdout)
    assert content['package.mass']['unit'] == 'kg' and content['package.mass']['default'] is None


def test_a_cup_is_written_for_mujoco(bellows, workshop, tmp_path):
    """Write the model of a cup and its package; name what a cup has that joints lack."""
    command = 'parameters', '--params', 'cup.yaml', '--mjcf', tmp_path / 'cup.xml'
    assert bellows(*command, cwd=workshop).stderr == ''
    assert (tmp_path / 'cup.xml').read_text().endswith('</mujoco>\n')
    done = bellows(*command, '--set', 'cup.relaxation=[0.2,0.1]', cwd=workshop)
    assert (done.returncode, 'lacks cup.relaxation' in done.stderr) == (0, True)
