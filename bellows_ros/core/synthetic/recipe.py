"""
The checked content of a motion file: a motion, and a tracking system.

A recorded pose of a body with the true pose (R, o) in the world is

    o_rec = o + R d + jump + noise,    R_rec = R exp(marker) exp(jump) exp(noise),

where d is the marker frame's origin in the body's axes, and `marker` the rotation vector of the
marker frame in the body. For the package, d includes the pick-up offset of an off-centre grip.
Poses are then rotated into the recording's world.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.parameters.checks import Settings
from bellows_ros.core.recording import alignment
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.synthetic.motion import Motion, motion_from, sample_stamps
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.random import default_rng, Generator, SeedSequence

WORLDS = {world: R.T for world, R in alignment.WORLDS.items()}
"""R_recording_world of each possible world of a recording."""


@dataclass(frozen=True)
class Faults:
    """Jumps or gaps: number, duration of each (s), and size of a jump (m, rad)."""

    count: int = 0
    duration: float = 0.0
    position: float = 0.0
    rotation: float = 0.0


class SimulatedSensor(NamedTuple):
    """
    Tracking of one body.

    Parameters
    ----------
    name : str
        Name for messages.
    rate_hz : float
        Poses per second.
    position_noise, rotation_noise : float
        Standard deviation per axis, m and rad.
    origin : array (3,)
        Origin of the marker frame in the body's axes, m.
    marker : array (3,)
        Rotation vector of the marker frame in the body's axes, rad.
    jumps, dropouts : Faults
        Jumps of tracking, and gaps without messages.
    jitter : float
        Standard deviation of a stamp from the time of its sample, s.
    latency : float
        Delay from a message's stamp to its arrival at the recorder, s.

    """

    name: str
    rate_hz: float
    position_noise: float = 0.0
    rotation_noise: float = 0.0
    origin: Array = np.zeros(3)
    marker: Array = np.zeros(3)
    jumps: Faults = Faults()
    dropouts: Faults = Faults()
    jitter: float = 0.0
    latency: float = 0.0


class TwistSensor(NamedTuple):
    """Measurement of the tool's twist: axes ('world' or 'tool') and noise (m/s, rad/s)."""

    frame: str = 'world'
    linear_noise: float = 0.0
    angular_noise: float = 0.0


class Schedule(NamedTuple):
    """
    Times and faults of a stream's samples.

    Parameters
    ----------
    sampled_ns : int array (N,)
        Times of the sampled poses, ns.
    stamps_ns : int array (N,)
        Stamps of the headers, ns.
    jump : int array (N,)
        Index of the tracking jump of the sample, -1 for none.
    sent : bool array (N,)
        False for a missing message.

    """

    sampled_ns: Stamps
    stamps_ns: Stamps
    jump: Stamps
    sent: Mask


def schedule(
    sensor: SimulatedSensor, duration: float, rest_duration: float, start_ns: int, draw: Generator
) -> Schedule:
    """
    Plan a stream's samples; jumps and gaps never overlap, and the initial rest has none.

    Parameters
    ----------
    sensor : SimulatedSensor
        Tracking of the body.
    duration, rest_duration : float
        Durations of the recording and of the rest at its beginning, s.
    start_ns : int
        Stamp of the beginning, ns.
    draw : Generator
        Generator of random numbers.

    Raises
    ------
    BellowsError
        If the jumps and gaps do not fit into the motion.

    """
    sampled_ns = sample_stamps(sensor.rate_hz, duration, start_ns)
    jump = np.full(len(sampled_ns), -1)
    sent = np.full(len(sampled_ns), True)
    first = int(np.ceil(rest_duration * sensor.rate_hz)) + 1
    lengths = np.maximum(np.round(np.repeat(
        [sensor.jumps.duration, sensor.dropouts.duration],
        [sensor.jumps.count, sensor.dropouts.count]) * sensor.rate_hz).astype(np.int64), 1)
    # There is at least one sample between two events, and at both ends.
    needed = int(lengths.sum()) + len(lengths) + 1
    free = len(sampled_ns) - first - needed
    if len(lengths) and free < 0:
        raise BellowsError(
            f"The outliers and dropouts of '{sensor.name}' need {needed} samples, but there are "
            f'only {max(len(sampled_ns) - first, 0)} after the rest. '
            'Make them fewer or shorter, or the motion longer.')
    order = draw.permutation(len(lengths))
    spread = np.sort(draw.integers(0, max(free, 0) + 1, len(lengths)))
    ends = first + spread + np.cumsum(lengths[order] + 1) - 1
    starts, is_jump = ends - lengths[order], order < sensor.jumps.count
    for number, (start, end) in enumerate(zip(starts[is_jump], ends[is_jump], strict=True)):
        jump[start:end] = number
    for start, end in zip(starts[~is_jump], ends[~is_jump], strict=True):
        sent[start:end] = False
    largest = 0.45 / sensor.rate_hz
    jitter = np.clip(draw.normal(0.0, sensor.jitter, len(sampled_ns)), -largest, largest)
    stamps_ns = sampled_ns + np.round(jitter * NS_PER_S).astype(np.int64)
    return Schedule(sampled_ns, stamps_ns, jump, sent)


