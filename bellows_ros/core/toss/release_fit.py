"""
Identification of the valve from tosses: delay, time constant, blow-off, and their scatter.

Of each toss the instant of letting go and the impulse are fitted to the package's poses, together
with its state at the beginning. With the load L of the lip at that instant the suction force V
has fallen to it: late = delay + tau ln(V0 / L), a straight line over all tosses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import log_so3, quaternion_to_rotation
from bellows_ros.core.model.equilibrium import moved
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple, State
from bellows_ros.core.model.simulation import state_row, tool_rows
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.savgol import with_filtered_noise
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.toss.release import flight, Held, NO_FLIGHT, STRIDE
from bellows_ros.errors import UndeterminedError, UnstableError
import numpy as np

FEWEST = 3
"""Fewest tosses for delay and tau."""

FALLS_BELOW, SHORTEST_FALL = 3.0, 0.05
"""A package flies if its specific force stays below this (m/s^2) for at least this time (s)."""

BEFORE, AFTER = 0.15, 0.3
"""Part of a toss used, before and after letting go, s."""

LONGEST_LATE = 1.0
"""Longest time (s) from the valve to the flight."""

REPLICAS = 20
"""Draws of the tool's noise for the standard errors of a toss."""

SIZES = np.repeat([1e-3, 1e-2, 1e-2, 1e-1], 3)
"""Scales of the corrections of the initial state: m, rad, m/s, rad/s."""


@dataclass(frozen=True, eq=False)
class LettingGo:
    """
    One toss.

    Parameters
    ----------
    late : float
        From the valve to letting go, s.
    late_std : float
        Standard error, s.
    load : float
        Suction force (N) at which the lip peels then.
    impulse, impulse_std : float
        Of the blow-off, N s.
    speed : float
        Of B then, m/s.
    chi2 : float
        Sum of squared residuals over their number; about 1 where model and noise are right.

    """

    late: float
    late_std: float
    load: float
    impulse: float
    impulse_std: float
    speed: float
    chi2: float


def flights(package: Trajectory, gravity: float) -> Array:
    """
    Return where a package flies: (N, 2), indices of the first sample of each flight and the last.

    Parameters
    ----------
    package : Trajectory
        B in the world, z up, filtered, with body twists and their derivatives.
    gravity : float
        m/s^2.

    """
    assert package.twist is not None and package.acceleration is not None
    v, w = package.twist[:, :3], package.twist[:, 3:]
    felt = package.acceleration[:, :3] + np.cross(w, v) + gravity * package.rotation[:, 2]
    falls = package.valid & (np.linalg.norm(felt, axis=1) < FALLS_BELOW)
    edges = np.flatnonzero(np.diff(falls.astype(int), prepend=0, append=0))
    found = np.column_stack([edges[::2], edges[1::2] - 1])
    long_enough = np.diff(package.seconds[found], axis=1)[:, 0] >= SHORTEST_FALL
    return np.asarray(found[long_enough])


