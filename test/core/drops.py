"""Vertical drops of packages of several masses, by SciPy in one dimension, and real ones."""

from pathlib import Path

from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.simulation import rest, tool_rows
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.toss.release import NO_GRIP
from bellows_ros.core.toss.release_fit import Drop
import numpy as np
from scipy.integrate import solve_ivp

G = 9.81
SHARED = Path(__file__).parents[3] / 'shared' / 'release' / 'tue_five_masses.npz'


def made_drop(mass, stiffness, length, seconds, tool, package, valve, noise=1e-4):
    """Return a drop from heights (N,) of tool and package at times (s), the lip on B."""
    def poses(z):
        return Trajectory(
            np.round(np.asarray(seconds) * 1e9).astype(np.int64),
            np.column_stack([np.zeros((len(z), 2)), z]), np.tile(np.eye(3), (len(z), 1, 1)),
            np.zeros((len(z), 6)))

    cup = Cup(np.diag([6500.0, 6500.0, stiffness, 4.0, 4.0, 1.3]),
              np.diag([20.0, 20.0, 24.0, 0.05, 0.05, 0.05]), length)
    model = model_tuple(cup, Package(mass, 0.01 * np.eye(3), np.zeros(3)), G)
    still = poses(np.full(len(seconds), np.mean(tool)))
    return Drop(model, NO_GRIP, still, poses(np.asarray(package)),
                rest(model, tool_rows(still)[0]), valve, noise)


def simulated(mass, stiffness, length, law, seconds, valve):
    """Return the heights of a package dropped from a tool at 0, by the law in one dimension."""
    delay, fall, closing, opening, damping, sticking = law

    def suction(t):
        return 1.0 - (t - delay) / fall

    def slope(t, y):
        x, v = y
        pull = closing * suction(t) - max(0.0, closing - stiffness * x) + (
            closing * (max(0.0, x) / opening) ** 2) + damping * v
        return v, G - pull / mass

    until = delay + fall * (1.0 + sticking)
    out = solve_ivp(slope, (delay, until), (mass * G / stiffness, 0.0), rtol=1e-9, atol=1e-12,
                    max_step=1e-3, dense_output=True)
    t = seconds - valve
    x, v = out.sol(np.clip(t, delay, until))
    after = np.maximum(t - until, 0.0)
    return -(length + x + v * after + 0.5 * G * after**2)


def real_drops(most=99):
    """Return real drops by mass, the cup by static loads, and the arrays of the drops."""
    data = dict(np.load(SHARED))
    all_masses = np.unique(data['mass_kg'])
    hang = data['tool_z_m'] - data['package_z_m']
    rest_at = [hang[data['mass_kg'] == mass, :2].mean() for mass in all_masses]
    slope, length = np.polyfit(all_masses * G, rest_at, 1)
    return data, {mass: [
        made_drop(mass, 1.0 / slope, length, data['time_s'], data['tool_z_m'][i],
                  data['package_z_m'][i], 0.0)
        for i in np.flatnonzero(data['mass_kg'] == mass)[:most]]
        for mass in all_masses}


def filtered(drop, law, late, before=7):
    """
    Return height (N,), velocity (N,) and letting go (s) of a prediction, filtered like the data.

    The valve is later by `late` (s) than in the drop.
    """
    from scipy.signal import savgol_filter

    step = float(np.median(np.diff(drop.package.seconds)))
    count = len(drop.package) + 2 * before
    tool = drop.tool.position[0, 2]
    longer = made_drop(
        drop.mass, drop.model[0][2][0][8], drop.model[0][1], step * np.arange(count),
        np.full(count, tool), np.full(count, tool), before * step + late)
    released, states = longer.predicted(law)
    position, velocity = (savgol_filter(states[:, 2], 13, 3, order, step)[before:-before]
                          for order in (0, 1))
    return position, velocity, released - before * step - late


def at_the_end(data, drops, law, factor):
    """
    Return errors of height (m) and velocity (m/s) at the last sample, and their deviations.

    Each (N, 2), of drops whose valve is taken as it was recorded; the deviations are those of the
    law with a factor (6, 6) of its covariance.
    """
    def end(numbers):
        return np.array([part[-1] for part in filtered(drops[0], tuple(numbers), 0.0)[:2]])

    slopes = [(end(law + 0.1 * column) - end(law - 0.1 * column)) / 0.2 for column in factor.T]
    errors = []
    for drop in drops:
        i = index_of(data, drop)
        position, velocity, _ = filtered(drop, law, 0.0)
        off = position - data['package_z_m'][i]
        errors.append((off[-1] - off[:5].mean(),
                       velocity[-1] - data['package_velocity_z_m_s'][i, -1]))
    return np.array(errors), np.tile(np.linalg.norm(slopes, axis=0), (len(drops), 1))


def index_of(data, drop):
    """Return the row of a real drop."""
    return np.flatnonzero(
        (data['mass_kg'] == drop.mass)
        & (data['package_z_m'][:, -1] == drop.package.position[-1, 2]))[0]


def misses(data, drops, law, latest=5e-3):
    """
    Return rms of position (m) and velocity (m/s), letting go (s), and the fastest miss at the end.

    Of each drop, (N, 4), at the best instant within 5 ms, from where each package hung.
    """
    rows = []
    for drop in drops:
        i, best = index_of(data, drop), (np.inf, ())
        for late in np.arange(-latest, latest + 1e-6, 5e-4):
            position, velocity, released = filtered(drop, law, late)
            off = position - data['package_z_m'][i]
            off -= off[:5].mean()
            slope = velocity - data['package_velocity_z_m_s'][i]
            found = [np.sqrt(np.mean(off**2)), np.sqrt(np.mean(slope**2)), released,
                     np.abs(slope[-8:]).max()]
            cost = (found[0] / 6e-4)**2 + (found[1] / 2e-2)**2
            if cost < best[0]:
                best = cost, found
        rows.append(best[1])
    return np.array(rows)
