"""Declare the parameters of a node from the table, and change them live, all or nothing."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from rcl_interfaces import msg as interfaces
from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.parameter import Parameter

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
    if parameter.kind == 'double' and not (low is None or high is None):  # none for arrays
        described.floating_point_range = [
            interfaces.FloatingPointRange(from_value=float(low), to_value=float(high))]
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
    values : Values
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
            super().__init__(user, **options)
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
        self.add_on_set_parameters_callback(self._validate)
        self.add_post_set_parameters_callback(self.guarded(self._apply))

    def check_values(self, values: Values) -> tuple[str, ...]:
        """Return doubts about values; raise BellowsError if valid values contradict each other."""
        return ()

    def on_values(self, before: Mapping[str, object]) -> None:
        """Apply new `values`; called with the previous values of the changed parameters."""

    def declare_from_table(self, name: str, value: table.Value) -> None:
        """Declare a parameter of the table with a checked value."""
        typed = ros_parameter(name, value)
        self.declare_parameter(
            name, typed.type_ if value == () else typed.value,  # an empty list has no type
            descriptor(table.lookup(name), self._read_only), ignore_override=True)

    def _changed(self, parameters: Sequence[Parameter]) -> dict[str, table.Value]:
        """Return the parameters of the table with new values; raise BellowsError for bad ones."""
        ours = (each for each in parameters if each.name in self.values)
        checked = {each.name: checks.validate(each.name, each.value) for each in ours}
        return {name: value for name, value in checked.items() if value != self.values[name]}

    def _validate(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        """Return whether parameters can be set together, by the checks of the start."""
        try:
            if changed := self._changed(parameters):
                self.check_values(self.values.replaced(changed))
        except BellowsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:  # noqa: BLE001 (whatever it is, nothing is to change)
            self.note_failure(error)
            return SetParametersResult(successful=False, reason=shown(str(error)))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Use parameters that were set together in one step, and log new doubts about them."""
        if not (changed := self._changed(parameters)):
            return
        before = {name: self.values[name] for name in changed}
        self.values = self.values.replaced(changed)
        doubts = self.check_values(self.values)
        for doubt in set(doubts) - set(self.doubts):
            self.get_logger().warning(doubt)
        self.doubts = doubts
        self.on_values(before)


class ManagedNode(LifecycleNodeMixin, TableNode):
    """
    A node with a lifecycle.

    Attributes
    ----------
    is_active : bool
        Whether it publishes.

    """

    is_active = False
