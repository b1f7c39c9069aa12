"""
Whitened differences between measured and simulated poses of the package.

The package is simulated along the path of the tool, from rest or a first state near it, which is
free within wide limits and eliminated. A sensor gives six numbers in each bin of time: the
differences of a tracked body's pose, or the residuals of a tag's corners, relative to their noise.

Noise n of the tool's poses moves the simulated package by G n, and the numbers of its sensor by
M G n with their mean derivative M by the pose, so that they have the spectrum
C(f) = R + M G Q G^H M^H, with spectra R of the sensor's noise and Q of the tool's, by which they
are whitened. G follows from small motions d of the package,

    d'' = A_p d + A_v d' + B_p S0 n + B_v (S0 n)',

with the response S0 of the filter of the tool's path. Its slopes follow S1, but the cubic curves
between the rows of a path have the slopes of its poses on average. With exact poses of the tool,
this is output error; with noisy ones, the sum of squares is the minimum over all paths of the tool
(total least squares).

Derivatives are differences of simulations along the likeliest path, without the frequencies at
which it is noise (instrumental variables): derivatives with the noise that also is in the numbers
would have a mean product with them, and bias the damping.

The likeliest path follows the unknowns (variable projection): with a moving cup G is only nearly
the response of the package, so that a path takes up part of what wrong unknowns do. Derivatives
include this, as otherwise they promise more information than there is.
"""

from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Places, Stamps
from bellows_ros.core.identification.result import CHANCE
from bellows_ros.core.identification.segments import (
    Course,
    in_threads,
    MIN_POSE_STD,
    moved,
    noise_spectrum,
    ROW_NS,
    Segment,
)
from bellows_ros.core.identification.unknowns import (
    delayed,
    DIFFERENCE,
    gravity_of,
    payload_of,
    Problem,
    QUANTITY_DIFFERENCE,
)
from bellows_ros.core.model import equilibrium, simulation
from bellows_ros.core.model.cup_package import model_tuple
from bellows_ros.core.model.equilibrium import linearise
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.recording.standstills import Standstill
from bellows_ros.core.sensors import body
from bellows_ros.core.sensors.corners import Seen
from bellows_ros.core.signals.resampling import MAD_TO_STD, resample
from bellows_ros.core.signals.trajectory import NS_PER_S, pose_rows, Trajectory
from bellows_ros.errors import BellowsError, UnstableError
import numpy as np


class Responses(NamedTuple):
    """
    Responses to noise of the tool's poses at F frequencies of a padded series.

    Those of the package (F, 6, 6), in body axes, and of the path and its slope (2, F).
    """

    package: Array
    path: Array


class Filters(NamedTuple):
    """
    Filters of a sensor's numbers at F frequencies of a padded series.

    Response (F, 6, 6) of the numbers to noise of the tool, filter (F, 6, 6) to white noise of
    variance 1, and filter (F, 6, 6) from white noise to the likeliest noise of the tool, m and
    rad; variances (6,) by the tool, and sum of the logarithms of all variances of a series.
    """

    response: Array
    whitening: Array
    likeliest: Array
    of_tool: Array
    logs: float

    @classmethod
    def of(
        cls, problem: Problem, segment: Segment, course: Course, of_package: Array
    ) -> 'Filters':
        """Return the filters of a segment from the response (F, 6, 6) of the package."""
        period, (padded, frequency) = segment.bin_ns / NS_PER_S, _frequencies(segment)
        response = course.by_pose @ of_package
        of_tool = noise_spectrum(segment.tool_noise, segment.tool_period, frequency) / period
        of_sensor = np.ones((len(frequency), 6))  # of white views
        if not problem.has_views(segment):
            of_sensor = noise_spectrum(segment.package_noise._replace(
                std=course.std), segment.period, frequency) / period
        by_tool = (response * of_tool[:, None]) @ _adjoint(response)
        root = np.linalg.inv(np.linalg.cholesky(by_tool + of_sensor[:, :, None] * np.eye(6)))
        logs = -4.0 * float(np.sum(np.log(np.abs(np.einsum('fii->fi', root)))))
        return cls(
            response, root, -of_tool[:, :, None] * _adjoint(response) @ _adjoint(root),
            np.mean(np.einsum('fii->fi', by_tool).real, axis=0), logs / padded)


