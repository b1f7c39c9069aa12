"""Objects of core from values of parameters: cup, package, gripper, structure, gravity."""

from collections.abc import Mapping
from dataclasses import replace
import math
from types import MappingProxyType
from typing import Any
import warnings

from bellows_ros.core.geometry import lie
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import Cup, gripper_of, Package, TERMS, Uncertain
from bellows_ros.core.model.grip import Grip, Law, Release, RELEASE_NAMES
from bellows_ros.core.model.pseudo_inertia import flatness, nearest
from bellows_ros.core.model.structure import matrix, Structure, UPPER
from bellows_ros.core.model.validity_range import Envelope
from bellows_ros.core.parameters.values import Values
from bellows_ros.core.sensors.corners import CornerNoise, Tag
from bellows_ros.errors import BellowsError, UnitWarning
import numpy as np

STIFFNESS_BY_VACUUM = np.array([0.0, 0.0, 2.0e-5, 2.3e-5, 2.3e-5, 0.0])
"""Relative change of the diagonal of K per vacuum, for finite-element bellows, 1/Pa."""

BENDING_BY_MASS = 0.30
"""Relative change of the stiffness in bending per mass, for these bellows, 1/kg."""

BENDING_WITH_STRETCH = 0.03
"""Relative change of the stiffness in bending per mass beyond the fitted stretch, 1/kg."""

NO_CUPS: Mapping[int, float] = MappingProxyType({})
"""Empty default for measured quantities of single cups."""

EXTRAPOLATION = 2.0
"""Relative growth of the law's standard deviations per factor e of mass beyond its range, from
real drops of lighter and heavier packages (docs/evidence.md)."""

MAX_DELAY = 0.15
"""Longest delay from valve to release of usual ejectors with hoses, s."""


def cup_of(values: Values) -> Cup:
    """Return the cup of parameter values, composed of several cups if given."""
    return gripper_of(one_cup_of(values), places_of(values))


def one_cup_of(values: Values) -> Cup:
    """Return a single cup of parameter values; cup.layout is ignored."""
    cup = Cup(**{
        name: term.from_parameter(values.get(term.parameter, term.default))
        for name, term in TERMS.items() if name != 'layout'})
    low, high = (values.get(f'cup.valid_{end}', np.zeros(14))[2] for end in ('low', 'high'))
    if low or high:
        structure.require_stretch(cup.stiffness, cup.stretch, low, high)
    else:
        structure.require_stretch(cup.stiffness, cup.stretch)
    for doubt in structure.cup_doubts(cup.stiffness, cup.length):
        warnings.warn(doubt, UnitWarning, stacklevel=2)
    return cup


def tag_of(values: Values) -> Tag | None:
    """Return the detected tag and its camera, None for a tracked body; see measured.*."""
    given = values.measured
    if not given.tag_size:
        return None
    usual = CornerNoise()
    return Tag(given.tag_size * given.scale, CornerNoise(
        given.noise[0] or usual.sigma, given.noise[1] or usual.growth), given.exposure)


def package_of(values: Values) -> Package:
    """
    Return the package of parameter values.

    An inertia that is impossible within its standard deviations becomes the nearest possible one.
    """
    inertia = structure.inertia_matrix(values.package.inertia)
    usual = structure.INERTIA_STD * np.diag(inertia)
    structure.check_inertia(inertia, stated_std(
        {'package.inertia_std': -1.0, **values}, 'package.inertia_std', usual))
    if flatness(inertia) < -structure.INERTIA_ROUNDING:
        inertia = nearest(inertia)
    return Package(values.package.mass, inertia, np.array(values.package.com))


def stated_std(values: Mapping[str, Any], name: str, usual: Array) -> Array:
    """Return stated standard deviations (n,), with the usual ones (n,) for entries below 0."""
    std = np.atleast_1d(values[name])[:len(usual)]
    return np.where(std < 0.0, usual, std)


def parameter_vector(values: Values) -> Array:
    """Return the parameters (52,) of values: K and P, mass, com, inertia; SI units."""
    return np.concatenate([
        matrix(values.cup.stiffness)[UPPER], matrix(values.cup.damping)[UPPER],
        [values.package.mass], values.package.com, values.package.inertia])


