"""
An ordinary cell: a camera, parameters with errors, and faults.

The package is simulated with the model; nothing else is taken from the observer. Its noise has a
memory, stamps are late, K, P, mass, centre of mass, inertia and the camera's pose are off.
"""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import quaternion_product
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import moved_by
from bellows_ros.core.model.structure import composed
import numpy as np

from .cases import (
    CUP,
    NOISE,
    observer,
    PACKAGE,
    pick_and_place,
    tool_motion,
    truth,
    with_noise,
)

PERIOD_NS = 8_000_000
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
        self.stamps, self.tool = wrong['motion'](rng, seconds, period_ns=PERIOD_NS)
        self.tool = [(tuple(np.add(o, WORKPLACE).tolist()), *rest) for o, *rest in self.tool]
        self.package, self.cup = self._true()
        self.first = round(at * 1e9 / PERIOD_NS)
        self.body = truth(self.tool, self.package, self.cup, change=self._change(),
                          period_ns=PERIOD_NS)
        given = {**ORDINARY, **stated(PACKAGE, **{
            name: value for name, value in wrong.items()
            if name not in (*OF_CAMERA, 'noise', 'offset', 'motion')}), **more}
        if given['payload__estimate']:
            given |= {f'package__{name}_std': 0.0 * np.array(given[f'package__{name}_std'])
                      for name in ('mass', 'com') if name not in wrong}
        self.made = observer(**given)
        self.seen = self._seen(round(1e9 / rate_hz / PERIOD_NS))

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
            off['mass'] += 0.1 * self.size
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
            since = (k - self.first) * PERIOD_NS * 1e-9
            if since < 0.0 or self.fault in ('', 'mass', 'camera', 'turn'):
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
        kept = np.exp(-every * PERIOD_NS * 1e-9 / wrong['memory']) if wrong['memory'] else 0.0
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
                w = late * 1e9 / PERIOD_NS
                a, b = self.body[max(k - int(w) - 1, 0)], self.body[max(k - int(w), 0)]
                mean = (1.0 - w % 1.0) * (np.r_[a[2], a[3]] + np.r_[b[2], b[3]]) / 2
                step = mean * PERIOD_NS * 1e-9
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
            phase = 2.0 * np.pi * k * PERIOD_NS * 1e-9 / 90.0
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
