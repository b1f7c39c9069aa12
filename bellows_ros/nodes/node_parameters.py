"""Declare the parameters of a node from the table, and change them live, all or nothing."""

from collections.abc import Collection, Mapping
from typing import Any

from rcl_interfaces import msg as interfaces
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService

from .guarding import GuardedNode
from ..core.parameters import checks, table
from ..core.parameters.values import Values
from ..errors import BellowsError, shown

QOS_PREFIX = 'qos_overrides.'


def ros_parameter(name: str, value: object) -> Parameter:
    """Return a value of the table as a ROS parameter."""
    return Parameter(name, Parameter.Type[table.lookup(name).kind.upper()],
                     list(value) if isinstance(value, tuple) else value)


def descriptor(parameter: table.Parameter, read_only: bool) -> interfaces.ParameterDescriptor:
    """Return the content of `ros2 param describe`: description, unit, constraint and range."""
    unit = f' Unit: {parameter.unit}.' if parameter.unit else ''
    described = interfaces.ParameterDescriptor(
        description=parameter.description + unit,
        additional_constraints=parameter.constraint,
        read_only=read_only or parameter.read_only)
    low = parameter.above if parameter.minimum is None else parameter.minimum
    high = parameter.maximum
    if low is not None and high is not None:  # of a single number; ROS has none for arrays
        if parameter.kind == 'double':
            described.floating_point_range = [
                interfaces.FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif parameter.kind == 'integer':
            described.integer_range = [
                interfaces.IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return described


class TableNode(GuardedNode):
    """
    A node with the parameters of the table.

    Parameters
    ----------
    user : {'predictor', 'identifier'}
        Default name of the node, and user of its parameters.
    read_only : bool
        Whether no parameter can change once the node runs.
    results : collection of str
        Parameters that are declared only with their values.
    options
        Keyword arguments of `rclpy.node.Node`.

    Attributes
    ----------
    values : dict
        All values in the form of core; a change replaces the whole mapping.
    doubts : tuple of str
        Questions about unlikely values.
    overridden : frozenset of str
        Names set by a file or the command line.

    Raises
    ------
    BellowsError
        If a name is unknown, a value is invalid, a value without a default is missing, or ROS
        rejects the node, for example if required security is unavailable.

    """

    def __init__(
        self, user: str, read_only: bool = False, results: Collection[str] = (), **options: Any
    ) -> None:
        try:
            super().__init__(user, start_parameter_services=False, **options)
        except (RuntimeError, ParameterException) as error:  # bases of errors of rcl and rclpy
            why = ' '.join(str(error).partition(', at /')[0].split())
            raise BellowsError(
                f"ROS cannot create the node '{user}': {shown(why, 400)}.") from None
        self._read_only = read_only
        try:
            overridden = {
                name: parameter.value
                for name, parameter in self._parameter_overrides.items()
                if not (self.has_parameter(name) or name.startswith(QOS_PREFIX))}
            self.overridden = frozenset(overridden)
            required = [p.name for p in table.parameters_for(user) if p.default is None]
            self.values: Values = checks.resolve(
                overridden, () if overridden.get('package.files') else required)
            self.doubts = self.check_values(self.values)
            for name, value in self.values.items():
                if name not in results and user in table.lookup(name).used_by:
                    self.declare_from_table(name, value)
        except BellowsError:
            self.destroy_node()
            raise
        self._parameter_service = AtomicParameterService(self)

    def check_values(self, values: Values) -> tuple[str, ...]:
        """Return doubts about values; raise BellowsError if valid values contradict each other."""
        return ()

    def on_values(self, before: Mapping[str, object]) -> None:
        """Apply new `values`; called with the previous values of the parameters that were set."""

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """
        Set all parameters in one step or, if this fails, related ones together and others singly.

        Setting a parameter to its current value succeeds without effect, so that the output of
        `ros2 param dump` can be loaded.
        """
        result = self.set_parameters_atomically(parameter_list)
        if result.successful:
            return [result] * len(parameter_list)
        together = [p for p in parameter_list if p.name.startswith(
            ('cup.', 'cups.', 'package.', 'envelope.', 'vacuum.'))]
        common = self.set_parameters_atomically(together)
        return [common if p in together else self.set_parameters_atomically([p])
                for p in parameter_list]

    def declare_from_table(self, name: str, value: table.Value) -> None:
        """Declare a parameter of the table with a checked value."""
        typed = ros_parameter(name, value)
        self.declare_parameter(
            name, typed.type_ if value == () else typed.value,  # an empty list has no type
            descriptor(table.lookup(name), self._read_only), ignore_override=True)

    def set_parameters_atomically(self, parameters: list[Parameter]) -> SetParametersResult:
        """Set all parameters or none, and return the reason."""
        now = {p.name: self.get_parameter_or(p.name, Parameter(p.name)) for p in parameters}
        changing, previous = list[Parameter](), self.values
        try:
            changing = [p for p in map(_checked, parameters) if not self.has_parameter(p.name) or (
                now[p.name].get_parameter_value() != p.get_parameter_value())]
            if not changing:
                return SetParametersResult(successful=True)
            ours = {p.name: checks.validate(p.name, p.value) for p in changing if _is_ours(p)}
            new = previous.replaced(ours)
            doubts = self.check_values(new)  # before rclpy, whose messages are shorter
            result = super().set_parameters_atomically(changing)
            if result.successful and ours:
                self.values = new
                self.on_values({name: previous.get(name) for name in ours})
                result.reason = ' '.join(set(doubts) - set(self.doubts))
                self.doubts = doubts
                if result.reason:
                    self.get_logger().warning(result.reason)
            return result
        except ParameterNotDeclaredException:
            unknown = [p.name for p in changing if not self.has_parameter(p.name)]
            return _refused(_why_unknown(unknown[0], self.get_name()))
        except Exception as error:  # noqa: BLE001 (whatever it is, nothing is to change)
            if self.values != previous:
                self.values = previous
                super().set_parameters_atomically([now[p.name] for p in changing])
                self.on_values(ours)
            if not isinstance(error, BellowsError):
                self.note_failure(error)
            return _refused(str(error))


class ManagedNode(LifecycleNodeMixin, TableNode):
    """
    A node with a lifecycle.

    Attributes
    ----------
    is_active : bool
        Whether it publishes.

    """

    is_active = False


class AtomicParameterService(ParameterService):
    """
    The parameter services of a node, with its own `set_parameters`.

    The service of rclpy sets one parameter after the other, and does not answer a request with an
    unknown type.
    """

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        """Set related parameters all or none, the others one by one."""
        response.results = self._get_node().set_parameters(list(map(_read, request.parameters)))
        return response

    def _set_parameters_atomically_callback(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        """Set all parameters or none."""
        response.result = self._get_node().set_parameters_atomically(
            list(map(_read, request.parameters)))
        return response


def _read(message: interfaces.Parameter) -> Parameter:
    """Return a parameter of a request, without value if its type is unknown."""
    is_known = any(message.value.type == kind.value for kind in Parameter.Type)
    return Parameter.from_parameter_msg(message) if is_known else Parameter(message.name)


def _refused(reason: str) -> SetParametersResult:
    """Return the answer to a rejected call."""
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


def _checked(parameter: Parameter) -> Parameter:
    """Return a parameter in the form of the table, with the type of its declaration."""
    if not parameter.name:
        raise BellowsError(
            "A parameter without a name cannot be set. 'ros2 param list' shows the names.")
    return ros_parameter(
        parameter.name, checks.validate(parameter.name, parameter.value)
    ) if _is_ours(parameter) else parameter
