"""Variations of the given quantities of a recording, as pure functions of it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import adjoint, apply, exp_so3, inverse_transform, transform
from bellows_ros.core.identification.samples import Samples
from bellows_ros.core.model.cup_package import Package, varied
from bellows_ros.core.model.structure import Structure
from bellows_ros.core.signals.resampling import resample
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory
import numpy as np

LARGEST_OFFSET = 0.2
"""Largest time offset considered, s ..."""

SLIPPING = 0.3
"""Time (s) over which a slip is looked for."""

SLACK = 0.01
"""... and the margin beyond it for derivatives, s."""


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
    samples = given.samples
    stamps = samples.package.stamps_ns
    furthest = LARGEST_OFFSET + SLACK
    shift = round(float(np.clip(theta[0], -furthest, furthest)) * NS_PER_S)
    edge = round(furthest * NS_PER_S)
    inside = (stamps >= stamps[0] + edge) & (stamps <= stamps[-1] - edge)
    there = resample(samples.tool, stamps[inside] + shift)
    package = samples.package.select(inside)
    lost = samples.tool.stamps_ns[~samples.tool.valid]  # the same samples for every offset
    first, last = (np.searchsorted(lost, package.stamps_ns + side) for side in (-edge, edge))
    tool = replace(there, stamps_ns=package.stamps_ns, valid=first == last)
    return _with(given, tool=tool, package=package)


def com(given: Given, theta: Array) -> Given:
    """Return it with the centre of mass moved (3,) in axes of the lip, m."""
    there = _with(given, payload=varied(given.samples.payload, com=theta))
    fixed = np.array([given.aligned, given.aligned, False]) | given.lip_recorded  # then B moves
    return _body_moved(there, np.zeros(3), np.where(fixed, theta, 0.0))


def length(given: Given, theta: Array) -> Given:
    """Return it with a longer cup, m."""
    return given._replace(length=given.length + float(theta[0]))


def mass(given: Given, theta: Array) -> Given:
    """Return it with the mass multiplied by exp(theta), at the same inertia."""
    return _with(given, payload=varied(given.samples.payload, mass=theta))


def inertia(given: Given, theta: Array) -> Given:
    """Return it with moments of inertia exp(theta) (1,) or (3,) times as large."""
    return _with(given, payload=varied(given.samples.payload, inertia=theta))


def package_world(given: Given, theta: Array) -> Given:
    """
    Return it with the world of the package moved and turned by theta (6,), m and rad.

    It turns about the middle of the package's positions. Body twists stay what they are.
    """
    body = given.samples.package
    R, middle = exp_so3(theta[3:]), body.position[body.valid].mean(axis=0)
    return _with(given, package=replace(
        body, position=middle + theta[:3] + apply(R, body.position - middle),
        rotation=R @ body.rotation))


def grip(given: Given, theta: Array) -> Given:
    """Return it with the package's frame in the recorded one moved by x, y (m), and turned."""
    return _body_moved(given, theta[2:5], np.array([theta[0], theta[1], 0.0]))


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
        part = np.clip(since / SLIPPING + 0.5, 0.0, 1.0)[:, None]
        way = apply(body.rotation, part * [theta[0], theta[1], 0.0])
        return _with(given, package=replace(body, position=body.position - way))
    return slipped


def tilt(given: Given, theta: Array) -> Given:
    """Return it with the world of both bodies turned by theta (2,) about x and y, rad."""
    return gravity(exp_so3(np.append(theta, 0.0)))(given, theta)


def exchanged(first: Package, second: Package) -> Variation:
    """Return a variation in which two recordings have each other's package."""
    return lambda given, theta: _with(
        given, payload=second if given.samples.payload.mass == first.mass else first)


def gravity(R: Array) -> Variation:
    """Return a variation that rotates the world of both bodies."""
    def turned(given: Given, theta: Array) -> Given:
        """Return it in a world that is turned by R."""
        tool, package = (
            replace(body, position=apply(R, body.position), rotation=R @ body.rotation)
            for body in (given.samples.tool, given.samples.package))
        return _with(given, tool=tool, package=package)
    return turned


def yaw(angle: float, of_tool: bool) -> Variation:
    """Return a variation that rotates a body's frame about its z axis."""
    phi = np.array([0.0, 0.0, angle])

    def turned(given: Given, theta: Array) -> Given:
        """Return it with a body turned."""
        if not of_tool:
            return _body_moved(given, phi, np.zeros(3), about_lip=True)
        return _with(given, tool=_of_fixed_frame(given.samples.tool, phi, np.zeros(3)))
    return turned


def other_frame(given: Given, theta: Array) -> Given:
    """Return it with the package's poses taken as those of the lip instead of B, or vice versa."""
    com = given.samples.payload.com
    moved = _body_moved(given, np.zeros(3), -com if given.lip_recorded else com)
    return moved._replace(lip_recorded=not given.lip_recorded)


def scaled(what: Variation, factor: float) -> Variation:
    """Return a mass or an inertia in other units."""
    return lambda given, theta: what(given, np.array([np.log(factor)]))


def structure(other: Structure) -> Variation:
    """Return another structure of K and P."""
    return lambda given, theta: given._replace(structure=other)


def extra(name: str) -> Variation:
    """Return columns of a cup that drifts, is not linear, or has friction."""
    return lambda given, theta: given._replace(extra=name)


def _with(given: Given, **changes: Any) -> Given:
    """Return it with other samples."""
    return given._replace(samples=replace(given.samples, **changes))


def _body_moved(given: Given, phi: Array, way: Array, about_lip: bool = False) -> Given:
    """Return it with B displaced in its own axes."""
    if about_lip:  # B = S + R com
        com = given.samples.payload.com
        way = exp_so3(phi) @ com - com
    return _with(given, package=_of_fixed_frame(given.samples.package, phi, way))


def _of_fixed_frame(body: Trajectory, phi: Array, way: Array) -> Trajectory:
    """Return the motion of a frame that is fixed in a body, by its pose there."""
    R = exp_so3(phi)
    X = adjoint(inverse_transform(transform(R, way)))
    return replace(
        body, position=body.position + apply(body.rotation, way), rotation=body.rotation @ R,
        twist=None if body.twist is None else apply(X, body.twist),
        acceleration=None if body.acceleration is None else apply(X, body.acceleration))
