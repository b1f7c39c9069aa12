"""
Faults of a recording detected in its poses and stamps without a fit.

Each test takes milliseconds. Tool and package on a cup move nearly as one rigid body; each fault
of one of the two poses breaks this relation in a specific manner.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import permutations, product
from types import MappingProxyType
from typing import NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array, Mask
from bellows_ros.core.recording import alignment, conventions
from bellows_ros.core.recording.outliers import repeats_in_motion
from bellows_ros.core.signals import resampling
from bellows_ros.core.signals.resampling import common_span, MAD_TO_STD, resample
from bellows_ros.core.signals.trajectory import NS_PER_S, PoseStream, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np

SAMPLES = 300
"""Number of compared pairs of poses."""

MAX_REPEAT_PART = 0.05
"""Largest fraction of poses that repeat the previous pose in motion, as single lost messages
do."""

MIN_FROZEN_PART, MIN_SHIFT = 0.95, 5e-3
"""Smallest fraction of steps with a new position and an unchanged rotation, and smallest motion
(m), of a frozen rotation."""

FIXED = np.repeat([1e-4, 5e-4], 3)
"""Smallest deflection of an identifiable cup, standard deviations in m and rad."""

AT_REST = np.repeat([5e-4, 5e-3], 3)
"""Largest motion of a body at rest, standard deviations in m and rad."""

MOVING = np.repeat([0.02, 0.1], 3)
"""Smallest motion of a tool that shakes its package, standard deviations in m and rad."""

MIN_TILT_RATIO = 0.02
"""
Smallest ratio of the rotation of a package on a cup to the tilt of its tool, by its weight.

The ratio is m g d / K: 0.03 for 0.5 kg, 25 mm below a cup of 4 N m/rad, and 0.2 for 1.8 kg, 45 mm
below.
"""

SWAPPED_SECONDS, UPRIGHT = 0.02, 0.5
"""Shortest exchange of two bodies (s), and the smallest cosine between the tool's z axis and the
direction of the package that is surely above, or below."""

NOISE_DEVIATIONS = 2.0
"""Smallest ratio of the standard deviations of motion and noise of a moving body."""

DIFFERENCES, DIFFERENCES_NORM = 4, np.sqrt(70.0)
"""Order of the differences of poses that suppress motion, and the norm of their coefficients."""

MAX_STEP_ERROR = 0.2
"""Largest relative deviation of uniform steps."""

MIN_SAMPLES, MAX_SAMPLES = 20, 3000
"""Smallest and largest number of differences for an estimate of noise: 3000 give it to 2 %."""

MAX_MISFIT_RATIO, MAX_MISFIT = 0.4, 0.6
"""Largest ratio of relative motion after and before the correction of a convention, and largest
remaining relative motion (rad, and relative to the distance), of bodies on one cup."""

SIMPLER, OPPOSITE, DISSIMILAR = 0.9, -0.6, 0.5
"""Ratio of misfits below which a later candidate replaces an earlier one; largest correlation of
two rotations of which one is inverse; and ratio of misfits between two kinds of candidates."""

AXIS_ROTATIONS = [
    axes for order in permutations(np.eye(3)) for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(axes := np.multiply(order, np.array(signs)[:, None])) > 0.0][1:]
"""Rotations (3, 3) that permute axes."""

MIN_RIGID_SIMILARITY = 0.8
"""Smallest similarity of the rotations of two bodies on one cup."""

MIN_SIMILARITY, MAX_DIFFERENCE_RATIO = 0.95, 0.25
"""Smallest similarity of rotations in two worlds with a corrected convention, and largest ratio of
dissimilarities after and before."""

MIN_FRAME_ANGLE = np.deg2rad(30.0)
"""Smallest rotation between two frames that a misplaced camera or marker cannot explain, rad."""

MAX_RESIDUAL_RATIO, MAX_RESIDUAL = 0.3, 0.02
"""Largest ratio of the residuals of rigid motion with other axes, and largest such residual
(m)."""

MIN_SPREAD_RATIO = 0.05
"""Smallest ratio of the third to the first extent of a path that determines its handedness."""

MAX_UP = -0.5
"""Largest vertical component of the tool's z axis (median) that points out of the arm."""


