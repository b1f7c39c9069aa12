"""
Tool motions that leave the package without swing: inverse dynamics, and input shaping.

The cup transmits all six axes, so the package's pose is a flat output: the motion of the package
determines the wrench of the cup, and this wrench, linear in the relative twist, determines the
motion of the tool. Input shaping (Singer and Seering) sums delayed copies of a motion, whose
swings cancel.
"""

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import Any, NamedTuple

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import as_inputs, entry, kernel
from bellows_ros.core.geometry.tuples import Vector
from bellows_ros.core.model import kernels, simulation
from bellows_ros.core.model.equilibrium import resting_on_tool, symmetric_matrix, system_matrix
from bellows_ros.core.model.jacobians import damper_jacobians
from bellows_ros.core.model.kernels import ModelTuple, State, Wrench
from bellows_ros.core.model.validity_range import PEAK_MOMENT_BENDING
from bellows_ros.core.planning import plan_prediction as planning
from bellows_ros.core.planning.limits import TooFastError
from bellows_ros.core.planning.points import body_twists, curve_of
from bellows_ros.core.signals.trajectory import at_tip, NS_PER_S, Trajectory
from bellows_ros.errors import BellowsError
import numpy as np
import scipy  # whose parts are loaded as they are used

METHODS = ('inverse', 'zv', 'zvd')

GRID = 0.001
"""Spacing of the resulting motion, s."""

SPACING = 0.005
"""Spacing of evaluations of the fourth derivative, s."""

SNAP_TOLERANCE = 100.0
"""Largest change of a continuous fourth derivative between evaluations, m/s^4."""

RELATIVE_SNAP_TOLERANCE = 0.1
"""Largest change of a continuous fourth derivative relative to its size."""
SUBDIVISION = 5
"""Ratio of the spacings of a motion and of its points for smoothing."""

RATE_PER_STEP = 0.4
"""Relaxation rate of the cup times step; RK4 is then accurate to 1e-4."""
MAX_GRID_STEPS = 300_000
"""Largest number of steps of the inverse, all of which are stored."""
MAX_RATE = 1e5
"""Largest relaxation rate of an invertible cup, 1/s."""
ARRIVAL_TOLERANCE = (2e-5, 1e-4)
"""Largest remaining distance and rotation of a tool that has arrived, m and rad."""
MAX_ARRIVAL = 12.0
"""Longest wait for the arrival, in the cup's longest relaxation times."""
FADE_TIME = 0.02
"""Duration in which a motion fades after its end, without a step of twist or acceleration, s."""

MIN_RESIDUAL_SWING = planning.SETTLED_ANGLE
"""Swing of the package above which a mode is shaped, rad."""
ALLOWED_TIME = 1.0
"""Longest duration of a shaper, s, or the plan's duration if longer."""
TAIL = 2.0
"""Duration after a shaped motion in which its residual swing is evaluated, s."""


class SwingMode(NamedTuple):
    """A mode of the hanging package."""

    frequency: float
    """Undamped frequency, Hz."""
    damping_ratio: float
    """Damping ratio."""
    swing: float
    """Rotation of the package by this mode after a plan, rad."""


# -------------------------------------------------------------------------------------- inverse


@kernel
def needed_wrench(model: ModelTuple, body: State, dv: Vector, dw: Vector) -> Wrench:
    """Return the wrench at the lip, in S axes, required for given rates of the package (3.5)."""
    mass, com, inertia, _ = model[1]
    _, q, v, w = body[:4]
    free_dv, free_dw = kernels.newton_euler(
        model[1], model[2], t3.rotation_matrix(q), v, w, t3.ZERO, t3.ZERO)
    f = t3.scale(mass, t3.subtract(dv, free_dv))
    return f, t3.add(t3.apply(inertia, t3.subtract(dw, free_dw)), t3.cross(com, f))


