"""Plans, and a second integrator that predicts many of them at once: `oracle`, plain RK4."""

from types import SimpleNamespace

from bellows_ros.core.geometry import lie
from bellows_ros.core.model.cup_package import Cup, Package
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.planning.points import plan_of
import numpy as np

from . import oracle

CUP = Cup(
    np.diag([5400, 5400, 9200, 4.2, 4.2, 1.35]), np.diag([55, 55, 24, 0.06, 0.06, 0.1]), 0.046)
PACKAGE = Package(1.8, np.diag([0.00438, 0.00654, 0.00984]), (0.0, 0.0, -0.03))
GRIP = (60e3 * np.pi * 0.02 ** 2, 0.02, 0.5)
GRAVITY = np.array([0.0, 0.0, -9.81])
VALUES = Values({
    'cup.stiffness': CUP.stiffness.ravel().tolist(), 'cup.damping': CUP.damping.ravel().tolist(),
    'cup.length': CUP.length, 'package.mass': 1.8, 'package.com': [0.0, 0.0, -0.03],
    'package.inertia': [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0],
})
"""Cup and package as parameters."""


class Move:
    """A quintic move by a way (m, world) and a rotation vector (rad) in a time (s), or many."""

    def __init__(self, way, turn, duration):
        self.way, self.turn = np.asarray(way, dtype=float), np.asarray(turn, dtype=float)
        self.duration = np.asarray(duration, dtype=float)

    def steps(self, s):
        """Return the step and its slope over the part of the time that has passed."""
        return s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s)**2

    def at(self, t):
        """Return position, rotation and body twist at times (N,)."""
        s = np.clip(np.asarray(t) / self.duration, 0.0, 1.0)[..., None]
        step, rate = self.steps(s)
        rate = rate / self.duration[..., None]
        phi = step * self.turn
        R = lie.exp_so3(phi)
        v = np.einsum('...ji,...j->...i', R, rate * self.way)
        w = np.einsum('...ij,...j->...i', lie.dexp(-phi), rate * self.turn)
        return step * self.way, R, np.concatenate([v, w], axis=-1)

    def points(self, rate_hz):
        """Return times, poses (N, 7) and body twists at a rate."""
        count = round(float(self.duration) * rate_hz)
        stamps = np.round(np.linspace(0.0, float(self.duration), count + 1) * 1e9).astype(np.int64)
        o, R, v = self.at(stamps * 1e-9)
        return stamps, np.hstack([o, lie.rotation_to_quaternion(R)]), v

    def plan(self, rate_hz=1000):
        """Return the plan sampled."""
        return plan_of(*self.points(rate_hz), twist_frame='tool').trajectory()


def random_case(rng):
    """Return a move, a package and a grip that may or may not hold it."""
    way = rng.normal(0.0, 0.35, 3) * [1, 1, 0.5]
    turn = rng.normal(0.0, 0.3, 3)
    move = Move(way, turn, rng.uniform(0.35, 0.9))
    mass, half = rng.uniform(0.6, 2.2), rng.uniform(0.03, 0.1, 3)
    squares = half ** 2
    inertia = np.diag(mass / 3 * (squares.sum() - squares))
    com = (rng.normal(0, 0.004), rng.normal(0, 0.004), -half[2])
    radius = rng.uniform(0.018, 0.03)
    return move, Package(mass, inertia, com), (rng.uniform(4e4, 7e4) * np.pi * radius**2, radius,
                                               rng.uniform(0.3, 0.7))


class Batch:
    """Many packages on one cup, each under its own move: the printed formulas, broadcast."""

    def __init__(self, cup, moves, packages):
        self.cup, self.packages = cup, SimpleNamespace(**{
            name: np.array([getattr(package, name) for package in packages])
            for name in ('mass', 'com', 'inertia')})
        self.moves = Move(*(np.array([getattr(move, name) for move in moves])
                            for name in ('way', 'turn', 'duration')))

    def tools(self, t):
        """Return poses (N, 4, 4) and body twists (N, 6) of the tools at a time (s)."""
        o, R, v = self.moves.at(t)
        return lie.transform(R, o), v

    def run(self, T, v, duration, steps):
        """Yield time, tools, poses, twists and wrenches of all after every step of plain RK4."""
        h, tools = duration / steps, self.tools(0.0)
        for k in range(steps + 1):
            wrench = oracle.lip_wrench(self.cup, self.packages, *tools, T, v)
            yield k * h, tools, T, v, wrench
            middle, end = self.tools((k + 0.5) * h), self.tools((k + 1) * h)
            a1 = self.rates(tools, T, v)
            a2 = self.rates(middle, T + 0.5 * h * a1[0], v + 0.5 * h * a1[1])
            a3 = self.rates(middle, T + 0.5 * h * a2[0], v + 0.5 * h * a2[1])
            a4 = self.rates(end, T + h * a3[0], v + h * a3[1])
            T, v = (x + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                    for x, b1, b2, b3, b4 in zip((T, v), a1, a2, a3, a4, strict=True))
            tools = end

    def rates(self, tools, T, v):
        """Return the rates of poses (N, 4, 4), entry by entry, and of twists."""
        twist = np.zeros((len(v), 4, 4))
        twist[:, :3, :3], twist[:, :3, 3] = lie.hat(v[:, 3:]), v[:, :3]
        return T @ twist, oracle.acceleration(self.cup, self.packages, GRAVITY, *tools, T, v)
