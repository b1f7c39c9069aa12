"""
The public API, `import bellows_ros`: arrays and paths in, arrays and frozen data out.

The functions of this module are shortcuts to other modules; a workflow is loaded when its function
is called.
"""

from __future__ import annotations  # signatures show names, not their members

from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
import inspect
from itertools import chain
from numbers import Integral, Real
import os
from types import SimpleNamespace, UnionType
from typing import (
    Any,
    get_args,
    get_origin,
    get_type_hints,
    ParamSpec,
    TYPE_CHECKING,
    TypeVar,
    Union,
)

from bellows_ros.core import live
from bellows_ros.core.geometry.arrays import Array, real_numbers
from bellows_ros.core.geometry.lie import quaternion_to_rotation, rotation_to_quaternion, transform
from bellows_ros.core.live import Prediction
from bellows_ros.core.model import cup_package, equilibrium, simulation
from bellows_ros.core.model.cup_package import box_inertia, Cup, Package
from bellows_ros.core.model.simulation import state_row
from bellows_ros.core.parameters.checks import PACKAGE_PARAMETERS, resolve
from bellows_ros.core.parameters.conversion import cup_of, package_of
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.signals import savgol as filters
from bellows_ros.core.signals.screening import pose_steps, repeated
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
from bellows_ros.errors import BellowsError, require_types
from bellows_ros.files import File, parameter_files
import bellows_ros.plots  # noqa: F401 (results draw themselves)
import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from bellows_ros.workflows.identification import Identification
    from bellows_ros.workflows.plan import PlanReport
    from bellows_ros.workflows.replay import Replay
    from bellows_ros.workflows.toss import TossResult

__all__ = [
    'BellowsError', 'Cup', 'LivePredictor', 'Package', 'Prediction', 'Trajectory', 'box_inertia',
    'fastest', 'identify', 'observe', 'parameters_of', 'plan', 'read_cup',
    'read_package', 'read_parameters', 'replay', 'savgol', 'simulate', 'static_equilibrium',
    'steer', 'toss', 'write_cup', 'write_parameters']

MotionSource = File | Trajectory
Parameters = Mapping[str, object] | File
"""Parameters by name, as `read_parameters` and `parameters_of` return them, or their file."""

Inputs = ParamSpec('Inputs')
Result = TypeVar('Result')

ACCEPTED: Mapping[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_), int: (Integral,), float: (Real,), Sequence: (list, tuple),
    Sequence[float]: (list, tuple, np.ndarray)}
"""Accepted types by type hint: numbers also of NumPy, and no text as a sequence of characters."""


def check_of(name: str, hint: Any, default: object) -> Callable[[Any], None]:
    """
    Return a function that checks an argument by its type hint, except at its default.

    Arrays are checked when they are read. Values of the very classes of the hint need no further
    check, so that the arguments of each pose cost little.
    """
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    classes = [option if option in ACCEPTED else get_origin(option) or option
               for option in options]
    if np.ndarray in classes or {*get_args(ArrayLike)}.issubset(options):
        return lambda value: None
    if get_origin(hint) is tuple:
        return _check_of_vector(name, len(get_args(hint)))
    types = tuple(chain.from_iterable(ACCEPTED.get(each, (each,)) for each in classes))
    exact = frozenset(options)

    def check(value: Any) -> None:
        if type(value) in exact or value is default:
            return
        require_types(**{name: (value, *types)})
        if Real in types and isinstance(value, Real):
            real_numbers(value, name)

    return check


def _check_of_vector(name: str, size: int) -> Callable[[Any], None]:
    """Return a function that checks a tuple or an array of so many real numbers."""
    floats = (float,) * size

    def check(value: Any) -> None:
        if type(value) is tuple and (*map(type, value),) == floats:
            return
        array = real_numbers(value, name)
        if array.shape != (size,):
            raise BellowsError(f'{name} must have the shape {(size,)}, got {array.shape}.')

    return check