def _frequencies(segment: Segment) -> tuple[int, Array]:
    """Return the length of a padded series, and its frequencies (F,), Hz."""
    period = segment.bin_ns / NS_PER_S
    padded = 2 * ((len(segment.bins_ns) + round(BLOCK_DURATION / period) + 1) // 2)
    return padded, np.asarray(np.fft.rfftfreq(padded, period), np.float64)


def _responses(problem: Problem, theta: Array, segment: Segment, course: Course) -> Responses:
    """Return the responses of a segment about its first rest; theta is local."""
    _, frequency = _frequencies(segment)
    model = problem.model(theta, segment)
    plain: ModelTuple = (model[0][:4], *model[1:])  # without internal strains
    tool = np.append(course.rows[0, :7], np.zeros(6))
    by = linearise(plain, simulation.row_state(tool), _first_state(plain, tool, np.zeros(12)))
    lags, iw = np.arange(segment.weights.shape[1]) - segment.weights.shape[1] // 2, (
        2j * np.pi * frequency)
    path: Any = segment.weights[:2] @ np.exp(segment.tool_period * np.outer(lags, iw))
    path[:, frequency > 0.5 / segment.tool_period] = 0.0
    mean = np.sinc(frequency * segment.bin_ns / NS_PER_S) / np.sinc(
        frequency * segment.period)  # of the poses of a bin
    iw = iw[:, None, None]
    G = np.linalg.solve(iw**2 * np.eye(6) - iw * by.body_twist - by.body_pose,
                        (mean * path[0])[:, None, None] * (by.tool_pose + iw * by.tool_twist))
    return Responses(np.asarray(G), np.asarray(path))


def _adjoint(matrices: Array) -> Array:
    """Return conjugate transposes of matrices (F, 6, 6)."""
    return np.conj(np.swapaxes(matrices, 1, 2))


def filtered(response: Array, series: Array) -> Array:
    """Return the series (N, 6, q) behind a filter of a response (F, 6, 6)."""
    count, size = len(series), 2 * (len(response) - 1)
    spectra = np.fft.rfft(series, size, axis=0)
    return np.asarray(np.fft.irfft(response @ spectra, size, axis=0)[:count])


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

PATH_PART = 0.5
"""Part by which the noise of the tool's path is renewed: errors that a step returns with a factor
between -3 and 1, as the cup is not linear, then decay."""

BLOCK_DURATION = 1.0
"""Length of the parts of a recording whose information is stored, and of the zeros behind a
series, s: some periods of a swing, which decays before the series begins again."""

MAX_WHITE_CORRELATION = 0.1
"""Largest correlation of innovations that count as white, or chance if larger."""


