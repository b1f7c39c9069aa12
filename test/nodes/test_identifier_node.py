"""The identifier node: finds the cup beside the executor and shows it as parameters."""

from bellows_ros.core.model.cup_package import TERMS
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rclpy.parameter import Parameter

from . import conftest

pytest.importorskip('bellows_ros.workflows.identify')

PACKAGE = {**conftest.PACKAGE, 'recording.package_frame': 'com'}
TOPICS = {'topics__tool_pose': '/tool_arm/pose', 'topics__package_pose': '/package/pose'}


def make(ros, package=PACKAGE, **given):
    """Return a spinning identifier; `__` in the names of parameters stands for a dot."""
    from bellows_ros.nodes.identifier_node import IdentifierNode

    named = {name.replace('__', '.'): value for name, value in given.items()}
    overrides = conftest.overrides_of({**package, 'fit.method': 'least_squares', **named})
    node = IdentifierNode(context=ros.context, parameter_overrides=overrides)
    ros.executor.add_node(node)
    return node


def result_of(ros, node):
    """Return with what the work of a node ends."""
    assert ros.spin_until(node.finished.done, 300.0)
    return node.finished.result()


def test_recordings_must_be_named(ros):
    """End with what to set."""
    with pytest.raises(BellowsError):
        make(ros)


def test_parameters_are_fixed(ros, tmp_path):
    """Refuse to change one while the node runs, also an empty list, which ROS has not set."""
    node = make(ros, bags=[str(tmp_path)])
    for name, value in (('fit.structure', 'full'), ('package.files', ['another'])):
        result, = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful and name in result.reason
    with pytest.raises(BellowsError):
        result_of(ros, node)


def test_error_of_the_work_ends_the_node(ros, tmp_path):
    """Raise where the node is waited for, and write nothing."""
    node = make(ros, bags=[str(tmp_path / 'nowhere')], output__json=str(tmp_path / 'fit.json'))
    with pytest.raises(BellowsError, match='nowhere'):
        result_of(ros, node)
    assert list(tmp_path.iterdir()) == []


def test_cup_is_found_shown_written_and_set_on_the_predictor(ros, rig, tmp_path, make_predictor):
    """Go the whole way from a recording to a running predictor, and change nothing else of it."""
    own = {'cup.lip_radius': 0.03, 'cup.friction': 0.7, 'cup.suction_area': 2e-3}
    before = {'cup.layout': [0.05, 0.0, 0.0, -0.05, 0.0, 0.0], 'cup.relaxation': [0.2, 0.1]}
    predictor = make_predictor({**PACKAGE, **own, **before})
    written = tmp_path / 'cup.yaml'
    node = make(
        ros, bags=[str(rig / 'clean')], output__parameters=str(written), predictor='/predictor',
        output__json=str(tmp_path / 'fit.json'))
    assert not node.has_parameter('cup.stiffness'), 'shown before it is known'
    assert ros.spin_until(lambda: node.has_parameter('cup.damping') and (
        predictor.values['cup.stiffness'] == node.values['cup.stiffness']), 300.0)

    values = read_parameters(written)
    with np.load(rig / 'clean_truth.npz') as truth:
        K = truth['K']
    shown = {name: node.get_parameter(name).value for name in ('cup.stiffness', 'cup.damping')}
    found = np.reshape(shown['cup.stiffness'], (6, 6))
    assert_allclose(np.diag(found), np.diag(K), rtol=0.01)  # what is promised for this recording
    assert {name: tuple(value) for name, value in shown.items()}.items() <= values.items()
    terms = {term.parameter: term.default for term in TERMS.values()}
    errors = {'cup.stiffness_std', 'cup.damping_std', 'cup.valid_low', 'cup.valid_high'}
    assert set(values) == terms.keys() | errors
    for name in ('cup.layout', 'cup.relaxation', 'cup.stretch'):  # the recording has none
        assert values[name] == predictor.values[name] == terms[name]
    for name, value in values.items():  # to the digits of a file
        assert_allclose(predictor.values[name], value, err_msg=name)
    assert (tmp_path / 'fit.json').is_file()
    assert {name: predictor.values[name] for name in own} == own


def test_packages_in_files_are_enough_and_an_absent_predictor_is_named(ros, root, monkeypatch):
    """Start without package.*, and give up waiting after a while, with the cup found."""
    monkeypatch.setattr('bellows_ros.nodes.identifier_node.PREDICTOR_TIMEOUT', 0.2)
    node = make(
        ros, {}, predictor='/elsewhere', bags=[str(root / 'bags/validation')], cup__length=0.046,
        package__files=[str(root / 'bags/package.yaml')], **TOPICS)
    assert not node.has_parameter('package.mass')
    with pytest.raises(BellowsError, match="'/elsewhere'"):
        result_of(ros, node)
    assert node.has_parameter('cup.stiffness')