def stiffness_std(values: Values) -> Array:
    """
    Return the standard deviations (6, 6) of K for the mass and the vacuum of use.

    Results of finite-element bellows add errors in proportion to the distance from the masses and
    vacuums in cup.valid_low and cup.valid_high.
    """
    std = np.reshape(values.cup.stiffness_std, (6, 6))
    K = np.diag(matrix(values.cup.stiffness))

    def distance(name: str, place: int) -> float:
        value = values.get(name, 0.0)
        low, high = (values.get(f'cup.valid_{end}', (0.0,) * 14)[place] for end in (
            'low', 'high'))
        return max(low - value, value - high, 0.0) if high > 0.0 and value > 0.0 else 0.0

    has_stretch = any(values.get('cup.stretch', ()))
    more = distance('vacuum.holding', 13) * STIFFNESS_BY_VACUUM
    more[3:5] += (BENDING_WITH_STRETCH if has_stretch else BENDING_BY_MASS) * distance(
        'package.mass', 12)
    return np.asarray(np.hypot(std, np.diag(K * more)))


def parameter_std(values: Values) -> Array:
    """
    Return the standard deviations (52,) of the parameters.

    Infinite errors of unidentifiable entries of K or P are limited to the geometric mean of the
    two diagonal entries, the validity of a linear model.
    """
    root = [np.sqrt(np.diag(matrix(values[kind]))) for kind in ('cup.stiffness', 'cup.damping')]
    limit = np.concatenate([np.outer(each, each)[UPPER] for each in root])
    std = parameter_vector(Values({
        name[:-4]: each for name, each in values.items() if name.endswith('_std')}))
    std[:21] = stiffness_std(values)[UPPER]
    return np.concatenate([np.minimum(std[:42], limit), np.maximum(std[42:], 0.0)])


def places_of(values: Values) -> Array:
    """
    Return x, y, z (m) in E and the index, from 0, of each holding cup (n, 4).

    Raises
    ------
    BellowsError
        If cup.layout and cup.open do not describe a holding gripper.

    """
    positions = structure.positions_of(values.get('cup.layout', (0.0, 0.0, 0.0)))
    opened = set(values.get('cup.open', ())) - {-1.0}  # -1 stands for none
    every = set(range(len(positions)))
    if not opened <= every or opened == every:
        given = ', '.join(f'{place:g}' for place in sorted(opened))
        raise BellowsError(
            f'cup.open has {given}; expected integers from 0 to {len(positions) - 1}, the places '
            'of cups in cup.layout, without those that hold.')
    indices = sorted(every - opened)
    return np.column_stack([positions[indices], indices])


def richest_structure(values: Values) -> Structure:
    """Return the richest structure that a fit may select: `given_structure` unless it is auto."""
    is_auto = values.fit.structure == structure.AUTO
    return structure.AUTO_STRUCTURES[1] if is_auto else given_structure(values)


def given_structure(values: Values) -> Structure:
    """
    Return the structure in parameter values; a layout's structure has the places of its cups.

    Raises
    ------
    BellowsError
        If fit.structure is unknown, or is layout without several cups in cup.layout.

    """
    named = structure.structure_named(values.fit.structure)
    if named is not structure.OF_LAYOUT:
        return named
    places = places_of(values)
    if structure.is_single(places):
        raise BellowsError(
            'fit.structure: layout fits one cup of a gripper, but cup.layout has a single cup. '
            'Give x, y and z (m) of each, as cup.layout: [0.05, 0.0, 0.0, -0.05, 0.0, 0.0].')
    return replace(named, places=tuple(map(tuple, places.tolist())))


def fitted_structure(values: Values) -> Structure:
    """Return the structure of a fit; raise for cup.layout with a single cup's structure."""
    given = given_structure(values)
    if any(values.get('cup.layout', ())) and not given.places:
        raise BellowsError(
            'cup.layout describes a gripper of several cups, whose cup.stiffness is of one, but '
            f'fit.structure: {given.name} is of a single cup. Set fit.structure: layout, or leave '
            'cup.layout out to fit the gripper as one cup (fit.structure: full).')
    return given


