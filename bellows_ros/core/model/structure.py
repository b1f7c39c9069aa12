"""
Structures of K and P: free entries, tied entries, and the sum of equal cups.

A new structure is one entry in `STRUCTURES`; methods and tables use all entries.

Cup i of a gripper stands at a_i in E, and its lip at a_i in S. Its strain (3.18) and twist are
linear in strain and twist of a cup at the origin, h_i = A_i h and v_i = A_i v, A_i = [[I, -a_i^],
[0, I]], as (I + R^T)(R - I) a = (R - R^T) a. Hence K = sum A_i^T K_1 A_i and P = sum A_i^T P_1 A_i
describe exactly one equivalent cup of the same kernel, at any rotation and in motion.

Checks of parameter values: a 6x6 matrix is 36 numbers, row-major; an inertia is [ixx, iyy, izz,
ixy, ixz, iyz]; units are SI.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
import math

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.geometry.lie import adjoint, transform
from bellows_ros.core.signals.residuals import AXES
from bellows_ros.errors import BellowsError
import numpy as np
from numpy.typing import ArrayLike

THESIS_STIFFNESS = (6417.0, 6417.0, 1.153e4, 3.868, 3.868, 1.123)
THESIS_DAMPING = (66.06, 66.06, 22.35, 0.05458, 0.05458, 0.09736)
THESIS_LENGTH = 0.0481
"""Length l0 of the cup in chapter 3 of the thesis, m."""

MAX_CUPS = 32
"""Largest number of cups."""

REACH = 2.0
"""Largest distance of a cup from E, m."""

CLEARANCE = 5e-3
"""Smallest distance of two cups, m."""

UPPER = np.triu_indices(6)
SINGLE = np.zeros((1, 4))
"""Places of a single cup at E."""


def positions_of(layout: Sequence[float]) -> Array:
    """
    Return the positions (n, 3) of cups in E, m.

    Raises
    ------
    BellowsError
        If the positions are not x, y, z of 1 to 32 cups, or not plausible for a gripper.

    """
    if not layout or len(layout) % 3:
        raise BellowsError(
            f'cup.layout has {len(layout)} numbers; expected x, y and z of each cup in the tool, '
            'one cup after the other: [0.05, 0.0, 0.0, -0.05, 0.0, 0.0] for two.')
    places = np.reshape(np.array(layout, dtype=np.float64), (-1, 3))
    if len(places) > MAX_CUPS:
        raise BellowsError(
            f'cup.layout has {len(places)} cups; expected at most {MAX_CUPS}. Fit a gripper of '
            'more as one cup (fit.structure: full).')
    farthest = float(np.abs(places).max())
    if farthest > REACH:
        raise BellowsError(
            f'cup.layout has a cup {farthest:g} m from the tool; expected at most {REACH:g} m. '
            'Is it in mm?')
    gaps = np.linalg.norm(places[:, None] - places, axis=2) + np.diag([np.inf] * len(places))
    i, j = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
    if gaps[i, j] < CLEARANCE:
        raise BellowsError(
            f'cup.layout: cups {min(i, j)} and {max(i, j)} are {1e3 * gaps[i, j]:.3g} mm apart; '
            f'expected at least {1e3 * CLEARANCE:g} mm. Give each cup once, in m.')
    return places


def is_single(places: Array) -> bool:
    """Return whether places (n, 4) are a single cup at E."""
    return len(places) == 1 and not places[0, :3].any()


def maps(places: Array) -> Array:
    """Return A (n, 6, 6), from strain and twist at the origin to strain and twist of each cup."""
    return adjoint(transform(np.eye(3), -places[:, :3]))


def composed(matrix: Array, places: Array) -> Array:
    """Return K or P (6, 6) of the gripper from K_1 or P_1 of one cup: sum A_i^T K_1 A_i."""
    if is_single(places):
        return matrix
    A = maps(places)
    return np.asarray(np.einsum('nki,kl,nlj->ij', A, matrix, A))


def composition(places: Array) -> Array:
    """Return C (21, 21), from the upper triangle of one cup's matrix to the gripper's, by rows."""
    units = STRUCTURES['full'].basis
    return np.column_stack([composed(unit, places)[UPPER] for unit in units])


RELAXATION_TIMES = (0.06, 0.8)
"""Times of the two branches of relaxing rubber, s; fits with other times have errors within 0.1
%."""

CoupledAxes = tuple[tuple[int, float], ...]
"""Axes coupled with each other, each with its sign."""

Entry = tuple[int, int, float]
"""Row and column in the upper triangle, and the sign of the parameter in this entry."""


@dataclass(frozen=True)
class Structure:
    """
    A linear family of symmetric 6x6 matrices, the same for K and for P.

    Parameters
    ----------
    name : str
        As in fit.structure.
    meaning : str
        Assumption on the cup, in a few words.
    groups : tuple of str
        Blocks of coupled axes. Blocks joined by '=' have equal numbers, and a minus inverts an
        axis: 'x ry = y -rx' stands for K[x,x] = K[y,y], K[ry,ry] = K[rx,rx], K[x,ry] = -K[y,rx].
        Axes of different blocks are not coupled.
    places : tuple of (x, y, z, index)
        Positions (m, in E) of cups of a gripper, each with these K and P; empty for one cup.

    """

    name: str
    meaning: str
    groups: tuple[str, ...]
    places: tuple[tuple[float, ...], ...] = ()

    @cached_property
    def blocks(self) -> tuple[tuple[CoupledAxes, ...], ...]:
        """The blocks of each group, which hold the same parameters."""
        def coupled(block: str) -> CoupledAxes:
            """Return the axes of a block such as 'x -ry', and their signs."""
            return tuple((AXES.index(axis.lstrip('-')), -1.0 if '-' in axis else 1.0)
                         for axis in block.split())

        return tuple(tuple(map(coupled, group.split('='))) for group in self.groups)

    @cached_property
    def entries(self) -> tuple[tuple[Entry, ...], ...]:
        """For every parameter of one matrix its entries, the first with sign +1."""
        parameters = []
        for blocks in self.blocks:
            for i, j in combinations_with_replacement(range(len(blocks[0])), 2):
                pairs = [sorted((block[i], block[j])) for block in blocks]
                entries = [(row, column, sign * other)
                           for (row, sign), (column, other) in pairs]
                lead = min(entries)[2]
                parameters.append(tuple(sorted(
                    (row, column, sign * lead) for row, column, sign in entries)))
        return tuple(sorted(parameters))

    @property
    def leads(self) -> tuple[tuple[int, int], ...]:
        """Row and column of the first entry of every parameter."""
        return tuple(entries[0][:2] for entries in self.entries)

    @property
    def size(self) -> int:
        """Number of free parameters of one matrix."""
        return len(self.entries)

    @property
    def couplings(self) -> list[int]:
        """Indices of the couplings among the parameters (2 n,)."""
        return [place for place, (i, j) in enumerate(2 * self.leads) if i != j]

    @property
    def couples(self) -> bool:
        """Whether the structure couples directions, and the weight of a fit components."""
        return any(len(blocks[0]) > 1 for blocks in self.blocks)

    @property
    def tied_axes(self) -> tuple[tuple[int, ...], ...]:
        """Axes that share their entries on the diagonal."""
        return tuple(tuple(row for row, _, _ in entries) for entries in self.entries
                     if entries[0][0] == entries[0][1])

    @cached_property
    def basis(self) -> list[Array]:
        """The symmetric matrices (6, 6) of the parameters' units."""
        matrices = np.zeros((self.size, 6, 6))
        for unit, entries in zip(matrices, self.entries, strict=True):
            for row, column, sign in entries:
                unit[row, column] = unit[column, row] = sign
        return list(matrices)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the parameters: 'K x', 'K rx', 'K x-rz', ..., 'P x', ..."""
        names = [AXES[i] if i == j else f'{AXES[i]}-{AXES[j]}' for i, j in self.leads]
        return tuple(f'{matrix} {name}' for matrix in 'KP' for name in names)

    @cached_property
    def model_basis(self) -> list[Array]:
        """Matrix (6, 6) of the cup or gripper for a unit of each parameter."""
        if not self.places:
            return self.basis
        return [composed(unit, np.array(self.places)) for unit in self.basis]

    def matrices(self, x: Array) -> tuple[Array, Array]:
        """Return K and P (6, 6) of the parameters x (2 n,)."""
        K, P = (np.tensordot(half, np.array(self.basis), axes=1) for half in np.split(x, 2))
        return K, P

    def spread(self, errors: Array) -> tuple[Array, Array]:
        """Return errors (6, 6) of K and P from errors (2 n,) of parameters, possibly infinite."""
        K, P = np.where(self.basis, errors.reshape(2, -1, 1, 1), 0.0).max(axis=1)
        return K, P

    def parameters(self, stiffness: Array, damping: Array) -> Array:
        """Return the parameters x (2 n,) nearest to K and P: means of tied entries."""
        return np.array([
            np.mean([sign * matrix[row, column] for row, column, sign in entries])
            for matrix in (stiffness, damping)
            for entries in self.entries])

    def sizes(self, stiffness: Array, damping: Array) -> Array:
        """Return the scale of each parameter (2 n,): geometric mean of its diagonal entries."""
        i, j = np.array(self.leads).T
        return np.concatenate([np.sqrt(np.abs(M[i, i] * M[j, j])) for M in (stiffness, damping)])

    def covariance(self, count: int, mean: Array, scatter: Array) -> Array:
        """
        Return Q (6, 6) of six-vectors in the form of this structure.

        Each block is a full covariance (4.69); equal blocks share one covariance, about their
        common mean (4.80).

        Parameters
        ----------
        count : int
            Number of vectors.
        mean : ndarray (6,)
            Mean of the vectors.
        scatter : ndarray (6, 6)
            Sum of the products of their deviations from the mean.

        """
        Q = np.zeros((6, 6))
        for blocks in self.blocks:
            axis, sign = np.moveaxis(np.array(blocks), -1, 0)
            axis = axis.astype(np.intp)
            rows, columns = axis[:, :, None], axis[:, None]
            signs = sign[:, :, None] * sign[:, None]
            off = mean[axis] * sign
            off -= off.mean(axis=0)
            total = np.sum(
                scatter[rows, columns] * signs + count * off[:, :, None] * off[:, None], axis=0)
            Q[rows, columns] = total * signs / (len(blocks) * count - 1)
        return Q


STRUCTURES = {structure.name: structure for structure in (
    Structure('axisymmetric', 'diagonal and equal laterally', ('x = y', 'z', 'rx = ry', 'rz')),
    Structure('axisymmetric_coupled', 'as axisymmetric, with its centre of stiffness anywhere on '
              'the axis', ('x ry = y -rx', 'z', 'rz')),
    Structure('diagonal', 'no coupling of directions', ('x', 'y', 'z', 'rx', 'ry', 'rz')),
    Structure('full', 'any symmetric matrix', ('x y z rx ry rz',)))}
"""Structures by name, from the simplest to the most general."""


OF_LAYOUT = Structure('layout', 'each cup of cup.layout axisymmetric',
                      STRUCTURES['axisymmetric'].groups)
"""Structure of one cup of a gripper; `places` are filled in."""

AUTO = 'auto'
"""Value of fit.structure for the automatic selection from `AUTO_STRUCTURES`."""

AUTO_STRUCTURES = STRUCTURES['axisymmetric'], STRUCTURES['axisymmetric_coupled']
"""Candidates of the automatic selection, the simpler one first."""

STRUCTURE_NAMES = (AUTO, *STRUCTURES, OF_LAYOUT.name)


def structure_named(name: str) -> Structure:
    """Return the structure with a name, or raise BellowsError with a list of the names."""
    if name not in STRUCTURE_NAMES:
        raise BellowsError(
            f"fit.structure is '{str(name)[:40]}'; expected one of {', '.join(STRUCTURE_NAMES)}.")
    return AUTO_STRUCTURES[0] if name == AUTO else STRUCTURES.get(name, OF_LAYOUT)


ROUNDING = 1e-12
"""Relative size of eigenvalues that are rounding errors."""

MIN_STIFFNESS = 1e-6
"""Smallest eigenvalue of a stiffness matrix: one millionth of a soft cup's, N/m or N m/rad."""


