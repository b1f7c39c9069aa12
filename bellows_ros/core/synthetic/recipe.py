"""The content of a motion file, checked."""

from collections.abc import Mapping
from dataclasses import dataclass
import re

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.synthetic import sensing
from bellows_ros.core.synthetic.motion import Motion, motion_from
from bellows_ros.core.synthetic.sensing import Sensor, TwistSensor
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
        start_ns=settings.whole('start_time_ns', START_NS, least=10**9, most=2**62),
        truth=settings.flag('truth', False),
        releases=releases,
        pickup=pickup,
    )
    settings.done()
    return recipe


def _releases(settings: Settings, duration: float) -> tuple[tuple[float, ...], float]:
    """Return when the valve is switched off, and how long after it the next package hangs."""
    times = settings.numbers('times', 's', least=0.0, default=())
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
