"""Hypotheses on what was given with recordings, or on the cup: one list of variations."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply, exp_so3, log_so3, mean_rotation
from bellows_ros.core.identification.causes import radius_of_gyration
from bellows_ros.core.identification.quantities import of_fixed_frame, payload_of, poses_of
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.model.structure import Structure, STRUCTURES
from bellows_ros.core.parameters.checks import GYRATION, INERTIA_UNITS
from bellows_ros.core.recording.alignment import closed_form, levelling, motion_of, R_WORLD_MOTIVE
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

MAX_OFFSET = 0.21
"""Largest time offset considered, and a margin beyond it for derivatives, s."""

SLIP_DURATION = 0.3
"""Time (s) over which a slip is spread, so that its time has a derivative."""


class Given(NamedTuple):
    """
    A recording with its given data.

    Parameters
    ----------
    samples : Samples
        Its filtered motions.
    length : float
        Nominal length l0 of the cup, m.
    structure : Structure
        Of K and P.
    lip_recorded : bool
        Whether the recorded poses are of the lip, so that another centre of mass moves B.
    aligned : bool
        Whether alignment at rest has put the lip below the tool tip, whatever the centre of mass.
    extra : str
        'drift', 'cubic' (a spring that is not linear, up to fifth order) or 'friction' for columns
        beside those of K and P; '' for none.

    """

    samples: Samples
    length: float
    structure: Structure
    lip_recorded: bool = False
    aligned: bool = False
    extra: str = ''


Variation = Callable[[Given, Array], Given]


def time_offset(given: Given, theta: Array) -> Given:
    """Return it with the tool's stamps earlier by an offset, s."""
    tool, stamps_ns = given.samples.tool, given.samples.package.stamps_ns
    edge = round(MAX_OFFSET * NS_PER_S)
    shift = round(float(np.clip(theta[0], -MAX_OFFSET, MAX_OFFSET)) * NS_PER_S)
    package = given.samples.package.between(stamps_ns[0] + edge, stamps_ns[-1] - edge)
    lost = tool.stamps_ns[~tool.valid]  # the same samples for every offset
    first, last = (np.searchsorted(lost, package.stamps_ns + side) for side in (-edge, edge))
    return _with(given, package=package, tool=replace(
        resample(tool, package.stamps_ns + shift), stamps_ns=package.stamps_ns,
        valid=first == last))


def quantity(name: str) -> Variation:
    """Return the variation of a quantity of `KINDS`, of the package or of its poses."""
    def varied(given: Given, theta: Array) -> Given:
        """Return it with another value; the lip stays where it is known to be."""
        samples, free = given.samples, {name: theta}
        moves = np.where(given.lip_recorded, 1.0, [given.aligned, given.aligned, 0.0])
        return _with(given, payload=payload_of(samples.payload, free),
                     package=poses_of(samples.package, free, moves))
    return varied


def length(given: Given, theta: Array) -> Given:
    """Return it with a longer cup, m."""
    return given._replace(length=given.length + float(theta[0]))


def package_marker(given: Given, theta: Array) -> Given:
    """Return it with the package's frame in the recorded one moved by x, y (m), and turned."""
    return quantity('package_marker')(given, np.insert(theta, 2, 0.0))


def tool_marker(given: Given, theta: Array) -> Given:
    """Return it with the tool's frame in the recorded one moved by x, y (m), and turned."""
    return _with(given, tool=of_fixed_frame(
        given.samples.tool, theta[2:], np.append(theta[:2], 0.0)))


def slip(first_ns: int) -> Variation:
    """
    Return a variation in which a package slips on the lip: x, y (m) and the time since then (s).

    Of the recording whose package begins with that stamp. A slip takes some time, so that this has
    a derivative.
    """
    def slipped(given: Given, theta: Array) -> Given:
        """Return it with the package where it was before it slipped."""
        body = given.samples.package
        if int(body.stamps_ns[0]) != first_ns:
            return given
        since = (body.stamps_ns - first_ns) / NS_PER_S - theta[2]
        part = np.clip(since / SLIP_DURATION + 0.5, 0.0, 1.0)[:, None]
        return _with(given, package=replace(body, position=body.position - apply(
            body.rotation, part * [*theta[:2], 0.0])))
    return slipped


def tilt(given: Given, theta: Array) -> Given:
    """Return it with the world of both bodies turned by theta (2,) about x and y, rad."""
    return other_world(exp_so3(np.append(theta, 0.0)))(given, theta)


