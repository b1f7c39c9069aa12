"""
Declare the parameters of a node from the table, and change them live, all or nothing.

A managed node refuses invalid transitions, at which rclpy would end, and cleans up.
"""

from collections.abc import Callable, Collection, Iterable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces import msg as interfaces
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.task import Future

from .guarding import GuardedNode
from ..core.parameters import checks, table
from ..errors import BellowsError, short

Values = dict[str, Any]
"""Dotted names to values as `core.parameters.checks.validate` returns them."""

QOS_PREFIX = 'qos_overrides.'
ATOMIC_PREFIXES = ('cup.', 'cups.', 'package.', 'envelope.', 'vacuum.')
"""Parameters with these prefixes change together or not at all within one call."""


def ros_parameter(name: str, value: object) -> Parameter:
    """Return a value of the table as a ROS parameter."""
    return Parameter(name, Parameter.Type[table.lookup(name).kind.upper()],
                     list(value) if isinstance(value, tuple) else value)


def descriptor(parameter: table.Parameter, read_only: bool) -> interfaces.ParameterDescriptor:
    """Return the content of `ros2 param describe`: sentence, unit, constraint and range."""
    unit = f' Unit: {parameter.unit}.' if parameter.unit else ''
    described = interfaces.ParameterDescriptor(
        description=parameter.description + unit,
        additional_constraints=parameter.constraint,
        read_only=read_only or parameter.read_only)
    low = parameter.above if parameter.minimum is None else parameter.minimum
    high = parameter.maximum
    if low is not None and high is not None:  # of a single number; ROS knows none for arrays
        if parameter.kind == 'double':
            described.floating_point_range = [
                interfaces.FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif parameter.kind == 'integer':
            described.integer_range = [
                interfaces.IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return described


class TableNode(GuardedNode):
    """
    A node whose parameters are those of the table.

    Parameters
    ----------
    user : {'predictor', 'identifier'}
        Default name of the node, and whose parameters it has.
    read_only : bool
        True where none of them can change once the node runs.
    results : collection of str
        Parameters that are not declared before the node has their values.
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    values : dict
        All values as the core takes them; replaced as a whole when some are set.
    overridden : frozenset of str
        Names that a file or the command line set.

    Raises
    ------
    BellowsError
        If a name is unknown, a value is not allowed, one without a default is missing, or ROS
        refuses the node, as where it is to be secured and cannot.

    """

    def __init__(
        self, user: str, read_only: bool = False, results: Collection[str] = (), **options: Any
    ) -> None:
        """Declare all parameters, with the values from files and the command line."""
        try:
            super().__init__(user, start_parameter_services=False, **options)
        except (RuntimeError, ParameterException) as error:  # the bases of rcl's and rclpy's
            why = ' '.join(str(error).partition(', at /')[0].split())
            raise BellowsError(
                f"ROS cannot create the node '{user}': {short(why, 400)}.") from None
        self._read_only = read_only
        try:
            overridden = {
                name: parameter.value
                for name, parameter in self._parameter_overrides.items()
                if not (self.has_parameter(name) or name.startswith(QOS_PREFIX))}
            self.overridden = frozenset(overridden)
            required = [p.name for p in table.parameters_of(user) if p.default is None]
            self.values: Values = checks.resolve(
                overridden, () if overridden.get('package.files') else required)
            self.check_values(self.values)
            for name, value in self.values.items():
                if name not in results and user in table.lookup(name).used_by:
                    self.declare_from_table(name, value)
        except BellowsError:
            self.destroy_node()
            raise
        self._parameter_service = AtomicParameterService(self)

    def check_values(self, values: Values) -> None:
        """Raise BellowsError if values that are allowed one by one contradict each other."""

    def on_values(self, names: list[str]) -> None:
        """Act on new `values`; called after the named parameters have been set."""

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """
        Set parameters: all in one step, or else those that belong together, and others singly.

        A parameter that is given the value it has counts as set, so that what `ros2 param dump`
        writes can be loaded, and without any effect on what runs.
        """
        result = self.set_parameters_atomically(parameter_list)
        if result.successful:
            return [result] * len(parameter_list)
        together = [p for p in parameter_list if p.name.startswith(ATOMIC_PREFIXES)]
        common = self.set_parameters_atomically(together)
        return [common if p in together else self.set_parameters_atomically([p])
                for p in parameter_list]

    def declare_from_table(self, name: str, value: table.Value) -> None:
        """Declare a parameter of the table with a value that has been checked."""
        parameter, typed = table.lookup(name), ros_parameter(name, value)
        self.declare_parameter(
            name, typed.type_ if value == () else typed.value,  # an empty list has no type
            descriptor(parameter, self._read_only), ignore_override=True)
        if value == () and parameter.kind == 'double_array':
            super().set_parameters_atomically([typed])

    def set_parameters_atomically(self, parameters: list[Parameter]) -> SetParametersResult:
        """Set all or none of some parameters, and say why not."""
        now = {p.name: self.get_parameter_or(p.name, Parameter(p.name)) for p in parameters}
        changing = [p for p in map(_as_double, parameters) if not self.has_parameter(p.name) or (
            now[p.name].get_parameter_value() != p.get_parameter_value())]
        if not changing:
            return SetParametersResult(successful=True)
        ours = {p.name: p.value for p in changing if _is_ours(p)}
        previous = self.values
        try:
            if not all(p.name for p in changing):
                raise BellowsError(
                    "A parameter without a name cannot be set. 'ros2 param list' shows the names.")
            new = {**previous, **{name: checks.validate(name, ours[name]) for name in ours}}
            self.check_values(new)  # before rclpy, whose messages are shorter
            result = super().set_parameters_atomically(changing)
            if result.successful and ours:
                self.values = new
                self.on_values(list(ours))
            return result
        except ParameterNotDeclaredException:
            unknown = [p.name for p in changing if not self.has_parameter(p.name)]
            return _refused(_why_unknown(unknown[0], self.get_name()))
        except Exception as error:  # noqa: BLE001 (whatever it is, nothing is to change)
            if self.values is not previous:
                self.values = previous
                super().set_parameters_atomically([now[p.name] for p in changing])
                self.on_values(list(ours))
            if not isinstance(error, BellowsError):
                self.note_failure(error)
            return _refused(str(error))


class AtomicParameterService(ParameterService):
    """
    The parameter services of a node, with its own `set_parameters`.

    The service of rclpy sets one parameter after the other, whatever the node. A request with a
    type that does not exist fails, and gets an empty answer.
    """

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        """Set parameters that belong together all or none, the others one by one."""
        response.results = self._get_node().set_parameters(
            [Parameter.from_parameter_msg(message) for message in request.parameters])
        return response


def _refused(reason: str) -> SetParametersResult:
    """Return the answer to a refused call."""
    return SetParametersResult(successful=False, reason=reason)


def _is_ours(parameter: Parameter) -> bool:
    """Return whether a parameter is in the table; others belong to ROS."""
    return parameter.name in table.PARAMETERS or bool(table.NAMED_CUP.fullmatch(parameter.name))


def _why_unknown(name: str, node: str) -> str:
    """Return the message about an unknown parameter."""
    try:
        users = table.lookup(name).used_by
    except BellowsError as error:
        return str(error)
    if table.NAMED_CUP.fullmatch(name):
        return f"'{name}' was not declared when '{node}' started. Set it in a file."
    return f"The node '{node}' has no parameter '{name}': it belongs to the {users[0]}."


def _as_double(parameter: Parameter) -> Parameter:
    """Return a parameter with integers, or nothing, as doubles if doubles are expected."""
    if not (_is_ours(parameter) and table.lookup(parameter.name).kind.startswith('double')):
        return parameter
    kind, value = parameter.type_, parameter.value
    if kind.name.endswith('_ARRAY') and not value:  # an empty list is sent as one of bytes
        return ros_parameter(parameter.name, [])
    if kind not in (Parameter.Type.INTEGER, Parameter.Type.INTEGER_ARRAY):
        return parameter
    doubles = float(value) if kind == Parameter.Type.INTEGER else [float(x) for x in value]
    return ros_parameter(parameter.name, doubles)


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
    is_active : bool
        Whether it publishes.

    Raises
    ------
    BellowsError
        If a parameter is unknown, not allowed or missing.

    """

    def __init__(self, user: str, **options: Any) -> None:
        """Check the parameters; the node is unconfigured."""
        TableNode.__init__(self, user, **options)
        LifecycleNodeMixin.__init__(self)
        # rclpy's own callback raises where a transition is not allowed, and leaves no answer.
        service = next(each for each in self.services if each.srv_type is ChangeState)
        self._change_state_unchecked = self.guarded(service.callback, ChangeState.Response)
        service.callback = self._change_state
        self.finished: Future = Future()
        self._before: set[Any] | None = None  # what exists while it is not configured
        self._failure, self.is_active = '', False

    def configure(self) -> None:
        """Make everything that needs the parameters, or raise the obstacle."""

    def start(self) -> None:
        """Configure and activate, or end and raise the obstacle."""
        for step in (self.trigger_configure, self.trigger_activate):
            if step() != SUCCESS:
                self.destroy_node()
                raise BellowsError(self._failure or 'The node could not be started.')

    @property
    def lifecycle_state(self) -> str:
        """Name of the state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure, or log why not and leave nothing behind."""
        self._before = {*self.publishers, *self.subscriptions, *self.services, *self.timers}
        try:
            self.configure()
        except Exception as error:  # noqa: BLE001 (rclpy would swallow whatever it is)
            kind = '' if isinstance(error, BellowsError) else f'{type(error).__name__}: '
            self._failure = f'{kind}{short(str(error), 1000)}'
            self.get_logger().error(f'Cannot be configured: {self._failure}')
            self.release_resources()
            return FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let publishers publish, and callbacks work."""
        result = super().on_activate(state)
        self.is_active = True
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing."""
        self.is_active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything that was made."""
        self.release_resources()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing for good."""
        if self.is_active:
            self.on_deactivate(state)
        self.release_resources()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything, so that the node can be configured again."""
        self.get_logger().error('A transition failed; the node is unconfigured now.')
        self.is_active = False
        self.release_resources()
        return SUCCESS

    def release_resources(self) -> None:
        """End the threads, and destroy what was made to be configured."""
        for worker in self.workers:
            worker.close()
        self.workers.clear()
        if self._before is None:
            return
        made: tuple[tuple[Iterable[Any], Callable[[Any], object]], ...] = (
            (self.publishers, self.destroy_lifecycle_publisher),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service), (self.timers, self.destroy_timer))
        for entities, destroy in made:
            for entity in set(entities) - self._before:
                destroy(entity)
        self._before = None

    def close(self) -> None:
        """Release everything, and leave the graph."""
        self.is_active = False
        self.release_resources()
        self.destroy_node()

    def _change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Go through a transition that the state allows; refuse any other."""
        wanted = request.transition
        allowed = self._state_machine.available_transitions
        if any(wanted.label == label if wanted.label else wanted.id == number
               for number, label, *_ in allowed):
            return self._change_state_unchecked(request, response)
        name = short(wanted.label) or wanted.id
        self.get_logger().warning(
            f"Transition '{name}' refused: from '{self.lifecycle_state}' only "
            f'{", ".join(f"{label} ({number})" for number, label, *_ in allowed) or "none"}.')
        response.success = False
        return response

    def destroy_node(self) -> None:
        """Leave the graph; rclpy forgets the state machine, which would keep the node there."""
        super().destroy_node()
        if hasattr(self, '_state_machine'):  # not where the parameters were refused
            self._state_machine.destroy_when_not_in_use()
