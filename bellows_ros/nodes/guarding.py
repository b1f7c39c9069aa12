"""
Nodes: callbacks and work aside may fail, parameters are those of the table; spinning.

A failure is logged once, then counted; the node lives on. Parameters change live, all or nothing.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
import traceback
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle.node import LifecycleNodeMixin
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from ..core.parameters import checks, table
from ..core.parameters.values import Values
from ..errors import BellowsError, MAX_MESSAGE, shown

PACKAGE = Path(__file__).parents[1]

OVERRIDABLE = QoSOverridingOptions((
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY))
"""QoS that parameters can override; durability is among them for vacuum switches with rare
messages."""

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS with which late subscribers get the newest message."""

THREADS = 2
"""Threads of work aside: one may compile for a minute while the other answers."""


@contextmanager
def refusals_of_ros(work: str) -> Iterator[None]:
    """Raise BellowsError for an error of ROS during some work, such as a name it cannot use."""
    try:
        yield
    except (RuntimeError, ParameterException) as error:  # bases of errors of rcl and rclpy
        why = ' '.join(str(error).partition(', at /')[0].rstrip('.').split())
        raise BellowsError(f'ROS cannot {work}: {shown(why, 400)}.') from None


class GuardedNode(Node):
    """
    A node whose callbacks may fail.

    Attributes
    ----------
    failures : collections.Counter
        Number of failures by place in the code.

    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Create the node; rclpy creates its first subscriptions here."""
        self.failures: Counter[str] = Counter()
        self._aside = ThreadPoolExecutor(THREADS, 'aside')
        super().__init__(*arguments, **options)

    def note_failure(self, error: Exception, place: str = '') -> None:
        """Count an exception by its place, by default its line of code; log the first one."""
        frames = traceback.extract_tb(error.__traceback__)  # the first one is the guard itself
        own = [frame for frame in frames[1:] if PACKAGE in Path(frame.filename).parents]
        innermost = (own or frames)[-1]
        place = place or f'{Path(innermost.filename).name}:{innermost.lineno}'
        self.failures[place] += 1
        if self.failures[place] == 1:
            self.get_logger().error(
                f'A callback failed at {place}: {type(error).__name__}: {shown(str(error))}. '
                'The node continues, and only counts further failures there. Please report '
                'it, with the traceback from --log-level debug.')
            self.get_logger().debug(''.join(traceback.format_exception(error)))

    def guarded(
        self, callback: Callable[..., Any],
        otherwise: Callable[[Exception], Any] = lambda error: None,
    ) -> Callable[..., Any]:
        """Return a callback that records its exceptions and then returns a substitute."""
        @wraps(callback)
        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except Exception as error:  # noqa: BLE001 (nothing may end the node)
                self.note_failure(error)
                return otherwise(error)

        return call

    def aside(self, work: Callable[..., None], *arguments: Any) -> Future[None]:
        """Do some work in a thread, during the live prediction."""
        return self._aside.submit(self.guarded(work), *arguments)

    def forget_work(self) -> None:
        """Drop the work aside that has not begun."""
        self._aside.shutdown(wait=False, cancel_futures=True)
        self._aside = ThreadPoolExecutor(THREADS, 'aside')

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *more: Any, **options: Any
    ) -> Any:
        """
        Subscribe with a callback that may fail, and QoS that can be overridden.

        rclpy also subscribes to the clock by this function.
        """
        if msg_type is not Clock:
            options['qos_overriding_options'] = OVERRIDABLE
        return super().create_subscription(
            msg_type, topic, self.guarded(callback), *more, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any
    ) -> Any:
        """Serve with a callback that may fail; the answer then has the error, if it has texts."""
        def failed(error: Exception) -> Any:
            response = srv_type.Response()
            if hasattr(response, 'message'):
                response.message = shown(str(error))
            return response

        return super().create_service(
            srv_type, srv_name, self.guarded(callback, failed), **options)


