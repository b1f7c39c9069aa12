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


@pytest.fixture
def number():
    """Return a function from a topic and the names of fields in it to a number of its message."""
    geometry = pytest.importorskip(
        'geometry_msgs.msg', reason="no ROS messages here (pip install '.[ros]')")
    types = {'/cup/wrench': geometry.WrenchStamped, '/cup/deflection': geometry.PoseStamped,
             '/cup/safety_factor': geometry.Vector3Stamped}
    return lambda topic, fields: reduce(getattr, fields, types[topic]())


def test_every_curve_of_the_plotjuggler_layout_is_a_field_that_messages_have(root, number):
    """Name topics and fields with slashes; one area for each share of the height."""
    layout = ElementTree.parse(root / 'config' / 'predictor.plotjuggler.xml').getroot()
    splitter = layout.find('tabbed_widget/Tab/Container/DockSplitter')
    areas = splitter.findall('DockArea')
    assert len(areas) == int(splitter.get('count')) == len(splitter.get('sizes').split(';'))
    curves = [curve.get('name') for area in areas for curve in area.findall('plot/curve')]
    assert len(curves) == 11
    for _, cup, topic, *fields in (name.split('/') for name in curves):
        assert isinstance(number(f'/{cup}/{topic}', fields), float), (topic, fields)


def test_every_plot_of_the_foxglove_layout_is_of_fields_that_messages_have(root, number):
    """Name panels and paths as Foxglove saves them, with fields of the messages' own types."""
    content = json.loads((root / 'config' / 'predictor.foxglove.json').read_text())
    for name, panel in content['configById'].items():
        assert panel['foxglovePanelTitle'] and 'title' not in panel
        for path in panel.get('paths', ()):
            topic, *fields = path['value'].split('.')
            assert isinstance(number(topic, fields), float), name
            assert path['timestampMethod'] == 'headerStamp' and path['enabled']
