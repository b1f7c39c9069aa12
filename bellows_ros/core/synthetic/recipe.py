"""
The content of a motion file, checked, and the recording with tosses that it can describe.

In such a recording packages hang, are released, fly and land, and the next is picked up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
import re
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import quaternion_to_rotation
from bellows_ros.core.model.grip import Grip
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.simulation import STILL, write_row
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.signals.trajectory import Trajectory
from bellows_ros.core.synthetic import sensing
from bellows_ros.core.synthetic.motion import Motion, motion_from
from bellows_ros.core.synthetic.sensing import Sensor, TwistSensor
from bellows_ros.core.toss.free_flight import flight, ROTATION_PER_STEP
from bellows_ros.core.toss.landing import changed
from bellows_ros.core.toss.release import HeldMotion, Law, LONGEST_WAIT, Release, toss
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.random import default_rng, Generator, SeedSequence

TOPICS = {
    'tool_pose': '/tool_arm/pose',
    'tool_twist': '/tool_arm/twist',
    'package_pose': '/package/pose',
    'valve': '/vacuum/valve',
}
FRAME_IDS = {'z_up': 'world', 'motive_y_up': 'motive'}
START_NS = 1_700_000_000_000_000_000

_PURPOSES = ('phases', 'tool plan', 'tool', 'tool twist', 'package plan', 'package', 'release')
_TOPIC = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


@dataclass(frozen=True, eq=False)
class Recipe:
    """
    How a recording is made: the motion, how both bodies are tracked, and how it is stored.

    Parameters
    ----------
    motion : Motion
        Of the tool.
    tool, package : Sensor
        How each is tracked.
    tool_twist : TwistSensor or None
        How the tool's twist is measured; None where it is not published.
    world : str
        Of `core.sensing.WORLDS`.
    frame_id : str
        In every header.
    topics : mapping
        Topic of 'tool_pose', 'tool_twist', 'package_pose' and 'valve'.
    storage, zstd : str, bool
        As `files.bag_writer.write_bag` takes them.
    seed : int
        Of all random numbers.
    start_ns : int
        First stamp, ns.
    truth : bool
        Whether the true motion is written beside the recording.
    releases : tuple of float
        When the valve is switched off, s since the beginning.
    pickup : float
        How long after that the next package hangs, s.

    """

    motion: Motion
    tool: Sensor
    tool_twist: TwistSensor | None
    package: Sensor
    world: str
    frame_id: str
    topics: Mapping[str, str]
    storage: str
    zstd: bool
    seed: int
    start_ns: int
    truth: bool
    releases: tuple[float, ...]
    pickup: float


def read_recipe(motion: Mapping[str, object], com: Array) -> Recipe:
    """
    Check the content of a motion file.

    Parameters
    ----------
    motion : mapping
        Parsed YAML.
    com : array (3,)
        Centre of mass B in the lip frame S, m.

    Raises
    ------
    BellowsError
        If a setting is missing, unknown or not allowed.

    """
    settings = Settings(motion)
    seed = settings.whole('seed', 0)
    world = settings.choice('world', tuple(sensing.WORLDS), 'z_up')
    moving = motion_from(settings, generator(seed, 'phases'))
    tool, package = settings.block('tool'), settings.block('package')
    tracked = np.zeros(3) if package.choice('frame', ('com', 'lip'), 'com') == 'com' else -com
    offset = package.vector('pickup_offset', 2, (0.0, 0.0), unit='m')
    releases, pickup = _releases(settings.block('release'), moving.duration)
    recipe = Recipe(
        motion=moving,
        tool=sensing.sensor_from(tool),
        tool_twist=sensing.twist_sensor_from(tool.block('twist')),
        package=sensing.sensor_from(package, tracked + [*offset, 0.0]),
        world=world,
        frame_id=settings.text('frame_id', FRAME_IDS[world]),
        topics=_topics(settings.block('topics')),
        storage=settings.choice('storage', ('mcap', 'sqlite3'), 'mcap'),
        zstd=settings.choice('compression', ('none', 'zstd'), 'none') == 'zstd',
        seed=seed,
        start_ns=settings.whole('start_time_ns', START_NS, minimum=10**9, maximum=2**62),
        truth=settings.flag('truth', False),
        releases=releases,
        pickup=pickup,
    )
    settings.done()
    return recipe


def _releases(settings: Settings, duration: float) -> tuple[tuple[float, ...], float]:
    """Return when the valve is switched off, and how long after it the next package hangs."""
    times = settings.numbers('times', 's', minimum=0.0, default=())
    pickup = settings.number('pickup', 2.0, 's', above=0.0)
    if (np.diff(times) <= pickup).any():
        raise settings.refuse(
            'times', f'further apart than release.pickup, {pickup:g} s, and in order',
            times.tolist())
    if (times >= duration).any():
        raise settings.refuse('times', f'before the end at {duration:g} s', times.tolist())
    return tuple(times.tolist()), pickup


def _topics(settings: Settings) -> dict[str, str]:
    """Return the topics, with a leading slash, all different."""
    topics = {}
    for role, default in TOPICS.items():
        name = settings.text(role, default)
        topics[role] = name if name.startswith('/') else f'/{name}'
        if not _TOPIC.fullmatch(topics[role]):
            raise settings.refuse(role, 'a topic name such as ' + default, name)
        if list(topics.values()).count(topics[role]) > 1:
            raise settings.refuse(role, 'a topic no other stream has', name)
    return topics


def generator(seed: int, purpose: str) -> Generator:
    """Return random numbers for one purpose, which do not depend on how many others draw."""
    return default_rng(SeedSequence(seed, spawn_key=(_PURPOSES.index(purpose),)))


class Thrown(NamedTuple):
    """A toss with its valve; times are s since the beginning of the recording."""

    valve_time: float
    release_time: float
    landing_time: float
    law: Law
    """As it was drawn, in the order of `RELEASE_NAMES`."""


@dataclass(frozen=True, eq=False)
class Truth:
    """
    True trajectories of tool E and package B at common stamps, with body twists.

    Tossed, the package hangs where `held`; where it lies after a toss it is not `tracked`.
    """

    tool: Trajectory
    package: Trajectory
    held: Mask
    tracked: Mask
    tosses: tuple[Thrown, ...] = ()

    def at(self, stamps_ns: Stamps) -> 'Truth':
        """Return the samples at some of the stamps."""
        index = np.searchsorted(self.tool.stamps_ns, stamps_ns)
        return replace(
            self, tool=self.tool.select(index), package=self.package.select(index),
            held=self.held[index], tracked=self.tracked[index])


def tossed(
    model: ModelTuple, grip: Grip | None, release: Release, tool: Trajectory,
    times: Sequence[float], pickup: float, changes: Array,
) -> Truth:
    """
    Simulate a recording in which packages are tossed.

    Parameters
    ----------
    model, grip : tuple
        As the kernels take them.
    release : Release
        Valve, package and floor.
    tool : Trajectory
        E with body twists.
    times : sequence of float
        When the valve is switched off, s since the first stamp, in order.
    pickup : float
        So long (s) after that the next package hangs at rest.
    changes : array (N, 8)
        By how much the law of release of each toss differs; see `changed`.

    Raises
    ------
    BellowsError
        If the tool moves at a pick-up, a toss cannot be, or does not end before the next pick-up.

    """
    count, seconds = len(tool), tool.seconds
    rows, tosses = np.empty((count, 13)), []
    held, tracked = np.ones((2, count), dtype=bool)
    begins = np.searchsorted(seconds, [0.0, *np.add(times, pickup)]).tolist()
    for k, (first, last) in enumerate(zip(begins, [*begins[1:], count], strict=True)):
        if first >= count:
            break
        part, start = slice(first, last), float(seconds[first])
        switched = times[k] - start if k < len(times) else math.inf
        here = tool.select(slice(first, None))
        try:
            _require_rest(here)
            hanging = HeldMotion(model, grip, here, until=switched + LONGEST_WAIT)
            t = seconds[part] - start
            at = np.searchsorted(hanging.times, t - 1e-9)
            rows[part] = hanging.states[np.minimum(at, len(hanging.times) - 1)]
            if k == len(times):
                break
            drawn = changed(release, changes[k])
            found = toss(hanging, drawn, switched)
            hanging = hanging.released(drawn, switched)
            rows[part] = hanging.states[np.minimum(at, len(hanging.times) - 1)]
            if found.landing_time > t[-1] and last < count:
                raise BellowsError(
                    f'The package lands {found.landing_time - switched:.3g} s after the valve is '
                    f'switched, but the next one is picked up after {pickup:g} s. Raise '
                    'release.pickup.')
        except BellowsError as error:
            raise BellowsError(f'Package {k + 1}, held from {start:.3g} s on: {error}') from None
        held[part] = t <= found.release_time
        tracked[part] = t <= found.landing_time
        body, now = found.release, found.release_time
        for j in np.flatnonzero(tracked[part] & ~held[part]):
            body = flight(model[1], model[2], body, float(t[j] - now), ROTATION_PER_STEP)
            now = float(t[j])
            write_row(rows[first + j], body)
        write_row(resting := np.zeros(13), (*found.landing[:2], (0.0,) * 3, (0.0,) * 3))
        rows[part][t > found.landing_time] = resting
        tosses.append(Thrown(
            times[k], start + found.release_time, start + found.landing_time, drawn.law))
    package = Trajectory(
        tool.stamps_ns, rows[:, :3], quaternion_to_rotation(rows[:, 3:7]), rows[:, 7:])
    return Truth(tool, package, held, tracked, tuple(tosses))


def _require_rest(tool: Trajectory) -> None:
    """Refuse a tool that moves where a package is picked up."""
    assert tool.twist is not None
    speed, rate = (float(np.linalg.norm(part)) for part in np.split(tool.twist[0], 2))
    if speed > STILL[0] or rate > STILL[1]:
        raise BellowsError(
            f'the tool moves at {speed:.3g} m/s and {rate:.3g} rad/s there, but picks up '
            'packages only at rest. Change release.pickup, or let the tool wait.')
