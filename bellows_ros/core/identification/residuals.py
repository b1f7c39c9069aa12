"""
Whitened differences between measured and simulated poses of the package.

The package is simulated along the path of the tool, from rest or a first state near it, which is
free within wide limits and eliminated. A sensor gives six numbers in each bin of time: the
differences of a tracked body's pose, or the residuals of a tag's corners, relative to their noise.

Noise of the tool's poses moves the simulated package. A Kalman filter whitens the numbers by the
noise of the sensor and by that of the tool's path, with which the package swings about its
simulated motion; see `smoother`. With exact poses of the tool, this is output error; with noisy
ones, the sum of squares is the minimum over all paths of the tool (total least squares).

Derivatives are differences of simulations along the likeliest path, without the frequencies at
which it is noise (instrumental variables): derivatives with the noise that also is in the numbers
would have a mean product with them, and bias the damping.
"""

from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.identification.result import CHANCE
from bellows_ros.core.identification.segments import (
    Course,
    in_threads,
    MIN_POSE_STD,
    ROW_NS,
    Segment,
)
from bellows_ros.core.identification.smoother import (
    filtered,
    lie_bracket,
    noise_of_means,
    path_noise,
    response,
    Sensor,
    small_motion,
    SmallMotion,
    smoothed,
    Steps,
    steps_of,
)
from bellows_ros.core.identification.unknowns import (
    delayed,
    DIFFERENCE,
    Problem,
    QUANTITY_DIFFERENCE,
)
from bellows_ros.core.model import equilibrium, simulation
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import Seen
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np
import scipy

START_STD = np.repeat([0.05, 0.3, 0.5, 3.0], 3)
"""Standard deviation of the package's first state about rest on the tool: wider than any swing,
m, rad, m/s and rad/s."""

MIN_INTEGRATION_STEP = 2e-5
"""
Shortest step of the integrator, s.

A cup with modes faster than 20,000/s, which needs shorter steps, is rejected by the search.
"""

MAX_QUICKENING = 30.0
"""Largest ratio of the speed of modes to the start, with 100 times the stiffness and 10 times the
ordinary damping."""

COARSE_FACTOR = 4.0
"""
Ratio of the integrator's steps in a fit to the steps in a prediction.

K and P of `bags/identification` change by less than 1e-4, 0.01 standard errors.
"""

MIN_GROWTH = 0.1
"""Smallest ratio of the variances of slow poses after a step and before it."""

BLOCK_DURATION = 1.0
"""Length of the parts of a recording whose information is stored, and of the zeros behind a
series, s: some periods of a swing, which decays before the series begins again."""

MAX_WHITE_CORRELATION = 0.1
"""Largest correlation of innovations that count as white, or chance if larger."""


class Part(NamedTuple):
    """
    The whitened differences of a segment.

    Innovations (N, 6), weighted by Huber; differences (N, 6) in m and rad; sum of the logarithms
    of their variances; the course with the likeliest path and first state; the noise
    (6,) of poses by the differences; information (c, q, q) and slope (c, q) of each second; and
    the smear (N,) of views, rad.
    """

    innovations: Array
    residuals: Array
    logs: float
    course: Course
    std: Array
    information: Array
    slope: Array
    smear: Array

    @property
    def is_white(self) -> bool:
        """Whether successive innovations are uncorrelated."""
        e = np.clip(self.innovations, -CHANCE, CHANCE)
        correlation = [np.sum(e[lag:] * e[:-lag], axis=0) / np.sum(e**2, axis=0)
                       for lag in (1, 2, 3) if lag < len(e)]
        limit = max(MAX_WHITE_CORRELATION, CHANCE / np.sqrt(len(e)))
        return bool(np.max(np.abs(correlation), initial=0.0) < limit)


def model_step(problem: Problem, theta: Array, segment: Segment) -> float:
    """Return the longest step (s) of the integrator, or raise for too fast a cup."""
    longest, first = (COARSE_FACTOR * equilibrium.largest_step(problem.model(each, segment))
                      for each in (theta, problem.start))
    shortest = max(MIN_INTEGRATION_STEP, first / MAX_QUICKENING)
    if longest < shortest:
        raise BellowsError(
            f'With this cup the simulation needs integration steps of {longest:.2g} s; at '
            f'least {shortest:.2g} s is expected. Check the units of package.mass, '
            'package.inertia, cup.stiffness and cup.damping.')
    return min(longest, 0.5 * ROW_NS / NS_PER_S)  # two steps between rows


