"""
Settings that recordings may have otherwise: worlds, axes, exchanged packages.

They are no numbers that a search can free, so each is tried by a search of its own. Worlds are
tried by where things fall in them, which is the same.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import exp_so3
from bellows_ros.core.identification.causes import DISTINCT, Finding
from bellows_ros.core.identification.quantities import of_fixed_frame
from bellows_ros.core.identification.search import Search
from bellows_ros.core.identification.segments import MeasuredSegment, Segment
from bellows_ros.core.model.cup_package import Cup, gravity_vector
from bellows_ros.core.recording.alignment import levelling, R_WORLD_MOTIVE
from bellows_ros.errors import BellowsError
import numpy as np

ROTATIONS = (90, 180, -90)
"""Angles (degrees) about z by which a frame may be turned."""

Setting = tuple[Finding, list[MeasuredSegment]]
"""What a setting would be, and the recordings with it."""


def settings_of(measured: Sequence[MeasuredSegment]) -> Iterator[Setting]:
    """Yield all other settings of recordings of one cup."""
    for value, R in _worlds(measured[0].world):
        yield Finding('recording.world', value), [
            replace(each, gravity=R.T @ gravity_vector(each.gravity)) for each in measured]
    for degrees in ROTATIONS:
        phi = np.array([0.0, 0.0, -np.radians(degrees)])
        yield Finding('yaw', f'tool {degrees}'), [
            replace(each, tool=of_fixed_frame(each.tool, phi, np.zeros(3))) for each in measured]
        yield Finding('yaw', f'package {degrees}'), [  # turned about its lip
            replace(each, package=of_fixed_frame(
                each.package, phi, exp_so3(phi) @ each.payload.com - each.payload.com))
            for each in measured]
    packages = list({each.payload.mass: each.payload for each in measured}.values())
    if len(packages) == 2:
        yield Finding('package.files', 'exchanged'), [
            replace(each, payload=packages[int(each.payload.mass == packages[0].mass)])
            for each in measured]


def _worlds(world: str) -> Iterator[tuple[str, Array]]:
    """Yield worlds other than the given one: values of a setting, and the turn to it."""
    other, R = ('motive_y_up', R_WORLD_MOTIVE) if world == 'z_up' else ('z_up', R_WORLD_MOTIVE.T)
    yield other, R
    for down in np.concatenate([np.eye(3), -np.eye(3)[:2]]):
        if down @ R[2] > -0.5:  # where things fall in the other world
            yield f'gravity {down.astype(int).tolist()}', levelling(down)


def likeliest_setting(search: Search, cup: Cup) -> Finding | None:
    """
    Return the other setting with which recordings leave noise alone, None without one.

    Each is approached from the same cup, and the best is fitted. Recordings may not tell which of
    two frames is turned: the other one that leaves as little is then named with it.

    Parameters
    ----------
    search : Search
        Of recordings as they were given.
    cup : Cup
        Where the searches begin.

    """
    given = [segment.measured for segment in search.segments]
    ends = list[tuple[float, Finding, Search]]()
    for finding, measured in [(Finding('', ''), given), *settings_of(given)]:
        other = search.with_free(search.unknowns(cup), {})
        other.segments = [Segment(each) for each in measured]
        with suppress(BellowsError):  # no cup explains that
            ends.append((other.approach(with_couplings=False).squares, finding, other))
    least, likeliest, other = min(ends, key=itemgetter(0))
    for segment in other.segments:
        segment.reset()
    if not likeliest.name or not other.fits(other.minimum()):
        return None
    (before, *_), *_ = ends
    instead = [finding.value for squares, finding, *_ in ends if finding is not likeliest and (
        finding.name == likeliest.name == 'yaw' and DISTINCT * squares < least)]
    return likeliest._replace(
        left=float(np.sqrt(least / before)), instead=next(iter(instead), ''))
