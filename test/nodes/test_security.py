"""The SROS 2 policy against the graph: all that the nodes use, and no more; nothing unsecured."""

from xml.etree import ElementTree

import pytest

from .conftest import GIVEN, overrides_of, PACKAGE
from .test_command import run

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