def _first_state(model: ModelTuple, tool: Array, change: Array) -> State:
    """Return the package at rest on the tool (13,), carried by its twist, after a change (12,)."""
    try:
        rest = simulation.rest(model, tool)
    except UnstableError:
        rest = equilibrium.resting_on_tool(model, simulation.row_state(tool))
    T_tool, T_body = (lie.transform(lie.quaternion_to_rotation(np.array(q)), np.array(o))
                      for o, q in ((tool[:3], tool[3:7]), rest[:2]))
    twist = lie.adjoint(lie.inverse_transform(T_body) @ T_tool) @ tool[7:]
    moved = equilibrium.moved_by(rest, change + np.append(np.zeros(6), twist))
    plain: State = moved[0], moved[1], moved[2], moved[3]
    return equilibrium.adapted(model, simulation.row_state(tool), plain)


def _spans(problem: Problem, segment: Segment) -> list[tuple[slice, float]]:
    """Return parts of the rows with one model each, and what `Problem.model` needs for them."""
    count, rows_ns = len(segment.rows), segment.rows_ns
    first, last = segment.span_ns
    if 'length_drift' in problem.rows:
        length = round(BLOCK_DURATION * NS_PER_S / ROW_NS)
        return [(slice(i, min(i + length, count - 1) + 1), float(
            (rows_ns[i] - first) / (last - first) - 0.5)) for i in range(0, count - 1, length)]
    if 'slip' in problem.rows and problem.slip_ns >= first:
        at = int(np.clip(np.searchsorted(rows_ns, problem.slip_ns), 0, count - 1))
        return [(span, part) for span, part in (
            (slice(0, at + 1), -1.0), (slice(at, count), 0.0)) if span.stop - span.start > 1]
    return [(slice(0, count), 0.0 if 'slip' not in problem.rows else -1.0)]


def _marked(problem: Problem, theta: Array, segment: Segment, tool: Array) -> Array:
    """Return states (M, 13) of the tool of those of its marker."""
    if 'tool_marker' not in problem.rows:
        return tool
    marker = problem.values(theta)['tool_marker']
    return simulation.tool_rows(body.of_fixed_frame(
        simulation.trajectory_of(segment.rows_ns, tool), marker[3:], marker[:3]))


def simulated(
    problem: Problem, theta: Array, segment: Segment, tool: Array, start: Array, steps: int
) -> Array:
    """
    Return the package's states (M, 13) at the rows of the tool (M, 13); theta is local.

    The first state is a change (12,) from rest on the measured tool, whatever the path.
    """
    out, state = np.empty((len(tool), 13)), None
    tool, measured = (_marked(problem, theta, segment, rows) for rows in (tool, segment.rows))
    for span, part in _spans(problem, segment):
        model, rows = problem.model(theta, segment, part), tool[span]
        if state is None:
            state = _first_state(model, measured[0], start)
        count = len(rows) - 1
        found = simulation.simulate_rows(
            model, state, rows, np.full(count, ROW_NS / NS_PER_S),
            np.full(count, steps, dtype=np.int64))
        out[span] = found[:, :13]
        state = simulation.body_row(found[-1].tolist(), state)
    if not np.all(np.isfinite(out)):
        raise UnstableError(
            'The simulation diverges with this cup. Check package.mass, package.com, the frames, '
            'cup.stiffness and cup.damping.')
    return out


