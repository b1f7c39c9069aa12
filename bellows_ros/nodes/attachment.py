"""Attaching and detaching the package: two services, and a vacuum signal if there is one."""

from collections.abc import Callable, Mapping
from functools import partial
import math
import re
import time
from typing import Any

from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from .conversions import stamp_to_ns
from .guarding import GuardedNode
from .tool_inputs import SensorInput
from ..core.live.health import Status, vacuum_status
from ..core.live.load import is_held, why_no_pressure


class Attachment:
    """
    Ask to attach and to detach.

    What a service asks for holds until the vacuum signal changes the next time.

    Parameters
    ----------
    node : GuardedNode
        Serves and subscribes.
    values : mapping
        Parameters by name.
    change : callable
        Takes True to attach, False to detach, and why; returns whether it is done.
    hear : callable
        Takes each pressure in the cup, Pa; of several sensors the highest of cups that hold.
    on_held : callable
        Takes of each message of the vacuum whether the cup holds, before anything is changed.
    on_open : callable
        Is called when other cups of a gripper hold.

    Attributes
    ----------
    held : bool
        Whether the cup holds the package, as far as is known.
    signal : SensorInput or None
        The vacuum signal, where one is asked for.
    open_cups : tuple of int
        Cups of cup.layout without vacuum, by sensors of their own.

    """

    def __init__(
        self, node: GuardedNode, values: Mapping[str, Any], change: Callable[[bool, str], bool],
        hear: Callable[[float], None], on_held: Callable[[bool], None],
        on_open: Callable[[], None],
    ) -> None:
        """Offer the services, and listen to the vacuum if the parameters say so."""
        self._change, self._hear, self._join, self._on_open = change, hear, on_held, on_open
        self.open_cups: tuple[int, ...] = ()
        self._pressures: dict[int, float] = {}  # by cup, of those that hold
        self._seen: set[int] = set()  # cups with a sensor
        self.set_values(values)
        self._kind = signal = values['vacuum.signal']
        self.held = values['package.attached'] and signal == 'none'
        for service, held, words in (
                ('attach', True, 'Attached: starts from rest at the next tool pose.'),
                ('detach', False, 'Detached: nothing is predicted.')):
            node.create_service(
                Trigger, f'package/{service}', partial(self._answer, held, words))
        self._said: bool | None = None  # by the vacuum signal, the last time
        self._refused = {'nan': 0, 'negative': 0, 'no_such_cup': 0}
        self.signal: SensorInput | None = None
        if signal != 'none':
            self.signal = SensorInput(node, *{
                'bool': (Bool, 'vacuum/held', self._on_held),
                'pressure': (FluidPressure, 'vacuum/pressure', self._on_pressure)}[signal])

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Take other thresholds."""
        self._values = values

    def _answer(
        self, held: bool, words: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Carry out a service request."""
        response.success = self._change(held, 'service')
        response.message = words if response.success else 'The node is not active.'
        if response.success:
            self.held = held
        return response

    def _on_held(self, message: Bool) -> None:
        """Follow a vacuum switch."""
        assert self.signal
        self.signal.arrivals.add(time.monotonic_ns(), math.nan)  # without a stamp
        self._follow(message.data)

    def _on_pressure(self, message: FluidPressure) -> None:
        """Follow the pressure in the cup."""
        assert self.signal
        self.signal.note(time.monotonic_ns(), stamp_to_ns(message.header.stamp))
        pressure, cups = message.fluid_pressure, len(self._values['cup.layout']) // 3
        of_cup = re.search(r'cup_(\d{1,3})$', message.header.frame_id) if cups > 1 else None
        reason = why_no_pressure(pressure)
        if of_cup and not reason and int(of_cup[1]) >= cups:
            reason = 'no_such_cup'
        if reason:
            self._refused[reason] += 1
        elif of_cup:
            self._follow_cup(int(of_cup[1]), pressure)
        else:
            self._hear(pressure)
            self._follow(is_held(pressure, bool(self._said), self._values))

    def _follow_cup(self, cup: int, pressure: float) -> None:
        """Follow the pressure in one cup of a gripper, which holds while any of its cups does."""
        if is_held(pressure, cup in self._pressures, self._values):
            self._pressures[cup] = pressure
        else:
            self._pressures.pop(cup, None)
        self._seen.add(cup)
        if self._pressures:
            self._hear(max(self._pressures.values()))
            opened = tuple(sorted(self._seen - set(self._pressures)))
            if opened != self.open_cups:
                self.open_cups = opened
                self._on_open()
        self._follow(bool(self._pressures))

    def _follow(self, held: bool) -> None:
        """Follow the vacuum when it changes; a node that is not active yet does so once it is."""
        self._join(held)
        changed, self._said = held != self._said, held
        if changed and held != self.held:
            self.held = held
            self._change(held, 'vacuum')

    def status(self, name: str) -> Status | None:
        """Return the diagnostics line on the vacuum signal, if there is to be one."""
        if self.signal is None:
            return None
        latched = self._kind == 'bool'
        return vacuum_status(name, self.signal.seen(self._refused), self.held, latched)
