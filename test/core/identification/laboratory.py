"""Recordings of a laboratory with one wrong statement, or with a cup beyond the model."""

from dataclasses import replace

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.lie import apply, exp_so3, quaternion_to_rotation
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.model.equilibrium import static_equilibrium
from bellows_ros.core.model.kernels import advance
from bellows_ros.core.model.simulation import row_state, tool_rows, write_row
from bellows_ros.core.parameters.checks import resolve
from bellows_ros.core.recording.preparation import prepare
from bellows_ros.core.recording.recording import PrepareSettings
from bellows_ros.core.signals.trajectory import PoseStream, Trajectory
import numpy as np
from scipy.signal import butter, lfilter

from ...cell.cup import GRAVITY
from ...cell.motion import shake

Y_UP = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
NOISES = ((2e-5, 5e-5), (1e-4, 3e-4), (1e-4, 5e-4), (3e-4, 1e-3))
COLOUR = 0.026  # s
LARGEST = np.array([6e-3, 6e-3, 6e-3, 0.25, 0.25, 0.25])  # deflection, m and rad
SLIP = 0.05 * LARGEST


def radial(way):
    """Return sizes (6,) of a deflection, of x and y together."""
    size = np.abs(way)
    for pair in ([0, 1], [3, 4]):
        size[pair] = np.hypot(*way[pair])
    return size


def moved(cup, package, tool, stiffness, friction, slipped, leak=0.0, pull=(0.0, 0.0, 0.0)):
    """
    Return the package's motion with a stiffness (6,) of time (0 to 1) and deflection (6,).

    Friction is so many times a spring of that stiffness, at a slider that slips from `SLIP` on.
    The package slips (3,) on the lip, within a two hundredth of the time; the cup lengthens by a
    leak (m) from beginning to end; a cable pulls (3,) the centre of mass, N.
    """
    gravity = np.array([0.0, 0.0, -GRAVITY]) + np.divide(pull, package.mass)
    model = model_tuple(cup, package, gravity)
    since = np.clip(np.linspace(-150.0, 90.0, len(tool)), 0.0, 1.0)
    rows, seconds = tool_rows(tool), tool.seconds
    body = static_equilibrium(model, row_state(rows[0]))
    out = np.empty((len(rows), 13))
    write_row(out[0], body)
    _, length, _, P = model[0]
    before = z = np.zeros(6)
    for k, step in enumerate(np.diff(seconds).tolist()):
        R = quaternion_to_rotation(out[k, 3:7])
        R_E_A = tool.rotation[k].T
        com = package.com + since[k] * slipped
        if since[k] and slipped.any():
            model = model_tuple(cup, replace(package, com=com), gravity)
        o = R_E_A @ (out[k, :3] - R @ com - tool.position[k]) + [0.0, 0.0, length]
        turn = R_E_A @ R
        phi = 0.5 * (turn - turn.T)[[2, 0, 1], [1, 2, 0]]
        deflection = np.concatenate([o, phi])
        K = stiffness(seconds[k] / seconds[-1], deflection).tolist()
        stiff = ((K[0], 0.0, 0.0, 0.0, K[1], 0.0, 0.0, 0.0, K[2]), (0.0,) * 9,
                 (K[3], 0.0, 0.0, 0.0, K[4], 0.0, 0.0, 0.0, K[5]))
        longer = length + leak * seconds[k] / seconds[-1]
        now = (0.5 * longer, longer, stiff, P), model[1], model[2]
        arm = rows[k], rows[k + 1]
        if friction:
            way, before = deflection - (before if k else deflection), deflection
            z = (z + way) / (1.0 + radial(way) / SLIP)
            lip = o - [0.0, 0.0, length], turn
            arm = [dragged(own, *lip, friction * z) for own in arm]
        body = advance(now, body, *map(row_state, arm), step, 1)
        write_row(out[k + 1], body)
    return Trajectory(tool.stamps_ns, out[:, :3], quaternion_to_rotation(out[:, 3:7]))


def dragged(row, o, turn, way):
    """Return a tool row that displaces the lip, which has position o and rotation in the tool."""
    R, back = quaternion_to_rotation(row[3:7]), turn.T @ exp_so3(-way[3:])
    p = row[:3] + R @ (o - turn @ back @ (o + way[:3]))
    return np.concatenate([p, lie.rotation_to_quaternion(R @ turn @ back), row[7:]])


