"""
Uncertain quantities of cup and package, and models with one of them changed.

A figure's standard deviation is |J sigma| with J its derivatives by the uncertain numbers, which
are taken to be independent. They are central differences of whole predictions, not analytic ones:
a figure is a largest value over time, or of the instant at which a cup lets go or a box meets the
floor, and its slope at a point can be other than that over half a sigma.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from bellows_ros.core.geometry.arrays import Array
from bellows_ros.core.model import structure
from bellows_ros.core.model.cup_package import blocks, package_tuple
from bellows_ros.core.model.kernels import ModelTuple
from bellows_ros.core.model.structure import matrix, SINGLE, UPPER
import numpy as np

STEP = 0.5
"""Step of central differences, standard deviations."""

NAMES = (
    *(f'{kind}[{i},{j}]' for kind in ('cup.stiffness', 'cup.damping')
      for i, j in zip(*UPPER, strict=True)),
    'package.mass', *(f'package.com[{axis}]' for axis in 'xyz'),
    *(f'package.inertia[{entry}]' for entry in ('xx', 'yy', 'zz', 'xy', 'xz', 'yz')))
"""The 52 parameters, in the order of the arrays."""


def parameter_vector(values: Mapping[str, Any]) -> Array:
    """Return the numbers (52,) of parameter values: K and P, mass, com, inertia; SI units."""
    return np.concatenate([
        matrix(values['cup.stiffness'])[UPPER], matrix(values['cup.damping'])[UPPER],
        [values['package.mass']], values['package.com'], values['package.inertia']])


def deviations_of(values: Mapping[str, Any]) -> Array:
    """
    Return the standard deviations (52,) of the numbers.

    An entry of K or P that is not identifiable has a huge one. A linear model holds for no more
    than entries as large as the roots of their two diagonal ones: those are the largest.
    """
    root = [np.sqrt(np.diag(matrix(values[kind]))) for kind in ('cup.stiffness', 'cup.damping')]
    most = np.concatenate([np.outer(each, each)[UPPER] for each in root])
    std = parameter_vector({name.removesuffix('_std'): each for name, each in values.items()
                            if name.endswith('_std')})
    return np.concatenate([np.minimum(std[:42], most), std[42:]])


def model_with(model: ModelTuple, numbers: Array, places: Array = SINGLE) -> ModelTuple:
    """
    Return a model with other numbers (52,), length and gravity as they are.

    K and P are those of one of the cups at the places, as `places_of` returns them.
    """
    K, P = np.zeros((2, 6, 6))
    K[UPPER], P[UPPER] = numbers[:21], numbers[21:42]
    K, P = (structure.composed(np.triu(M) + np.triu(M, 1).T, places) for M in (K, P))
    cup = (*model[0][:2], blocks(K), blocks(P), *model[0][4:])
    package = package_tuple(
        numbers[42], numbers[43:46], structure.inertia_matrix(numbers[46:]))
    return cup, package, model[2]


def perturbed(
    values: Mapping[str, Any], model: ModelTuple
) -> Iterator[tuple[str, ModelTuple, ModelTuple]]:
    """Yield name and models with a number `STEP` sigma up and down, where sigma is not 0."""
    numbers, places = parameter_vector(values), structure.places_of(values)
    changes = np.diag(STEP * deviations_of(values))
    for i in np.flatnonzero(changes.diagonal()):
        up, down = (model_with(model, numbers + side * changes[i], places) for side in (1, -1))
        yield NAMES[i], up, down


def contributions(
    values: Mapping[str, Any], model: ModelTuple, compute: Callable[[ModelTuple], Array]
) -> tuple[list[str], Array]:
    """
    Return the contribution of each uncertain parameter to the standard deviations of figures.

    Parameters
    ----------
    values : mapping
        Parameters by name: cup.stiffness, cup.damping, package.*, each with its _std.
    model : tuple
        Of the same values, as the kernels take it.
    compute : callable
        From a model to figures, an array.

    Returns
    -------
    names : list of str
        M, of the uncertain numbers.
    parts : array (M, ...)
        Derivative times standard deviation; the root of their squares' sum is a figure's own.

    """
    parts = {name: (compute(up) - compute(down)) / (2.0 * STEP)
             for name, up, down in perturbed(values, model)}
    return list(parts), np.array(list(parts.values()))


def mean_square(
    values: Mapping[str, Any], model: ModelTuple, compute: Callable[[ModelTuple], float]
) -> float:
    """
    Return the mean square of a vector over the uncertain parameters; see `contributions`.

    Of a size near zero the derivative says nothing; its square is quadratic in each number.
    """
    square = compute(model) ** 2
    changes = sum((compute(up) ** 2 + compute(down) ** 2 - 2.0 * square) / (2.0 * STEP ** 2)
                  for _, up, down in perturbed(values, model))
    return max(square + changes, 0.0)