@kernel
def inverse_dynamics(model: ModelTuple, tool: State, body: State, dv: Vector, dw: Vector) -> State:
    """
    Return the tool with the twist at which the cup causes given rates of the package.

    D1(H) v1 = f_spring(H) - f_required at S1 (3.27, 3.33) is solved for the relative twist. The
    tool also has the internal strains of a cup that relaxes.
    """
    cup, package, _ = model
    l1 = cup[0]
    f, m = needed_wrench(model, body, dv, dw)
    o_E_S, R, v_S, w_S = kernels.lip_relative_to_tool(
        package[1], kernels.with_twist(tool, t3.ZERO, t3.ZERO), body)
    o = kernels.spring_frames(cup, o_E_S, R)
    spring_f, spring_m = kernels.spring_wrench(o, R, cup[2], cup[4:], tool[4:])
    a = t3.subtract(spring_f, f)
    b = t3.subtract(spring_m, (m[0] + l1 * f[1], m[1] - l1 * f[0], m[2]))  # X(S_H_S1)^T
    D = damper_jacobians(o, R, t3.ZERO, t3.ZERO, cup[3])[1]  # -D1, by blocks
    D_oo_inverse = t3.inverse(D[0])
    cross_part = t3.multiply(D[2], D_oo_inverse)
    w = t3.apply(
        t3.inverse(t3.add_scaled_matrix(D[3], -1.0, t3.multiply(cross_part, D[1]))),
        t3.subtract(t3.apply(cross_part, a), b))
    v = t3.apply(D_oo_inverse, t3.subtract(t3.scale(-1.0, a), t3.apply(D[1], w)))
    v_ES = (v[0] - l1 * w[1], v[1] + l1 * w[0], v[2])
    w_E = t3.apply(R, t3.subtract(w_S, w))
    v_E = t3.subtract(t3.apply(R, t3.subtract(v_S, v_ES)), t3.cross(w_E, o_E_S))
    return kernels.with_twist(tool, v_E, w_E)


