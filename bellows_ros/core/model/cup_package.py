"""Cup and package as frozen data, the regressor, and the effect of uncertain parameters."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, InitVar, replace
from functools import cached_property
from typing import Any, NamedTuple
import warnings

from bellows_ros.core.geometry.arrays import Array, real_numbers
from bellows_ros.core.model import kernels, pseudo_inertia, structure
from bellows_ros.core.model.kernels import Blocks, CupTuple, ModelTuple, PackageTuple
from bellows_ros.core.model.structure import SINGLE, UPPER
from bellows_ros.errors import BellowsError, UnitWarning
import numpy as np
from numpy.typing import ArrayLike, NDArray

STANDARD_GRAVITY = 9.81
"""Gravitational acceleration in the thesis, m/s^2."""

MAX_LENGTH = 1.0
"""Largest length of a cup, m."""

PERTURBATION = 0.5
"""Step of the central differences of `contributions`, standard deviations."""

PARAMETER_NAMES = (
    *(f'{kind}[{i},{j}]' for kind in ('cup.stiffness', 'cup.damping')
      for i, j in zip(*UPPER, strict=True)),
    'package.mass', *(f'package.com[{axis}]' for axis in 'xyz'),
    *(f'package.inertia[{entry}]' for entry in ('xx', 'yy', 'zz', 'xy', 'xz', 'yz')))
"""Names of the uncertain parameters (52,) of cup and package, in the order of arrays."""


@dataclass(frozen=True)
class Term:
    """
    The declaration of a term of a cup: an attribute of `Cup`, and the parameter of this name.

    Parameters
    ----------
    name : str
        Name of the attribute. The layout has none, as a `Cup` is equivalent to a whole gripper.
    units : tuple of str
        Units of the numbers, '' without; of a matrix, of translation, coupling and rotation.
    default : float or tuple of float
        Default of the parameter: of the cup of the thesis, or of a cup without the term.
    require : callable, optional
        Function of the term that raises BellowsError if no cup can have it.
    is_matrix : bool
        Whether the term is a symmetric (6, 6) matrix, in parameters 36 numbers, row-major.
    symbols : tuple of str
        Symbols of the numbers of a term that extends the law of K and P; () for others.
    effect : str
        Effect of a term of the law, in words.
    by_sign : tuple of str
        Effect if the first number is above 0, and if it is below 0; () if it has one sign.
    is_additive : bool
        Whether equal cups with a term of the law are together a cup with this law.

    """

    name: str
    units: tuple[str, ...]
    default: float | tuple[float, ...]
    require: Callable[[Any], object] | None = None
    is_matrix: bool = False
    symbols: tuple[str, ...] = ()
    effect: str = ''
    by_sign: tuple[str, ...] = ()
    is_additive: bool = True

    @property
    def parameter(self) -> str:
        """Name of the parameter."""
        return f'cup.{self.name}'

    def from_parameter(self, value: Any) -> Any:
        """Return the term of the value of its parameter."""
        return structure.matrix(value) if self.is_matrix else value

    def to_parameter(self, value: Any) -> Any:
        """Return the value of the parameter."""
        return tuple(value.ravel().tolist()) if self.is_matrix else value


def _diagonal(numbers: Sequence[float]) -> tuple[float, ...]:
    """Return a diagonal matrix as 36 numbers."""
    return tuple(np.diag(numbers).ravel().tolist())


TERMS: Mapping[str, Term] = {term.name: term for term in (
    Term('stiffness', ('N/m', 'N', 'N m/rad'), _diagonal(structure.THESIS_STIFFNESS),
         structure.require_stiffness, is_matrix=True),
    Term('damping', ('N s/m', 'N s', 'N m s/rad'), _diagonal(structure.THESIS_DAMPING),
         structure.require_damping, is_matrix=True),
    Term('length', ('m',), structure.THESIS_LENGTH),
    Term('relaxation', ('', ''), (0.0, 0.0), symbols=('r1', 'r2'),
         effect='The rubber relaxes (K is the static stiffness)'),
    Term('stretch', ('N/m^2', 'N'), (0.0, 0.0), symbols=('a', 'b'), is_additive=False,
         effect='The stiffness of the cup changes as its length does', by_sign=(
             'The cup is stiffer in compression than in tension',
             'The cup is stiffer in tension than in compression')),
    Term('layout', ('m',), (0.0, 0.0, 0.0), structure.positions_of))}
"""All terms of a cup by name. Files, nodes, fits, checks and exports iterate over them."""

LAW: Mapping[str, Term] = {name: term for name, term in TERMS.items() if term.symbols}
"""Terms that extend the law of K and P, all zeros for a cup without them."""


def frozen_array(values: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """Return a read-only copy of the given shape, or raise an error that names the quantity."""
    array = real_numbers(values, what)
    if array.shape != shape:
        raise BellowsError(f'The {what} must have the shape {shape}, got {array.shape}.')
    if not np.all(np.isfinite(array)):
        raise BellowsError(f'The {what} must be finite numbers, got {array.tolist()}.')
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Cup:
    """
    A bellows suction cup under vacuum.

    Parameters
    ----------
    stiffness : array_like (6, 6)
        K of the potential (3.17); N/m, N/rad, N m/rad in its blocks.
    damping : array_like (6, 6)
        P of (3.33); N s/m, N s/rad, N m s/rad in its blocks.
    length : float
        Length l0 under vacuum without load, m. Spring and damper sit at half the length, l1 = l2 =
        l0 / 2.
    relaxation : (float, float)
        Strengths r_b of two branches of relaxing rubber: the stiffness is K (1 + r1 + r2) for a
        sudden strain, and K, the static stiffness, after relaxation. Zeros for a cup without
        relaxation.
    relaxation_times : (float, float)
        Times tau_b of the branches, s.
    stretch : (float, float)
        Coefficients a (N/m^2) and b (N) of the energy a h_z^3 + b h_z (h_rx^2 + h_ry^2): below 0
        for a spring that is stiffer in tension than in compression, and in bending under tension.

    Raises
    ------
    BellowsError
        If a matrix is not 6x6, finite and symmetric, the length or a time is not positive, the
        length is above 1 m, a strength is negative, or a coefficient is not finite. Definiteness
        is not required.

    Examples
    --------
    >>> K = np.diag([5400.0, 5400.0, 9200.0, 4.2, 4.2, 1.35])
    >>> P = np.diag([55.0, 55.0, 24.0, 0.06, 0.06, 0.1])
    >>> bellows_ros.Cup(stiffness=K, damping=P, length=0.046).length
    0.046

    """

    stiffness: Array
    damping: Array
    length: float
    relaxation: tuple[float, ...] = (0.0, 0.0)
    relaxation_times: tuple[float, float] = structure.RELAXATION_TIMES
    stretch: tuple[float, ...] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ('stiffness', 'damping'):
            matrix = frozen_array(getattr(self, name), (6, 6), name)
            structure.require_symmetric(matrix, f'The {name}')
            object.__setattr__(self, name, matrix)
        object.__setattr__(self, 'length', float(frozen_array(self.length, (), 'cup length')))
        if self.length <= 0.0:
            raise BellowsError(f'The cup length must be above 0 m, got {self.length}.')
        if self.length > MAX_LENGTH:  # the limit of the table of parameters
            raise BellowsError(
                f'The cup length must be at most {MAX_LENGTH:g} m, got {self.length:g}. Is it in '
                'mm?')
        for name, what in (('relaxation', 'two strengths of cup.relaxation'),
                           ('relaxation_times', 'two relaxation_times'),
                           ('stretch', 'two coefficients of cup.stretch')):
            numbers = frozen_array(getattr(self, name), (2,), what).tolist()
            object.__setattr__(self, name, tuple(numbers))
        r, tau = self.relaxation, self.relaxation_times
        if min(r) < 0.0:
            raise BellowsError(
                'cup.relaxation must be two strengths of 0 or more, as fractions of the static '
                f'stiffness, got {list(r)}. Without relaxation they are [0, 0].')
        if not 0.0 < tau[0] < tau[1]:
            raise BellowsError(
                'relaxation_times must be two times above 0 s, the shorter one first, got '
                f'{list(tau)}. Leave them at {list(structure.RELAXATION_TIMES)}: cup.relaxation '
                'is identified with these.')

    @classmethod
    def thesis(cls) -> 'Cup':
        """Return the cup identified in the thesis: K (4.78), P (4.79), l0 of section 4.2."""
        return cls(np.diag(structure.THESIS_STIFFNESS), np.diag(structure.THESIS_DAMPING),
                   structure.THESIS_LENGTH)

    def with_terms(self, terms: Mapping[str, Any]) -> 'Cup':
        """Return a cup with other terms, by name."""
        return replace(self, **terms)

    def parameters(self) -> dict[str, Any]:
        """Return all terms by parameter; the layout is of one cup, as K and P are composed."""
        return {term.parameter: term.to_parameter(getattr(self, term.name, term.default))
                for term in TERMS.values()}

    @cached_property
    def as_tuple(self) -> CupTuple:
        """The cup as the kernels take it."""
        pairs = zip(self.relaxation, self.relaxation_times, strict=True)
        branches = pairs if any(self.relaxation) else ()
        return (0.5 * float(self.length), float(self.length),
                (*blocks(self.stiffness), self.stretch), blocks(self.damping), *branches)


@dataclass(frozen=True)
class Package:
    """
    A rigid package and its place on the lip.

    Parameters
    ----------
    mass : float
        Mass, kg.
    inertia : array_like (3, 3)
        Inertia tensor at the centre of mass, in B axes, kg m^2.
    com : array_like (3,)
        Centre of mass B in the lip frame S, m; typically (0, 0, -d).
    is_checked : bool
        Whether the numbers are checked.

    Raises
    ------
    BellowsError
        If the mass is not positive, the centre of mass is farther than 10 m, or no rigid body can
        have the inertia.

    Warns
    -----
    UnitWarning
        If a number is likely in another unit.

    Examples
    --------
    >>> inertia = np.diag([0.00438, 0.00654, 0.00984])
    >>> bellows_ros.Package(mass=1.8, inertia=inertia, com=(0.0, 0.0, -0.03)).mass
    1.8

    """

    mass: float
    inertia: Array
    com: Array
    is_checked: InitVar[bool] = True

    def __post_init__(self, is_checked: bool) -> None:
        if not is_checked:
            return
        object.__setattr__(self, 'inertia', frozen_array(self.inertia, (3, 3), 'package inertia'))
        object.__setattr__(self, 'com', frozen_array(self.com, (3,), 'package centre of mass'))
        object.__setattr__(self, 'mass', float(frozen_array(self.mass, (), 'package mass')))
        if self.mass <= 0.0:
            raise BellowsError(f'The package mass must be above 0 kg, got {self.mass}.')
        if np.abs(self.com).max() > 10.0:  # the limit of the table of parameters
            raise BellowsError(f'package.com must be within 10 m, got {self.com.tolist()}.')
        structure.check_inertia(self.inertia)
        for doubt in structure.unit_doubts(
                self.mass, np.diag(self.inertia).tolist(), self.com.tolist()):
            warnings.warn(doubt, UnitWarning, stacklevel=3)

    @cached_property
    def as_tuple(self) -> PackageTuple:
        """The package as the kernels take it."""
        return package_tuple(self.mass, self.com, self.inertia)


def gripper_of(one: Cup, places: Array | Sequence[Sequence[float]]) -> Cup:
    """
    Return the cup equivalent to equal cups at places (n, 4); without places, the one cup.

    Raises
    ------
    BellowsError
        If the single cup has a term of which the energy of several cups has another form.

    """
    if not len(places) or structure.is_single(np.asarray(places)):
        return one
    for term in LAW.values():
        numbers, zeros = list(getattr(one, term.name)), [0.0] * len(term.symbols)
        if any(numbers) and not term.is_additive:
            raise BellowsError(
                f'{term.parameter} is {numbers}, but cup.layout has {len(places)} cups; expected '
                f'{zeros} with several, whose energy is none of this form. Set {term.parameter}: '
                f'{zeros}, or leave cup.layout out and identify the gripper as one cup.')
    K, P = (structure.composed(each, np.asarray(places)) for each in (one.stiffness, one.damping))
    return replace(one, stiffness=K, damping=P)


def varied(
    package: Package, com: ArrayLike = 0.0, mass: ArrayLike = 0.0, inertia: ArrayLike = 0.0
) -> Package:
    """
    Return a package with a shifted centre of mass (3,), m, and scaled mass and inertia.

    Scales are logarithms of factors of the mass, and of each moment of inertia (3,) or of all; see
    `pseudo_inertia.with_moments`.
    """
    return Package(
        package.mass * float(np.exp(mass).item()),
        pseudo_inertia.with_moments(package.inertia, np.broadcast_to(inertia, 3)),
        package.com + np.asarray(com), is_checked=False)


def package_tuple(mass: float, com: Array, inertia: Array) -> PackageTuple:
    """Return a package as the kernels take it."""
    return float(mass), _tuple(com), _tuple(inertia), _tuple(np.linalg.inv(inertia))


def _tuple(values: NDArray[Any]) -> Any:
    return tuple(float(value) for value in values.ravel())


def blocks(matrix: Array) -> Blocks:
    """Return the (oo, oR, RR) blocks of a symmetric (6, 6) matrix, as the kernels take them."""
    return _tuple(matrix[:3, :3]), _tuple(matrix[:3, 3:]), _tuple(matrix[3:, 3:])


def model_tuple(cup: Cup, package: Package, gravity: float | ArrayLike) -> ModelTuple:
    """Return the model as the kernels take it, with gravity as in `gravity_vector`."""
    vector = frozen_array(gravity_vector(gravity), (3,), 'gravity')
    return cup.as_tuple, package.as_tuple, _tuple(vector)


def gravity_vector(gravity: float | ArrayLike) -> Array:
    """Return gravity in the world (3,) from its magnitude along -z, or as given, m/s^2."""
    vector = real_numbers(gravity, 'gravity')
    return np.array([0.0, 0.0, -float(vector)]) if vector.ndim == 0 else vector


def regressor(
    length: float, basis: list[Array], position: Array, rotation: Array, twist: Array
) -> Array:
    """
    Return the regressor L (N, 6, 2 n) of the wrench at the lip, L x (4.67), linear in K and P.

    Parameters
    ----------
    length : float
        Length of the cup, m.
    basis : list of ndarray (6, 6)
        The n symmetric matrices whose weighted sums are K and P; x has the weights of K, then of
        P.
    position, rotation, twist : ndarray (N, 3), (N, 3, 3), (N, 6)
        E_o_S (m), E_R_S and the body twist of the lip relative to the tool.

    """
    zero, units = blocks(np.zeros((6, 6))), [blocks(unit) for unit in basis]
    # The kernel's arithmetic also holds for tuples of arrays.
    sampled: Any = (tuple(position.T.copy()), tuple(rotation.reshape(-1, 9).T.copy()),
                    tuple(twist[:, :3].T.copy()), tuple(twist[:, 3:].T.copy()))
    pairs = [(unit, zero) for unit in units] + [(zero, unit) for unit in units]  # K and P
    wrenches = [kernels.cup_wrench((0.5 * length, length, K, P), *sampled) for K, P in pairs]
    return np.stack([np.concatenate(wrench).T for wrench in wrenches], axis=2)


def box_inertia(mass: float, depth: float, width: float, height: float) -> Array:
    """
    Return the inertia tensor (3, 3) in kg m^2 of a homogeneous box at its centre (A.2).

    Depth lies along x, width along y and height along z, all in m. Numbers that are not above 0
    raise BellowsError; implausible ones cause a UnitWarning.

    Examples
    --------
    >>> inertia = bellows_ros.box_inertia(1.8, depth=0.2, width=0.16, height=0.06)
    >>> inertia.diagonal().round(5).tolist()
    [0.00438, 0.00654, 0.00984]

    """
    box = frozen_array([mass, depth, width, height], (4,), 'mass and sides of a box')
    if not box.min() > 0.0:
        raise BellowsError(
            f'A box needs mass (kg), depth, width and height (m) above 0, got {box.tolist()}.')
    d2, w2, h2 = box[1:]**2
    moments = box[0] / 12.0 * np.array([h2 + w2, h2 + d2, d2 + w2])
    for doubt in structure.unit_doubts(float(box[0]), moments.tolist()):
        warnings.warn(doubt, UnitWarning, stacklevel=2)
    return np.diag(moments)


def model_with(model: ModelTuple, numbers: Array, places: Array = SINGLE) -> ModelTuple:
    """
    Return a model with other numbers (52,), but the same length and gravity.

    K and P are of each of n equal cups; places (n, 4) are x, y, z (m) in E, and the index.
    """
    K, P = np.zeros((2, 6, 6))
    K[UPPER], P[UPPER] = numbers[:21], numbers[21:42]
    K, P = (structure.composed(np.triu(M) + np.triu(M, 1).T, places) for M in (K, P))
    stretch, branches = kernels.law_of(model)
    oo, oR, RR, *_ = blocks(K)
    spring: Blocks = (oo, oR, RR, *stretch)
    cup: CupTuple = (model[0][0], model[0][1], spring, blocks(P), *branches)
    package = package_tuple(
        numbers[42], numbers[43:46], structure.inertia_matrix(numbers[46:]))
    return cup, package, model[2]


class Uncertain(NamedTuple):
    """The numbers (52,) of cup and package, their standard deviations, and the cups' places."""

    numbers: Array
    std: Array
    places: Array