def checked(function: Callable[Inputs, Result]) -> Callable[Inputs, Result]:
    """Check the arguments of a function by their type hints, except those at their defaults."""
    parameters = inspect.signature(function).parameters

    @cache
    def checks() -> Mapping[str, Callable[[Any], None]]:
        """Return the check of each argument; the hint of a result is loaded later."""
        arguments = {name: hint for name, hint in function.__annotations__.items()
                     if name != 'return'}
        hints = get_type_hints(SimpleNamespace(__annotations__=arguments), function.__globals__)
        return {name: check_of(name, hint, parameters[name].default)
                for name, hint in hints.items()}

    @wraps(function)
    def call(*args: Inputs.args, **kwargs: Inputs.kwargs) -> Result:
        own = checks()
        for name, value in chain(zip(parameters, args, strict=False), kwargs.items()):
            if name in own:  # unlike self
                own[name](value)
        return function(*args, **kwargs)

    return call


def with_checked_methods(cls: type[live.Predictor]) -> type[live.Predictor]:
    """Check the arguments of all public methods that a class inherits from its first base."""
    base = cls.__bases__[0]
    cls.__doc__ = base.__doc__
    for name, method in vars(base).items():
        if inspect.isfunction(method) and (name == '__init__' or not name.startswith('_')):
            setattr(cls, name, checked(method))
    return cls


@with_checked_methods
class LivePredictor(live.Predictor):
    """The predictor of the nodes, with checked arguments."""


read_parameters = checked(parameter_files.read_parameters)
write_parameters = checked(parameter_files.write_parameters)
savgol = checked(filters.savgol)


@checked
def read_cup(path: File) -> Cup:
    """
    Read a cup from a parameter file, such as the output of `bellows identify`.

    Parameters
    ----------
    path : path
        YAML file with cup.stiffness, cup.damping and cup.length; other terms have defaults.

    Raises
    ------
    BellowsError
        If the file cannot be read, or a required parameter is missing or invalid.

    Examples
    --------
    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> cup.length
    0.046
    >>> float(cup.stiffness[2, 2])
    9200.0

    """
    return cup_of(_parameters(path, ('cup.stiffness', 'cup.damping', 'cup.length')))


@checked
def read_package(path: File) -> Package:
    """
    Read a package from a parameter file.

    Parameters
    ----------
    path : path
        YAML file with package.mass, package.inertia and package.com.

    Raises
    ------
    BellowsError
        If the file cannot be read, or a parameter is missing or invalid.

    Examples
    --------
    >>> bellows_ros.read_package('bags/package.yaml').mass
    1.8

    """
    return package_of(_parameters(path))


@checked
def write_cup(path: File, cup: Cup, package: Package | None = None) -> None:
    """
    Write a cup, and optionally a package, for both nodes and all commands.

    Parameters
    ----------
    path : path
        YAML file, written whole or not at all.
    cup : Cup
        K, P and length.
    package : Package, optional
        Package on the cup.

    Raises
    ------
    BellowsError
        If K is not positive definite, or the file cannot be written.

    Examples
    --------
    >>> bellows_ros.write_cup(folder / 'cup.yaml', bellows_ros.Cup.thesis())
    >>> bellows_ros.read_cup(folder / 'cup.yaml').length
    0.0481

    """
    write_parameters(path, parameters_of(cup, package))


@checked
def parameters_of(cup: Cup, package: Package | None = None) -> dict[str, object]:
    """
    Return the parameters of a cup, and of a package, for functions of parameters by name.

    Examples
    --------
    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> bellows_ros.parameters_of(cup)['cup.length']
    0.046

    """
    values: dict[str, object] = cup.parameters()
    if package is not None:
        values.update({
            'package.mass': float(package.mass),
            'package.inertia': package.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist(),
            'package.com': package.com.tolist()})
    return values