@entry
def _invert_kernel(
    model: ModelTuple, tool: State, reference: Any, h: float, speed: float, rate: float,
    out: Array, package: Array,
) -> int:
    """
    Write the states of tool and package along a motion; return the number of states.

    The reference of the package (N, 19) has a spacing of half a step h (s), and rests at its end.
    Once the tool is slower than a speed (m/s) and a rate (rad/s), the tool stops within
    `FADE_TIME`.
    """
    still, faded, fading = t3.ZERO, 0, math.ceil(FADE_TIME / h)
    for k in range(len(out)):
        do, ds, sum_o, sum_s, stage = still, still, still, still, tool
        dz = sum_z = kernels.moved_strains(tool[4:], -1.0, tool[4:])
        for i in range(4):  # of a step of RKMK4
            row = reference[min(2 * k + (i + 1) // 2, len(reference) - 1)]
            body, at = simulation.row_state(row), 0.5 * ((i + 1) // 2) * h
            stage = inverse_dynamics(
                model, kernels.stage_state(tool, at, do, ds, still, still, dz), body,
                (row[13], row[14], row[15]), (row[16], row[17], row[18]))
            if i == 0 and faded == 0 and 2 * k >= len(reference) - 1 and (
                    t3.dot(stage[2], stage[2]) < speed * speed and (
                        t3.dot(stage[3], stage[3]) < rate * rate)):
                faded = k
            if faded > 0:
                s = min(1.0, (k - faded + 0.5 * ((i + 1) // 2)) / fading)
                part = (1.0 - s) ** 3 * (1.0 + s * (3.0 + 6.0 * s))
                v, w = t3.scale(part, stage[2]), t3.scale(part, stage[3])
                stage = kernels.with_twist(stage, v, w)
            if i == 0:
                simulation.write_row(out[k], stage)
                simulation.write_row(package[k], body)
                if faded > 0 and k >= faded + fading:
                    return k + 1
            do, ds = t3.apply(t3.rotation_matrix(stage[1]), stage[2]), kernels.rotation_rate(
                t3.scale(at, ds), stage[3])
            dz = kernels.strain_rates(model, stage, kernels.with_strains(body, stage[4:]))
            weight = 1.0 if i % 3 == 0 else 2.0
            sum_o, sum_s = t3.add_scaled(sum_o, weight, do), t3.add_scaled(sum_s, weight, ds)
            sum_z = kernels.moved_strains(sum_z, weight, dz)
        tool = kernels.stage_state(tool, h / 6.0, sum_o, sum_s, still, still, sum_z)
        tool = kernels.with_rotation(tool, t3.normalised(tool[1]))
    return len(out)


def relaxation_rates(model: ModelTuple) -> Array:
    """
    Return the relaxation rates (1/s) of the cup under a wrench: the eigenvalues of P^-1 K.

    With internal strains the rates are eigenvalues of P dh/dt = -K (h + sum_b r_b (h - z_b)),
    dz_b/dt = (h - z_b) / tau_b.

    Raises
    ------
    BellowsError
        If the damper is too weak for the inverse.

    """
    K, P = map(symmetric_matrix, model[0][2:4])
    with np.errstate(all='ignore'):
        sound = np.linalg.eigvalsh(P).min() > 0.0
        A = np.linalg.solve(P, K) if sound else np.zeros((6, 6))
        if sound and model[0][4:]:
            (r, tau), (s, theta) = model[0][4:]
            eye, none = np.eye(6), np.zeros((6, 6))
            A = np.block([[(1.0 + r + s) * A, -r * A, -s * A], [-eye / tau, eye / tau, none],
                          [-eye / theta, none, eye / theta]])
        rates = np.sort(np.linalg.eigvals(A).real)
    if not 0.0 < rates[0] <= rates[-1] < MAX_RATE:
        raise BellowsError(
            'The cup cannot be inverted: its damping is too small for its stiffness, or not '
            f'positive definite; the rates of P^-1 K are {rates[0]:.3g} to {rates[-1]:.3g} 1/s, '
            f'expected above 0 and below {MAX_RATE:g}. Use the method zvd.')
    return rates


def inverse(
    model: ModelTuple, reference: Trajectory, start: State | None = None
) -> tuple[Trajectory, Trajectory, float]:
    """
    Return the motion of the tool under which the package moves as given.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    reference : Trajectory
        Poses and body twists of B, from rest to rest.
    start : State, optional
        Tool from which B hangs at rest at the first pose; searched by default.

    Returns
    -------
    tool : Trajectory
        Motion of E with body twists, after the arrival continued until the cup has relaxed.
    package : Trajectory
        Motion of B at equal stamps, smoothed unless C^4.
    smoothed : float
        Duration of the smoothing (s); 0 for a C^4 motion.

    Raises
    ------
    BellowsError
        If the cup cannot be inverted, or would have to bend too far.

    """
    rates = relaxation_rates(model)
    rows, smoothed = _smooth_rows(reference)
    duration = float(reference.seconds[-1])
    count = math.ceil(duration / min(GRID, RATE_PER_STEP / rates[-1]) - 1e-9)
    h = duration / count
    arrival = (MAX_ARRIVAL / rates[0] + FADE_TIME) / h
    simulation.require_steps(count + 2.0 * arrival, MAX_GRID_STEPS)
    if start is None:
        start = _tool_above(model, rows[0])
    out, package = np.empty((2, count + 2 + round(arrival), 13))
    body = simulation.state_row(rows[0, :3], rows[0, 3:7])
    start = kernels.relaxed(model[0], kernels.lip_strain(model, start, body), start)
    states = _reference_states(rows, duration, count)
    last = _invert(
        model, start, states, h, rates[0] * np.array(ARRIVAL_TOLERANCE), out, package) - 1
    index = np.append(np.arange(0, last, max(1, round(GRID / h))), last)
    stamps = reference.stamps_ns[0] + np.round(index * h * NS_PER_S).astype(np.int64)
    tool, package = (
        simulation.trajectory_of(stamps, rows) for rows in (out[index], package[index]))
    if np.sum(tool.rotation[:, :, 2] * package.rotation[:, :, 2], axis=1).min() < math.cos(
            PEAK_MOMENT_BENDING):
        raise _too_far()
    return tool, package, smoothed


def _reference_states(rows: Array, duration: float, count: int) -> Array:
    """
    Return states of B, and the rates of its body twist (2 count + 1, 19).

    The reference is a quintic spline through evenly spaced poses (N, 7), from rest to rest.
    """
    still: Any = [(1, np.zeros(7)), (2, np.zeros(7))]
    spline = scipy.interpolate.make_interp_spline(
        np.linspace(0.0, duration, len(rows)), rows, 5, bc_type=(still, still))
    t = np.linspace(0.0, duration, 2 * count + 1)
    value, rate, bend = (spline(t, order) for order in range(3))
    q = value[:, 3:]
    size = np.linalg.norm(q, axis=1)[:, None]
    (_, twist), (_, bent) = body_twists(q, rate), body_twists(q, bend)
    v, w = twist[:, :3], twist[:, 3:]
    growth = 2.0 * np.sum(q * rate[:, 3:], axis=1)[:, None] / size ** 2
    return np.hstack([
        value[:, :3], q / size, twist, bent - np.hstack([np.cross(w, v), growth * w])])


def _invert(
    model: ModelTuple, tool: State, reference: Array, h: float, arrived: Array, out: Array,
    package: Array,
) -> int:
    """Write the states of tool and package; return their number."""
    speed, rate = arrived.tolist()
    try:
        count = int(_invert_kernel(
            model, tool, *as_inputs(reference), h, speed, rate, out, package))
    except (ArithmeticError, ValueError):  # interpreted kernels raise where compiled ones give nan
        count = 0
    if not count or not np.isfinite(out[:count]).all():
        raise _too_far()
    return count


def _too_far() -> TooFastError:
    """Return the error for a motion beyond the cup's reach."""
    return TooFastError(
        'This motion of the package would bend the cup by more than '
        f'{math.degrees(PEAK_MOMENT_BENDING):.0f} degrees. Give the motion more time, by limits '
        'for example, or use the method zvd.')


def _tool_above(model: ModelTuple, body: Array) -> State:
    """Return the tool from which a package with a pose (7,) hangs at rest."""
    (l1, l0, K, P, *_), package, gravity = model
    model = (l1, l0, K, P), package, gravity
    rates = relaxation_rates(model)
    shift = resting_on_tool(model, kernels.ORIGIN)[0]
    o = body[:3] - lie.quaternion_to_rotation(body[3:]) @ shift
    h = min(GRID, RATE_PER_STEP / rates[-1])
    out = np.empty((2, 2 + round((2.0 * MAX_ARRIVAL / rates[0] + FADE_TIME) / h), 13))
    count = _invert(model, simulation.state_row(o, body[3:]), np.pad(body, (0, 12))[None], h,
                    1e-4 * rates[0] * np.array(ARRIVAL_TOLERANCE), *out)
    return simulation.state_row(out[0, count - 1, :3], out[0, count - 1, 3:7])


def tool_above(model: ModelTuple, package: Trajectory) -> Trajectory:
    """Return the motion of the tool with a package fixed below it."""
    o, q = _tool_above(model, simulation.tool_rows(package)[0, :7])[:2]
    T_B = lie.transform(package.rotation[0], package.position[0])
    T_E = lie.transform(lie.quaternion_to_rotation(np.array(q)), np.array(o))
    return at_tip(package, lie.inverse_transform(T_B) @ T_E)


def _smooth_rows(reference: Trajectory) -> tuple[Array, float]:
    """Return evenly spaced poses (N, 7) from rest to rest, smoothed if necessary."""
    curve, duration = curve_of(reference), float(reference.seconds[-1])
    rows = curve(np.linspace(0.0, duration, max(6, round(duration / SPACING)) + 1))
    if is_smooth(curve):
        return rows, 0.0
    fine = (len(rows) - 1) * SUBDIVISION
    # Longer smoothing makes the rest so fast that a cup with errors of 5 % swings; shorter
    # smoothing makes the tool jerk.
    box = round(0.25 * fine * min(0.12, 0.2 / duration)) | 1  # odd, with a middle
    reach = 2 * (box - 1)
    quick = curve(np.linspace(0.0, duration, fine + 1 - 2 * reach))
    smooth = np.pad(quick, ((reach, reach), (0, 0)), mode='edge')
    for _ in range(4):
        smooth = scipy.ndimage.uniform_filter1d(smooth, box, axis=0, mode='nearest')
    smooth[:, 3:] /= np.linalg.norm(smooth[:, 3:], axis=1)[:, None]
    return smooth[::SUBDIVISION], 2.0 * reach * duration / fine


def is_smooth(curve: Any) -> bool:
    """
    Return whether a motion from rest to rest, as returned by `curve_of`, is C^4.

    In a motion that is not C^4, the change of the fourth derivative between neighbours does not
    decrease with their distance.
    """
    duration = float(curve.x[-1])
    count = round(duration / max(SPACING, float(np.median(np.diff(curve.x)))))
    count = 2 * max(3, round(0.5 * count))
    rows = np.pad(curve(np.linspace(0.0, duration, count + 1)), ((6, 6), (0, 0)), mode='edge')
    fine, coarse = (np.diff(rows[::every], 4, axis=0) * (count / (every * duration)) ** 4
                    for every in (1, 2))
    change, before = (np.abs(np.diff(d, axis=0)).max() for d in (fine, coarse))
    tolerance = max(SNAP_TOLERANCE, RELATIVE_SNAP_TOLERANCE * np.abs(fine).max())
    return bool(change < tolerance or change < 0.7 * before)


# -------------------------------------------------------------------------------------- shaping


def residual_modes(model: ModelTuple, prediction: planning.PlanPrediction) -> list[SwingMode]:
    """
    Return the modes of the hanging package, with the swing of each after a plan.

    The model is linearised at rest after the plan. The slowest mode is first; overdamped modes are
    left out.
    """
    last = simulation.tool_rows(prediction.tool)[-1]
    tool = simulation.state_row(last[:3], last[3:7])
    hanging = simulation.rest(model, last)
    values, vectors = np.linalg.eig(system_matrix(model, tool, hanging))
    R = lie.quaternion_to_rotation(np.array(hanging[1]))
    end = prediction.states[-1]
    shift = R.T @ (end[:3] - hanging[0])
    rotation = lie.log_so3(R.T @ lie.quaternion_to_rotation(end[3:7]))
    state = np.concatenate([shift, rotation, end[7:], np.zeros(len(values) - 12)])  # relaxed
    sizes = np.linalg.solve(vectors, state)
    tilts = 2.0 * np.abs(sizes) * np.linalg.norm(vectors[3:6], axis=0)
    return sorted(SwingMode(abs(s) / (2.0 * math.pi), -s.real / abs(s), float(tilt))
                  for s, tilt in zip(values, tilts, strict=True) if s.imag > 1e-9 * abs(s))


def impulses(modes: Sequence[SwingMode], method: str) -> tuple[Array, Array]:
    """
    Return delays (s) and sizes, with sum 1, of the ZV or ZVD shaper of some modes (M,).

    k = exp(-zeta pi / sqrt(1 - zeta^2)) is the amplitude ratio of a swing over half a period.
    """
    delays, sizes = np.zeros(1), np.ones(1)
    for mode in modes:
        root = math.sqrt(1.0 - mode.damping_ratio ** 2)
        k = math.exp(-mode.damping_ratio * math.pi / root)
        powers = np.array([1.0, k] if method == 'zv' else [1.0, 2.0 * k, k * k])
        half = 0.5 / (mode.frequency * root)
        delays = np.add.outer(delays, half * np.arange(len(powers))).ravel()
        sizes = np.outer(sizes, powers / powers.sum()).ravel()
    return delays, sizes


def to_shape(modes: Sequence[SwingMode]) -> list[SwingMode]:
    """
    Return the modes that swing, the largest swing first.

    Similar modes are merged, weighted by their swing.
    """
    groups: list[list[SwingMode]] = []
    for mode in modes:
        if mode.swing <= MIN_RESIDUAL_SWING:
            continue
        if groups and mode.frequency < 1.05 * groups[-1][-1].frequency:  # shaped as one
            groups[-1].append(mode)
        else:
            groups.append([mode])
    merged = (SwingMode(*np.average(group, axis=0, weights=[
        mode.swing for mode in group]).tolist()) for group in groups)
    return sorted(merged, key=lambda mode: -mode.swing)


def best_shaper(
    model: ModelTuple, tool: Trajectory, method: str, residual: planning.PlanPrediction,
) -> tuple[Trajectory, list[SwingMode], float, str]:
    """
    Return a shaped motion, its shaped modes, its residual swing (rad), and its method.

    Shapers of no mode, one mode and several modes are simulated, from short to long, up to
    `ALLOWED_TIME`: ZVD shapers, then ZV shapers. The first motion with a residual swing below
    `MIN_RESIDUAL_SWING` is selected, otherwise the motion with the least swing, which may be the
    unchanged motion (method 'none').
    """
    swinging = to_shape(residual_modes(model, residual))
    allowed = max(ALLOWED_TIME, float(tool.seconds[-1]))
    best = tool, swinging[:0], residual.residual_swing, 'none'
    for kind in ('zvd', 'zv') if method == 'zvd' else ('zv',):
        for count in range(1, len(swinging) + 1):
            delays, sizes = impulses(swinging[:count], kind)
            if best[2] <= MIN_RESIDUAL_SWING or delays.max() > allowed:
                break
            motion = shaped(tool, delays, sizes)
            swing = planning.PlanSimulation(
                model, None, motion, tail=TAIL).predict().residual_swing
            if swing < best[2]:
                best = motion, swinging[:count], swing, kind
    return best


def shaped(tool: Trajectory, delays: Array, sizes: Array) -> Trajectory:
    """Return the sum of delayed copies of a motion, with quaternions summed and normalised."""
    duration, curve = float(tool.seconds[-1]), curve_of(tool)
    simulation.require_steps(len(delays) * (duration + delays.max()) / GRID, 5 * MAX_GRID_STEPS)
    seconds = np.arange(math.ceil((duration + delays.max()) / GRID - 1e-9) + 1) * GRID
    at = np.clip(seconds - delays[:, None], 0.0, duration)
    rows, rates = (np.tensordot(sizes, of(at), 1) for of in (curve, curve.derivative()))
    stamps = tool.stamps_ns[0] + np.round(seconds * NS_PER_S).astype(np.int64)
    rotation, twist = body_twists(rows[:, 3:], rates)
    return Trajectory(stamps, rows[:, :3], rotation, twist)


# ---------------------------------------------------------------------------------- both of them


class Steered(NamedTuple):
    """A motion of the tool that leaves the package without swing."""

    tool: Trajectory
    package: Trajectory
    """Poses of B as in the reference, at the tool's stamps."""
    smoothed: float
    """Time over which the reference motion was smoothed, s; 0 if C^4."""
    modes: list[SwingMode]
    """Shaped modes of the package."""
    residual: float
    """Swing of the package after the motion according to the model, rad; 0 for the inverse."""
    method: str
    """'inverse', 'zv', 'zvd', or 'none' for an unchanged motion."""


def steer(model: ModelTuple, plan: Trajectory, method: str, of_package: bool = False) -> Steered:
    """
    Return a motion of the tool that leaves the package without swing.

    Parameters
    ----------
    model : tuple
        Model for the kernels.
    plan : Trajectory
        Poses and body twists from rest to rest: of the tool, with the package hanging rigidly
        below it, or of the package's B.
    method : {'inverse', 'zv', 'zvd'}
        Inverse dynamics of the planned package, or input shaping with modes of the model at rest.
    of_package : bool
        Whether the plan is of B.

    Raises
    ------
    BellowsError
        If the plan does not begin and end at rest, the package cannot rest under the tool, or the
        cup cannot be inverted.

    """
    twist = np.abs(np.asarray(plan.twist)[[0, -1]])
    if (twist > np.repeat(simulation.MAX_REST_RATES, 3)).any():
        raise BellowsError(
            f'The plan begins or ends in motion, at up to {twist[:, :3].max():.3g} m/s and '
            f'{twist[:, 3:].max():.3g} rad/s; expected rest. Give a plan from rest to rest.')
    if method == 'inverse':
        row = simulation.tool_rows(plan)[0]
        first = None if of_package else simulation.state_row(*np.split(row, [3, 7]))
        package = plan if of_package else hanging(model, plan)
        return Steered(*inverse(model, package, first), [], 0.0, method)
    tool = tool_above(model, plan) if of_package else plan
    prediction = planning.PlanSimulation(model, None, tool, tail=TAIL).predict()
    tool, modes, residual, used = best_shaper(model, tool, method, prediction)
    return Steered(tool, hanging(model, tool), 0.0, modes, residual, used)


def hanging(model: ModelTuple, tool: Trajectory) -> Trajectory:
    """
    Return the motion of the package hanging rigidly below the tool, at rest at both ends.

    If the tool tilts, the relative pose changes from the first to the last with four continuous
    derivatives.
    """
    T_E = lie.transform(tool.rotation[[0, -1]], tool.position[[0, -1]])
    rests = [simulation.rest(model, row) for row in simulation.tool_rows(tool)[[0, -1]]]
    T_B = lie.transform(lie.quaternion_to_rotation(np.array([state[1] for state in rests])),
                        np.array([state[0] for state in rests]))
    T_E_B = lie.inverse_transform(T_E) @ T_B
    change = lie.log_se3(lie.inverse_transform(T_E_B[0]) @ T_E_B[1])
    s = (tool.seconds / tool.seconds[-1])[:, None]
    step = s**5 * (126.0 + s * (-420.0 + s * (540.0 + s * (-315.0 + s * 70.0))))
    rate = 630.0 * s**4 * (1.0 - s) ** 4 / tool.seconds[-1]
    package = at_tip(tool, T_E_B[0] @ lie.exp_se3(step * change))
    return replace(package, twist=np.asarray(package.twist) + rate * change)