def matrix(values: ArrayLike) -> Array:
    """Return 36 numbers, row-major, as a 6x6 matrix."""
    return np.array(values, dtype=np.float64).reshape(6, 6)


def inertia_matrix(values: ArrayLike) -> Array:
    """Return [ixx, iyy, izz, ixy, ixz, iyz] as a symmetric 3x3 matrix."""
    xx, yy, zz, xy, xz, yz = np.array(values, dtype=np.float64)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def require_stiffness(stiffness: Array, name: str = 'cup.stiffness') -> None:
    """
    Raise BellowsError unless a 6x6 matrix is symmetric positive definite and stiff enough.

    Raises
    ------
    BellowsError
        The error names the smallest eigenvalue.

    """
    require_symmetric(stiffness, name)
    smallest = float(np.linalg.eigvalsh(stiffness)[0])
    if smallest < MIN_STIFFNESS:
        what = 'not positive definite' if smallest <= 0.0 else 'too soft to hold a package'
        raise BellowsError(
            f'{name} is {what}: its smallest eigenvalue is {smallest:.6g}, expected at least '
            f'{MIN_STIFFNESS:g}. Check signs, rows and units (N/m, N and N m/rad), or identify it '
            'again.')


def require_damping(damping: Array, name: str = 'cup.damping') -> None:
    """
    Raise BellowsError for a 6x6 matrix that is not symmetric positive semidefinite.

    Raises
    ------
    BellowsError
        The error names the smallest eigenvalue.

    """
    require_symmetric(damping, name)
    smallest = float(np.linalg.eigvalsh(damping)[0])
    if smallest < -ROUNDING * float(np.abs(damping).max()):
        raise BellowsError(
            f'{name} is not positive semidefinite: its smallest eigenvalue is {smallest:.6g}, '
            'but a negative one would let the cup create energy. Check signs and rows, or '
            'identify it again.')