def simulation_of(
    problem: Problem, theta: Array, segment: Segment, course: Course
) -> tuple[Array, Array]:
    """
    Return the package's states (M, 13) at the rows, and derivatives (M, 6, q) of its poses.

    The derivatives are in body axes, by the unknowns, along a smooth path: the response to noise
    of the tool would agree with the same noise in the differences.
    """
    steps = int(equilibrium.substeps_for(
        ROW_NS / NS_PER_S, model_step(problem, theta, segment)))
    size = len(theta)
    lengths = np.concatenate([
        np.full(problem.count, DIFFERENCE), np.full(size - problem.count, QUANTITY_DIFFERENCE)])
    is_simulated = np.ones(size, dtype=bool)
    for name in SENSED & problem.rows.keys():
        is_simulated[problem.rows[name]] = False

    def run(tool: Array, change: Array) -> Array:
        return simulated(problem, theta + change, segment, tool, course.start, steps)

    smooth_tool, changes = segment.smooth(course.rows), np.diag(lengths)[is_simulated]
    states, smooth, *others = in_threads(
        run, [course.rows, *[smooth_tool] * (1 + len(changes))],
        [np.zeros(size), np.zeros(size), *changes])
    columns = np.zeros((len(smooth), 6, size))
    inverse = np.swapaxes(lie.quaternion_to_rotation(smooth[:, 3:7]), 1, 2)
    conjugate = lie.quaternion_conjugate(smooth[:, 3:7])
    for place, other in zip(np.flatnonzero(is_simulated), others, strict=True):
        columns[:, :3, place] = lie.apply(inverse, other[:, :3] - smooth[:, :3]) / lengths[place]
        turn = lie.quaternion_product(conjugate, other[:, 3:7])
        columns[:, 3:, place] = 2.0 * turn[:, :3] * np.sign(turn[:, 3:]) / lengths[place]
    return states, columns


SENSED = frozenset({
    'time_offset', 'clock_rate', 'package_world', 'package_marker', 'scale', 'exposure'})
"""Quantities of the measured poses, which the simulation is without."""


def at_stamps(rows_ns: Stamps, values: Array, stamps: Stamps) -> Array:
    """Return values (M, ...) of uniform rows at stamps (N,), on cubic curves through the rows."""
    at = (stamps - rows_ns[0]) / (int(rows_ns[1] - rows_ns[0]) if len(rows_ns) > 1 else 1)
    first = np.clip(np.floor(at).astype(np.int64) - 1, 0, max(len(rows_ns) - 4, 0))
    a, b, c, d = ((at - first - k).reshape(-1, *[1] * (values.ndim - 1)) for k in range(4))
    out = np.zeros((len(stamps), *values.shape[1:]))
    for k, weight in enumerate((
            -b * c * d / 6.0, a * c * d / 2.0, -a * b * d / 2.0, a * b * c / 6.0)):
        out += weight * values[np.minimum(first + k, len(rows_ns) - 1)]
    return out


def evaluated(problem: Problem, theta: Array, segment: Segment, course: Course) -> Part:
    """Return a segment's whitened differences, linearised about a course; theta is local."""
    states, columns = simulation_of(problem, theta, segment, course)
    stamps = delayed(segment.package.stamps_ns, problem.values(theta), segment.middle)
    used = (stamps >= segment.rows_ns[0]) & (stamps <= segment.rows_ns[-1])
    place = (segment.package.stamps_ns - segment.bins_ns[0] + segment.bin_ns // 2) // (
        segment.bin_ns)
    used &= (place >= 0) & (place < len(segment.bins_ns))
    if not used.any():
        raise BellowsError('No package pose lies within the motion of the tool.')
    chosen = np.flatnonzero(used)[np.argsort(stamps[used], kind='stable')]
    stamps = stamps[chosen]
    package = resample(simulation.trajectory_of(segment.rows_ns, states), stamps)
    bend = at_stamps(segment.rows_ns, _accelerations(states), stamps)
    starts = np.flatnonzero(np.diff(place[chosen], prepend=-1))
    bins = place[chosen][starts]
    first_ns, delays = int(delayed(
        segment.bins_ns[:1], problem.values(theta), segment.middle)[0]), stamps - stamps[0]
    steps = steps_of(int(segment.rows_ns[0]), first_ns, segment.bin_ns, bins)
    counts = np.diff(starts, append=len(chosen))

    def means(values: Array) -> Array:
        return (np.add.reduceat(values, starts, axis=0).T / counts).T

    centres = stamps[0] + np.rint(means(delays)).astype(np.int64)
    if problem.has_views(segment):
        seen = _seen(problem, theta, segment, course, chosen, package, bend)
        J = at_stamps(segment.rows_ns, columns, stamps)
        numbers = _binned_views(seen, J, starts)
    else:
        e, own = _differences(problem, theta, segment, chosen, package, bend)
        J = at_stamps(segment.rows_ns, columns, centres) + means(own)
        by_pose = np.tile(np.eye(6), (len(J), 1, 1))
        numbers = Numbers(means(e), J, means(e), 0.0, np.empty(0), by_pose)
    sensor = _sensor(problem, segment, course, steps, numbers.by_pose, counts, (
        centres - steps.stamps_ns[steps.places]) / NS_PER_S)
    motion = _small_motion(problem, theta, segment, course, states, steps)
    return _part(segment, course, numbers, steps, sensor, motion, states[0, 7:13])