class Laboratory:
    """A cup and a package, their recording, and the stated parameters."""

    def __init__(self, seed, soft=0.0, coloured=False, seconds=10.0, rate_hz=480.0):
        rng = self.rng = np.random.default_rng((11, seed))
        lateral, axial, turning = np.exp(rng.uniform(-0.4, 0.4, 3))
        self.K = np.array([6000.0 * lateral] * 2 + [11000.0 * axial] + [4.2 * turning] * 2
                          + [1.3 * turning])
        self.P = np.diag([60.0, 60.0, 24.0, 0.06, 0.06, 0.1]) * rng.uniform(0.7, 1.3)
        self.length = self.said_length = rng.uniform(0.035, 0.06)
        mass = rng.uniform(1.0, 2.6)
        a, b, h = rng.uniform([0.14, 0.14, 0.03], [0.24, 0.24, 0.08])
        inertia = mass / 12.0 * np.diag([b * b + h * h, a * a + h * h, a * a + b * b])
        self.package = self.said = Package(mass, inertia, (0.0, 0.0, -rng.uniform(0.02, 0.05)))
        self.noise = NOISES[rng.integers(4)], NOISES[rng.integers(3)]
        self.rate_hz, self.coloured = rate_hz, coloured
        self.frame = str(rng.choice(['com', 'lip']))
        self.said_frame, self.said_world, self.world = self.frame, 'z_up', np.eye(3)
        self.late, self.turn = 0.0, {}
        self.apart, self.wander, self.friction = np.zeros(6), np.zeros(3), 0.0
        self.slipped, self.level, self.low_pass_hz = np.zeros(3), np.eye(3), 0.0
        self.leak, self.clock_rate, self.magnified = 0.0, 0.0, 1.0
        self.occluded, self.camera_hz, self.pull = False, rate_hz, np.zeros(3)
        self.motion = shake(duration=seconds, seed=int(rng.integers(1 << 30)))
        self.law = lambda when, deflection: self.K
        self.soften(soft)

    def soften(self, part):
        """Use a spring whose stiffness falls by a fraction up to the largest deflection."""
        self.vary(lambda when, deflection: np.maximum(
            1.0 - part * (radial(deflection) / LARGEST) ** 2, 0.4))

    def vary(self, factor):
        """Multiply the stiffness by a factor of time and deflection."""
        law = self.law
        self.law = lambda *now: law(*now) * factor(*now)

    def say(self, mass=1.0, inertia=1.0, com=0.0):
        """Change the stated package."""
        own = self.said
        self.said = Package(mass * own.mass, inertia * own.inertia, own.com + com)

    def recording(self):
        """Return the recording, prepared with the stated parameters."""
        tool = self.motion.at_rate(self.rate_hz, 0)
        cup = Cup(np.diag(self.K), self.P, self.length)
        tool = _turned(self.level, tool)
        body = moved(cup, self.package, tool, self.law, self.friction, self.slipped,
                     self.leak, self.pull)
        tool, body = (_turned(self.level.T, own) for own in (tool, body))
        package = self._seen('package', body, self.noise[0])
        return prepare(self._seen('tool', tool, self.noise[1]), package, PrepareSettings(
            world=self.said_world, package_frame=self.said_frame, payload=self.said,
            gravity=GRAVITY))

    def _seen(self, name, body, noise):
        """Return a body's poses as they are recorded."""
        p, R, drawn = body.position, body.rotation, self.rng.standard_normal((2, len(body), 3))
        if self.coloured:
            decay = np.exp(-1.0 / (self.rate_hz * COLOUR))
            for i in range(1, len(body)):
                drawn[:, i] = decay * drawn[:, i - 1] + np.sqrt(1 - decay**2) * drawn[:, i]
        if name == 'package':
            p = p - apply(R, self.package.com) if self.frame == 'lip' else p
            turn, middle = exp_so3(self.apart[3:]), p.mean(axis=0)
            p, R = middle + self.apart[:3] + apply(turn, p - middle), turn @ R
            p = self.magnified * (p + body.seconds[:, None] * self.wander)
        R = R @ self.turn.get(name, np.eye(3)) @ exp_so3(noise[1] * drawn[1])
        p = apply(self.world, p + noise[0] * drawn[0])
        if self.low_pass_hz:
            b, a = butter(2, self.low_pass_hz / (self.rate_hz / 2))
            turn = lie.log_so3(R[0].T @ R)
            p, turn = (own[0] + lfilter(b, a, own - own[0], axis=0) for own in (p, turn))
            R = R[0] @ exp_so3(turn)
        late, R = round(1e9 * self.late) if name == 'tool' else 0, self.world @ R
        seen = np.ones(len(p), dtype=bool)
        if self.occluded and name == 'package':  # a jump of 30 mm that ends with a dropout
            at = len(p) // 3
            p[at:at + 40] += [0.03, 0.0, 0.0]
            seen[at + 40:at + 55] = False
        if name == 'package':
            seen &= np.arange(len(p)) % round(self.rate_hz / self.camera_hz) == 0
        stamps = body.stamps_ns + late
        if name == 'tool':
            stamps = stamps + np.rint(
                self.clock_rate * (stamps - stamps[0])).astype(np.int64)
        return PoseStream(name, 'world', stamps[seen], p[seen], R[seen])


def parameters(laboratory):
    """Return the stated parameters of a laboratory."""
    said = laboratory.said
    return resolve({
        'cup.length': laboratory.said_length, 'fit.method': 'output_error',
        'fit.structure': 'axisymmetric', 'recording.package_frame': laboratory.said_frame,
        'recording.world': laboratory.said_world, 'package.mass': said.mass,
        'package.com': said.com.tolist(),
        'package.inertia': said.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()})


