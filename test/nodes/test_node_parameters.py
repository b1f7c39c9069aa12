"""Parameters of the nodes: declared from the table, refused in words, changed all or nothing."""

from threading import Event
import time

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.checks import POSE_PARAMETERS
from bellows_ros.core.parameters.table import ANY_LENGTH, parameters_for
from bellows_ros.errors import BellowsError
from bellows_ros.files.parameter_files import read_parameters, write_parameters
from bellows_ros.nodes import pipeline
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter

from .conftest import break_once, overrides_of, PACKAGE, Peer, set_on, START
from .test_planning import encode_multi_dof, message, VALUES

THESIS = Cup.thesis()
K = (1.1 * THESIS.stiffness).ravel().tolist()
P = (1.1 * THESIS.damping).ravel().tolist()
INDEFINITE = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]).ravel().tolist()


class Caller(Peer):
    """Another node that sets parameters through the services."""

    def set_parameters(self, **values):
        """Set parameters as `ros2 param set` and `load` do; `__` stands for a dot."""
        named = {name.replace('__', '.'): value for name, value in values.items()}
        return [(result.successful, result.reason) for result in self.set_one_by_one(
            [parameter.to_parameter_msg() for parameter in overrides_of(named)])]

    def set_one_by_one(self, parameters):
        """Return the result of each."""
        return self.call('/predictor/set_parameters', SetParameters, SetParameters.Request(
            parameters=parameters)).results

    def set_at_once(self, parameters):
        """Return the one result of all."""
        return self.call(
            '/predictor/set_parameters_atomically', SetParametersAtomically,
            SetParametersAtomically.Request(parameters=parameters)).result


@pytest.fixture
def caller(ros):
    """Give a node beside the predictor."""
    return Caller(ros)


def cup(node):
    """Return the stiffness and the damping that the node shows."""
    return [list(node.get_parameter(f'cup.{name}').value) for name in ('stiffness', 'damping')]


def used(node):
    """Return the blocks of K and P that the prediction is made with."""
    return node.pipeline.live.model[0][2:]


@pytest.mark.parametrize(('stiffness', 'damping', 'named'), [
    (K, INDEFINITE, 'cup.damping'), ((1e-300 * np.eye(6)).ravel().tolist(), P, 'cup.stiffness')])
@pytest.mark.parametrize('order', [1, -1])
def test_no_parameter_changes_if_one_is_rejected(stiffness, damping, named, order, node, caller):
    """Refuse both with the reason, whichever comes first in the call."""
    shown, before = cup(node), used(node)
    both = [('cup__stiffness', stiffness), ('cup__damping', damping)][::order]
    results = caller.set_parameters(**dict(both))

    assert [successful for successful, _ in results] == [False, False]
    assert all(named in reason for _, reason in results)
    assert cup(node) == shown
    assert used(node) == before


def test_package_changes_live_and_what_stays_has_no_effect(node, caller):
    """Take 3 for 3.0, as `ros2 param set` sends it; make nothing anew for what was dumped."""
    assert caller.set_parameters(package__mass=3, package__com=[0, 0, -1]) == [(True, '')] * 2
    assert node.get_parameter('package.mass').value == 3.0
    assert node.pipeline.live.model[1][:2] == (3.0, (0.0, 0.0, -1.0))
    before, model = node.values, node.pipeline.live.model
    dumped = {name.replace('.', '__'): node.get_parameter(name).value
              for name in before if node.has_parameter(name)}
    assert caller.set_parameters(**dumped) == [(True, '')] * len(dumped)
    assert node.values is before and node.pipeline.live.model is model


def test_what_does_not_belong_together_is_set_one_by_one(node, caller):
    """Set what can be set; a fixed parameter with its own value is no failure of a load."""
    results = caller.set_parameters(
        gravity__magnitude=9.81, tool_twist__frame='tool', frames__package='box', cup__stifness=K,
        bags=['a'])

    assert [successful for successful, _ in results] == [True, False, True, False, False]
    assert 'read-only' in results[1][1]
    assert "'cup.stiffness'" in results[3][1]
    assert 'identifier' in results[4][1]
    assert node.values['frames.package'] == 'box'


@pytest.mark.parametrize('order', [1, -1])
def test_thresholds_and_ranges_change_together(order, node, caller):
    """Take both ends of a range in one call, although neither fits the other's old value."""
    high = {'vacuum__attach_below': 96e3, 'vacuum__detach_above': 98e3,
            'envelope__deflection_low': [0.01] * 6, 'envelope__deflection_high': [0.02] * 6}
    assert caller.set_parameters(**dict(list(high.items())[::order])) == [(True, '')] * 4
    assert node.values['envelope.deflection_low'] == (0.01,) * 6


