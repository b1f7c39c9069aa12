"""The predictor as a managed node: transitions over services, and silence unless active."""

from threading import active_count

from bellows_ros.errors import BellowsError
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
import pytest
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from .conftest import MS, PACKAGE, Peer, pose_at, set_on, START

ALL = {'package/pose': PoseStamped, 'package/twist': TwistStamped, 'package/odometry': Odometry,
       'cup/wrench': WrenchStamped, 'cup/deflection': PoseStamped, 'package/markers': MarkerArray}


class Manager(Peer):
    """A lifecycle manager: calls services and listens to everything."""

    def __init__(self, ros):
        """Join the graph."""
        super().__init__(ros, 'manager')
        self.heard: list[str] = []
        for topic, kind in ALL.items():
            self.hears(kind, topic, decode=lambda _, topic=topic: self.heard.append(topic))
        self.states = self.hears(String, 'package/state', decode=lambda message: message.data)
        self.writer = self.writes(PoseStamped, 'tool_arm/pose')
        self._stamp = START

    def change(self, transition):
        """Ask for a transition by its number, or by its label."""
        named = {'label' if isinstance(transition, str) else 'id': transition}
        request = ChangeState.Request(transition=Transition(**named))
        return bool(self.call('/predictor/change_state', ChangeState, request).success)

    def state(self):
        """Ask for the state."""
        return str(self.call('/predictor/get_state', GetState).current_state.label)

    def send(self, count=20):
        """Send poses of a tool that stands still."""
        for _ in range(count):
            self._stamp += 2 * MS
            self.writer.publish(pose_at(self._stamp))

    def take_what_is_under_way(self):
        """Forget messages that were sent before, in whatever order the topics bring them."""
        while self.heard:
            self.heard.clear()
            self.ros.spin_until(lambda: bool(self.heard), 0.1)

    def hears_all(self):
        """Send poses and tell whether all topics answer."""
        self.heard.clear()
        self.connect()
        self.send()
        return bool(self.ros.spin_until(lambda: set(self.heard) == set(ALL)))


@pytest.fixture
def manager(ros):
    """Give a lifecycle manager."""
    return Manager(ros)


def test_every_transition(make_predictor, manager):
    """Go through all states twice, with what was set before; publish only while active."""
    node = make_predictor({**PACKAGE, 'autostart': False})
    assert manager.state() == 'unconfigured'
    set_on(node, 'package.mass', 1.0)
    threads = active_count()
    for _ in range(2):
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state() == 'inactive'
        assert node.pipeline.live.model[1][0] == 1.0
        manager.wait(manager.is_connected)
        manager.send()
        for service in ('/predictor/reset', '/package/detach'):
            assert not manager.call(service, Trigger).success
        assert manager.heard == [] and node.pipeline.live.screen.poses == 0
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        assert manager.hears_all()
        assert manager.change('deactivate')
        manager.wait(lambda: manager.states[-1:] == ['inactive'])
        manager.take_what_is_under_way()
        manager.send()
        assert manager.change(Transition.TRANSITION_CLEANUP)
        assert manager.state() == 'unconfigured' and manager.heard == []
        manager.wait(lambda: active_count() <= threads)
    assert manager.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert manager.state() == 'finalized'


def test_a_transition_that_is_not_allowed_is_refused(make_predictor, manager):
    """Answer no to each of them, and go on as before."""
    make_predictor({**PACKAGE, 'autostart': False})
    for state, allowed in (('unconfigured', (1, 5)), ('inactive', (3, 2, 6)), ('active', (4, 7))):
        for transition in sorted({*range(9), 60, 99} - {*allowed}):
            assert not manager.change(transition), transition
            assert manager.state() == state
        assert not manager.change('configured')
        if state != 'active':
            assert manager.change(allowed[0])
    assert manager.hears_all()


def test_failed_configuration_leaves_no_parts(make_predictor, manager):
    """Say why, whatever the reason, and have no topics however often it is tried."""
    override = 'qos_overrides./tool_arm/pose.subscription.reliability'
    node = make_predictor({**PACKAGE, 'autostart': False, override: 'nonsense'})
    before = {*node.publishers, *node.subscriptions, *node.services}
    for _ in range(3):
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state() == 'unconfigured'
        assert {*node.publishers, *node.subscriptions, *node.services} == before
    with pytest.raises(BellowsError, match='nonsense'):
        make_predictor({**PACKAGE, override: 'nonsense'})


def test_package_is_attached_and_detached(node, manager):
    """Predict only while it is attached, and say so."""
    assert manager.hears_all()
    assert manager.call('/package/detach', Trigger).success
    manager.wait(lambda: manager.states[-1] == 'detached')
    manager.take_what_is_under_way()
    before = node.pipeline.live.screen.poses
    manager.send(20)
    manager.wait(lambda: node.pipeline.live.screen.poses == before + 20)
    answer = manager.call('/package/attach', Trigger)
    assert answer.success and set(manager.heard) <= {'package/markers'}  # that takes them away
    assert manager.hears_all()
    manager.wait(lambda: manager.states[-1] != 'detached')


@pytest.mark.parametrize('signal', ['bool', 'pressure'])
def test_vacuum_attaches_and_detaches(signal, make_predictor, manager):
    """Follow the switch or the pressure; without a signal nothing is held."""
    node = make_predictor({**PACKAGE, 'vacuum.signal': signal})
    kind, topic = (Bool, 'vacuum/held') if signal == 'bool' else (FluidPressure, 'vacuum/pressure')
    writer = manager.writes(kind, topic)
    manager.connect()
    assert node.pipeline.live.attached is False
    for held in (True, False, True):
        writer.publish(Bool(data=held) if signal == 'bool' else FluidPressure(
            fluid_pressure=30e3 if held else 101e3))
        manager.wait(lambda held=held: node.pipeline.live.attached is held)
    assert manager.hears_all()
