"""
A model of a tracking system: marker frames, noise, outliers, dropouts, stamps.

A recorded pose of a body with the true pose (R, o) in the world is

    o_rec = o + R d + jump + noise,    R_rec = R exp(marker) exp(jump) exp(noise),

where d is where the marker frame's origin lies in the body's axes, and `marker` the rotation
vector by which that frame is turned against the body. For the package, d holds the pick-up offset:
the plate was not gripped at the markers' centre. Poses are then turned into the recording's world.
"""

from dataclasses import dataclass, field

from bellows_ros.core.geometry.arrays import Array, Mask, Stamps
from bellows_ros.core.geometry.lie import apply, exp_so3
from bellows_ros.core.parameters.settings import Settings
from bellows_ros.core.recording import alignment
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
from bellows_ros.core.synthetic.motion import sample_stamps
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.random import Generator

Indices = Stamps

WORLDS = {world: R.T for world, R in alignment.WORLDS.items()}
"""R_recording_world of each possible world of a recording."""

FASTEST = 10_000.0
"""Highest rate of a stream, Hz."""
LARGEST_JITTER = 0.45
"""Jitter is limited to this fraction of the sampling time, so that stamps stay in order."""


@dataclass(frozen=True)
class Faults:
    """Jumps or gaps: how many, how long each (s), and how far a jump goes (m, rad)."""

    count: int = 0
    duration: float = 0.0
    position: float = 0.0
    rotation: float = 0.0


@dataclass(frozen=True, eq=False)
class Sensor:
    """
    How one body is tracked.

    Parameters
    ----------
    name : str
        For messages.
    rate_hz : float
        Poses per second.
    position_noise, rotation_noise : float
        Standard deviation in each axis, m and rad.
    origin : array (3,)
        Where the marker frame's origin lies in the body's axes, m.
    marker : array (3,)
        Rotation vector of the marker frame in the body's axes, rad.
    jumps, dropouts : Faults
        Of tracking, and gaps without messages.
    jitter : float
        Standard deviation of a stamp about the time of its sample, s.
    latency : float
        From a message's stamp to its arrival at the recorder, s.

    """

    name: str
    rate_hz: float
    position_noise: float = 0.0
    rotation_noise: float = 0.0
    origin: Array = field(default_factory=lambda: np.zeros(3))
    marker: Array = field(default_factory=lambda: np.zeros(3))
    jumps: Faults = Faults()
    dropouts: Faults = Faults()
    jitter: float = 0.0
    latency: float = 0.0


@dataclass(frozen=True)
class TwistSensor:
    """How the tool's twist is measured: axes ('world' or 'tool') and noise (m/s, rad/s)."""

    frame: str = 'world'
    linear_noise: float = 0.0
    angular_noise: float = 0.0


@dataclass(frozen=True, eq=False)
class Schedule:
    """
    When a stream's samples are taken, and the fate of each.

    Parameters
    ----------
    sampled_ns : int array (N,)
        When the body was where the sample says, ns.
    stamps_ns : int array (N,)
        What the message's header says, ns.
    jump : int array (N,)
        Number of the tracking jump the sample is part of, -1 for none.
    kept : bool array (N,)
        False where the message is missing.
    jumps, dropouts : tuple of int
        Index of the first sample of each, in order.

    """

    sampled_ns: Stamps
    stamps_ns: Stamps
    jump: Indices
    kept: Mask
    jumps: tuple[int, ...]
    dropouts: tuple[int, ...]


def schedule(
    sensor: Sensor, duration: float, rest_duration: float, start_ns: int, draw: Generator
) -> Schedule:
    """
    Plan a stream's samples; jumps and gaps never overlap, and the initial rest has none.

    Parameters
    ----------
    sensor : Sensor
        How the body is tracked.
    duration, rest_duration : float
        Of the whole recording and of the rest at its beginning, s.
    start_ns : int
        Stamp of the beginning, ns.
    draw : Generator
        Random numbers.

    Raises
    ------
    BellowsError
        If the jumps and gaps do not fit into the motion.

    """
    sampled_ns = sample_stamps(sensor.rate_hz, duration, start_ns)
    jump = np.full(len(sampled_ns), -1)
    kept = np.full(len(sampled_ns), True)
    first = int(np.ceil(rest_duration * sensor.rate_hz)) + 1
    lengths = np.maximum(np.round(np.repeat(
        [sensor.jumps.duration, sensor.dropouts.duration],
        [sensor.jumps.count, sensor.dropouts.count]) * sensor.rate_hz).astype(np.int64), 1)
    # Between two events, and at both ends, there is one sample at least.
    needed = int(lengths.sum()) + len(lengths) + 1
    free = len(sampled_ns) - first - needed
    if len(lengths) and free < 0:
        raise BellowsError(
            f"The outliers and dropouts of '{sensor.name}' need {needed} samples, but there are "
            f'only {max(len(sampled_ns) - first, 0)} after the rest. '
            'Make them fewer or shorter, or the motion longer.'
        )
    order = draw.permutation(len(lengths))
    spread = np.sort(draw.integers(0, max(free, 0) + 1, len(lengths)))
    starts = first + spread + np.cumsum(lengths[order] + 1) - lengths[order] - 1
    jumps: list[int] = []
    dropouts: list[int] = []
    for start, event in zip(starts.tolist(), order.tolist(), strict=True):
        samples = slice(start, start + int(lengths[event]))
        if event < sensor.jumps.count:
            jump[samples] = len(jumps)
            jumps.append(start)
        else:
            kept[samples] = False
            dropouts.append(start)
    largest = LARGEST_JITTER / sensor.rate_hz
    jitter = np.clip(draw.normal(0.0, sensor.jitter, len(sampled_ns)), -largest, largest)
    stamps_ns = sampled_ns + np.round(jitter * NS_PER_S).astype(np.int64)
    return Schedule(sampled_ns, stamps_ns, jump, kept, tuple(jumps), tuple(dropouts))


