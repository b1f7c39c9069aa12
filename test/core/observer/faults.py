"""Packages, cups and cameras with which something goes wrong."""

from bellows_ros.core.geometry.lie import exp_so3, rotation_to_quaternion
from bellows_ros.core.geometry.tuples import quaternion_product
from bellows_ros.core.model.cup_package import Cup, model_tuple, Package
from bellows_ros.core.observer.alarms import Alarms, FIRSTS, LOOKED_FOR
from bellows_ros.core.observer.filter import changed
from bellows_ros.core.observer.observer import GATE
import numpy as np
from scipy.stats import norm

from .cases import (
    at_once,
    CUP,
    follow,
    NOISE,
    observer,
    PACKAGE,
    PERIOD_NS,
    tool_motion,
    truth,
    with_noise,
)

KINDS = 'slip', 'leak', 'wear', 'payload', 'lost', 'camera'
AT = 3.0  # s, when those that set in do
EVERY = 8
FIRST = round(AT / (PERIOD_NS * 1e-9))
SLIP = 3e-3  # m


def across(rng, length):
    """Give a vector of a length across the lip."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return length * np.array([np.cos(angle), np.sin(angle), 0.0])


def wrong_from_the_start(kind, rng):
    """Give the package and the cup that are there indeed."""
    if kind == 'payload':
        com = PACKAGE.com + across(rng, rng.uniform(0.005, 0.015))
        return Package(1.1 * PACKAGE.mass, 1.1 * PACKAGE.inertia, com), CUP
    if kind == 'wear':
        return PACKAGE, Cup(rng.uniform(0.6, 0.75) * CUP.stiffness, CUP.damping, CUP.length)
    return PACKAGE, CUP


def setting_in(kind, rng):
    """Give the change of state and model at each sample."""
    by, rate = across(rng, SLIP), rng.uniform(4e-3, 10e-3)

    def model(com=PACKAGE.com, part=1.0, longer=0.0):
        cup = Cup(part * CUP.stiffness, part * CUP.damping, CUP.length + longer)
        return model_tuple(cup, Package(PACKAGE.mass, PACKAGE.inertia, com), 9.81)

    models = {
        'slip': lambda k: model(PACKAGE.com + by),
        'leak': lambda k: model(longer=rate * (k - FIRST) * PERIOD_NS * 1e-9),
        'lost': lambda k: model(part=1e-9),
    }

    def change(k, body, before):
        if k < FIRST or kind not in models:
            return body, before
        if kind == 'slip' and k == FIRST:
            body = changed(body, np.r_[by, np.zeros(9)])
        return body, models[kind](k)

    return change


def frame_moved(rng):
    """Give a function that gives a pose as a camera sees it that was pushed."""
    direction = rng.normal(size=3)
    by = rng.uniform(5e-3, 20e-3) * direction / np.linalg.norm(direction)
    x, y, z, w = rotation_to_quaternion(exp_so3(rng.normal(size=3) * 0.01)).tolist()
    return lambda pose: (
        tuple((np.array(pose[0]) + by).tolist()), quaternion_product((x, y, z, w), pose[1]))


def work(seed, kind='', seconds=5.0, tool_noise=(2e-5, 1e-4)):
    """Give the alarms (cause, s since the fault) in a motion with a fault, '' for none."""
    made, start_ns = observed(seed, kind, seconds, tool_noise)
    return [(a.cause, (a.stamp_ns - start_ns) * 1e-9 - AT) for a in made.alarms]


def most_within(seconds, rate_per_hour, seed):
    """
    Give the largest part of slips that any test finds in a time at a rate of false alarms.

    Neyman and Pearson's: direction, size and time of the slip are known to it, and what it makes
    of the innovations. It may be wrong as often as alarms fall into such a time by chance.
    """
    made, start_ns = observed(seed, '', AT + seconds, (2e-5, 1e-4))
    alarms = made._alarms
    onset_ns = start_ns + round(AT * 1e9)
    slot = min(range(len(alarms._onsets)), key=lambda k: abs(alarms._onsets[k] - onset_ns))
    assert abs(alarms._onsets[slot] - onset_ns) <= EVERY * PERIOD_NS
    first = FIRSTS[LOOKED_FOR.index(next(c for c in LOOKED_FOR if c.name == 'slip'))]
    J = alarms._information[first:first + 2, :2, slot - 1]
    distance = SLIP * np.sqrt(np.trace(J) / 2)
    return norm.cdf(distance - norm.isf(rate_per_hour * seconds / 3600))


class Kept(Alarms):
    """Keep all that there was to look at."""

    def __init__(self):
        """Keep nothing yet."""
        super().__init__(1.0)
        self.looked_at = []

    def step(self, *given):
        """Keep what is given."""
        self.looked_at.append(given)
        return super().step(*given)


def by_chance(hours, seed, allowed=1.0):
    """
    Give the alarms (cause, hours since the beginning) in white innovations, as sound work has.

    What faults would make of them is that of a motion of 20 s, over and over.
    """
    made, _ = observed(seed, '', 20.0, (2e-5, 1e-4), Kept())
    given = made._alarms.looked_at[30:]
    colours = [np.linalg.inv(found.whitener) for _, _, found, _ in given]
    rng, alarms, found = np.random.default_rng(seed), Alarms(allowed), []
    for n in range(round(hours * 3.6e12 / (EVERY * PERIOD_NS))):
        _, passage, innovation, _ = given[n % len(given)]
        white = rng.normal(size=6)
        distance = white @ white
        alarm = alarms.step(
            n * EVERY * PERIOD_NS, passage, innovation._replace(
                y=colours[n % len(given)] @ white, distance=distance), distance < GATE)
        if alarm is not None:
            found.append((alarm.cause, alarm.stamp_ns / 3.6e12))
    return found


def observed(seed, kind, seconds, tool_noise, alarms=None):
    """Give an observer of a motion with a fault, and when it began, ns."""
    rng = np.random.default_rng(seed)
    stamps, tool = tool_motion(rng, seconds)
    body = truth(tool, *wrong_from_the_start(kind, rng), change=setting_in(kind, rng))
    moved = frame_moved(rng)
    seen = {k: with_noise(rng, body[k], NOISE) for k in range(EVERY, len(tool), EVERY)}
    if kind == 'camera':
        seen = {k: moved(pose) if k >= FIRST else pose for k, pose in seen.items()}
    noisy = [with_noise(rng, state, np.repeat(tool_noise, 3)) for state in tool]
    made = observer()
    made._alarms = alarms or made._alarms
    follow(made, stamps, noisy, truth(noisy[:1])[0], at_once(stamps, seen))
    return made, int(stamps[0])
