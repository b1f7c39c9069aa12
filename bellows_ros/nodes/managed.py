"""A managed node that refuses invalid transitions, at which rclpy would end, and cleans up."""

from collections.abc import Callable, Iterable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.task import Future

from .parameters import TableNode
from ..core.parameters.table import short
from ..errors import BellowsError

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNodeMixin, TableNode):
    """
    A lifecycle node with the parameters of the table.

    Parameters
    ----------
    user : {'predictor', 'identifier'}
        Default name of the node, and whose parameters it has.
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    finished : rclpy.task.Future
        Ends the process when it is done.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    def __init__(self, user: str, **options: Any) -> None:
        """Check the parameters; the node is unconfigured."""
        TableNode.__init__(self, user, **options)
        LifecycleNodeMixin.__init__(self)
        self.finished: Future = Future()
        self._why_not = ''

    def configure(self) -> None:
        """Make everything that needs the parameters, or raise the obstacle."""
        raise NotImplementedError

    def start(self) -> None:
        """Configure and activate, or end and raise the obstacle."""
        for step in (self.trigger_configure, self.trigger_activate):
            if step() != SUCCESS:
                self.destroy_node()
                raise BellowsError(self._why_not or 'The node could not be started.')

    @property
    def lifecycle_state(self) -> str:
        """Name of the state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure, or log why not and leave nothing behind."""
        self._before = {*self.publishers, *self.subscriptions, *self.services}
        try:
            self.configure()
        except Exception as error:  # noqa: BLE001 (rclpy would swallow whatever it is)
            kind = '' if isinstance(error, BellowsError) else f'{type(error).__name__}: '
            self._why_not = f'{kind}{short(str(error), 1000)}'
            self.get_logger().error(f'Cannot be configured: {self._why_not}')
            self.release_resources()
            return FAILURE
        return super().on_configure(state)

    def release_resources(self) -> None:
        """Destroy the topics and services that were made to be configured."""
        made: tuple[tuple[Iterable[Any], Callable[[Any], object]], ...] = (
            (self.publishers, self.destroy_lifecycle_publisher),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
        )
        for entities, destroy in made:
            for entity in set(entities) - self._before:
                destroy(entity)

    def _change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Go through a transition that the state allows; refuse any other."""
        wanted = request.transition
        allowed = self._state_machine.available_transitions
        if any(wanted.label == label if wanted.label else wanted.id == number
               for number, label, *_ in allowed):
            change = super()._LifecycleNodeMixin__on_change_state  # type: ignore[misc]
            return self.guarded(change, ChangeState.Response)(request, response)
        name = short(wanted.label) or wanted.id
        self.get_logger().warning(
            f"Transition '{name}' refused: from '{self.lifecycle_state}' only "
            f'{", ".join(f"{label} ({number})" for number, label, *_ in allowed) or "none"}.'
        )
        response.success = False
        return response

    # The callback of rclpy, by its private name: it raises where a transition is not allowed, and
    # what spins the node ends with it.
    _LifecycleNodeMixin__on_change_state = _change_state

    def destroy_node(self) -> None:
        """Leave the graph; rclpy forgets the state machine, which would keep the node there."""
        super().destroy_node()
        if hasattr(self, '_state_machine'):  # not where the parameters were refused
            self._state_machine.destroy_when_not_in_use()