def _small_motion(
    problem: Problem, theta: Array, segment: Segment, course: Course, states: Array,
    steps: Steps,
) -> SmallMotion:
    """Return the package's small motions about its simulated states (M, 13) at the rows."""
    model = problem.model(theta, segment)
    plain: ModelTuple = (model[0][:4], *model[1:])  # without internal strains
    stamps = steps.stamps_ns
    middles = stamps[:-1] + np.diff(stamps) // 2

    def amid(rows: Array) -> Array:
        found = at_stamps(segment.rows_ns, rows, middles)
        found[:, 3:7] /= np.linalg.norm(found[:, 3:7], axis=1)[:, None]
        return found

    return small_motion(plain, amid(_marked(problem, theta, segment, course.rows)), amid(states),
                        np.diff(stamps) / NS_PER_S)


class Numbers(NamedTuple):
    """
    The numbers of a sensor in K bins.

    Values (K, 6) with their derivatives (K, 6, q) by the unknowns; residuals (K, 6), m and rad;
    sum of the logarithms of the variances to which the values are relative; smears (K,) of views,
    rad; derivatives (K, 6, 6) by the pose of the package.
    """

    values: Array
    derivatives: Array
    residuals: Array
    logs: float
    smear: Array
    by_pose: Array


def _seen(
    problem: Problem, theta: Array, segment: Segment, course: Course, chosen: Places,
    package: Trajectory, bend: Array,
) -> Seen:
    """Return chosen views of a tag about the simulated package."""
    assert segment.views is not None
    return segment.views.select(chosen).seen(
        np.hstack([simulation.tool_rows(package), bend]), course.corners, problem.values(theta),
        problem.rows, problem.units, segment.context)


def _binned_views(seen: Seen, J: Array, starts: Places) -> Numbers:
    """
    Return the views in bins that begin at given views, relative to the noise of their corners.

    J (N, 6, q) are derivatives of the package's poses.
    """
    derivatives = seen.maps @ J + seen.columns
    positive = np.sign(np.einsum('nii->ni', seen.maps))  # as the triangular maps are then unique
    relative = positive / np.sqrt(seen.variance)[:, None]
    root = np.sqrt(np.diff(starts, append=len(relative)))

    def binned(values: Array) -> Array:
        return (np.add.reduceat(values, starts, axis=0).T / root).T

    return Numbers(
        binned(seen.residuals * relative), binned(derivatives * relative[:, :, None]),
        seen.scale * binned(seen.residuals) / root[:, None],
        6.0 * float(np.sum(np.log(seen.variance))), binned(seen.smear) / root,
        binned(seen.maps * relative[:, :, None]))


def _differences(
    problem: Problem, theta: Array, segment: Segment, chosen: Places, package: Trajectory,
    bend: Array,
) -> tuple[Array, Array]:
    """Return differences (N, 6) of chosen poses from simulated ones, and derivatives (N, 6, q)."""
    assert package.twist is not None
    free, size = problem.values(theta), len(theta)
    there = body.poses_of(segment.package.select(chosen), free, *segment.context)
    inverse = np.swapaxes(package.rotation, 1, 2)
    e = np.hstack([lie.apply(inverse, there.position - package.position),
                   lie.log_so3(inverse @ there.rotation)])
    columns = body.columns_of(there, free, problem.rows, size, segment.context, package)
    for name in problem.rows.keys() & set(body.CLOCKS):
        columns[:, :, problem.rows[name]] *= package.twist[:, :, None]
    if 'exposure' in problem.rows and segment.views is None:
        bend = body.EXPOSURE**2 / 24.0 * bend
        e -= free['exposure'] * bend
        columns[:, :, problem.rows['exposure']] = bend[:, :, None]
    return e, columns * problem.units


