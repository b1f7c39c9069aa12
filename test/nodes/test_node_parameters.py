"""Parameters of the nodes: declared from the table, refused in words, one check for all times."""

from threading import Event

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.table import parameters_for
from bellows_ros.nodes import pipeline
import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from .conftest import overrides_of, PACKAGE, Peer, set_on, START

THESIS = Cup.thesis()
K = (1.1 * THESIS.stiffness).ravel().tolist()
P = (1.1 * THESIS.damping).ravel().tolist()
INDEFINITE = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]).ravel().tolist()


class Caller(Peer):
    """Another node that sets parameters through the services."""

    def set_at_once(self, **values):
        """Set parameters all or none; `__` stands for a dot."""
        named = {name.replace('__', '.'): value for name, value in values.items()}
        result = self.call(
            '/predictor/set_parameters_atomically', SetParametersAtomically,
            SetParametersAtomically.Request(parameters=[
                parameter.to_parameter_msg() for parameter in overrides_of(named)])).result
        return result.successful, result.reason


@pytest.fixture
def caller(ros):
    """Give a node beside the predictor."""
    return Caller(ros)


def used(node):
    """Return the blocks of K and P that the prediction is made with."""
    return node.pipeline.live.model[0][2:]


@pytest.mark.parametrize(('stiffness', 'damping', 'named'), [
    (K, INDEFINITE, 'cup.damping'), ((1e-300 * np.eye(6)).ravel().tolist(), P, 'cup.stiffness')])
@pytest.mark.parametrize('order', [1, -1])
def test_no_parameter_changes_if_one_is_rejected(stiffness, damping, named, order, node, caller):
    """Refuse both with the reason, whichever comes first in the call."""
    kept, before = node.values, used(node)
    both = [('cup__stiffness', stiffness), ('cup__damping', damping)][::order]
    successful, reason = caller.set_at_once(**dict(both))
    assert not successful and named in reason
    assert node.values is kept and used(node) == before


@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_values_are_used_at_once_and_doubts_are_logged(node, caller, capfd):
    """Both ends of a range in one call; nothing anew for dumped values; a cup opened, closed."""
    assert caller.set_at_once(vacuum__thresholds=[96e3, 98e3])[0]
    assert caller.set_at_once(package__mass=3.0, package__com=[0.0, 0.0, 0.03])[0]
    assert node.pipeline.live.model[1][:2] == (3.0, (0.0, 0.0, 0.03))
    log = capfd.readouterr().err
    assert 'package.com' in log and 'Is it -0.03?' in log
    before, model = node.values, node.pipeline.live.model
    dumped = {name.replace('.', '__'): node.get_parameter(name).value for name in before
              if node.has_parameter(name) and node.get_parameter(name).value is not None
              and not node.describe_parameter(name).read_only
              and list(np.atleast_1d(node.get_parameter(name).value))}
    assert caller.set_at_once(**dumped)[0]
    assert node.values is before and node.pipeline.live.model is model
    single = used(node)[0][0][0]
    set_on(node, 'cup.layout', [0.05, 0.0, 0.0, -0.05, 0.0, 0.0])
    assert used(node)[0][0][0] == pytest.approx(2.0 * single)
    set_on(node, 'cup.open', [1.0])
    assert used(node)[0][0][0] == pytest.approx(single)


@pytest.mark.parametrize(('name', 'value', 'named'), [
    ('cup.valid_low', [0.01] * 14, ''), ('package.mass', 5e-324, 'package.mass'),
    ('package.com', '[0, 0, x]', ''), ('package.mass', '2,5', ''), ('cup.stifness', K, ''),
    ('tool_link', 'a\x1b[31mb', r"'a\x1b[31mb'"), ('tool_twist.frame', 'tool', ''),
    ('bags', ['a'], ''), ('wrench.frame', '1e300 0 0 0 0 0 1', 'wrench.frame'),
    ('gripper.com', [-1e6] * 3, 'gripper.com')])
@pytest.mark.filterwarnings('ignore::bellows_ros.errors.UnitWarning')
def test_a_bad_value_is_refused_in_words(name, value, named, node, caller):
    """In printable characters, before it is in use; the node goes on."""
    before = node.values
    answer = caller.call('/predictor/set_parameters', SetParameters, SetParameters.Request(
        parameters=[Parameter(name, value=value).to_parameter_msg()])).results[0]
    assert not answer.successful and answer.reason.isprintable() and named in answer.reason
    assert node.values is before and not node.failures


def test_every_parameter_is_described(node, caller):
    """Show sentence, unit, range and whether it can change."""
    table = parameters_for('predictor')
    answer = caller.call('/predictor/describe_parameters', DescribeParameters,
                         DescribeParameters.Request(names=[p.name for p in table]))
    assert len(answer.descriptors) == len(table)
    for parameter, shown in zip(table, answer.descriptors, strict=True):
        assert parameter.description in shown.description
        assert parameter.unit in shown.description
        assert shown.additional_constraints == parameter.constraint
        assert shown.read_only == parameter.read_only


def test_one_file_serves_both_nodes(make_predictor):
    """Accept the identifier's names and ROS's own."""
    node = make_predictor({**PACKAGE, 'fit.structure': 'full', 'use_sim_time': False,
                           'package.mass': 2})
    assert node.get_parameter('package.mass').value == 2.0
    assert not node.has_parameter('fit.structure')


def test_prediction_continues_while_another_kind_of_cup_compiles(make_partner, monkeypatch):
    """Predict with the cup before until the kernels of a relaxing cup are compiled aside."""
    compiled = Event()
    partner = make_partner(with_twists=False)
    node = partner.predictor
    monkeypatch.setattr(pipeline, 'warm_up', lambda *model: compiled.wait(300.0))
    set_on(node, 'cup.relaxation', [0.1, 0.1])
    partner.predict(START)
    assert len(node.pipeline.live.model[0]) == 4
    compiled.set()
    partner.wait(lambda: len(node.pipeline.live.model[0]) == 6)
    assert not node.failures