def _turned(R, body):
    """Return a motion in a world that is turned by R."""
    return replace(body, position=apply(R, body.position), rotation=R @ body.rotation)


def either(rng, low, high):
    """Return a size with a random sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _time_offset(own):
    own.late = either(own.rng, 3e-3, 60e-3)


def _com_along(own):
    own.frame = own.said_frame = 'com'
    own.say(com=[0.0, 0.0, either(own.rng, 2e-3, 8e-3)])


def _com_aside(own):
    angle, size = own.rng.uniform(0.0, 2.0 * np.pi), own.rng.uniform(3e-3, 8e-3)
    own.say(com=[size * np.cos(angle), size * np.sin(angle), 0.0])


def _length(own):
    own.said_length = own.length + either(own.rng, 1e-3, 4e-3)


def _inertia(own):
    own.say(inertia=float(own.rng.choice([0.5, 0.65, 1.5, 2.0])))


def _world(own):
    if own.rng.random() < 0.5:
        own.world = Y_UP
    else:
        own.said_world = 'motive_y_up'


def _turn_one(own, turn):
    body = str(own.rng.choice(['tool', 'package']))
    own.turn[body] = own.turn.get(body, np.eye(3)) @ exp_so3(turn)


def _frame(own):
    own.said_frame = {'com': 'lip', 'lip': 'com'}[own.frame]


def _worlds(own):
    own.apart = own.rng.normal(size=6) * ([1e-3] * 3 + [8e-3] * 3)


def _far_worlds(own):
    turn = own.rng.normal(size=3)
    turn *= np.radians(own.rng.uniform(10.0, 90.0)) / np.linalg.norm(turn)
    own.apart = np.concatenate([own.rng.normal(size=3), turn])


def _world_drift(own):
    own.wander = _aside(own, own.rng.uniform(2e-3, 6e-3) / 60.0)


def _drift(own):
    part = either(own.rng, 0.2, 0.4)
    own.vary(lambda when, deflection: 1.0 + part * (when - 0.5))


def _friction(own):
    own.friction = own.rng.uniform(0.4, 1.0)


def _oval(own):
    ratio = own.rng.uniform(1.25, 1.5)
    own.K = own.K * [1.0, ratio, 1.0, ratio, 1.0, 1.0]


def _marker(own):
    turn = own.rng.normal(size=3)
    turn *= np.radians(own.rng.choice([2.0, 5.0])) / np.linalg.norm(turn)
    _turn_one(own, turn)


def _aside(own, size):
    angle = own.rng.uniform(0.0, 2.0 * np.pi)
    return size * np.array([np.cos(angle), np.sin(angle), 0.0])


def _far_clocks(own):
    own.late = either(own.rng, *((0.11, 1.0) if own.rng.random() < 0.5 else (1.0, 8.0)))


def _pull(own):
    own.pull = _aside(own, 2.0)


FAULTS = {
    'time offset': (_time_offset, 'time_offset'),
    'centre of mass along z': (_com_along, 'com'),
    'centre of mass aside': (_com_aside, 'com'),
    'length': (_length, 'length'),
    'inertia': (_inertia, 'inertia'),
    'world': (_world, 'sideways'),
    'package frame': (_frame, 'package_marker'),
    'two worlds': (_worlds, 'package_world'),
    'drift': (_drift, 'unknown'),
    'camera drifts': (_world_drift, 'unknown'),
    'soft spring': (lambda own: own.soften(own.rng.uniform(0.3, 0.5)), 'unknown'),
    'friction': (_friction, 'unknown'),
    'structure': (_oval, 'unknown'),
    'leak': (lambda own: setattr(own, 'leak', own.rng.uniform(4e-4, 1.5e-3)), 'length_drift'),
    'clocks drift': (lambda own: setattr(own, 'clock_rate', either(own.rng, 6e-4, 2e-3)),
                     'clock_rate'),
    'scale': (lambda own: setattr(own, 'magnified', 1.0 + either(own.rng, 0.01, 0.03)), 'scale'),
    'two worlds far apart': (_far_worlds, 'package_world'),
    'marker frame turned': (_marker, 'package_marker'),
    'package slipped': (lambda own: setattr(own, 'slipped', _aside(own, 3e-3)), 'slip'),
    'gravity tilted': (lambda own: setattr(own, 'level', exp_so3(_aside(own, np.radians(10.0)))),
                       'gravity.direction'),
    'clocks far apart': (_far_clocks, 'time_offset'),
    'mass 10 %': (lambda own: own.say(mass=float(own.rng.choice([0.9, 1.1]))), 'inertia'),
    'occlusion beside a dropout': (lambda own: setattr(own, 'occluded', True), 'sound'),
    'side pull': (_pull, 'gravity'),
}
"""What makes a laboratory faulty, and the name of the cause, or words of the error."""