def has_coupling(stiffness: Array) -> bool:
    """Return whether K[x, ry] shifts the centre of stiffness out of the middle of the cup."""
    couplings = np.abs([stiffness[0, 4], stiffness[1, 3]])
    return bool(np.any(couplings > 1e-4 * stiffness[[0, 1], [0, 1]]))  # m


STRETCH_RANGE = 5e-3
"""Axial range about the nominal length for the check of a cup without a validity range, m."""


def require_stretch(
    stiffness: Array, stretch: Sequence[float], low: float = -STRETCH_RANGE,
    high: float = STRETCH_RANGE,
) -> None:
    """
    Raise BellowsError if coefficients a and b make the energy indefinite in an axial range (m).

    At an axial shift s the energy is 1/8 h^T (K + 16 s diag(0, 0, a, b, b, 0)) h, as h_z = 2 s.

    Raises
    ------
    BellowsError
        The error names the shift at which the energy is not positive.

    """
    slope = 16.0 * np.diag([0.0, 0.0, stretch[0], stretch[1], stretch[1], 0.0])
    for shift in (low, high):
        if any(stretch) and float(np.linalg.eigvalsh(stiffness + shift * slope)[0]) <= 0.0:
            raise BellowsError(
                f'cup.stretch is [{stretch[0]:g}, {stretch[1]:g}], with which the energy of the '
                f'cup is not above 0 at an axial shift of {1e3 * shift:.3g} mm; expected a '
                f'one above 0 from {1e3 * low:.3g} to {1e3 * high:.3g} mm, the validity range. '
                'Set cup.stretch: [0.0, 0.0], or identify the cup again.')