def exchanged(first: Package, second: Package) -> Variation:
    """Return a variation in which two recordings have each other's package."""
    return lambda given, theta: _with(
        given, payload=second if given.samples.payload.mass == first.mass else first)


def other_world(R: Array) -> Variation:
    """Return a variation that rotates the world of both bodies."""
    def turned(body: Trajectory) -> Trajectory:
        return replace(body, position=apply(R, body.position), rotation=R @ body.rotation)

    return lambda given, theta: _with(
        given, tool=turned(given.samples.tool), package=turned(given.samples.package))


def yaw(angle: float, of_tool: bool) -> Variation:
    """Return a variation that rotates a body's frame about its z axis."""
    phi = np.array([0.0, 0.0, angle])

    def turned(given: Given, theta: Array) -> Given:
        """Return it with a body turned, the package about its lip."""
        if of_tool:
            return _with(given, tool=of_fixed_frame(given.samples.tool, phi, np.zeros(3)))
        com = given.samples.payload.com
        return _with(given, package=of_fixed_frame(
            given.samples.package, phi, exp_so3(phi) @ com - com))
    return turned


def other_frame(given: Given, theta: Array) -> Given:
    """Return it with the package's poses taken as those of the lip instead of B, or vice versa."""
    com = given.samples.payload.com
    return _with(given, package=of_fixed_frame(
        given.samples.package, np.zeros(3), -com if given.lip_recorded else com),
    )._replace(lip_recorded=not given.lip_recorded)


def in_other_unit(factor: float) -> Variation:
    """Return a variation with an inertia so many times as large."""
    return lambda given, theta: quantity('inertia')(given, np.array([np.log(factor)]))


def other_cup(**changes: Any) -> Variation:
    """Return a variation with another structure of K and P, or with extra columns."""
    return lambda given, theta: given._replace(**changes)


def _with(given: Given, **changes: Any) -> Given:
    """Return it with other samples."""
    return given._replace(samples=replace(given.samples, **changes))


class Hypothesis(NamedTuple):
    """
    What may be otherwise.

    Parameters
    ----------
    name : str
        Of the cause: a name of fit.free, a parameter, or what the cup is.
    variation : Variation
        The change, by the numbers that are freed.
    steps : tuple of float
        Change of each number for derivatives; none where a setting is otherwise.
    starts : callable
        Numbers that are tried first, of a recording: where the weight stretches the cup by less
        than what is off, its stiffness has the wrong sign in a false minimum.
    furthest : float
        No round goes further than so many steps.
    value : str
        What the setting is then; which body where numbers of either may be freed.
    more : int
        Columns that the cup has more.
    datum : bool
        Whether something that was given is wrong, and not the cup otherwise.

    """

    name: str
    variation: Variation
    steps: tuple[float, ...] = ()
    starts: Callable[[Given], Iterable[Array]] = lambda given: ()
    furthest: float = 200.0
    value: str = ''
    more: int = 0
    datum: bool = True

    @property
    def freed(self) -> int:
        """Numbers that it has more."""
        return len(self.steps) + self.more


RASTER = 0.01
"""Spacing (s) of the offsets tried first; up to 10 Hz the residuals have one minimum within it."""

SLIP_TIMES, SLIP_SIZE = 12, 2e-3
"""Times at which slips are tried, and their size, m."""

MIN_SECONDS = 3.0
"""Shortest duration of valid samples (s) with which an offset is looked for."""

STARTS_ALONG_Z = np.array([-8e-3, -4e-3, -2e-3, -1e-3, 1e-3, 2e-3, 4e-3, 8e-3])
"""Offsets along z that are tried, m."""


def _worlds(given: Given) -> list[Array]:
    """Return motions (6,) of the package's world: along z, also from that of one rigid body."""
    tool, package = given.samples.tool, given.samples.package
    pose = closed_form(tool, package, given.length, -given.samples.payload.com)
    rigid = motion_of(pose, package.position[package.valid].mean(axis=0))
    along = np.outer([0.0, *STARTS_ALONG_Z], np.eye(6)[2])
    return [*along[1:], *(rigid + along)]


def _turns(given: Given) -> list[Array]:
    """Return the marker (5,) with which the lip is turned as the tool on average."""
    tool, package = given.samples.tool, given.samples.package
    turned = mean_rotation(np.swapaxes(package.rotation, 1, 2) @ tool.rotation)
    return [np.append(np.zeros(2), log_so3(turned))]


