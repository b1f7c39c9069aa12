"""The SROS 2 policy against the graph: all that the nodes use, and no more."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from .conftest import PACKAGE

ROS_OPTIONAL = {'/tf', '/clock', '/parameter_events', '/vacuum/held', '/vacuum/pressure',
                '/rosout'}  # fmt: skip


def permitted(root: Path, node: str) -> dict[tuple[str, str], set[str]]:
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


def _full(name: str, node: str) -> str:
    """Return a name as the graph has it."""
    name = name.replace('~/', f'/{node}/')
    return name if name.startswith('/') else f'/{name}'


def in_graph(node: Any) -> dict[tuple[str, str], set[str]]:
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
def test_policy_of_the_predictor_is_exact(
        signal: str, root: Path, make_predictor: Callable[..., Any], ros: Any) -> None:
    """Permit what the graph shows; what the policy holds beyond is used in other settings."""
    node = make_predictor({**PACKAGE, 'vacuum.signal': signal})
    allowed = permitted(root, 'predictor')
    if not ros.spin_until(lambda: all(in_graph(node).values()), 10.0):
        pytest.skip('DDS discovery on this machine does not show the node to itself in time')
    for key, used in in_graph(node).items():
        assert used <= allowed[key]
        unused = allowed[key] - used
        assert unused <= ROS_OPTIONAL | {'/predictor/get_type_description'}, unused


def test_policy_of_the_identifier_is_enough(root: Path, ros: Any) -> None:
    """Permit what the graph shows."""
    from bellows_ros.nodes.identifier_node import IdentifierNode
    from rclpy.parameter import Parameter

    node = IdentifierNode(context=ros.context, parameter_overrides=[
        *(Parameter(name, value=value) for name, value in PACKAGE.items()),
        Parameter('bags', value=[str(root / 'bags' / 'static')])])
    ros.executor.add_node(node)
    allowed = permitted(root, 'identifier')
    for key, used in in_graph(node).items():
        assert used <= allowed[key]