def _sensor(
    problem: Problem, segment: Segment, course: Course, steps: Steps, by_pose: Array,
    counts: Places, after: Array,
) -> Sensor:
    """
    Return the noise of the means of poses, or that of views relative to their own, in bins.

    Bins have counts (K,) of poses, and mean stamps after their steps (K,), s.
    """
    if problem.has_views(segment):
        white = noise_of_means(np.ones(6), 0.0, 1, 1.0)
        return Sensor(steps.places, after, by_pose, white, np.zeros((len(counts), 6)))
    whole = segment.poses_per_bin
    noise = noise_of_means(course.std, segment.package_noise.correlation, whole,
                           steps.period / segment.period)
    missing = np.maximum(whole / counts - 1.0, 0.0)
    return Sensor(steps.places, after, by_pose, noise, missing[:, None] * course.std**2 / whole)


def _part(
    segment: Segment, course: Course, numbers: Numbers, steps: Steps, sensor: Sensor,
    motion: SmallMotion, twist: Array,
) -> Part:
    """Return the numbers of a sensor, whitened; the twist (6,) is the package's first one."""
    noise = path_noise(segment, steps.period)
    to_rates = np.eye(12)  # d' is a change of the twist without that by d
    to_rates[6:, :6] = -lie_bracket(twist[None])[0]
    first = to_rates @ np.diag(START_STD**2) @ to_rates.T
    explained = response(motion, to_rates @ course.start, _change_at(course, steps.stamps_ns))
    values = numbers.values + np.array([
        sensor.by_motion(number) @ explained[place] for number, place in enumerate(steps.places)])
    found = filtered(motion, noise, sensor, first, np.concatenate(
        [values[..., None], numbers.derivatives], axis=2))
    white = found.white[..., 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        weights = np.sqrt(np.minimum(1.0, CHANCE / np.abs(white)))
    innovations, J = weights * white, weights[..., None] * found.white[..., 1:]
    start, change = smoothed(motion, noise, sensor, first, found, weights * innovations)
    std = course.std
    if segment.views is None:
        growth = np.maximum(found.variance / sensor.variance, MIN_GROWTH)
        std = np.maximum(std * np.sqrt(growth), MIN_POSE_STD)
    return Part(
        innovations, numbers.residuals, numbers.logs + found.logs,
        course._replace(rows=_path(segment, steps.stamps_ns, change), stamps_ns=steps.stamps_ns,
                        change=change, start=np.asarray(np.linalg.solve(to_rates, start))),
        std, *_blocks(J, innovations, segment.bin_ns / NS_PER_S), numbers.smear)


def _change_at(course: Course, stamps_ns: Stamps) -> Array:
    """Return the change (N, 6) of a course's path at stamps (N,)."""
    begin = course.stamps_ns[0]
    known = (course.stamps_ns - begin) / NS_PER_S
    return np.asarray(scipy.interpolate.CubicSpline(known, course.change)(
        np.clip((stamps_ns - begin) / NS_PER_S, known[0], known[-1])))


def _path(segment: Segment, stamps_ns: Stamps, change: Array) -> Array:
    """Return the rows (M, 13) of a path that is changed (N, 6) at stamps (N,)."""
    known = (stamps_ns - stamps_ns[0]) / NS_PER_S
    seconds = np.minimum((segment.rows_ns - stamps_ns[0]) / NS_PER_S, known[-1])
    curve = scipy.interpolate.CubicSpline(known, change)
    return segment.moved(np.hstack([curve(seconds), curve(seconds, 1)]))


def _accelerations(rows: Array) -> Array:
    """Return the acceleration of B and the angular one (M, 6), body axes, of rows (M, 13)."""
    rates = np.gradient(rows[:, 7:], ROW_NS / NS_PER_S, axis=0)
    rates[:, :3] += np.cross(rows[:, 10:], rows[:, 7:10])
    return rates


def _blocks(J: Array, r: Array, period: float) -> tuple[Array, Array]:
    """Return information (c, q, q) and slope (c, q) of each second of a segment."""
    length = max(round(BLOCK_DURATION / period), 1)
    blocks = [(J[first:first + length].reshape(-1, J.shape[-1]), r[first:first + length].ravel())
              for first in range(0, len(J), length)]
    return np.array([J.T @ J for J, _ in blocks]), np.array([J.T @ r for J, r in blocks])