class Part(NamedTuple):
    """
    The whitened differences of a segment.

    Innovations (N, 6), weighted by Huber; differences (N, 6) in m and rad; sum of the logarithms
    of their variances; the likeliest noise of the tool and change of the first state; the noise
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


def simulated(
    problem: Problem, theta: Array, segment: Segment, tool: Array, start: Array, steps: int
) -> Array:
    """Return the package's states (M, 13) at the rows of the tool (M, 13); theta is local."""
    out, state = np.empty((len(tool), 13)), None
    if 'tool_marker' in problem.rows:
        marker = problem.values(theta)['tool_marker']
        tool = simulation.tool_rows(body.of_fixed_frame(
            simulation.trajectory_of(segment.rows_ns, tool), marker[3:], marker[:3]))
    for span, part in _spans(problem, segment):
        model, rows = problem.model(theta, segment, part), tool[span]
        if state is None:
            state = _first_state(model, rows[0], start)
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
    problem: Problem, theta: Array, segment: Segment, course: Course, shifts: Array
) -> tuple[Array, Array]:
    """
    Return the package's states (M, 13) at the rows, and derivatives (M, 6, q + 12) of its poses.

    The derivatives are in body axes, by the unknowns and the first state, along a smooth path:
    the response to noise of the tool would agree with the same noise in the differences. The path
    shifts with each unknown (M, 12, q).
    """
    steps = int(equilibrium.substeps_for(
        ROW_NS / NS_PER_S, model_step(problem, theta, segment)))
    size = len(theta)
    lengths = np.concatenate([
        np.full(problem.count, DIFFERENCE), np.full(size - problem.count, QUANTITY_DIFFERENCE),
        DIFFERENCE * START_STD])
    is_simulated = np.ones(size, dtype=bool)
    for name in SENSED & problem.rows.keys():
        is_simulated[problem.rows[name]] = False

    def run(tool: Array, change: Array) -> Array:
        return simulated(problem, theta + np.where(is_simulated, change[:size], 0.0), segment,
                         tool, course.start + change[size:], steps)

    unchanged, smooth_tool = np.zeros(size + 12), segment.smooth(course.rows)
    tools = [course.rows, smooth_tool] + [
        moved(smooth_tool, lengths[place] * shifts[:, :, place]) for place in range(size)
    ] + [smooth_tool] * 12
    states, smooth, *others = in_threads(
        run, tools, [unchanged, unchanged, *np.diag(lengths)])
    columns = np.zeros((len(smooth), 6, size + 12))
    inverse = np.swapaxes(lie.quaternion_to_rotation(smooth[:, 3:7]), 1, 2)
    conjugate = lie.quaternion_conjugate(smooth[:, 3:7])
    for place, (length, other) in enumerate(zip(lengths, others, strict=True)):
        columns[:, :3, place] = lie.apply(inverse, other[:, :3] - smooth[:, :3]) / length
        turn = lie.quaternion_product(conjugate, other[:, 3:7])
        columns[:, 3:, place] = 2.0 * turn[:, :3] * np.sign(turn[:, 3:]) / length
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
    responses = _responses(problem, theta, segment, course)
    course = _followed(course, theta, segment, responses)
    states, columns = simulation_of(
        problem, theta, segment, course, -_of_path(segment, responses, course.noise_by_theta))
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
    if problem.has_views(segment):
        seen = _seen(problem, theta, segment, course, chosen, package, bend)
        J = at_stamps(segment.rows_ns, columns, stamps)
        return _part(
            problem, segment, *_whitened_views(seen, J, course, starts), bins, responses)
    e, own = _differences(problem, theta, segment, chosen, package, bend)
    counts = np.diff(starts, append=len(chosen))

    def means(values: Array) -> Array:
        return (np.add.reduceat(values, starts, axis=0).T / counts).T

    J = at_stamps(segment.rows_ns, columns, stamps[0] + np.rint(
        means(stamps - stamps[0])).astype(np.int64))
    J[:, :, :len(theta)] += means(own)
    return _part(problem, segment, course, Numbers(
        means(e), J, means(e), 0.0, np.empty(0)), bins, responses)


def _of_path(segment: Segment, responses: Responses, noise: Array) -> Array:
    """Return the change (M, 12, q) of the rows of a path by noise (B, 6, q) at the bins."""
    return np.hstack([
        at_stamps(segment.bins_ns, filtered(response[:, None, None] * np.eye(6), noise),
                  segment.rows_ns) for response in responses.path])


def _followed(
    course: Course, theta: Array, segment: Segment, responses: Responses
) -> Course:
    """Return the course with the noise that follows the unknowns, to first order."""
    if len(course.theta) != len(theta):  # of a problem with other unknowns
        return course._replace(
            theta=theta, noise_by_theta=np.zeros((len(segment.bins_ns), 6, len(theta))))
    noise = course.noise + course.noise_by_theta @ (theta - course.theta)
    rows = segment.moved(-_of_path(segment, responses, noise[..., None])[..., 0])
    return course._replace(rows=rows, noise=noise, theta=theta)