def letting_go(
    model: ModelTuple, grip: Grip | None, tool: Trajectory, package: Trajectory, start: State,
    valve: float, about: float, noise: tuple[float, float], replicas: Sequence[Trajectory] = (),
) -> LettingGo:
    """
    Return when a package was let go.

    Parameters
    ----------
    model, grip : tuple
        As the kernels take them.
    tool, package : Trajectory
        E with body twists and B, in the world: from one stamp before the valve until before the
        landing. Every stamp of the package is one of the tool.
    start : State
        About that of B at the first stamp.
    valve, about : float
        When it was switched, and about when it let go, s since the first stamp.
    noise : (float, float)
        Standard deviations of the package's positions (m) and rotations (rad).
    replicas : sequence of Trajectory
        The tool with noise once more, for what that does to the standard errors.

    Raises
    ------
    BellowsError
        If no letting go explains the poses.

    """
    from scipy.optimize import least_squares

    seconds = package.seconds
    end = float(seconds[-1])
    given = Held(model, None, tool, start, end)
    rows = np.searchsorted(given.times, seconds - 1e-9)

    def run(x: Array, held: Held) -> tuple[Held, State, float]:
        push: Any = (tuple(part.tolist()) for part in np.split(SIZES * x[:12], 4))
        begun = held.again(moved(start, *push))
        time = min(max(valve + float(x[12]) * 1e-3, valve), end - 1e-3)
        release = NO_FLIGHT._replace(impulse=float(x[13]) * 1e-2)
        return begun, begun.let_go(release, time)[1], time

    def residuals(x: Array, held: Held = given) -> Array:
        begun, body, time = run(x, held)
        states = begun.states[rows].copy()
        now = time
        for k in np.flatnonzero(seconds > time):
            body = flight(model[1], model[2], body, float(seconds[k] - now), 10.0 * STRIDE)
            now = float(seconds[k])
            states[k] = [*body[0], *body[1], *body[2], *body[3]]
        turn = np.swapaxes(package.rotation, -1, -2) @ quaternion_to_rotation(states[:, 3:7])
        return np.hstack([
            (states[:, :3] - package.position) / noise[0], log_so3(turn) / noise[1]]).ravel()

    guesses = [np.append(np.zeros(12), [1e3 * (about + by - valve), 0.0]) for by in (-0.02, 0.0)]
    step = np.full(14, 1e-4)
    fits = [least_squares(residuals, x, diff_step=step, max_nfev=30) for x in guesses]
    best = min(fits, key=lambda fit: float(fit.cost))
    chi2 = 2.0 * float(best.cost) / (len(best.fun) - len(best.x))
    if not math.isfinite(chi2):
        raise UndeterminedError('No release time explains the poses of this toss. Leave it out.')
    back = np.linalg.pinv(np.asarray(best.jac))
    scatter = [back @ (residuals(best.x, Held(model, None, replica, start, end)) - best.fun)
               for replica in replicas]
    std = np.sqrt(np.diag(back @ back.T) + (np.var(scatter, axis=0) if scatter else 0.0))
    begun, body, time = run(best.x, given)
    loaded = Held(model, grip, tool, begun.start, end)
    load = float(np.interp(time, loaded.times, loaded.loads))
    return LettingGo(
        time - valve, 1e-3 * float(std[12]), load,
        1e-2 * float(best.x[13]), 1e-2 * float(std[13]), math.hypot(*body[2]), chi2)


def tosses_of(
    recording: Recording, model: ModelTuple, grip: Grip | None, valves_ns: Sequence[int] | None
) -> tuple[list[LettingGo], list[str]]:
    """
    Return the tosses in a recording, and why others cannot be used.

    Parameters
    ----------
    recording : Recording
        Of tool and package.
    model, grip : tuple
        As the kernels take them.
    valves_ns : sequence of int or None
        When the valve was switched off, ns; None where it was not recorded.

    """
    package, tool = recording.package, recording.tool
    stamps_ns, noise = package.stamps_ns, recording.measured_noise[1]
    step = float(np.median(np.diff(recording.aligned_tool.seconds)))
    used, found, left_out = set(), list[LettingGo](), list[str]()
    for first, last in flights(package, recording.settings.gravity):
        flies_ns = int(stamps_ns[first])
        where = f'the flight at {recording.since_start(stamps_ns)[first]:.2f} s'
        valve_ns = flies_ns - round(0.1 * NS_PER_S)
        if valves_ns is not None:
            early = [v for v in valves_ns if 0.0 <= (flies_ns - v) / NS_PER_S <= LONGEST_LATE]
            if not early:
                left_out.append(f'{where}: the valve was not switched before it')
                continue
            valve_ns = max(early)
            used.add(valve_ns)
        begin_ns, end_ns = valve_ns - round(BEFORE * NS_PER_S), flies_ns + round(AFTER * NS_PER_S)
        part = slice(int(np.searchsorted(stamps_ns, begin_ns)),
                     min(int(last), int(np.searchsorted(stamps_ns, end_ns))) + 1)
        poses = recording.measured_package.select(part)
        if not (package.valid[part.start] and poses.valid[0] and tool.valid[part].all()):
            left_out.append(f'{where}: tool or package was not tracked continuously before it')
            continue
        start = state_row(*(row[0] for row in np.split(
            tool_rows(package.select(slice(part.start, part.start + 1))), [3, 7], axis=1)))
        since, draw = int(stamps_ns[part.start]), np.random.default_rng(0)
        replicas = [
            with_filtered_noise(
                tool.select(part), recording.noise.tool, recording.tool_weights, step, draw)
            for _ in range(REPLICAS)]
        try:
            one = letting_go(
                model, grip, tool.select(part), poses.select(poses.valid), start,
                (valve_ns - since) / NS_PER_S, (flies_ns - since) / NS_PER_S, noise, replicas)
        except (UndeterminedError, UnstableError) as error:
            left_out.append(f'{where}: {error}')
            continue
        found.append(one if valves_ns is not None else replace(one, late=math.nan))
    for valve_ns in sorted(set(valves_ns or ()) - used):
        seconds = (valve_ns - recording.start_ns) / NS_PER_S
        left_out.append(f'the valve at {seconds:.2f} s: no tracked flight follows')
    return found, left_out


