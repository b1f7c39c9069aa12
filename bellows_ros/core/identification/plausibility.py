"""Findings on wrong inputs, and those that need no fit: units, axes, clocks, smoothed poses."""

from dataclasses import replace
from typing import NamedTuple

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import apply
from bellows_ros.core.identification.samples import prepared_again, require_hanging
from bellows_ros.core.model.cup_package import Package
from bellows_ros.core.parameters.checks import (
    GYRATION,
    INERTIA_UNITS,
    LARGEST_MASS,
    unit_of_inertia,
)
from bellows_ros.core.recording.alignment import ALIKE, turn_correlation
from bellows_ros.core.recording.recording import Recording
from bellows_ros.core.signals.trajectory import NS_PER_S, Trajectory, uniform_rate_hz
from bellows_ros.errors import BellowsError, MisreadError
import numpy as np

SIGNIFICANT = 6.0
"""Standard errors that a significant change is away from nothing."""

MATERIAL = 0.05
"""Part by which a material change moves an entry of K, or a twist."""

DISTINCT = 0.5
"""A distinct hypothesis leaves less than this part of the squares that another leaves. The square
of it is asked where it must explain nearly all, and of what the cup may be beside wrong data."""

DOUBTED = 1.0
"""Squares beyond noise, in those expected of noise and rubber, with which a cup is doubted."""

GRAMS = 1e3
"""How many of what masses may be in are 1 kg."""

NONE = np.empty(0)

MISREAD, MOST_FACTS = 'recording', 4
"""Name of a finding that is a sentence on how poses were read, and most findings without a fit."""

SWINGING = -0.2, 0.05
"""Time offsets (s) that the swing of the package can explain: it turns after its tool, not before.
Smaller offsets of clocks are fitted."""

SWING = 0.07
"""Usual time (s) by which a package turns after its tool."""

ROUGH = 0.05
"""Standard deviation of an offset by when both bodies turn alike (s), as the package swings."""

PERIODIC = 0.95
"""Part of the largest correlation of turns that small offsets reach in a periodic motion."""

SPECTRUM_SECONDS, LEAST_RATE_HZ = 1.0, 100.0
"""Length of the periodograms of poses, and the rate (Hz) from which on they are looked at."""

NOISE_HZ, NYQUIST_PART = 25.0, 0.9
"""Frequency (Hz) above which poses have noise alone, and up to which part of the highest one."""

STEEPEST = 3.0
"""Power of frequency with which the density of noise falls; behind a filter of second order, 4."""

SMALLEST_DENSITY = 1e-18
"""Density (m^2/Hz) below which there is no noise to see a filter by."""


class Finding(NamedTuple):
    """
    A hypothesis tried.

    Parameters
    ----------
    name, value : str
        Of the cause: a name of fit.free, a parameter, or what the cup is; and what the setting is
        then, '' where numbers are freed.
    theta, std : ndarray (n,)
        The numbers freed, and their standard errors.
    left : float
        RMS of the residuals beyond noise over what it was.
    moved : float
        Largest part by which it moves an entry of the diagonal of K that is identifiable.
    datum, certain : bool
        Whether it is of what was given, and whether nothing else explains the recordings so well.
    instead : str
        Name or value of another datum that these recordings cannot tell from it; '' for none.
    rest : float
        Squares beyond noise that it leaves, in those expected of noise and rubber.
    is_fact : bool
        Whether it is seen without any fit.

    """

    name: str
    value: str
    theta: Array = NONE
    std: Array = NONE
    left: float = 0.0
    moved: float = 0.0
    datum: bool = True
    certain: bool = True
    instead: str = ''
    rest: float = 0.0
    is_fact: bool = False

    @property
    def material(self) -> bool:
        """Whether a cup is wrong without it: whatever is certain halves errors, or moves K."""
        return self.certain and self.datum

    @property
    def likely(self) -> bool:
        """Whether it is worth a word: it explains most, whatever else does."""
        return self.certain or self.left**2 < DISTINCT


def implausible_inputs(own: Recording) -> tuple[Finding, ...]:
    """Return what is wrong with a recording or what was given with it, without any fit."""
    found = (_package(own.payload), _clocks(own), wrong_twists(own), _smoothed(own))
    return tuple(own._replace(is_fact=True) for own in found if own is not None)


def corrected(own: Recording) -> tuple[tuple[Finding, ...], Recording]:
    """Return what is wrong with a recording without any fit, and the recording without that."""
    found = list[Finding]()
    while len(found) < MOST_FACTS:
        try:
            require_hanging(own)
            new = [wrong for wrong in implausible_inputs(own)
                   if wrong.name not in {known.name for known in found}]
            if not new:
                break
            found += new
            for wrong in new:
                own = _mended(own, wrong)
        except BellowsError as error:
            if not (found or isinstance(error, MisreadError)):
                raise
            found.append(Finding(MISREAD, str(error), is_fact=True,
                                 instead=getattr(error, 'setting', '')))
            if not isinstance(error, MisreadError):
                break
            own = error.mended()
    return tuple(found), own