class Numbers(NamedTuple):
    """
    The numbers of a sensor in K bins.

    Values (K, 6) with their derivatives (K, 6, q + 12) by the unknowns and the first state;
    residuals (K, 6), m and rad; sum of the logarithms of the variances to which the values are
    relative; smears (K,) of views, rad.
    """

    values: Array
    derivatives: Array
    residuals: Array
    logs: float
    smear: Array


def _seen(
    problem: Problem, theta: Array, segment: Segment, course: Course, chosen: Places,
    package: Trajectory, bend: Array,
) -> Seen:
    """Return chosen views of a tag about the simulated package."""
    assert segment.views is not None
    return segment.views.select(chosen).seen(
        np.hstack([simulation.tool_rows(package), bend]), course.corners, problem.values(theta),
        problem.rows, problem.units, segment.context)


def _whitened_views(
    seen: Seen, J: Array, course: Course, starts: Places
) -> tuple[Course, Numbers]:
    """
    Return the views in bins that begin at given views, relative to the noise of their corners.

    J (N, 6, q + 12) are derivatives of the package's poses. The course has the mean derivative of
    the numbers by the pose: the noise of the tool is much smaller than the package's swing, so
    that its effect on a view is nearly that on the mean view.
    """
    derivatives = seen.maps @ J
    derivatives[:, :, :seen.columns.shape[2]] += seen.columns
    positive = np.sign(np.einsum('nii->ni', seen.maps))  # as the triangular maps are then unique
    relative = positive / np.sqrt(seen.variance)[:, None]
    root = np.sqrt(np.diff(starts, append=len(relative)))

    def binned(values: Array) -> Array:
        return (np.add.reduceat(values, starts, axis=0).T / root).T

    by_pose = np.mean(binned(seen.maps * relative[:, :, None]), axis=0)
    return course._replace(by_pose=by_pose), Numbers(
        binned(seen.residuals * relative), binned(derivatives * relative[:, :, None]),
        seen.scale * binned(seen.residuals) / root[:, None],
        6.0 * float(np.sum(np.log(seen.variance))), binned(seen.smear) / root)


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


def _spread(values: Array, known: Places, count: int) -> Array:
    """Return values (count, ...), linear between those (K, ...) at known places (K,)."""
    x = np.interp(np.arange(count), known, np.arange(len(known)))
    before = x.astype(np.int64)
    part = (x - before).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - part) * values[before] + part * values[np.minimum(
        before + 1, len(known) - 1)])


def _part(
    problem: Problem, segment: Segment, course: Course, numbers: Numbers, known: Places,
    responses: Responses,
) -> Part:
    """Return the numbers of a sensor at known bins (K,), whitened in the frequency domain."""
    count, size = len(segment.bins_ns), len(course.theta)
    filters = Filters.of(problem, segment, course, responses.package)
    series = _spread(np.concatenate(
        [numbers.values[..., None], numbers.derivatives], axis=2), known, count)
    noise = np.concatenate([course.noise[..., None], -course.noise_by_theta], axis=2)
    series[..., :1 + size] -= filtered(filters.response, noise)
    white = filtered(filters.whitening, series)[known]
    found = _weighted(white[..., 0], white[..., 1:], course.start)
    explaining = np.zeros((count, 6, 1 + size))
    explaining[known] = found.weights[..., None] * np.concatenate(
        [found.explained[..., None], found.derivatives], axis=2)
    likeliest = noise + PATH_PART * (filtered(filters.likeliest, explaining) - noise)
    rows = segment.moved(-_of_path(segment, responses, likeliest[..., :1])[..., 0])
    std = course.std
    if not problem.has_views(segment):
        squares = series[known, :, 0] ** 2
        total = np.mean(np.minimum(
            squares, CHANCE**2 * MAD_TO_STD**2 * np.median(squares, axis=0)), axis=0)
        std = np.maximum(
            np.sqrt(np.maximum(total - filters.of_tool, 0.1 * total)), MIN_POSE_STD)
    return Part(
        found.innovations, numbers.residuals, numbers.logs + filters.logs * len(known),
        course._replace(rows=rows, noise=likeliest[..., 0], start=found.start,
                        noise_by_theta=-likeliest[..., 1:]),
        std, *_blocks(found.derivatives, found.explained, segment.bin_ns / NS_PER_S),
        numbers.smear)


