"""The recordings in bags/: small, made from the files beside them, good for identification."""


from bellows_ros.core.signals.trajectory import PoseStream
from bellows_ros.files.bags import read_streams, topics
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.workflows.simulate import simulate_recording
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from ruamel.yaml import YAML

from .cell.sensors import TOPICS

NAMES = ('identification', 'validation', 'static', 'rubber')


@pytest.fixture(scope='module')
def bags(root):
    return root / 'bags'


def test_all_together_are_below_six_megabytes(bags):
    files = [path for path in bags.rglob('*') if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 6e6
    assert {path.parent.name for path in files if path.suffix == '.mcap'} == {
        *NAMES, 'tag', 'tag_validation'}


@pytest.mark.parametrize('name', NAMES)
def test_the_files_make_the_recording_again(bags, name, tmp_path):
    motion = YAML(typ='safe').load((bags / f'{name}.yaml').read_text())
    cup = 'rubber_cup.yaml' if name == 'rubber' else 'cup.yaml'
    report = simulate_recording(read_parameters(bags / cup), motion, tmp_path / name)

    assert report.warnings == ()
    assert np.radians(3.0) < report.largest_bending_rad < np.radians(25.0)
    assert topics(bags / name) == topics(tmp_path / name)
    there = {topic.name for topic in topics(bags / name)}
    roles = {role: topic for role, topic in TOPICS.items() if topic in there}
    kept, made = read_streams(bags / name, roles), read_streams(tmp_path / name, roles)
    for role, stream in kept.items():
        other = made[role]
        assert_array_equal(stream.stamps_ns, other.stamps_ns)
        assert not stream.refused and stream.frame_id == 'world'
        # Equal but for rounding, which depends on the machine's mathematical library.
        if isinstance(stream, PoseStream):
            assert_allclose(stream.position, other.position, atol=1e-10)
            assert_allclose(stream.rotation, other.rotation, atol=1e-9)
        else:
            assert_allclose(stream.linear, other.linear, atol=1e-10)
            assert_allclose(stream.angular, other.angular, atol=1e-10)


def test_what_is_known_beforehand_agrees_with_the_truth_and_does_not_hold_it(bags):
    truth, known = read_parameters(bags / 'cup.yaml'), read_parameters(bags / 'package.yaml')
    assert not {'cup.stiffness', 'cup.damping'} & set(known)
    shared = set(truth) & set(known)
    assert shared == {'package.mass', 'package.inertia', 'package.com', 'cup.length',
                      'recording.package_frame'}
    assert {name: known[name] for name in shared} == {name: truth[name] for name in shared}
    assert {known[f'topics.{role}'] for role in TOPICS} == set(TOPICS.values())