def grip_of(
    values: Values, vacuum: float | None = None, of_cups: Mapping[int, float] = NO_CUPS
) -> Grip | None:
    """
    Return the grip in parameter values, or None if it is incomplete.

    Parameters
    ----------
    values : mapping
        Parameters by name: cup.lip_radius, cup.suction_area, cup.friction, vacuum.holding.
    vacuum : float, optional
        Measured pressure below ambient (Pa), instead of vacuum.holding.
    of_cups : mapping of int to float
        Measured pressure below ambient (Pa) in single cups of a gripper; the other cups have
        `vacuum`, the smallest of these pressures.

    """
    radius = float(values.cup.lip_radius)
    pressure = float(values.vacuum.holding) if vacuum is None else max(vacuum, 0.0)
    if radius == 0.0 or (vacuum is None and pressure == 0.0):
        return None
    area = float(values.cup.suction_area) or math.pi * radius * radius
    grip, places = (pressure * area, radius, float(values.cup.friction)), places_of(values)
    if structure.is_single(places):
        return grip
    relative = [max(of_cups.get(int(index), pressure), 1.0) / max(pressure, 1.0)
                for index in places[:, 3]]  # at least 1 Pa, for a finite ratio
    return *grip, np.column_stack([places, relative])


def parameter_envelope(values: Values) -> Envelope | None:
    """Return the validity range in parameter values, or None if deflections are unknown."""
    valid = box_of(values)
    return valid if valid.is_known else None


def box_of(values: Values) -> Envelope:
    """Return the validity range in parameter values, possibly unknown."""
    return Envelope(np.array(values.cup.valid_low), np.array(values.cup.valid_high))


def tip_of(values: Values) -> Array | None:
    """Return the pose (4, 4) of E in the frame of the tool's poses, None if both are equal."""
    pose = np.array(values.get('tool_pose.offset', '').split(), float)
    return lie.transform(lie.quaternion_to_rotation(pose[3:]), pose[:3]) if len(pose) else None


def gravity_of(values: Mapping[str, Any]) -> Array:
    """Return the acceleration (3,) of gravity in the world, m/s^2, of parameter values."""
    direction = np.asarray(values['gravity.direction'], dtype=np.float64)
    return np.asarray(values['gravity.magnitude'] * (direction / np.linalg.norm(direction)))


def uncertain_of(values: Values) -> Uncertain:
    """Return the parameters of cup and package with standard deviations and the cups' places."""
    return Uncertain(parameter_vector(values), parameter_std(values), places_of(values))


def release_of(values: Values) -> Release:
    """
    Return release and landing from parameter values.

    Raises
    ------
    BellowsError
        If the size of the package is missing.

    """
    size = values.package.size
    if not min(size) > 0.0:
        raise BellowsError(
            f'package.size is {list(size)}; expected three sides above 0 m, since the landing '
            'depends on the corners. Set it, for example package.size: [0.3, 0.2, 0.15].')
    x, y, z = (0.5 * side for side in size)
    return Release(release_law_of(values), (x, y, z), values.landing.height)


def release_law_of(values: Values) -> Law:
    """
    Return the law of release from parameter values.

    Raises
    ------
    BellowsError
        If a cup opens without a closing force.

    """
    law: Any = tuple(values[name] for name in RELEASE_NAMES)
    if law[3] > 0.0 and not law[2] > 0.0:
        raise BellowsError(
            f'release.closing is {law[2]:g} N, but release.opening {law[3]:g} m; expected a force '
            'above 0 that closes the cup. Take both from bellows identify --release.')
    return law  # type: ignore[no-any-return]


def release_factor(values: Values) -> Array:
    """
    Return L (6, 6), where L L^T is the covariance of the law of release; unused rows are 0.

    Outside the masses (release.mass_range) of the fitted law, the covariance of the law is larger.
    """
    std = np.array(values.release.std) * (1.0 + EXTRAPOLATION * beyond_masses(values))
    if not values.release.opening:
        std[2:] = 0.0
    size, axes = np.linalg.eigh(np.reshape(values.release.correlation, (6, 6)))
    root = (axes * np.sqrt(np.maximum(size, 0.0))) @ axes.T  # rounded ones may be indefinite
    return np.asarray(std[:, None] * root)


def with_assumed_release(values: Values) -> Values:
    """Return values with a delay uncertain by 0 to `MAX_DELAY`, if at most a delay is given."""
    if any(release_law_of(values)[1:]) or any(values.release.std):
        return values
    return values.replaced({
        'release.delay': values.release.delay or 0.5 * MAX_DELAY,
        'release.std': (MAX_DELAY / 12.0**0.5, *(0.0,) * 5)})


def beyond_masses(values: Values) -> float:
    """Return the logarithmic distance of the package from release.mass_range; 0 without one."""
    mass, (lightest, heaviest) = values.package.mass, values.release.mass_range
    return max(0.0, math.log(lightest / mass), math.log(mass / heaviest)) if lightest else 0.0