def _mended(own: Recording, wrong: Finding) -> Recording:
    """Return a recording without something that is wrong, as it is where that cannot be."""
    held = own.payload
    if wrong.name == 'mass':
        held = Package(held.mass / GRAMS, held.inertia, held.com)
    elif wrong.name == 'inertia':
        held = Package(held.mass, held.inertia / dict(INERTIA_UNITS)[wrong.value], held.com)
    elif wrong.name == 'time_offset':
        shift = round(float(wrong.theta[0]) * NS_PER_S)
        tool, twist = own.tool_pose, own.tool_twist
        return prepared_again(
            own, replace(tool, stamps_ns=tool.stamps_ns - shift), own.package_pose,
            twist and replace(twist, stamps_ns=twist.stamps_ns - shift))
    else:
        return own
    return replace(own, settings=replace(own.settings, payload=held))


def radius_of_gyration(held: Package) -> float:
    """Return the root of the sum of a package's moments of inertia over its mass, m."""
    return float(np.sqrt(np.trace(held.inertia) / held.mass))


def _package(held: Package) -> Finding | None:
    """Return the unit of a mass or an inertia that no package has, None where it may have it."""
    gyration = radius_of_gyration(held)
    if held.mass > LARGEST_MASS:
        return Finding('mass', 'g')
    return None if gyration < GYRATION[-1] else Finding('inertia', unit_of_inertia(gyration))


def _clocks(own: Recording) -> Finding | None:
    """Return by how much the clocks are apart, where both bodies turn alike only later."""
    lags, alike = turn_correlation(own.aligned_tool, own.aligned_package)
    if not len(lags):
        return None
    best, near = int(np.argmax(alike)), (lags >= SWINGING[0]) & (lags <= SWINGING[1])
    if alike[best] < 2.0 * ALIKE or near[best] or (
            near.any() and np.max(alike[near]) > PERIODIC * alike[best]):
        return None
    if 0.0 < lags[best] < -SWINGING[0]:
        require_hanging(own)  # a tool taken for the package turns later, too
    return Finding('time_offset', '', lags[[best]] + SWING, np.array([ROUGH]))


def wrong_twists(own: Recording) -> Finding | None:
    """Return in which axes or unit the tool's recorded twists are, None where it is as given."""
    tool, measured = own.tool, own.measured_tool
    if measured.twist is None or tool.twist is None:
        return None
    _, i, j = np.intersect1d(measured.stamps_ns, tool.stamps_ns, return_indices=True)
    known = measured.valid[i] & tool.valid[j]
    given, true = measured.twist[i][known], tool.twist[j][known]
    if not len(given):
        return None
    R_E_A = np.swapaxes(measured.rotation[i][known], 1, 2)
    turn = own.settings.R_world_recorded.T @ np.swapaxes(R_E_A, 1, 2)  # from E to as recorded
    other = 'tool'
    if own.settings.tool_twist_frame == 'tool':
        turn = R_E_A @ own.settings.R_world_recorded
        other = 'world'
    markers = own.alignment.R_tool_markers_tool
    turn = turn @ markers if other == 'world' else markers.T @ turn

    def off(twist: Array) -> float:
        """Return how far twists (N, 6) are from those of the poses, in squares of their size."""
        return sum(
            float(np.mean((twist[:, part] - true[:, part]) ** 2)
                  / np.mean(true[:, part] ** 2 + 1e-12)) for part in (slice(0, 3), slice(3, 6)))

    before = off(given)
    if before < MATERIAL**2:
        return None
    turned = np.hstack([apply(turn, given[:, :3]), apply(turn, given[:, 3:])])
    for name, value, twist in (
            ('tool_twist.frame', other, turned),
            ('topics.tool_twist', 'degrees per second',
             given * np.repeat([1.0, np.pi / 180.0], 3))):
        if off(twist) < DISTINCT**4 * before:
            return Finding(name, value, left=float(np.sqrt(off(twist) / before)))
    return None


def _smoothed(own: Recording) -> Finding | None:
    """Return that poses went through a low-pass: their noise falls too steeply."""
    steep = [topic for topic, poses in (('tool_pose', own.aligned_tool),
                                        ('package_pose', own.aligned_package))
             if _noise_order(poses) > STEEPEST]
    return Finding('low-pass', ' and '.join(steep)) if steep else None


def _noise_order(poses: Trajectory) -> float:
    """Return the power of frequency with which noise of positions falls, 0 if it is not seen."""
    rate = uniform_rate_hz(poses.stamps_ns)
    size, order = round(SPECTRUM_SECONDS * rate), 4
    if rate < LEAST_RATE_HZ:
        return 0.0
    window = np.hanning(size - order)
    seen = [np.abs(np.fft.rfft(
        np.diff(poses.position[first:first + size], order, axis=0) * window[:, None], axis=0))
        for first in range(0, len(poses) - size, size) if poses.valid[first:first + size].all()]
    if not seen:
        return 0.0
    hz = np.fft.rfftfreq(size - order, 1.0 / rate)
    inside = (hz > NOISE_HZ) & (hz < 0.5 * NYQUIST_PART * rate)
    by_difference = (2.0 * np.sin(np.pi * hz[inside] / rate)) ** (2 * order)
    density = np.median(np.sum(np.square(seen), axis=2), axis=0)[inside] / by_difference * (
        2.0 / rate / float(window @ window))
    if np.median(density) < SMALLEST_DENSITY:
        return 0.0
    return -float(np.polyfit(np.log(hz[inside]), np.log(density), 1)[0])