QUANTITIES = (
    Hypothesis('time_offset', time_offset, (1e-4,), lambda given:
               RASTER * np.arange(-20, 21)[:, None], 100.0),
    Hypothesis('com', quantity('com'), (1e-5,) * 3, lambda given:
               np.outer(STARTS_ALONG_Z, np.eye(3)[2]), 1000.0),
    Hypothesis('length', length, (1e-5,), lambda given:
               np.outer([1.0, 4.0], STARTS_ALONG_Z).reshape(-1, 1), 500.0),
    Hypothesis('package_world', quantity('package_world'), (1e-5,) * 6, _worlds, 5000.0),
    Hypothesis('inertia', quantity('inertia'), (1e-3,), furthest=1000.0),
    Hypothesis('gravity.direction', tilt, (1e-4,) * 2, furthest=1000.0),
    Hypothesis('package_marker', package_marker, (1e-5,) * 5, _turns, 5000.0,
               'package'),
    Hypothesis('package_marker', tool_marker, (1e-5,) * 5, lambda given:
               [-theta for theta in _turns(given)], 5000.0, 'tool'))
"""
What was given, as numbers.

K and P scaled with mass and inertia make the same motion. So another mass is the same as another
inertia, and only one factor of all moments of inertia is tried.
"""

CUP_EFFECTS = tuple(Hypothesis(name, other_cup(extra=name), more=6, datum=False)
                    for name in ('drift', 'cubic', 'friction'))
"""What the cup may be, whatever was given."""


def hypotheses(recordings: Sequence[Given], world: str) -> Iterator[Hypothesis]:
    """Yield all that may be otherwise with recordings given so, in a recording.world."""
    given = recordings[0]
    inner = time_offset(given, np.zeros(1)).samples
    seconds = np.count_nonzero(inner.valid) * np.median(np.diff(inner.tool.stamps_ns)) / NS_PER_S
    yield from QUANTITIES[0 if seconds > MIN_SECONDS else 1:]
    yield from map(_slip_of, recordings)
    yield from _packages(recordings)
    for value, R in _other_worlds(world):
        yield Hypothesis('recording.world', other_world(R), value=value)
    for body in ('tool', 'package'):
        for degrees in (90, 180, -90):
            yield Hypothesis(
                'yaw', yaw(np.radians(-degrees), body == 'tool'), value=f'{body} {degrees}')
    yield Hypothesis('recording.package_frame', other_frame,
                     value='com' if given.lip_recorded else 'lip')
    structure = given.structure
    for other in STRUCTURES.values():
        if other.size > structure.size and other.contains(structure):
            yield Hypothesis('structure', other_cup(structure=other), value=other.name,
                             more=2 * (other.size - structure.size), datum=False)
    yield from CUP_EFFECTS


def _slip_of(given: Given) -> Hypothesis:
    """Return a slip of the package in one recording, tried at times and to sides all over it."""
    seconds = given.samples.package.seconds
    times = np.linspace(0.0, float(seconds[-1]), SLIP_TIMES + 2)[1:-1]
    starts = [np.array([*shift, when]) for when in times
              for shift in SLIP_SIZE * np.concatenate([np.eye(2), -np.eye(2)])]
    return Hypothesis('slip', slip(int(given.samples.package.stamps_ns[0])), (1e-5, 1e-5, 1e-2),
                      lambda given: starts)


def _packages(recordings: Sequence[Given]) -> Iterator[Hypothesis]:
    """Yield packages whose inertia is in another unit, or that are exchanged between two files."""
    gyration = radius_of_gyration(recordings[0].samples.payload)
    for unit, factor in INERTIA_UNITS:
        if gyration > GYRATION[0] * np.sqrt(factor):
            yield Hypothesis('inertia', in_other_unit(1.0 / factor), value=unit)
    packages = {given.samples.payload.mass: given.samples.payload for given in recordings}
    if len(packages) == 2:
        yield Hypothesis('package.files', exchanged(*packages.values()), value='exchanged')


def _other_worlds(world: str) -> Iterator[tuple[str, Array]]:
    """Yield worlds other than the given one: values of a setting, and the turn to it."""
    R = R_WORLD_MOTIVE if world == 'z_up' else R_WORLD_MOTIVE.T
    yield 'motive_y_up' if world == 'z_up' else 'z_up', R
    for down in np.concatenate([np.eye(3), -np.eye(3)[:2]]):
        if down @ R[2] > -0.5:  # where things fall in the other world
            yield f'gravity {down.astype(int).tolist()}', levelling(down)
