"""
Safety factors of a vacuum grip against peel and slip; data of its release.

The safety factor of a gripper is the smallest safety factor of its cups, each with its own wrench;
K_1 and P_1 of one cup follow from the sums K and P (see `structure`). The vacuum presses the
package on a lip with V = pressure below ambient times effective area (N). The wrench (f, m) of the
cup on the package is taken at S in S axes: f_z > 0 pulls the package into the cup, and the contact
force of the lip is N = V - f_z. A safety factor is the largest s for which the lip holds the
wrench s (f, m) with the same V. The safety factor is infinite if the lip holds any multiple, and
below 1 if the grip is lost.
"""

import math
from typing import NamedTuple

from bellows_ros.core.findings import Finding, Level
from bellows_ros.core.geometry import tuples as t3
from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.jit import entry, kernel
from bellows_ros.core.geometry.tuples import Matrix, Vector, ZERO
from bellows_ros.core.model import kernels
from bellows_ros.core.model.kernels import Blocks, CupTuple, ModelTuple, State, Strains, Wrench
from bellows_ros.core.model.simulation import row_state
import numpy as np

Grip = tuple[float, float, float, *tuple[Array, ...]]
"""Suction force V (N), lip radius r (m) and friction of one cup. For a gripper, V, r and friction
are of the cup with the least suction; an array (n, 5) follows with the holding cups: the rows of
`places_of`, and the suction force relative to V."""

MODES = ('peel', 'slip')
"""Failure modes of the grip; an elastic lip peels before it tips."""

RELEASE_NAMES = tuple(f'release.{name}' for name in (
    'delay', 'fall', 'closing', 'opening', 'damping', 'sticking'))
"""Parameters of the law of release, in the order of `Law`."""

Law = tuple[float, float, float, float, float, float]
"""Law of release: delay of the suction's fall (s), time in which the suction falls to 0 (s),
closing force F0 of the bellows (N), stretch L at which open bellows pull with F0 (m, 0 for none),
damping of the open bellows along z (N s/m, 0 for the cup's damping), and sticking of the lip
relative to the holding suction."""
NO_LAW: Law = (0.0,) * 6
"""Law of a cup with immediate release."""


class Release(NamedTuple):
    """Data of valve, cup, package and floor."""

    law: Law
    half: Vector
    """Half the sides of the package's box along x, y, z of B, m."""
    height: float
    """Height of the floor, from the world's origin against gravity, m."""


NO_FLIGHT = Release(NO_LAW, (0.0, 0.0, 0.0), math.inf)
"""Release of a package without a flight."""


@kernel
def ratio(suction: float, load: float) -> float:
    """Return suction / load, or infinity without a load."""
    return suction / load if load > 0.0 else math.inf


@kernel
def peel_load(radius: float, f: Vector, m: Vector) -> float:
    """Return the suction force (N) at or below which the lip peels, f_z + 2 m_t / r."""
    return f[2] + 2.0 * math.sqrt(m[0] * m[0] + m[1] * m[1]) / radius


@entry
def safety_factors(grip: tuple[float, float, float], f: Vector, m: Vector) -> tuple[float, float]:
    """
    Return the safety factors against peel and slip, as in `MODES`.

    The lip does not peel if the pressure on an elastic lip is nonnegative all around, 2 m_t / r <=
    N. The lip does not slip if q <= friction N, where q combines lateral force and moment as q^2 =
    f_t^2 + (m_z / r)^2. A thin ring with Coulomb friction holds less under a lateral force
    combined with m_z: the factor is up to 11 % too large, and up to 33 % under strong bending.
    """
    suction, radius, friction = grip
    twist = m[2] / radius
    q = math.sqrt(f[0] * f[0] + f[1] * f[1] + twist * twist)
    return (
        ratio(suction, peel_load(radius, f, m)), ratio(friction * suction, q + friction * f[2]))


@kernel
def one_of(M: Blocks, places: Array) -> Blocks:
    """Return the blocks of one cup from the gripper's, the inverse of `composed`."""
    n = float(len(places))
    oo = t3.scale_matrix(1.0 / n, M[0])
    total, squares = ZERO, t3.scale_matrix(0.0, M[0])
    for k in range(len(places)):
        place = (places[k, 0], places[k, 1], places[k, 2])
        a, total = t3.hat(place), t3.add(total, place)
        squares = t3.add_scaled_matrix(squares, 1.0, t3.multiply(t3.multiply(a, oo), a))
    S = t3.hat(total)
    oR = t3.scale_matrix(1.0 / n, t3.add_scaled_matrix(M[1], 1.0, t3.multiply(oo, S)))
    mixed = t3.multiply(S, oR)  # S oR - oR^T S is twice its symmetric part
    RR = t3.add_scaled_matrix(t3.add_scaled_matrix(M[2], -1.0, mixed), -1.0, t3.transposed(mixed))
    return oo, oR, t3.scale_matrix(1.0 / n, t3.add_scaled_matrix(RR, 1.0, squares))


@entry
def cup_of_gripper(cup: CupTuple, places: Array) -> CupTuple:
    """Return one cup of a gripper."""
    return (cup[0], cup[1], one_of(cup[2], places), one_of(cup[3], places), *cup[4:])