def perturbed(
    uncertain: Uncertain, model: ModelTuple
) -> Iterator[tuple[str, ModelTuple, ModelTuple]]:
    """Yield name and models with one uncertain number `PERTURBATION` sigma larger and smaller."""
    numbers, std, places = uncertain
    for i in np.flatnonzero(std):
        change = PERTURBATION * std[i] * np.eye(len(std))[i]
        up, down = (model_with(model, numbers + side * change, places) for side in (1, -1))
        yield PARAMETER_NAMES[i], up, down


def contributions(
    uncertain: Uncertain, model: ModelTuple, compute: Callable[[ModelTuple], Array]
) -> tuple[list[str], Array]:
    """
    Return the contribution of each uncertain number to the standard deviations of outputs.

    The standard deviation of an output is |J sigma|, with the derivatives J of the output by the
    uncertain numbers, which are assumed independent. Derivatives are central differences of whole
    predictions, because an output may be a maximum over time, whose analytic slope differs from
    the slope over half a sigma.

    Parameters
    ----------
    uncertain : Uncertain
        Numbers with standard deviations.
    model : tuple
        Model with these numbers, for the kernels.
    compute : callable
        Function from a model to its outputs, an array.

    Returns
    -------
    names : list of str
        Names of the M uncertain numbers.
    parts : array (M, ...)
        Derivative times standard deviation; the standard deviation of an output is the root of its
        sum of squares.

    """
    parts = {name: (compute(up) - compute(down)) / (2.0 * PERTURBATION)
             for name, up, down in perturbed(uncertain, model)}
    return list(parts), np.array(list(parts.values()))


def mean_square(
    uncertain: Uncertain, model: ModelTuple, compute: Callable[[ModelTuple], float]
) -> float:
    """
    Return the mean square of a vector over the uncertain parameters; see `contributions`.

    The mean square is computed from the squared norm, which is quadratic in each number, because
    the derivative of a norm is undefined at zero.
    """
    square = compute(model) ** 2
    changes = sum(compute(up) ** 2 + compute(down) ** 2 - 2.0 * square
                  for _, up, down in perturbed(uncertain, model))
    return max(square + changes / (2.0 * PERTURBATION ** 2), 0.0)