@checked
def identify(
    recordings: Sequence[File | tuple[Trajectory, Trajectory]] | File, package: Package,
    cup_length: float, settings: Mapping[str, object] | None = None
) -> Identification:
    """
    Identify a cup's K and P from recordings, or from poses in arrays, as `bellows identify`.

    Parameters
    ----------
    recordings : path, or sequence of path or of (Trajectory, Trajectory)
        Each a rosbag2 recording, or the measured poses of the tool tip E and of the package's
        centre of mass B in a world with z up. Invalid samples are ignored; twists are not needed.
    package : Package
        Package on the cup.
    cup_length : float
        Cup length l0, m.
    settings : mapping, optional
        Further parameters by name, such as fit.structure or topics.tool_pose.

    Returns
    -------
    Identification
        It has cup; fit, with stiffness_std and damping_std (6, 6) and the covariance of the
        parameters named by fit.labels; findings and warnings, as sentences; refusals, empty for a
        usable cup; parameters() for `write_parameters`; `plot()`, `to_json(path)`.

    Raises
    ------
    BellowsError
        If a recording is unusable, the recordings do not determine the cup, or a given quantity is
        certainly wrong.

    Examples
    --------
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> result = bellows_ros.identify(
    ...     'bags/identification', package, 0.046,
    ...     {'fit.method': 'least_squares', 'recording.package_frame': 'com'})
    >>> result.refusals, bool(abs(result.cup.stiffness[2, 2] - 9200.0) < 50.0)
    ((), True)

    """
    values: dict[str, object] = {**(settings or {}), **{
        name: value for name, value in parameters_of(Cup.thesis(), package).items()
        if name.startswith('package.')}, 'cup.length': cup_length}
    bags, poses = list[str](), dict[str, dict[str, PoseStream]]()
    for each in [recordings] if isinstance(recordings, str | os.PathLike) else recordings:
        if isinstance(each, str | os.PathLike):
            bags.append(os.fspath(each))
            continue
        pair: tuple[Any, ...] = tuple(each) if isinstance(each, Sequence) else ()
        if len(pair) != 2 or not all(isinstance(body, Trajectory) for body in pair):
            raise BellowsError(
                'A recording must be a path, or two Trajectory, of the tool and of the package.')
        bags.append(f'recording {len(bags) + 1}')
        poses[bags[-1]] = {f'{body}_pose': PoseStream(
            body, 'world', good.stamps_ns, good.position, good.rotation)
            for body, each in zip(('tool', 'package'), pair, strict=True)
            for good in [_samples_of(each)]}
    if len(poses) == len(bags):
        values.setdefault('recording.package_frame', 'com')
    from bellows_ros.workflows import identify as workflow

    return workflow.identify({**values, 'bags': bags}, poses=poses)


@checked
def simulate(
    cup: Cup, package: Package, tool: Trajectory,
    gravity: float | ArrayLike = cup_package.STANDARD_GRAVITY
) -> Trajectory:
    """
    Simulate the package under a whole motion of the tool, from rest.

    Parameters
    ----------
    cup : Cup
        Cup between tool and package.
    package : Package
        Package on the cup.
    tool : Trajectory
        N poses of E in the world with body twists, as `savgol` returns; interpolated by cubic
        Hermite curves.
    gravity : float or array_like (3,)
        Magnitude along -z of the world, or vector in the world, m/s^2.

    Returns
    -------
    Trajectory
        N poses and body twists of B in the world, at the tool's stamps.

    Raises
    ------
    BellowsError
        If cup or package are not physical, there is no static equilibrium to start from, or the
        simulation diverges.

    Examples
    --------
    A tool moves steadily along x for a second: the package, initially at rest below it, is pulled
    along and swings.

    >>> t = np.linspace(0.0, 1.0, 501)
    >>> tool = bellows_ros.Trajectory(
    ...     stamps_ns=np.arange(501) * 2_000_000,
    ...     position=np.column_stack([0.2 * t, 0.0 * t, 0.0 * t]),
    ...     rotation=np.broadcast_to(np.eye(3), (501, 3, 3)),
    ...     twist=np.tile([0.2, 0.0, 0.0, 0.0, 0.0, 0.0], (501, 1)))
    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> moved = bellows_ros.simulate(cup, package, tool)
    >>> len(moved), bool(moved.position[-1, 0] > 0.15)
    (501, True)

    """
    resolve(parameters_of(cup, package))
    return simulation.simulate(cup, package, tool, gravity=gravity)


