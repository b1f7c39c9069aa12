"""
A pick-and-place cell that shares no formula with the package: bushing, contact, camera.

The cup is a co-rotated bushing at its middle with two relaxing branches; the package is a box with
corners that touch a table with friction; symplectic Euler steps of 0.5 ms. The package stands on
the table before and after a cycle, and touches the table while it is still held. A camera sees a
part of the cycle. The numbers that a user states differ from the true ones.
"""

import math
from typing import NamedTuple

from numba import njit
import numpy as np
from scipy.spatial.transform import Rotation

STEP = 5e-4
EVERY = 20
"""Number of steps between two stored samples, 10 ms."""
TABLE = 0.08
STIFFNESS = np.array([4300.0, 4300.0, 7800.0, 3.4, 3.4, 1.1])
DAMPING = np.array([48.0, 48.0, 30.0, 0.05, 0.05, 0.08])
LENGTH = 0.042
RELAXING, TIMES = np.array([0.06, 0.05]), np.array([0.06, 0.8])
WRONG = {'stiffness': 0.03, 'damping': 0.2, 'mass': 0.02, 'com': 2e-3, 'inertia': 0.05,
         'camera': (2e-3, 3e-3), 'marker': (2e-3, 3e-3)}
"""Standard deviations of the stated numbers: relative, com in m, m and rad."""
FLAT = 1.0, 1.0, 0.5
"""Ratio of the errors of the centre of mass along the axes."""
NOISE = np.repeat([2e-3, 1e-2], 3)
CAMERA = np.array([0.5, 0.0, 1.6])
"""Position of a camera that looks down, m."""
TAG = 0.08
"""Side of a tag at the centre of mass, m."""
CORNER_NOISE = 1e-4
"""Standard deviation of a corner at rest, rad."""
EXPOSURE = 3e-3
"""Exposure of the camera, s."""
DOWN = np.diag([1.0, -1.0, -1.0])


class CellCycle(NamedTuple):
    """One cycle: sampled motion, sensor messages, and the truth."""

    times: np.ndarray
    tool: np.ndarray
    """Position, quaternion, linear and angular velocity in the world (N, 13)."""
    truth: np.ndarray
    """Position and quaternion of the package (N, 7)."""
    seen: list
    """Measured poses: stamp, arrival (s), position, quaternion."""
    stated: dict
    """Parameters package.*, with standard deviations."""
    at: dict
    """Times of the events, s."""
    load: np.ndarray | None = None
    """Force and moment at B of the cup on the package, world (N, 6), if simulated."""


@njit(cache=True)
def _turned(phi):
    """Return the rotation by a rotation vector."""
    angle = math.sqrt((phi * phi).sum())
    X = np.array([[0.0, -phi[2], phi[1]], [phi[2], 0.0, -phi[0]], [-phi[1], phi[0], 0.0]])
    one = 1.0 if angle < 1e-6 else math.sin(angle) / angle
    two = 0.5 if angle < 1e-6 else (1.0 - math.cos(angle)) / (angle * angle)
    return np.eye(3) + one * X + two * (X @ X)


@njit(cache=True)
def _corners(o, R):
    """Return the directions (8,) of the corners of a tag in the axes of the camera."""
    out = np.zeros(8)
    for k in range(4):
        x = o + 0.5 * TAG * ((-1.0 if k % 3 == 0 else 1.0) * R[:, 0]
                             + (1.0 if k < 2 else -1.0) * R[:, 1])
        out[2 * k], out[2 * k + 1] = x[0] / x[2], x[1] / x[2]
    return out


@njit(cache=True)
def _fitted(o, R, seen):
    """Return the pose near another whose corners are the seen ones, by Levenberg-Marquardt."""
    damping, J = 1e-3, np.zeros((8, 6))
    for _ in range(30):
        e = seen - _corners(o, R)
        for i in range(6):
            x = np.zeros(6)
            x[i] = 1e-5
            J[:, i] = (_corners(o + x[:3], R @ _turned(x[3:])) - seen + e) / 1e-5
        A = J.T @ J
        x = np.linalg.solve(A + damping * np.diag(np.diag(A)), J.T @ e)
        tried, turned = o + x[:3], R @ _turned(x[3:])
        better = np.sum((seen - _corners(tried, turned))**2) < np.sum(e**2)
        damping *= 0.1 if better else 10.0
        if better:
            o, R = tried, turned
    return o, R


