"""The SROS 2 policy against the graph: all that the nodes use, and no more; nothing unsecured."""

import subprocess
import sys
from xml.etree import ElementTree

import pytest

from .conftest import GIVEN, PACKAGE

ROS_OPTIONAL = {'/tf', '/tf_static', '/clock', '/parameter_events', '/vacuum/held',
                '/vacuum/pressure', '/rosout'}
ENCLAVE = ('identity_ca.cert.pem', 'cert.pem', 'key.pem', 'permissions_ca.cert.pem',
           'governance.p7s', 'permissions.p7s')


def permitted(root, node):
    """Return the full names that a node may use, by kind and direction."""
    tree = ElementTree.parse(root / 'security' / 'policies.xml')
    profile = tree.find(f".//profile[@node='{node}']")
    assert profile is not None
    found: dict[tuple[str, str], set[str]] = {}
    for group in profile:
        (direction,) = [key for key, value in group.attrib.items() if value == 'ALLOW']
        names = {str(item.text) for item in group}
        found[group.tag, direction] = {_full(name, node) for name in names}
    return found


def _full(name, node):
    """Return a name as the graph has it."""
    name = name.replace('~/', f'/{node}/')
    return name if name.startswith('/') else f'/{name}'


def in_graph(node):
    """Return the full names that a running node uses."""
    name, space = node.get_name(), node.get_namespace()
    return {
        ('topics', 'subscribe'): {t for t, _ in node.get_subscriber_names_and_types_by_node(
            name, space)},
        ('topics', 'publish'): {t for t, _ in node.get_publisher_names_and_types_by_node(
            name, space)},
        ('services', 'reply'): {t for t, _ in node.get_service_names_and_types_by_node(
            name, space)},
    }


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
    """Permit what the graph shows."""
    from bellows_ros.nodes.identifier_node import IdentifierNode
    from rclpy.parameter import Parameter

    node = IdentifierNode(context=ros.context, parameter_overrides=[
        *(Parameter(name, value=value) for name, value in PACKAGE.items()),
        Parameter('recording.package_frame', value='com'),
        Parameter('bags', value=[str(root / 'bags' / 'static')])])
    ros.executor.add_node(node)
    allowed = permitted(root, 'identifier')
    for key, used in in_graph(node).items():
        assert used <= allowed[key]


@pytest.mark.parametrize('name, enclave', [('predictor', True), ('identifier', False)],
                         ids=['nothing signed', 'no keystore'])
def test_what_is_to_be_secured_and_cannot_be_does_not_start(
        name, enclave, root, tmp_path, user_environment):
    """End with 2 and the reason, rather than run in the clear: where DDS has no security too."""
    pytest.importorskip('rclpy', reason="no rclpy here (pip install '.[ros]')")
    folder = tmp_path / 'enclaves' / 'bellows_ros' / name
    if enclave:
        folder.mkdir(parents=True)
        for file in ENCLAVE:
            (folder / file).write_text('neither key nor signature')
    done = subprocess.run(
        [sys.executable, '-m', 'bellows_ros.nodes.command', name, '--ros-args', '--enclave',
         f'/bellows_ros/{name}', *GIVEN],
        env={**user_environment, 'ROS_SECURITY_ENABLE': 'true',
             'ROS_SECURITY_STRATEGY': 'Enforce', 'ROS_SECURITY_KEYSTORE': str(tmp_path)},
        cwd=root, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2, done.stderr
    assert 'security' in done.stderr.lower() and 'Traceback' not in done.stderr
