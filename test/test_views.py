"""The layouts of RViz, Foxglove and PlotJuggler: they load, and show topics that are there."""

from functools import reduce
import json
import re
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML


def topics_of(content):
    """Return all topics in a layout."""
    return set(re.findall(r'/(?:tool_arm|package|cup)/\w+', json.dumps(content)))


@pytest.mark.parametrize('name', ['predictor.rviz', 'predictor.foxglove.json'])
def test_layouts_show_topics_of_the_predictor(name, root):
    """Name no topic that no node has."""
    text = (root / 'config' / name).read_text()
    content = YAML(typ='safe').load(text) if name.endswith('.rviz') else json.loads(text)
    shown = topics_of(content)
    nodes = ''.join(path.read_text() for path in (root / 'bellows_ros' / 'nodes').glob('*.py'))
    assert {'/tool_arm/pose', '/package/pose', '/package/measured', '/package/plan_path',
            } <= shown
    assert [topic for topic in shown if f"'{topic[1:]}'" not in nodes] == []


def test_every_curve_is_a_field_that_messages_have(root):
    """Name topics and fields as PlotJuggler and Foxglove do."""
    geometry = pytest.importorskip(
        'geometry_msgs.msg', reason="no ROS messages here (pip install '.[ros]')")
    types = {'/cup/wrench': geometry.WrenchStamped, '/cup/deflection': geometry.PoseStamped,
             '/cup/safety_factor': geometry.Vector3Stamped}
    layout = ElementTree.parse(root / 'config' / 'predictor.plotjuggler.xml')
    curves = [re.match('(/[^/]+/[^/]+)/(.*)', curve.get('name')).groups()
              for curve in layout.iter('curve')]
    content = json.loads((root / 'config' / 'predictor.foxglove.json').read_text())
    curves += [path['value'].split('.', 1) for panel in content['configById'].values()
               for path in panel.get('paths', ())]
    assert len(curves) > 20
    for topic, fields in curves:
        assert isinstance(reduce(getattr, re.split('[/.]', fields), types[topic]()), float), fields
