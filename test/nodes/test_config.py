"""The files that are shipped: configuration, the example of the pages, policies of SROS 2."""

import runpy
import subprocess
import sys
from xml.etree import ElementTree

from bellows_ros.core.model.cup_package import Cup
from bellows_ros.core.parameters.table import parameters_for
from bellows_ros.files.parameter_files import read_parameters
from geometry_msgs.msg import InertiaStamped, TwistStamped
import pytest

from .conftest import GIVEN, overrides_of, PACKAGE
from .test_command import run

NAMES = ('predictor', 'identifier', 'cup_thesis')


@pytest.mark.parametrize('name', (*NAMES, 'ur'))
def test_every_value_has_its_unit(name, root):
    """Find a comment on every line that holds a value, and read the file."""
    file = root / 'config' / f'{name}.yaml'
    assert read_parameters(file)
    for line in file.read_text().splitlines():
        text, _, comment = line.partition('#')
        is_heading = text.strip().endswith(':')
        assert comment.strip() or is_heading or not text.strip(), line


@pytest.mark.parametrize('name', NAMES)
def test_our_reader_takes_it(name, root):
    """Read every file with the checks of the table, and show what holds without the file."""
    values = read_parameters(root / 'config' / f'{name}.yaml')
    if name == 'cup_thesis':
        cup = Cup.thesis()
        assert values['cup.stiffness'] == tuple(cup.stiffness.ravel())
        assert values['cup.damping'] == tuple(cup.damping.ravel())
        assert values['cup.length'] == cup.length
    elif name == 'predictor':
        assert {f'package.{own}' for own in ('mass', 'inertia', 'com')} == set(values)
    else:
        ours = {p.name for p in parameters_for(name)}
        of_the_cup = ('cup.stiffness', 'cup.damping', 'cup.length', 'cup.relaxation',
                      'cup.stretch', 'cup.valid_', 'cup.layout', 'cup.open')
        # ROS has no empty list to show.
        of_many = ('package.files', 'fit.free')
        shown = set(values) | {n for n in ours if n.startswith((*of_the_cup, *of_many))}
        assert ours - shown == set(), 'not in the file'
    chosen = {'bags', 'cup.length', 'output.parameters', 'output.json'}  # of the recording, names
    for parameter in (p for user in ('predictor', 'identifier') for p in parameters_for(user)):
        if parameter.default is not None and parameter.name in set(values) - chosen:
            assert values[parameter.name] == parameter.default, parameter.name


def test_launch_file_gives_the_package_after_the_cup(root):
    """Let the package of the user prevail there, too, and do without a cup."""
    launched = runpy.run_path(str(root / 'launch' / 'predictor.launch.py'))
    usual = {name: default for name, (default, _) in launched['ARGUMENTS'].items()}
    switches = {'autostart': True, 'use_sim_time': False}

    for cup, files in (('c.yaml', ['c.yaml', 'p.yaml']), ('', ['p.yaml'])):
        node = launched['node_arguments']({**usual, 'params_file': 'p.yaml', 'cup_file': cup})
        assert node['parameters'] == [*files, switches] and node['remappings'] == []


def test_launch_file_remaps_every_topic(root, make_predictor):
    """Give each topic of a running node an argument; pass simulated time on."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    launched = runpy.run_path(str(root / 'launch' / 'predictor.launch.py'))
    value = {name: default for name, (default, _) in launched['ARGUMENTS'].items()}
    value |= {'params_file': 'p.yaml', 'use_sim_time': 'True'}
    value |= {name: f'/cell/{name}' for name in launched['TOPICS']}
    arguments = launched['node_arguments'](value)
    assert arguments['parameters'][-1] == {'autostart': True, 'use_sim_time': True}
    remaps = [word for pair in arguments['remappings'] for word in ('-r', ':='.join(pair))]
    node = make_predictor(cli_args=['--ros-args', *remaps])
    own = {end.topic_name for end in (*node.subscriptions, *node.publishers)}
    others = {name for name in own if not name.startswith('/cell/')}
    assert others <= {'/parameter_events', '/rosout', '/predictor/transition_event'}
    assert len(own - others) > 20


def test_predictor_starts_with_its_files(root, make_predictor):
    """Give the real node both files, as a user would."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    files = [root / 'config' / f'{name}.yaml' for name in ('cup_thesis', 'predictor')]
    node = make_predictor({}, cli_args=[
        '--ros-args', *(part for file in files for part in ('--params-file', str(file)))])

    expected = {name: value for file in files for name, value in read_parameters(file).items()}
    for name, value in expected.items():
        shown = node.get_parameter(name).value
        assert (tuple(shown) if isinstance(value, tuple) else shown) == value
    assert node.overridden == set(expected)


HELD, GRIPPER = 2.5, 1.5  # kg
OPTIONS = {'gripper_mass': GRIPPER, 'gripper_com': [0.0, 0.0, 0.04], 'lip_distance': 0.0981}


def estimate(mass, x, z):
    """Return an estimated payload, or its standard deviations."""
    message = InertiaStamped()
    message.inertia.m, message.inertia.com.x, message.inertia.com.z = mass, x, z
    return message