@pytest.mark.parametrize(('values', 'named'), [
    ({'envelope__deflection_low': [0.01] * 6}, ''), ({'package__mass': 5e-324}, 'package.mass'),
    ({'cup__damping': (1e6 * np.eye(6)).ravel().tolist()}, 'cup.damping'),
])
def test_what_cannot_be_computed_with_is_refused(values, named, node, make_predictor, caller):
    """Refuse it before it is in use, and go on."""
    before = node.values
    (successful, reason), = caller.set_parameters(**values)
    assert not successful and named in reason
    assert node.values is before
    with pytest.raises(BellowsError, match=named or None):
        make_predictor({**PACKAGE, **{k.replace('__', '.'): v for k, v in values.items()}})


def test_a_cup_of_a_gripper_is_opened_and_closed_live(node, caller):
    """It leaves the stiffness; an empty list, which has no type, brings it back."""
    single = used(node)[0][0][0]
    assert caller.set_parameters(cup__layout=[0.05, 0.0, 0.0, -0.05, 0.0, 0.0]) == [(True, '')]
    assert used(node)[0][0][0] == pytest.approx(2.0 * single)
    assert caller.set_parameters(cup__open=[1]) == [(True, '')]
    assert used(node)[0][0][0] == pytest.approx(single)
    ((successful, reason),) = caller.set_parameters(cup__open=[2])
    assert not successful and 'cup.layout' in reason
    assert caller.set_parameters(cup__open=[]) == [(True, '')]
    assert used(node)[0][0][0] == pytest.approx(2.0 * single)


@pytest.mark.parametrize(('name', 'value', 'named'), [
    ('', 1.0, ''), ('package.com', '[0, 0, x]', "the text '[0, 0, x]'"),
    ('package.mass', '2,5', "the text '2,5'"), ('cup.name', 'a\x1b[31mb', r"'a\x1b[31mb'"),
    ('x\x1b[31m\n', 1.0, r"'x\x1b[31m\n'")])
def test_what_is_wrong_with_a_value_is_named(name, value, named, node, caller):
    """In both services, in printable characters."""
    before = node.values
    odd = [Parameter(name, value=value).to_parameter_msg()]
    for result in (*caller.set_one_by_one(odd), caller.set_at_once(odd)):
        assert not result.successful
        assert named in result.reason and result.reason.isprintable()
    assert node.values is before


@pytest.mark.parametrize('kind', range(5, 10))
def test_an_empty_list_is_refused_for_all_but_lists_of_any_length(kind, node, caller):
    """Answer for each parameter and type of list, since a tool sends an empty one as bytes."""
    names = [p.name for p in parameters_for('predictor') if p.length != ANY_LENGTH
             and p.kind != 'string_array' and p.name not in POSE_PARAMETERS]
    results = [caller.set_one_by_one([ParameterMessage(
        name=name, value=ParameterValue(type=kind))])[0] for name in names]
    assert len(names) > 60 and not any(result.successful for result in results)
    assert all(name in result.reason for name, result in zip(names, results, strict=True))
    assert not node.failures


def test_a_list_of_integers_and_doubles_is_set_as_on_the_command_line(node, caller):
    """`ros2 param set` sends it as a text."""
    assert caller.set_parameters(package__com='[0.01, 0, -0.05]') == [(True, '')]
    assert node.values.package.com == (0.01, 0.0, -0.05)


def test_doubts_are_answered_and_logged_with_both_values(node, caller, capfd):
    """Accept an unlikely value with a question, once."""
    results = caller.set_parameters(package__com=[0.0, 0.0, 0.03])
    assert results[0][0] and 'Is it -0.03?' in results[0][1]
    assert caller.set_parameters(coast__limit=0.3) == [(True, '')]
    log = capfd.readouterr().err
    assert 'package.com from [0, 0, -0.03] to [0, 0, 0.03]' in log and 'Is it -0.03?' in log


def test_malformed_requests_are_answered(node, caller):
    """Refuse a type that does not exist, and the removal of a parameter; live on."""
    for kind in (0, 99):
        odd = [ParameterMessage(name='package.mass', value=ParameterValue(type=kind))]
        assert not any(result.successful for result in caller.set_one_by_one(odd))
        assert not caller.set_at_once(odd).successful
    assert caller.set_parameters(package__mass=2.0) == [(True, '')]


def test_one_type_that_does_not_exist_spoils_no_other_answer(node, caller, capfd):
    """Set the others that stand alone; refuse those that belong to it; report no fault of ours."""
    odd = [Parameter(name, value=value).to_parameter_msg() for name, value in (
        ('measured.noise', [1e-3, 1e-3]), ('coast.limit', 0.3), ('package.mass', 2.0),
        ('landing.height', -0.5))]
    for name in ('safety.least', 'use_sim_time'):
        odd.insert(2, ParameterMessage(name=name, value=ParameterValue(type=99)))
    results = caller.set_one_by_one(odd)
    assert [result.successful for result in results] == [True, True, False, False, True, True]
    assert all(result.reason for result in results[2:4])
    odd.append(ParameterMessage(name='package.com', value=ParameterValue(type=77)))
    odd[4].value.double_value = 2.5
    assert [result.successful for result in caller.set_one_by_one(odd)] == [
        True, True, False, False, False, True, False]
    assert not caller.set_at_once(odd).successful
    assert node.values.package.mass == 2.0 and not node.failures
    assert 'report' not in capfd.readouterr().err


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
    mass = {d.name: d for d in answer.descriptors}['package.mass'].floating_point_range[0]
    assert (mass.from_value, mass.to_value) == (0.0, 1e4)


