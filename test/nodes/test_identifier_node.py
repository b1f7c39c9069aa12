"""The identifier node: finds the cup beside the executor and shows it as parameters."""

from pathlib import Path
from typing import Any

from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters
from bellows_ros.nodes.predictor_node import PredictorNode
import numpy as np
from numpy.testing import assert_allclose
import pytest
from rclpy.parameter import Parameter

pytest.importorskip('bellows_ros.workflows.identify')

PACKAGE = {
    'package.mass': 2.17,
    'package.inertia': [0.0087, 0.0087, 0.0173, 0.0, 0.0, 0.0],
    'package.com': [0.0, 0.0, -0.03],
}


def make(ros: Any, **given: object) -> Any:
    """Return a spinning identifier; `__` in the names of parameters stands for a dot."""
    from bellows_ros.nodes.identifier_node import IdentifierNode

    values = {**PACKAGE, **{name.replace('__', '.'): value for name, value in given.items()}}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    node = IdentifierNode(context=ros.context, parameter_overrides=overrides)
    ros.executor.add_node(node)
    return node


def test_recordings_must_be_named(ros: Any) -> None:
    """End with what to set."""
    with pytest.raises(BellowsError, match='the parameter bags is empty'):
        make(ros)


def test_error_of_the_work_ends_the_node(ros: Any, tmp_path: Path) -> None:
    """Raise where the node is waited for, and write nothing."""
    node = make(ros, bags=[str(tmp_path / 'nowhere')], output__json=str(tmp_path / 'fit.json'))
    assert ros.spin_until(node.finished.done, 30.0)
    with pytest.raises(BellowsError, match='nowhere'):
        node.finished.result()
    assert list(tmp_path.iterdir()) == []


def test_cup_is_found_shown_written_and_set_on_the_predictor(
        ros: Any, rig: Path, tmp_path: Path) -> None:
    """Go the whole way from a recording to a running predictor."""
    predictor = PredictorNode(context=ros.context, parameter_overrides=[
        Parameter(name, value=value) for name, value in PACKAGE.items()])
    ros.executor.add_node(predictor)
    written = tmp_path / 'cup.yaml'
    node = make(
        ros, bags=[str(rig / 'clean')], output__parameters=str(written), predictor='/predictor',
        output__json=str(tmp_path / 'fit.json'), exit_when_done=True)
    assert not node.has_parameter('cup.stiffness'), 'shown before it is known'
    assert ros.spin_until(node.finished.done, 60.0)
    assert node.finished.result() is None

    with np.load(rig / 'clean_truth.npz') as truth:
        K = truth['K']
    found = np.reshape(node.get_parameter('cup.stiffness').value, (6, 6))
    assert_allclose(np.diag(found), np.diag(K), rtol=0.01)  # what is promised for this recording
    for name in ('cup.stiffness', 'cup.damping'):
        value = list(node.get_parameter(name).value)
        assert value == list(predictor.get_parameter(name).value)
        assert tuple(value) == read_parameters(written)[name]
    assert (tmp_path / 'fit.json').is_file()


def test_absent_predictor_is_said(
        ros: Any, rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give up after a while, with the cup found."""
    monkeypatch.setattr('bellows_ros.nodes.identifier_node.LONGEST_WAIT', 0.2)
    node = make(ros, bags=[str(rig / 'clean')], predictor='/elsewhere')
    assert ros.spin_until(node.finished.done, 60.0)
    with pytest.raises(BellowsError, match="could not be set on '/elsewhere'"):
        node.finished.result()
    assert node.has_parameter('cup.stiffness')
