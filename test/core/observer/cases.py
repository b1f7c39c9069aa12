"""A package with known true motion, a tool with noisy poses, and a camera."""

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
