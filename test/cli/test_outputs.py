"""No output of any command takes the place of what is read, or lies in it."""

import argparse
import importlib
from pathlib import Path
import shutil

from bellows_ros.cli.app import COMMANDS
from bellows_ros.cli.options import Output
import pytest

from .conftest import contents

PARAMS = ('--params', 'package.yaml')
CUP = ('--params', 'cup.yaml')


@pytest.fixture(scope='module')
def cell(bellows, workshop, tmp_path_factory):
    """Give a folder with a recording, what is known of it, and results, none of which may go."""
    folder = tmp_path_factory.mktemp('cell')
    shutil.copytree(workshop, folder, dirs_exist_ok=True)
    known = (folder / 'package.yaml').read_text()
    (folder / 'bags.yaml').write_text(
        f"{known}bags: ['recording']\nstatic.bags: ['recording']\n")
    done = bellows('identify', 'recording', *PARAMS, '--json', 'fit.json', cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / 'poses.tum').write_text('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n')
    (folder / 'link').symlink_to('recording')
    (folder / 'sources').mkdir()
    shutil.copy(folder / 'poses.tum', folder / 'sources')
    return folder


@pytest.mark.parametrize('line', [
    ('info', 'recording', '--json', 'recording/recording.mcap'),
    ('info', 'recording', '--write-params', 'recording/new.yaml'),
    ('info', 'recording/recording.mcap', '--json', 'recording/metadata.yaml'),
    ('info', 'link', '--json', 'recording/recording.mcap'),
    ('info', 'recording', '--json', 'link/recording.mcap'),
    ('identify', 'recording', *PARAMS, '--out', 'recording/recording.mcap'),
    ('identify', 'recording', *PARAMS, '--out', 'package.yaml'),
    ('identify', 'recording', *PARAMS, '--report', 'recording/page.html'),
    ('identify', 'recording', *PARAMS, '--set', 'output.json=recording/recording.mcap'),
    ('identify', '--params', 'bags.yaml', '--json', 'recording/recording.mcap'),
    ('identify', '--params', 'bags.yaml', '--set', 'bags=x', '--json', 'recording/metadata.yaml'),
    ('structures', 'recording', *PARAMS, '--json', 'recording/metadata.yaml'),
    ('structures', '--params', 'bags.yaml', '--json', 'recording/metadata.yaml'),
    ('static', 'recording', *PARAMS, '--out', 'recording/recording.mcap'),
    ('static', '--params', 'bags.yaml', '--json', 'recording/recording.mcap'),
    ('compare', 'fit.json', 'fit.json', '--json', 'fit.json'),
    ('replay', 'recording', *CUP, '--json', 'recording/recording.mcap'),
    ('replay', 'recording', *CUP, '--report', 'cup.yaml'),
    ('simulate', *CUP, '--motion', 'motion.yaml', '--out', 'new', '--json', 'motion.yaml'),
    ('plot', 'motion', 'recording', *PARAMS, '--out', 'recording/motion.png'),
    ('plot', 'motion', 'recording', *PARAMS, '--out', 'x.png', '--json', 'package.yaml'),
    ('view', 'recording', *CUP, '--out', 'recording/view.rrd'),
    ('convert', 'recording', '--topic', '/package/pose', '--out', 'recording/package.tum'),
    ('convert', 'poses.tum', '--topic', '/p', '--out', 'poses.tum'),
    ('convert', 'sources/poses.tum', '--topic', '/p', '--out', 'sources', '--force'),
    ('export', 'cup.yaml', '--to', 'sdf', '--out', 'cup.yaml'),
])
def test_output_that_is_read_is_refused(bellows, cell, line):
    """Say so before any work, end with 2, and change nothing."""
    before = contents(cell)
    done = bellows(*line, cwd=cell)
    assert done.returncode == 2, done.stdout + done.stderr
    assert 'input' in done.stderr and 'Give a name elsewhere' in done.stderr, done.stderr
    assert contents(cell) == before


@pytest.mark.parametrize(('line', 'option', 'name'), [
    (('export', 'cup.yaml', '--to', 'c'), '--out', 'x.h'),
    (('identify', 'recording', *PARAMS), '--out', 'x.yaml'),
    (('info', 'recording'), '--write-params', 'x.yaml'),
    (('simulate', *CUP, '--motion', 'motion.yaml', '--out', 'x', '--force'), '--json', 'x.json'),
])
def test_text_goes_to_stdout_where_its_name_is_a_dash(bellows, cell, tmp_path, line, option, name):
    """Write the very text of the file and nothing else there, and no file of this name."""
    here = {'x': tmp_path / 'x', **{path.name: path for path in cell.iterdir()}}
    line = tuple(str(here.get(word, word)) for word in line)
    assert bellows(*line, option, name, cwd=tmp_path).returncode == 0
    done = bellows(*line, option, '-', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, (tmp_path / name).read_text())
    assert 'Wrote -' not in done.stderr and not (tmp_path / '-').exists()


@pytest.mark.parametrize(('line', 'words'), [
    (('simulate', *CUP, '--motion', 'motion.yaml', '--out', '-'), 'is for text'),
    (('plot', 'motion', 'recording', *PARAMS, '--out', '-'), 'is for text'),
    (('export', 'cup.yaml', '--to', 'c', '--out', '-', '--json', '-'), 'has room for one'),
])
def test_what_stdout_cannot_take_is_refused(bellows, cell, line, words):
    """Say so before any work."""
    before = contents(cell)
    done = bellows(*line, cwd=cell)
    assert (done.returncode, done.stdout) == (2, '') and words in done.stderr, done.stderr
    assert contents(cell) == before


def test_every_output_is_known_as_one():
    """Have all options that name what is written checked: those with FILE, and BAG and NAME."""
    outputs = {}
    for command in COMMANDS:
        parser = argparse.ArgumentParser()
        importlib.import_module(f'bellows_ros.cli.{command}').add_arguments(parser)
        for action in parser._actions:
            if action.metavar in ('FILE', 'NAME', 'BAG') and action.type not in (Path, None):
                assert isinstance(action.type, type) and issubclass(action.type, Output)
                outputs.setdefault(command, []).append(action.option_strings[0])
            elif action.metavar in ('FILE', 'BAG'):
                assert action.type is Path, (command, action)
    assert outputs['identify'] == ['--out', '--json', '--report']
    assert outputs['info'] == ['--write-params', '--json']
    assert set(COMMANDS) == set(outputs)