@checked
def static_equilibrium(
    cup: Cup, package: Package, T_world_tool: ArrayLike | None = None,
    gravity: float | ArrayLike = cup_package.STANDARD_GRAVITY
) -> Array:
    """
    Return the pose of a package that hangs from a tool at rest (3.9).

    Parameters
    ----------
    cup : Cup
        Cup between tool and package.
    package : Package
        Package on the cup.
    T_world_tool : array_like (4, 4) or RigidTransform, optional
        Pose of the tool tip E in the world, m; default: upright at the origin.
    gravity : float or array_like (3,)
        Magnitude along -z of the world, or vector in the world, m/s^2.

    Returns
    -------
    ndarray (4, 4)
        T_world_package, the pose of the centre of mass B.

    Raises
    ------
    BellowsError
        If T_world_tool is not a pose, or the cup cannot carry the package in this pose.

    Examples
    --------
    The weight stretches the cup by m g / K_z:

    >>> cup = bellows_ros.read_cup('bags/cup.yaml')
    >>> package = bellows_ros.read_package('bags/package.yaml')
    >>> T_world_package = bellows_ros.static_equilibrium(cup, package)
    >>> T_world_package[:3, 3].round(5).tolist()
    [0.0, 0.0, -0.07792]

    """
    resolve(parameters_of(cup, package))
    T = np.eye(4) if T_world_tool is None else cup_package.frozen_array(
        getattr(T_world_tool, 'as_matrix', lambda: T_world_tool)(), (4, 4), 'T_world_tool')
    R = T[:3, :3]
    is_rotation = np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0
    if not (is_rotation and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))):
        raise BellowsError(
            f'T_world_tool must be a rotation and a position above 0, 0, 0, 1, got {T.tolist()}.')
    tool = state_row(T[:3, 3], rotation_to_quaternion(R))
    body = equilibrium.static_equilibrium(cup_package.model_tuple(cup, package, gravity), tool)
    return transform(quaternion_to_rotation(np.array(body[1])), np.array(body[0]))


@checked
def plan(
    motion: MotionSource, parameters: Parameters, urdf: str = '', topic: str = ''
) -> PlanReport:
    """
    Predict the package's motion under a planned motion of the tool, as `bellows plan`.

    Parameters
    ----------
    motion : path or Trajectory
        A recording with a plan, joint states, transforms or poses of the tool; a TUM file; a
        message or a motion as YAML; or the poses of E in a world with z up, with body twists, or,
        without them, from rest to rest.
    parameters : mapping or path
        Package and cup by name, and the grip if known; or a file with them.
    urdf, topic : str
        URDF of the arm for a plan of joints; topic of the plan in a recording with several.

    Returns
    -------
    PlanReport
        It has prediction, warnings and succeeded, whether the cup holds; `plot()` draws it and
        `to_json(path)` writes it.

    Raises
    ------
    BellowsError
        If the motion cannot be read, is impossible for an arm, or the cup cannot hold the package.

    Examples
    --------
    >>> result = bellows_ros.plan('bags/transport.yaml', 'bags/tossing.yaml')
    >>> result.succeeded
    True

    """
    from bellows_ros.workflows import plan as workflow

    return workflow.plan(motion, _parameters(parameters), urdf, topic)


@checked
def fastest(
    motion: MotionSource, parameters: Parameters, urdf: str = '', topic: str = ''
) -> PlanReport:
    """
    Predict a motion like `plan`, and find the shortest time with a safe grip.

    Returns
    -------
    PlanReport
        As in `plan`, of the motion in the shortest time; `fastest.scale` is the ratio of the
        shortest time to the motion's own time.

    Raises
    ------
    BellowsError
        As in `plan`; or if the grip is unknown, the motion is not from rest to rest, or no time
        is safe.

    Examples
    --------
    >>> result = bellows_ros.fastest('bags/transport.yaml', 'bags/tossing.yaml')
    >>> bool(0.3 < result.fastest.scale < 1.5)
    True

    """
    from bellows_ros.workflows import plan as workflow

    return workflow.plan(
        motion, _parameters(parameters), urdf, topic, seek_fastest=True)


@checked
def steer(
    motion: MotionSource, parameters: Parameters, method: str = 'zvd',
    limits: Mapping[str, object] | File = '', urdf: str = '', topic: str = '',
) -> PlanReport:
    """
    Change a motion so that the package does not swing, as `bellows plan --steer`.

    Parameters
    ----------
    motion, parameters, urdf, topic
        As in `plan`.
    method : {'zv', 'zvd'}
        Input shaping for the modes of cup and package at rest.
    limits : mapping or path, optional
        Limits of the arm, to which the motion is slowed down, as in config/limits_example.yaml.

    Returns
    -------
    PlanReport
        As in `plan`, of the steered motion, steered.tool; `motions` has both motions by name.

    Raises
    ------
    BellowsError
        As in `plan`; or if the motion cannot be steered within the limits.

    Examples
    --------
    >>> result = bellows_ros.steer('bags/transport.yaml', 'bags/tossing.yaml')
    >>> bool(result.motions['zvd'].summary()['swing_left'] < 0.01)
    True

    """
    from bellows_ros.workflows import plan as workflow

    return workflow.steer_plan(motion, _parameters(parameters), method, limits, urdf, topic)


