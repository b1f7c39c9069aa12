"""
A package with known true motion, a tool with noisy poses, and a camera; ordinary cells.

In an ordinary cell (`Cell`) parameters have errors, and there may be a fault. The package is
simulated with the model; nothing else is taken from the observer. The noise has a memory, stamps
are late, K, P, mass, centre of mass, inertia and the camera's pose are off.
"""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import quaternion_product
from bellows_ros.core.live.held_package import prepared
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import (
    largest_step,
    moved_by,
    pose_error,
    static_equilibrium,
    substeps_for,
)
from bellows_ros.core.model.kernels import advance, tool_at, tool_segment
from bellows_ros.core.model.structure import composed
from bellows_ros.core.observer.observer import Observer
from bellows_ros.core.parameters.checks import resolve
import numpy as np

from ...cell.cup import CUP, PACKAGE

PERIOD_NS = 4_000_000
NOISE = np.repeat([2e-3, 1e-2], 3)
SETTINGS = {
    'package.mass': 1.8, 'package.com': [0.0, 0.0, -0.03],
    'package.inertia': [0.00438, 0.00654, 0.00984, 0.0, 0.0, 0.0],
    'tool_noise': (2e-5, 1e-4),
    'measured.camera_std': [0.0, 0.0], 'measured.marker_std': [0.0, 0.0],
    'measured.latency': [0.0, 0.0], 'payload.estimate': False,
    'cup.stiffness_std': (1e-9 * np.eye(6)).ravel().tolist(),
    'cup.damping_std': (1e-9 * np.eye(6)).ravel().tolist(),
    'package.mass_std': 1e-9, 'package.com_std': [1e-12] * 3,
    'package.inertia_std': [1e-12] * 3 + [0.0] * 3,
}


def values(**more):
    """Return all parameters; an estimated payload has no stated mass."""
    if more.get('payload__estimate'):
        more = {'package__mass_std': -1.0, 'package__com_std': [-1.0] * 3, **more}
    return resolve({**SETTINGS, **{k.replace('__', '.'): v for k, v in more.items()}}, ())


def observer(package=PACKAGE, cup=CUP, **more):
    """Give an observer of the package."""
    made = Observer(values(**more))
    made.set_model(*prepared(cup, package, 9.81)[:3])
    return made


def tool_motion(rng, seconds, size=0.05, period_ns=PERIOD_NS):
    """Give the tool's states: sines along all axes and about them, that begin at rest."""
    t = np.arange(0.0, seconds, period_ns * 1e-9)
    part = np.tanh(t / 0.3)
    ramp, ramp_rate = part**2, 2.0 * part * (1.0 - part**2) / 0.3
    position, velocity = np.zeros((2, len(t), 3))
    for axis in range(3):
        for f in rng.uniform(0.3, 1.5, 2):
            w, phase = 2 * np.pi * f, rng.uniform(0, 2 * np.pi)
            a = size / (1 + axis)
            position[:, axis] += a * ramp * np.sin(w * t + phase)
            velocity[:, axis] += a * (
                ramp * w * np.cos(w * t + phase) + ramp_rate * np.sin(w * t + phase))
    yaw = 0.3 * ramp * np.sin(3.0 * t)
    rate = 0.3 * (ramp * 3.0 * np.cos(3.0 * t) + ramp_rate * np.sin(3.0 * t))
    return _stamps_and_states(position, velocity, yaw, rate, period_ns)


def pick_and_place(rng, seconds, period_ns=PERIOD_NS):
    """Return the tool's states in pick-and-place: moves up to 0.6 m, rotations, standstills."""
    t, n = np.arange(0.0, seconds, period_ns * 1e-9), 1 + round(seconds)
    targets = np.r_[np.zeros((1, 4)), rng.uniform(-1.0, 1.0, (n, 4)) * (0.25, 0.25, 0.1, 0.5)]
    lasts, rests = rng.uniform(0.8, 1.4, n), rng.uniform(0.3, 1.0, n)
    begins = 0.5 + np.cumsum(np.r_[0.0, lasts[:-1] + rests[:-1]])
    at, rate = np.zeros((2, len(t), 4))
    for begin, last, step in zip(begins, lasts, np.diff(targets, axis=0), strict=True):
        s = np.clip((t - begin) / last, 0.0, 1.0)[:, None]
        at += step * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        rate += step * 30.0 * s**2 * (1.0 - s)**2 / last
    return _stamps_and_states(at[:, :3], rate[:, :3], at[:, 3], rate[:, 3], period_ns)