Bodies = tuple[Trajectory, Trajectory]


class Fact(NamedTuple):
    """
    A fault detected without a fit.

    Parameters
    ----------
    code : str
        Its name in the texts of the room 'facts'.
    body : str
        Faulty body: 'tool', 'package', 'both', or '' if unknown.
    numbers : mapping of str to float
        Sizes in SI units.

    """

    code: str
    body: str = ''
    numbers: Mapping[str, float] = MappingProxyType({})


BLOCKING = frozenset((
    'clock_step', 'swapped', 'frozen_orientation', 'package_on_tool', 'package_at_rest',
    'one_body', 'millimetres', 'quaternion_order', 'conjugated', 'inverse_rotation', 'inverted',
    'rotation_frame', 'left_handed', 'exchanged'))
"""Faults that prevent a fit and a replay."""


def facts_of(
    tool: PoseStream, package: PoseStream, R_world_recorded: Array | None = None
) -> tuple[Fact, ...]:
    """
    Return the faults of the poses of a tool and its package, the most fundamental ones first.

    Parameters
    ----------
    tool, package : PoseStream
        Recorded poses, in one frame or in two.
    R_world_recorded : ndarray (3, 3), optional
        Rotation from the tool's recorded axes to a world with z up; default: z is up.

    """
    found = [*_of_streams(tool, package)]
    first, last = common_span(tool, package)
    stamps = np.unique(np.linspace(0, max(last - first, 0), SAMPLES).astype(np.int64)) + first
    if last <= first:
        return (*found, *_of_gravity(tool.rotation, np.eye(3) if R_world_recorded is None
                                     else R_world_recorded))
    one_frame = len({tool.frame_id, package.frame_id} - {''}) < 2
    bodies = resample(tool.trajectory(), stamps), resample(package.trajectory(), stamps)
    motion = (*_swapped(tool, package, one_frame), *_of_motion(
        tool, package, bodies, one_frame))
    if motion or any(fact.code == 'frozen_orientation' for fact in found):
        return (*found, *motion)
    for test in (_of_frames, _of_conventions):
        if wrong := tuple(test(tool, package, bodies, one_frame)):
            return (*found, *wrong)
    R = np.eye(3) if R_world_recorded is None else R_world_recorded
    return (*found, *_of_arrangement(bodies, one_frame, R))


def _of_streams(tool: PoseStream, package: PoseStream) -> Iterator[Fact]:
    """Yield the faults of each topic alone."""
    for body, stream in (('tool', tool), ('package', package)):
        begin, end = (int(stream.stamps_ns[i]) for i in (0, -1))
        for at_ns, size in stream.clock_steps:
            if begin < at_ns < end:
                yield Fact('clock_step', body, {
                    'at': (at_ns - min(begin, int(other_of(body, tool, package).stamps_ns[0])))
                    / NS_PER_S, 'size': size})
        if (repeats := repeats_in_motion(stream)) > MAX_REPEAT_PART * len(stream):
            yield Fact('repeated_poses', body, {'count': repeats, 'poses': len(stream)})
        tick = resampling.resolution(stream.stamps_ns)
        repeated = len(stream.refused.get('duplicate_stamp', ()))
        if tick or repeated > MAX_REPEAT_PART * (len(stream) + repeated):
            yield Fact('quantised_stamps', body, {
                'tick': tick or float(np.median(np.diff(stream.stamps_ns))) / NS_PER_S,
                'repeated': repeated, 'poses': len(stream) + repeated})
        other = other_of(body, tool, package)
        if (part := _frozen_part(stream)) > MIN_FROZEN_PART and (
                body == 'package' or _deviation(other.trajectory())[3:].max() > MOVING[3]):
            yield Fact('frozen_orientation', body, {'part': part})


def other_of(body: str, tool: PoseStream, package: PoseStream) -> PoseStream:
    """Return the poses of the other body."""
    return package if body == 'tool' else tool


MIN_NEAR_PART = 0.9
"""Smallest fraction of poses with the usual distance of two bodies of one clock: with 5 s between
the clocks of bags/identification the fraction is below a half."""