@kernel
def wrench_at(
    one: CupTuple, a: Vector, o: Vector, R: Matrix, v: Vector, w: Vector, strains: Strains
) -> Wrench:
    """
    Return the wrench of one cup of a gripper on the package, at its lip in S axes.

    The position of the cup is a. Pose and twist are of S; internal strains are of the gripper.
    """
    o = t3.add(o, t3.subtract(t3.apply(R, a), a))
    return kernels.cup_wrench(one, o, R, t3.add(v, t3.cross(w, a)), w, strains_at(strains, a))


@kernel
def strains_at(strains: Strains, a: Vector) -> Strains:
    """Return the internal strains A z of one cup, from the strains z of the gripper."""
    if len(strains) == 0:
        return ()
    (b, c), (d, e) = strains
    return ((t3.subtract(b, t3.cross(a, c)), c), (t3.subtract(d, t3.cross(a, e)), e))


@entry
def least_factors(
    grip: Grip, cup: CupTuple, o: Vector, R: Matrix, v: Vector, w: Vector, strains: Strains,
    f: Vector, m: Vector,
) -> tuple[float, float, int, int]:
    """
    Return the smallest safety factors against peel and slip, and the rows of the two cups.

    Pose and twist are of S in E, as `cup_wrench` takes them, and (f, m) is its wrench.
    """
    if len(grip) == 3:
        peel, slip = safety_factors(grip, f, m)
        return peel, slip, 0, 0
    (places,) = grip[3:]
    one = cup_of_gripper(cup, places)
    peel, slip, peeling, slipping = math.inf, math.inf, 0, 0
    for k in range(len(places)):
        f, m = wrench_at(one, (places[k, 0], places[k, 1], places[k, 2]), o, R, v, w, strains)
        factors = safety_factors((grip[0] * places[k, 4], grip[1], grip[2]), f, m)
        if factors[0] < peel:
            peel, peeling = factors[0], k
        if factors[1] < slip:
            slip, slipping = factors[1], k
    return peel, slip, peeling, slipping


@kernel
def largest_peel_load(grip: Grip, model: ModelTuple, tool: State, body: State) -> float:
    """Return the smallest V (N) of the grip at which no cup peels."""
    cup, package, _ = model
    o, R, v, w = kernels.lip_relative_to_tool(package[1], tool, body)
    if len(grip) == 3:
        f, m = kernels.cup_wrench(cup, o, R, v, w, body[4:])
        return peel_load(grip[1], f, m)
    (places,) = grip[3:]
    one, load = cup_of_gripper(cup, places), -math.inf
    for k in range(len(places)):
        f, m = wrench_at(one, (places[k, 0], places[k, 1], places[k, 2]), o, R, v, w, body[4:])
        load = max(load, peel_load(grip[1], f, m) / places[k, 4])
    return load


@entry
def factors_along(model: ModelTuple, grip: Grip, tool: Array, body: Array) -> Array:
    """
    Return safety factors (N, 2), as in `MODES`, and the rows (N, 2) of the weakest cups.

    Motions are rows (N, 13) of tool and package.
    """
    out = np.empty((len(tool), 4))
    for k in range(len(tool)):
        lip = kernels.lip_relative_to_tool(model[1][1], row_state(tool[k]), row_state(body[k]))
        f, m = kernels.cup_wrench(model[0], *lip)
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = least_factors(
            grip, model[0], *lip, (), f, m)
    return out


def mode_name(grip: Grip, mode: int, row: int) -> str:
    """Return the name of a failure mode, for a gripper with index and place of the cup."""
    if len(grip) == 3:
        return MODES[mode]
    (places,) = grip[3:]
    x, y, z, index, _ = places[row].tolist()
    height = f', z {z:g} m' if z else ''
    return f'{MODES[mode]} of cup {index:.0f} at x {x:g} m, y {y:g} m{height}'


class Margin(NamedTuple):
    """The smallest safety factor of a motion, its mode, and its time, s."""

    factor: float
    mode: str
    time: float

    @property
    def finding(self) -> Finding:
        """The margin as a finding."""
        place = f'{self.mode}, at {self.time:.2f} s'
        return safety_finding(self.factor, place, 0.0, 1.0) or Finding(
            'grip', Level.OK, {'factor': self.factor, 'mode': place, 'lower': ''})


def margin(grip: Grip, factors: Array, seconds: Array) -> Margin:
    """Return the smallest of `factors_along` (N, 4) at times (N,), ignoring NaN."""
    row, mode = np.unravel_index(np.nanargmin(factors[:, :2]), (len(factors), 2))
    return Margin(
        float(factors[row, mode]), mode_name(grip, int(mode), int(factors[row, 2 + mode])),
        float(seconds[row]))


def safety_finding(
    factor: float, mode: str, std: float, required: float
) -> Finding | None:
    """Return the finding on a safety factor that is too small, else None."""
    if math.isinf(factor) or (factor >= 1.0 and factor - 2.0 * std >= required):
        return None
    return Finding('grip', Level.ERROR if factor < 1.0 else Level.WARN, {
        'factor': factor, 'mode': mode, 'required': required, 'lower': (
            f', {factor - 2.0 * std:.3g} less two standard deviations' if std else '')})