@njit(cache=True)
def _fly(tool, state, cup, box, push, grip, floor):
    """Return (N, 36): position, rotation, twists in the world, branches, wrench of the cup."""
    K, P, r, tau, length = cup
    mass, J, com, size = box
    n = (len(tool) - 1) // EVERY + 1
    out = np.zeros((n, 36))
    o, R, v, w = state[:3].copy(), state[3:12].copy().reshape(3, 3), state[12:15].copy(), (
        state[15:18].copy())
    z = state[18:30].copy().reshape(2, 6)
    corners = np.array([[0.5 if i >> j & 1 else -0.5 for j in range(3)] for i in range(8)])
    corners = (corners - np.array([0.0, 0.0, 0.5])) * size - com
    radius = np.linalg.norm(corners[0]) + 0.05
    for k in range(len(tool)):
        if k % EVERY == 0:
            row = out[k // EVERY]
            row[:3], row[3:12], row[12:15], row[15:18], row[18:30] = o, R.ravel(), v, w, z.ravel()
        is_low = o[2] < floor + radius
        if is_low and grip[k] == 0.0 and (v * v).sum() < 1e-8 and (w * w).sum() < 1e-6:
            continue
        e, RE = tool[k, :3], tool[k, 3:12].copy().reshape(3, 3)
        ve, we = tool[k, 12:15], tool[k, 15:18]
        f, t = np.zeros(3), np.zeros(3)
        f[2] = -9.81 * mass
        f += push[k, :3]
        t += push[k, 3:]
        if grip[k] > 0.0:
            near, far = RE[:, 2] * (-0.5 * length), R @ (-com) + R[:, 2] * (0.5 * length)
            d = o + far - e - near
            D = RE.T @ R
            angle = math.acos(min(max(0.5 * (np.trace(D) - 1.0), -1.0), 1.0))
            phi = np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
            phi *= 0.5 if angle < 1e-6 else 0.5 * angle / math.sin(angle)
            M = RE @ _turned(0.5 * phi)
            strain, rate = np.zeros(6), np.zeros(6)
            strain[:3], strain[3:] = M.T @ d, phi
            rate[:3] = M.T @ (v + np.cross(w, far) - ve - np.cross(we, near))
            rate[3:] = M.T @ (w - we)
            load = strain.copy()
            for b in range(2):
                load += r[b] * (strain - z[b])
                z[b] += STEP / tau[b] * (strain - z[b])
            load = -grip[k] * (K * load + P * rate)
            F = M @ load[:3]
            f += F
            couple = M @ load[3:] + np.cross(far - 0.5 * d, F)
            t += couple
            if k % EVERY == 0:
                out[k // EVERY, 30:33], out[k // EVERY, 33:] = F, couple
        for i in range(8 if is_low else 0):
            arm = R @ corners[i]
            depth = floor - o[2] - arm[2]
            if depth > 0.0:
                u = v + np.cross(w, arm)
                N = max(2.5e4 * depth - 70.0 * u[2], 0.0)
                F = np.zeros(3)
                F[2] = N
                F[:2] = -0.35 * N / (math.hypot(u[0], u[1]) + 5e-3) * u[:2]
                f += F
                t += np.cross(arm, F)
        v = v + STEP / mass * f
        wb = R.T @ w
        wb = wb + STEP * (R.T @ t - np.cross(wb, J * wb)) / J
        w = R @ wb
        o = o + STEP * v
        R = R @ _turned(STEP * wb)
    return out


class ContactCell:
    """
    A cell with its own errors; `cycle` draws one package and one cycle after the other.

    Parameters
    ----------
    seed : int
    sensor : {'memory', 'white', 'view', 'corners'}
        Noise of measured poses: with a memory of 50 ms, without memory, a function of the view
        with blur and flips, as of a detected tag, or of the corners of a tag. Poses of a tag are
        in the axes of the camera.

    """

    def __init__(self, seed, sensor='memory'):
        """Draw the cell."""
        self.rng, self.sensor = np.random.default_rng(seed), sensor
        k, p = (np.exp(WRONG[name] * self.rng.normal(size=4))[[0, 0, 1, 2, 2, 3]]
                for name in ('stiffness', 'damping'))
        static = STIFFNESS * k / (1.0 + 0.6 * RELAXING.sum())
        self.cup = static, DAMPING * p, RELAXING, TIMES, LENGTH
        self.camera = self._offset('camera')
        self.waves = self.rng.normal(size=(6, 8, 6)), self.rng.uniform(0.0, 6.3, (6, 8))

    def _offset(self, name):
        return np.repeat(WRONG[name], 3) * self.rng.normal(size=6)

    def _path(self, height):
        """Return way points: end time, position, rotation vector, and the times of events."""
        g, at = self.rng, {}
        o = np.array([g.uniform(-0.1, 0.1), g.uniform(-0.3, 0.3), TABLE + height + LENGTH])
        points = [(0.0, o + [0.0, 0.0, 0.08], np.zeros(3))]

        def go(event, seconds, to=None, turned=None):
            t, o, turn = points[-1]
            at[event] = t + seconds
            points.append((at[event], o if to is None else to, turn if turned is None else turned))

        go('grip', 0.4, o - [0.0, 0.0, 2e-3])
        go('lift', 0.2)
        go('move', 0.45, points[-1][1] + [0.0, 0.0, 0.15])
        distance, heading = g.uniform(0.5, 1.2), g.uniform(-0.6, 0.6)
        yaw = g.uniform(-1.0, 1.0)
        seconds = max(math.sqrt(5.78 * distance / 4.5), math.sqrt(5.78 * abs(yaw) / 12.0))
        o = points[-1][1] + [distance * math.cos(heading), distance * math.sin(heading),
                             g.uniform(0.0, 0.1)]
        go('hold', seconds, o, np.r_[g.uniform(-0.05, 0.05, 2), yaw])
        go('lower', g.uniform(0.3, 1.5))
        o = np.r_[o[:2], TABLE + height + LENGTH - 1e-3]
        go('low', 0.5, o, np.r_[0.0, 0.0, yaw])
        go('valve', 0.1)
        go('up', 0.2)
        go('away', 0.4, o + [0.0, 0.0, 0.1])
        go('back', seconds, np.array([0.0, 0.0, TABLE + 0.25]), np.zeros(3))
        go('end', g.uniform(0.1, 2.0))
        at['release'] = at['valve'] + 0.08
        at['seen'] = at['move'] + g.uniform(0.1, 0.5) * seconds
        at['unseen'] = at['seen'] + 0.4 * at['end']
        return points, at

    def cycle(self, fault='', at_event='hold', after=0.1, size=1.0, gradual=0.0):
        """
        Return a cycle, with a fault some time (s) after an event.

        Faults: 'collision' (size in N s), 'drop', 'slip' (m), 'swap' (factor of mass), 'latency'
        (s), 'camera' (m). A drop lets the grip fade within a time (s), and the switch tells of it.
        """
        g = self.rng
        dims = np.array([g.uniform(0.15, 0.3), g.uniform(0.12, 0.22), g.uniform(0.06, 0.14)])
        mass, com = g.uniform(0.6, 2.2), np.r_[4e-3 * g.normal(size=2), -0.5 * dims[2]]
        inertia = mass / 12.0 * (np.sum(np.square(dims)) - np.square(dims))
        stated = {
            'package.mass': mass, 'package.mass_std': WRONG['mass'] * mass,
            'package.com': com.tolist(), 'package.com_std': [WRONG['com'] * x for x in FLAT],
            'package.inertia': [*inertia.tolist(), 0.0, 0.0, 0.0],
            'package.inertia_std': [*(WRONG['inertia'] * inertia).tolist(), 0.0, 0.0, 0.0]}
        factor = (1.0 + WRONG['mass'] * g.normal()) * (size if fault == 'swap' else 1.0)
        inertia = factor * inertia * np.exp(WRONG['inertia'] * g.normal(size=3))
        com = com + WRONG['com'] * g.normal(size=3) * FLAT
        box = factor * mass, inertia, com, dims
        marker = self._offset('marker')
        points, at = self._path(dims[2])
        times = np.arange(0.0, at['end'] - 2 * STEP, STEP)
        tool = _sampled(points, times)
        grip = ((times > at['grip']) & (times < at['release'])).astype(float)
        push, when = np.zeros((len(times), 6)), at[at_event] + after
        at['fault'], direction = when, g.normal(size=3)
        direction /= np.linalg.norm(direction)
        if fault == 'collision':
            hit = (times > when) & (times < when + 0.02)
            push[hit, :3] = direction * size / 0.02
            push[hit, 3:] = np.cross(0.5 * dims * g.uniform(-1.0, 1.0, 3), push[hit, :3][0])
        if fault == 'drop':
            grip *= np.clip(1.0 - (times - when) / max(gradual, STEP), 0.0, 1.0)
            at['release'] = when + gradual + 0.05  # of the vacuum switch
        start = np.r_[points[1][1][:2] + com[:2], TABLE + dims[2] + com[2], np.eye(3).ravel(),
                      np.zeros(18)]
        states = _fly(tool, start, self.cup, box, push, grip, TABLE)
        if fault == 'slip':  # the lip slips at once: the rest of the motion from there
            first = round(when / STEP) // EVERY
            k, slip = first * EVERY, size * direction * [1.0, 1.0, 0.0] / np.linalg.norm(
                direction[:2])
            again = states[first].copy()
            again[:3] += again[3:12].reshape(3, 3) @ slip
            states[first:] = _fly(tool[k:], again, self.cup, (factor * mass, inertia, com + slip,
                                                              dims), push[k:], grip[k:], TABLE)
        truth = np.hstack([states[:, :3], Rotation.from_matrix(
            states[:, 3:12].reshape(-1, 3, 3)).as_quat()])
        q = Rotation.from_matrix(tool[::EVERY, 3:12].reshape(-1, 3, 3)).as_quat()
        told = np.hstack([tool[::EVERY, :3], q, tool[::EVERY, 12:]])
        told[1:, :7] = 0.5 * (told[1:, :7] + told[:-1, :7])  # 5 ms late
        told[:, 3:7] /= np.linalg.norm(told[:, 3:7], axis=1)[:, None]
        told[:, :3] += 2e-5 * g.normal(size=(len(told), 3))
        told[:, 7:] += np.repeat([5e-4, 1e-3], 3) * g.normal(size=(len(told), 6))
        seen = self._seen(truth, marker, at, fault, size * direction)
        return CellCycle(times[::EVERY], told, truth, seen, stated, at, states[:, 30:])

    def _seen(self, truth, marker, at, fault, moved):
        g, drawn, origin = self.rng, [], np.array([0.5, 0.0, 0.3])
        last, n = min(at['unseen'], len(truth) * 0.01 - 0.01), self.rng.normal(size=6)
        memory = math.exp(-1.0 / 30.0 / 0.05) if self.sensor == 'memory' else 0.0
        for t in np.arange(at['seen'], last, 1.0 / 30.0):
            k, has_fault = round(100.0 * t), t > at['fault']
            o, R = truth[k, :3], Rotation.from_quat(truth[k, 3:])
            speed = np.linalg.norm(o - truth[max(k - 3, 0), :3]) / 0.03
            o, R = o + R.apply(marker[:3]), R * Rotation.from_rotvec(marker[3:])
            world = Rotation.from_rotvec(self.camera[3:])
            o, R = world.apply(o - origin) + origin + self.camera[:3], world * R
            if fault == 'camera' and has_fault:
                o = o + moved
            n = memory * n + math.sqrt(1.0 - memory**2) * g.normal(size=6)
            e = NOISE * n
            if self.sensor == 'view':  # depth is z; errors are waves of the view, and blur
                waves, phases = self.waves
                view = np.r_[o / 0.08, R.as_rotvec() / 0.15]
                e = np.sin(waves @ view + phases).sum(axis=1) / 2.0
                e = e * [4e-4, 4e-4, 3e-3, 4e-3, 4e-3, 2e-3] * (
                    1.0 + speed * np.array([1.0, 1.0, 1.0, 5.0, 5.0, 1.0]))
                e += [1e-4, 1e-4, 4e-4, 3e-3, 3e-3, 1e-3] * n
            if self.sensor != 'corners':
                o, R = o + e[:3], R * Rotation.from_rotvec(e[3:])
            if self.sensor in ('view', 'corners'):
                o, R = self._detected(o, R, speed)
            stamp = 0.01 * k + 5e-3 * g.normal()
            if fault == 'latency' and has_fault:
                stamp += np.linalg.norm(moved)
            arrival = max(stamp, t) + g.uniform(0.03, 0.06)
            if g.random() > 0.02:
                drawn.append((stamp, arrival, tuple(o.tolist()), tuple(R.as_quat().tolist())))
        return sorted(drawn)

    def _detected(self, o, R, speed):
        """
        Return the pose of a tag in the axes of the camera, for 'corners' with their noise.

        One pose in a hundred is the second solution: the tag flips about the line of sight.
        """
        o, R = DOWN @ (o - CAMERA), DOWN @ R.as_matrix()
        seen = _corners(o, R)
        if self.sensor == 'corners':
            blur = 30.0 * (speed / np.linalg.norm(o) * EXPOSURE)**2
            seen += math.hypot(CORNER_NOISE, blur) * self.rng.normal(size=8)
        if self.rng.random() < 0.01:
            line = o / np.linalg.norm(o)
            about = np.cross(R[:, 2], line)
            R = Rotation.from_rotvec(
                2.0 * math.copysign(1.0, R[:, 2] @ line) * about).as_matrix() @ R
        o, R = _fitted(o, R, seen)
        return o, Rotation.from_matrix(R)


def _sampled(points, times):
    """Return position, rotation, linear and angular velocity (N, 18) of minimum-jerk moves."""
    o, turn = np.zeros((2, len(times), 3))
    for (a, o0, r0), (b, o1, r1) in zip(points[:-1], points[1:], strict=True):
        part = times >= a if a else times >= -1.0
        s = np.clip((times[part] - a) / (b - a), 0.0, 1.0)[:, None]
        e = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        o[part], turn[part] = o0 + e * (o1 - o0), r0 + e * (r1 - r0)
    R = Rotation.from_rotvec(turn)
    w = np.zeros_like(o)
    w[:-1] = (R[1:] * R[:-1].inv()).as_rotvec() / STEP
    return np.hstack([o, R.as_matrix().reshape(-1, 9), np.gradient(o, STEP, axis=0), w])
