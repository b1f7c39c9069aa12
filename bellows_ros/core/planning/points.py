"""
Conversion of the points of a plan to a trajectory of the tool and of its joints, with checks.

Inverse kinematics gives the joints along a path of the tool, with rates and limits.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
import math
from typing import Any, NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Stamps
from bellows_ros.core.model.simulation import tool_rows, ToolRows
from bellows_ros.core.planning.arm import Arm
from bellows_ros.core.signals.resampling import resample, subdivided
from bellows_ros.core.signals.screening import MAX_TOOL_RATE, MAX_TOOL_SPEED, UNIT_TOLERANCE
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
import scipy  # whose parts are loaded as they are used: the predictor starts without

MAX_POINTS = 100_000
"""Largest number of points of a plan."""

MAX_TIME = 600.0
"""Longest duration of a plan, s."""

MAX_PLAN_NUMBER = 1e9
"""Bound of the numbers of a plan, against overflows of its polynomials, SI units."""

MAX_GAP_NS = 10_000_000
"""Longest time between points without interpolation, ns."""

JUMP_TOLERANCE = (1e-3, 1e-2)
"""Largest step between points that is plausible at any speed, m and rad."""

INSTANT_NS = 1000
"""Time in which a speed changes at once, ns."""
MIN_SPACING = 1e-4
"""Time between points below which the speed changes at once, s."""
MAX_SPEED_STEP = (0.02, 0.1)
"""Largest instantaneous change of speed without a warning, m/s and rad/s: a force of 1 N by the
damping of a usual cup."""

MAX_MISFIT = 0.5
"""Largest RMS deviation of the integrated rates from the steps, relative to the steps."""
MIN_JUDGED = 20
"""Number of points from which the integrated rates are compared: fewer may hide the motion."""


def plan_of(
    stamps_ns: Stamps, poses: Array, twist: Array | None = None,
    twist_frame: str = 'world', name: str = 'The plan', given: bool = True,
) -> ToolRows:
    """
    Check the points of a plan; return it with body twists and without long gaps.

    Parameters
    ----------
    stamps_ns : int array (N,)
        Stamps, ns.
    poses : array (N, 7)
        Position (m) and quaternion xyzw of E in the world.
    twist : array (N, 6), optional
        Velocity of the tool tip and angular velocity (m/s, rad/s); by default from a cubic spline
        from rest to rest. The tool moves along cubic polynomials between points.
    twist_frame : {'world', 'tool'}
        Axes of the twists.
    name : str
        Name of the plan for messages.
    given : bool
        Whether the twists are given, and not estimated from the poses. Given twists are tested.

    Raises
    ------
    BellowsError
        If the plan is impossible for an arm: too few or too many points, times that do not
        increase, numbers that are not finite, quaternions not of unit length, jumps, inconsistent
        velocities.

    """
    _require_points(stamps_ns, (poses, twist), name)
    length = np.linalg.norm(poses[:, 3:], axis=1)
    _refuse(np.abs(length - 1.0) > UNIT_TOLERANCE, name,
            'has a quaternion that is not of unit length', f'length 1 to {UNIT_TOLERANCE:g}',
            'Are its numbers x, y, z, w in this order?')
    q = poses[:, 3:] / length[:, None]
    R = lie.quaternion_to_rotation(q)
    in_tool = np.swapaxes(R, -1, -2) if twist_frame == 'world' else np.eye(3)
    v, w = (lie.apply(in_tool, rate)
            for rate in np.hsplit(np.zeros((len(poses), 6)) if twist is None else twist, 2))
    t = (stamps_ns - stamps_ns[0]) / NS_PER_S
    step, rotation = _steps(poses[:, :3], R)
    _require_reachable(np.diff(t), step, rotation, v, w, name)
    if twist is None:
        continuous = _continuous_quaternions(R)
        curve = scipy.interpolate.CubicSpline(
            t, np.hstack([poses[:, :3], continuous]), bc_type='clamped')
        body = body_twists(continuous, curve(t, 1))[1]
    else:
        body = np.hstack([v, w])
        if given:
            require_consistent(np.diff(t), step, lie.apply(R, v), f'{name}: its velocities')
            require_consistent(np.diff(t), rotation, w, f'{name}: its angular velocities')
    plan = ToolRows(stamps_ns, np.hstack([poses[:, :3], q, body]))
    fine_ns = _without_gaps(stamps_ns)
    if len(fine_ns) == len(stamps_ns):
        return plan
    return ToolRows(fine_ns, tool_rows(resample(plan.trajectory(), fine_ns)))


def plan_of_joints(
    arm: Arm, names: Sequence[str], stamps_ns: Stamps, position: Array,
    velocity: Array | None = None, acceleration: Array | None = None,
) -> tuple[Trajectory, 'Joints']:
    """
    Check the points of a plan of an arm's joints; return it as a plan of the tool, and its joints.

    Joints move as ros2_control documents it: linearly between points that have positions alone,
    along cubic polynomials with given velocities, and quintic ones with given velocities and
    accelerations. Along straight lines the joints begin and end at rest.

    Parameters
    ----------
    arm : Arm
        Arm with these joints.
    names : sequence of str
        Names of the K joints, including all that move the tool.
    stamps_ns : int array (N,)
        Stamps, ns.
    position, velocity, acceleration : array (N, K)
        Motion of the joints in the order of their names, rad or m.

    Raises
    ------
    BellowsError
        If a joint is missing, and as `plan_of`.

    """
    columns = arm.columns(names, 'The plan')
    q = position[:, columns]
    rate, bend = (None if part is None else part[:, columns] for part in (velocity, acceleration))
    _require_points(stamps_ns, (q, rate, bend), 'The plan')
    t = (stamps_ns - stamps_ns[0]) / NS_PER_S
    fine = _without_gaps(stamps_ns)
    if rate is None:
        fine = _with_instants(fine, stamps_ns)
    else:
        require_consistent(
            np.diff(t), np.diff(q, axis=0), rate, 'The plan: the velocities of its joints')
    curve = interpolated(t, q, rate, bend)
    at = (fine - stamps_ns[0]) / NS_PER_S
    speed = curve(at, 1)
    if rate is None:
        speed[[0, -1]] = 0.0
    T, twist = arm.tool(curve(at), speed)
    tool = Trajectory(fine, T[:, :3, 3], T[:, :3, :3], twist)
    step, rotation = _steps(tool.position, tool.rotation)
    _require_reachable(np.diff(at), step, rotation, twist[:, :3], twist[:, 3:], 'The plan')
    return tool, Joints(arm, stamps_ns, q)


def interpolated(t: Array, value: Array, rate: Array | None, bend: Array | None) -> Any:
    """
    Return piecewise polynomials in time by the given fields, as ros2_control documents them.

    Parameters
    ----------
    t : array (N,)
        Times of the points, s.
    value, rate, bend : array (N, M) or None
        Positions of the joints, and their derivatives; accelerations need velocities.

    """
    if rate is None:
        slope = np.diff(value, axis=0) / np.diff(t)[:, None]
        return scipy.interpolate.PPoly(np.array([slope, value[:-1]]), t)
    if bend is None:
        return scipy.interpolate.CubicHermiteSpline(t, value, rate)
    return quintic(t, value, rate, bend)


def _with_instants(fine_ns: Stamps, stamps_ns: Stamps) -> Stamps:
    """Return stamps with those between which the speed changes at a plan's points (N,)."""
    instant = np.minimum(INSTANT_NS, np.diff(stamps_ns) // 2)
    after_first, before = stamps_ns[0] + instant[:1], stamps_ns[1:] - instant
    return np.unique(np.concatenate([fine_ns, after_first, before]))


def speed_step_finding(tool: Trajectory | ToolRows) -> Finding | None:
    """Return the finding on instantaneous changes of a tool's speed, None for small ones."""
    change = np.diff(tool_rows(tool)[:, 7:], axis=0)[np.diff(tool.seconds) < MIN_SPACING]
    sizes = np.linalg.norm(change.reshape(-1, 2, 3), axis=2).max(axis=0, initial=0.0)
    if (sizes <= MAX_SPEED_STEP).all():
        return None
    linear, angular = sizes.tolist()
    return Finding('speed_steps', Level.WARN, {'linear': linear, 'angular': angular})


def _steps(position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return the shifts (N - 1, 3), m, and rotation vectors, rad, between poses."""
    R_earlier_later = np.swapaxes(rotation[:-1], -1, -2) @ rotation[1:]
    return np.diff(position, axis=0), lie.log_so3(R_earlier_later)


def _without_gaps(stamps_ns: Stamps) -> Stamps:
    """Return stamps at most `MAX_GAP_NS` apart."""
    return subdivided(stamps_ns, -(-np.diff(stamps_ns) // MAX_GAP_NS))


def _continuous_quaternions(rotation: Array) -> Array:
    """Return quaternions (N, 4) with the sign that is nearest to the previous one."""
    q = lie.rotation_to_quaternion(rotation)
    q[1:] *= np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0))[:, None]
    return q


def curve_of(motion: Trajectory) -> Any:
    """
    Return a motion as cubic Hermite polynomials in time, s since its first point.

    The values are position and quaternion, (..., 7), normalised at the motion's points.
    """
    q, twist = _continuous_quaternions(motion.rotation), np.asarray(motion.twist)
    spin = 0.5 * lie.quaternion_product(q, np.pad(twist[:, 3:], ((0, 0), (0, 1))))
    return scipy.interpolate.CubicHermiteSpline(
        motion.seconds, np.hstack([motion.position, q]),
        np.hstack([lie.apply(motion.rotation, twist[:, :3]), spin]))


def body_twists(q: Array, rate: Array) -> tuple[Array, Array]:
    """
    Return rotations (N, 3, 3) and body twists (N, 6) from rates (N, 7) of position and quaternion.

    The quaternions (N, 4) may have any length.
    """
    size = np.sum(q * q, axis=1)[:, None]
    rotation = lie.quaternion_to_rotation(q / np.sqrt(size))
    angular = 2.0 * lie.quaternion_product(lie.quaternion_conjugate(q), rate[:, 3:])[:, :3] / size
    return rotation, np.hstack([lie.apply(np.swapaxes(rotation, -1, -2), rate[:, :3]), angular])


def quintic(t: Array, value: Array, rate: Array, bend: Array) -> Any:
    """Return quintic polynomials between times (N,) with given values and derivatives (N, M)."""
    h = np.diff(t)[:, None]
    v, v_end, a, a_end = h * rate[:-1], h * rate[1:], h**2 * bend[:-1], h**2 * bend[1:]
    d, e, f = np.diff(value, axis=0) - v - 0.5 * a, v_end - v - a, a_end - a
    return scipy.interpolate.PPoly(np.array([
        (6 * d - 3 * e + 0.5 * f) / h**5, (-15 * d + 7 * e - f) / h**4,
        (10 * d - 4 * e + 0.5 * f) / h**3, 0.5 * bend[:-1], rate[:-1], value[:-1]]), t)


def timed(plan: Trajectory, factor: float) -> Trajectory:
    """Return a plan stretched in time by a factor, with the same first stamp."""
    stamps = plan.stamps_ns[0] + np.round((plan.stamps_ns - plan.stamps_ns[0]) * factor).astype(
        np.int64)
    return replace(plan, stamps_ns=stamps, twist=np.asarray(plan.twist) / factor)


# ------------------------------------------------------------------------------------- checks


def require_count(count: int, name: str) -> None:
    """Raise for a plan without a motion, or with too many points."""
    if not 2 <= count <= MAX_POINTS:
        raise BellowsError(
            f'{name} has {count} point{"" if count == 1 else "s"}; expected 2 to {MAX_POINTS}. '
            + ('A single point is the end of the motion: give its start, too, at '
               'time_from_start 0.' if count < 2 else 'Thin it out, or split it.'))


def _refuse(bad: Any, name: str, what: str, expected: str, remedy: str) -> None:
    """Raise for a plan with invalid points, naming the first."""
    if bad.any():
        raise BellowsError(
            f'{name}: point {int(np.argmax(bad))} (the first is 0) {what}, as {int(bad.sum())} of '
            f'{len(bad)} do; expected {expected}. {remedy}')


def _require_points(stamps_ns: Stamps, parts: Iterable[Array | None], name: str) -> None:
    """Raise for a wrong number of points, numbers that are not finite, and implausible times."""
    require_count(len(stamps_ns), name)
    numbers = np.hstack([part for part in parts if part is not None])
    _refuse(~(np.abs(numbers) < MAX_PLAN_NUMBER).all(axis=1), name,
            'holds NaN, infinity or a huge number', f'numbers below {MAX_PLAN_NUMBER:g}',
            'Leave such points out.')
    steps = np.diff(stamps_ns)
    if steps.min() <= 0:
        i = int(np.argmax(steps <= 0))
        t = (stamps_ns[i:i + 2] - stamps_ns[0]) / NS_PER_S
        raise BellowsError(
            f'{name} is not timed: point {i + 1} (the first is 0) is at {t[1]:.6f} s, after one '
            f'at {t[0]:.6f} s; expected increasing times. Sort the points, or time them with the '
            'planner (in MoveIt a time parameterization such as TOTG).')
    seconds = float(stamps_ns[-1] - stamps_ns[0]) / NS_PER_S
    if seconds > MAX_TIME:
        raise BellowsError(
            f'{name} takes {seconds:g} s; expected at most {MAX_TIME:g}. Check that its times are '
            'in seconds.')


def _require_reachable(
    durations: Array, step: Array, rotation: Array, v: Array, w: Array, name: str
) -> None:
    """Raise for steps (m, rad) between points, or velocities, that no arm can follow."""
    moved, turned, speed, rate = (np.linalg.norm(each, axis=1) for each in (step, rotation, v, w))
    jump = (moved > JUMP_TOLERANCE[0] + MAX_TOOL_SPEED * durations) | (
        turned > JUMP_TOLERANCE[1] + MAX_TOOL_RATE * durations)
    is_fast = (speed > MAX_TOOL_SPEED) | (rate > MAX_TOOL_RATE)
    is_fast[:-1] |= jump
    _refuse(is_fast, name, 'is faster than any arm, or jumps to the next',
            f'at most {MAX_TOOL_SPEED:g} m/s and {MAX_TOOL_RATE:g} rad/s',
            'Check units and times.')


def require_consistent(durations: Array, steps: Array, rates: Array, what: str) -> None:
    """Raise for rates (N, K) that contradict the steps (N - 1, K) between points."""
    misfit = contradiction(durations, steps, rates)
    if misfit is not None:
        size = float(np.sqrt(np.mean(steps**2)))
        raise BellowsError(
            f'{what} contradict the points: integrated they deviate by {misfit:.3g} from steps of '
            f'{size:.3g} (RMS, SI units); expected the same motion. Check their signs, units, '
            'times and axes (tool_twist.frame: world or tool), or leave them out.')


def contradiction(durations: Array, steps: Array, rates: Array) -> float | None:
    """
    Return the deviation of the integrated rates (N, K) from the steps (N - 1, K), None if small.

    The integral of the rates by trapezoids over the durations (s) must be near the steps; of few
    points it must not have the opposite direction.
    """
    moves = 0.5 * (rates[1:] + rates[:-1]) * durations[:, None]
    errors, size = moves - steps, float(np.sqrt(np.mean(steps**2)))
    # white noise of recorded poses: successive steps have opposite parts
    noise = max(-2.0 * float(np.mean(errors[1:] * errors[:-1])), 0.0) if len(errors) > 1 else 0.0
    misfit = math.sqrt(max(float(np.mean(errors**2)) - noise, 0.0))
    allowed = MAX_MISFIT * size + JUMP_TOLERANCE[0] * float(np.median(durations))
    judged = misfit > allowed if len(rates) >= MIN_JUDGED else np.sum(moves * steps) < 0.0
    return misfit if judged else None


MIN_GAIN = 0.01
"""Smallest speed of the tool in any direction at unit speed of the joints in a regular pose, m/s
or rad/s."""

MAX_JUMP = 0.5
"""Largest step of a joint between points without a change of configuration, rad or m."""

CHECK_RATE = 1000.0
"""Rate at which limits are checked between the points, Hz."""


class JointPath(NamedTuple):
    """Motion of an arm's moving joints: times (N,), s; then (N, M) rad or m, per s and per s^2."""

    seconds: Array
    position: Array
    velocity: Array
    acceleration: Array


def joint_path(arm: Arm, tool: Trajectory, guess: Array) -> JointPath:
    """
    Return the motion of the joints that moves the tool along a path.

    Parameters
    ----------
    arm : Arm
        Arm; the tool's poses are poses of its tool link in its root.
    tool : Trajectory
        N points with body twists.
    guess : array (N, M)
        Joint positions of a nearby motion, which select the configuration and, for a redundant
        arm, the nearest solution.

    Raises
    ------
    BellowsError
        If a point is out of reach or singular, or the arm would have to change its configuration;
        with the time.

    """
    seconds = tool.seconds
    position = arm.positions(lie.transform(tool.rotation, tool.position), guess)
    J = arm.jacobian(position)
    gains = np.linalg.svd(J, compute_uv=False)[:, -1]
    if gains[worst := int(np.argmin(gains))] < MIN_GAIN:
        raise BellowsError(
            f'The arm is singular at {seconds[worst]:.3f} s: a joint speed of 1 rad/s moves the '
            f'tool by {gains[worst]:.2g} m/s or rad/s in some direction, expected at least '
            f'{MIN_GAIN:g}. Start in another configuration, or move the path.')
    jumps = np.abs(np.diff(position, axis=0)).max(axis=1)
    if jumps[worst := int(np.argmax(jumps))] > MAX_JUMP:
        raise BellowsError(
            f'The arm changes its configuration at {seconds[worst]:.3f} s: a joint moves by '
            f'{jumps[worst]:.2g} rad or m between two points, expected at most {MAX_JUMP:g}. '
            'Start in another configuration, or give more points.')
    slope = scipy.interpolate.CubicSpline(seconds, position)(seconds, 1)
    missing = np.asarray(tool.twist) - lie.apply(J, slope)
    velocity = np.asarray(slope + (np.linalg.pinv(J) @ missing[..., None])[..., 0])
    acceleration = scipy.interpolate.CubicSpline(seconds, velocity)(seconds, 1)
    return JointPath(seconds, position, velocity, acceleration)


def joint_parts(arm: Arm, path: JointPath, acceleration: float) -> dict[str, float]:
    """
    Return the used part of each limit of the joints; a part above 1 exceeds its limit.

    Parameters
    ----------
    arm : Arm
        Arm with ranges and speeds of its joints.
    path : JointPath
        Motion along quintic polynomials, as by drivers; checked at `CHECK_RATE`.
    acceleration : float
        Largest acceleration of each joint, rad/s^2 or m/s^2.

    Raises
    ------
    BellowsError
        If a joint leaves its range, at any speed.

    """
    curve, parts = quintic(*path), dict[str, float]()
    at = np.linspace(
        0.0, path.seconds[-1], max(2, int(np.ceil(path.seconds[-1] * CHECK_RATE)) + 1))
    speeds, rates = np.abs(curve(at, 1)).max(axis=0), np.abs(curve(at, 2)).max(axis=0)
    for joint, position, speed, rate in zip(
            arm.moving_joints, curve(at).T, speeds, rates, strict=True):
        k = int(np.argmax(np.maximum(joint.lower - position, position - joint.upper)))
        if not joint.lower <= position[k] <= joint.upper:
            raise BellowsError(
                f"Joint '{joint.name}' would be at {position[k]:.4g} at {at[k]:.3f} s; its "
                f'range is {joint.lower:.4g} to {joint.upper:.4g} (rad or m). Start in '
                'another configuration, or move the path.')
        parts[f'{joint.name} speed'] = float(speed / joint.speed)
        parts[f'{joint.name} acceleration'] = float(rate / acceleration)
    return parts


def joint_excess(arm: Arm, path: JointPath, acceleration: float) -> tuple[float, str]:
    """Return the smallest factor of the duration within the limits of joints, and the limit."""
    return max([(1.0, ''), *(
        (math.sqrt(part) if name.endswith('acceleration') else part, name)
        for name, part in joint_parts(arm, path, acceleration).items() if part > 1.0)])


class Joints(NamedTuple):
    """
    Joint positions of a plan of an arm's joints.

    Parameters
    ----------
    arm : Arm
    stamps_ns : int array (N,)
        Stamps, ns.
    position : array (N, M)
        Positions of the moving joints in their order, rad or m.

    """

    arm: Arm
    stamps_ns: Stamps
    position: Array

    def along(self, tool: Trajectory, planned: Trajectory) -> JointPath:
        """
        Return the joint motion for another motion of the tool, in the configuration of this plan.

        The points have about the spacing of the plan, at most 10 ms.

        Parameters
        ----------
        tool : Trajectory
            Motion of the tool link in the arm's root.
        planned : Trajectory
            Planned motion of the tool, whose joints at equal relative times give the
            configuration.

        Raises
        ------
        BellowsError
            As in `joint_path`.

        """
        step = min(float(np.median(np.diff(self.stamps_ns))) / NS_PER_S, 0.01)
        rows = np.flatnonzero(np.append(True, np.diff(tool.seconds) > MIN_SPACING))
        every = max(1, round(step / float(np.median(np.diff(tool.seconds[rows])))))
        rows = rows[::every]
        rows[-1] = len(tool) - 1  # at rest, where the plan ends at rest
        points = tool.select(rows)
        part = points.seconds / points.seconds[-1]
        since, until = (int(stamp - self.stamps_ns[0]) for stamp in planned.stamps_ns[[0, -1]])
        spline = scipy.interpolate.CubicSpline(self.stamps_ns - self.stamps_ns[0], self.position)
        return joint_path(self.arm, points, spline(since + part * (until - since)))