def ros_parameter(name: str, value: object) -> Parameter:
    """Return a value of the table as a ROS parameter."""
    return Parameter(name, Parameter.Type[table.lookup(name).kind.upper()],
                     list(value) if isinstance(value, tuple) else value)


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
        with refusals_of_ros(f"create the node '{user}'"):
            super().__init__(user, **options)
        self._read_only, self._doubts = read_only, set[str]()
        overridden = {
            name: parameter.value for name, parameter in self._parameter_overrides.items()
            if not (self.has_parameter(name) or name.startswith('qos_overrides.'))}
        self.overridden = frozenset(overridden)
        required = [p.name for p in table.parameters_for(user) if p.default is None]
        self._use(checks.resolve(
            overridden, () if overridden.get('package.files') else required))
        for name, value in self.values.items():
            if name not in results and user in table.lookup(name).used_by:
                self.declare_from_table(name, value)
        self.add_on_set_parameters_callback(self._validate)
        self.add_post_set_parameters_callback(self.guarded(self._apply))

    def check_values(self, values: Values) -> Collection[str]:
        """Return doubts about values; raise BellowsError if valid values contradict each other."""
        return ()

    def on_values(self) -> None:
        """Apply new `values`."""

    def _use(self, values: Values) -> None:
        """Check and store values, and log new doubts about them."""
        known, self._doubts = self._doubts, set(self.check_values(values))
        self.values = values
        for doubt in self._doubts - known:
            self.get_logger().warning(doubt)

    def declare_from_table(self, name: str, value: table.Value) -> None:
        """Declare a parameter of the table with a checked value."""
        typed, parameter = ros_parameter(name, value), table.lookup(name)
        unit = f' Unit: {parameter.unit}.' if parameter.unit else ''
        self.declare_parameter(
            name, typed.type_ if value == () else typed.value,  # an empty list has no type
            ParameterDescriptor(
                description=parameter.description + unit,
                additional_constraints=parameter.constraint,
                read_only=self._read_only or parameter.read_only), ignore_override=True)

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
        except Exception as error:  # noqa: BLE001 (whatever it is, nothing is to change)
            if not isinstance(error, BellowsError):
                self.note_failure(error)
            return SetParametersResult(successful=False, reason=shown(str(error), MAX_MESSAGE))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        """Use parameters that were set together in one step."""
        if changed := self._changed(parameters):
            self._use(self.values.replaced(changed))
            self.get_logger().info(f'Set while running: {", ".join(changed)}.')
            self.on_values()


class ManagedNode(LifecycleNodeMixin, TableNode):
    """
    A node with a lifecycle.

    Attributes
    ----------
    is_active : bool
        Whether it publishes.

    """

    is_active = False

    def create_trigger(self, name: str, work: Callable[[], object], words: str) -> None:
        """Offer a service that does some work while the node is active, and answers with words."""
        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = self.is_active, 'The node is not active.'
            if self.is_active:
                work()
                response.message = words
            return response

        self.create_service(Trigger, name, answer)


MAX_SPIN_WAIT = 0.1
"""Longest call of the executor, and longest delay of a request to end, s: Python cannot process a
signal during an endless call."""


def executor_for(node: GuardedNode) -> Any:
    """
    Return an executor for a node, woken by events, which rclpy has since 7.1.4.

    The usual executor rebuilds its list of entities after each callback, which takes longer than
    the callback.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor as Executor
    except ImportError:
        Executor = SingleThreadedExecutor
    executor = Executor(context=node.context)
    executor.add_node(node)
    return executor


def spin(node: Any, is_asked_to_stop: Callable[[], bool]) -> None:
    """
    Let a node work until it has finished or is asked to stop, and close it.

    Parameters
    ----------
    node : GuardedNode
        Node with a future `finished`, whose exception is raised here, and a method `close`.
    is_asked_to_stop : callable
        Function that is called every `MAX_SPIN_WAIT`.

    """
    executor = executor_for(node)
    try:
        while not (is_asked_to_stop() or node.finished.done()):
            try:
                executor.spin_until_future_complete(node.finished, MAX_SPIN_WAIT)
            except Exception as error:  # noqa: BLE001 (of rclpy's own callbacks: the node goes on)
                if not node.context.ok():
                    raise
                node.note_failure(error)
        if node.finished.done():
            node.finished.result()
    finally:
        executor.shutdown()
        node.close()