def test_a_ur_gets_the_total_payload_at_its_flange(peer, root, user_environment):
    """As the estimate is sure: of gripper and package together, with z away from the arm."""
    SetPayload = pytest.importorskip('ur_msgs.srv', reason='no ur_msgs here').SetPayload
    asked = []
    peer.node.create_service(
        SetPayload, '/io_and_status_controller/set_payload',
        lambda request, response: asked.append(request) or response)
    twists, stds, estimates = (peer.writes(kind, f'package/{name}', 10) for kind, name in (
        (TwistStamped, 'twist'), (InertiaStamped, 'estimated_std'), (InertiaStamped, 'estimated')))
    words = [word for name, value in OPTIONS.items() for word in ('-p', f'{name}:={value}')]
    example = subprocess.Popen(
        [sys.executable, root / 'docs/examples/ur_payload.py', '--ros-args', *words],
        env=user_environment)
    try:
        peer.connect()

        def is_asked():
            for writer, message in ((twists, TwistStamped()), (stds, estimate(0.01, 1e-3, 1e-3)),
                                    (estimates, estimate(HELD, 0.02, -0.03))):
                writer.publish(message)
            return asked

        peer.wait(is_asked)
    finally:
        example.kill()
        example.wait()
    total = GRIPPER + HELD
    assert asked[0].mass == pytest.approx(total)
    center = asked[0].center_of_gravity
    assert center.x == pytest.approx(HELD * 0.02 / total)
    assert center.z == pytest.approx((GRIPPER * 0.04 + HELD * (0.0981 + 0.03)) / total)


ROS_OPTIONAL = {'/tf', '/tf_static', '/clock', '/parameter_events', '/vacuum/held',
                '/vacuum/pressure', '/rosout', '/package/camera_info'}
ENCLAVE = ('identity_ca.cert.pem', 'cert.pem', 'key.pem', 'permissions_ca.cert.pem',
           'governance.p7s', 'permissions.p7s')


def permitted(root, node):
    """Return the full names that a node may use, by kind and direction."""
    tree = ElementTree.parse(root / 'security' / 'policies.xml')
    found: dict[tuple[str, str], set[str]] = {}
    for group in tree.find(f".//profile[@node='{node}']"):
        (direction,) = [key for key, value in group.attrib.items() if value == 'ALLOW']
        names = (str(item.text).replace('~/', f'/{node}/') for item in group)
        found[group.tag, direction] = {f'/{name.removeprefix("/")}' for name in names}
    return found


def in_graph(node):
    """Return the full names that a running node uses."""
    calls = {
        ('topics', 'subscribe'): node.get_subscriber_names_and_types_by_node,
        ('topics', 'publish'): node.get_publisher_names_and_types_by_node,
        ('services', 'reply'): node.get_service_names_and_types_by_node}
    return {key: {name for name, _ in call(node.get_name(), node.get_namespace())}
            for key, call in calls.items()}


@pytest.mark.parametrize('signal', ['none', 'bool', 'pressure'])
def test_policy_of_the_predictor_is_exact(signal, root, make_predictor, ros):
    """Permit what the graph shows; what the policy holds beyond is used in other settings."""
    node = make_predictor({**PACKAGE, 'vacuum.signal': signal})
    allowed = permitted(root, 'predictor')
    assert ros.spin_until(lambda: all(in_graph(node).values()))
    for key, used in in_graph(node).items():
        assert used <= allowed[key]
        unused = allowed[key] - used
        assert unused <= ROS_OPTIONAL | {'/predictor/get_type_description'}, unused


def test_policy_of_the_identifier_is_enough(root, ros):
    """Permit what the graph shows, of a node whose work has ended: no thread outlives the test."""
    from bellows_ros.nodes.identifier_node import IdentifierNode

    node = IdentifierNode(context=ros.context, parameter_overrides=overrides_of({
        **PACKAGE, 'recording.package_frame': 'com', 'bags': [str(root / 'nowhere')]}))
    ros.executor.add_node(node)
    assert ros.spin_until(node.finished.done) and node.finished.exception()
    allowed = permitted(root, 'identifier')
    for key, used in in_graph(node).items():
        assert used <= allowed[key]


@pytest.mark.parametrize('name, enclave', [('predictor', True), ('identifier', False)],
                         ids=['nothing signed', 'no keystore'])
def test_what_is_to_be_secured_and_cannot_be_does_not_start(
        name, enclave, root, tmp_path, user_environment):
    """End with 2 and the reason, rather than run in the clear: where DDS has no security too."""
    folder = tmp_path / 'enclaves' / 'bellows_ros' / name
    if enclave:
        folder.mkdir(parents=True)
        for file in ENCLAVE:
            (folder / file).write_text('neither key nor signature')
    environment = {**user_environment, 'ROS_SECURITY_ENABLE': 'true',
                   'ROS_SECURITY_STRATEGY': 'Enforce', 'ROS_SECURITY_KEYSTORE': str(tmp_path)}
    done = run(environment, root, '-m', 'bellows_ros.nodes.command', name, '--ros-args',
               '--enclave', f'/bellows_ros/{name}', *GIVEN)
    assert done.returncode == 2, done.stderr
    assert 'security' in done.stderr.lower() and 'Traceback' not in done.stderr