def _accelerations(rows: Array) -> Array:
    """Return the acceleration of B and the angular one (M, 6), body axes, of rows (M, 13)."""
    rates = np.gradient(rows[:, 7:], ROW_NS / NS_PER_S, axis=0)
    rates[:, :3] += np.cross(rows[:, 10:], rows[:, 7:10])
    return rates


class Weighted(NamedTuple):
    """
    Innovations (N, 6) weighted by Huber, without the effect of the first state.

    Further fields are the derivatives (N, 6, q), the innovations (N, 6) that they explain, the
    likeliest change (12,) of the first state, and the weights (N, 6).
    """

    innovations: Array
    derivatives: Array
    explained: Array
    start: Array
    weights: Array


def _weighted(white: Array, J: Array, start: Array) -> Weighted:
    """Return weighted innovations; J (N, 6, q + 12) includes derivatives by the first state."""
    with np.errstate(divide='ignore', invalid='ignore'):
        weights = np.sqrt(np.minimum(1.0, CHANCE / np.abs(white)))
    white, J = white * weights, J * weights[..., None]
    size = J.shape[2] - 12
    first, rest = J[..., size:].reshape(-1, 12), J[..., :size].reshape(-1, size)
    prior = START_STD**-2
    inverse = np.linalg.inv(first.T @ first + np.diag(prior))
    change = inverse @ (first.T @ white.ravel() - prior * start)
    carried = inverse @ (first.T @ rest)
    return Weighted(
        white, (rest - first @ carried).reshape(*white.shape, size),
        white - (first @ change).reshape(white.shape), start + change, weights)


def _blocks(J: Array, r: Array, period: float) -> tuple[Array, Array]:
    """Return information (c, q, q) and slope (c, q) of each second of a segment."""
    length = max(round(BLOCK_DURATION / period), 1)
    blocks = [(J[first:first + length].reshape(-1, J.shape[-1]), r[first:first + length].ravel())
              for first in range(0, len(J), length)]
    return np.array([J.T @ J for J, _ in blocks]), np.array([J.T @ r for J, r in blocks])


def at_rest(problem: Problem, theta: Array) -> tuple[Array, Array, float]:
    """
    Return derivatives (n, q) and residuals (n,) of the standstills, in standard errors.

    A chi^2 above its expectation reduces the weight of the standstills; it is the third result.
    Unknowns are of the first recording.
    """
    middle = np.append(np.mean([
        still.package.position[0] for still in problem.standstills], axis=0), 0.0)

    def balances(theta: Array) -> Array:
        return np.concatenate([_off_balance(problem, theta, still, middle) / np.maximum(
            np.repeat(still.error, 3), MIN_POSE_STD) for still in problem.standstills])

    here = balances(theta)
    J = np.column_stack([(here - balances(theta + step)) / DIFFERENCE
                         for step in DIFFERENCE * np.eye(len(theta))])
    chi2 = float(np.mean(here**2))
    weight = max(chi2, 1.0) ** -0.5
    return weight * J, weight * here, chi2


def _off_balance(problem: Problem, theta: Array, still: Standstill, middle: Array) -> Array:
    """Return the deviation (6,) of a standstill from the equilibrium of the model, m and rad."""
    free = problem.values(theta)
    cup = replace(problem.gripper(theta, free), relaxation=(0.0, 0.0))
    model = model_tuple(cup, payload_of(still.payload, free),
                        gravity_of(still.gravity, free))
    tool, measured = (simulation.row_state(np.append(pose_rows(poses)[0], np.zeros(6)))
                      for poses in (still.tool, body.poses_of(
                          still.package, free, np.array(still.moves_with_com, float), middle)))
    rest = equilibrium.static_equilibrium(model, tool, measured)
    return np.concatenate(equilibrium.pose_error(rest, *measured[:2]))