def require_symmetric(values: Array, name: str) -> None:
    """Raise BellowsError, with the entries that differ most, for an asymmetric matrix."""
    asymmetry = np.abs(values - values.T)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(asymmetry)), values.shape))
    if asymmetry[row, column] > 1e-9 * float(np.max(np.abs(values))):
        raise BellowsError(
            f'{name} is not symmetric: row {row + 1}, column {column + 1} is '
            f'{values[row, column]:.9g}, row {column + 1}, column {row + 1} is '
            f'{values[column, row]:.9g}. Give the same number to both, row by row.')


INERTIA_STD = 0.05
"""Relative standard deviation of moments of inertia if none is given."""

INERTIA_ROUNDING = 1e-3
"""Tolerance for rounded moments of inertia, relative; without it rounded thin plates are
rejected."""


def check_inertia(inertia: Array, std: ArrayLike = 0.0) -> None:
    """
    Raise BellowsError unless a rigid body can have this inertia tensor (3, 3), kg m^2.

    The tensor must be symmetric and positive definite, and no principal moment above the sum of
    the other two by more than rounding, or the standard deviations (3,) of the moments.
    """
    require_symmetric(inertia, 'package.inertia')
    moments = np.linalg.eigvalsh(inertia)
    excess, others = moments[2] - moments[0] - moments[1], moments[0] + moments[1]
    if moments[0] <= 0.0 or excess > max(INERTIA_ROUNDING * others, float(np.linalg.norm(std))):
        raise no_body(moments.tolist())


