"""The node that identifies a cup from recordings and shows the result."""

from collections.abc import Mapping
from threading import Event, Thread
from typing import Any

from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from .guarding import ros_parameter, TableNode
from ..core.parameters import checks, table
from ..errors import BellowsError
from ..report.build import write_page
from ..workflows.identification import Identification, save
from ..workflows.identify import identify

PREDICTOR_TIMEOUT = 10.0
"""Longest wait for the predictor, s."""

CUP_PREFIXES = ('cup.',)
RESULT_NAMES = [
    p.name for p in table.parameters_for('identifier') if p.name.startswith(CUP_PREFIXES)]
"""Parameters that are declared after the fit."""

OUTPUTS = ('output.parameters', 'output.json', 'output.report', 'output.cell')


class IdentifierNode(TableNode):
    """
    Identify a cup once, in a thread, and offer the result as parameters.

    Parameters
    ----------
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    finished : rclpy.task.Future
        Raises the error of the work, if any.

    Raises
    ------
    BellowsError
        If a parameter is unknown, invalid or missing.

    """

    def __init__(self, **options: Any) -> None:
        """Start the work."""
        super().__init__('identifier', read_only=True, results=RESULT_NAMES, **options)
        self.finished: Future = Future()
        self._stage = ''
        if not self.values.bags:
            self.destroy_node()
            raise BellowsError(
                'The parameter bags is empty. Name one or more recordings, for example '
                "--ros-args -p bags:='[recording]' or in the parameter file bags: ['recording'].")
        settings = {name: self.values[name] for name in self.values if name in self.overridden}
        Thread(target=self._run, args=(settings,), daemon=True).start()

    def _run(self, settings: Mapping[str, Any]) -> None:
        """Identify, write and show the result, set it on the predictor; an error ends the node."""
        try:
            result = identify(settings, self._log_stage)
            cup_file, json_file, page, cell_file = (result.values[name] for name in OUTPUTS)
            save(result, cup_file, json_file, cell_path=cell_file)
            if page:
                write_page(result, page)
            cup = self._show(result)
            if self.values.predictor:
                self._set_on_predictor(cup)
            self.get_logger().info('Done; the result stays here as parameters until Ctrl-C.')
        except Exception as error:  # noqa: BLE001 (raised again where the end is awaited)
            self.finished.set_exception(error)

    def _log_stage(self, stage: str, part: float = 0.0) -> None:
        """Log each step once."""
        if stage != self._stage:
            self._stage = stage
            self.get_logger().info(stage)

    def _show(self, result: Identification) -> dict[str, table.Value]:
        """Make the result parameters of this node; return all parameters of the cup."""
        for line in result.notes:
            self.get_logger().info(line)
        for warning in result.warnings:
            self.get_logger().warning(warning)
        result.require_usable()
        cup = {name: checks.validate(name, value) for name, value in result.parameters().items()
               if name.startswith(CUP_PREFIXES)}
        self.values = self.values.replaced(
            {name: cup[name] for name in RESULT_NAMES if name in cup})
        for name in RESULT_NAMES:
            self.declare_from_table(name, self.values[name])
        for name in ('cup.stiffness', 'cup.damping'):
            diagonal = ', '.join(f'{x:.5g}' for x in self.values[name][::7])
            self.get_logger().info(f'{name}: diagonal {diagonal}')
        for file in filter(None, map(self.values.get, OUTPUTS)):
            self.get_logger().info(f'Wrote {file}.')
        return cup

    def _set_on_predictor(self, cup: Mapping[str, table.Value]) -> None:
        """Set the cup on the predictor once available, and log the answer."""
        name, answered = str(self.values.predictor), Event()
        client, missing = AsyncParameterClient(self, name), 'there is no node of this name'
        if client.wait_for_services(PREDICTOR_TIMEOUT):
            answer = client.set_parameters_atomically(
                [ros_parameter(key, value) for key, value in cup.items()])
            answer.add_done_callback(lambda done: answered.set())
            missing = '' if answered.wait(PREDICTOR_TIMEOUT) else 'there was no answer'
        if missing:
            raise BellowsError(
                f"The cup was identified, but could not be set on '{name}': {missing} "
                f'({PREDICTOR_TIMEOUT:g} s waited). Start the predictor, check its name and '
                'namespace, or leave the parameter predictor empty.')
        result = answer.result().result
        if not result.successful:
            raise BellowsError(f"The node '{name}' refused the identified cup: {result.reason}")
        self.get_logger().info(f"Set the cup on '{name}'.")

    def close(self) -> None:
        """Stop the node. Unfinished work is abandoned; it has written no files."""
        self.destroy_node()