def measure_poses(
    truth: Trajectory, sensor: Sensor, plan: Schedule, world: Array, draw: Generator
) -> Trajectory:
    """
    Return the recorded poses of a body, in the recording's world.

    Parameters
    ----------
    truth : Trajectory
        Its poses at `plan.sampled_ns`.
    sensor : Sensor
        How it is tracked.
    plan : Schedule
        When it is sampled.
    world : array (3, 3)
        R_recording_world, of `WORLDS`.
    draw : Generator
        Random numbers.

    """
    count = len(truth)
    noise = draw.normal(size=(count, 6))
    directions = draw.normal(size=(len(plan.jumps), 2, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    sizes = np.array([[sensor.jumps.position], [sensor.jumps.rotation]])
    jumps = np.concatenate([directions * sizes, np.zeros((1, 2, 3))])[plan.jump]  # -1: none
    position = truth.position + apply(truth.rotation, sensor.origin)
    position = position + jumps[:, 0] + sensor.position_noise * noise[:, :3]
    rotation = truth.rotation @ exp_so3(sensor.marker) @ exp_so3(jumps[:, 1])
    rotation = rotation @ exp_so3(sensor.rotation_noise * noise[:, 3:])
    kept = plan.kept
    return Trajectory(plan.stamps_ns[kept], position[kept] @ world.T, (world @ rotation)[kept])


def measure_twists(
    truth: Trajectory,
    sensor: TwistSensor,
    marker: Array,
    plan: Schedule,
    world: Array,
    draw: Generator,
) -> Array:
    """
    Return the recorded twists (M, 6) of the tool tip, m/s and rad/s.

    Parameters
    ----------
    truth : Trajectory
        With body twists at `plan.sampled_ns`.
    sensor : TwistSensor
        In 'world' axes, or in 'tool' axes: those of the tool's marker frame.
    marker : array (3,)
        Rotation vector of that frame in the tool's axes, rad.
    plan : Schedule
        When they are sampled.
    world : array (3, 3)
        R_recording_world.
    draw : Generator
        Random numbers.

    """
    axes = world @ truth.rotation if sensor.frame == 'world' else exp_so3(marker).T
    noise = np.repeat([sensor.linear_noise, sensor.angular_noise], 3) * draw.normal(
        size=(len(truth), 6))
    twist = np.asarray(truth.twist)
    return (np.hstack([apply(axes, twist[:, :3]), apply(axes, twist[:, 3:])]) + noise)[plan.kept]


def sensor_from(settings: Settings, origin: Array | None = None) -> Sensor:
    """
    Return the sensor that settings describe; see config/motion_example.yaml.

    Parameters
    ----------
    settings : Settings
        The block 'tool' or 'package'; what else may stand in it the caller asks for.
    origin : array (3,), optional
        Where the marker frame's origin lies in the body's axes, m; zero when left out.

    """
    noise, marker, stamps = (settings.block(name) for name in ('noise', 'marker', 'stamps'))
    return Sensor(
        settings.path,
        rate_hz=settings.number('rate_hz', unit='Hz', above=0.0, maximum=FASTEST),
        position_noise=noise.number('position', 0.0, 'm', minimum=0.0),
        rotation_noise=noise.number('rotation', 0.0, 'rad', minimum=0.0),
        origin=np.zeros(3) if origin is None else origin,
        marker=marker.vector('rotation', 3, (0.0, 0.0, 0.0), unit='rad'),
        jumps=_faults(settings.block('outliers'), True),
        dropouts=_faults(settings.block('dropouts'), False),
        jitter=stamps.number('jitter', 0.0, 's', minimum=0.0),
        latency=stamps.number('latency', 0.0, 's', minimum=0.0, maximum=60.0),
    )


def _faults(settings: Settings, moved: bool) -> Faults:
    """Return the jumps or gaps; if there are any, their sizes must be given."""
    count = settings.whole('count', 0, maximum=100_000)
    needed = None if count else 0.0
    sizes = (
        settings.number('position', needed, 'm', minimum=0.0),
        settings.number('rotation', needed, 'rad', minimum=0.0, maximum=3.0),
    ) if moved else ()
    return Faults(count, settings.number('duration', needed, 's', minimum=0.0), *sizes)


def twist_sensor_from(settings: Settings) -> TwistSensor | None:
    """Return the twist sensor in the block 'tool.twist'; None if it is off."""
    noise = settings.block('noise')
    sensor = TwistSensor(
        settings.choice('frame', ('world', 'tool'), 'world'),
        noise.number('linear', 0.0, 'm/s', minimum=0.0),
        noise.number('angular', 0.0, 'rad/s', minimum=0.0),
    )
    return sensor if settings.flag('publish', True) else None
