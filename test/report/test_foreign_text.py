"""Hostile text in every string of files and messages: no message, picture or page carries it."""

from collections.abc import Iterator
import copy
import json
import os

from bellows_ros import plots
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.planning.arm import read_arm
from bellows_ros.errors import BellowsError
from bellows_ros.files import plans
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.plan import read_plan
import numpy as np
import pytest

from ..cli.conftest import bellows  # noqa: F401 (a fixture)
from ..files.recordings import EPOCH_NS, message, POSE, TYPES, write

HOSTILE = '\x1b]0;owned\x07\x1b[2J\n\u202e$\\\\frac{' + 'a' * 200_000
MAX_LENGTH = 3000


def require_harmless(text):
    """Refuse control characters and floods."""
    assert all(c.isprintable() or c == '\n' for c in text), repr(text[:300])
    assert text.encode() and len(text) <= MAX_LENGTH


def harmless(read, *arguments):
    """Read hostile content; what is said of it must be harmless."""
    try:
        read(*arguments)
    except BellowsError as error:
        require_harmless(str(error))


def with_hostile_strings(content, path=()) -> Iterator[object]:
    """Yield copies of nested content, in each of which one key or string is hostile."""
    items = (content.items() if isinstance(content, dict) else
             enumerate(content) if isinstance(content, list) else ())
    for key, value in items:
        for other in with_hostile_strings(value):
            changed = copy.copy(content)
            changed[key] = other
            yield changed
        if isinstance(key, str):
            yield {HOSTILE if name == key else name: part for name, part in content.items()}
    if isinstance(content, str):
        yield HOSTILE


PLAN = {
    'header': {'frame_id': 'world'}, 'joint_names': ['tool'], 'points': [
        {'transforms': [{'translation': {'x': float(k), 'y': 0.0, 'z': 0.5},
                         'rotation': {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}}],
         'velocities': [], 'accelerations': [], 'time_from_start': {'sec': k, 'nanosec': 0}}
        for k in range(3)]}

URDF = """<robot name="arm"><link name="base"/><link name="tool"/>
<joint name="one" type="revolute"><parent link="base"/><child link="tool"/>
<origin xyz="0 0 1" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1"/></joint></robot>"""


PARAMETERS = {'/**': {'ros__parameters': {
    'package': {'mass': 1.8}, 'fit': {'method': 'output_error', 'free': ['com']},
    'topics': {'tool_pose': '/a'}, 'recording': {'package_world': 'estimate'}}}}
MOTION = {'kind': 'waypoints', 'waypoints': {'poses': [{'position': [0, 0, 1], 'move': 1.0}]},
          'tool': {'rate_hz': 500.0}, 'package': {'rate_hz': 360.0, 'frame': 'com'}}


def test_each_string_of_plans_parameters_and_motions(root, tmp_path):
    """Replace each key and text of a file in turn."""
    for content in with_hostile_strings(PLAN):
        harmless(plans.plans_in_yaml, content, HOSTILE)
    values = resolve(read_parameters(root / 'bags/tossing.yaml'))
    path = tmp_path / 'a.yaml'
    for content, read in ((PARAMETERS, read_parameters), (MOTION, read_plan)):
        for other in with_hostile_strings(content):
            path.write_text(json.dumps(other))
            harmless(read, path, *[values] * (read is read_plan))


def test_names_of_a_urdf():
    """In every attribute, and in the name of the link."""
    text = HOSTILE.translate({ord(c): None for c in '\x1b\x07\n'}) + '&#9;'
    for word in ('base', 'tool', 'one', 'revolute', '0 0 1', '-1', 'robot', 'joint'):
        harmless(read_arm, URDF.replace(word, text, 1), 'tool')
        harmless(read_arm, URDF.replace(f'"{word}"', f'"{text}"'), 'tool')
    harmless(read_arm, URDF, HOSTILE)


def test_frames_and_topics_of_a_recording(bellows, tmp_path):  # noqa: F811
    """In frame_id of messages, and in the name of a topic."""
    bad = HOSTILE[:2000]
    rows = [(int(t), bytes(TYPES.serialize_cdr(message(
        POSE, t, pose=np.array([0, 0, 1, 0, 0, 0, 1.0]), frame_id=bad), POSE)))
        for t in EPOCH_NS + np.arange(50) * 10_000_000]
    write(tmp_path / 'bag', {('/tool', POSE): rows, (f'/x{bad[:100]}', POSE): rows})
    for command in ('info', 'plan', 'identify', 'replay'):
        done = bellows(command, 'bag', cwd=tmp_path)
        for text in (done.stdout, done.stderr):
            assert all(c.isprintable() or c == '\n' for c in text), repr(text[:300])
            assert 'Traceback' not in text and len(text) < 20_000


@pytest.mark.parametrize('note', ['run_$5_and_$6', '$\\frac{', os.fsdecode(b'caf\xe9'), HOSTILE])
def test_pictures(note, tmp_path):
    """In the conditions above the panels."""
    pytest.importorskip('matplotlib', reason="no matplotlib here (pip install '.[plot]')")
    with plots.picture('Title', note) as figure:
        plots.write_figure(tmp_path / 'a.png', figure)
        plots.svg_of(figure)