def _stamps_and_states(position, velocity, yaw, rate, period_ns):
    """Give the tool's states, with the velocity (m/s) in axes of the world."""
    states = []
    for o, v, a, r in zip(position, velocity, yaw.tolist(), rate.tolist(), strict=True):
        c, s = np.cos(a), np.sin(a)
        body_v = np.array([c * v[0] + s * v[1], -s * v[0] + c * v[1], v[2]])
        states.append((tuple(o.tolist()), (0.0, 0.0, float(np.sin(a / 2)), float(np.cos(a / 2))),
                       tuple(body_v.tolist()), (0.0, 0.0, r)))
    return np.arange(len(yaw)) * period_ns + 1_000_000_000, states


def truth(tool, package=PACKAGE, cup=CUP, start=None, change=None, period_ns=PERIOD_NS):
    """Give the package's true states; change (k, body, model) is made at sample k."""
    model = model_tuple(cup, package, 9.81)
    h = period_ns * 1e-9
    substeps = substeps_for(h, largest_step(model))
    body = start or static_equilibrium(model, tool[0])
    out = [body]
    for k in range(1, len(tool)):
        if change is not None:
            before = model
            body, model = change(k, body, model)
            if model != before:
                substeps = substeps_for(h, largest_step(model))
        body = advance(model, body, tool[k - 1], tool[k], h, substeps)
        out.append(body)
    return out


def later(state, theta, start, end, seconds):
    """Return a later state for given model parameters, with the wrench as many small impulses."""
    t = np.zeros(25)
    t[:len(theta)] = theta[:25]
    K, P, S = (np.diag(np.exp(0.5 * s)) @ M @ np.diag(np.exp(0.5 * s)) for M, s in (
        (CUP.stiffness, t[10:16]), (CUP.damping, t[16:22]),
        (0.5 * np.trace(PACKAGE.inertia) * np.eye(3) - PACKAGE.inertia, t[22:])))
    cup, grown = Cup(K, P, CUP.length), np.exp(t[0])
    package = Package(
        PACKAGE.mass * grown, grown * (np.trace(S) * np.eye(3) - S), PACKAGE.com + t[1:4])
    model = model_tuple(cup, package, 9.81)
    force, moment = grown * t[4:7], grown * t[7:10]
    push = np.concatenate([
        force / package.mass,
        np.linalg.solve(package.inertia, moment - np.cross(package.com, force))])
    steps = 4 * substeps_for(seconds, largest_step(model))
    segment = tool_segment(start, end, seconds)
    tools = [start, *(tool_at(segment, (i + 1) / steps) for i in range(steps))]
    for i in range(steps):
        state = moved_by(state, np.concatenate([np.zeros(6), 0.5 * push * seconds / steps]))
        state = advance(model, state, tools[i], tools[i + 1], seconds / steps, 1)
        state = moved_by(state, np.concatenate([np.zeros(6), 0.5 * push * seconds / steps]))
    return state


def with_noise(rng, body, std):
    """Give a pose of a body with noise in its own axes."""
    return moved_by(body, np.concatenate([rng.normal(size=6) * std, np.zeros(6)]))


def error_of(known, body):
    """Return the change (12,) from one state, such as an observer's, to another."""
    return np.concatenate([
        *pose_error(known, body[0], body[1]),
        np.subtract(body[2], known[2]), np.subtract(body[3], known[3])])


def measured(made, stamp_ns, body):
    """Give the measured pose of a body."""
    return made.sensor.measurement(int(stamp_ns), body[0], body[1])


