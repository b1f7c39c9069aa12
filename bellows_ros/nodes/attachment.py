"""Attaching and detaching the package: two services, and a vacuum signal if there is one."""

from functools import partial
from typing import Any

from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from .conversions import stamp_to_ns
from .tool_inputs import SensorInput
from ..core.live.health import Status, vacuum_status
from ..core.live.load import ALL, Vacuum


class Attachment:
    """
    Ask to attach and to detach.

    What a service asks for holds until the vacuum signal changes the next time.

    Parameters
    ----------
    pipeline : Pipeline
        Attaches and detaches.

    Attributes
    ----------
    held : bool
        Whether the cup holds the package, as far as is known.
    signal : SensorInput or None
        The vacuum signal, where one is asked for.
    vacuum : Vacuum
        Which cups hold, by their pressures.

    """

    def __init__(self, pipeline: Any) -> None:
        """Offer the services, and listen to the vacuum if the parameters say so."""
        self._pipeline, node, values = pipeline, pipeline.node, pipeline.values
        self.vacuum = Vacuum(values)
        self._kind = values['vacuum.signal']
        self.held = values['package.attached'] and self._kind == 'none'
        for service, held, words in (
                ('attach', True, 'Attached: starts from rest at the next tool pose.'),
                ('detach', False, 'Detached: nothing is predicted.')):
            node.create_service(Trigger, f'package/{service}', partial(self._answer, held, words))
        self._last_reading: bool | None = None  # by the vacuum signal, the last time
        self._refused = {'nan': 0, 'negative': 0, 'no_such_cup': 0}
        self.signal = None if self._kind == 'none' else SensorInput(node, *{
            'bool': (Bool, 'vacuum/held', self._on_held),
            'pressure': (FluidPressure, 'vacuum/pressure', self._on_pressure)}[self._kind])

    def _answer(
        self, held: bool, words: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Carry out a service request."""
        response.success = self._pipeline.attach(held, 'service')
        response.message = words if response.success else 'The node is not active.'
        if response.success:
            self.held = held
        return response

    def _on_held(self, message: Bool) -> None:
        """Follow a vacuum switch."""
        assert self.signal
        self.signal.note()
        self._pipeline.observing.on_vacuum(message.data, ALL)
        self._follow(message.data)

    def _on_pressure(self, message: FluidPressure) -> None:
        """Follow the pressure in the cup, and go on without cups of a gripper that lose it."""
        assert self.signal
        self.signal.note(stamp_to_ns(message.header.stamp))
        vacuum, opened = self.vacuum, self.vacuum.open_cups
        readings = vacuum.update(message.fluid_pressure, message.header.frame_id)
        if isinstance(readings, str):
            self._refused[readings] += 1
            return
        for reading in readings:
            self._pipeline.observing.on_vacuum(*reading)
        if vacuum.pressure is not None:
            self._pipeline.load.set_pressure(vacuum.pressure)
        if vacuum.open_cups != opened:
            cups = ', '.join(map(str, vacuum.open_cups))
            self._pipeline.node.get_logger().warning(
                f'Without vacuum: cups {cups} of cup.layout.' if cups else 'All cups have vacuum.')
            self._pipeline.use_values()
        self._follow(vacuum.held)

    def _follow(self, held: bool) -> None:
        """Follow the vacuum when it changes; a node that is not active yet does so once it is."""
        changed, self._last_reading = held != self._last_reading, held
        if changed and held != self.held:
            self.held = held
            self._pipeline.attach(held, 'vacuum')

    def status(self, name: str) -> Status | None:
        """Return the diagnostics line on the vacuum signal, if there is to be one."""
        if self.signal is None:
            return None
        latched = self._kind == 'bool'
        return vacuum_status(name, self.signal.seen(self._refused), self.held, latched)