def measure_poses(
    truth: Trajectory, sensor: SimulatedSensor, plan: Schedule, world: Array, draw: Generator
) -> Trajectory:
    """
    Return the recorded poses of a body, in the recording's world.

    Parameters
    ----------
    truth : Trajectory
        True poses of the body at `plan.sampled_ns`.
    sensor : SimulatedSensor
        Tracking of the body.
    plan : Schedule
        Times of the samples.
    world : array (3, 3)
        R_recording_world, one of `WORLDS`.
    draw : Generator
        Generator of random numbers.

    """
    count = len(truth)
    noise = draw.normal(size=(count, 6))
    directions = draw.normal(size=(plan.jump.max() + 1, 2, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    sizes = np.array([[sensor.jumps.position], [sensor.jumps.rotation]])
    jumps = np.concatenate([directions * sizes, np.zeros((1, 2, 3))])[plan.jump]  # -1: none
    position = truth.position + apply(truth.rotation, sensor.origin)
    position = position + jumps[:, 0] + sensor.position_noise * noise[:, :3]
    rotation = truth.rotation @ exp_so3(sensor.marker) @ exp_so3(jumps[:, 1])
    rotation = rotation @ exp_so3(sensor.rotation_noise * noise[:, 3:])
    sent = plan.sent
    return Trajectory(plan.stamps_ns[sent], position[sent] @ world.T, (world @ rotation)[sent])


def measure_twists(
    truth: Trajectory, sensor: TwistSensor, marker: Array, plan: Schedule, world: Array,
    draw: Generator
) -> Array:
    """
    Return the recorded twists (M, 6) of the tool tip, m/s and rad/s.

    Parameters
    ----------
    truth : Trajectory
        True motion with body twists at `plan.sampled_ns`.
    sensor : TwistSensor
        Measurement in 'world' axes, or in 'tool' axes, of the tool's marker frame.
    marker : array (3,)
        Rotation vector of the marker frame in the tool's axes, rad.
    plan : Schedule
        Times of the samples.
    world : array (3, 3)
        R_recording_world.
    draw : Generator
        Generator of random numbers.

    """
    axes = world @ truth.rotation if sensor.frame == 'world' else exp_so3(marker).T
    noise = np.repeat([sensor.linear_noise, sensor.angular_noise], 3) * draw.normal(
        size=(len(truth), 6))
    twist = np.asarray(truth.twist)
    return (np.hstack([apply(axes, twist[:, :3]), apply(axes, twist[:, 3:])]) + noise)[plan.sent]


def sensor_from(settings: Settings, origin: Array | None = None) -> SimulatedSensor:
    """
    Return the sensor of settings; see config/motion_example.yaml.

    Parameters
    ----------
    settings : Settings
        The block 'tool' or 'package'; the caller reads its other settings.
    origin : array (3,), optional
        Origin of the marker frame in the body's axes, m; default: zero.

    """
    noise, marker, stamps = (settings.block(name) for name in ('noise', 'marker', 'stamps'))
    return SimulatedSensor(
        settings.path,
        rate_hz=settings.number('rate_hz', unit='Hz', above=0.0, maximum=1e4),
        position_noise=noise.number('position', 0.0, 'm', minimum=0.0),
        rotation_noise=noise.number('rotation', 0.0, 'rad', minimum=0.0),
        origin=np.zeros(3) if origin is None else origin,
        marker=marker.vector('rotation', 3, (0.0, 0.0, 0.0), unit='rad'),
        jumps=_faults(settings.block('outliers'), True),
        dropouts=_faults(settings.block('dropouts'), False),
        jitter=stamps.number('jitter', 0.0, 's', minimum=0.0),
        latency=stamps.number('latency', 0.0, 's', minimum=0.0, maximum=60.0))


def _faults(settings: Settings, moved: bool) -> Faults:
    """Return the jumps or gaps; their sizes must be given if there are any."""
    count = settings.integer('count', 0, maximum=100_000)
    needed = None if count else 0.0
    sizes = (
        settings.number('position', needed, 'm', minimum=0.0),
        settings.number('rotation', needed, 'rad', minimum=0.0, maximum=3.0)) if moved else ()
    return Faults(count, settings.number('duration', needed, 's', minimum=0.0), *sizes)


def twist_sensor_from(settings: Settings) -> TwistSensor | None:
    """Return the twist sensor in the block 'tool.twist'; None if disabled."""
    noise = settings.block('noise')
    sensor = TwistSensor(
        settings.choice('frame', ('world', 'tool'), 'world'),
        noise.number('linear', 0.0, 'm/s', minimum=0.0),
        noise.number('angular', 0.0, 'rad/s', minimum=0.0))
    return sensor if settings.flag('publish', True) else None


START_NS = 1_700_000_000_000_000_000
"""First stamp of a recording of a motion or plan without a date."""

_PURPOSES = ('phases', 'tool plan', 'tool', 'tool twist', 'package plan', 'package')


class Recipe(NamedTuple):
    """
    Recipe of a recording from `START_NS` on: motion, tracking of both bodies, and storage.

    Parameters
    ----------
    motion : Motion
        Motion of the tool.
    tool, package : SimulatedSensor
        Tracking of tool and package.
    tool_twist : TwistSensor or None
        Measurement of the tool's twist; None without a published twist.
    world : str
        One of `WORLDS`.
    storage, zstd : str, bool
        Storage, as `files.bags.write_bag` takes it.
    seed : int
        Seed of all random numbers.
    truth : bool
        Whether the true motion is written in addition to the recording.

    """

    motion: Motion
    tool: SimulatedSensor
    tool_twist: TwistSensor | None
    package: SimulatedSensor
    world: str
    storage: str
    zstd: bool
    seed: int
    truth: bool

    @property
    def frame_id(self) -> str:
        """Frame in every header."""
        return 'world' if self.world == 'z_up' else 'motive'


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
    seed = settings.integer('seed', 0)
    world = settings.choice('world', tuple(WORLDS), 'z_up')
    moving = motion_from(settings, generator(seed, 'phases'))
    tool, package = settings.block('tool'), settings.block('package')
    tracked = np.zeros(3) if package.choice('frame', ('com', 'lip'), 'com') == 'com' else -com
    offset = package.vector('pickup_offset', 2, (0.0, 0.0), unit='m')
    recipe = Recipe(
        motion=moving,
        tool=sensor_from(tool),
        tool_twist=twist_sensor_from(tool.block('twist')),
        package=sensor_from(package, tracked + [*offset, 0.0]),
        world=world,
        storage=settings.choice('storage', ('mcap', 'sqlite3'), 'mcap'),
        zstd=settings.choice('compression', ('none', 'zstd'), 'none') == 'zstd',
        seed=seed,
        truth=settings.flag('truth', False))
    settings.done()
    return recipe


def generator(seed: int, purpose: str) -> Generator:
    """Return random numbers for one purpose, independent of the numbers for other purposes."""
    return default_rng(SeedSequence(seed, spawn_key=(_PURPOSES.index(purpose),)))