def follow(made, stamps, tool, start, came, before=None, after=None):
    """
    Follow the tool; arrived poses (k: [(stamp, pose), ...]) are used at its sample k.

    Starts with a body at the first sample, unless it has started.
    """
    if start is not None:
        made.start(int(stamps[0]), tool[0], start)
    for k in range(1, len(tool)):
        if before is not None:
            before(k)
        made.follow(int(stamps[k]), tool[k - 1], tool[k])
        for stamp_ns, pose in came.get(k, []):
            seen = measured(made, stamp_ns, pose)
            if seen != 'repeated':
                made.update(seen)
        if after is not None:
            after(k)


def at_once(stamps, poses):
    """Return measured poses that arrive at the sample of their measurement."""
    return {k: [(stamps[k], pose)] for k, pose in poses.items()}


CELL_PERIOD_NS = 8_000_000
WORKPLACE = np.array([0.6, 0.3, 0.4])  # m, in the camera's world
TOOL_NOISE = np.repeat([2e-5, 1e-4], 3)
DIAGONAL = np.eye(6).ravel()
EXACTLY_KNOWN = 1e-9
"""A standard deviation that is stated: 0 would stand for a default."""
CALIBRATED = [0.7e-3, 1.4e-3]
ORDINARY = {'measured__camera_std': CALIBRATED, 'measured__marker_std': CALIBRATED,
            'measured__latency': [0.0, 5e-3], 'payload__estimate': True}
"""As a node has it."""
EXACT = {'measured__camera_std': [0.0, 0.0], 'measured__marker_std': [0.0, 0.0],
         'measured__latency': [0.0, 0.0]}


def stated(package, stiffness=0.0, damping=0.0, mass=0.0, com=0.0, inertia=0.0):
    """Give parameters that state relative standard deviations, and that of com (m)."""
    stiffness, damping, mass, com, inertia = (
        max(each, EXACTLY_KNOWN) for each in (stiffness, damping, mass, com, inertia))
    return {
        'cup__stiffness_std': (stiffness * CUP.stiffness.ravel() * DIAGONAL).tolist(),
        'cup__damping_std': (damping * CUP.damping.ravel() * DIAGONAL).tolist(),
        'package__mass_std': mass * package.mass, 'package__com_std': [com] * 3,
        'package__inertia_std': [*(inertia * np.diag(package.inertia)), 0.0, 0.0, 0.0],
    }


LAYOUT = np.array([[0.06, 0.04, 0.0], [0.06, -0.04, 0.0], [-0.06, 0.04, 0.0], [-0.06, -0.04, 0.0]])
"""A gripper of four cups, ..."""
HEAVY = Package(4 * PACKAGE.mass, np.diag([0.06, 0.09, 0.12]), np.array([0.0, 0.0, -0.06]))
"""... each of which bears as much as the single cup does."""
OF_GRIPPER = {
    'cup__layout': LAYOUT.ravel().tolist(), 'package__mass': HEAVY.mass,
    'package__com': HEAVY.com.tolist(),
    'package__inertia': [*np.diag(HEAVY.inertia).tolist(), 0.0, 0.0, 0.0],
}


def gripper_of(cup, layout=LAYOUT):
    """Give the cup that a gripper of several is."""
    return Cup(composed(cup.stiffness, layout), composed(cup.damping, layout), cup.length)


CONDITIONS = {
    'white': {},
    'memory 33 ms': {'memory': 0.033},
    'memory 100 ms': {'memory': 0.1},
    '3 ms late': {'late': 0.003},
    '10 ms late': {'late': 0.01},
    'K 3 %': {'stiffness': 0.03},
    'com 1 mm': {'com': 1e-3},
    'com 2 mm': {'com': 2e-3},
    'camera 1 mm, 2 mrad': {'offset': (1e-3, 2e-3)},
    'mass 2 %': {'mass': 0.02},
    'outliers 3 %': {'outliers': 0.03, 'memory': 0.033},
    'camera drifts 1 mm': {'drift': 1e-3},
    'noise 1.5 times as stated': {'noise': 1.5, 'memory': 0.033},
    'jitter 3 ms, moves and rests': {
        'late': 5e-3, 'jitter': 3e-3, 'motion': pick_and_place},
    'all, small': {'stiffness': 0.01, 'damping': 0.05, 'com': 1e-3, 'late': 0.003,
                   'offset': (5e-4, 0.0), 'memory': 0.033},
}
CONDITIONS['all, small, moves and rests'] = {**CONDITIONS['all, small'], 'motion': pick_and_place}
"""What is wrong in sound work: by how much, in either direction; and how the tool moves."""
OF_CAMERA = ('memory', 'late', 'jitter', 'outliers', 'drift')
"""Memory of the noise, lateness and jitter of stamps (s); part of poses with more noise, of
Student's distribution with 3 degrees of freedom; slow drift to and fro in 90 s (m)."""