@checked
def toss(
    motion: MotionSource, parameters: Parameters, release: float | None = None,
    target: Sequence[float] | None = None, urdf: str = '', topic: str = '',
) -> TossResult:
    """
    Predict a toss: the landing and its covariance, like `bellows toss`.

    Parameters
    ----------
    motion, parameters, urdf, topic
        As in `plan`, with release.* among the parameters.
    release : float, optional
        Time of the valve, s from the time 0 of the plan.
    target : (x, y), optional
        Target of B, m, for which the time of the valve is searched.

    Returns
    -------
    TossResult
        It has toss, covariance (6, 6) of the landing, groups(), warnings; `plot()`,
        `to_json(path)`.

    Raises
    ------
    BellowsError
        As in `plan`; or if neither a time nor a target is given.

    Examples
    --------
    >>> result = bellows_ros.toss('bags/throw.yaml', 'bags/tossing.yaml', release=1.0)
    >>> result.covariance.shape
    (6, 6)

    """
    x_y: Any = None if target is None else tuple(
        cup_package.frozen_array(target, (2,), 'target').tolist())
    from bellows_ros.workflows import toss as workflow

    return workflow.toss_plan(
        motion, _parameters(parameters), release, x_y, urdf=urdf, topic=topic)


@checked
def replay(recording: File, parameters: Parameters) -> Replay:
    """
    Predict a recording with a cup from start to end and compare both, like `bellows replay`.

    Parameters
    ----------
    recording : path
        rosbag2 folder, or a bare .mcap or .db3 file, not used for the identification of the cup.
    parameters : mapping or path
        Package, cup, topics and settings of the recording by name, or a file with them.

    Returns
    -------
    Replay
        It has validation, live and warnings; `plot()` draws it and `to_json(path)` writes it.

    Raises
    ------
    BellowsError
        If a parameter or the recording is unusable, or the cup cannot hold the package.

    Examples
    --------
    >>> result = bellows_ros.replay(
    ...     'bags/validation', bellows_ros.read_parameters('bags/tossing.yaml'))
    >>> bool(result.validation.scores.nrmse[3] < 0.05)
    True

    """
    from bellows_ros.workflows import replay as workflow

    return workflow.replay(recording, _parameters(parameters))


@checked
def observe(recording: File, parameters: Parameters, topic: str) -> Replay:
    """
    Replay a recording, with a second prediction corrected by measured poses of the package.

    Parameters
    ----------
    recording, parameters
        Recording and parameters, as in `replay`, with the parameters measured.*.
    topic : str
        Topic with the poses of the package from a camera.

    Returns
    -------
    Replay
        As in `replay`; `observed` compares prediction, camera and both, and has the alarms.

    Raises
    ------
    BellowsError
        As in `replay`; or if there are no poses on the topic.

    Examples
    --------
    >>> result = bellows_ros.observe(
    ...     'bags/validation', 'bags/tossing.yaml', 'package/pose')
    >>> sorted(result.observed.estimates)[0]
    'both'

    """
    from bellows_ros.workflows import replay as workflow

    if not topic:
        raise BellowsError('topic is empty. Name the one with measured poses of the package.')
    return workflow.replay(recording, _parameters(parameters), observe=topic)


def _samples_of(poses: Trajectory) -> Trajectory:
    """Return the valid poses without those that repeat a pose in motion."""
    good = poses.select(poses.valid)
    return good.select(~repeated(pose_steps(good.position, good.rotation)))


def _parameters(source: Parameters, names: Sequence[str] = PACKAGE_PARAMETERS) -> Values:
    """Return parameters by name; raise if a required name is missing."""
    values, what = (Values(source), 'The mapping of parameters') if isinstance(
        source, Mapping) else (Values(read_parameters(source)), f"Parameter file '{source}'")
    if missing := [name for name in names if name not in values]:
        raise BellowsError(f'{what} lacks {", ".join(missing)}. Add parameters_of(cup, package), '
                           'or give a file that has them.')
    return values