def no_body(moments: Sequence[float]) -> BellowsError:
    """Return the error for principal moments of inertia (3,), kg m^2, of an impossible body."""
    shown = ', '.join(f'{moment:.6g}' for moment in moments)
    return BellowsError(
        f'No body has this package.inertia: its principal moments are {shown} kg m^2; expected '
        'all above zero, and the largest at most the sum of the other two. Check units (kg m^2), '
        'signs and the order ixx, iyy, izz, ixy, ixz, iyz.')


MIN_MASS = 0.01
"""Smallest plausible mass of a package, kg."""

MAX_MASS = 50.0
"""Largest plausible mass of a package, kg."""

MAX_GYRATION = 1.0
"""Largest plausible radius of gyration of a package, and distance of its com from the lip, m."""

SOFT = 30.0
"""Smallest plausible stiffness in translation, N/m."""

MAX_PLAUSIBLE_LENGTH = 0.3
"""Largest plausible length of a cup, m."""

LEVER = (1e-3, 0.5)
"""Plausible range of the lever arm sqrt(K rotational / K translational) of a cup, m."""


def unit_doubts(
    mass: float, moments: Sequence[float], com: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[str, ...]:
    """
    Return a question for each of a package's numbers that is likely in another unit.

    Parameters
    ----------
    mass : float
        Mass, kg.
    moments : sequence of float
        Moments of inertia about x, y and z, kg m^2.
    com : sequence of float
        Centre of mass in the lip frame, m.

    """
    doubts, height = [], com[2]
    if height > 0.0:
        doubts.append(
            f'package.com is {height:g} m above the lip, inside the cup; z points into the arm. '
            f'Is it {-height:g}?')
    if (away := float(np.linalg.norm(com))) > MAX_GYRATION:
        doubts.append(
            f'package.com is {away:g} m from the lip; expected up to {MAX_GYRATION:g} m. Is it in '
            'another unit?')
    if not MIN_MASS <= mass <= MAX_MASS:
        doubts.append(
            f'package.mass is {mass:g} kg; cups of this kind carry {MIN_MASS:g} to '
            f'{MAX_MASS:g} kg. Is it in another unit?')
    gyration = math.sqrt(float(np.sum(moments))) / math.sqrt(mass)  # also of the smallest mass
    if gyration > MAX_GYRATION:
        doubts.append(
            f'package.inertia has a radius of gyration of {gyration:.3g} m; expected up to '
            f'{MAX_GYRATION:g} m. Is it in kg m^2?')
    return tuple(doubts)


def cup_doubts(stiffness: Array, length: float) -> tuple[str, ...]:
    """Return a question for each number of a cup, K (6, 6) and length (m), of unlikely size."""
    diagonal = np.diag(stiffness)
    least, radius = float(diagonal[:3].min()), float(np.sqrt(
        diagonal[3:].max() / max(diagonal[:3].max(), 1e-12)))
    doubts = []
    if least < SOFT:
        doubts.append(
            f'cup.stiffness has {least:g} N/m in translation; cups of this kind have at least '
            f'{SOFT:g} N/m. Is it in N/mm?')
    elif not LEVER[0] <= radius <= LEVER[1]:
        doubts.append(
            f'cup.stiffness in rotation is that of a spring in translation at {radius:.3g} m from '
            f'the axis; expected {LEVER[0]:g} to {LEVER[1]:g} m. Are both in N/m and N m/rad?')
    if length > MAX_PLAUSIBLE_LENGTH:
        doubts.append(f'cup.length is {length:g} m; cups of this kind have up to '
                      f'{MAX_PLAUSIBLE_LENGTH:g} m. Is it in another unit?')
    return tuple(doubts)