class Cell:
    """
    A run of a cell.

    Parameters
    ----------
    seed : int
    seconds : float
    wrong : dict
        Of `CONDITIONS`; stated as standard deviations where there is a parameter for it.
    fault : str
        Cause of an alarm, of `faults`, or none.
    at : float
        Onset of the fault, s.
    rate_hz : float
        Of the camera.
    size : float
        Size of the fault relative to the usual one.
    more : parameters of the observer

    """

    def __init__(self, seed, seconds, wrong, fault='', at=5.0, rate_hz=125 / 4, size=1.0, **more):
        """Simulate the package and its measured poses."""
        self.rng = rng = np.random.default_rng(seed)
        self.at, self.fault, self.size = at, fault, size
        self.wrong = wrong = {
            **dict.fromkeys(OF_CAMERA, 0.0), 'noise': 1.0, 'offset': (0.0, 0.0),
            'motion': tool_motion, **wrong}
        self.stamps, self.tool = wrong['motion'](rng, seconds, period_ns=CELL_PERIOD_NS)
        self.tool = [(tuple(np.add(o, WORKPLACE).tolist()), *rest) for o, *rest in self.tool]
        self.package, self.cup = self._true()
        self.first = round(at * 1e9 / CELL_PERIOD_NS)
        self.body = truth(self.tool, self.package, self.cup, change=self._change(),
                          period_ns=CELL_PERIOD_NS)
        given = {**ORDINARY, **stated(PACKAGE, **{
            name: value for name, value in wrong.items()
            if name not in (*OF_CAMERA, 'noise', 'offset', 'motion')}), **more}
        if given['payload__estimate']:
            given |= {f'package__{name}_std': 0.0 * np.array(given[f'package__{name}_std'])
                      for name in ('mass', 'com') if name not in wrong}
        self.made = observer(**given)
        self.seen = self._seen(round(1e9 / rate_hz / CELL_PERIOD_NS))

    def _across(self, length):
        angle = self.rng.uniform(0.0, 2.0 * np.pi)
        return length * np.array([np.cos(angle), np.sin(angle), 0.0])

    def _direction(self, length):
        direction = self.rng.normal(size=3)
        return length * direction / np.linalg.norm(direction)

    def _true(self):
        """Return the true package and cup."""
        off = {name: self.rng.choice([-1.0, 1.0]) * self.wrong.get(name, 0.0)
               for name in ('mass', 'inertia', 'stiffness', 'damping')}
        com = self._direction(self.wrong.get('com', 0.0))
        if self.fault == 'mass':
            off['mass'] += 0.15 * self.size
        if self.fault == 'worn':
            off['stiffness'] -= 0.12 * self.size
            off['damping'] -= 0.12 * self.size
        mass, inertia = 1.0 + off['mass'], 1.0 + off['inertia']
        return Package(
            mass * PACKAGE.mass, mass * inertia * PACKAGE.inertia, PACKAGE.com + com), Cup(
                (1.0 + off['stiffness']) * CUP.stiffness, (1.0 + off['damping']) * CUP.damping,
                CUP.length)

    def _change(self):
        """Give the change of state and model at each sample of the tool."""
        by = self.size * self._across(3e-3)
        push, spin = self.size * np.array([0.0, 0.15, 0.1]), self.size * np.array([1.0, 1.0, 0.0])

        def model(com, part=1.0):
            cup = Cup(part * self.cup.stiffness, part * self.cup.damping, self.cup.length)
            return model_tuple(cup, Package(self.package.mass, self.package.inertia, com), 9.81)

        def change(k, body, before):
            since = (k - self.first) * CELL_PERIOD_NS * 1e-9
            if since < 0.0 or self.fault in ('', 'mass', 'worn', 'camera', 'turn'):
                return body, before
            if self.fault == 'push':
                is_pushed = k == self.first
                return moved_by(body, is_pushed * np.r_[np.zeros(6), push, spin]), before
            if self.fault == 'slip':
                body = moved_by(body, np.r_[by, np.zeros(9)]) if k == self.first else body
                return body, model(self.package.com + by)
            left = 1.0 - since / 0.15 if self.fault == 'peel' else 0.0
            return body, model(self.package.com, max(left, 1e-9))

        return change

    def _seen(self, every):
        """Give the measured poses (stamp, pose) by sample of the tool."""
        wrong, rng, n = self.wrong, self.rng, np.zeros(6)
        kept = np.exp(-every * CELL_PERIOD_NS * 1e-9 / wrong['memory']) if wrong['memory'] else 0.0
        offset = [self._direction(size) for size in wrong['offset']]
        moved = [self.size * self._direction(5e-3) for _ in range(2)]
        std = wrong['noise'] * NOISE
        out, n = {}, rng.normal(size=6) * std
        for k in range(every, len(self.tool), every):
            n = kept * n + np.sqrt(1.0 - kept**2) * rng.normal(size=6) * std
            body, late = self.body[k], wrong['late']
            if wrong['jitter']:
                late = max(late + wrong['jitter'] * rng.normal(), 0.0)
            if late:
                w = late * 1e9 / CELL_PERIOD_NS
                a, b = self.body[max(k - int(w) - 1, 0)], self.body[max(k - int(w), 0)]
                mean = (1.0 - w % 1.0) * (np.r_[a[2], a[3]] + np.r_[b[2], b[3]]) / 2
                step = mean * CELL_PERIOD_NS * 1e-9
                body = moved_by(a, np.r_[step, np.zeros(6)])
            after = k >= self.first
            if after and self.fault in ('drop', 'peel') and (
                    np.linalg.norm(np.subtract(body[0], self.tool[k][0])) > 0.55):
                break
            if after and self.fault == 'turn':
                body = moved_by(body, np.r_[np.zeros(3), [0.0, 0.0, 0.1 * self.size], np.zeros(6)])
            pose = moved_by(body, np.r_[n, np.zeros(6)])[:2]
            if wrong['outliers'] and rng.random() < wrong['outliers']:
                tail = 1.5 * NOISE * rng.standard_t(3, size=6)
                pose = moved_by((*pose, *body[2:]), np.r_[tail, np.zeros(6)])[:2]
            phase = 2.0 * np.pi * k * CELL_PERIOD_NS * 1e-9 / 90.0
            drift = wrong['drift'] * np.sin(phase + np.arange(3.0))
            pose = _from_elsewhere(pose, offset[0] + drift, offset[1], pivot=WORKPLACE)
            if after and self.fault == 'camera':
                pose = _from_elsewhere(pose, *moved, pivot=WORKPLACE)
            out[k] = [(int(self.stamps[k]), pose)]
        return out

    def run(self, after=None):
        """
        Let the observer follow; give its alarms (cause, s since the fault).

        Calls after(k) when sample k of the tool is done.
        """
        made, rng = self.made, self.rng
        noisy = [with_noise(rng, state, TOOL_NOISE) for state in self.tool]
        made.start(int(self.stamps[0]), noisy[0], truth(noisy[:1])[0])
        for k in range(1, len(noisy)):
            made.follow(int(self.stamps[k]), noisy[k - 1], noisy[k])
            for stamp_ns, pose in self.seen.get(k, []):
                made.update(made.sensor.measurement(stamp_ns, *pose))
            if after is not None:
                after(k)
        return [(alarm.kind, (alarm.stamp_ns - int(self.stamps[0])) * 1e-9 - self.at)
                for alarm in made.alarms]


def _from_elsewhere(pose, shift, turn, pivot):
    """Return a pose measured by a camera that is shifted, and rotated about a pivot."""
    R = exp_so3(np.array(turn))
    q = tuple(rotation_to_quaternion(R).tolist())
    return tuple((R @ (np.array(pose[0]) - pivot) + pivot + shift).tolist()), quaternion_product(
        q, pose[1])
