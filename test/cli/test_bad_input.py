"""What a command refuses: it says what is wrong, ends with 2, and changes no file."""

import shlex
import shutil

from bellows_ros.files.bags import as_messages, write_bag
import numpy as np
import pytest
from ruamel.yaml import YAML

from .conftest import contents, KNOWN, TRANSPORT, write_yaml
from ..conftest import ROOT

POSE, TWIST = 'geometry_msgs/msg/PoseStamped', 'geometry_msgs/msg/TwistStamped'
RATE_HZ = 200.0
START_NS = 1_700_000_000_000_000_000
BAGS = ROOT / 'bags'
SHORT = {
    'CELL': '--params package.yaml', 'CUP': '--params cup.yaml', 'BAGS': f'{BAGS}', 'TOSS':
    f'toss {BAGS}/throw.yaml --params {BAGS}/tossing.yaml --json new.json', 'PLAN':
    'plan --params cup.yaml --json new.json --out new',
    'IDENTIFY': 'identify recording --params package.yaml'}
"""What lines begin with or share; the cell is what stands in the folder."""


def still(topic, seconds, start_s=0.0, kind=POSE):
    """Return messages of a body that does not move."""
    count = round(seconds * RATE_HZ)
    first_ns = START_NS + round(start_s * 1e9)
    stamps_ns = first_ns + np.round(np.arange(count) * 1e9 / RATE_HZ).astype(np.int64)
    values = np.zeros((count, 7 if kind == POSE else 6))
    if kind == POSE:
        values[:, 6] = 1.0
    return as_messages(topic, kind, stamps_ns, values)


def write_bad_bags(folder):
    """Write recordings that cannot be used."""
    (folder / 'bad.mcap').write_text('certainly not a recording')
    tool, twist = still('/tool_arm/pose', 5.0), still('/tool_arm/twist', 5.0, kind=TWIST)
    write_bag(folder / 'other', [still('/arm/pose', 5.0), still('/box/pose', 5.0)])
    write_bag(folder / 'twists', [
        still('/tool_arm/pose', 5.0, kind=TWIST), twist, still('/package/pose', 5.0)])
    write_bag(folder / 'apart', [tool, twist, still('/package/pose', 5.0, start_s=60.0)])


def write_bad_files(folder):
    """Write parameters, motions and limits that are wrong."""
    write_yaml(folder / 'massless.yaml', {n: v for n, v in KNOWN.items() if n != 'package.mass'})
    motion = YAML(typ='safe').load((folder / 'motion.yaml').read_text())
    write_yaml(folder / 'dance.yaml', {**motion, 'kind': 'dance'})
    write_yaml(folder / 'transport.yaml', TRANSPORT)
    write_yaml(folder / 'point.yaml', {**TRANSPORT, 'waypoints': {'poses': []}})
    limits = YAML(typ='safe').load((ROOT / 'config' / 'limits_example.yaml').read_text())
    write_yaml(folder / 'misspelt.yaml', {**limits, 'bendig': 1.0})
    write_yaml(folder / 'safe.yaml', {'safety_factor': 1.0})


@pytest.fixture(scope='module')
def cell(workshop, tmp_path_factory):
    """Give a folder with a recording, what is known of it, results, and much that is wrong."""
    folder = tmp_path_factory.mktemp('cell')
    shutil.copytree(workshop, folder, dirs_exist_ok=True)
    write_yaml(folder / 'bags.yaml', {**KNOWN, 'bags': ['recording']})
    (folder / 'poses.tum').write_text('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n')
    (folder / 'link').symlink_to('recording')
    (folder / 'loop').symlink_to('loop')
    (folder / 'sources').mkdir()
    shutil.copy(folder / 'poses.tum', folder / 'sources')
    write_bad_bags(folder)
    write_bad_files(folder)
    return folder


def words_of(line):
    """Return the words of a line, with what is short for others."""
    words = shlex.split(' '.join(SHORT.get(word, word) for word in line.split()))
    return [word.replace('BAGS', f'{BAGS}') for word in words]