@dataclass(frozen=True)
class ValveFit:
    """
    Delay (s), tau (s), impulse (N s): values, standard errors, and scatter from toss to toss.

    NaN where the tosses do not say. The scatter of tau cannot be separated from that of the
    delay, which holds both.
    """

    delay: float
    delay_error: float
    delay_scatter: float
    tau: float
    tau_error: float
    impulse: float
    impulse_error: float
    impulse_scatter: float


def valve_fit(tosses: Sequence[LettingGo], suction: float) -> ValveFit:
    """
    Return the estimates of valve and blow-off from many tosses.

    Parameters
    ----------
    tosses : sequence of LettingGo
        At least `FEWEST`, with loads that differ. Without the instants of the valve, `late` is
        NaN: then only the blow-off is found.
    suction : float
        V0, the suction force while it holds, N; 0 where it is not known: then only the delay until
        it lets go is.

    Raises
    ------
    BellowsError
        If there are too few, or all let go under the same load.

    """
    if len(tosses) < FEWEST:
        raise UndeterminedError(
            f'A valve needs {FEWEST} or more usable tosses, got {len(tosses)}. Record more.')
    impulses = np.array([t.impulse for t in tosses])
    spread = float(np.var(impulses, ddof=1))
    noise = float(np.mean([t.impulse_std**2 for t in tosses]))
    delay, delay_error, scatter, tau, tau_error = _line(tosses, suction)
    return ValveFit(
        delay, delay_error, scatter, tau, tau_error, float(impulses.mean()),
        math.sqrt(spread / len(impulses)), math.sqrt(max(0.0, spread - noise)))


def _line(tosses: Sequence[LettingGo], suction: float) -> tuple[float, float, float, float, float]:
    """Return delay, its error and scatter, tau and its error: late = delay + tau ln(V0 / L)."""
    late = np.array([t.late for t in tosses])
    if np.isnan(late).all():
        return math.nan, math.nan, math.nan, math.nan, math.nan
    known = np.array([t.late_std for t in tosses])
    A, scatter = np.ones((len(late), 1)), 0.0
    if suction:
        x = np.log(suction / np.array([t.load for t in tosses]))
        if np.ptp(x) < 0.05:
            raise UndeterminedError(
                'tau is not identifiable: the load at release is nearly the same in all tosses, '
                f'ln(V0/L) from {x.min():.3g} to {x.max():.3g}. Also release at other times of '
                'the swing.')
        A = np.column_stack([A, x])
    for _ in range(20):  # the scatter weighs the tosses, and comes from what is left over
        weight = 1.0 / (scatter**2 + known**2)
        inverse = np.linalg.inv(A.T @ (weight[:, None] * A))
        line = inverse @ (A.T @ (weight * late))
        left = late - A @ line
        total = float(left @ left) / (len(late) - A.shape[1])
        scatter = math.sqrt(max(0.0, total - float(np.mean(known**2))))
    tau = (float(line[1]), math.sqrt(inverse[1, 1])) if suction else (math.nan, math.nan)
    return float(line[0]), math.sqrt(inverse[0, 0]), scatter, tau[0], tau[1]