def test_one_file_serves_both_nodes(make_predictor, capfd):
    """Accept the identifier's names and ROS's own; warn about an override that no topic takes."""
    misspelt = 'qos_overrides./tool_arm/poze.subscription.depth'
    node = make_predictor({**PACKAGE, 'fit.structure': 'full', 'use_sim_time': False,
                           'package.mass': 2, misspelt: 5})
    assert f"'{misspelt}'" in capfd.readouterr().err
    assert node.get_parameter('package.mass').value == 2.0
    assert not node.has_parameter('fit.structure')


def test_file_with_named_cups_survives_a_round_trip_through_a_node(make_predictor, tmp_path):
    """Start from a file that was written, show what it says, and start from what is shown."""
    given = {**PACKAGE, 'cup.name': 'soft', 'cups.soft.stiffness': K, 'cups.soft.length': 0.05,
             'cups.hard.stiffness': THESIS.stiffness.ravel().tolist(), 'coast.limit': 0.05}
    written, shown = tmp_path / 'cups.yaml', given
    for _ in range(2):
        write_parameters(written, shown)
        assert read_parameters(written).keys() >= given.keys()
        node = make_predictor({}, cli_args=['--ros-args', '--params-file', str(written)])
        for name, value in given.items():
            got = node.get_parameter(name).value
            assert (list(got) if isinstance(value, list) else got) == value
        assert used(node)[0][0][0] == K[0]
        shown = node.values
        node.close()


def ends(parameter):
    """Return the smallest and the largest value of a parameter."""
    low = parameter.minimum
    if low is None and parameter.above is not None:
        low = float(np.nextafter(parameter.above, np.inf))
    values = [float(end) for end in (low, parameter.maximum) if end is not None]
    if parameter.kind == 'double':
        return values
    size = parameter.length
    diagonal = size == 36 and not parameter.name.endswith('_std')
    of = np.eye(6).ravel() if diagonal else np.ones(size)
    return [(value * of).tolist() for value in values]


@pytest.mark.timeout(400)
@pytest.mark.usefixtures('rubber_kernels')
def test_both_ends_of_each_range_work_or_are_refused(make_partner, monkeypatch):
    """
    Predict, plan, land and report with each, or change nothing and name what is wrong.

    What a node would do for messages is called here, as nothing else runs.
    """
    partner = make_partner(VALUES.replaced({'package.size': [0.1] * 3, 'landing.height': -1.0}))
    node, tried = partner.predictor, 0
    pipeline = node.pipeline
    topics = [*vars(pipeline.outputs).values(), *vars(pipeline.planning).values()]
    for topic in topics:
        if hasattr(topic, 'subscribed'):
            topic.subscribed = True
    plan = encode_multi_dof(message())
    for parameter in parameters_for('predictor'):
        if parameter.read_only or not parameter.kind.startswith('double'):
            continue
        before = node.get_parameter(parameter.name)
        for value in ends(parameter):
            kept, tried = node.values, tried + 1
            shown = node.get_parameter(parameter.name).value
            (result,) = node.set_parameters([Parameter(parameter.name, value=value)])
            if not result.successful:
                assert result.reason and node.values == kept, parameter.name
                assert node.get_parameter(parameter.name).value == shown
                continue
            partner.wait(lambda: not node.pipeline._is_compiling)
            begun = time.process_time()
            for k in range(1, 12):
                pipeline.process_pose(tried * 10**9 + k * 4_000_000, 'world',
                                      (1e-5 * k * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            pipeline.planning._answer(pipeline.planning._of_tool, plan)
            if pipeline.latest is not None:
                pipeline._land(pipeline.latest, None, np.eye(12), 0)
            pipeline._tick()
            node.diagnostics.report()
            assert not node.failures, (parameter.name, value)
            assert time.process_time() - begun < 10.0, (parameter.name, value)
        set_on(node, parameter.name, before.value)
    assert tried > 70


def test_a_failed_set_changes_no_parameter(node):
    """Go back to what was, though it fails where the values are used."""
    kept = node.values
    break_once(node.pipeline.outputs, 'use_values')
    result = node.set_parameters_atomically([Parameter('cup.stiffness', value=K)])
    assert not result.successful and 'broken' in result.reason
    assert node.values == kept and list(kept['cup.stiffness']) == cup(node)[0]
    assert used(node)[0][0][0] == kept['cup.stiffness'][0] and sum(node.failures.values()) == 1


def test_prediction_continues_while_another_kind_of_cup_compiles(make_partner, monkeypatch):
    """Predict with the cup before until what a cup that relaxes needs is compiled beside it."""
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
