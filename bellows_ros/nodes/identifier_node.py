"""The node that identifies a cup from recordings, and shows them."""

from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future as Work
from threading import Thread
import time
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from .parameters import ros_parameter, TableNode
from ..core.parameters import parameters_of, validate
from ..errors import BellowsError
from ..report.build import write_page
from ..workflows.identification import save
from ..workflows.identify import identify

TICK = 0.1
LONGEST_WAIT = 10.0
"""How long (s) the predictor is waited for."""

OF_THE_CUP = ('cup.', 'envelope.')
SHOWN = [p.name for p in parameters_of('identifier') if p.name.startswith(OF_THE_CUP)]
"""Parameters that are there when the work is done."""


class IdentifierNode(TableNode):
    """
    Identify a cup once, beside the executor, and show the result as parameters.

    Parameters
    ----------
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    finished : rclpy.task.Future
        Done when the work is and `exit_when_done` is set; raises what went wrong.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    def __init__(self, **options: Any) -> None:
        """Start the work."""
        super().__init__('identifier', read_only=True, results=SHOWN, **options)
        self.finished: Future = Future()
        self._stages: deque[str] = deque()
        self._said = ''
        self._work: Work[Any] = Work()
        if not self.values['bags']:
            self.destroy_node()
            raise BellowsError(
                'The parameter bags is empty. Name one or more recordings, for example '
                "--ros-args -p bags:='[recording]' or in the parameter file bags: ['recording'].")
        given = {name: value for name, value in self.values.items() if name in self.given}
        Thread(target=self._do_work, args=(given,), daemon=True).start()
        self._step: Callable[[], None] = self._await_work
        self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # --------------------------------------------------------- beside the executor

    def _do_work(self, settings: Mapping[str, Any]) -> None:
        """Identify and write the files, in a thread that touches nothing of ROS."""
        try:
            result = identify(settings, lambda stage, fraction: self._stages.append(stage))
            wanted = result.values
            save(result, wanted['output.parameters'], wanted['output.json'])
            if wanted['output.report']:
                write_page(result, wanted['output.report'])
            self._work.set_result(result)
        except Exception as error:  # noqa: BLE001 (it is raised again where the node ends)
            self._work.set_exception(error)

    # ------------------------------------------------------------- in the executor

    def _tick(self) -> None:
        """Do what comes next; what goes wrong ends the node."""
        try:
            self._step()
        except Exception as error:  # noqa: BLE001 (raised again by whoever waits for the end)
            self._step = self._rest
            self.finished.set_exception(error)

    def _await_work(self) -> None:
        """Say what is being done, and show the result as soon as it is there."""
        while self._stages:
            stage = self._stages.popleft()
            if stage != self._said:
                self._said = stage
                self.get_logger().info(stage)
        if self._work.done():
            self._show(self._work.result())

    def _show(self, result: Any) -> None:
        """Make the result parameters of this node and go on to the predictor."""
        for line in result.findings:
            self.get_logger().info(line)
        for warning in result.warnings:
            self.get_logger().warning(warning)
        result.require_usable()
        found = {k: v for k, v in result.parameters().items() if k.startswith(OF_THE_CUP)}
        self._cup = {name: validate(name, value) for name, value in found.items()}
        self.values = {**self.values, **{name: self._cup[name] for name in SHOWN}}
        for name in SHOWN:
            self.declare_from_table(name, self.values[name])
        for name in ('cup.stiffness', 'cup.damping'):
            diagonal = ', '.join(f'{x:.5g}' for x in self.values[name][::7])
            self.get_logger().info(f'{name}: diagonal {diagonal}')
        for name in ('output.parameters', 'output.json', 'output.report'):
            if self.values[name]:
                self.get_logger().info(f'Wrote {self.values[name]}.')
        if self.values['predictor']:
            self._client = AsyncParameterClient(self, str(self.values['predictor']))
            self._give_up_at = time.monotonic() + LONGEST_WAIT
            self._step = self._send
        else:
            self._end()

    def _send(self) -> None:
        """Set the cup on the predictor as soon as it is there."""
        if self._client.services_are_ready():
            cup = [ros_parameter(name, value) for name, value in self._cup.items()]
            self._answer = self._client.set_parameters_atomically(cup)
            self._step = self._await_answer
        else:
            self._give_up_in_time('there is no node of this name')

    def _await_answer(self) -> None:
        """Say what the predictor made of the cup."""
        if not self._answer.done():
            self._give_up_in_time('there was no answer')
            return
        result = self._answer.result().result
        if not result.successful:
            raise BellowsError(
                f"The node '{self.values['predictor']}' refused the identified cup: "
                f'{result.reason}'
            )
        self.get_logger().info(f"Set the cup on '{self.values['predictor']}'.")
        self._end()

    def _give_up_in_time(self, what: str) -> None:
        """Raise BellowsError when the predictor has been waited for long enough."""
        if time.monotonic() > self._give_up_at:
            raise BellowsError(
                f"The cup was identified, but could not be set on '{self.values['predictor']}': "
                f'{what} ({LONGEST_WAIT:g} s waited). Start the predictor, check its name and '
                'namespace, or leave the parameter predictor empty.'
            )

    def _end(self) -> None:
        """End, or stay to show the result."""
        self._step = self._rest
        if self.values['exit_when_done']:
            self.finished.set_result(None)
        else:
            self.get_logger().info('Done; the result stays here as parameters until Ctrl-C.')

    def _rest(self) -> None:
        """Do nothing; the timer goes on, so that Ctrl-C is noticed."""

    def close(self) -> None:
        """End; work that still goes on is left behind, as it writes its files only when done."""
        self.destroy_node()