def _swapped(tool: PoseStream, package: PoseStream, one_frame: bool) -> Iterator[Fact]:
    """Yield the time in which two bodies that hang one below the other are exchanged."""
    hand, eye = tool.trajectory(), package.trajectory()
    first, last = common_span(hand, eye)
    eye = eye.select((eye.stamps_ns >= first) & (eye.stamps_ns <= last))
    hand = resample(hand, eye.stamps_ns)
    offset = eye.position - hand.position
    distance = np.linalg.norm(offset, axis=1)
    usual = float(np.median(distance))
    above = np.einsum('ni,ni->n', offset, hand.rotation[:, :, 2]) / np.maximum(distance, 1e-9)
    if not one_frame or not 1e-3 < usual < conventions.REACH[1] or np.median(above) > -UPRIGHT:
        return
    near = np.abs(distance - usual) < conventions.MAX_CHANGE * usual
    if np.mean(near) < MIN_NEAR_PART:
        return
    exchanged = (above > UPRIGHT) & near
    edges = np.flatnonzero(np.diff(exchanged, prepend=False, append=False)).reshape(-1, 2)
    for begin, end in edges.tolist():
        span = eye.stamps_ns[[begin, end - 1]] - min(tool.stamps_ns[0], package.stamps_ns[0])
        if np.ptp(span) >= SWAPPED_SECONDS * NS_PER_S:
            yield Fact('swapped', 'both', dict(zip(
                ('begin', 'end'), (span / NS_PER_S).tolist(), strict=True)))
            return


def _frozen_part(stream: PoseStream) -> float:
    """Return the fraction of steps of a moving body with exactly unchanged rotation."""
    moves = np.any(stream.position[1:] != stream.position[:-1], axis=1)
    if not moves.any() or np.ptp(stream.position, axis=0).max() < MIN_SHIFT:
        return 0.0
    same = np.all(stream.rotation[1:] == stream.rotation[:-1], axis=(1, 2))
    return float(np.mean(same[moves]))