READ = [
    'info recording --json recording/recording.mcap',
    'info recording --write-params recording/new.yaml',
    'info link --json recording/recording.mcap',
    'IDENTIFY --out recording/recording.mcap',
    'IDENTIFY --set output.json=recording/recording.mcap',
    'identify --params bags.yaml --json recording/metadata.yaml',
    'replay recording CUP --report cup.yaml',
    'convert poses.tum --topic /p --out poses.tum',
]
"""Outputs that are read."""
UNWRITABLE = [
    ('IDENTIFY --out no/cup.yaml', "no/cup.yaml'"), ('IDENTIFY --json sources', "'sources'"),
    ('PLAN transport.yaml --plot plan.txt', '.png, .svg, .pdf'),
    ('simulate CUP --motion motion.yaml --out -', "'-'"),
    ('PLAN transport.yaml --steer zv --plot plan.avi', '.gif'),
]
UNREADABLE = [
    ('identify CELL', 'bags'),
    ('info none --write-params new.yaml', "'none'"), ('info loop', "'loop' ... exist"),
    ('identify bad.mcap CELL', "'bad.mcap'"),
    ('identify other CELL', "'/tool_arm/pose' ... /arm/pose, /box/pose ... topics.tool_pose"),
    ('identify twists CELL', f"'/tool_arm/pose' ... {TWIST} ... {POSE}"),
    ('identify apart CELL', '/package/pose ... 60'),
    ('PLAN point.yaml', "'waypoints.poses'"),
    ('PLAN transport.yaml --topic /x', "topic is '/x' ... 'transport.yaml'"),
    ('simulate CUP --motion dance.yaml --out new', "'kind' ... multi_sine ... dance"),
]
NOT_ALLOWED = [
    ('identify recording --params massless.yaml', 'package.mass: 2.17 ... kg'),
    ('plan transport.yaml', 'package.mass ... bellows info ... --params FILE'),
    ('IDENTIFY --set fit.structur=full', "--set fit.structur: ... 'fit.structure'"),
    ('info recording --from soon', '--from: recording.start'),
    ('PLAN transport.yaml --steer zv --limits safe.yaml', 'cup.lip_radius'),
    ('PLAN transport.yaml --limits misspelt.yaml', "'bendig'"),
    ('TOSS --target 1900 150', 'mm'),
    ('TOSS', 'release ... target'),
]


@pytest.mark.parametrize(('line', 'named'), [
    *((line, 'input') for line in READ), *UNWRITABLE, *UNREADABLE, *NOT_ALLOWED])
def test_what_cannot_be_done_is_refused(bellows, cell, line, named):
    """Name what is wrong, end with 2, and touch nothing."""
    before = contents(cell)
    done = bellows(*words_of(line), cwd=cell)
    assert (done.returncode, done.stdout) == (2, ''), done.stderr
    assert done.stderr.startswith('bellows') and 'Traceback' not in done.stderr
    for each in named.split(' ... '):
        assert each in ' '.join(done.stderr.split())
    assert contents(cell) == before


@pytest.mark.parametrize(('line', 'option', 'name'), [
    ('info recording', '--write-params', 'x.yaml'),
    ('simulate CUP --motion motion.yaml --out x --force', '--json', 'x.json')])
def test_text_goes_to_stdout_where_its_name_is_a_dash(
        succeed, cell, tmp_path, line, option, name):
    """Write the very text of the file and nothing else there, and no file of this name."""
    here = {'x': tmp_path / 'x', **{path.name: path for path in cell.iterdir()}}
    line = [str(here.get(word, word)) for word in words_of(line)]
    succeed(*line, option, name, cwd=tmp_path)
    done = succeed(*line, option, '-', cwd=tmp_path)
    assert done.stdout == (tmp_path / name).read_text()
    assert 'Wrote -' not in done.stderr and not (tmp_path / '-').exists()