def _deviation(body: Trajectory) -> Array:
    """Return the robust standard deviation (6,) of a body's pose, m and rad."""
    middle = body.rotation[len(body) // 2].T
    moved = np.hstack([body.position, lie.log_so3(middle @ body.rotation)])
    return np.asarray(0.5 * np.subtract(*np.percentile(moved, (84, 16), axis=0)))


def _of_motion(
    tool: PoseStream, package: PoseStream, bodies: Bodies, one_frame: bool
) -> tuple[Fact, ...]:
    """Return whether the package is fixed to its tool, or rests under a moving tool."""
    tool_motion, package_motion = map(_deviation, bodies)
    moves = bool(np.any(tool_motion >= MOVING))
    tilt = float(np.linalg.norm(np.std(bodies[0].rotation[:, 2, :2], axis=0)))
    noise = NOISE_DEVIATIONS * noise_of(package.trajectory())
    if moves and np.all(package_motion < np.fmax(AT_REST, noise)):
        return (Fact('package_at_rest', 'package', {
            'position': float(package_motion[:3].max()),
            'rotation': float(package_motion[3:].max())}),)
    hand, eye = tool.trajectory(), package.trajectory()
    if not one_frame:
        try:
            R = alignment.rotation_of(*(body.rotation for body in bodies))
        except BellowsError:  # the tool hardly rotates
            return ()
        eye = replace(eye, position=lie.apply(R, eye.position) + _rigid_motion(*bodies, R)[0][3:],
                      rotation=R @ eye.rotation)
    relative = _seen_from(hand, eye)
    if len(relative) < SAMPLES // 2:
        return ()
    noise, deviation = noise_of(relative), _deviation(relative)
    is_seen = moves or float(noise[3:].max()) < MIN_TILT_RATIO * tilt
    distance = float(np.median(np.linalg.norm(relative.position, axis=1)))
    if is_seen and distance < conventions.MAX_DISTANCE and np.all(
            deviation < np.fmax(FIXED, NOISE_DEVIATIONS * noise)) and np.all(
            noise < MOVING / 10.0):
        return (Fact('one_body' if distance < 1e-3 else 'package_on_tool', 'package', {
            'distance': distance, 'position': float(deviation[:3].max()),
            'rotation': float(deviation[3:].max())}),)
    return ()


def _seen_from(tool: Trajectory, package: Trajectory) -> Trajectory:
    """Return the package in the axes of the tool, in groups of five successive poses."""
    first, last = common_span(tool, package)
    inside = np.flatnonzero((package.stamps_ns >= first) & (package.stamps_ns <= last))
    starts = inside[:-4][::max(len(inside) // (2 * SAMPLES), 1)]
    package = package.select(np.unique((starts[:, None] + np.arange(5)).ravel()))
    tool = resample(tool, package.stamps_ns)
    back = np.swapaxes(tool.rotation, 1, 2)
    return Trajectory(package.stamps_ns, lie.apply(back, package.position - tool.position),
                      back @ package.rotation)


def noise_of(body: Trajectory, chosen: Mask | None = None) -> Array:
    """
    Return the standard deviation (6,) of the noise of selected poses, m and rad, nan for too few.

    Differences of fourth order of five poses at uniform steps suppress the motion.
    """
    n, steps = DIFFERENCES, np.diff(body.stamps_ns)
    if len(body) <= n:
        return np.full(6, np.nan)
    uniform = np.abs(steps / np.median(steps) - 1.0) < MAX_STEP_ERROR
    groups = np.lib.stride_tricks.sliding_window_view(uniform, n).all(axis=1)
    at = np.flatnonzero(groups if chosen is None else groups & chosen[n // 2:len(body) - n // 2])
    if len(at) < MIN_SAMPLES:
        return np.full(6, np.nan)
    at = at[::len(at) // MAX_SAMPLES + 1]
    middle = np.swapaxes(body.rotation[at + n // 2], 1, 2)
    change = sum(weight * np.hstack([
        body.position[at + k], lie.log_so3(middle @ body.rotation[at + k])])
        for k, weight in enumerate((1.0, -4.0, 6.0, -4.0, 1.0)))
    return np.asarray(MAD_TO_STD * np.median(np.abs(change), axis=0) / DIFFERENCES_NORM)


def _conjugated(body: Trajectory) -> Trajectory:
    """Return poses with inverse rotations."""
    return replace(body, rotation=np.swapaxes(body.rotation, 1, 2))


def _inverted(body: Trajectory) -> Trajectory:
    """Return the inverse poses."""
    back = np.swapaxes(body.rotation, 1, 2)
    return replace(body, position=-lie.apply(back, body.position), rotation=back)


def _of_conventions(
    tool: PoseStream, package: PoseStream, bodies: Bodies, one_frame: bool
) -> Iterator[Fact]:
    """Yield wrong units, quaternion orders and inverse poses that explain non-rigid motion."""
    orders = conventions.conventions_of(tool, package)
    names = ('tool', 'package')
    yield from (Fact('millimetres', body) for body, order in zip(names, orders, strict=True)
                if order.millimetres)
    is_w_first = [order.w_first for order in orders]
    if one_frame:
        fact, misfit = _of_one_frame(bodies)
        if any(is_w_first):
            read = (conventions.converted(*each) for each in zip(bodies, orders, strict=True))
            if not misfit < DISSIMILAR * _misfit(*read):
                fact = None
        if fact:
            yield fact
        else:
            yield from (Fact('quaternion_order', body) for body, wrong in zip(
                names, is_w_first, strict=True) if wrong)
        return
    plain, inverse = _similarities(bodies)
    if any(is_w_first) or inverse > MIN_SIMILARITY and (
            1.0 - inverse < MAX_DIFFERENCE_RATIO * (1.0 - plain)):
        yield Fact('inverse_rotation', _worse_body(bodies))


def _of_one_frame(bodies: Bodies) -> tuple[Fact | None, float]:
    """Return the fault of poses in one frame with the best correction, and its misfit."""
    tool, package = bodies
    tried = list[tuple[Fact, Trajectory, Trajectory]]()
    for code, change in (('conjugated', _conjugated), ('inverted', _inverted)):
        one, other = change(tool), change(package)
        tried += [(Fact(code, 'package'), tool, other), (Fact(code, 'tool'), one, package),
                  (Fact(code, 'both'), one, other)]
    is_inverse = _correlation(bodies) < OPPOSITE
    if is_inverse:
        tried = [each for each in tried if each[0].body != 'both']
    else:
        for axes in AXIS_ROTATIONS:
            angle = float(np.linalg.norm(lie.log_so3(axes)))
            one, other = (replace(body, rotation=axes @ body.rotation) for body in bodies)
            tried.append((Fact('rotation_frame', 'both', {'angle': angle}), one, other))
        for signs in 1.0 - 2.0 * np.eye(3):
            one, other = (replace(body, position=body.position * signs) for body in bodies)
            tried.append((Fact('left_handed', 'both'), one, other))
    before, least = _misfit(*bodies), float('inf')
    fact: Fact | None = None
    for candidate, one, other in tried:
        if (misfit := _misfit(one, other)) < SIMPLER * least:
            fact, least = candidate, misfit
    limit = before if is_inverse else min(MAX_MISFIT_RATIO * before, MAX_MISFIT)
    return (fact, least) if least < limit else (None, float('inf'))


def _correlation(bodies: Bodies) -> float:
    """Return the correlation of the rotations of two bodies about axes of one world."""
    a, b = (lie.log_so3(body.rotation @ body.rotation[len(body) // 2].T) for body in bodies)
    return float(np.sum(a * b)) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)


def _similarities(bodies: Bodies) -> tuple[float, float]:
    """Return the similarity of two rotations in two worlds, as recorded and with one inverted."""
    a, b = (lie.log_so3(body.rotation[len(body) // 2].T @ body.rotation) for body in bodies)
    R = bodies[1].rotation
    inverse = lie.log_so3(R[len(R) // 2] @ np.swapaxes(R, 1, 2))
    return conventions.similarity(a, b), conventions.similarity(a, inverse)


def _worse_body(bodies: Bodies) -> str:
    """Return the body whose inverse rotations make the motion rigid, '' if undecided."""
    tool, package = bodies
    residuals = []
    for each in ((_conjugated(tool), package), (tool, _conjugated(package))):
        R = alignment.rotation_of(*(body.rotation for body in each))
        residuals.append(_best_axes(*each, R, 1.0)[0])
    of_tool, of_package = residuals
    return 'tool' if of_tool < 0.5 * of_package else (
        'package' if of_package < 0.5 * of_tool else '')


def _misfit(tool: Trajectory, package: Trajectory) -> float:
    """Return the relative motion of a package in its tool (distance, rad); infinite if far."""
    bodies, plain = (tool, package), (conventions.Convention(), conventions.Convention())
    distance, change = conventions.distance_of(bodies, plain)
    if not (1e-3 < distance < conventions.REACH[1] and change < conventions.MAX_CHANGE):
        return float('inf')
    offset = lie.apply(np.swapaxes(tool.rotation, 1, 2), package.position - tool.position)
    hangs = np.median(offset[:, 2]) < 0.0
    return (1.0 if hangs else 1.0 / SIMPLER**2) * conventions.motion_in_tool(bodies, plain)[0]


def _rigid_motion(tool: Trajectory, package: Trajectory, X: Array) -> tuple[Array, float]:
    """Return c and t (6,) with o + R c nearest to X p + t, and the RMS residual, m."""
    A = np.concatenate(
        [tool.rotation, -np.tile(np.eye(3), (len(tool), 1, 1))], axis=2).reshape(-1, 6)
    b = (lie.apply(X, package.position) - tool.position).ravel()
    constants = np.linalg.lstsq(A, b, rcond=1e-6)[0]
    return constants, float(np.sqrt(3.0 * np.mean((b - A @ constants)**2)))


def _of_frames(
    tool: PoseStream, package: PoseStream, bodies: Bodies, one_frame: bool
) -> Iterator[Fact]:
    """Yield positions in a left-handed frame, or in another frame than the rotations."""
    try:
        A = alignment.rotation_of(*(body.rotation for body in bodies))
    except BellowsError:  # the tool hardly rotates
        return
    plain, inverse = _similarities(bodies)
    if plain < MIN_RIGID_SIMILARITY or 1.0 - plain > DISSIMILAR * (1.0 - inverse):
        return
    extents = np.linalg.svd(bodies[1].position - bodies[1].position.mean(axis=0))[1]
    if not extents[0] > MIN_SHIFT or extents[2] < MIN_SPREAD_RATIO * extents[0]:
        return
    before = _rigid_motion(*bodies, A)[1]
    (proper, turned), (mirrored, _) = (
        _best_axes(*bodies, A, handed) for handed in (1.0, -1.0))
    if mirrored < min(MAX_RESIDUAL_RATIO * min(before, proper), MAX_RESIDUAL):
        yield Fact('left_handed')
    elif proper < min(MAX_RESIDUAL_RATIO * before, MAX_RESIDUAL):
        angle = float(np.linalg.norm(lie.log_so3(turned @ A.T)))
        of_rotations, of_positions = (_rotation_residual(bodies, X) for X in (A, turned))
        if angle > MIN_FRAME_ANGLE and of_rotations < MAX_RESIDUAL_RATIO * of_positions:
            yield Fact('rotation_frame', _wrongly_turned(*bodies, A) if one_frame else '',
                       {'angle': angle})


def _rotation_residual(bodies: Bodies, X: Array) -> float:
    """Return the RMS difference (rad) of both rotations if X maps the package's axes."""
    a, b = (lie.log_so3(body.rotation @ body.rotation[len(body) // 2].T) for body in bodies)
    return float(np.sqrt(np.mean(np.sum((a - lie.apply(X, b))**2, axis=1))))


def _best_axes(
    tool: Trajectory, package: Trajectory, A: Array, handed: float
) -> tuple[float, Array]:
    """Return the least residual (m) of rigid motion, and the orthogonal X of a handedness."""
    p = package.position - package.position.mean(axis=0)
    c, X = np.zeros(3), A
    for _ in range(8):
        o = tool.position + lie.apply(tool.rotation, c)
        U, _, V = np.linalg.svd((o - o.mean(axis=0)).T @ p)
        X = U @ np.diag([1.0, 1.0, handed * np.sign(np.linalg.det(U @ V))]) @ V
        rest, turns = lie.apply(X, p) - tool.position, tool.rotation - tool.rotation.mean(axis=0)
        c = np.linalg.lstsq(turns.reshape(-1, 3), (rest - rest.mean(axis=0)).ravel(),
                            rcond=1e-6)[0]
    return _rigid_motion(tool, package, X)[1], X


def _wrongly_turned(tool: Trajectory, package: Trajectory, A: Array) -> str:
    """Return the body whose rotations are in another frame, by the better correction."""
    other = _misfit(replace(tool, rotation=A.T @ tool.rotation), package)
    return 'tool' if other < _misfit(tool, replace(package, rotation=A @ package.rotation)) else (
        'package')


def _of_arrangement(bodies: Bodies, one_frame: bool, R: Array) -> Iterator[Fact]:
    """Yield exchanged topics, or a z axis of the tool that points out of the arm."""
    tool, package = bodies
    offset = package.position - tool.position
    if one_frame and np.median(np.linalg.norm(offset, axis=1)) < conventions.REACH[1]:
        back = np.swapaxes(tool.rotation, 1, 2)
        in_tool = float(np.median(lie.apply(back, offset)[:, 2]))
        upward = float(np.median(offset @ R[2]))
        if in_tool > 0.0 and upward > 0.0:
            yield Fact('exchanged', 'both', {'in_tool': in_tool, 'upward': upward})
            return
    yield from _of_gravity(tool.rotation, R)


def _of_gravity(rotation: Array, R: Array) -> Iterator[Fact]:
    """Yield a z axis of the tool that points down, out of the arm."""
    up, angle = tool_up(rotation, R)
    if up < MAX_UP:
        yield Fact('tool_z', 'tool', {'angle': angle})


def tool_up(rotation: Array, R: Array) -> tuple[float, float]:
    """Return the vertical component of the tool's z axis (median), and its angle, rad."""
    up = float(np.median(rotation[:, :, 2] @ R[2]))
    return up, float(np.arccos(np.clip(up, -1.0, 1.0)))
